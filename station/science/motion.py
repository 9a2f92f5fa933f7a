"""Whether the scanner was moved: a step in the series of its poses, told from drift.

A pose drifts as a random walk, differs between odd and even scans, and is now and then wrong by itself. A
step is what stays: the scans after it lie beyond it, and no drift as quick as that of the series explains it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

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
    level = pose.astype(np.float64).copy()
    told: list[Step] = []
    drifts: dict[int, _Drift] = {}  # by the scan they are known up to: three newest scans ask for each
    for newest in range(FEWEST - 1, len(level)):
        since = told[-1].last_before + 1 if told else 0
        found = _step_at(time_s[: newest + 1], level[: newest + 1], habit, since, drifts)
        if found is not None:
            told.append(found)
            level[found.last_before + 1 :] -= found.size
            drifts.clear()
    return told


def _step_at(
    time_s: Floats, level: Floats, habit: Floats, since: int, drifts: dict[int, _Drift]
) -> Step | None:
    """Return the sharpest of the significant steps after which just scans enough have come, if any.

    `drifts` are those found before, by the last scan that each was learned from.
    """
    newest = len(level) - 1
    found: list[Step] = []
    for after in range(AFTER[0], AFTER[1] + 1):
        first = max(newest - after - BEFORE + 1, 0)
        if newest - after < since:
            continue
        known = slice(max(newest - after + 1 - HISTORY, 0), newest - after + 1)
        if newest - after not in drifts:
            drifts[newest - after] = _drift(time_s[known], level[known], habit)
        drift = drifts[newest - after]
        apart = _median(level[newest - after + 1 :]) - _median(level[known][-LATELY:])
        if np.all(apart**2 < QUIET**2 * drift.noise):
            continue
        window = slice(first, newest + 1)
        later = np.arange(first, newest + 1) > newest - after
        size, sigma, lasts = _fit(time_s[window], level[window], later, drift)
        sigmas = float(np.max(np.where(lasts, np.abs(size) / sigma, 0.0)))
        if sigmas > SIGMAS:
            found.append(Step(newest - after, newest, size, sigma, sigmas))
    if not found:
        return None
    noise = drifts[found[-1].last_before].noise  # one for all, of the scans before any of these places
    return max(found, key=lambda step: _contrast(level, step.last_before, noise))


def _contrast(level: Floats, last_before: int, noise: Floats) -> float:
    """How much the poses (n, p) right after a scan differ from those up to it; one outlier does not count."""
    before, after = level[: last_before + 1][-BESIDE:], level[last_before + 1 :][:BESIDE]
    return float(((_median(after) - _median(before)) ** 2 / noise).sum())


@dataclass(frozen=True)
class _Drift:
    """How a pose moves (p,): variance it gains by the second, of its noise, between odd and even scans."""

    walk: Floats
    noise: Floats
    odd_even: Floats


def _drift(time_s: Floats, level: Floats, habit: Floats) -> _Drift:
    """Learn how a pose moves from the median differences over several lags, which outliers leave alone."""
    lags = [lag for lag in LAGS if lag < len(level) / 2]
    both = np.column_stack([level, time_s])
    apart = np.stack([_median(np.abs(both[lag:] - both[:-lag])) for lag in lags])
    apart_s, found = apart[:, -1], (1.4826 * apart[:, :-1]) ** 2
    design = np.stack([apart_s / apart_s[0], np.full(len(lags), 2.0)], axis=-1)
    walk, noise = np.linalg.solve(design.T @ design, design.T @ found)
    scans = len(level)
    worth = HABITS_WORTH / (scans + HABITS_WORTH)
    walk = np.clip(walk, 0.02 * found[0], found[0]) * (1 - worth) + habit**2 * worth
    noise = np.maximum(noise, 0.1 * found[0]) * (1 - worth) + habit**2 * worth
    one_apart = _median(np.abs(np.diff(level, axis=0)))
    return _Drift(walk / apart_s[0], noise, one_apart**2 + noise)


def _median(values: Floats) -> Floats:
    """Median over the first axis: of so few values, numpy's own takes several times as long."""
    half, rest = divmod(len(values), 2)
    parted = np.partition(values, half if rest else (half - 1, half), axis=0)
    return np.asarray(parted[half] if rest else (parted[half - 1] + parted[half]) / 2)


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
        left = (level.T - estimate @ design.T)[:, :, None]
        own = np.maximum(noise, (own * (weight @ left)[:, :, 0]) ** 2 / CAUCHY**2)  # without the walk
    size = estimate[:, 1]
    far = (level.T - middle[0][:, None]) * np.sign(size)[:, None] > BEYOND * np.abs(size)[:, None]
    lasts = np.count_nonzero(far[:, later], axis=1) >= AFTER[0]
    lasts &= np.count_nonzero(~far[:, ~later][:, -LATELY:], axis=1) >= AFTER[0]
    return size, np.sqrt(covariance[:, 1, 1]), lasts
