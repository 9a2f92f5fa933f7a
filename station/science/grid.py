"""Streaming cell statistics on a fixed grid, the same for any order and any split of the points."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from station.science.terrain import Ground, ground

if TYPE_CHECKING:
    from station.quantities import Bools, Floats, Floats32, Grid, Ints, Reference

# Sums are of multiples of 2^-20 m (and m²), so that adding float64 is exact up to 2^33 and the order in
# which points come cannot matter.
QUANTUM = 2.0**20
STEP_MOST = 6.0  # sigmas: beyond, something happened
CLASS_STEPS = 10.0  # what the class of a cell weighs against the steps from scan to scan of its own
ALL = slice(None)
T = TypeVar("T", bound=np.generic)
ROUGHNESS_CELLS = 1.0  # one sigma of the neighbourhood that tells how rough a cell is


class Gridder:
    """Counts, sums and squares per cell, of heights above the reference surface where there is one.

    Averaging residuals rather than heights removes the sampling error of a slope, which is 0.11 m for one or
    two points in a 1 m cell at 25° (EQUATIONS 4.10), and the loss of change that goes with it (6.5).
    """

    def __init__(self, grid: Grid, reference: Reference | None, datum_m: float) -> None:
        """Heights in cells without reference are taken from `datum_m`, to keep their sums small."""
        self.grid = grid
        self.ground: Ground | None = ground(reference) if reference else None
        self.datum_m = float(np.round(datum_m))
        cells = grid.nx * grid.ny
        self.count = np.zeros(cells, np.int32)
        self._residual = np.zeros(cells)
        self._square = np.zeros(cells)
        self._variance = np.zeros(cells)
        self._brightness = np.zeros(cells)

    def cells(self, x_m: Floats, y_m: Floats) -> tuple[Bools, Floats, Floats]:
        """Tell which points (n,) lie on the grid, and the column and row of those, in fractions of cells.

        A point on an edge belongs to the cell east or south of it.
        """
        column = (x_m - self.grid.west_m) / self.grid.cell_m
        row = (self.grid.north_m - y_m) / self.grid.cell_m
        inside = (column >= 0) & (column < self.grid.nx) & (row >= 0) & (row < self.grid.ny)
        return inside, column[inside], row[inside]

    def flat(self, column: Floats, row: Floats) -> Ints:
        """Index (n,) of each point's cell in the flattened grid."""
        return row.astype(np.int64) * self.grid.nx + column.astype(np.int64)

    def known(self, cell: Ints) -> Bools:
        """Tell for each point (n,) whether the reference is known in its cell."""
        if self.ground is None:
            return np.zeros(len(cell), bool)
        return np.asarray(self.ground.known.ravel()[cell])

    def add(self, cell: Ints, residual_m: Floats, variance_m2: Floats, intensity: Floats | None) -> None:
        """Add points (n,): their cell, height above reference or datum, random variance and brightness."""
        residual_m = np.rint(residual_m * QUANTUM) / QUANTUM
        np.add.at(self.count, cell, 1)
        np.add.at(self._residual, cell, residual_m)
        np.add.at(self._square, cell, np.rint(residual_m**2 * QUANTUM) / QUANTUM)
        np.add.at(self._variance, cell, np.rint(variance_m2 * QUANTUM) / QUANTUM)
        if intensity is not None:
            np.add.at(self._brightness, cell, np.rint(intensity * QUANTUM) / QUANTUM)

    def mean_residual(self, rows: slice = ALL) -> Floats:
        """Mean height above reference or datum (ny, nx) [m], NaN in empty cells; of some rows or all.

        Source: Hartzell et al. (2015), Eq. 11, of residuals (EQUATIONS 6.5).
        """
        count, residual = self._rows(self.count, rows), self._rows(self._residual, rows)
        mean_m = np.full(count.shape, np.nan)
        np.divide(residual, count, out=mean_m, where=count > 0)
        return mean_m

    def intensity(self, rows: slice = ALL) -> Floats32:
        """Mean brightness of each cell (ny, nx), 0-1, NaN in empty cells and in scans that do not tell."""
        count, brightness = self._rows(self.count, rows), self._rows(self._brightness, rows)
        bright = np.full(count.shape, np.nan, np.float32)
        np.divide(brightness, count, out=bright, where=brightness > 0)
        return bright

    def spread(self) -> Floats32:
        """Standard deviation of the points in each cell (ny, nx) [m], NaN for fewer than two."""
        spread_m = np.full(len(self.count), np.nan, np.float32)
        several = np.flatnonzero(self.count > 1)
        count = self.count[several].astype(np.float64)
        centred = self._square[several] - self._residual[several] ** 2 / count
        spread_m[several] = np.sqrt(np.maximum(centred, 0.0) / (count - 1))
        return spread_m.reshape(self.grid.shape)

    def random_variance(self, rows: slice = ALL) -> Floats32:
        """Random variance of each cell's mean (ny, nx) [m²], NaN in empty cells; of some rows or all.

        Source: Hartzell et al. (2015), Eq. 12.
        """
        count, variance = self._rows(self.count, rows), self._rows(self._variance, rows)
        variance_m2 = np.full(count.shape, np.nan, np.float32)
        seen = count > 0
        variance_m2[seen] = variance[seen] / count[seen].astype(np.float64) ** 2
        return variance_m2

    def _rows(self, values: NDArray[T], rows: slice) -> NDArray[T]:
        return values.reshape(self.grid.shape)[rows]


