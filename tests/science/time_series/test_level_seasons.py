"""Levels and rates of seasons of hourly scans with a truth: σ from cell to area, with errors that last.

Ice melts by day as warm as the air and the height of the ice let it, with clouds; snow falls in patches and
settles, the wind moves it; a slope creeps, an avalanche falls. Beams tilt and bend for hours, and fog hides a
part. The true rate of a day is the change since the end of the day before, without avalanches.
"""

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from station.science.time_series.cell_filter import CellFilter
from station.science.time_series.class_filter import SAMPLE_CELLS, ClassFilter
from station.science.time_series.filter_errors import day_rates, filter_errors

pytestmark = pytest.mark.integration

SHAPE = 40, 40  # cells of 10 m
ROW, COLUMN = np.indices(SHAPE)
DAYS, FIRST_DAY = 9, 4
HOURS = 24 * DAYS
LASTING_H = 6.0
BOX = 10  # cells along the edge of 100 m
RANDOM_M, PARAMETER_M = 0.03, 0.004


@dataclass(frozen=True)
class Season:
    """True level (t, n), the avalanche in it, and observations [m]; σ of what a scan's errors share (n,)."""

    level_m: np.ndarray
    avalanche_m: np.ndarray
    change_m: np.ndarray
    systematic_m: np.ndarray


def lasting(rng, hours, *shape):
    """Random numbers of unit variance that decay over some hours."""
    kept = np.exp(-1 / hours)
    values = rng.standard_normal((HOURS, *shape))
    for hour in range(1, HOURS):
        values[hour] = kept * values[hour - 1] + np.sqrt(1 - kept**2) * values[hour]
    return values


def pattern(rng, cells):
    values = gaussian_filter(rng.standard_normal(SHAPE), cells, mode="wrap")
    return values / values.std()


def melt_m(rng):
    cloud = np.clip(0.5 + 0.5 * lasting(rng, 12), 0, 1)
    sun = np.sin(2 * np.pi * (np.arange(HOURS) / 24 - 0.38))
    air_c = 7 + 2 * lasting(rng, 48) + 5 * sun * (1 - 0.6 * cloud)
    factor = 2.5e-4 * np.exp(0.25 * pattern(rng, 4) + 0.1 * rng.standard_normal(SHAPE))
    lower_c = 8 * (1 - ROW / SHAPE[0])
    return -np.cumsum(np.maximum(air_c[:, None, None] - lower_c, 0), axis=0) * factor


def snow_m(rng):
    depth_m, gust = np.zeros(HOURS), lasting(rng, 8) > 1.5
    begin = rng.integers(FIRST_DAY * 24, HOURS - 30)
    for hour in range(1, HOURS):
        fall_m = 0.015 * rng.uniform(0.3, 1.7) * (begin <= hour < begin + 12)
        depth_m[hour] = depth_m[hour - 1] * (1 - 0.25 / 24) + fall_m
    share = np.clip(1 + 0.3 * pattern(rng, 6) + 0.1 * rng.standard_normal(SHAPE), 0.1, 2)
    moved_m = [0.004 * pattern(rng, 2) * (windy and depth > 0.02)
               for windy, depth in zip(gust, depth_m, strict=True)]  # fmt: skip
    return depth_m[:, None, None] * share + np.cumsum(moved_m, axis=0)


def season(seed, kind):
    rng = np.random.default_rng(seed)
    level_m = avalanche_m = np.zeros((HOURS, *SHAPE))
    day = np.arange(HOURS)[:, None, None] / 24
    if kind in ("melt", "all"):
        level_m = level_m + melt_m(rng)
    if kind in ("snow", "all"):
        level_m = level_m + snow_m(rng)
    if kind in ("creep", "all"):
        level_m = level_m - rng.uniform(0.002, 0.02) * day * ((COLUMN >= 25) & (ROW < 20))
    if kind in ("avalanche", "all"):
        fallen = np.hypot(ROW - rng.integers(10, 30), COLUMN - rng.integers(10, 30)) < 5
        hour = 24 * rng.integers(3, DAYS - 1) + rng.integers(2, 20)
        avalanche_m = 0.6 * fallen * (day >= hour / 24)
        level_m = level_m + avalanche_m
    range_km, azimuth = 0.7 + 0.04 * COLUMN, np.arctan2(ROW - 20, COLUMN + 5)
    jacobian = np.stack(
        [range_km * np.cos(azimuth), range_km * np.sin(azimuth), 0.3 + 0 * range_km, range_km**2 / 2]
    )
    parameters = lasting(rng, LASTING_H, 4)
    error_m = PARAMETER_M * np.einsum("tk,kyx->tyx", parameters, jacobian)
    change_m = level_m + error_m + RANDOM_M * rng.standard_normal(level_m.shape)
    change_m[rng.random(level_m.shape) < 0.2] = np.nan
    for begin in rng.integers(0, HOURS, 3).tolist():  # fog
        change_m[begin : begin + 8, :, 20:] = np.nan
    systematic_m = PARAMETER_M * np.sqrt((jacobian**2).sum(axis=0)).ravel()
    return Season(*(part.reshape(HOURS, -1) for part in (level_m, avalanche_m, change_m)), systematic_m)


