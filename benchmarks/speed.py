"""Seconds of CPU that the adjustment adds to a scan on a large grid, on one core."""

from __future__ import annotations

import time
from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace

import numpy as np
from scipy import ndimage

from station.pipeline import Told, gridder_for, level, measure, outlook_on
from station.quantities import Bools, Floats, Grid, Reference, Setup
from station.science import prior, shared
from station.science.grid import Gridder
from station.science.normals import LineLog
from station.sections import ScannerSection

GRID = Grid(west_m=0.0, north_m=5000.0, cell_m=1.0, nx=4000, ny=5000)
RIDGE_M = (2000.0, -50.0, 700.0)  # beside the grid: the head looks over half a turn, as at Hintereisferner
AMIDST_M = (3900.0, 300.0, 700.0)  # on the grid: a whole turn
SCANNER = ScannerSection.model_validate({"model": "riegl-vz-6000"}).instrument
VALID = 0.31  # share of the grid's cells that a scan sees: Voordendag et al. (2023)
STABLE = 0.3  # of these
POINTS_A_CELL = 2
NOISE_M = 0.03
ROUNDS = 3


def adjustment_seconds(
    position_m: tuple[float, float, float], seed: int = 1, grid: Grid = GRID
) -> dict[str, float]:
    """Return CPU seconds of estimating, of applying, and of measuring without either; the best of three."""
    random = np.random.default_rng(seed)
    seen, stable = _patchy(random, grid, VALID), _patchy(random, grid, STABLE)
    reference = _reference(grid, seen)
    setup = Setup(SCANNER, grid, position_m)
    outlook = outlook_on(reference, setup, stable)
    gridder = _filled(random, gridder_for(setup, outlook), seen)
    told = _told(random, grid, position_m)
    found = level(gridder, setup, told, outlook)
    levelled_s = _best(lambda held: level(held, setup, told, outlook), gridder)
    unknown = found.shared()
    without_s = _best(lambda held: measure(held, setup, unknown, outlook), gridder)
    with_s = _best(lambda held: measure(held, setup, unknown, outlook, (told, found)), gridder)
    total_s = levelled_s + max(with_s - without_s, 0.0)
    return {
        "valid_share": float(seen.mean()),
        "level_s": levelled_s,
        "measure_s": without_s,
        "measure_levelled_s": with_s,
        "adjustment_s": total_s,
        "ratio_to_measure": total_s / without_s,
    }


def _best(work: Callable[[Gridder], object], gridder: Gridder) -> float:
    taken_s = []
    for _ in range(ROUNDS):
        held = deepcopy(gridder)  # a measurement takes its memory
        began_s = time.process_time()
        work(held)
        taken_s.append(time.process_time() - began_s)
    return min(taken_s)


def _patchy(random: np.random.Generator, grid: Grid, share: float) -> Bools:
    """Cells in patches of about 100 m, so large a share of all."""
    coarse = ndimage.gaussian_filter(random.normal(size=(grid.ny // 50 + 1, grid.nx // 50 + 1)), 1.5)
    fine = np.repeat(np.repeat(coarse, 50, axis=0), 50, axis=1)[: grid.ny, : grid.nx]
    return np.asarray(fine > np.quantile(coarse, 1 - share))


def _reference(grid: Grid, seen: Bools) -> Reference:
    """A bowl with waves."""
    x_m, y_m = (axis / 1000 for axis in np.meshgrid(grid.x_m, grid.y_m))
    height_m = 120 * ((x_m - 2.5) ** 2 + (y_m - 2) ** 2) / 2 + 30 * np.sin(9 * x_m) * np.cos(7 * y_m)
    given = Reference.given(grid, "1", np.where(seen, height_m, np.nan), seen)
    return replace(
        given,
        random_variance_m2=np.where(seen, 0.01**2, np.nan).astype(np.float32),
        roughness_m2=np.where(seen, 0.02**2, np.nan).astype(np.float32),
        intensity=np.where(seen, 0.5, np.nan).astype(np.float32),
    )


def _filled(random: np.random.Generator, gridder: Gridder, seen: Bools) -> Gridder:
    row, column = np.nonzero(seen)
    for _ in range(POINTS_A_CELL):
        residual_m = random.normal(0, NOISE_M, len(row))
        number = gridder.numbered(column, row)
        gridder.add(number, residual_m, np.full(len(number), 0.5))
    return gridder


def _told(random: np.random.Generator, grid: Grid, position_m: tuple[float, float, float]) -> Told:
    """What a log with noise and the usual faults tells."""
    of = shared.basis(grid, position_m)
    lines = prior.lines_of(of, np.eye(3), None)
    lean_rad: Floats = np.radians(random.normal(0, 0.004, of.line_count))
    azimuth_rad = of.line_azimuth_rad
    faults = np.radians(0.0015) * np.stack([np.cos(azimuth_rad), np.sin(azimuth_rad)], axis=-1)
    log = LineLog(lean_rad, np.full(of.line_count, np.radians(0.008) ** -2), faults)
    return Told(of, lines, np.zeros((3, of.line_count)), log, weather_known=True)
