"""The volume between points and a surface below them, by raster and by mesh, and what makes it unsure.

A volume is linear in small errors of its points, so each of them has a gradient: by how much the volume grows
per metre that the point moves east, north and up. The area stays where it is while its points move. With that
gradient both answers are had: `independent_variance`, as published, and `variance`, with what points share.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import shapely
from scipy import ndimage
from scipy.spatial import Delaunay, QhullError

from station.quantities import Bools, Floats, Grid, Ints, Shared
from station.science.shared import (
    GLOBAL,
    Basis,
    Sensitivities,
    aggregate_variance,
    leans_between,
    line_variances,
    sensitivities,
)
from station.science.terrain import Ground

AROUND = np.ones((3, 3), np.bool_)  # a cell and its neighbours: triangles reach over the edge of an area

FLAT = 1e-12  # twice the area of a triangle, in cells, that is a line but for rounding


@dataclass(frozen=True)
class Volume:
    """A volume above a surface, over the part of an area that has points.

    `gradient_m2` (n, 3) is by how much it grows per metre each point moves; nought for points that are not
    used.
    """

    volume_m3: float
    area_m2: float
    gradient_m2: Floats


def raster(points_m: Floats, under: Ground, cells: Bools) -> Volume:
    """Volume between points (n, 3) and the surface under them, over the chosen cells that hold points.

    The mean height of a cell's points over the surface counts for the whole cell; so the terrain within a
    cell does no harm. Over a level surface it is as published.
    Source: Hartzell et al. (2015), Eq. 13, of residuals (EQUATIONS 6.5).
    """
    used, column, row = _placed(points_m, under, cells)
    height_m, east, north = _heights(points_m[used], column, row, under)
    cell = row.astype(np.int64) * under.grid.nx + column.astype(np.int64)
    _, place, count = np.unique(cell, return_inverse=True, return_counts=True)
    weight_m2 = under.grid.cell_m**2 / count[place]
    gradient_m2 = np.zeros(points_m.shape)
    gradient_m2[used] = weight_m2[:, None] * np.stack([-east, -north, np.ones_like(east)], axis=-1)
    return Volume(float(height_m @ weight_m2), len(count) * under.grid.cell_m**2, gradient_m2)


def mesh(points_m: Floats, under: Ground, cells: Bools) -> Volume:
    """Volume between the triangles that connect points (n, 3) and the surface under them, over chosen cells.

    Triangles are cut off at the edge of the cells. Raises ValueError where points span no triangle.
    Source: Hartzell et al. (2015), Eq. 16-19; the mesh is of heights over the surface (EQUATIONS 6.5).
    """
    used, column, row = _placed(points_m, under, ndimage.binary_dilation(cells, AROUND))
    height_m, east, north = _heights(points_m[used], column, row, under)
    corner, slope, area, share = _facets(np.stack([column, row], axis=-1), height_m, under.grid, cells)
    area_m2 = area * under.grid.cell_m**2
    gradient = _facet_gradient(corner, slope, area_m2[:, None] * share, len(height_m))
    gradient[:, 0] -= east * gradient[:, 2]
    gradient[:, 1] -= north * gradient[:, 2]
    gradient_m2 = np.zeros(points_m.shape)
    gradient_m2[used] = gradient
    return Volume(float(height_m @ gradient[:, 2]), float(area_m2.sum()), gradient_m2)


def _facet_gradient(corner: Ints, slope: Floats, weight_m2: Floats, count: int) -> Floats:
    """What a metre east, north and up of each of `count` points does to the volume under facets (count, 3).

    `corner` (t, 3) says which points a facet hangs on, `slope` (t, 2) how it rises, `weight_m2` (t, 3) how
    much of its area each corner carries. About a point that triangles enclose this is the sum of the paper's
    derivatives. At the edge of the mesh the paper's move the edge along: then the volume hangs on the level
    that heights count from, and a centimetre at the edge of a field at 3000 m is worth 30 m² of cliff.
    Source: Hartzell et al. (2015), Eq. 20, with an edge that stays.
    """
    gradient = np.zeros((count, 3))
    for k in range(3):
        np.add.at(gradient[:, 2], corner[:, k], weight_m2[:, k])
        for axis in range(2):
            np.add.at(gradient[:, axis], corner[:, k], -slope[:, axis] * weight_m2[:, k])
    return gradient


def _placed(points_m: Floats, under: Ground, cells: Bools) -> tuple[Bools, Floats, Floats]:
    """Tell which points (n,) lie in the cells and over known surface, and where these are, in cells."""
    grid = under.grid
    column = (points_m[:, 0] - grid.west_m) / grid.cell_m
    row = (grid.north_m - points_m[:, 1]) / grid.cell_m
    used = (column >= 0) & (column < grid.nx) & (row >= 0) & (row < grid.ny) & np.isfinite(points_m[:, 2])
    wanted = cells & under.known
    used[used] = wanted[row[used].astype(np.int64), column[used].astype(np.int64)]
    return used, column[used], row[used]


def _heights(points_m: Floats, column: Floats, row: Floats, under: Ground) -> tuple[Floats, Floats, Floats]:
    below_m, east, north = under.under(column, row)
    return points_m[:, 2] - below_m, east, north


def _facets(place: Floats, height_m: Floats, grid: Grid, cells: Bools) -> tuple[Ints, Floats, Floats, Floats]:
    """Triangulate points at `place` (n, 2) (columns and rows), cut at the edge of the cells.

    Returns for each piece the points it hangs on (t, 3), its rise per metre east and north (t, 2), its area
    in cells (t,), and the share that each of the three has in its mean height (t, 3).
    """
    try:
        corner = Delaunay(place).simplices.astype(np.int64)
    except (QhullError, ValueError) as error:
        raise ValueError(f"{len(place)} points in these cells span no triangle") from error
    one, two, three = np.moveaxis(place[corner], 1, 0)
    corner = corner[np.abs(_cross(two - one, three - one)) > FLAT]
    whole = _is_inside(place, corner, cells)
    cut, pieces = _cut(place, corner[~whole], cells)
    centre = np.concatenate([place[corner[whole]].mean(axis=1), pieces[:, :2]])
    at = np.concatenate([np.flatnonzero(whole), np.flatnonzero(~whole)[cut]])
    corner = corner[at]
    one, two, three = np.moveaxis(place[corner], 1, 0)
    twice = _cross(two - one, three - one)
    area = np.concatenate([np.abs(twice[: np.count_nonzero(whole)]) / 2, pieces[:, 2]])
    share = np.stack([_cross(two - centre, three - centre), _cross(three - centre, one - centre)], axis=-1)
    share = np.column_stack([share / twice[:, None], 1 - share.sum(axis=-1) / twice])
    first, second = (height_m[corner[:, k]] - height_m[corner[:, 0]] for k in (1, 2))
    rise = np.stack(
        [
            first * (three - one)[:, 1] - second * (two - one)[:, 1],
            first * (three - one)[:, 0] - second * (two - one)[:, 0],  # rows run south: two signs cancel
        ],
        axis=-1,
    )
    return corner, rise / (twice * grid.cell_m)[:, None], area, share


def _cross(one: Floats, two: Floats) -> Floats:
    return np.asarray(one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0])


def _is_inside(place: Floats, corner: Ints, cells: Bools) -> Bools:
    """Tell which triangles have nothing but chosen cells about them (t,)."""
    total = np.pad(np.cumsum(np.cumsum(cells, axis=0), axis=1), ((1, 0), (1, 0)))
    low, high = (reach(place[corner], axis=1).astype(np.int64) for reach in (np.min, np.max))
    high += 1
    inside = (
        total[high[:, 1], high[:, 0]]
        - total[low[:, 1], high[:, 0]]
        - total[high[:, 1], low[:, 0]]
        + total[low[:, 1], low[:, 0]]
    )
    return np.asarray(inside == np.prod(high - low, axis=1))


def _cut(place: Floats, corner: Ints, cells: Bools) -> tuple[Ints, Floats]:
    """Cut triangles with the rows of chosen cells: which triangle (k,), and column, row, area (k, 3)."""
    triangles = shapely.polygons(place[corner]) if len(corner) else np.empty(0, object)
    edge = np.diff(np.pad(cells, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    row, first = np.nonzero(edge == 1)
    _, behind = np.nonzero(edge == -1)
    runs = shapely.box(first, row, behind, row + 1)
    at, run = shapely.STRtree(runs).query(triangles, predicate="intersects")
    pieces = shapely.intersection(triangles[at], runs[run])
    area = shapely.area(pieces)
    real = area > 0
    centre = shapely.centroid(pieces[real])
    return at[real], np.stack([shapely.get_x(centre), shapely.get_y(centre), area[real]], axis=-1)


def independent_contributions(of: Volume, covariance_m2: Floats) -> Floats:
    """What each point (n,) adds to the variance of a volume [m⁶], were its errors (n, 3, 3) its own.

    Source: Hartzell et al. (2015), Eq. 21; over a level surface Eq. 12 and 14 for the raster.
    """
    return np.asarray(np.einsum("ni,nij,nj->n", of.gradient_m2, covariance_m2, of.gradient_m2))


def independent_variance(of: Volume, covariance_m2: Floats) -> float:
    """Variance of a volume as published [m⁶]: the errors (n, 3, 3) of each point its own, whatever they are.

    The paper calls it conservative to leave correlation out; for errors that points share it is the other
    way round: they add up. For that see `variance`.
    """
    return float(independent_contributions(of, covariance_m2).sum())


def felt_by(of: Volume, basis: Basis, offset_m: Floats) -> tuple[Bools, Sensitivities]:
    """Which points (n,) a volume hangs on, and the effect of shared parameters on it through each of these.

    `offset_m` (n, 3) is from the scanner. A point weighs `gradient_m2[:, 2]`, on a facet as steep as the rest
    of its gradient says.
    """
    used = of.gradient_m2[:, 2] != 0
    east, north = (-of.gradient_m2[used, axis] / of.gradient_m2[used, 2] for axis in (0, 1))
    x_m, y_m, z_m = offset_m[used].T
    return used, sensitivities(basis, (x_m, y_m, z_m), east, north)


def variance(of: Volume, covariance_m2: Floats, offset_m: Floats, basis: Basis, unknown: Shared) -> float:
    """Variance of a volume [m⁶]: each point's own errors (n, 3, 3), and those that all share.

    `offset_m` (n, 3) is from the scanner; `unknown` is on the parameters of `basis`.
    Source: EQUATIONS 6.2, for the gradient of `raster` or `mesh`.
    """
    used, felt = felt_by(of, basis, offset_m)
    weights = of.gradient_m2[used, 2]
    own_m2 = independent_contributions(of, covariance_m2)[used] / weights**2
    return aggregate_variance(weights, own_m2, felt, unknown)


def shared_contributions(
    weights: Floats, felt: Sensitivities, unknown: Shared, held: Floats | None = None
) -> Floats:
    """What each cell or point (n,) adds to the variance of a weighted sum of heights by what all share.

    With a² σ_r², its own, they sum up to `shared.aggregate_variance`. One below nought takes away from what
    others add, as on the other side of a tilt's axis, or as noise does that is in the estimate too (`held`).
    Source: EQUATIONS 6.2, term by term: a J C g.
    """
    if held is None:
        return weights * _shared_with(weights, felt, unknown)
    free_m2 = _shared_with(weights * (1 - held), felt, unknown)
    return weights * (free_m2 - held * _shared_with(weights, felt, unknown))


def common_contributions(
    weights: Floats, felt: tuple[Sensitivities, Sensitivities], common: Floats
) -> Floats:
    """What each cell (n,) adds to a sum's variance by the errors that two epochs have in common.

    `common` (p, p) is the covariance of the shared parameters of the one with those of the other, of which
    cells feel what is in `felt`. It goes off the variance of the difference.
    """
    one, other = felt
    there, back = common @ other.total(weights), common.T @ one.total(weights)
    return weights * (_effect(there, one) + _effect(back, other))


def _shared_with(weights: Floats, felt: Sensitivities, unknown: Shared) -> Floats:
    """Covariance (n,) of each height with a weighted sum of them, by what all share."""
    left = leans_between(felt.of).left
    own = left @ (line_variances(felt.of, unknown) * (felt.by_line(weights) @ left))
    return _effect(unknown.covariance @ felt.total(weights), felt) + felt.lean * own[felt.line]


def _effect(state: Floats, felt: Sensitivities) -> Floats:
    """Effect of shared parameters (p,) on heights (n,)."""
    of = felt.of
    lean, bend, aside = np.split(state[len(GLOBAL) :], [of.lean_count, of.lean_count + of.refraction_count])
    lean_before, lean_after, lean_share = felt.lean_knot()
    bend_before, bend_after, bend_share = felt.refraction_knot()
    return np.asarray(
        state[: len(GLOBAL)] @ felt.globals_
        + felt.lean * (lean[lean_before] * (1 - lean_share) + lean[lean_after] * lean_share)
        + felt.refraction * (bend[bend_before] * (1 - bend_share) + bend[bend_after] * bend_share)
        + felt.across * (aside[bend_before] * (1 - bend_share) + aside[bend_after] * bend_share)
    )


def net_variance(on_m6: float, off_m6: float) -> float:
    """Variance of the volume between two surfaces that share no error [m⁶].

    Source: Hartzell et al. (2015), Eq. 15.
    """
    return on_m6 + off_m6


def against_density(
    points_m: Floats, every: tuple[int, ...], measure: Callable[[Floats, Ints], tuple[Volume, float]]
) -> Floats:
    """Points per m² and one sigma of the volume [m³], (k, 2), with only each `every`-th point left.

    `measure` takes the points that are left and their places in the whole. The paper's sigma goes on falling
    with the root of the density; what points share stays.
    Source: Hartzell et al. (2015), Fig. 8.
    """
    told = []
    for step in every:
        kept = np.arange(0, len(points_m), step)
        volume, variance_m6 = measure(points_m[kept], kept)
        density = np.count_nonzero(volume.gradient_m2[:, 2]) / volume.area_m2
        told.append((density, np.sqrt(variance_m6)))
    return np.array(told)