def filtered(truth, *, stable):
    """Yield level, rate and their errors at the end of each day from the fourth on, and its last hour."""
    count = truth.change_m.shape[1]
    sample = np.linspace(0, count - 1, SAMPLE_CELLS).astype(int)
    cells, ground = CellFilter.empty(count), ClassFilter(SAMPLE_CELLS, stable=stable)
    random_m2, systematic_m2 = np.full(count, RANDOM_M**2), truth.systematic_m**2
    for hour, scan_m in enumerate(truth.change_m):
        days = 1 / 24 if hour else 0.0
        noise, motion = ground.advance(days, scan_m[sample], random_m2[sample], systematic_m2[sample])
        cells.advance(days, noise, motion, scan_m, random_m2, systematic_m2)
        if hour % 24 == 23:
            state, moved_m = cells.estimates(), cells.moved_m
            errors = filter_errors(state, moved_m, cells.unseen_d, random_m2, systematic_m2, ground)
            if hour >= 24 * FIRST_DAY:
                yield state.level_m, day_rates(state, moved_m, ground), errors, hour
            cells.begin_day()
            ground.begin_day()


def squares_of_z(error, random_m2, systematic_m2):
    """Mean squares of z of cells, of boxes of 100 m, and of all cells."""

    def of_boxes(values):
        boxes = values.reshape(SHAPE[0] // BOX, BOX, SHAPE[1] // BOX, BOX).swapaxes(1, 2)
        return boxes.reshape(-1, BOX**2)

    def of_means(groups):
        error, random_m2, systematic_m2 = groups
        variance = random_m2.mean(axis=1) / error.shape[1] + np.sqrt(systematic_m2).mean(axis=1) ** 2
        return np.mean(error.mean(axis=1) ** 2 / variance)

    parts = error, random_m2, systematic_m2
    boxes, area = ([of(part) for part in parts] for of in (of_boxes, lambda part: part[None]))
    return np.mean(error**2 / (random_m2 + systematic_m2)), of_means(boxes), of_means(area)


def squares(kind, seeds):
    """Mean square of z of levels and of rates (2, 3): of cells, boxes of 100 m, and areas."""
    found = []
    for seed in range(seeds):
        truth = season(seed, kind)
        steady_m = truth.level_m - truth.avalanche_m
        for level_m, rate_m_d, errors, hour in filtered(truth, stable=kind == "stable"):
            level = squares_of_z(
                level_m - truth.level_m[hour], errors.level_random_m2, errors.level_systematic_m2
            )
            rate = squares_of_z(
                rate_m_d - (steady_m[hour] - steady_m[hour - 24]),
                errors.rate_random_m2_d2,
                errors.rate_systematic_m2_d2,
            )
            found.append((level, rate))
    return np.mean(found, axis=0)


def test_sigma_of_levels_and_rates_holds_from_cell_to_area_on_each_kind_of_ground():
    kinds = "stable", "quiet", "creep", "melt", "snow", "avalanche", "all"
    by_kind = np.array([squares(kind, 6) for kind in kinds])
    z = np.sqrt(by_kind.mean(axis=0))
    assert np.all((z > 0.8) & (z < 1.25)), z
    assert np.all((by_kind > 0.45**2) & (by_kind < 1.35**2)), by_kind**0.5  # of few independent errors each


def test_sigma_holds_in_patches_of_snow():
    z = np.sqrt(squares("snow", 16))
    assert np.all((z > 0.8) & (z < 1.2)), z


def test_rates_of_a_day_of_snowfall_are_better_than_a_single_difference():
    ratios = []
    for seed in range(3):
        truth = season(seed, "snow")
        for _, rate_m_d, _, hour in filtered(truth, stable=False):
            true_m_d = truth.level_m[hour] - truth.level_m[hour - 24]
            if true_m_d.mean() > 0.05:
                ratios.append(np.sqrt(np.mean((rate_m_d - true_m_d) ** 2)) / (np.sqrt(2) * RANDOM_M))
    assert len(ratios) >= 3
    assert max(ratios) < 0.75
