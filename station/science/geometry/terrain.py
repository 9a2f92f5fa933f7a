"""Slope, aspect and normals of a surface, and its height between the cell centres."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy import ndimage

from station.quantities import Bools, Floats, Floats32, Grid, Ints, Ints32, Reals, Reference

ALL = slice(None)
BLOCK_ROWS = 128  # height of a block of rows, as of a chunk in the store
HALO_ROWS = 4  # adjacent rows that the smoothed gradient of a block needs
BLOCK_CELLS = 200_000  # cells extrapolated at once
GRADIENT_CELLS = 1.5  # one sigma of the Gaussian that gradients are smoothed with
BLOCK_WINDOWS = 8_000  # cells whose neighbourhoods are processed at once
TAKE_MODE: Final = "wrap"  # indices are valid by construction; without the bounds check a third faster
# Sigma of the Gaussian that a plane is fitted with; the sum of weights up to which a wider one is taken.
PLANE_CELLS = (1.5, 3.0, 6.0)
MIN_PLANE_CELLS = 10.0
PLANE_RIDGE = 1e-2  # draws the slope to zero where the known cells do not tell it
MIN_WEIGHT = 1e-3  # weight of the known cells of a neighbourhood, below which it counts as empty


def normal(slope_rad: Floats, aspect_rad: Floats) -> Floats:
    """Unit normal (n, 3) (east, north, up); aspect is the downslope direction, clockwise from north.

    Source: Voordendag et al. (2023), Eq. 14.
    """
    sin_slope = np.sin(slope_rad)
    return np.stack(
        [np.sin(aspect_rad) * sin_slope, np.cos(aspect_rad) * sin_slope, np.cos(slope_rad)], axis=-1
    )


def smooth_gradient(
    elevation_m: Floats | Floats32, cell_m: float, cells: float = GRADIENT_CELLS, rows: slice = ALL
) -> tuple[Floats32, Floats32]:
    """Eastward and northward gradient (ny, nx) [1] of a surface smoothed over `cells` (one sigma).

    NaN in the surface is skipped (normalised convolution of the differences); NaN where no value is near.
    Only of `rows`, if given.
    """
    east, north = (np.full(elevation_m.shape, np.nan, np.float32) for _ in range(2))
    east[:, 1:-1] = (elevation_m[:, 2:] - elevation_m[:, :-2]) / (2 * cell_m)
    north[1:-1] = (elevation_m[:-2] - elevation_m[2:]) / (2 * cell_m)
    return smooth(east, cells, rows), smooth(north, cells, rows)


def gradient_at(
    elevation_m: Floats32, cell_m: float, row: Ints | Ints32, column: Ints | Ints32
) -> tuple[Floats32, Floats32]:
    """Return `smooth_gradient` [1] in a few cells (n,), each from the window of cells around it.

    Per cell it takes ten times as long as for a whole surface.
    """
    weights_1d = _gaussian(GRADIENT_CELLS)
    weights, half_width = np.outer(weights_1d, weights_1d).reshape(-1), len(weights_1d) // 2 + 1
    padded_m = np.pad(elevation_m, half_width, constant_values=np.nan)
    offset = np.arange(2 * half_width + 1)
    window = (offset[:, None] * padded_m.shape[1] + offset)[..., None]
    first, inner = row * padded_m.shape[1] + column, slice(1, -1)
    gradient = np.empty((2, len(first)), np.float32)
    for part in (slice(at, at + BLOCK_WINDOWS) for at in range(0, len(first), BLOCK_WINDOWS)):
        windows_m = padded_m.reshape(-1).take(window + first[part], mode=TAKE_MODE)
        gradient[0, part] = _mean_of_finite(windows_m[inner, 2:] - windows_m[inner, :-2], weights)
        gradient[1, part] = _mean_of_finite(windows_m[:-2, inner] - windows_m[2:, inner], weights)
    gradient /= 2 * cell_m
    return gradient[0], gradient[1]


def smooth(values: Floats | Floats32, cells: float, rows: slice = ALL) -> Floats32:
    """Values (ny, nx) smoothed with a Gaussian of `cells` (one sigma), skipping NaN; NaN where none is near.

    Only of `rows`, if given.
    """
    known = np.isfinite(values)
    weight = _convolve_gaussian(known.astype(np.float32), cells, rows)
    filled = np.where(known, values, np.float32(0)).astype(np.float32, copy=False)
    return _divide_by_weight(_convolve_gaussian(filled, cells, rows), weight)


def _mean_of_finite(values: Floats32, weights: Floats32) -> Floats32:
    """Mean (n,) of the finite values (k, k, n), by weights (k²,); NaN where none is near.

    It uses `einsum`, because the last digit of a BLAS product depends on the number of cells.
    """
    values = values.reshape(len(weights), -1)
    known = values == values  # noqa: PLR0124 - False for NaN
    known_weight = np.einsum("i,ij->j", weights, known.astype(np.float32))
    bits = values.view(np.int32)
    bits &= np.negative(known.view(np.int8), dtype=np.int32)  # NaN to 0, in half the time of `where`
    return _divide_by_weight(np.einsum("i,ij->j", weights, values), known_weight)


def _divide_by_weight(total: Floats32, weight: Floats32) -> Floats32:
    """Return sums per weight of their finite values, NaN for a negligible weight; overwrites both."""
    total[weight <= MIN_WEIGHT] = np.nan
    total /= np.maximum(weight, MIN_WEIGHT, out=weight)
    return total


def _gaussian(cells: float) -> Floats32:
    """Return the weights (2 n + 1,) of a Gaussian of `cells` (one sigma), truncated at two sigma."""
    half_width = int(2 * cells + 0.5)
    weights = np.exp(-0.5 * (np.arange(-half_width, half_width + 1) / cells) ** 2)
    return np.asarray((weights / weights.sum()).astype(np.float32))


def _convolve_gaussian(values: Floats32, cells: float, rows: slice) -> Floats32:
    """Return rows of values (ny, nx) convolved with a Gaussian, with zeros beyond the border.

    It works on whole arrays: `ndimage.gaussian_filter` works line by line, which takes twice as long.
    """
    weights = _gaussian(cells)
    (start, stop, step), width = rows.indices(len(values)), values.shape[1]
    padded = np.pad(values, len(weights) // 2)
    columns = _symmetric_sum([padded[start + at : stop + at : step] for at in range(len(weights))], weights)
    return _symmetric_sum([columns[:, at : at + width] for at in range(len(weights))], weights)


def _symmetric_sum(shifted: list[Floats32], weights: Floats32) -> Floats32:
    """Return the weighted sum of shifted arrays, for weights symmetric about the middle."""
    middle = len(weights) // 2
    total: Floats32 = shifted[middle] * weights[middle]
    pair = np.empty_like(total)
    for first, second in zip(range(middle), range(len(weights) - 1, middle, -1), strict=True):
        np.add(shifted[first], shifted[second], out=pair)
        pair *= weights[first]
        total += pair
    return total


@dataclass(frozen=True)
class BilinearSurface:
    """The reference surface for lookups by shots: bilinear between nodes at the cell centres.

    `height_above_datum_m` (ny, nx) is extrapolated by one ring of cells around those that are `known`. Known
    cells have a `cell_index` (ny, nx) from 0, all others -1.
    """

    grid: Grid
    datum_m: float
    height_above_datum_m: Floats32
    cell_index: Ints32

    @property
    def known(self) -> Bools:
        """Mask (ny, nx) of the known cells."""
        return np.asarray(self.cell_index >= 0)

    def height(self, column: Floats, row: Floats) -> Floats:
        """Height of the surface below points (n,) [m], which are given as for `height_and_gradient`.

        Nodes differ by a metre or two, which single precision resolves to a micrometre.
        """
        nw, ne, sw, se, u, v = self._corners(column, row)
        east, south = ne - nw, sw - nw
        u, v = u.astype(np.float32), v.astype(np.float32)
        between_m = east * u + (south + (se - sw - east) * u) * v
        # Cast to float64 before adding: mixed-precision addition is 2 × slower.
        return nw.astype(np.float64) + self.datum_m + between_m.astype(np.float64)

    def height_and_gradient(self, column: Floats, row: Floats) -> tuple[Floats, Floats, Floats]:
        """Height [m] and eastward and northward gradient [1] of the surface below points (n,).

        Points are in cells from the north-west corner of the grid; the result is valid where the point's own
        cell is known.
        """
        *heights_m, u, v = self._corners(column, row)
        nw, ne, sw, se = (height_m.astype(np.float64) for height_m in heights_m)
        north_side, south_side = nw + (ne - nw) * u, sw + (se - sw) * u
        east = ((ne - nw) * (1 - v) + (se - sw) * v) / self.grid.cell_m
        north = (north_side - south_side) / self.grid.cell_m
        return self.datum_m + north_side + (south_side - north_side) * v, east, north

    def cell_means(self, rows: slice) -> Floats:
        """Mean height over each cell (r, nx) of the given rows [m]."""
        window = _with_neighbours(rows)
        return (
            self.datum_m
            + cell_means(self.height_above_datum_m[window])[rows.start - window.start :][: _row_count(rows)]
        )

    def cell_gradients(self, rows: slice) -> tuple[Floats, Floats]:
        """Mean eastward and northward gradient over each cell (r, nx) of the given rows [1]."""
        window = _with_neighbours(rows)
        inner = slice(rows.start - window.start, rows.stop - window.start)
        east, north = cell_gradients(self.height_above_datum_m[window], self.grid.cell_m)
        return east[inner], north[inner]

    def _corners(self, column: Floats, row: Floats) -> tuple[Reals, ...]:
        """Return heights of the nodes nw, ne, sw, se of points (n,), and their offset from nw [cells]."""
        nx, ny = self.grid.nx, self.grid.ny
        east, south = column - 0.5, row - 0.5
        # Within half a cell of the grid's border the last slope is extrapolated; -0.5 truncates to 0.
        west_node = np.minimum(east.astype(np.int32), np.int32(max(nx - 2, 0)))
        north_node = np.minimum(south.astype(np.int32), np.int32(max(ny - 2, 0)))
        nw_node = (north_node * np.int32(nx) + west_node).astype(np.intp)
        to_east, to_south = min(nx - 1, 1), min(ny - 1, 1) * nx
        heights_m = [
            self.height_above_datum_m.ravel()[step:].take(nw_node, mode=TAKE_MODE)
            for step in (0, to_east, to_south, to_south + to_east)
        ]
        return (*heights_m, east - west_node.astype(np.float64), south - north_node.astype(np.float64))


def cell_means(nodes: Floats | Floats32) -> Floats:
    """Mean over each cell (ny, nx) of the surface that is bilinear between the nodes at cell centres."""
    return _mean_along(_mean_along(_with_border(nodes), 0), 1)


def cell_gradients(nodes: Floats | Floats32, cell_m: float) -> tuple[Floats, Floats]:
    """Mean eastward and northward gradient over each cell (ny, nx) [1] of the surface of `cell_means`."""
    padded = _with_border(nodes)
    rows, columns = _mean_along(padded, 0), _mean_along(padded, 1)
    east, north = rows[:, 2:] - rows[:, :-2], columns[:-2] - columns[2:]
    return east / (2 * cell_m), north / (2 * cell_m)


def _with_border(nodes: Floats | Floats32) -> Floats:
    """Return nodes with another row and column on each side, extrapolated."""
    return np.pad(np.asarray(nodes, dtype=np.float64), 1, mode="reflect", reflect_type="odd")


def _mean_along(nodes: Floats, axis: int) -> Floats:
    """Return means over cells, along one axis, of values that are linear between nodes; two cells fewer."""
    across = nodes.swapaxes(0, axis)
    return np.asarray((across[:-2] + 6 * across[1:-1] + across[2:]) / 8).swapaxes(0, axis)


def known_cell_means(nodes: Floats | Floats32, rows: slice, columns: slice) -> Floats:
    """Mean over each cell (r, c) of a window of a surface with nodes (ny, nx); NaN where they are unknown.

    Nodes around the known ones are extrapolated, as for the shots.
    """
    halos = [slice(max(part.start - HALO_ROWS, 0), part.stop + HALO_ROWS) for part in (rows, columns)]
    inner = tuple(
        slice(part.start - halo.start, part.stop - halo.start)
        for part, halo in zip((rows, columns), halos, strict=True)
    )
    window = np.asarray(nodes[halos[0], halos[1]], dtype=np.float64)
    known = np.isfinite(window)
    datum = float(window[known].mean()) if known.any() else 0.0
    extended = extrapolate_ring((window - datum).astype(np.float32))
    means = datum + cell_means(np.nan_to_num(extended, copy=False))
    return np.where(known, means, np.nan)[inner]


def _with_neighbours(rows: slice) -> slice:
    return slice(max(rows.start - 1, 0), rows.stop + 1)


def _row_count(rows: slice) -> int:
    return int(rows.stop - rows.start)


def fit_planes(elevation_m: Floats, *, keep_dense: bool = False) -> Floats:
    """Elevations (ny, nx) [m] of planes fitted around each known cell; NaN stays.

    The weights are Gaussian, of the least of `PLANE_CELLS` that reaches enough known cells. With
    `keep_dense`, a cell whose eight neighbours are all known keeps its own. Source: equations.md, 4.11.
    """
    fitted_m, halo = np.full(elevation_m.shape, np.nan), len(_gaussian(PLANE_CELLS[-1])) // 2
    for rows in row_blocks(len(elevation_m)):
        window = slice(max(rows.start - halo, 0), rows.stop + halo)
        inner = slice(rows.start - window.start, rows.stop - window.start)
        part_m = elevation_m[window]
        wanted = np.isfinite(part_m)
        if not wanted.any():
            continue
        datum_m = float(part_m[wanted].mean())
        height_m, known = np.where(wanted, part_m - datum_m, 0.0), wanted.astype(np.float64)
        if keep_dense:
            dense = ndimage.binary_erosion(wanted, np.ones((3, 3), bool))
            fitted_m[rows] = np.where(dense, part_m, np.nan)[inner]
            wanted &= ~dense
        for cells in PLANE_CELLS:
            reached, plane_m = _fit_plane(height_m, known, cells)
            chosen = (wanted & ((reached >= MIN_PLANE_CELLS) | (cells == PLANE_CELLS[-1])))[inner]
            fitted_m[rows][chosen] = plane_m[inner][chosen] + datum_m
            wanted[inner][chosen] = False
    return fitted_m


def _fit_plane(height_m: Floats, known: Floats, cells: float) -> tuple[Floats, Floats]:
    """Return the sum of the weights of known cells, and the plane's height at the centre (ny, nx)."""
    weights = _gaussian(cells).astype(np.float64)
    weights /= weights.max()
    offset = np.arange(len(weights)) - len(weights) // 2.0
    kernels = [weights * offset**power for power in range(3)]

    def moment(values: Floats, east: int, south: int) -> Floats:
        columns = ndimage.correlate1d(values, kernels[south], axis=0, mode="constant")
        return np.asarray(ndimage.correlate1d(columns, kernels[east], axis=1, mode="constant"))

    total, east, south = moment(known, 0, 0), moment(known, 1, 0), moment(known, 0, 1)
    ridge = PLANE_RIDGE * cells**2 * np.maximum(total, MIN_WEIGHT)
    east2, south2, mixed = moment(known, 2, 0) + ridge, moment(known, 0, 2) + ridge, moment(known, 1, 1)
    height, height_east, height_south = (moment(height_m, *powers) for powers in ((0, 0), (1, 0), (0, 1)))
    minors = east2 * south2 - mixed**2, east * south2 - mixed * south, east * mixed - east2 * south
    determinant = total * minors[0] - east * minors[1] + south * minors[2]
    numerator = height * minors[0] - height_east * minors[1] + height_south * minors[2]
    return total, numerator / np.maximum(determinant, MIN_WEIGHT**3)


