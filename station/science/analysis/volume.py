"""Volume between points and the surface below them, by raster and by mesh, and its variance.

A volume is linear in small errors of its points, so each point has a gradient: the growth of the volume per
metre that the point moves east, north and up, with the area fixed. Both variances use that gradient:
`independent_variance`, as published, and `variance`, with the shared errors.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import shapely
from scipy import ndimage
from scipy.spatial import Delaunay, QhullError

from station.quantities import Bools, Floats, Grid, Ints, SharedParameters
from station.science.geometry.terrain import BilinearSurface
from station.science.uncertainty.jacobian import HeightJacobian, height_jacobian, line_tilt_variance
from station.science.uncertainty.parameters import ParameterLayout, knot_interpolation
from station.science.uncertainty.propagation import aggregate_variance

NEIGHBOURHOOD = np.ones((3, 3), np.bool_)  # a cell and its neighbours: triangles extend beyond an area
MIN_TWICE_AREA = 1e-12  # twice the area of a triangle [cells]; below, it is a line


@dataclass(frozen=True)
class Volume:
    """Volume above a surface, over the part of an area that has points.

    `gradient_m2` (n, 3) is its growth per metre of motion of each point; zero for points that are not used.
    """

    volume_m3: float
    area_m2: float
    gradient_m2: Floats


def raster_volume(points_m: Floats, surface: BilinearSurface, cells: Bools) -> Volume:
    """Volume between points (n, 3) and the surface below them, over the chosen cells that hold points.

    The mean height of a cell's points over the surface stands for the whole cell, so terrain within a cell
    does no harm. Over a level surface the result is as published.
    Source: Hartzell et al. (2015), Eq. 13, of residuals (equations.md, 6.5).
    """
    used, column, row = _points_in_cells(points_m, surface, cells)
    height_m, east, north = _residual_heights(points_m[used], column, row, surface)
    cell = row.astype(np.int64) * surface.grid.nx + column.astype(np.int64)
    _, cell_index, count = np.unique(cell, return_inverse=True, return_counts=True)
    weight_m2 = surface.grid.cell_m**2 / count[cell_index]
    gradient_m2 = np.zeros(points_m.shape)
    gradient_m2[used] = weight_m2[:, None] * np.stack([-east, -north, np.ones_like(east)], axis=-1)
    return Volume(float(height_m @ weight_m2), len(count) * surface.grid.cell_m**2, gradient_m2)


def mesh_volume(points_m: Floats, surface: BilinearSurface, cells: Bools) -> Volume:
    """Volume between a triangulation of points (n, 3) and the surface below them, over the chosen cells.

    Triangles are clipped at the edge of the cells. Raises ValueError if the points span no triangle.
    Source: Hartzell et al. (2015), Eq. 16-19; the mesh is of heights over the surface (equations.md, 6.5).
    """
    used, column, row = _points_in_cells(points_m, surface, ndimage.binary_dilation(cells, NEIGHBOURHOOD))
    height_m, east, north = _residual_heights(points_m[used], column, row, surface)
    corner, slope, area, share = _clipped_facets(
        np.stack([column, row], axis=-1), height_m, surface.grid, cells
    )
    area_m2 = area * surface.grid.cell_m**2
    gradient = _facet_gradient(corner, slope, area_m2[:, None] * share, len(height_m))
    gradient[:, 0] -= east * gradient[:, 2]
    gradient[:, 1] -= north * gradient[:, 2]
    gradient_m2 = np.zeros(points_m.shape)
    gradient_m2[used] = gradient
    return Volume(float(height_m @ gradient[:, 2]), float(area_m2.sum()), gradient_m2)


def _facet_gradient(corner: Ints, slope: Floats, weight_m2: Floats, count: int) -> Floats:
    """Gradient of the volume under facets per metre east, north and up of each of `count` points (count, 3).

    `corner` (t, 3) are the indices of the points of a facet, `slope` (t, 2) its rise, `weight_m2` (t, 3) the
    area carried by each corner. For a point enclosed by triangles this is the sum of the paper's derivatives.
    At the edge of the mesh the paper's derivatives move the edge along: the volume then depends on the level
    that heights count from, and a centimetre at the edge of a field at 3000 m is worth 30 m² of cliff.
    Source: Hartzell et al. (2015), Eq. 20, with a fixed edge.
    """
    gradient = np.zeros((count, 3))
    for k in range(3):
        np.add.at(gradient[:, 2], corner[:, k], weight_m2[:, k])
        for axis in range(2):
            np.add.at(gradient[:, axis], corner[:, k], -slope[:, axis] * weight_m2[:, k])
    return gradient


def _points_in_cells(
    points_m: Floats, surface: BilinearSurface, cells: Bools
) -> tuple[Bools, Floats, Floats]:
    """Return a mask of points (n,) in the cells and over known surface, and their column and row [cells]."""
    grid = surface.grid
    column = (points_m[:, 0] - grid.west_m) / grid.cell_m
    row = (grid.north_m - points_m[:, 1]) / grid.cell_m
    used = (column >= 0) & (column < grid.nx) & (row >= 0) & (row < grid.ny) & np.isfinite(points_m[:, 2])
    usable = cells & surface.known
    used[used] = usable[row[used].astype(np.int64), column[used].astype(np.int64)]
    return used, column[used], row[used]


def _residual_heights(
    points_m: Floats, column: Floats, row: Floats, surface: BilinearSurface
) -> tuple[Floats, Floats, Floats]:
    surface_m, east, north = surface.height_and_gradient(column, row)
    return points_m[:, 2] - surface_m, east, north


def _clipped_facets(
    position: Floats, height_m: Floats, grid: Grid, cells: Bools
) -> tuple[Ints, Floats, Floats, Floats]:
    """Triangulate points at `position` (n, 2) (columns and rows), clipped at the edge of the cells.

    Returns for each piece the indices of its points (t, 3), its rise per metre east and north (t, 2), its
    area in cells (t,), and the share of each point in its mean height (t, 3).
    """
    try:
        corner = Delaunay(position).simplices.astype(np.int64)
    except (QhullError, ValueError) as error:
        raise ValueError(f"{len(position)} points in these cells span no triangle") from error
    a, b, c = np.moveaxis(position[corner], 1, 0)
    corner = corner[np.abs(_cross(b - a, c - a)) > MIN_TWICE_AREA]
    whole = _is_inside(position, corner, cells)
    clipped, pieces = _clip(position, corner[~whole], cells)
    centre = np.concatenate([position[corner[whole]].mean(axis=1), pieces[:, :2]])
    triangle = np.concatenate([np.flatnonzero(whole), np.flatnonzero(~whole)[clipped]])
    corner = corner[triangle]
    a, b, c = np.moveaxis(position[corner], 1, 0)
    twice_area = _cross(b - a, c - a)
    area = np.concatenate([np.abs(twice_area[: np.count_nonzero(whole)]) / 2, pieces[:, 2]])
    share = np.stack([_cross(b - centre, c - centre), _cross(c - centre, a - centre)], axis=-1)
    share = np.column_stack([share / twice_area[:, None], 1 - share.sum(axis=-1) / twice_area])
    first, second = (height_m[corner[:, k]] - height_m[corner[:, 0]] for k in (1, 2))
    rise = np.stack(
        [
            first * (c - a)[:, 1] - second * (b - a)[:, 1],
            first * (c - a)[:, 0] - second * (b - a)[:, 0],  # rows run south: two signs cancel
        ],
        axis=-1,
    )
    return corner, rise / (twice_area * grid.cell_m)[:, None], area, share


def _cross(a: Floats, b: Floats) -> Floats:
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def _is_inside(position: Floats, corner: Ints, cells: Bools) -> Bools:
    """Return True for triangles (t,) whose bounding box holds chosen cells only."""
    total = np.pad(np.cumsum(np.cumsum(cells, axis=0), axis=1), ((1, 0), (1, 0)))
    low, high = (extreme(position[corner], axis=1).astype(np.int64) for extreme in (np.min, np.max))
    high += 1
    inside = (
        total[high[:, 1], high[:, 0]]
        - total[low[:, 1], high[:, 0]]
        - total[high[:, 1], low[:, 0]]
        + total[low[:, 1], low[:, 0]]
    )
    return np.asarray(inside == np.prod(high - low, axis=1))


def _clip(position: Floats, corner: Ints, cells: Bools) -> tuple[Ints, Floats]:
    """Clip triangles at rows of chosen cells; return the triangle (k,) and column, row and area (k, 3)."""
    triangles = shapely.polygons(position[corner]) if len(corner) else np.empty(0, object)
    edge = np.diff(np.pad(cells, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    row, first = np.nonzero(edge == 1)
    _, end = np.nonzero(edge == -1)
    runs = shapely.box(first, row, end, row + 1)
    triangle, run = shapely.STRtree(runs).query(triangles, predicate="intersects")
    pieces = shapely.intersection(triangles[triangle], runs[run])
    area = shapely.area(pieces)
    real = area > 0
    centre = shapely.centroid(pieces[real])
    return triangle[real], np.stack([shapely.get_x(centre), shapely.get_y(centre), area[real]], axis=-1)


def independent_contributions(volume: Volume, covariance_m2: Floats) -> Floats:
    """Contribution of each point (n,) to the variance of a volume [m⁶] if errors (n, 3, 3) are independent.

    Source: Hartzell et al. (2015), Eq. 21; over a level surface Eq. 12 and 14 for the raster.
    """
    return np.asarray(np.einsum("ni,nij,nj->n", volume.gradient_m2, covariance_m2, volume.gradient_m2))


def independent_variance(volume: Volume, covariance_m2: Floats) -> float:
    """Variance of a volume as published [m⁶]: all point errors (n, 3, 3) taken as independent.

    The paper calls it conservative to neglect correlation; errors common to the points do the opposite: they
    add up. For those see `variance`.
    """
    return float(independent_contributions(volume, covariance_m2).sum())


def volume_jacobian(
    volume: Volume, params: ParameterLayout, offset_m: Floats
) -> tuple[Bools, HeightJacobian]:
    """Return a mask of the points (n,) with weight in a volume, and the Jacobian of their heights.

    `offset_m` (n, 3) is from the scanner. A point's weight is `gradient_m2[:, 2]`; the other components of
    its gradient give the slope of its facet.
    """
    used = volume.gradient_m2[:, 2] != 0
    east, north = (-volume.gradient_m2[used, axis] / volume.gradient_m2[used, 2] for axis in (0, 1))
    x_m, y_m, z_m = offset_m[used].T
    return used, height_jacobian(params, (x_m, y_m, z_m), east, north)


def variance(
    volume: Volume, covariance_m2: Floats, offset_m: Floats, params: ParameterLayout, shared: SharedParameters
) -> float:
    """Variance of a volume [m⁶] from independent point errors (n, 3, 3) and shared errors.

    `offset_m` (n, 3) is from the scanner; `shared` has the parameters of `params`.
    Source: equations.md, 6.2, for the gradient of `raster_volume` or `mesh_volume`.
    """
    used, jacobian = volume_jacobian(volume, params, offset_m)
    weights = volume.gradient_m2[used, 2]
    independent_m2 = independent_contributions(volume, covariance_m2)[used] / weights**2
    return aggregate_variance(weights, independent_m2, jacobian, shared)


def shared_contributions(
    weights: Floats, jacobian: HeightJacobian, shared: SharedParameters, leverage: Floats | None = None
) -> Floats:
    """Contribution of each cell or point (n,) to the variance of a weighted sum by the shared errors.

    With the random part a² σ_r² they sum to `propagation.aggregate_variance`. A negative contribution reduces
    that of others, as on the other side of a tilt axis, or as noise absorbed by the estimate does
    (`leverage`).
    Source: equations.md, 6.2, term by term: a J C g.
    """
    if leverage is None:
        return weights * _shared_covariance(weights, jacobian, shared)
    free_m2 = _shared_covariance(weights * (1 - leverage), jacobian, shared)
    return weights * (free_m2 - leverage * _shared_covariance(weights, jacobian, shared))


def common_contributions(
    weights: Floats, jacobians: tuple[HeightJacobian, HeightJacobian], common: Floats
) -> Floats:
    """Contribution of each cell (n,) to the covariance of the sums of two epochs by their common errors.

    `common` (p, p) is the cross-covariance of the shared parameters of the two epochs, `jacobians` their
    Jacobians. It reduces the variance of the difference.
    """
    first, second = jacobians
    on_first, on_second = common @ second.aggregate(weights), common.T @ first.aggregate(weights)
    return np.asarray(weights * (first.effect(on_first) + second.effect(on_second)))


def _shared_covariance(weights: Floats, jacobian: HeightJacobian, shared: SharedParameters) -> Floats:
    """Covariance (n,) of each height with a weighted sum of heights, by the shared errors."""
    residual_projector = knot_interpolation(jacobian.params).residual_projector
    line_covariance = residual_projector @ (
        line_tilt_variance(jacobian.params, shared)
        * (jacobian.aggregate_by_line(weights) @ residual_projector)
    )
    shared_covariance = jacobian.effect(shared.covariance @ jacobian.aggregate(weights))
    return np.asarray(shared_covariance + jacobian.sight_tilt * line_covariance[jacobian.line])


def difference_variance(on_m6: float, off_m6: float) -> float:
    """Variance of the volume between two surfaces with independent errors [m⁶].

    Source: Hartzell et al. (2015), Eq. 15.
    """
    return on_m6 + off_m6


def density_dependence(
    points_m: Floats, steps: tuple[int, ...], measure: Callable[[Floats, Ints], tuple[Volume, float]]
) -> Floats:
    """Points per m² and sigma of the volume [m³], (k, 2), with only each n-th point, for n in `steps`.

    `measure` takes the kept points and their indices. The paper's sigma falls with the root of the density
    without limit; the shared errors stay.
    Source: Hartzell et al. (2015), Fig. 8.
    """
    rows = []
    for step in steps:
        kept = np.arange(0, len(points_m), step)
        volume, variance_m6 = measure(points_m[kept], kept)
        density = np.count_nonzero(volume.gradient_m2[:, 2]) / volume.area_m2
        rows.append((density, np.sqrt(variance_m6)))
    return np.array(rows)
