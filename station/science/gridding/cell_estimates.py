"""Estimates for the cells of a scan: height, change, standard deviation and quality flags."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from station.quantities import (
    CELL_DTYPE,
    Bools,
    Floats,
    Floats32,
    Ints,
    Ints32,
    Measurement,
    Quality,
    Reals,
    ScanGeometry,
    SharedParameters,
    Viewpoint,
)
from station.science.geometry.observation import Observation
from station.science.gridding import significance
from station.science.gridding.cells_outside import CellsOutside, iter_cells_outside
from station.science.gridding.gridder import CellSums, Gridder, slope_sampling_variance
from station.science.gridding.reference_cells import HIGH_INCIDENCE_COS, CellClass
from station.science.gridding.stored_precision import quantum, round_sigma, round_total
from station.science.gridding.viewing_geometry import AzimuthSector, ViewingGeometry
from station.science.gridding.viewpoints import PositionErrors, mean_shot_variance
from station.science.uncertainty import budget, parameters, shot_noise
from station.science.uncertainty.jacobian import HeightJacobian, height_jacobian
from station.science.uncertainty.variance_factors import VarianceFactors, class_in_scan

FEW_POINTS = 3


def estimate_cells(
    gridder: Gridder, viewing: ViewingGeometry | None, estimator: CellEstimator
) -> Measurement:
    """Return height, change, σ and flags of all cells of a scan; overwrites the gridder's buffers."""
    scan_geometry = estimator.scan_geometry
    names = budget.TERMS if scan_geometry.published_budget else (*budget.TERMS, *budget.PUBLISHED)
    in_place, columns = gridder.release_buffers()
    builder = _MeasurementBuilder(
        in_place.view(CELL_DTYPE),
        columns.view(np.float32),
        np.zeros(gridder.used, np.uint8),
        {
            name: np.full(gridder.used, np.nan, np.float32)
            for name in names
            if scan_geometry.store_terms and scan_geometry.position_m is not None
        },
        scan_geometry.min_points,
    )
    if viewing is not None:
        for first, whole in viewing.sectors():
            sums = gridder.sums(first, first + len(whole))
            builder.write_empty(first + np.flatnonzero(sums.count == 0))
            observed = np.flatnonzero(sums.count > 0)  # indices are four times as fast as a mask
            if not len(observed):
                continue
            sector, sums, cell_index = whole.take(observed), sums.take(observed), first + observed
            builder.write(cell_index, sums, estimator.in_reference(cell_index, sector, sums, viewing))
    for outside in iter_cells_outside(gridder, scan_geometry, viewing):
        sums = gridder.take(outside.cell_index)
        shares = gridder.viewpoint_shares(outside.cell_index)
        estimates = estimator.outside_reference(outside, sums, shares, gridder.datum_m)
        builder.write(outside.cell_index, sums, estimates)
    return Measurement(
        scan_geometry.grid,
        gridder.cell_index,
        gridder.count,
        builder.cells,
        builder.change_m,
        builder.quality,
        builder.terms,
    )


@dataclass(frozen=True)
class _CellEstimates:
    """Estimates for cells of a scan, (n,) each."""

    elevation_m: Reals
    change_m: Reals
    sigma_m: Reals
    random_m: Reals
    flags: NDArray[np.uint8]
    terms: dict[str, Floats]


def _as_opaque_items(cells: NDArray[np.void]) -> NDArray[np.void]:
    """Return a view with each cell as one opaque item, which copies twice as fast as its fields."""
    return cells.view(f"V{CELL_DTYPE.itemsize}")