def nodes_from_means(means: Floats) -> Floats:
    """Nodes (ny, nx) whose bilinear surface has the given cell means, to second order in its curvature.

    With the means themselves as nodes there would be a false change: 12 mm for 10 m cells on a slope whose
    radius of curvature is 1 km. Next to a gap a node is the mean.
    """
    nodes = 2 * means - cell_means(means)
    return np.where(np.isfinite(nodes), nodes, means)


def bilinear_surface(reference: Reference) -> BilinearSurface:
    """Return a reference surface for lookups, with its known cells indexed row by row."""
    height_m = np.empty(reference.grid.shape, np.float32)
    cell_index = np.full(reference.grid.shape, -1, np.int32)
    datum_m, first_index = _datum(reference), 0
    for rows in row_blocks(reference.grid.ny):
        height_m[rows] = reference.elevation_m[rows] - datum_m
        known = np.isfinite(height_m[rows])
        end_index = first_index + int(np.count_nonzero(known))
        cell_index[rows][known] = np.arange(first_index, end_index)
        first_index = end_index
    return BilinearSurface(
        reference.grid, datum_m, np.nan_to_num(extrapolate_ring(height_m), copy=False), cell_index
    )


def _datum(reference: Reference) -> float:
    """Return a height close to the whole surface [m]: its rounded mean."""
    heights = (reference.elevation_m[rows] for rows in row_blocks(reference.grid.ny))
    total_m, count = np.sum([(np.nansum(block), np.isfinite(block).sum()) for block in heights], axis=0)
    return float(np.round(total_m / max(count, 1)))


