"""Step detection in the pose series, to distinguish a moved scanner from a drifting one.

A pose drifts as a random walk, differs between odd and even scans, and is sometimes an outlier. A step is
lasting: the poses after it lie beyond it, and the usual drift of the series does not explain it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from station.quantities import Bools, Floats, VarianceComponents
from station.science.geometry.robust_statistics import NORMAL_MAD

SCANS_BEFORE = 12  # window for the pose before a step
RECENT_SCANS = 7  # of these, for a robust median
SCANS_AFTER = (5, 7)  # scans after a step when it is first and last tested
DRIFT_HISTORY_SCANS = 100  # scans from which the drift is estimated
LAGS = (2, 4, 6, 8)  # scans; even, so that odd-even differences cancel
MIN_SCANS = 20  # of a series before step detection starts
PRIOR_DRIFT_SCANS = 4  # weight of the prior variance components, in scans
SCAN_TO_SCAN_SHARE = 1 / 3  # of the variance components, which include drift over days
MIN_SIGNIFICANCE = 6.5  # sigmas of a step
SHARPNESS_SCANS = 3  # on either side of a step, to place it: neighbouring scans are as significant
MIN_DIFFERENCE_SIGMAS = 1.5  # of one scan's noise; smaller median differences are skipped
FAR_SIDE_SHARE = 0.5  # of the step size; a scan further than this counts as after the step
MAX_ITERATIONS = 5
REFINE_SIGMAS = MIN_SIGNIFICANCE / 2  # in the first iteration; the others change it by a tenth
CAUCHY_SCALE = 2.385  # 95 % efficient for normal errors


@dataclass(frozen=True)
class Step:
    """A sudden, lasting change of the pose between two scans of a series.

    `last_before` is the index of the scan before it, `detected_at` that of the scan at which it was detected.
    `size` and `sigma` (p,) are in the units of the pose; `significance` is that of its clearest component, in
    sigmas.
    """

    last_before: int
    detected_at: int
    size: Floats
    sigma: Floats
    significance: float


def pose_sigma(components: VarianceComponents) -> Floats:
    """Prior sigma of the pose change between two scans (6,): three rotations [rad], three shifts [m]."""
    return SCAN_TO_SCAN_SHARE * np.array(
        [components.tilt_rad] * 2 + [components.heading_rad] + [components.translation_m] * 3
    )


def detect_steps(time_s: Floats, pose: Floats, prior_sigma: Floats) -> list[Step]:
    """Return the steps in a series of poses (n, p) at times (n,), each as soon as enough scans followed it.

    `prior_sigma` (p,) is that of the change from scan to scan. A detected step is removed from the series
    before the search continues, so that it is reported once.
    """
    if len(pose) < MIN_SCANS:
        return []
    series = pose.astype(np.float64).copy()
    detected: list[Step] = []
    walk = _estimate_random_walk(time_s, series, prior_sigma)
    differences = _median_differences(series)
    for newest in range(MIN_SCANS - 1, len(series)):
        since = detected[-1].last_before + 1 if detected else 0
        step = _detect_step_at(
            time_s[: newest + 1], series[: newest + 1], since, walk, differences[:, newest]
        )
        if step is not None:
            detected.append(step)
            series[step.last_before + 1 :] -= step.size
            walk, differences = (
                _estimate_random_walk(time_s, series, prior_sigma),
                _median_differences(series),
            )
    return detected


def _detect_step_at(
    time_s: Floats, series: Floats, since: int, walks: _RandomWalk, differences: Floats
) -> Step | None:
    """Return the sharpest significant step for which the newest scan completes the evidence; None if none.

    `walks` are the drift models estimated at each scan, `differences` (a, p) the median differences at the
    newest scan.
    """
    newest = len(series) - 1
    candidates: list[Step] = []
    for after, difference in zip(range(SCANS_AFTER[0], SCANS_AFTER[1] + 1), differences, strict=True):
        last = newest - after
        walk = walks.at(last)
        if last < since or np.all(difference**2 < MIN_DIFFERENCE_SIGMAS**2 * walk.noise):
            continue
        first = max(last - SCANS_BEFORE + 1, 0)
        later = np.arange(first, newest + 1) > last
        size, sigma, lasts = _fit_step(time_s[first:], series[first:], later, walk)
        significance = float(np.max(np.where(lasts, np.abs(size) / sigma, 0.0)))
        if significance > MIN_SIGNIFICANCE:
            candidates.append(Step(last, newest, size, sigma, significance))
    if not candidates:
        return None
    noise = walks.at(candidates[-1].last_before).noise  # common to all candidates: of the scans before them
    return max(candidates, key=lambda step: _step_sharpness(series, step.last_before, noise))


def _median_differences(series: Floats) -> Floats:
    """Median of the newest 5, 6 and 7 poses minus the median of the 7 before them, at each scan (a, n, p)."""
    recent_median = _rolling_median(series, RECENT_SCANS)
    return np.stack(
        [
            _rolling_median(series, after)
            - np.concatenate([recent_median[:1].repeat(after, axis=0), recent_median[:-after]])
            for after in range(SCANS_AFTER[0], SCANS_AFTER[1] + 1)
        ]
    )


def _step_sharpness(series: Floats, last_before: int, noise: Floats) -> float:
    """Sharpness of a step after a scan, in variances of the noise; medians make it robust to an outlier."""
    earlier, later = series[: last_before + 1][-SHARPNESS_SCANS:], series[last_before + 1 :][:SHARPNESS_SCANS]
    return float(((np.median(later, axis=0) - np.median(earlier, axis=0)) ** 2 / noise).sum())


@dataclass(frozen=True)
class _RandomWalk:
    """Random walk of a pose (p,): variance per second, noise variance, variance of the odd-even difference.

    Or (n, p), as estimated at each scan.
    """

    walk: Floats
    noise: Floats
    odd_even: Floats

    def at(self, scan: int) -> _RandomWalk:
        """Return the model estimated at one scan."""
        return _RandomWalk(self.walk[scan], self.noise[scan], self.odd_even[scan])


def _estimate_random_walk(time_s: Floats, series: Floats, prior_sigma: Floats) -> _RandomWalk:
    """Estimate the random walk and noise of a pose from median differences over several lags, robustly.

    At each scan from the scans up to it; meaningful from the longest lag on.
    """
    series_and_time = np.column_stack([series, time_s])
    lagged = np.stack([_lagged_median(series_and_time, lag) for lag in LAGS], axis=1)  # (n, lags, p + 1)
    lag_s, lag_variance = lagged[..., -1], (NORMAL_MAD * lagged[..., :-1]) ** 2
    design = np.stack([lag_s / lag_s[:, :1], np.full(lag_s.shape, 2.0)], axis=-1)
    transposed = design.swapaxes(1, 2)
    walk, noise = np.linalg.solve(transposed @ design, transposed @ lag_variance).swapaxes(0, 1)
    prior_weight = (
        PRIOR_DRIFT_SCANS
        / (np.minimum(np.arange(len(series)) + 1, DRIFT_HISTORY_SCANS) + PRIOR_DRIFT_SCANS)[:, None]
    )
    walk = (
        np.clip(walk, 0.02 * lag_variance[:, 0], lag_variance[:, 0]) * (1 - prior_weight)
        + prior_sigma**2 * prior_weight
    )
    noise = np.maximum(noise, 0.1 * lag_variance[:, 0]) * (1 - prior_weight) + prior_sigma**2 * prior_weight
    return _RandomWalk(walk / lag_s[:, :1], noise, _lagged_median(series, 1) ** 2 + noise)


def _lagged_median(values: Floats, lag: int) -> Floats:
    """Median absolute difference over a lag in the last `DRIFT_HISTORY_SCANS` scans, at each scan (n, q)."""
    difference = np.abs(values[lag:] - values[:-lag])
    return np.concatenate(
        [difference[:1].repeat(lag, axis=0), _rolling_median(difference, DRIFT_HISTORY_SCANS - lag)]
    )


def _rolling_median(values: Floats, window: int) -> Floats:
    """Median of each row (n, q) and the rows before it, at most `window` rows in all.

    Sorts all windows at once: numpy's median takes several times as long for so few values each.
    """
    padded = np.concatenate([np.full((window - 1, values.shape[1]), np.nan), values])  # sorted to the end
    ordered = np.sort(sliding_window_view(padded, window, axis=0), axis=-1)
    count = np.minimum(np.arange(len(values)) + 1, window)[:, None, None]
    middle = [np.take_along_axis(ordered, index, axis=-1)[..., 0] for index in ((count - 1) // 2, count // 2)]
    return np.asarray((middle[0] + middle[1]) / 2)


def _fit_step(
    time_s: Floats, series: Floats, later: Bools, random_walk: _RandomWalk
) -> tuple[Floats, Floats, Bools]:
    """Fit level, step and odd-even difference to a window (n, p); return step, sigma and persistence (p,).

    The error model is a random walk plus noise; outliers are down-weighted.
    """
    scan_index = np.rint((time_s - time_s[0]) / np.median(np.diff(time_s)))
    design = np.stack([np.ones(len(series)), later, np.where(scan_index % 2, 0.5, -0.5)], axis=-1)
    elapsed_s = np.abs(time_s - time_s[~later][-1])
    separation_s = np.abs(np.subtract.outer(time_s, time_s))
    walk_covariance = (
        random_walk.walk[:, None, None] * (np.add.outer(elapsed_s, elapsed_s) - separation_s) / 2
    )
    prior = np.zeros((series.shape[1], 3, 3))
    prior[:, 2, 2] = 1 / random_walk.odd_even
    noise = random_walk.noise[:, None]
    middle = np.where(
        later[:, None], np.median(series[later], axis=0), np.median(series[~later][-RECENT_SCANS:], axis=0)
    )
    noise_variance = np.maximum(noise, (series - middle).T ** 2 / CAUCHY_SCALE**2)  # (p, n)
    for _ in range(MAX_ITERATIONS):
        weight = np.linalg.inv(walk_covariance + noise_variance[:, :, None] * np.eye(len(series)))
        covariance = np.linalg.inv(design.T @ weight @ design + prior)
        estimate = (covariance @ (design.T @ (weight @ series.T[:, :, None])))[:, :, 0]
        if np.all(np.abs(estimate[:, 1]) < REFINE_SIGMAS * np.sqrt(covariance[:, 1, 1])):
            break
        residual = (series.T - estimate @ design.T)[:, :, None]
        noise_variance = np.maximum(
            noise, (noise_variance * (weight @ residual)[:, :, 0]) ** 2 / CAUCHY_SCALE**2
        )  # without the walk
    size = estimate[:, 1]
    far = (series.T - middle[0][:, None]) * np.sign(size)[:, None] > FAR_SIDE_SHARE * np.abs(size)[:, None]
    lasts = np.count_nonzero(far[:, later], axis=1) >= SCANS_AFTER[0]
    lasts &= np.count_nonzero(~far[:, ~later][:, -RECENT_SCANS:], axis=1) >= SCANS_AFTER[0]
    return size, np.sqrt(covariance[:, 1, 1]), lasts
