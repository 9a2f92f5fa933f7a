"""What the residuals of an adjusted scan tell about its errors, from a sample of its cells."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from station.processing.pipeline import ScanAdjustment
from station.quantities import Ints, Reals, SharedParameters
from station.science.gridding.gridder import CellSums, Gridder
from station.science.gridding.reference_cells import CellClass
from station.science.gridding.significance import supported_variance
from station.science.gridding.viewing_geometry import AzimuthSector, ViewingGeometry
from station.science.gridding.viewpoints import Observations, Offsets, PositionErrors
from station.science.uncertainty.jacobian import HeightJacobian
from station.science.uncertainty.variance_factors import (
    UNIT_FACTORS,
    Residuals,
    VarianceFactors,
    class_in_scan,
    estimate_variance_factors,
)

MAX_RESIDUALS = 100_000  # of more cells a sample tells the variance factors
GROUP_M = 40.0  # range extent of cells through which a plane is laid; in azimuth one knot of the tilt
MAX_GROUPS = 1000  # by range


@dataclass(frozen=True)
class SampledCells:
    """Observed cells (n,) of a sector, and their residuals after the adjustment [m]."""

    cell_index: Ints
    sector: AzimuthSector
    sums: CellSums
    jacobian: HeightJacobian
    offset_m: Offsets
    residual_m: Reals

    @property
    def group(self) -> Ints:
        """Number of the cells of about the same azimuth and range to which each belongs."""
        range_m = self.jacobian.params.plane.horizontal_m(self.offset_m)
        range_bin = (range_m / GROUP_M).astype(np.int64)
        return np.asarray(range_bin + self.jacobian.knot_position.astype(np.int64) * MAX_GROUPS)

    @cached_property
    def point_m2(self) -> Reals:
        """Random variance of a point, by model or by the scatter in its cell."""
        return supported_variance(
            self.sector.point_variance_m2, self.sums.standard_deviation(), self.sums.count
        )


def sampled_cells(
    gridder: Gridder, viewing: ViewingGeometry, adjustment: ScanAdjustment
) -> Iterator[SampledCells]:
    """Yield the observed cells of the sectors of a reference, of very many a sample."""
    step = 1 + int(viewing.sector_bounds[-1]) // MAX_RESIDUALS
    for first, whole in viewing.sectors():
        cell_index = np.arange(first, first + len(whole), step)
        cell_index = cell_index[gridder.count[cell_index] > 0]
        if not len(cell_index):
            continue
        sector, sums = whole.take(cell_index - first), gridder.take(cell_index.astype(np.int32))
        jacobian, offset_m = viewing.jacobian(sector), viewing.offset_m(sector.cell, sector.height_m)
        residual_m = sums.mean_residual() - sector.mean_residual_m - adjustment.correction(jacobian)
        yield SampledCells(cell_index, sector, sums, jacobian, offset_m, residual_m)


def with_motion_seen(
    positions: PositionErrors,
    gridder: Gridder,
    viewing: ViewingGeometry,
    adjustment: ScanAdjustment,
    posterior: SharedParameters,
) -> PositionErrors:
    """Return the errors of positions, as large as residuals show that the positions moved.

    Cells of a group show it within blocks, whether the ground changed or not; means of stable ground else.
    """

    def observations() -> Iterator[tuple[SampledCells, Reals, Reals]]:
        for cells in sampled_cells(gridder, viewing, adjustment):
            design = positions.design(cells.cell_index, cells.jacobian, cells.offset_m)
            random_m2 = cells.point_m2 / cells.sums.count + cells.sector.reference_variance_m2
            yield cells, np.vstack([design, cells.residual_m]), np.asarray(random_m2)

    def within_groups() -> Iterator[Observations]:
        for cells, columns, random_m2 in observations():
            *design, residual_m = columns - _group_means(columns, cells.group, at_cells=True)
            yield np.array(design), residual_m, random_m2

    def on_stable_ground() -> Iterator[Observations]:
        for cells, columns, random_m2 in observations():
            stable = np.flatnonzero(cells.sector.in_class(CellClass.STABLE))
            if len(stable):
                other_m2 = random_m2 + cells.jacobian.variance(posterior)
                means = _group_means(np.vstack([columns, other_m2])[:, stable], cells.group[stable])
                yield means[:-2], means[-2], means[-1]

    return replace(
        positions,
        variance=positions.variance_by(on_stable_ground()),
        local_variance=positions.variance_by(within_groups()),
    )


def _group_means(columns: Reals, group: Ints, *, at_cells: bool = False) -> Reals:
    """Return the means (m, g) of columns (m, n) over the cells of each group; (m, n) with `at_cells`."""
    _, index = np.unique(group, return_inverse=True)
    means = np.stack([np.bincount(index, column) for column in columns]) / np.bincount(index)
    return means[:, index] if at_cells else means


def variance_factors(
    gridder: Gridder,
    viewing: ViewingGeometry,
    adjustment: ScanAdjustment,
    posterior: SharedParameters,
    positions: PositionErrors | None = None,
) -> VarianceFactors:
    """Return the variance factors of an adjusted scan."""
    snow, response, parts = adjustment.under_snow, adjustment.state.stable_response, []
    for cells in sampled_cells(gridder, viewing, adjustment):
        sector, sums, jacobian = cells.sector, cells.sums, cells.jacobian
        residual_m, stable = cells.residual_m, sector.in_class(CellClass.STABLE) & ~snow[cells.cell_index]
        if response is not None:  # that rock responds otherwise than modelled is no error of the state
            residual_m = residual_m - stable * response.effect(jacobian)
        scan_m2, systematic_m2 = cells.point_m2 / sums.count, jacobian.variance(posterior)
        if positions is not None:
            own_m2 = positions.height_variances(cells.cell_index, sector.cell, jacobian, cells.offset_m)
            scan_m2, systematic_m2 = scan_m2 + own_m2[1], systematic_m2 + own_m2[0]
        parts.append(
            Residuals(
                *cells.offset_m[:2],
                cells.group,
                class_in_scan(
                    sector.noise_class,
                    cells.point_m2 > sector.point_variance_m2,
                    sums.count.astype(np.float32),
                    sector.point_count,
                ),
                stable,
                residual_m.astype(np.float32),
                scan_m2,
                sector.reference_variance_m2,
                systematic_m2,
                np.nan_to_num(sums.standard_deviation()) ** 2,
                sums.count.astype(np.int64) - 1,
            )
        )
    return estimate_variance_factors(Residuals.concatenate(parts)) if parts else UNIT_FACTORS