def row_blocks(ny: int) -> Iterator[slice]:
    """Yield the rows of a grid in blocks of `BLOCK_ROWS`."""
    return (slice(top, min(top + BLOCK_ROWS, ny)) for top in range(0, ny, BLOCK_ROWS))


def extrapolate_ring(values: Floats32) -> Floats32:
    """Return a surface (ny, nx) extended by one ring of cells around the known ones.

    A new cell is the mean of the linear extrapolations of its neighbours, or of the neighbours where they
    have no slope: between the centres of a known cell and an unknown neighbour a shot still needs a height.
    """
    known = np.isfinite(values)
    adjacent = np.flatnonzero(ndimage.binary_dilation(known, np.ones((3, 3), bool)) & ~known)
    extended = values.copy()
    for part in np.array_split(adjacent, len(adjacent) // BLOCK_CELLS + 1):
        row, column = np.divmod(part, values.shape[1])
        extended[row, column] = _extrapolated(values, row, column)
    return extended


def _extrapolated(values: Floats32, row: Ints, column: Ints) -> Floats:
    """Return the values extrapolated to cells (n,) from the cells around them."""
    total, slope_count, sum_near, near_count = (np.zeros(len(row)) for _ in range(4))
    for row_step in (-1, 0, 1):
        for column_step in (-1, 0, 1):
            if row_step == column_step == 0:
                continue
            near = _value_at(values, row + row_step, column + column_step)
            far = _value_at(values, row + 2 * row_step, column + 2 * column_step)
            has_slope, is_known = np.isfinite(near + far), np.isfinite(near)
            total += np.where(has_slope, 2 * near - far, 0)
            slope_count += has_slope
            sum_near += np.where(is_known, near, 0)
            near_count += is_known
    return np.where(slope_count > 0, total / np.maximum(slope_count, 1), sum_near / np.maximum(near_count, 1))


def _value_at(values: Floats32, row: Ints, column: Ints) -> Floats:
    ny, nx = values.shape
    inside = (row >= 0) & (row < ny) & (column >= 0) & (column < nx)
    value = values[np.clip(row, 0, ny - 1), np.clip(column, 0, nx - 1)].astype(np.float64)
    return np.where(inside, value, np.nan)
