"""Level and rate of cells from a simulated series: this program, a plain Kalman filter, and py4dgeo.

python -m benchmarks.levels [--cells N] [--days N]

Each method gets the same changes of quiet ground, melting ice and an avalanche, and runs in a process of its
own. py4dgeo 1.2 has no Kalman filter; its smoothing is a running median of 24 scans, half of them later.
Errors are root mean squares from the third day on, but for the last day, which it has no later scans for. The
true rate is that of the last day, without the avalanche, and compared at the end of each day. The avalanche
falls on every tenth cell, of which the errors are.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import resource
import time
from collections.abc import Callable
from importlib.util import find_spec
from tempfile import TemporaryDirectory

import numpy as np

from station.quantities import Floats
from station.science.time_series.cell_filter import CellFilter
from station.science.time_series.class_filter import SAMPLE_CELLS, ClassFilter
from station.science.time_series.filter_errors import day_rates

HOUR_D = 1 / 24
RANDOM_M, SYSTEMATIC_M = 0.03, 0.003
PLAIN_LEVEL_NOISE_M2_D, PLAIN_RATE_NOISE_M2_D3 = 1e-5, 1e-4  # fixed, for all cells
PLAIN_CELLS = 100  # of which the cost is extrapolated
AVALANCHE_EVERY = 10  # cells
Estimates = tuple[Floats, Floats]  # level [m] and rate [m/d], (t, n)


def season(kind: str, cells: int, days: int) -> tuple[Floats, Floats]:
    """Return true levels and measured changes (t, n) of hourly scans [m]."""
    rng = np.random.default_rng(1)
    day = HOUR_D * np.arange(24 * days)
    factor = rng.uniform(0.7, 1.3, cells)
    sun = np.maximum(0, 2.4 * np.sin(2 * np.pi * (day - 0.3)))
    course_m = {
        "quiet": np.zeros(len(day)),
        "melt": np.cumsum(-0.06 * sun) * HOUR_D,
        "avalanche": 0.3 * (day > days / 2),
    }[kind]
    level_m = course_m[:, None] * factor
    if kind == "avalanche":
        level_m[:, np.arange(cells) % AVALANCHE_EVERY > 0] = 0.0
    shared_m = SYSTEMATIC_M * rng.standard_normal((len(day), 1))
    return level_m, level_m + RANDOM_M * rng.standard_normal(level_m.shape) + shared_m


def single_scans(change_m: Floats) -> Estimates:
    """Return the changes themselves, and their difference to those of a day before."""
    return change_m, change_m - np.roll(change_m, 24, axis=0)


def py4dgeo_median(change_m: Floats) -> Estimates:
    """Return py4dgeo's running median, and its difference to that of a day before."""
    from py4dgeo.segmentation import temporal_averaging  # noqa: PLC0415 - not installed everywhere

    level_m = temporal_averaging(change_m.T, 24).T
    return level_m, level_m - np.roll(level_m, 24, axis=0)


def plain_kalman(change_m: Floats) -> Estimates:
    """Return the estimates of a textbook filter with matrices, cell after cell, without steps."""
    step = np.array([[1.0, HOUR_D], [0.0, 1.0]])
    level, rate = PLAIN_LEVEL_NOISE_M2_D, PLAIN_RATE_NOISE_M2_D3
    noise = np.array([[level * HOUR_D + rate * HOUR_D**3 / 3, rate * HOUR_D**2 / 2], [0, rate * HOUR_D]])
    noise[1, 0] = noise[0, 1]
    estimates = np.empty((2, *change_m.shape))
    for cell, series_m in enumerate(change_m.T):
        state, covariance = np.array([series_m[0], 0.0]), np.diag([RANDOM_M**2, 0.01])
        estimates[:, 0, cell] = state
        for index, observed_m in enumerate(series_m[1:], 1):
            state, covariance = step @ state, step @ covariance @ step.T + noise
            gain = covariance[:, 0] / (covariance[0, 0] + RANDOM_M**2)
            state, covariance = (
                state + gain * (observed_m - state[0]),
                covariance - np.outer(gain, covariance[0]),
            )
            estimates[:, index, cell] = state
    return estimates[0], estimates[1]


def station_filter(change_m: Floats) -> Estimates:
    """Return the estimates of this program, with learned noise and steps."""
    count = change_m.shape[1]
    sample = np.linspace(0, count - 1, min(SAMPLE_CELLS, count)).astype(np.int64)
    cells, ground = CellFilter.empty(count), ClassFilter(len(sample))
    random_m2, systematic_m2 = np.full(count, RANDOM_M**2), np.full(count, SYSTEMATIC_M**2)
    estimates = np.empty((2, *change_m.shape))
    for index, scan_m in enumerate(change_m):
        days = HOUR_D if index else 0.0
        noise, motion = ground.advance(days, scan_m[sample], random_m2[sample], systematic_m2[sample])
        cells.advance(days, noise, motion, scan_m, random_m2, systematic_m2)
        state = cells.estimates()
        estimates[:, index] = state.level_m, day_rates(state, cells.moved_m, ground)
        if index % 24 == 0:
            cells.begin_day()
            ground.begin_day()
    return estimates[0], estimates[1]


METHODS: dict[str, Callable[[Floats], Estimates]] = {
    "single scans": single_scans,
    "py4dgeo median": py4dgeo_median,
    "plain Kalman": plain_kalman,
    "station": station_filter,
}


def measure(task: tuple[str, str, int, int]) -> dict[str, float]:
    """Return errors and cost of a method in a season; cells and days are the last two of the task."""
    method, kind, cells, days = task
    level_m, change_m = season(kind, PLAIN_CELLS if method == "plain Kalman" else cells, days)
    before_gb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    start_s = time.process_time()
    estimated_m, rate_m_d = METHODS[method](change_m)
    cpu_s = time.process_time() - start_s
    true_rate_m_d = 0.0 if kind == "avalanche" else level_m - np.roll(level_m, 24, axis=0)
    hit = slice(None, None, AVALANCHE_EVERY if kind == "avalanche" else 1)
    level_error_m = (estimated_m - level_m)[48:-24, hit]
    rate_error_m_d = (rate_m_d - true_rate_m_d)[48:-24:24, hit]
    return {
        "level [mm]": 1000 * float(np.sqrt(np.mean(level_error_m**2))),
        "rate [mm/d]": 1000 * float(np.sqrt(np.mean(rate_error_m_d**2))),
        "CPU [µs per cell and scan]": 1e6 * cpu_s / change_m.size,
        "memory [GB]": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6 - before_gb,
    }


def main() -> None:
    """Print a table for each season."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--cells", type=int, default=5000)
    parser.add_argument("--days", type=int, default=14)
    arguments = parser.parse_args()
    methods = [name for name in METHODS if name != "py4dgeo median" or find_spec("py4dgeo")]
    spawning = multiprocessing.get_context("spawn")
    with TemporaryDirectory() as folder, spawning.Pool(1, os.chdir, (folder,), 1) as pool:  # py4dgeo's log
        for kind in ("quiet", "melt", "avalanche"):
            tasks = [(method, kind, arguments.cells, arguments.days) for method in methods]
            for method, measured in zip(methods, pool.map(measure, tasks, chunksize=1), strict=True):
                print(f"{kind:10} {method:15}", "  ".join(f"{k} {v:.3g}" for k, v in measured.items()))


if __name__ == "__main__":
    main()