@dataclass(frozen=True)
class _MeasurementBuilder:
    """Columns of a measurement under construction; `cells` and `change_m` reuse the memory of its sums."""

    cells: NDArray[np.void]
    change_m: Floats32
    quality: NDArray[np.uint8]
    terms: dict[str, Floats32]
    min_points: int

    def write_empty(self, cell_index: Ints) -> None:
        """Mark cells (m,) as empty."""
        empty = np.array((np.nan,) * 4, CELL_DTYPE)
        _as_opaque_items(self.cells)[cell_index] = _as_opaque_items(empty)
        self.change_m[cell_index] = np.nan

    def write(self, cell_index: Ints | Ints32, sums: CellSums, estimates: _CellEstimates) -> None:
        """Write the estimates of cells (m,); for cells with too few points only the spread."""
        enough = sums.count >= self.min_points
        few = np.flatnonzero(~enough)
        cells = np.empty(len(cell_index), CELL_DTYPE)
        random_m, sigma_m = (values.astype(np.float32) for values in (estimates.random_m, estimates.sigma_m))
        systematic_m = round_sigma(np.sqrt(np.maximum(sigma_m * sigma_m - random_m * random_m, 0)))
        quantum_m = quantum(random_m)  # not by all of σ: what cells share does not blur their differences
        for name, values in (
            ("elevation_m", np.rint(estimates.elevation_m / quantum_m) * quantum_m),
            ("uncertainty_m", round_total(random_m, systematic_m)),
            ("systematic_uncertainty_m", systematic_m),
        ):
            cells[name] = values
            cells[name][few] = np.nan
        cells["spread_m"] = np.where(sums.count < FEW_POINTS, np.nan, sums.standard_deviation())
        _as_opaque_items(self.cells)[cell_index] = _as_opaque_items(cells)
        change_m = np.rint(estimates.change_m / quantum_m) * quantum_m
        self.change_m[cell_index] = np.where(enough, change_m, np.nan)
        self.quality[cell_index] = np.where(enough, estimates.flags, 0)
        for name, values in estimates.terms.items():
            self.terms[name][cell_index[enough]] = values[enough]


