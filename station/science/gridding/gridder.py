"""Streaming cell statistics on a fixed grid, independent of the order and the blocks of the points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from station.science.geometry.terrain import row_blocks
from station.science.gridding.echo_layers import MIN_SURFACE_POINTS, EchoLayers, LayerSums, supported

if TYPE_CHECKING:
    from station.quantities import Floats, Floats32, Grid, Ints, Ints32
    from station.science.geometry.terrain import BilinearSurface

# Sums are integers, in units of 2^-20 m (and m²), so that they do not depend on the order of the points.
UNITS_PER_M = 2.0**20
MAX_INTENSITY = 65535.0  # intensity has 16 bits
MAX_INTENSITY_POINTS = 65537  # points per cell whose intensity 32 bits can sum
COMMON_SHARE = 0.98  # of the cells with several points, whose change one with fewer may have too
MAX_COMMON_CELLS = 100_000  # of more cells a sample tells the range
NO_THICKNESS = np.empty(0, np.uint8)


@dataclass(frozen=True)
class CellSums:
    """Sums over the points of cells, (ny, nx) each."""

    count: Ints32
    moments: Ints  # (ny, nx, 2): of residuals and of their squares
    intensity_sum: NDArray[np.uint32] | None  # None if the points have no intensity

    def take(self, selection: Ints) -> CellSums:
        """Return a copy of the sums of the selected cells (n,)."""
        intensity_sum = None if self.intensity_sum is None else self.intensity_sum.take(selection)
        return CellSums(self.count.take(selection), self.moments.take(selection, axis=0), intensity_sum)

    def rows(self, rows: slice) -> CellSums:
        """Return views of the sums of some rows."""
        intensity_sum = None if self.intensity_sum is None else self.intensity_sum[rows]
        return CellSums(self.count[rows], self.moments[rows], intensity_sum)

    def mean_residual(self) -> Floats:
        """Mean height above reference or datum (ny, nx) [m], NaN in empty cells.

        Source: Hartzell et al. (2015), Eq. 11, applied to residuals (equations.md, 6.5).
        """
        with np.errstate(invalid="ignore"):
            return np.asarray(self.moments[..., 0] / (self.count * UNITS_PER_M))

    def intensity(self) -> Floats32:
        """Mean intensity of each cell (ny, nx), 0-1; NaN without any, or above `MAX_INTENSITY_POINTS`."""
        mean = np.full(self.count.shape, np.nan, np.float32)
        if self.intensity_sum is not None:
            valid = (self.intensity_sum > 0) & (self.count <= MAX_INTENSITY_POINTS)
            np.divide(
                self.intensity_sum, self.count * MAX_INTENSITY, out=mean, where=valid, casting="same_kind"
            )
        return mean

    def standard_deviation(self) -> Floats32:
        """Standard deviation of the points in each cell (ny, nx) [m], NaN for fewer than two."""
        spread_m = np.full(self.count.shape, np.nan, np.float32)
        several = np.flatnonzero(self.count >= 2)
        count = self.count.take(several).astype(np.float64)
        residual, square = self.moments.reshape(-1, 2).take(several, axis=0).T / UNITS_PER_M
        centred = square - residual**2 / count
        spread_m.reshape(-1)[several] = np.sqrt(np.maximum(centred, 0.0) / (count - 1))
        return spread_m


class Gridder:
    """Count, sum and sum of squares per cell, of heights above the reference surface if there is one.

    Averaging residuals rather than heights removes the sampling error of a slope, which is 0.11 m for one or
    two points in a 1 m cell at 25° (equations.md, 4.10), and the loss of change that comes with it (6.5).

    Sums are stored by cell index, and only cells with an index occupy memory: cells of the reference have the
    index of its viewing geometry, in the order of the head's azimuth; others get theirs at their first point.

    Echoes of the air stay out: the sums are those of one run of adjacent layers per cell (equations.md, 6.6).
    """

    def __init__(
        self,
        grid: Grid,
        surface: BilinearSurface | None,
        datum_m: float,
        thickness: NDArray[np.uint8] = NO_THICKNESS,
        viewpoints: int = 1,
    ) -> None:
        """Create an empty grid; heights in cells without reference count from `datum_m`, for small sums.

        `thickness` (n,) are the codes of the layers of the reference cells: see `thickness_code`. Points from
        more than one of the `viewpoints` are also counted for each.
        """
        self.grid = grid
        self._surface = surface
        self.datum_m = float(np.round(datum_m))
        self.cell_index = (
            np.full(grid.shape, -1, np.int32) if surface is None else np.array(surface.cell_index)
        )
        self.reference_cells = int(self.cell_index.max()) + 1  # cells of the reference have the first indices
        self.used = self.reference_cells
        cells = grid.nx * grid.ny
        self._rest = cells  # where the sums of outlying points go, which nobody reads
        self._count = np.zeros(cells + 1, np.int32)
        self._moments = np.zeros((cells + 1, 2), np.int64)
        self._intensity_sum = np.zeros(cells + 1, np.uint32)
        self._count_by_viewpoint = np.zeros((viewpoints, cells + 1 if viewpoints > 1 else 0), np.int32)
        if not len(thickness):
            thickness = np.ones(self.reference_cells, np.uint8)
        self._layers: EchoLayers | None = EchoLayers(cells, grid.cell_m, thickness)
        self.rejected = 0  # points that are not of the surface of their cell
        self._below = 0  # those of them that lie below it
        # On a reference, intensity is only summed in the cells where it is compared with the reference's.
        self._intensity_cells = cells if surface is None else self.reference_cells
        self._has_intensity = False

    def locate(self, x_m: Floats, y_m: Floats) -> tuple[Ints | slice, Floats, Floats]:
        """Return the points (n,) on the grid, and their column and row in fractional cells.

        A point on an edge belongs to the cell east or south of it.
        """
        column = (x_m - self.grid.west_m) / self.grid.cell_m
        row = (self.grid.north_m - y_m) / self.grid.cell_m
        inside_grid = (column >= 0) & (column < self.grid.nx) & (row >= 0) & (row < self.grid.ny)
        if inside_grid.all():  # the usual case: indexing all points takes longer than this test
            return slice(None), column, row
        inside = np.flatnonzero(inside_grid)
        return inside, column[inside], row[inside]

    def cell_indices(self, column: Floats, row: Floats) -> Ints32:
        """Return the cell index (n,) of each point; new cells get the next indices."""
        cell = (row.astype(np.int32) * np.int32(self.grid.nx) + column.astype(np.int32)).astype(np.intp)
        indices = self.cell_index.reshape(-1)
        cell_index = indices.take(cell)
        new = np.flatnonzero(cell_index < 0)
        if len(new):
            cell = cell[new]
            indices[cell] = np.arange(len(cell))  # of several points in a cell the last one wins
            chosen = cell[indices[cell] == np.arange(len(cell))]
            indices[chosen] = np.arange(self.used, self.used + len(chosen))
            self.used += len(chosen)
            cell_index[new] = indices[cell]
        return cell_index

    def datum_height(self, cell_index: Ints32, column: Floats, row: Floats) -> Floats:
        """Return the height (n,) that each point's residual is relative to [m]: reference or datum."""
        if self._surface is None:
            return np.full(len(cell_index), self.datum_m)
        height_m = self._surface.height(column, row)
        height_m[np.flatnonzero(cell_index >= self.reference_cells)] = self.datum_m
        return height_m

    def new_cells(self) -> Ints32:
        """Return the flattened cells (n,) with points but without reference, ascending."""
        cell, first = np.empty(self.used - self.reference_cells, np.int32), 0
        for rows in row_blocks(self.grid.ny):
            parts = np.flatnonzero(self.cell_index[rows] >= self.reference_cells)
            cell[first : first + len(parts)] = parts + rows.start * self.grid.nx
            first += len(parts)
        return cell

    def is_empty(self) -> bool:
        """Return True if no point was added."""
        return not self.count.any()

    def finish(self) -> None:
        """End the scan: leave the surface of each cell in its sums, and release what only points need."""
        self._surface = None
        if self._layers is None:
            return
        self.rejected = self._layers.dropped
        cells = self._layers.cells_in_table()
        if len(cells):
            self._keep_surfaces(self._layers, cells)
        self._reject_lone(self._layers)
        self._layers = None

    def _keep_surfaces(self, layers: EchoLayers, cells: Ints) -> None:
        """Replace the sums of cells (n,) with those of their surface."""
        low, high = layers.run_bounds(cells)
        dense = LayerSums(
            cells,
            low,
            high,
            self._count[cells].astype(np.int64),
            self._moments[cells, 0],
            self._moments[cells, 1],
            self._intensity_sum[cells].astype(np.int64),
        )
        total = int(dense.count.sum()) + layers.stored
        chosen, below = layers.choose(dense, self.reference_cells)
        self.rejected += total - int(chosen.count.sum())
        self._below += below
        self._count[cells] = chosen.count
        self._moments[cells, 0], self._moments[cells, 1] = chosen.residual, chosen.square
        self._intensity_sum[cells] = chosen.intensity

    def _reject_lone(self, layers: EchoLayers) -> None:
        """Empty the reference cells in which no echo is of a surface: the few far from it that are alone."""
        doubtful, clouds = layers.far_from_reference(self._count[: self.reference_cells])
        if not len(doubtful):
            return
        residual_m = self.take(doubtful.astype(np.int32)).mean_residual()
        neighbours_m, thickness_m = self._neighbours(doubtful), layers.thickness_m(doubtful)
        lowest_m, highest_m = self._common_change()
        is_common = (residual_m > lowest_m - thickness_m) & (residual_m < highest_m + thickness_m)
        alone = clouds | ~(is_common | supported(residual_m, neighbours_m, thickness_m))
        self.rejected += int(self._count[doubtful[alone]].sum())
        self._below += int(self._count[doubtful[alone & (residual_m < 0)]].sum())
        for sums in (self._count, self._moments, self._intensity_sum):
            sums[doubtful[alone]] = 0

    def _common_change(self) -> tuple[float, float]:
        """Return the range of change [m] of nearly all reference cells with several points."""
        step = 1 + self.reference_cells // MAX_COMMON_CELLS
        sample = np.arange(0, self.reference_cells, step, dtype=np.int32)
        sample = sample[self._count[sample] >= MIN_SURFACE_POINTS]
        if not len(sample):
            return 0.0, 0.0
        rest = (1 - COMMON_SHARE) / 2
        lowest_m, highest_m = np.quantile(self.take(sample).mean_residual(), [rest, 1 - rest])
        return float(lowest_m), float(highest_m)

    def _neighbours(self, cell_index: Ints) -> Floats32:
        """Return the mean residuals of the eight cells around reference cells (n,) [m], NaN if unknown."""
        neighbours_m = np.full((len(cell_index), 8), np.nan, np.float32)
        rows, columns = self._positions(cell_index)
        steps = [(row, column) for row in (-1, 0, 1) for column in (-1, 0, 1) if row or column]
        for number, (row_step, column_step) in enumerate(steps):
            row, column = rows + row_step, columns + column_step
            inside = np.flatnonzero(
                (row >= 0) & (row < self.grid.ny) & (column >= 0) & (column < self.grid.nx)
            )
            adjacent = self.cell_index[row[inside], column[inside]]
            known = (adjacent >= 0) & (adjacent < self.reference_cells)
            neighbours_m[inside[known], number] = self.take(adjacent[known]).mean_residual()
        return neighbours_m

    def _positions(self, cell_index: Ints) -> tuple[Ints, Ints]:
        """Return rows and columns of ascending cells (n,) by index."""
        row, column = np.empty((2, len(cell_index)), np.int64)
        wanted = np.zeros(self.used + 1, bool)  # the last one is for the index -1
        wanted[cell_index] = True
        for rows in row_blocks(self.grid.ny):
            indices = self.cell_index[rows].reshape(-1)
            found = np.flatnonzero(wanted.take(indices, mode="wrap"))
            place = np.searchsorted(cell_index, indices[found])
            row[place], column[place] = self.grid.row_and_column(found)
            row[place] += rows.start
        return row, column

    @property
    def rejected_echo_share(self) -> float:
        """Share of the points on the grid that are not of the surface of their cell."""
        return self._share(self.rejected)

    @property
    def airborne_echo_share(self) -> float:
        """Share of the points on the grid that are of the air: rejected ones above the surface.

        As many as there are below are taken off, and two standard deviations of that difference. Where few
        points fall on rough ground, a beam that moved a little meets other ground, as often below the surface
        of its cell as above it; air is only above.
        """
        return self._share(max(self.rejected - 2 * self._below - 2 * self.rejected**0.5, 0.0))

    def _share(self, points: float) -> float:
        """Return a number of points as a share of those on the grid."""
        total = int(self.count.sum(dtype=np.int64)) + self.rejected
        return points / total if total else 0.0

    def add(
        self, cell_index: Ints32, residual_m: Floats, intensity: Floats | None, viewpoint: int = 0
    ) -> None:
        """Add points (n,): cell index, height above reference or datum [m], and intensity, 0-1."""
        position = cell_index.astype(np.intp)
        if self._count_by_viewpoint.size:
            np.add.at(self._count_by_viewpoint[viewpoint], position, np.int32(1))
        rounded = np.rint(residual_m * UNITS_PER_M)
        units = rounded.astype(np.int64)
        squares = np.rint(rounded * rounded * (1 / UNITS_PER_M)).astype(np.int64)
        assert self._layers is not None  # noqa: S101 - points are added before the end of the scan
        outside, layer = self._layers.outside(position, residual_m)
        cells = position[outside]
        position[outside] = self._rest
        self._sum(position, units, squares, intensity)
        if len(outside):
            bright = None if intensity is None else intensity[outside]
            self._add_outside(self._layers, cells, layer, units[outside], squares[outside], bright)

    def _sum(self, position: Ints, units: Ints, squares: Ints, intensity: Floats | None) -> None:
        """Add points (n,) to the sums of their cells."""
        np.add.at(self._count, position, np.int32(1))
        if intensity is not None:
            self._has_intensity = True
            compared = np.flatnonzero(position < self._intensity_cells)
            np.add.at(self._intensity_sum, position[compared], _intensity_units(intensity[compared]))
        moments, first = self._moments.reshape(-1), 2 * position
        np.add.at(moments, first, units)
        np.add.at(moments[1:], first, squares)

    def _add_outside(
        self,
        layers: EchoLayers,
        cells: Ints,
        layer: Ints,
        units: Ints,
        squares: Ints,
        intensity: Floats | None,
    ) -> None:
        """Add points (n,) outside the runs of layers of their cells: to runs that grow, or to the table."""
        joins = layers.grow(cells, layer, self._count)
        joined, other = np.flatnonzero(joins), np.flatnonzero(~joins)
        self._sum(
            cells[joined], units[joined], squares[joined], None if intensity is None else intensity[joined]
        )
        if len(other):
            compared = np.zeros(len(other), np.int64)
            if intensity is not None:
                compared[:] = _intensity_units(intensity[other]) * (cells[other] < self._intensity_cells)
            layers.store(cells[other], layer[other], units[other], squares[other], compared)

    @property
    def count(self) -> Ints32:
        """Number of points by cell index (n,)."""
        return self._count[: self.used]

    def sums(self, first: int, end: int) -> CellSums:
        """Return views of the sums of a range of reference cells, valid until the buffers are released."""
        intensity_sum = self._intensity_sum[first:end] if self._has_intensity else None
        return CellSums(self._count[first:end], self._moments[first:end], intensity_sum)

    @property
    def has_intensity(self) -> bool:
        """True if the intensity of any point is known."""
        return bool(self._has_intensity and self._intensity_sum.any())

    def intensity(self, cell_index: Ints) -> Floats32:
        """Return the mean intensity of reference cells (n,) by index, 0-1; NaN where it is unknown."""
        sums = self.sums(0, self.reference_cells)
        return sums.take(cell_index).intensity()

    def viewpoint_shares(self, cell_index: Ints32) -> Floats:
        """Return the share of each viewpoint (k, n) in all points of cells (n,) by index.

        That of the first is 1 if there is no other, and in cells without points.
        """
        if not self._count_by_viewpoint.size:
            return np.ones((1, len(cell_index)))
        count = self._count_by_viewpoint.take(cell_index, axis=1)
        count[0] += count.sum(axis=0) == 0
        return np.asarray(count / count.sum(axis=0))

    def take(self, cell_index: Ints32) -> CellSums:
        """Return a copy of the sums of cells (n,) by index, without intensity."""
        return CellSums(self._count.take(cell_index), self._moments.take(cell_index, axis=0), None)

    def rasters(self, rows: slice = slice(None)) -> CellSums:
        """Return a copy of the sums as rasters (r, nx), on some rows of the grid or on all.

        On a reference they are those of its cells only: heights in others count from the datum.
        """
        cell_index = self.cell_index[rows]
        present = np.flatnonzero((cell_index >= 0) & (cell_index < (self.reference_cells or self.used)))
        present_index = cell_index.reshape(-1).take(present)
        sums = self.take(present_index)
        count, moments = np.zeros(cell_index.shape, np.int32), np.zeros((*cell_index.shape, 2), np.int64)
        count.reshape(-1)[present], moments.reshape(-1, 2)[present] = sums.count, sums.moments
        intensity_sum = None
        if self._has_intensity:
            intensity_sum = np.zeros(cell_index.shape, np.uint32)
            intensity_sum.reshape(-1)[present] = self._intensity_sum.take(present_index)
        return CellSums(count, moments, intensity_sum)

    def release_buffers(self) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """Return the buffers of moments and intensity, 16 and 4 bytes per cell, to be overwritten."""
        moments, intensity_sum = self._moments[: self.used], self._intensity_sum[: self.used]
        return moments.reshape(-1).view(np.uint8), intensity_sum.view(np.uint8)


def _intensity_units(intensity: Floats) -> NDArray[np.uint32]:
    return np.rint(intensity * MAX_INTENSITY).astype(np.uint32)


def slope_sampling_variance(cell_m: float, tan_slope: Floats, count: Floats) -> Floats:
    """Variance of a plain mean of heights due to points off the centre of a sloping cell [m²].

    Source: equations.md, 4.10; in none of the papers.
    """
    return np.asarray((cell_m * tan_slope) ** 2 / (12 * count))
