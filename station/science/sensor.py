"""What the ground says of the inclination log: how far it is off its habits, and how late its clock is.

An adjustment holds ground and log together; with the log taken out again, its lean is what the ground alone
expects the log to say.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import linalg, special

from station.quantities import Bools, Floats, Habits
from station.science.adjustment import Adjustment
from station.science.prior import BIASES, Lines, motion

CHANCE = 1e-5  # that a log within its habits looks as far off
SEEN = 1e-3  # least share of the best seen combination of faults
LATE_MOST_S = 10.0  # clocks differ by up to 5 s, EQUATIONS 2.10: twice that is looked for
LATE_LEAST_S = 3.5  # that is worth a word
LATE_STEP_S = 0.5
LATE_ODDS = 11.0  # logarithm, against a log that is not late; by chance in less than one scan of a thousand
LATE_SIGMA_S = 2.5  # one sigma of a lateness that is told: else several are as likely
SLOW_S = 30.0  # periods above say little of a clock, and are where motion is least known
FEWEST_LINES, SHORTEST_S = 100, 60.0  # of a log that tells how late it is


@dataclass(frozen=True)
class Lateness:
    """How late a log's clock is beyond what it was already corrected by [s], one sigma of that [s].

    `odds` is the logarithm of how much likelier that is than none.
    """

    late_s: float
    sigma_s: float
    odds: float

    def words(self) -> list[str]:
        """Say it where it is clear."""
        if self.odds < LATE_ODDS or abs(self.late_s) < LATE_LEAST_S or self.sigma_s > LATE_SIGMA_S:
            return []
        late = f"{abs(self.late_s):.1f} s {'late' if self.late_s > 0 else 'early'}"
        return [f"inclination log {late} (± {self.sigma_s:.1f} s), by how the ground sways"]


@dataclass(frozen=True)
class Expected:
    """What a log says (lines,), in the order of time, against what the ground alone expects of it.

    `precision` (lines, lines) is the inverse covariance of the difference, the log's faults included;
    `by_noise` (lines,) the difference over the covariance of log noise and faults alone.
    """

    lines: Lines
    log_rad: Floats
    faults: Floats  # (lines, f) effect of one sigma of each [rad]
    ground_rad: Floats
    precision: Floats
    by_noise: Floats


def expected(lines: Lines, found: Adjustment) -> Expected | None:
    """Take the log out of an adjustment again; None where there was none.

    With m, K what the log should have said and the covariance of that, R the covariance of noise and faults
    and r = log - m, the difference to what is expected without the log is R (R - K)⁻¹ r: the formula of
    leave-one-out residuals, for all lines at once.
    """
    if (log := found.log) is None:
        return None
    order = np.argsort(lines.time_s)
    order = order[log.weight[order] > 0]
    known = found.unknown.along_sight(log)[np.ix_(order, order)]
    left = log.lean_rad[order] - found.logged_rad[order]
    weight, faults = log.weight[order], log.faults[order]
    weighted = weight[:, None] * faults
    inner = np.linalg.cholesky(np.eye(faults.shape[1]) + faults.T @ weighted)
    common = linalg.solve_triangular(inner, weighted.T, lower=True).T

    def over_noise(values: Floats) -> Floats:
        return np.asarray((weight * values.T).T - common @ (common.T @ values))

    precision = over_noise(np.eye(len(order)) - over_noise(known).T)
    by_noise = over_noise(left)
    factor = linalg.cho_factor(precision, lower=True)
    return Expected(
        Lines(lines.azimuth_rad[order], lines.time_s[order]),
        log.lean_rad[order],
        faults,
        log.lean_rad[order] - linalg.cho_solve(factor, by_noise),
        precision,
        by_noise,
    )


def off_habit(of: Expected) -> list[str]:
    """Say whether the sensor's faults are beyond its habits, and whether its wave over a turn is or its bias.

    Each estimate is normal with the part of its prior variance that the ground lets be seen.
    """
    estimate = of.faults.T @ of.by_noise
    variance = of.faults.T @ of.precision @ of.faults
    biases = np.arange(len(estimate)) < BIASES
    if _chance(estimate, variance) > CHANCE:
        return []
    wave, bias = (_chance(estimate[of], variance[np.ix_(of, of)]) for of in (~biases, biases))
    chosen = biases if bias < wave else ~biases
    largest_deg = np.degrees(np.abs(of.faults[:, chosen] @ estimate[chosen]).max())
    if bias < wave:
        return [f"the inclination sensor is {largest_deg:.3f} degree off, beyond its habit"]
    return [f"the inclination sensor's wave over a turn is {largest_deg:.3f} degree off its habit"]


def _chance(estimate: Floats, variance: Floats) -> float:
    """Chance that normal estimates (f,) are as large; what the ground does not let be seen does not count."""
    values, vectors = np.linalg.eigh(variance)
    seen = values > SEEN * values.max()
    size = np.sum((vectors.T @ estimate)[seen] ** 2 / values[seen])
    return float(special.chdtrc(np.count_nonzero(seen), size))


def lateness(of: Expected, habits: Habits, reference_scans: int) -> Lateness | None:
    """How late the log is, by how alike its swaying is to that of the ground; None where it is too short.

    The ground is a mean of so many scans (0: it comes from elsewhere), and leans by what is left of theirs.
    """
    if len(of.log_rad) < FEWEST_LINES or np.ptp(of.lines.time_s) < SHORTEST_S:
        return None
    late_s, odds = _odds_of_lateness(of, habits, 1 / reference_scans if reference_scans else 0.0)
    chance = np.exp(odds - odds.max())
    chance /= chance.sum()
    mean_s = float(chance @ late_s)
    sigma_s = float(np.sqrt(chance @ (late_s - mean_s) ** 2 + LATE_STEP_S**2 / 12))
    return Lateness(mean_s, sigma_s, float(odds.max() - odds[np.argmin(np.abs(late_s))]))


def _odds_of_lateness(of: Expected, habits: Habits, leans: float) -> tuple[Floats, Floats]:
    """Lateness (n,) [s] and the logarithm of its likelihood (n,).

    `leans` is what the reference has of the variance of a scan's motion: no adjustment takes that off, as all
    its scans lean by it alike. Slow waves, and the lines at both ends that have no partner, are left free.
    """
    time_s = of.lines.time_s
    into_s = time_s - time_s[0]
    waves = np.arange(int(2 * into_s[-1] / SLOW_S) + 1)
    edge: Bools = (into_s < LATE_MOST_S) | (into_s > into_s[-1] - LATE_MOST_S)
    free = np.concatenate(
        [np.cos(np.pi * np.outer(into_s / into_s[-1], waves)), np.eye(len(time_s))[:, edge]], axis=1
    )
    whole = motion(habits, of.lines)
    late_s = np.arange(-LATE_MOST_S, LATE_MOST_S + LATE_STEP_S / 2, LATE_STEP_S)
    sway_rad = _sway(of, habits, whole, leans)
    off = of.log_rad[:, None] - np.stack([np.interp(time_s - s, time_s, sway_rad) for s in late_s], axis=1)
    weighted, over = np.split(_over(of.precision, leans * whole, np.hstack([free, off])), [free.shape[1]], 1)
    within = linalg.cho_factor(free.T @ weighted)
    chi2 = np.sum(off * over, axis=0)
    chi2 -= np.sum((weighted.T @ off) * linalg.cho_solve(within, weighted.T @ off), axis=0)
    noise = chi2.min() / (len(time_s) - free.shape[1])  # against what the log is thought to have
    return late_s, -chi2 / 2 / max(noise, 1.0)


def _over(precision: Floats, beside: Floats, values: Floats) -> Floats:
    """Return values (n, k) over the covariance of a precision (n, n) and of what is beside it (n, n)."""
    weighted = precision @ values
    if not beside.any():
        return weighted
    return np.asarray(linalg.solve(np.eye(len(precision)) + precision @ beside, weighted))


def _sway(of: Expected, habits: Habits, whole: Floats, leans: float) -> Floats:
    """What the ground expects a sensor to feel (lines,) [rad]: without what lines have of their own.

    `whole` (lines, lines) is the covariance of a scan's motion, of which the reference leans by a share.
    """
    mean_rad = of.ground_rad.mean()
    shown = linalg.solve((1 + leans) * whole, of.ground_rad - mean_rad, assume_a="pos")
    return np.asarray(mean_rad + whole @ shown - habits.line_motion_rad**2 * shown)
