"""Uncertainty of a scan from several positions: of its shots, and of the positions against each other."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from station.quantities import Reals
from station.science.geometry.observation import Observation, Points
from station.science.gridding.reference_cells import CellClass
from station.science.uncertainty import shot_noise
from station.science.uncertainty.jacobian import height_jacobian
from station.science.uncertainty.parameters import GLOBAL

if TYPE_CHECKING:
    from station.quantities import Floats, Ints, Ints32, ScanGeometry, SharedParameters, Viewpoint
    from station.science.gridding.gridder import Gridder
    from station.science.gridding.viewing_geometry import ViewingGeometry
    from station.science.uncertainty.jacobian import HeightJacobian

OWN = slice([name for name, _ in GLOBAL].index("range_bias") + 1)  # parameters that each position has itself
Offsets = tuple[Reals, Reals, Reals]
Observations = tuple[Reals, Reals, Reals]  # design (7 k, n), residuals [m], variance of other errors [m²]
OUTLIER_SIGMAS = 3.0  # of a residual, at which it counts by half
BLOCK_CELLS = 10  # rows and columns of a block whose cells are seen alike
MAX_SAMPLED_CELLS = 100_000  # of more cells a sample tells the shares of the positions


def mean_shot_variance(
    shares: Floats,
    points_m: Points,
    gradient: tuple[Floats, Floats],
    viewpoints: Sequence[Viewpoint],
    *,
    published: bool,
) -> Floats:
    """Return the random variance of a shot's height in cells (n,), as the mean over all of their shots [m²].

    `shares` (k, n) are those of the viewpoints in the points of each cell. Source: equations.md, 6.14.
    """
    variance_m2 = np.zeros(len(points_m[0]))
    for share, viewpoint in zip(shares, viewpoints, strict=True):
        seen = np.flatnonzero(share > 0)
        x_m, y_m, z_m, east, north = (values[seen] for values in (*points_m, *gradient))
        observation = Observation.from_points((x_m, y_m, z_m), viewpoint.position_m, east, north)
        variance_m2[seen] += share[seen] * shot_noise.height_variance(
            observation, viewpoint.scanner, published=published
        )
    return variance_m2


def seen_from_viewpoints(
    viewing: ViewingGeometry, gridder: Gridder, scan_geometry: ScanGeometry
) -> ViewingGeometry:
    """Return a viewing geometry with the variances of the shots of a gridded scan.

    They are those of its viewpoints; without any, the geometry is returned as it is.
    """
    if not scan_geometry.viewpoints:
        return viewing
    shot_m2, point_m2 = (np.array(viewing.cells[name][:]) for name in ("shot_m2", "point_variance_m2"))
    grid, factor = viewing.grid, np.asarray(viewing.reference.variance_factor).reshape(-1)
    for first, sector in viewing.sectors():
        cells = slice(first, first + len(sector))
        row, column = grid.row_and_column(sector.cell)
        mean_m2 = mean_shot_variance(
            gridder.viewpoint_shares(np.arange(cells.start, cells.stop, dtype=np.int32)),
            (grid.x_m[column], grid.y_m[row], sector.height_m.astype(np.float64) + viewing.datum_m),
            (sector.east_gradient.astype(np.float64), sector.north_gradient.astype(np.float64)),
            scan_geometry.viewpoints,
            published=scan_geometry.published_budget,
        )
        scale = 1.0 if scan_geometry.published_budget else factor.take(sector.cell)
        point_m2[cells] += (mean_m2 - shot_m2[cells]) * scale
        shot_m2[cells] = mean_m2
    return replace(viewing, cells={**viewing.cells, "shot_m2": shot_m2, "point_variance_m2": point_m2})


@dataclass(frozen=True)
class PositionErrors:
    """Errors of the positions of a gridded scan against each other, after an adjustment as one cloud.

    `variance` (k, 7) is that of tilt, heading, translation and range bias of each position, in blocks of
    cells, and `local_variance` that between the cells of a block. `baseline_m` (k, 3) is the offset of a
    position from that of the adjustment, `adjusted_share` (k,) its mean share in the adjusted cells and
    `local_share` (k, by, bx) that in the cells of a block.
    """

    gridder: Gridder
    variance: Floats
    local_variance: Floats
    baseline_m: Floats
    adjusted_share: Floats
    local_share: Floats

    def height_variances(
        self,
        cell_index: Ints | Ints32,
        cell: Ints | Ints32,
        jacobian: HeightJacobian,
        offset_m: Offsets,
    ) -> tuple[Reals, Reals]:
        """Return the variances of cells (n,) that cells around them share, and do not share [m²].

        `cell` is in the flattened grid. Jacobian and offset are those from the position of the adjustment.
        Source: equations.md, 6.13.
        """
        systematic_m2: Reals = np.zeros_like(jacobian.sight_tilt)
        random_m2: Reals = np.zeros_like(jacobian.sight_tilt)
        row, column = self.gridder.grid.row_and_column(cell.astype(np.int64))
        shares = self.gridder.viewpoint_shares(cell_index.astype(np.int32))
        local_shares = self.local_share[:, row // BLOCK_CELLS, column // BLOCK_CELLS]
        for position, (share, local) in enumerate(zip(shares, local_shares, strict=True)):
            effects2 = self._effects(position, jacobian, offset_m) ** 2
            apart = local - self.adjusted_share[position]
            systematic_m2 += apart**2 * (self.variance[position] @ effects2)
            random_m2 += (share - local) ** 2 * (self.local_variance[position] @ effects2)
        return systematic_m2, random_m2

    def _effects(self, position: int, jacobian: HeightJacobian, offset_m: Offsets) -> Reals:
        """Return the effects (7, n) of the parameters of a position on heights that it alone sees."""
        east_m, north_m, up_m = self.baseline_m[position]
        own_m = offset_m[0] - east_m, offset_m[1] - north_m, offset_m[2] - up_m
        east, north = jacobian.gradient
        return height_jacobian(jacobian.params, own_m, east, north, jacobian.knot_position).pose[OWN]

    def design(self, cell_index: Ints, jacobian: HeightJacobian, offset_m: Offsets) -> Reals:
        """Return the effects (7 k, n) of the parameters of all positions on the heights of cells (n,)."""
        shares = self.gridder.viewpoint_shares(cell_index.astype(np.int32)) - self.adjusted_share[:, None]
        return np.concatenate(
            [share * self._effects(number, jacobian, offset_m) for number, share in enumerate(shares)]
        )

    def variance_by(self, observations: Iterable[Observations]) -> Floats:
        """Return the variance (k, 7) of positions that residuals show: the second moment of their motion.

        Source: equations.md, 6.13.
        """
        count, prior = len(self.baseline_m), self.variance.ravel()
        normal, right = np.diag(1 / prior), np.zeros(len(prior))
        for design, residual_m, other_m2 in observations:
            size_m2 = other_m2 + prior @ design**2
            weighted = design / (other_m2 * (1 + residual_m**2 / (OUTLIER_SIGMAS**2 * size_m2)))
            normal += weighted @ design.T
            right += weighted @ residual_m
        covariance = np.linalg.inv(normal)
        estimate = covariance @ right
        moments = covariance + np.outer(estimate, estimate)
        moments = np.einsum("ipjp->pij", moments.reshape(count, -1, count, self.variance.shape[1]))
        apart = np.eye(count) - 1 / count  # from the mean of all
        return np.asarray(np.einsum("ki,pij,kj->kp", apart, moments, apart) * count / (count - 1))

    def scaled(self, factor: float) -> PositionErrors:
        """Return the errors with their variances multiplied by a factor."""
        return replace(self, variance=self.variance * factor, local_variance=self.local_variance * factor)

    def added_to(self, shared: SharedParameters, viewing: ViewingGeometry) -> SharedParameters:
        """Return shared parameters with these errors, as if all cells had the mean of their variances."""
        step = 1 + int(viewing.sector_bounds[-1]) // MAX_SAMPLED_CELLS
        own_m2 = common_m2 = 0.0
        mean_variance = self.variance.mean(axis=0)
        for first, whole in viewing.sectors():
            cell_index = np.arange(first, first + len(whole), step)
            cell_index = cell_index[self.gridder.count[cell_index] > 0]
            sector = whole.take(cell_index - first)
            jacobian = viewing.jacobian(sector)
            offset_m = viewing.offset_m(sector.cell, sector.height_m)
            own_m2 += float(self.height_variances(cell_index, sector.cell, jacobian, offset_m)[0].sum())
            common_m2 += float((mean_variance @ jacobian.pose[OWN] ** 2).sum())
        covariance = shared.covariance.copy()
        covariance[OWN, OWN] += np.diag(mean_variance) * (own_m2 / common_m2 if common_m2 else 0.0)
        return replace(shared, covariance=covariance)


def position_errors(
    gridder: Gridder, scan_geometry: ScanGeometry, viewing: ViewingGeometry, variance: Floats
) -> PositionErrors | None:
    """Return the errors of the positions of a gridded scan; None if it has only one.

    `variance` (n,) is that of each global parameter of a position.
    """
    if len(scan_geometry.viewpoints) < 2 or scan_geometry.position_m is None:
        return None
    adjusted = viewing.select(CellClass.STABLE)
    adjusted = adjusted[gridder.count[adjusted] > 0]
    if not len(adjusted):
        adjusted = np.flatnonzero(gridder.count[: gridder.reference_cells])
    adjusted = adjusted[:: 1 + len(adjusted) // MAX_SAMPLED_CELLS]
    positions_m = np.array([viewpoint.position_m for viewpoint in scan_geometry.viewpoints])
    return PositionErrors(
        gridder,
        np.tile(variance[OWN], (len(positions_m), 1)),
        np.tile(variance[OWN], (len(positions_m), 1)),
        positions_m - scan_geometry.position_m,
        gridder.viewpoint_shares(adjusted.astype(np.int32)).mean(axis=1),
        _local_shares(gridder, len(positions_m)),
    )


def _local_shares(gridder: Gridder, viewpoints: int) -> Floats:
    """Return the mean share of each viewpoint in the observed cells of each block (k, by, bx)."""
    grid = gridder.grid
    shape = -(-grid.ny // BLOCK_CELLS), -(-grid.nx // BLOCK_CELLS)
    share = np.zeros((viewpoints, *shape))
    for band in range(shape[0]):
        cell_index = gridder.cell_index[band * BLOCK_CELLS : (band + 1) * BLOCK_CELLS]
        row, column = np.nonzero(cell_index >= 0)
        indices = cell_index[row, column]
        observed = np.flatnonzero(gridder.count[indices] > 0)
        block = column[observed] // BLOCK_CELLS
        count = np.maximum(np.bincount(block, minlength=shape[1]), 1)
        for viewpoint, shares in enumerate(gridder.viewpoint_shares(indices[observed])):
            share[viewpoint, band] = np.bincount(block, shares, shape[1]) / count
    return share
