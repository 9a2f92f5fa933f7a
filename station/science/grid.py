"""Streaming cell statistics on a fixed grid, the same for any order and any split of the points."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from station.science.terrain import bands

if TYPE_CHECKING:
    from station.quantities import Floats, Floats32, Grid, Ints, Ints32, Reals
    from station.science.terrain import Ground

# Sums are whole numbers, of 2^-20 m (and m²), so that the order in which points come cannot matter.
QUANTUM = 2.0**20
BRIGHTEST = 65535.0  # intensity is of 16 bits
BITS = 40  # of a number, in which brightness is summed up; the others count
ONE = 1 << BITS
STEP_MOST = 6.0  # sigmas: beyond, something happened
CLASS_STEPS = 10.0  # what the class of a cell weighs against the steps from scan to scan of its own
ROUGHNESS_CELLS = 1.0  # one sigma of the neighbourhood that tells how rough a cell is


@dataclass(frozen=True)
class Sums:
    """What the points of cells amount to, (ny, nx) each."""

    tally: Ints  # number of points, and below `BITS` their brightness
    residual: Ints
    square: Ints

    @cached_property
    def count(self) -> Ints32:
        """Points in each cell (ny, nx)."""
        return (self.tally >> BITS).astype(np.int32)

    def some(self, chosen: Ints) -> Sums:
        """Return those of the chosen cells (n,)."""
        return Sums(self.tally.take(chosen), self.residual.take(chosen), self.square.take(chosen))

    def mean_residual(self) -> Floats:
        """Mean height above reference or datum (ny, nx) [m], NaN in empty cells.

        Source: Hartzell et al. (2015), Eq. 11, of residuals (EQUATIONS 6.5).
        """
        with np.errstate(invalid="ignore"):
            return np.asarray(self.residual / (self.count * QUANTUM))

    def intensity(self) -> Floats32:
        """Mean brightness of each cell (ny, nx), 0-1, NaN in empty cells and in scans that do not tell."""
        brightness = self.tally & (ONE - 1)
        bright = np.full(brightness.shape, np.nan, np.float32)
        whole = self.count * BRIGHTEST
        np.divide(brightness, whole, out=bright, where=brightness > 0, casting="same_kind")
        return bright

    def spread(self) -> Floats32:
        """Standard deviation of the points in each cell (ny, nx) [m], NaN for fewer than two."""
        spread_m = np.full(self.tally.shape, np.nan, np.float32)
        several = np.flatnonzero(self.tally >= 2 * ONE)
        count = (self.tally.take(several) >> BITS).astype(np.float64)
        mean_square = (self.residual.take(several) / QUANTUM) ** 2 / count
        centred = self.square.take(several) / QUANTUM - mean_square
        spread_m.reshape(-1)[several] = np.sqrt(np.maximum(centred, 0.0) / (count - 1))
        return spread_m


class Gridder:
    """Counts, sums and squares per cell, of heights above the reference surface where there is one.

    Averaging residuals rather than heights removes the sampling error of a slope, which is 0.11 m for one or
    two points in a 1 m cell at 25° (EQUATIONS 4.10), and the loss of change that goes with it (6.5).

    Sums lie by the number of their cell, and memory is taken as far as cells have one: those that the
    reference knows have theirs from it, in the order in which the head comes by, the others as they are met.
    """

    def __init__(self, grid: Grid, ground: Ground | None, datum_m: float) -> None:
        """Heights in cells without reference are taken from `datum_m`, to keep their sums small."""
        self.grid = grid
        self._ground = ground
        self.datum_m = float(np.round(datum_m))
        self.number = np.full(grid.shape, -1, np.int32) if ground is None else np.array(ground.number)
        self.known = int(self.number.max()) + 1  # cells that the reference knows have the first numbers
        self.taken = self.known
        # Of a cell side by side, for it is they that a shot has to wait for: number of points and brightness
        # in one, heights, and their squares.
        self._sums = np.zeros((grid.nx * grid.ny, 3), np.int64)
        self._empty = True

    def cells(self, x_m: Floats, y_m: Floats) -> tuple[Ints | slice, Floats, Floats]:
        """Which points (n,) lie on the grid, and their column and row, in fractions of cells.

        A point on an edge belongs to the cell east or south of it.
        """
        column = (x_m - self.grid.west_m) / self.grid.cell_m
        row = (self.grid.north_m - y_m) / self.grid.cell_m
        there = (column >= 0) & (column < self.grid.nx) & (row >= 0) & (row < self.grid.ny)
        if there.all():  # as most are: to choose them all takes longer than to find that out
            return slice(None), column, row
        inside = np.flatnonzero(there)
        return inside, column[inside], row[inside]

    def numbered(self, column: Floats, row: Floats) -> Ints32:
        """Number (n,) of the cell of each point; cells that had none are given the next."""
        cell = (row.astype(np.int32) * np.int32(self.grid.nx) + column.astype(np.int32)).astype(np.intp)
        numbers = self.number.reshape(-1)
        number = numbers.take(cell)
        new = np.flatnonzero(number < 0)
        if len(new):
            cell = cell[new]
            numbers[cell] = np.arange(len(cell))  # of several points in a cell the last one stays
            met = cell[numbers[cell] == np.arange(len(cell))]
            numbers[met] = np.arange(self.taken, self.taken + len(met))
            self.taken += len(met)
            number[new] = numbers[cell]
        return number

    def below(self, number: Ints32, column: Floats, row: Floats) -> Floats:
        """Height (n,) that the residual of each point is taken from [m]: of the reference, or the datum."""
        if self._ground is None:
            return np.full(len(number), self.datum_m)
        below_m = self._ground.height(column, row)
        below_m[np.flatnonzero(number >= self.known)] = self.datum_m
        return below_m

    def beyond(self) -> Ints32:
        """Return the cells (n,) with points that no reference knows, rising."""
        return np.flatnonzero(self.number >= self.known).astype(np.int32)

    def is_empty(self) -> bool:
        """Tell whether no point has come."""
        return self._empty

    def complete(self) -> None:
        """No more points come: let the ground go that only they need."""
        self._ground = None

    def add(self, number: Ints32, residual_m: Floats, intensity: Floats | None) -> None:
        """Add points (n,): number of their cell, height above reference or datum, and brightness, 0-1."""
        self._empty &= not len(number)
        sums = self._sums.reshape(-1)
        steps = np.rint(residual_m * QUANTUM)
        at = np.multiply(number, 3, dtype=np.int64)
        tally = ONE if intensity is None else ONE + np.rint(intensity * BRIGHTEST).astype(np.int64)
        squares = np.rint(steps * steps * (1 / QUANTUM))
        np.add.at(sums, at, tally)
        np.add.at(sums[1:], at, steps.astype(np.int64))
        np.add.at(sums[2:], at, squares.astype(np.int64))

    def sums(self, first: int, end: int) -> Sums:
        """Take a copy of the cells with some numbers."""
        return Sums(*np.ascontiguousarray(self._sums[first:end].T))

    def at(self, number: Ints32) -> Sums:
        """Take a copy of cells (n,) by their numbers."""
        return Sums(*np.ascontiguousarray(self._sums.take(number, axis=0).T))

    def rasters(self, rows: slice = slice(None)) -> Sums:
        """Lay out a copy of all sums on some rows of the grid, or all, (r, nx) each."""
        number = self.number[rows]
        laid = np.zeros((3, *number.shape), np.int64)
        there = number >= 0
        laid[:, there] = self._sums.take(number[there], axis=0).T
        return Sums(*laid)

    def memory(self) -> NDArray[np.uint8]:
        """Give the sums away, all that there is of each cell in turn, to be overwritten once read."""
        return self._sums[: self.taken].reshape(-1).view(np.uint8)


class Stack:
    """Several scans on one grid, each within itself: what they share among their own points stays apart.

    Scans are added band by band, lest the grid's memory be taken several times.
    """

    def __init__(self, grid: Grid) -> None:
        self.grid = grid
        self._residual = np.zeros(grid.shape)
        self.count, self._variance, self._within, self._freedom = (
            np.zeros(grid.shape, np.float32) for _ in range(4)
        )
        self._bright, self._lit, self._steps, self._pairs, self._seen = (
            np.zeros(grid.shape, np.float32) for _ in range(5)
        )
        self._scans = 0
        self._last: Floats32 | None = None  # (2, ny, nx): mean and its variance, of the scan before

    def add(
        self,
        gridder: Gridder,
        known: tuple[Floats32, Floats32] | None = None,
        roughness_m2: Floats32 | None = None,
    ) -> None:
        """Add a scan.

        `known`, on a reference: random variance of a shot and what to lower heights by, and the
        `roughness_m2` of that reference, (ny, nx) each. Then scans are also compared with each other.
        """
        self._scans += 1
        if roughness_m2 is not None and self._last is None:
            self._last = np.full((2, *self.grid.shape), np.nan, np.float32)
        for rows in bands(self.grid.ny):
            sums = gridder.rasters(rows)
            count = sums.count.astype(np.float32)
            shot_m2, correction_m = (one[rows] for one in known) if known else np.zeros((2, *count.shape))
            mean_m = sums.mean_residual() - correction_m
            self._add(rows, sums, count, mean_m, shot_m2)
            if roughness_m2 is not None:
                variance_m2 = (shot_m2 + roughness_m2[rows]) / np.maximum(count, 1)
                self._compare(rows, mean_m.astype(np.float32), variance_m2.astype(np.float32))

    def _add(self, rows: slice, sums: Sums, count: Floats32, mean_m: Floats, shot_m2: Reals) -> None:
        self._seen[rows] += count > 0
        self.count[rows] += count
        self._residual[rows] += np.nan_to_num(mean_m) * count
        bright = sums.intensity()
        lit = np.where(np.isfinite(bright), count, np.float32(0))
        self._bright[rows] += np.nan_to_num(bright) * lit
        self._lit[rows] += lit
        self._variance[rows] += shot_m2 * count
        freedom = np.maximum(count - 1, 0)
        self._within[rows] += np.nan_to_num(sums.spread()) ** 2 * freedom
        self._freedom[rows] += freedom

    def _compare(self, rows: slice, mean_m: Floats32, variance_m2: Floats32) -> None:
        """Take the step from the scan before, in units of what it should be."""
        assert self._last is not None  # noqa: S101 - the caller's case
        before_m, before_m2 = self._last[:, rows]
        expected_m2 = variance_m2 + before_m2
        there = np.isfinite(mean_m - before_m) & (expected_m2 > 0)
        steps = (mean_m - before_m)[there] ** 2 / expected_m2[there]
        self._steps[rows][there] += np.minimum(steps, STEP_MOST**2)
        self._pairs[rows][there] += 1
        before_m[:], before_m2[:] = mean_m, variance_m2

    def intensity(self) -> Floats32:
        """Mean brightness of each cell (ny, nx), 0-1, NaN where unknown."""
        bright = np.full(self.grid.shape, np.nan, np.float32)
        np.divide(self._bright, self._lit, out=bright, where=self._lit > 0, casting="same_kind")
        return bright

    def seen(self) -> Floats32:
        """Share of the scans that saw each cell (ny, nx)."""
        return self._seen / np.float32(max(self._scans, 1))

    def variance_factor(self, classes: Ints32) -> Floats32:
        """Random variance that cells show from scan to scan against the modelled (ny, nx).

        It is drawn to that of the cell's class, of `classes` (ny, nx) from nought: its own few steps weigh
        against `CLASS_STEPS` of the class. One where there is nothing to tell.
        """
        number = int(classes.max()) + 1
        of_class, pairs = np.zeros((2, number))
        for rows in bands(self.grid.ny):
            of_class += np.bincount(classes[rows].ravel(), self._steps[rows].ravel(), number)
            pairs += np.bincount(classes[rows].ravel(), self._pairs[rows].ravel(), number)
        ratio = ((of_class + CLASS_STEPS) / (pairs + CLASS_STEPS)).astype(np.float32)
        factor = CLASS_STEPS * ratio[classes]
        factor += self._steps
        factor /= self._pairs + CLASS_STEPS
        return np.asarray(factor)

    def mean_residual(self) -> Floats:
        """Mean height of all points above reference or datum (ny, nx) [m], NaN in empty cells."""
        return np.asarray(self._per_point(self._residual))

    def roughness(self) -> Floats32:
        """Variance of the terrain about the reference within each cell (ny, nx) [m²].

        It is what the points of a scan scatter more than their own errors explain, pooled with the cells
        around, for a few points say little of a variance; nought where nothing tells.
        """
        excess = self._within - self._per_point(self._variance, empty=0.0) * self._freedom
        excess = ndimage.gaussian_filter(excess, ROUGHNESS_CELLS)
        freedom = ndimage.gaussian_filter(self._freedom, ROUGHNESS_CELLS)
        told = np.zeros(self.grid.shape, np.float32)
        np.divide(excess, freedom, out=told, where=(freedom > 1e-3) & (self.count > 0))
        return np.maximum(told, 0.0, out=told)

    def random_variance(self, roughness_m2: Floats32) -> Floats32:
        """Random variance of the mean of all points (ny, nx) [m²], NaN in empty cells.

        Source: Hartzell et al. (2015), Eq. 12, with the roughness as part of each point's variance.
        """
        return self._per_point(self._per_point(self._variance) + roughness_m2)

    def _per_point(self, values: Reals, empty: float = np.nan) -> Reals:
        """Divide by the number of points (ny, nx)."""
        divided = np.full_like(values, empty)
        np.divide(values, self.count, out=divided, where=self.count > 0)
        return divided


def slope_sampling_variance(cell_m: float, tan_slope: Floats, count: Floats) -> Floats:
    """Variance of a plain mean because the points do not sit at the middle of a sloping cell [m²].

    Source: EQUATIONS 4.10; in none of the papers.
    """
    return np.asarray((cell_m * tan_slope) ** 2 / (12 * count))
