"""Standardised errors of levels and rates in simulated seasons, by kind of ground, from a cell to an area.

python -m benchmarks.level_seasons [--kinds NAME …] [--seeds N] [--first SEED] [--lasting SHARE]
                                   [--markdown PAGE]

The surface of a season knows nothing of the filter: ice melts by an energy balance with clouds, snow falls in
patches, settles and drifts, rock creeps, an avalanche comes to rest. Of the variance of the errors that a
scan's cells share, a share lasts for 6 h, the rest differs from scan to scan. Nothing begins to fall in the
last three hours of a day: the first scan of a heavy snowfall is not known from an error of that scan.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import ndimage

from benchmarks.markdown_tables import write_tables
from station.quantities import Floats
from station.science.time_series.cell_filter import CellFilter
from station.science.time_series.class_filter import SAMPLE_CELLS, ClassFilter
from station.science.time_series.filter_errors import FilterErrors, day_rates, filter_errors

SIDE = 60  # cells of 10 m
SHAPE = SIDE, SIDE
ROW, COLUMN = np.indices(SHAPE)
DAYS, FIRST_DAY = 10, 3
HOURS = 24 * DAYS + 1
BOX = 10  # cells along the edge of 100 m
LASTING_H = 6.0
PARAMETER_M = 0.004  # one sigma of each of four parameters, at 1 km
KINDS = {
    "stable": "stable ground",
    "quiet": "ground that could move",
    "creep": "creep",
    "melt": "melt",
    "snow": "snowfall",
    "drift": "snowfall and drift",
    "avalanche": "creep and an avalanche",
    "mixed": "all of it, on ice and rock",
}
HEADS = "ground", "z of level: cell / box / area", "z of rate: cell / box / area", "level [mm]", "rate [mm/d]"


@dataclass(frozen=True)
class Season:
    """True levels and steps, and observations (t, n) [m]; σ of their random and shared errors (n,) [m]."""

    steady_m: Floats
    step_m: Floats
    change_m: Floats
    random_m: Floats
    systematic_m: Floats


@dataclass(frozen=True)
class Errors:
    """Errors of levels [m] and rates [m/d] of cells (n,) at the end of a day, and their variances."""

    level_m: Floats
    rate_m_d: Floats
    expected: FilterErrors

    def z(self) -> list[Floats]:
        """Return standardised errors: of levels and rates, each of cells, boxes and the area."""
        its = self.expected
        return [
            *_z_by_scale(self.level_m, its.level_random_m2, its.level_systematic_m2),
            *_z_by_scale(self.rate_m_d, its.rate_random_m2_d2, its.rate_systematic_m2_d2),
        ]


def _lasting(rng: np.random.Generator, hours: float, *shape: int) -> Floats:
    """Return random numbers (HOURS, …) of unit variance that decay over some hours."""
    kept = np.exp(-1 / hours)
    values = rng.standard_normal((HOURS, *shape))
    for hour in range(1, HOURS):
        values[hour] = kept * values[hour - 1] + np.sqrt(1 - kept**2) * values[hour]
    return values


def _pattern(rng: np.random.Generator, cells: float) -> Floats:
    values = ndimage.gaussian_filter(rng.standard_normal(SHAPE), cells, mode="wrap")
    return np.asarray(values / values.std())


def _melt_m(rng: np.random.Generator) -> Floats:
    sun = np.maximum(0, np.sin(2 * np.pi * (np.arange(HOURS) / 24 - 0.27)) + 0.25)
    sun *= np.clip(0.65 + 0.35 * _lasting(rng, 10), 0.15, 1.0)
    warmth = np.clip(0.4 + 0.5 * _lasting(rng, 60), 0, 1.5)
    albedo = np.clip(0.35 + 0.1 * _pattern(rng, 5) + 0.05 * rng.standard_normal(SHAPE), 0.1, 0.8)
    lapse = 1.15 - 0.5 * ROW / SIDE
    hourly_m = 0.0075 * sun[:, None, None] * (1 - albedo) + 0.0012 * warmth[:, None, None] * lapse
    return -np.cumsum(hourly_m, axis=0)


def _snow_m(rng: np.random.Generator, *, drifts: bool) -> Floats:
    share = np.clip(1 + 0.25 * _pattern(rng, 8) + 0.08 * rng.standard_normal(SHAPE), 0.2, 2)
    fall_m = np.zeros(HOURS)
    for _ in range(2):
        begin, hours = 24 * rng.integers(2, DAYS - 1) + rng.integers(1, 21), rng.integers(5, 15)
        fall_m[begin : begin + hours] += rng.uniform(0.006, 0.03) * rng.uniform(0.4, 1.6, hours)
    windy = _lasting(rng, 8) > 1.2
    depth_m = np.zeros((HOURS, *SHAPE))
    for hour in range(1, HOURS):
        depth_m[hour] = depth_m[hour - 1] * (1 - 0.35 / 24) + fall_m[hour] * share
        if drifts and windy[hour]:
            depth_m[hour] += 0.005 * _pattern(rng, 2) * (depth_m[hour] > 0.03)
    return depth_m


def _creep_m(rng: np.random.Generator) -> Floats:
    field_m_d = 0.012 * np.clip(1 + 0.6 * _pattern(rng, 8), 0, 3)
    return -np.cumsum((1 + 0.3 * _lasting(rng, 100))[:, None, None] * field_m_d, axis=0) / 24


def _avalanche_m(rng: np.random.Generator) -> Floats:
    hour, (row, column) = 24 * rng.integers(3, DAYS - 1) + rng.integers(3, 19), rng.integers(15, 45, 2)
    fallen = np.hypot(ROW - row, (COLUMN - column) / 2) < 7
    depth_m = rng.uniform(0.5, 2.0) * (0.7 + 0.3 * rng.random(SHAPE)) * fallen
    return (np.arange(HOURS)[:, None, None] >= hour) * depth_m


def season(kind: str, seed: int, lasting_share: float) -> Season:
    """Return a season of hourly scans of one kind of ground."""
    rng = np.random.default_rng([seed, list(KINDS).index(kind)])
    steady_m = step_m = np.zeros((HOURS, *SHAPE))
    if kind in ("melt", "mixed"):
        steady_m = steady_m + _melt_m(rng) * (ROW < 0.55 * SIDE if kind == "mixed" else 1)
    if kind in ("creep", "avalanche", "mixed"):
        rock = (ROW >= 0.55 * SIDE) & (COLUMN > 0.65 * SIDE)
        steady_m = steady_m + _creep_m(rng) * (rock if kind == "mixed" else 1)
    if kind in ("snow", "drift", "mixed"):
        steady_m = steady_m + _snow_m(rng, drifts=kind != "snow")
    if kind in ("avalanche", "mixed"):
        step_m = _avalanche_m(rng)
    range_km, azimuth = 0.9 + 0.02 * COLUMN, np.arctan2(ROW - SIDE / 2, COLUMN + 90)
    jacobian = np.stack(
        [range_km * np.cos(azimuth), range_km * np.sin(azimuth), 0.4 + 0 * range_km, range_km**2 / 2]
    )
    parameters = np.sqrt(lasting_share) * _lasting(rng, LASTING_H, 4)
    parameters += np.sqrt(1 - lasting_share) * rng.standard_normal((HOURS, 4))
    random_m = 0.02 * np.hypot(1, range_km) * rng.uniform(0.7, 1.4, SHAPE)
    change_m = steady_m + step_m + PARAMETER_M * np.einsum("tk,kyx->tyx", parameters, jacobian)
    change_m += random_m * rng.standard_normal(change_m.shape)
    change_m[rng.random(change_m.shape) < 0.15] = np.nan
    for begin in rng.integers(0, HOURS, 3).tolist():  # fog
        change_m[begin : begin + 7, :, 35:] = np.nan
    pause = rng.integers(30, HOURS - 8)
    change_m[pause : pause + 5] = np.nan
    series = (part.reshape(HOURS, -1) for part in (steady_m, step_m, change_m))
    systematic_m = PARAMETER_M * np.sqrt((jacobian**2).sum(axis=0))
    return Season(*series, random_m.ravel(), systematic_m.ravel())


def errors_of(truth: Season, *, stable: bool) -> Iterator[Errors]:
    """Yield the errors of the filter at the end of each day from the third on."""
    count = truth.change_m.shape[1]
    sample = np.linspace(0, count - 1, SAMPLE_CELLS).astype(np.int64)
    cells, ground = CellFilter.empty(count), ClassFilter(SAMPLE_CELLS, stable=stable)
    random_m2, systematic_m2 = truth.random_m**2, truth.systematic_m**2
    for hour, scan_m in enumerate(truth.change_m):
        days = 1 / 24 if hour else 0.0
        noise, motion = ground.advance(days, scan_m[sample], random_m2[sample], systematic_m2[sample])
        cells.advance(days, noise, motion, scan_m, random_m2, systematic_m2)
        if hour % 24:
            continue
        if hour >= 24 * FIRST_DAY:
            state, moved_m, steady_m = cells.estimates(), cells.moved_m, truth.steady_m
            yield Errors(
                state.level_m - steady_m[hour] - truth.step_m[hour],
                day_rates(state, moved_m, ground) - (steady_m[hour] - steady_m[hour - 24]),
                filter_errors(state, moved_m, cells.unseen_d, random_m2, systematic_m2, ground),
            )
        cells.begin_day()
        ground.begin_day()


def _z_by_scale(error: Floats, random_m2: Floats, systematic_m2: Floats) -> list[Floats]:
    """Return standardised errors of cells, of boxes of 100 m and of the area: systematic ones in common."""

    def of_means(groups: list[Floats]) -> Floats:
        errors, random, systematic = groups
        variance = random.mean(axis=1) / errors.shape[1] + np.sqrt(systematic).mean(axis=1) ** 2
        return np.asarray(errors.mean(axis=1) / np.sqrt(variance))

    parts = error, random_m2, systematic_m2
    split = SIDE // BOX, BOX, SIDE // BOX, BOX
    boxes = [part.reshape(split).swapaxes(1, 2).reshape(-1, BOX**2) for part in parts]
    return [error / np.sqrt(random_m2 + systematic_m2), of_means(boxes), of_means([p[None] for p in parts])]


def _rms(values: list[Floats]) -> float:
    return float(np.sqrt(np.mean(np.square(np.concatenate([np.ravel(part) for part in values])))))


def row(kind: str, seeds: range, lasting_share: float) -> tuple[str, ...]:
    """Return the cells of the row of a kind of ground."""
    found = [
        errors
        for seed in seeds
        for errors in errors_of(season(kind, seed, lasting_share), stable=kind == "stable")
    ]
    z = [f"{_rms(list(values)):.2f}" for values in zip(*(errors.z() for errors in found), strict=True)]
    level_mm, rate_mm_d = (
        1000 * _rms(values)
        for values in ([errors.level_m for errors in found], [errors.rate_m_d for errors in found])
    )
    return KINDS[kind], " / ".join(z[:3]), " / ".join(z[3:]), f"{level_mm:.1f}", f"{rate_mm_d:.1f}"


def main() -> None:
    """Print a row for each kind of ground, and write them to a page if one is given."""
    parser = argparse.ArgumentParser(description="Errors of levels and rates in simulated seasons.")
    parser.add_argument("--kinds", nargs="+", choices=list(KINDS), default=list(KINDS), metavar="NAME")
    parser.add_argument("--seeds", type=int, default=8, help="number of seasons of each kind")
    parser.add_argument("--first", type=int, default=1, help="the first seed")
    parser.add_argument("--lasting", type=float, default=1.0, help="share of the shared variance that lasts")
    parser.add_argument("--markdown", type=Path, help="page of the docs whose table is replaced")
    options = parser.parse_args()
    seeds, rows = range(options.first, options.first + options.seeds), []
    for kind in options.kinds:
        rows.append(row(kind, seeds, options.lasting))
        print(*rows[-1], sep="; ", flush=True)
    if options.markdown:
        share = f"{100 * options.lasting:.0f} % of the variance of shared errors lasts"
        title = f"{DAYS} d of hourly scans, seeds {seeds[0]} to {seeds[-1]}; {share}"
        write_tables(options.markdown, "level_seasons", title, [(HEADS, rows)])


if __name__ == "__main__":
    main()
