"""Check of the inclination log against the ground: bias, cyclic error and clock offset.

The adjustment combines ground and log. With the log removed from it again, the estimated tilt is what the
ground alone predicts for the log.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import linalg, special

from station.quantities import Bools, Floats, Reference, VarianceComponents
from station.science.adjustment.joint import Adjustment
from station.science.adjustment.prior import BIAS_MODES, LineTimes, tilt_covariance
from station.science.geometry.cyclic_error import OFFSET_PRIOR_S

FALSE_ALARM_PROBABILITY = 1e-5  # of a sensor error within its prior
MIN_PRECISION = 1e-6  # of the difference between log and ground, over that of the best known combination
MIN_OBSERVABILITY = 1e-3  # of the eigenvalue of the best observed combination of errors
MAX_OFFSET_S = 10.0  # clocks differ by up to 5 s (equations.md, 2.10): twice that is searched
MIN_OFFSET_S = 3.5  # smaller offsets are not reported
OFFSET_STEP_S = 0.5
MIN_LOG_ODDS = 11.0  # of an offset, which is N(0, `OFFSET_PRIOR_S`) before, against none
MAX_OFFSET_SIGMA_S = 2.5  # one sigma; beyond, several offsets are equally likely
LONGEST_PERIOD_S = 30.0  # longer ones constrain a clock little, and the motion there is least known
MIN_LINES, MIN_DURATION_S = 100, 60.0  # of a log for an estimate


@dataclass(frozen=True)
class ClockOffset:
    """Residual clock offset of an inclination log [s], positive if late, and its standard deviation [s].

    `log_likelihood_ratio` compares this offset with no offset.
    """

    offset_s: float
    sigma_s: float
    log_likelihood_ratio: float

    def warnings(self) -> list[str]:
        """Return a message if the offset is significant, large and well determined.

        Sway may look alike by chance at any offset, but a clock is seldom off by much.
        """
        log_odds = self.log_likelihood_ratio - (self.offset_s / OFFSET_PRIOR_S) ** 2 / 2
        if log_odds < MIN_LOG_ODDS or abs(self.offset_s) < MIN_OFFSET_S or self.sigma_s > MAX_OFFSET_SIGMA_S:
            return []
        offset_text = f"{abs(self.offset_s):.1f} s {'late' if self.offset_s > 0 else 'early'}"
        return [f"inclination log {offset_text} (± {self.sigma_s:.1f} s) by the ground: it is not used"]


@dataclass(frozen=True)
class LogCheck:
    """What the ground says against the log of a scan, and its clock offset, None if it is too short."""

    warnings: list[str]
    clock_offset: ClockOffset | None


@dataclass(frozen=True)
class LogPrediction:
    """Tilt in an inclination log (lines,), in order of time, and its prediction from the ground alone.

    `precision` (lines, lines) is the inverse covariance of the difference, sensor errors included;
    `weighted_residual` (lines,) is the difference times the inverse covariance of log noise and sensor
    errors.
    """

    lines: LineTimes
    log_rad: Floats
    error_modes: Floats  # (lines, f) effect of one sigma of each [rad]
    predicted_rad: Floats
    precision: Floats
    weighted_residual: Floats


def check_log(lines: LineTimes, adjustment: Adjustment, reference: Reference) -> LogCheck | None:
    """Return the check of the log that an adjustment used; None if it used none."""
    prediction = leave_log_out(lines, adjustment)
    if prediction is None:
        return None
    clock_offset = estimate_clock_offset(prediction, reference.components, len(reference.scan_ids))
    clock_warnings = clock_offset.warnings() if clock_offset else []
    return LogCheck(sensor_warnings(prediction) + clock_warnings, clock_offset)


def leave_log_out(lines: LineTimes, adjustment: Adjustment) -> LogPrediction | None:
    """Return the prediction of the log by an adjustment without it; None without a log of the scan's time.

    With m and K the adjusted tilt and its covariance, R the covariance of noise and sensor errors, and r the
    log minus m, the difference to the prediction without the log is R (R - K)⁻¹ r: the leave-one-out
    residual, for all lines at once. Models of the ground's change that disagree may make K larger than R; of
    what they disagree about, the ground predicts nothing.
    """
    if (log := adjustment.log) is None or not log.weight.any():
        return None
    order = np.argsort(lines.time_s)
    order = order[log.weight[order] > 0]
    predicted_covariance = adjustment.posterior.sight_tilt_covariance(log)[np.ix_(order, order)]
    residual_rad = log.sight_tilt_rad[order] - adjustment.predicted_log_rad[order]
    weight, error_modes = log.weight[order], log.error_modes[order]
    weighted_modes = weight[:, None] * error_modes
    mode_factor = np.linalg.cholesky(np.eye(error_modes.shape[1]) + error_modes.T @ weighted_modes)
    scaled_modes = linalg.solve_triangular(mode_factor, weighted_modes.T, lower=True).T

    def apply_noise_precision(values: Floats) -> Floats:
        return np.asarray((weight * values.T).T - scaled_modes @ (scaled_modes.T @ values))

    precision = apply_noise_precision(np.eye(len(order)) - apply_noise_precision(predicted_covariance).T)
    weighted_residual = apply_noise_precision(residual_rad)
    try:
        difference_rad = linalg.cho_solve(linalg.cho_factor(precision, lower=True), weighted_residual)
    except linalg.LinAlgError:
        values, vectors = linalg.eigh(precision)
        known = values > MIN_PRECISION * values[-1]
        values, vectors = values[known], vectors[:, known]
        precision = (vectors * values) @ vectors.T
        difference_rad = vectors @ (vectors.T @ weighted_residual / values)
    return LogPrediction(
        LineTimes(lines.azimuth_rad[order], lines.time_s[order]),
        log.sight_tilt_rad[order],
        error_modes,
        log.sight_tilt_rad[order] - difference_rad,
        precision,
        weighted_residual,
    )


def sensor_warnings(prediction: LogPrediction) -> list[str]:
    """Return a message if the sensor's bias or cyclic error exceeds its prior sigma significantly.

    Each estimate is normal, with the part of its prior variance that the ground can observe.
    """
    estimate = prediction.error_modes.T @ prediction.weighted_residual
    variance = prediction.error_modes.T @ prediction.precision @ prediction.error_modes
    biases = np.arange(len(estimate)) < BIAS_MODES
    if _p_value(estimate, variance) > FALSE_ALARM_PROBABILITY:
        return []
    cyclic_p, bias_p = (
        _p_value(estimate[prediction], variance[np.ix_(prediction, prediction)])
        for prediction in (~biases, biases)
    )
    chosen = biases if bias_p < cyclic_p else ~biases
    # By least squares: the prior, which it exceeds, would shrink it.
    size = (
        np.linalg.pinv(variance[np.ix_(chosen, chosen)], MIN_OBSERVABILITY, hermitian=True) @ estimate[chosen]
    )
    largest_deg = np.degrees(np.abs(prediction.error_modes[:, chosen] @ size).max())
    if bias_p < cyclic_p:
        deviation = f"is off by {largest_deg:.3f} degrees, beyond its usual bias"
    else:
        deviation = f"has a cyclic error that differs by {largest_deg:.3f} degrees from its usual one"
    return [f"the inclination sensor {deviation}: its log is not used"]


def _p_value(estimate: Floats, variance: Floats) -> float:
    """Return the probability of normal estimates (f,) as large as these, over the observable components."""
    values, vectors = np.linalg.eigh(variance)
    observable = values > MIN_OBSERVABILITY * values.max()
    chi2 = np.sum((vectors.T @ estimate)[observable] ** 2 / values[observable])
    return float(special.chdtrc(np.count_nonzero(observable), chi2))


def estimate_clock_offset(
    prediction: LogPrediction, components: VarianceComponents, reference_scans: int
) -> ClockOffset | None:
    """Return the clock offset of the log by its correlation with the ground's tilt; None if it is too short.

    The reference is a mean of `reference_scans` scans, 0 if it comes from elsewhere; the residual tilt of
    that mean is part of the model.
    """
    if len(prediction.log_rad) < MIN_LINES or np.ptp(prediction.lines.time_s) < MIN_DURATION_S:
        return None
    offset_s, log_likelihood = _offset_log_likelihood(
        prediction, components, 1 / reference_scans if reference_scans else 0.0
    )
    probability = np.exp(log_likelihood - log_likelihood.max())
    probability /= probability.sum()
    mean_s = float(probability @ offset_s)
    sigma_s = float(np.sqrt(probability @ (offset_s - mean_s) ** 2 + OFFSET_STEP_S**2 / 12))
    return ClockOffset(
        mean_s, sigma_s, float(log_likelihood.max() - log_likelihood[np.argmin(np.abs(offset_s))])
    )


def _offset_log_likelihood(
    prediction: LogPrediction, components: VarianceComponents, reference_share: float
) -> tuple[Floats, Floats]:
    """Return trial clock offsets (n,) [s] and the log-likelihood of each (n,).

    `reference_share` is the tilt variance of the reference over that of one scan: the adjustment cannot
    remove it, because all scans share it. Slow waves, and the lines at both ends that have no counterpart,
    are free parameters.
    """
    time_s = prediction.lines.time_s
    elapsed_s = time_s - time_s[0]
    orders = np.arange(int(2 * elapsed_s[-1] / LONGEST_PERIOD_S) + 1)
    edge: Bools = (elapsed_s < MAX_OFFSET_S) | (elapsed_s > elapsed_s[-1] - MAX_OFFSET_S)
    free_terms = np.concatenate(
        [np.cos(np.pi * np.outer(elapsed_s / elapsed_s[-1], orders)), np.eye(len(time_s))[:, edge]], axis=1
    )
    covariance = tilt_covariance(components, prediction.lines)
    offset_s = np.arange(-MAX_OFFSET_S, MAX_OFFSET_S + OFFSET_STEP_S / 2, OFFSET_STEP_S)
    predicted_rad = _predicted_tilt(prediction, components, covariance, reference_share)
    residual_rad = prediction.log_rad[:, None] - np.stack(
        [np.interp(time_s - s, time_s, predicted_rad) for s in offset_s], axis=1
    )
    weighted_terms, weighted_residual = np.split(
        _apply_precision(
            prediction.precision, reference_share * covariance, np.hstack([free_terms, residual_rad])
        ),
        [free_terms.shape[1]],
        1,
    )
    normal_factor = linalg.cho_factor(free_terms.T @ weighted_terms)
    chi2 = np.sum(residual_rad * weighted_residual, axis=0)
    chi2 -= np.sum(
        (weighted_terms.T @ residual_rad) * linalg.cho_solve(normal_factor, weighted_terms.T @ residual_rad),
        axis=0,
    )
    variance_factor = chi2.min() / (
        len(time_s) - free_terms.shape[1]
    )  # relative to the assumed noise of the log
    return offset_s, -chi2 / 2 / max(variance_factor, 1.0)


def _apply_precision(precision: Floats, added_covariance: Floats, values: Floats) -> Floats:
    """Return (P⁻¹ + A)⁻¹ V for a precision P (n, n), an added covariance A (n, n), values V (n, k)."""
    weighted = precision @ values
    if not added_covariance.any():
        return weighted
    return np.asarray(linalg.solve(np.eye(len(precision)) + precision @ added_covariance, weighted))


def _predicted_tilt(
    prediction: LogPrediction, components: VarianceComponents, covariance: Floats, reference_share: float
) -> Floats:
    """Return the tilt the ground predicts for the sensor (lines,) [rad], without white line jitter.

    `covariance` (lines, lines) is that of a scan's tilt; the reference has `reference_share` of it.
    """
    mean_rad = prediction.predicted_rad.mean()
    weighted = linalg.solve(
        (1 + reference_share) * covariance, prediction.predicted_rad - mean_rad, assume_a="pos"
    )
    return np.asarray(mean_rad + covariance @ weighted - components.line_jitter_rad**2 * weighted)
