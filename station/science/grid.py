"""Streaming cell statistics on a fixed grid, the same for any order and any split of the points."""

from __future__ import annotations

from dataclasses import dataclass
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
LIT_MOST = 65537  # points in a cell, whose brightness 32 bits can sum up
STEP_MOST = 6.0  # sigmas: beyond, something happened
CLASS_STEPS = 10.0  # what the class of a cell weighs against the steps from scan to scan of its own
ROUGHNESS_CELLS = 1.0  # one sigma of the neighbourhood that tells how rough a cell is


@dataclass(frozen=True)
class Sums:
    """What the points of cells amount to, (ny, nx) each."""

    count: Ints32
    moments: Ints  # (ny, nx, 2): their residuals, and the squares of these
    bright: NDArray[np.uint32] | None  # None where nothing tells of any

    def some(self, chosen: Ints) -> Sums:
        """Return a copy of those of the chosen cells (n,)."""
        bright = None if self.bright is None else self.bright.take(chosen)
        return Sums(self.count.take(chosen), self.moments.take(chosen, axis=0), bright)

    def mean_residual(self) -> Floats:
        """Mean height above reference or datum (ny, nx) [m], NaN in empty cells.

        Source: Hartzell et al. (2015), Eq. 11, of residuals (EQUATIONS 6.5).
        """
        with np.errstate(invalid="ignore"):
            return np.asarray(self.moments[..., 0] / (self.count * QUANTUM))

    def intensity(self) -> Floats32:
        """Mean brightness of each cell (ny, nx), 0-1, NaN where nothing tells, or of more than `LIT_MOST`."""
        mean = np.full(self.count.shape, np.nan, np.float32)
        if self.bright is not None:
            told = (self.bright > 0) & (self.count <= LIT_MOST)
            np.divide(self.bright, self.count * BRIGHTEST, out=mean, where=told, casting="same_kind")
        return mean

    def spread(self) -> Floats32:
        """Standard deviation of the points in each cell (ny, nx) [m], NaN for fewer than two."""
        spread_m = np.full(self.count.shape, np.nan, np.float32)
        several = np.flatnonzero(self.count >= 2)
        count = self.count.take(several).astype(np.float64)
        residual, square = self.moments.reshape(-1, 2).take(several, axis=0).T / QUANTUM
        centred = square - residual**2 / count
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
        cells = grid.nx * grid.ny
        self._count = np.zeros(cells, np.int32)
        self._moments = np.zeros((cells, 2), np.int64)
        self._bright = np.zeros(cells, np.uint32)
        self._compared = cells if ground is None else self.known  # brightness is of no use in the others
        self._is_lit = False

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
        cell, first = np.empty(self.taken - self.known, np.int32), 0
        for rows in bands(self.grid.ny):
            found = np.flatnonzero(self.number[rows] >= self.known)
            cell[first : first + len(found)] = found + rows.start * self.grid.nx
            first += len(found)
        return cell

    def is_empty(self) -> bool:
        """Tell whether no point has come."""
        return not self.count.any()

    def complete(self) -> None:
        """No more points come: let the ground go that only they need."""
        self._ground = None

    def add(self, number: Ints32, residual_m: Floats, intensity: Floats | None) -> None:
        """Add points (n,): number of their cell, height above reference or datum, and brightness, 0-1."""
        at = number.astype(np.intp)
        np.add.at(self._count, at, np.int32(1))
        if intensity is not None:
            self._is_lit = True
            lit = np.flatnonzero(at < self._compared)
            np.add.at(self._bright, at[lit], np.rint(intensity[lit] * BRIGHTEST).astype(np.uint32))
        at *= 2
        moments = self._moments.reshape(-1)
        steps = np.rint(residual_m * QUANTUM)
        squares = np.rint(steps * steps * (1 / QUANTUM))
        np.add.at(moments, at, steps.astype(np.int64))
        np.add.at(moments[1:], at, squares.astype(np.int64))

    @property
    def count(self) -> Ints32:
        """Number of points by number of the cell (n,)."""
        return self._count[: self.taken]

    def sums(self, first: int, end: int) -> Sums:
        """Look at the cells that the reference knows with some numbers, until their memory is given away."""
        bright = self._bright[first:end] if self._is_lit else None
        return Sums(self._count[first:end], self._moments[first:end], bright)

    def at(self, number: Ints32) -> Sums:
        """Take a copy of cells (n,) by their numbers; not of their brightness."""
        return Sums(self._count.take(number), self._moments.take(number, axis=0), None)

    def rasters(self, rows: slice = slice(None)) -> Sums:
        """Lay out a copy of all sums on some rows of the grid, or all, (r, nx) each."""
        number = self.number[rows]
        there = np.flatnonzero(number >= 0)
        told = self.at(number.reshape(-1).take(there))
        count, moments = np.zeros(number.shape, np.int32), np.zeros((*number.shape, 2), np.int64)
        count.reshape(-1)[there], moments.reshape(-1, 2)[there] = told.count, told.moments
        bright = None
        if self._is_lit:
            bright, lit = np.zeros(number.shape, np.uint32), (number >= 0) & (number < self._compared)
            bright[lit] = self._bright.take(number[lit])
        return Sums(count, moments, bright)

    def memory(self) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """Give moments and brightness away, 16 and 4 bytes of each cell in turn, overwritten once read."""
        moments, bright = self._moments[: self.taken], self._bright[: self.taken]
        return moments.reshape(-1).view(np.uint8), bright.view(np.uint8)


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
