"""Slope, aspect and normals of a surface, and its height between the cells."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy import ndimage

from station.quantities import Bools, Floats, Floats32, Grid, Ints, Ints32, Reals, Reference

ALL = slice(None)
BAND_ROWS = 128  # looked at together: what a store chunk is high …
MARGIN_ROWS = 4  # … and the rows beside them that a smoothed gradient looks at, too
TOGETHER = 200_000  # cells
GRADIENT_CELLS = 1.5  # one sigma of the neighbourhood that a gradient is of
SQUARES_TOGETHER = 8_000  # cells of which each looks at the square around it
THERE: Final = "wrap"  # how to take what is known to be there: to make sure of it takes a third longer
NEXT_TO_NONE = 1e-3  # of the weight of a neighbourhood


def normal(slope_rad: Floats, aspect_rad: Floats) -> Floats:
    """Unit normal (n, 3) (east, north, up); aspect is the downslope direction, clockwise from north.

    Source: Voordendag et al. (2023), Eq. 14.
    """
    across = np.sin(slope_rad)
    return np.stack([np.sin(aspect_rad) * across, np.cos(aspect_rad) * across, np.cos(slope_rad)], axis=-1)


def smooth_gradient(
    elevation_m: Floats | Floats32, cell_m: float, cells: float = GRADIENT_CELLS, rows: slice = ALL
) -> tuple[Floats32, Floats32]:
    """Rise per metre eastward and northward (ny, nx) of a surface smoothed over `cells` (one sigma).

    NaN in the surface is passed over (normalised convolution of the differences); NaN where nothing is near.
    Of `rows` only, if they are told.
    """
    east, north = (np.full(elevation_m.shape, np.nan, np.float32) for _ in range(2))
    east[:, 1:-1] = (elevation_m[:, 2:] - elevation_m[:, :-2]) / (2 * cell_m)
    north[1:-1] = (elevation_m[:-2] - elevation_m[2:]) / (2 * cell_m)
    return smooth(east, cells, rows), smooth(north, cells, rows)


def gradient_in(
    elevation_m: Floats32, cell_m: float, row: Ints | Ints32, column: Ints | Ints32
) -> tuple[Floats32, Floats32]:
    """Return what `smooth_gradient` is in a few cells (n,), each from the square of cells around it.

    A cell takes as long as ten of a whole surface.
    """
    line = _gaussian(GRADIENT_CELLS)
    share, reach = np.outer(line, line).reshape(-1), len(line) // 2 + 1
    around_m = np.pad(elevation_m, reach, constant_values=np.nan)
    place = np.arange(2 * reach + 1)
    square = (place[:, None] * around_m.shape[1] + place)[..., None]
    first, inner = row * around_m.shape[1] + column, slice(1, -1)
    gradient = np.empty((2, len(first)), np.float32)
    for part in (slice(at, at + SQUARES_TOGETHER) for at in range(0, len(first), SQUARES_TOGETHER)):
        beside_m = around_m.reshape(-1).take(square + first[part], mode=THERE)
        gradient[0, part] = _mean_known(beside_m[inner, 2:] - beside_m[inner, :-2], share)
        gradient[1, part] = _mean_known(beside_m[:-2, inner] - beside_m[2:, inner], share)
    gradient /= 2 * cell_m
    return gradient[0], gradient[1]


def smooth(values: Floats | Floats32, cells: float, rows: slice = ALL) -> Floats32:
    """Values (ny, nx) under a Gaussian of `cells` (one sigma), NaN passed over; NaN where nothing is near.

    Of `rows` only, if they are told.
    """
    known = np.isfinite(values)
    weight = _under_gaussian(known.astype(np.float32), cells, rows)
    valued = np.where(known, values, np.float32(0)).astype(np.float32, copy=False)
    return _per_weight(_under_gaussian(valued, cells, rows), weight)


def _mean_known(values: Floats32, share: Floats32) -> Floats32:
    """Mean (n,) of what is known of values (k, k, n), by their shares (k²,); NaN where nothing is near.

    With `einsum`, for a product of BLAS depends in its last digit on how many there are.
    """
    values = values.reshape(len(share), -1)
    known = values == values  # noqa: PLR0124 - but for NaN
    weight = np.einsum("i,ij->j", share, known.astype(np.float32))
    bits = values.view(np.int32)
    bits &= np.negative(known.view(np.int8), dtype=np.int32)  # NaN to nought, in half the time of `where`
    return _per_weight(np.einsum("i,ij->j", share, values), weight)


def _per_weight(total: Floats32, weight: Floats32) -> Floats32:
    """Divide sums by the weight of what is known in them, both of which are used up; NaN for next to none."""
    total[weight <= NEXT_TO_NONE] = np.nan
    total /= np.maximum(weight, NEXT_TO_NONE, out=weight)
    return total


def _gaussian(cells: float) -> Floats32:
    """Shares (2 n + 1,) of cells side by side under a Gaussian of `cells` (one sigma), cut off at two."""
    reach = int(2 * cells + 0.5)
    share = np.exp(-0.5 * (np.arange(-reach, reach + 1) / cells) ** 2)
    return np.asarray((share / share.sum()).astype(np.float32))


def _under_gaussian(values: Floats32, cells: float, rows: slice) -> Floats32:
    """Rows of values (ny, nx) under a Gaussian; beyond the border is nought.

    By whole arrays: `ndimage.gaussian_filter` goes through them line by line, which takes twice as long.
    """
    share = _gaussian(cells)
    (start, stop, step), wide = rows.indices(len(values)), values.shape[1]
    around = np.pad(values, len(share) // 2)
    down = _weighted([around[start + at : stop + at : step] for at in range(len(share))], share)
    return _weighted([down[:, at : at + wide] for at in range(len(share))], share)


def _weighted(beside: list[Floats32], share: Floats32) -> Floats32:
    """Add up what lies side by side, by shares that are the same to both sides of the middle."""
    middle = len(share) // 2
    total: Floats32 = beside[middle] * share[middle]
    both = np.empty_like(total)
    for before, after in zip(range(middle), range(len(share) - 1, middle, -1), strict=True):
        np.add(beside[before], beside[after], out=both)
        both *= share[before]
        total += both
    return total


@dataclass(frozen=True)
class Ground:
    """The reference surface as shots look it up: bilinear between nodes at the cell centres.

    `rise_m` (ny, nx) is height above `datum_m`, extended by one ring of cells beyond what is `known`. Known
    cells have a `number` (ny, nx), from nought, all others -1.
    """

    grid: Grid
    datum_m: float
    rise_m: Floats32
    number: Ints32

    @property
    def known(self) -> Bools:
        """Which cells (ny, nx) are known."""
        return np.asarray(self.number >= 0)

    def height(self, column: Floats, row: Floats) -> Floats:
        """Height of the surface below points (n,) [m], as `under`.

        What lies between the nodes is a metre or two, which single precision holds to a micrometre.
        """
        nw, ne, sw, se, u, v = self._corners(column, row)
        east, south = ne - nw, sw - nw
        u, v = u.astype(np.float32), v.astype(np.float32)
        between_m = east * u + (south + (se - sw - east) * u) * v
        # Each made double first: to add what is of two kinds takes twice as long.
        return nw.astype(np.float64) + self.datum_m + between_m.astype(np.float64)

    def under(self, column: Floats, row: Floats) -> tuple[Floats, Floats, Floats]:
        """Height [m] and rise per metre eastward and northward below points (n,).

        Points are in cells from the north-west corner of the grid; the answer means something where the
        point's own cell is known.
        """
        *rises, u, v = self._corners(column, row)
        nw, ne, sw, se = (rise.astype(np.float64) for rise in rises)
        north_side, south_side = nw + (ne - nw) * u, sw + (se - sw) * u
        east = ((ne - nw) * (1 - v) + (se - sw) * v) / self.grid.cell_m
        north = (north_side - south_side) / self.grid.cell_m
        return self.datum_m + north_side + (south_side - north_side) * v, east, north

    def cell_means(self, rows: slice) -> Floats:
        """Mean height over each cell (r, nx) of some rows [m]."""
        around = _around(rows)
        return self.datum_m + cell_means(self.rise_m[around])[rows.start - around.start :][: _height(rows)]

    def _corners(self, column: Floats, row: Floats) -> tuple[Reals, ...]:
        """Rise of the nodes nw, ne, sw, se of points (n,); how far east and south of nw they are [cells]."""
        nx, ny = self.grid.nx, self.grid.ny
        east, south = column - 0.5, row - 0.5
        # Half a cell within the border of the grid the last slope goes on; -0.5 counts as nought.
        left = np.minimum(east.astype(np.int32), np.int32(max(nx - 2, 0)))
        top = np.minimum(south.astype(np.int32), np.int32(max(ny - 2, 0)))
        first = (top * np.int32(nx) + left).astype(np.intp)
        right, below = min(nx - 1, 1), min(ny - 1, 1) * nx
        rises = [
            self.rise_m.ravel()[there:].take(first, mode=THERE) for there in (0, right, below, below + right)
        ]
        return (*rises, east - left.astype(np.float64), south - top.astype(np.float64))


def cell_means(nodes: Floats | Floats32) -> Floats:
    """Mean over each cell (ny, nx) of the surface that is bilinear between the nodes at cell centres."""
    around = np.pad(np.asarray(nodes, dtype=np.float64), 1, mode="reflect", reflect_type="odd")
    rows = (around[:-2] + 6 * around[1:-1] + around[2:]) / 8
    return np.asarray((rows[:, :-2] + 6 * rows[:, 1:-1] + rows[:, 2:]) / 8)


def _around(rows: slice) -> slice:
    return slice(max(rows.start - 1, 0), rows.stop + 1)


def _height(rows: slice) -> int:
    return int(rows.stop - rows.start)


def nodes_for(means: Floats) -> Floats:
    """Nodes (ny, nx) whose bilinear surface has the given cell means, to second order in its curvature.

    The means themselves as nodes would show a change where there is none: 12 mm for 10 m cells on a slope
    whose radius of curvature is 1 km. Beside a gap a node is the mean.
    """
    nodes = 2 * means - cell_means(means)
    return np.where(np.isfinite(nodes), nodes, means)


def ground(reference: Reference) -> Ground:
    """Prepare a master surface for looking up, its known cells numbered row by row."""
    rise_m = np.empty(reference.grid.shape, np.float32)
    number = np.full(reference.grid.shape, -1, np.int32)
    datum_m, first = _datum(reference), 0
    for rows in bands(reference.grid.ny):
        rise_m[rows] = reference.elevation_m[rows] - datum_m
        known = np.isfinite(rise_m[rows])
        end = first + int(np.count_nonzero(known))
        number[rows][known] = np.arange(first, end)
        first = end
    return Ground(reference.grid, datum_m, np.nan_to_num(extend(rise_m), copy=False), number)


def _datum(reference: Reference) -> float:
    """Return a height that all of a surface is near."""
    heights = (reference.elevation_m[rows] for rows in bands(reference.grid.ny))
    total_m, count = np.sum([(np.nansum(one), np.isfinite(one).sum()) for one in heights], axis=0)
    return float(np.round(total_m / max(count, 1)))


def bands(ny: int) -> Iterator[slice]:
    """Give the rows of a grid, as many at a time as are looked at together."""
    return (slice(top, min(top + BAND_ROWS, ny)) for top in range(0, ny, BAND_ROWS))


def extend(values: Floats32) -> Floats32:
    """Return a surface (ny, nx) with one more ring of cells around what is known.

    Each is the mean of what its neighbours' slopes lead to, or of the neighbours where they have no slope:
    between the centres of a known cell and its unknown neighbour a shot still needs a height.
    """
    known = np.isfinite(values)
    beside = np.flatnonzero(ndimage.binary_dilation(known, np.ones((3, 3), bool)) & ~known)
    extended = values.copy()
    for part in np.array_split(beside, len(beside) // TOGETHER + 1):
        row, column = np.divmod(part, values.shape[1])
        extended[row, column] = _continued(values, row, column)
    return extended


def _continued(values: Floats32, row: Ints, column: Ints) -> Floats:
    """Return what the cells around lead to in others (n,)."""
    total, sloped, flat, near = (np.zeros(len(row)) for _ in range(4))
    for down in (-1, 0, 1):
        for right in (-1, 0, 1):
            if down == right == 0:
                continue
            first = _at(values, row + down, column + right)
            second = _at(values, row + 2 * down, column + 2 * right)
            has_slope, has_one = np.isfinite(first + second), np.isfinite(first)
            total += np.where(has_slope, 2 * first - second, 0)
            sloped += has_slope
            flat += np.where(has_one, first, 0)
            near += has_one
    return np.where(sloped > 0, total / np.maximum(sloped, 1), flat / np.maximum(near, 1))


def _at(values: Floats32, row: Ints, column: Ints) -> Floats:
    ny, nx = values.shape
    inside = (row >= 0) & (row < ny) & (column >= 0) & (column < nx)
    found = values[np.clip(row, 0, ny - 1), np.clip(column, 0, nx - 1)].astype(np.float64)
    return np.where(inside, found, np.nan)
