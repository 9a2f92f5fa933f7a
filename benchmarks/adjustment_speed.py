"""CPU time that the adjustment adds to a scan on a large grid, on one core.

python -m benchmarks.adjustment_speed
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # set before numpy is imported: one core

import time
from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace

import numpy as np
from scipy import ndimage

from station.processing.pipeline import (
    AdjustmentInputs,
    adjust_to_reference,
    measure,
    new_gridder,
    reference_viewing_geometry,
)
from station.quantities import Air, Bools, Floats, Grid, Reference, ScanGeometry
from station.science.adjustment import prior
from station.science.adjustment.normal_equations import LineInclination
from station.science.gridding.gridder import Gridder
from station.science.uncertainty import parameters
from station.sections.inputs import ScannerSection

GRID = Grid(west_m=0.0, north_m=5000.0, cell_m=1.0, nx=4000, ny=5000)
RIDGE_M = (2000.0, -50.0, 700.0)  # outside the grid: the head covers half a turn, as at Hintereisferner
INSIDE_M = (3900.0, 300.0, 700.0)  # on the grid: a whole turn
SCANNER = ScannerSection.model_validate({"model": "riegl-vz-6000"}).instrument
VALID = 0.31  # share of the cells of the grid that a scan observes: Voordendag et al. (2023)
STABLE = 0.3  # share of the cells
POINTS_PER_CELL = 2
NOISE_M = 0.03
ROUNDS = 3
LIMIT_S, GOAL_S = 3.0, 2.0


def main() -> None:
    """Measure and print, on a ridge beside the grid and within it."""
    for name, position_m in (("from a ridge", RIDGE_M), ("all round", INSIDE_M)):
        print(f"adjustment, 20 million cells, {name} (limit {LIMIT_S:g} s, goal {GOAL_S:g} s):")
        for what, value in adjustment_seconds(position_m).items():
            print(f"  {what:<20} {value:.3f}")


def adjustment_seconds(
    position_m: tuple[float, float, float], seed: int = 1, grid: Grid = GRID
) -> dict[str, float]:
    """Return CPU seconds of the estimate, and of measuring with and without it; the best of three."""
    random = np.random.default_rng(seed)
    observed, stable = _patches(random, grid, VALID), _patches(random, grid, STABLE)
    reference = _reference(grid, observed)
    geometry = ScanGeometry(SCANNER, grid, position_m)
    viewing = reference_viewing_geometry(reference, geometry, stable)
    gridder = _filled(random, new_gridder(geometry, viewing), observed)
    inputs = _inputs(random, grid, position_m)
    adjustment = adjust_to_reference(gridder, geometry, inputs, viewing)
    estimate_s = _best(lambda copy: adjust_to_reference(copy, geometry, inputs, viewing), gridder)
    posterior = adjustment.state.shared
    without_s = _best(lambda copy: measure(copy, geometry, posterior, viewing), gridder)
    with_s = _best(lambda copy: measure(copy, geometry, posterior, viewing, adjustment), gridder)
    total_s = estimate_s + max(with_s - without_s, 0.0)
    return {
        "valid_share": float(observed.mean()),
        "estimate_s": estimate_s,
        "measure_s": without_s,
        "measure_adjusted_s": with_s,
        "adjustment_s": total_s,
        "ratio_to_measure": total_s / without_s,
    }


def _best(work: Callable[[Gridder], object], gridder: Gridder) -> float:
    seconds = []
    for _ in range(ROUNDS):
        copy = deepcopy(gridder)  # a measurement overwrites it
        start_s = time.process_time()
        work(copy)
        seconds.append(time.process_time() - start_s)
    return min(seconds)


def _patches(random: np.random.Generator, grid: Grid, share: float) -> Bools:
    """Return a share of the cells (ny, nx), in patches of about 100 m."""
    coarse = ndimage.gaussian_filter(random.normal(size=(grid.ny // 50 + 1, grid.nx // 50 + 1)), 1.5)
    fine = np.repeat(np.repeat(coarse, 50, axis=0), 50, axis=1)[: grid.ny, : grid.nx]
    return np.asarray(fine > np.quantile(coarse, 1 - share))


def _reference(grid: Grid, observed: Bools) -> Reference:
    """Return the reference of a bowl with waves."""
    x_m, y_m = (axis / 1000 for axis in np.meshgrid(grid.x_m, grid.y_m))
    height_m = 120 * ((x_m - 2.5) ** 2 + (y_m - 2) ** 2) / 2 + 30 * np.sin(9 * x_m) * np.cos(7 * y_m)
    reference = Reference.from_elevation(grid, "1", np.where(observed, height_m, np.nan), observed)
    return replace(
        reference,
        random_variance_m2=np.where(observed, 0.01**2, np.nan).astype(np.float32),
        roughness_m2=np.where(observed, 0.02**2, np.nan).astype(np.float32),
        intensity=np.where(observed, 0.5, np.nan).astype(np.float32),
    )


def _filled(random: np.random.Generator, gridder: Gridder, observed: Bools) -> Gridder:
    """Return the gridder with points in the centres of the observed cells."""
    row, column = np.nonzero(observed)
    for _ in range(POINTS_PER_CELL):
        residual_m = random.normal(0, NOISE_M, len(row))
        index = gridder.cell_indices(column.astype(np.float64), row.astype(np.float64))
        gridder.add(index, residual_m, np.full(len(index), 0.5))
    return gridder


def _inputs(
    random: np.random.Generator, grid: Grid, position_m: tuple[float, float, float]
) -> AdjustmentInputs:
    """Return the inputs from a log with noise and the usual systematic errors."""
    params = parameters.parameter_layout(grid, position_m)
    lines = prior.line_times(params, np.eye(3), None)
    tilt_rad: Floats = np.radians(random.normal(0, 0.004, params.line_groups))
    azimuth_rad = params.line_azimuth_rad
    modes_rad = np.radians(0.0015) * np.stack([np.cos(azimuth_rad), np.sin(azimuth_rad)], axis=-1)
    log = LineInclination(tilt_rad, np.full(params.line_groups, np.radians(0.008) ** -2), modes_rad)
    return AdjustmentInputs(params, lines, np.zeros((3, params.line_groups)), log, 0.0, Air(2.0, 700.0, 50.0))


if __name__ == "__main__":
    main()