class Stack:
    """Several scans on one grid, each within itself: what they share among their own points stays apart."""

    def __init__(self, grid: Grid) -> None:
        self.grid = grid
        self.count = np.zeros(grid.shape)
        self._residual, self._variance, self._within, self._freedom = (np.zeros(grid.shape) for _ in range(4))
        self._bright, self._lit, self._steps, self._pairs, self._seen = (
            np.zeros(grid.shape, np.float32) for _ in range(5)
        )
        self._scans = 0
        self._last: tuple[Floats32, Floats32] | None = None

    def add(
        self, gridder: Gridder, correction_m: Floats32 | None = None, roughness_m2: Floats32 | None = None
    ) -> None:
        """Add a scan, its heights lowered by the correction (ny, nx).

        `roughness_m2` of the reference it lies on, if any: then scans are also compared with each other.
        """
        count = gridder.count.reshape(self.grid.shape).astype(np.float64)
        seen = count > 0
        self._seen += seen
        self._scans += 1
        self.count += count
        mean_m = gridder.mean_residual()
        if correction_m is not None:
            mean_m -= correction_m
        self._residual[seen] += mean_m[seen] * count[seen]
        bright = gridder.intensity()
        lit = np.where(np.isfinite(bright), count, 0).astype(np.float32)
        self._bright += np.nan_to_num(bright) * lit
        self._lit += lit
        if roughness_m2 is not None:
            variance_m2 = gridder.random_variance()
            variance_m2 += (roughness_m2 / np.maximum(count, 1)).astype(np.float32)
            self._compare(mean_m.astype(np.float32), variance_m2)
        self._variance[seen] += gridder.random_variance()[seen] * count[seen] ** 2
        self._within += np.nan_to_num(gridder.spread()).astype(np.float64) ** 2 * np.maximum(count - 1, 0)
        self._freedom += np.maximum(count - 1, 0)

    def _compare(self, mean_m: Floats32, variance_m2: Floats32) -> None:
        """Take the step from the scan before, in units of what it should be."""
        if self._last is not None:
            before_m, before_m2 = self._last
            steps = (mean_m - before_m) ** 2 / (variance_m2 + before_m2)
            there = np.isfinite(steps)
            self._steps[there] += np.minimum(steps[there], STEP_MOST**2)
            self._pairs[there] += 1
        self._last = mean_m, variance_m2

    def intensity(self) -> Floats32:
        """Mean brightness of each cell (ny, nx), 0-1, NaN where unknown."""
        bright = np.full(self.grid.shape, np.nan, np.float32)
        np.divide(self._bright, self._lit, out=bright, where=self._lit > 0, casting="same_kind")
        return bright

    def seen(self) -> Floats32:
        """Share of the scans that saw each cell (ny, nx)."""
        return self._seen / np.float32(max(self._scans, 1))

    def variance_factor(self, classes: Ints) -> Floats32:
        """Random variance that cells show from scan to scan against the modelled (ny, nx).

        It is drawn to that of the cell's class, of `classes` (ny, nx) from nought: its own few steps weigh
        against `CLASS_STEPS` of the class. One where there is nothing to tell.
        """
        number = int(classes.max()) + 1
        of_class = np.bincount(classes.ravel(), self._steps.ravel(), number)
        pairs = np.bincount(classes.ravel(), self._pairs.ravel(), number)
        ratio = (of_class + CLASS_STEPS) / (pairs + CLASS_STEPS)
        return np.asarray(
            (self._steps + CLASS_STEPS * ratio[classes]) / (self._pairs + CLASS_STEPS), dtype=np.float32
        )

    def mean_residual(self) -> Floats:
        """Mean height of all points above reference or datum (ny, nx) [m], NaN in empty cells."""
        mean_m = np.full(self.grid.shape, np.nan)
        np.divide(self._residual, self.count, out=mean_m, where=self.count > 0)
        return mean_m

    def roughness(self) -> Floats:
        """Variance of the terrain about the reference within each cell (ny, nx) [m²].

        It is what the points of a scan scatter more than their own errors explain, pooled with the cells
        around, for a few points say little of a variance; nought where nothing tells.
        """
        expected = np.divide(self._variance, self.count, out=np.zeros(self.grid.shape), where=self.count > 0)
        excess = ndimage.gaussian_filter(self._within - expected * self._freedom, ROUGHNESS_CELLS)
        freedom = ndimage.gaussian_filter(self._freedom, ROUGHNESS_CELLS)
        told = np.divide(excess, freedom, out=np.zeros(self.grid.shape), where=freedom > 1e-3)
        return np.where(self.count > 0, np.maximum(told, 0.0), 0.0)

    def random_variance(self) -> Floats32:
        """Random variance of the mean of all points (ny, nx) [m²], NaN in empty cells.

        Source: Hartzell et al. (2015), Eq. 12, with the roughness as part of each point's variance.
        """
        variance_m2 = np.full(self.grid.shape, np.nan, np.float32)
        seen = self.count > 0
        total_m2 = self._variance[seen] / self.count[seen] + self.roughness()[seen]
        variance_m2[seen] = total_m2 / self.count[seen]
        return variance_m2


def slope_sampling_variance(cell_m: float, tan_slope: Floats, count: Floats) -> Floats:
    """Variance of a plain mean because the points do not sit at the middle of a sloping cell [m²].

    Source: EQUATIONS 4.10; in none of the papers.
    """
    return np.asarray((cell_m * tan_slope) ** 2 / (12 * count))