@dataclass(frozen=True)
class CellEstimator:
    """Corrects the cells of a scan for the adjustment and estimates their uncertainty.

    `posterior` are the shared parameters of the difference from the reference, `independent` those of the
    scan alone, None if unknown. `correction` returns what to subtract from heights [m], and `under_snow` (m,)
    is True for those cells of the reference that are stable ground whose snow may have changed; both are
    None without an adjustment. `position_errors` are those of several scan positions.
    """

    scan_geometry: ScanGeometry
    posterior: SharedParameters | None
    independent: SharedParameters | None
    correction: Callable[[HeightJacobian], Reals] | None
    under_snow: Bools | None
    factors: VarianceFactors
    position_errors: PositionErrors | None = None

    def in_reference(
        self, cell_index: Ints, sector: AzimuthSector, sums: CellSums, viewing: ViewingGeometry
    ) -> _CellEstimates:
        """Return estimates for cells (n,) of a sector of the reference."""
        count = sums.count.astype(np.float32)
        point_m2 = sector.point_variance_m2
        if not self.scan_geometry.published_budget:
            point_m2 = significance.supported_variance(point_m2, sums.standard_deviation(), sums.count)
        excess = point_m2 > sector.point_variance_m2
        noise_class = class_in_scan(sector.noise_class, excess, count, sector.point_count)
        stable = np.zeros(len(count), bool)
        if self.under_snow is not None:
            stable = sector.in_class(CellClass.STABLE) & ~self.under_snow[cell_index]
        point_m2 = point_m2 * self.factors.random_of(noise_class, stable)
        random_m2 = point_m2 / count + sector.reference_variance_m2
        shared_m2: Reals = np.zeros_like(count)
        correction_m: Reals = np.zeros_like(count)
        terms: dict[str, Floats] = {}
        if viewing.params is not None:
            jacobian = viewing.jacobian(sector)
            shared_m2, correction_m = self._systematic(jacobian)
            if self.position_errors is not None:
                offset_m = viewing.offset_m(sector.cell, sector.height_m)
                systematic_m2, own_m2 = self.position_errors.height_variances(
                    cell_index, sector.cell, jacobian, offset_m
                )
                shared_m2, random_m2 = shared_m2 + systematic_m2, random_m2 + own_m2
            if self.scan_geometry.store_terms:
                observation = viewing.observation(sector)
                excess_m2 = np.maximum(point_m2 - sector.point_variance_m2, 0.0) / count
                terms = self._terms(
                    jacobian, observation, sums.count.astype(np.float64), excess_m2.astype(np.float64)
                )
        sigma_m = self._sigma(random_m2 + shared_m2)
        change_m = (sums.mean_residual() - sector.mean_residual_m).astype(np.float32) - correction_m
        flags = Quality.FEW_POINTS * (sums.count < FEW_POINTS).view(np.uint8)
        flags |= Quality.HIGH_INCIDENCE * sector.in_class(CellClass.GRAZING).view(np.uint8)
        flags |= Quality.CHANGE_SIGNIFICANT * significance.significant(change_m, sigma_m).view(np.uint8)
        flags |= Quality.BARE_GROUND * sector.in_class(CellClass.BARE).view(np.uint8)
        flags |= Quality.STABLE_GROUND * stable.view(np.uint8)
        height_m = sector.height_m.astype(np.float64) + sector.mean_residual_m
        elevation_m = viewing.datum_m + (height_m + change_m)
        return _CellEstimates(elevation_m, change_m, sigma_m, np.sqrt(random_m2), flags, terms)

    def outside_reference(
        self, outside: CellsOutside, sums: CellSums, shares: Floats, datum_m: float
    ) -> _CellEstimates:
        """Return estimates for cells (n,) outside the reference, whose sums are above a datum.

        `shares` (k, n) are those of the viewpoints in their points.
        """
        scan_geometry = self.scan_geometry
        count, height_m = sums.count.astype(np.float64), sums.mean_residual() + datum_m
        flags = Quality.FEW_POINTS * (sums.count < FEW_POINTS).view(np.uint8)
        flags |= np.uint8(Quality.OUTSIDE_REFERENCE)
        no_change_m = np.full(len(count), np.nan)
        if scan_geometry.position_m is None:
            spread_m2 = np.nan_to_num(sums.standard_deviation().astype(np.float64)) ** 2
            random_m2 = np.maximum(spread_m2, scan_geometry.scanner.range_sigma_m**2) / count
            sigma_m = self._sigma(random_m2)
            return _CellEstimates(height_m, no_change_m, sigma_m, np.sqrt(random_m2), flags, {})
        row, column = scan_geometry.grid.row_and_column(outside.cell)
        points = scan_geometry.grid.x_m[column], scan_geometry.grid.y_m[row], height_m
        observation = Observation.from_points(
            points, scan_geometry.position_m, outside.east_gradient, outside.north_gradient
        )
        flags |= Quality.HIGH_INCIDENCE * (observation.cos_incidence < HIGH_INCIDENCE_COS).view(np.uint8)
        sampling_m2 = slope_sampling_variance(scan_geometry.grid.cell_m, observation.tan_slope, count)
        shot_m2 = mean_shot_variance(
            shares,
            points,
            (outside.east_gradient, outside.north_gradient),
            scan_geometry.viewpoints or (Viewpoint(scan_geometry.scanner, scan_geometry.position_m),),
            published=scan_geometry.published_budget,
        )
        random_m2 = shot_m2 / count + sampling_m2
        params = parameters.parameter_layout(scan_geometry.grid, scan_geometry.position_m, scan_geometry.axis)
        east_m, north_m, up_m = (axis_m.astype(np.float32) for axis_m in observation.offset_m)
        east, north = (
            slope.astype(np.float32) for slope in (observation.east_gradient, observation.north_gradient)
        )
        offset_m = east_m, north_m, up_m
        jacobian = height_jacobian(params, offset_m, east, north)
        shared_m2, correction_m = self._systematic(jacobian)
        if self.position_errors is not None:
            systematic_m2, own_m2 = self.position_errors.height_variances(
                outside.cell_index, outside.cell, jacobian, offset_m
            )
            shared_m2, random_m2 = np.add(shared_m2, systematic_m2), np.add(random_m2, own_m2)
        terms = self._terms(jacobian, observation, count, sampling_m2) if scan_geometry.store_terms else {}
        sigma_m = self._sigma(random_m2 + shared_m2)
        return _CellEstimates(height_m - correction_m, no_change_m, sigma_m, np.sqrt(random_m2), flags, terms)

    def _sigma(self, variance_m2: Reals) -> Reals:
        """Return the standard deviation of cells [m], in the form configured for the site."""
        if self.scan_geometry.published_budget:
            return shot_noise.sigma_total_voordendag(
                np.sqrt(variance_m2), self.scan_geometry.registration_sigma_m
            )
        return np.sqrt(variance_m2)

    def _systematic(self, jacobian: HeightJacobian) -> tuple[Reals, Reals]:
        """Return the systematic variance of cells [m²], and the correction to subtract from heights [m]."""
        zeros = np.zeros_like(jacobian.sight_tilt)
        if self.posterior is None:
            return zeros, zeros
        correction_m = zeros if self.correction is None else self.correction(jacobian)
        if self.scan_geometry.published_budget:
            return zeros, correction_m
        return jacobian.variance(self.posterior), correction_m

    def _terms(
        self, jacobian: HeightJacobian, observation: Observation, count: Floats, sampling_m2: Floats
    ) -> dict[str, Floats]:
        """Return the error budget by term [m], in the form configured for the site."""
        scan_geometry = self.scan_geometry
        if scan_geometry.published_budget:
            return budget.terms_voordendag(
                observation, count, scan_geometry.scanner, scan_geometry.registration_sigma_m
            )
        if self.independent is None:
            return {}
        terms = budget.error_budget(
            observation, count, sampling_m2, jacobian, self.independent, scan_geometry.scanner
        )
        return terms | budget.published_budget(observation, count, scan_geometry.scanner)
