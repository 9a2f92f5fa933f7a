"""Whether the scanner was moved: a step in the series of its poses, told from drift.

A pose drifts as a random walk, differs between odd and even scans, and is now and then wrong by itself. A
step is what stays: the scans after it lie beyond it, and no drift as quick as that of the series explains it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from station.quantities import Bools, Floats, Habits

BEFORE = 12  # scans that tell where the scanner stood
LATELY = 7  # of these, that tell where it last was if a few are wrong
AFTER = (5, 7)  # scans that must be there after a step, and after which it is no longer looked for
HISTORY = 100  # scans that tell how a station drifts
LAGS = (2, 4, 6, 8)  # scans; even, so that what differs between odd and even ones drops out
FEWEST = 20  # scans of a series before steps are looked for
HABITS_WORTH = 4  # scans of drift that the habits weigh against those of the series
SUDDEN = 1 / 3  # of the habits, which hold what drifts over days, between two scans
SIGMAS = 6.5  # of a step, before it is one
BESIDE = 3  # scans on either side of a step, that tell how sharp it is: a place beside it is as significant
QUIET = 1.5  # sigmas of one scan's noise; less between medians of scans is not worth a closer look
BEYOND = 0.5  # of its size, where a scan is taken to lie on its far side
ROUNDS = 5
CLOSER = SIGMAS / 2  # at first sight, for the other rounds, which change it by a tenth
CAUCHY = 2.385  # 95 % efficient for normal errors


@dataclass(frozen=True)
class Step:
    """A sudden, lasting change of the pose: between two scans of a series, told when a third had come.

    `size` and `sigma` (p,) are in the units of the pose; `sigmas` is how significant its clearest part is.
    """

    last_before: int
    told_at: int
    size: Floats
    sigma: Floats
    sigmas: float


def usual(habits: Habits) -> Floats:
    """What a pose is thought to differ by from scan to scan (6,): three turns [rad], three shifts [m]."""
    return SUDDEN * np.array([habits.tilt_rad] * 2 + [habits.heading_rad] + [habits.translation_m] * 3)


def steps(time_s: Floats, pose: Floats, habit: Floats) -> list[Step]:
    """Return the steps in a series of poses (n, p) at times (n,), each when scans enough had come to tell.

    `habit` (p,) is what a pose differs by from scan to scan, as thought beforehand. A step that was told is
    taken off before the next is looked for, so that it is told once.
    """
    if len(pose) < FEWEST:
        return []
    level = pose.astype(np.float64).copy()
    told: list[Step] = []
    drift = _drifts(time_s, level, habit)
    apart = _steps_apart(level)
    for newest in range(FEWEST - 1, len(level)):
        since = told[-1].last_before + 1 if told else 0
        found = _step_at(time_s[: newest + 1], level[: newest + 1], since, drift, apart[:, newest])
        if found is not None:
            told.append(found)
            level[found.last_before + 1 :] -= found.size
            drift, apart = _drifts(time_s, level, habit), _steps_apart(level)
    return told


def _step_at(time_s: Floats, level: Floats, since: int, drifts: _Drift, apart: Floats) -> Step | None:
    """Return the sharpest of the significant steps after which just scans enough have come, if any.

    `drifts` are those known at each scan, `apart` (a, p) is what the newest scans lie beyond those before.
    """
    newest = len(level) - 1
    found: list[Step] = []
    for after, beyond in zip(range(AFTER[0], AFTER[1] + 1), apart, strict=True):
        last = newest - after
        drift = drifts.at(last)
        if last < since or np.all(beyond**2 < QUIET**2 * drift.noise):
            continue
        first = max(last - BEFORE + 1, 0)
        later = np.arange(first, newest + 1) > last
        size, sigma, lasts = _fit(time_s[first:], level[first:], later, drift)
        sigmas = float(np.max(np.where(lasts, np.abs(size) / sigma, 0.0)))
        if sigmas > SIGMAS:
            found.append(Step(last, newest, size, sigma, sigmas))
    if not found:
        return None
    noise = drifts.at(found[-1].last_before).noise  # one for all, of the scans before any of these places
    return max(found, key=lambda step: _contrast(level, step.last_before, noise))


def _steps_apart(level: Floats) -> Floats:
    """How far the newest scans lie beyond those before (a, n, p): at each scan, some of them."""
    before = _medians(level, LATELY)
    return np.stack(
        [
            _medians(level, after) - np.concatenate([before[:1].repeat(after, axis=0), before[:-after]])
            for after in range(AFTER[0], AFTER[1] + 1)
        ]
    )


def _contrast(level: Floats, last_before: int, noise: Floats) -> float:
    """How much the poses (n, p) right after a scan differ from those up to it; one outlier does not count."""
    before, after = level[: last_before + 1][-BESIDE:], level[last_before + 1 :][:BESIDE]
    return float(((np.median(after, axis=0) - np.median(before, axis=0)) ** 2 / noise).sum())


@dataclass(frozen=True)
class _Drift:
    """How a pose moves (p,): variance it gains by the second, of its noise, between odd and even scans.

    Or (n, p), as known at each of some scans.
    """

    walk: Floats
    noise: Floats
    odd_even: Floats

    def at(self, scan: int) -> _Drift:
        """What is known at one scan."""
        return _Drift(self.walk[scan], self.noise[scan], self.odd_even[scan])


def _drifts(time_s: Floats, level: Floats, habit: Floats) -> _Drift:
    """Learn how a pose moves from the median differences over several lags, which outliers leave alone.

    At each scan from those up to it: it means something from the longest lag on.
    """
    both = np.column_stack([level, time_s])
    apart = np.stack([_over_lag(both, lag) for lag in LAGS], axis=1)  # (n, lags, p + 1)
    apart_s, found = apart[..., -1], (1.4826 * apart[..., :-1]) ** 2
    design = np.stack([apart_s / apart_s[:, :1], np.full(apart_s.shape, 2.0)], axis=-1)
    turned = design.swapaxes(1, 2)
    walk, noise = np.linalg.solve(turned @ design, turned @ found).swapaxes(0, 1)
    worth = HABITS_WORTH / (np.minimum(np.arange(len(level)) + 1, HISTORY) + HABITS_WORTH)[:, None]
    walk = np.clip(walk, 0.02 * found[:, 0], found[:, 0]) * (1 - worth) + habit**2 * worth
    noise = np.maximum(noise, 0.1 * found[:, 0]) * (1 - worth) + habit**2 * worth
    return _Drift(walk / apart_s[:, :1], noise, _over_lag(level, 1) ** 2 + noise)


def _over_lag(values: Floats, lag: int) -> Floats:
    """Median difference over a lag of the last `HISTORY` scans (n, q), at each scan."""
    apart = np.abs(values[lag:] - values[:-lag])
    return np.concatenate([apart[:1].repeat(lag, axis=0), _medians(apart, HISTORY - lag)])


def _medians(values: Floats, most: int) -> Floats:
    """Median of each row (n, q) and those before it, as many as there are up to `most` together.

    By sorting them all at once: numpy's own takes several times as long for each of so few values.
    """
    padded = np.concatenate([np.full((most - 1, values.shape[1]), np.nan), values])  # which sorting puts last
    ordered = np.sort(sliding_window_view(padded, most, axis=0), axis=-1)
    count = np.minimum(np.arange(len(values)) + 1, most)[:, None, None]
    middle = [np.take_along_axis(ordered, at, axis=-1)[..., 0] for at in ((count - 1) // 2, count // 2)]
    return np.asarray((middle[0] + middle[1]) / 2)


def _fit(time_s: Floats, level: Floats, later: Bools, drift: _Drift) -> tuple[Floats, Floats, Bools]:
    """Fit level, step and odd-even difference to a window (n, p): step, its sigma, whether it lasts (p,).

    The errors are those of a random walk and of noise; scans that fit neither count little.
    """
    number = np.rint((time_s - time_s[0]) / np.median(np.diff(time_s)))
    design = np.stack([np.ones(len(level)), later, np.where(number % 2, 0.5, -0.5)], axis=-1)
    elapsed_s = np.abs(time_s - time_s[~later][-1])
    apart_s = np.abs(np.subtract.outer(time_s, time_s))
    walked = drift.walk[:, None, None] * (np.add.outer(elapsed_s, elapsed_s) - apart_s) / 2
    prior = np.zeros((level.shape[1], 3, 3))
    prior[:, 2, 2] = 1 / drift.odd_even
    noise = drift.noise[:, None]
    middle = np.where(
        later[:, None], np.median(level[later], axis=0), np.median(level[~later][-LATELY:], axis=0)
    )
    own = np.maximum(noise, (level - middle).T ** 2 / CAUCHY**2)  # (p, n)
    for _ in range(ROUNDS):
        weight = np.linalg.inv(walked + own[:, :, None] * np.eye(len(level)))
        covariance = np.linalg.inv(design.T @ weight @ design + prior)
        estimate = (covariance @ (design.T @ (weight @ level.T[:, :, None])))[:, :, 0]
        if np.all(np.abs(estimate[:, 1]) < CLOSER * np.sqrt(covariance[:, 1, 1])):
            break
        left = (level.T - estimate @ design.T)[:, :, None]
        own = np.maximum(noise, (own * (weight @ left)[:, :, 0]) ** 2 / CAUCHY**2)  # without the walk
    size = estimate[:, 1]
    far = (level.T - middle[0][:, None]) * np.sign(size)[:, None] > BEYOND * np.abs(size)[:, None]
    lasts = np.count_nonzero(far[:, later], axis=1) >= AFTER[0]
    lasts &= np.count_nonzero(~far[:, ~later][:, -LATELY:], axis=1) >= AFTER[0]
    return size, np.sqrt(covariance[:, 1, 1]), lasts
