"""Variance of linear functions of the cells: boxes, areas, volumes, differences of two epochs."""

from __future__ import annotations

from dataclasses import dataclass, replace

import h5py
import numpy as np

from station.archive.areas import AreaChange
from station.archive.derived.computed_rasters import (
    SYSTEMATIC,
    ReferenceSurfaces,
    is_value,
)
from station.archive.epochs import EpochRef
from station.archive.netcdf_layout import Series
from station.quantities import Bools, Floats, Grid, Quality, Reals
from station.queries.common_errors import common_error_covariance, shared_of
from station.queries.epoch_cells import (
    EpochCells,
    EpochMean,
    EpochReader,
    bounding_box,
    layout_of_scanner,
    observed_in_all,
    read_cells_of,
)
from station.science.adjustment import ground_classes
from station.science.adjustment.leverage import leverage
from station.science.analysis.voids import area_weights, void_variance
from station.science.geometry.terrain import smooth_gradient
from station.science.uncertainty.jacobian import HeightJacobian, cell_jacobian
from station.science.uncertainty.propagation import (
    aggregate_variance,
    cell_covariances,
)

MARGIN_CELLS = 6  # reach of the smoothed gradient around a cell


@dataclass(frozen=True)
class ObservedArea:
    """The cells (n,) of an area that an epoch observed, or both of two, and how they fill its voids.

    `value_m` is the change, that from another epoch, or with `above_surface` the height above a surface that
    does not come from the station, which has the errors of the reference too.
    """

    epochs: list[EpochCells]
    cells: Bools  # (ny, nx)
    value_m: Floats
    random_m2: list[Floats]  # in each epoch
    weights: Floats  # of the mean of the area, its voids interpolated
    void_m2: float  # variance of that mean by the interpolation
    coverage: float  # share of the area
    above_surface: bool


class Aggregates(EpochReader):
    """Means and variances over cells of the epochs of a store."""

    def __init__(self, series: Series) -> None:
        super().__init__(series)
        self._surfaces = ReferenceSurfaces(series)
        # Of the last cells, reused by the median.
        self._jacobian_cache: tuple[EpochCells, Bools, HeightJacobian] | None = None

    def variance(self, weights: Floats | Bools, epoch: EpochRef, other: EpochRef | None = None) -> float:
        """Return the variance of the weighted sum of change [m² times squared weights].

        The sum is over one epoch, or over its difference to another epoch. `weights` (ny, nx) are zero
        outside the area; a mask stands for the mean of its cells with a change, NaN if there is none. Cells
        without a change do not contribute. Source: equations.md, 6.2.
        """
        if other == epoch:
            return 0.0
        cells = weights != 0
        epochs = self._read_epochs(cells, epoch, other)
        common_cells = observed_in_all(epochs, cells)
        cell_weights = weights[common_cells].astype(np.float64)
        if weights.dtype == np.bool_:
            if not len(cell_weights):
                return np.nan
            cell_weights /= len(cell_weights)
        return self._weighted_sum_variance(
            epochs,
            common_cells,
            cell_weights,
            self._random_variances(epochs, common_cells, common_cells[cells]),
        )

    def area(self, cells: Bools, epoch: EpochRef, other: EpochRef | None = None) -> AreaChange:
        """Return the change of the cells (ny, nx) in an epoch, or from another epoch to it [m].

        The sigma of the median is that of the mean, with the random part larger by √(π/2), as for normal
        errors. Source: equations.md, 6.2; voids: Hartzell et al. (2015), see `voids`.
        """
        area = self.observe(cells, epoch, other)
        if area is None:
            return AreaChange(np.nan, np.nan, np.nan, np.nan, 0.0)
        variance_m2 = self.sum_variance(area, area.weights)[1] + area.void_m2
        equal_weights = np.full(len(area.value_m), 1 / len(area.value_m))
        median_variance_m2 = self._weighted_sum_variance(
            area.epochs, area.cells, equal_weights, area.random_m2, random_factor=np.pi / 2
        )
        return AreaChange(
            mean_m=float(area.weights @ area.value_m),
            mean_sigma_m=float(np.sqrt(variance_m2)),
            median_m=float(np.median(area.value_m)),
            median_sigma_m=float(np.sqrt(median_variance_m2)),
            coverage=area.coverage,
        )

    def observe(
        self,
        cells: Bools,
        epoch: EpochRef,
        other: EpochRef | EpochMean | None = None,
        surface_m: Floats | None = None,
    ) -> ObservedArea | None:
        """Return the cells (ny, nx) that an epoch observed, or both of two; None if there are none.

        The other may be the mean of several. With `surface_m` (ny, nx), the values are heights above it where
        it is known.
        """
        epochs = self._read_epochs(cells, epoch, other)
        common_cells = observed_in_all(epochs, cells)
        bounds = bounding_box(cells, 0)
        if surface_m is not None:
            common_cells[bounds] &= np.isfinite(surface_m[bounds])
        observed = common_cells[bounds][cells[bounds]]
        if not observed.any():
            return None
        value_m = epochs[0].change_m[observed] - (0.0 if other is None else epochs[1].change_m[observed])
        if surface_m is not None:
            value_m += self.mean_elevation(epochs[0], common_cells) - surface_m[common_cells]
        above_surface = surface_m is not None
        random_m2 = self._random_variances(epochs, common_cells, observed, above_surface=above_surface)
        value_map_m, noise_map_m2 = np.full(cells[bounds].shape, np.nan), np.zeros(cells[bounds].shape)
        value_map_m[common_cells[bounds]], noise_map_m2[common_cells[bounds]] = (
            value_m,
            np.sum(random_m2, axis=0),
        )
        weights, fill_distance = area_weights(cells[bounds], common_cells[bounds])
        return ObservedArea(
            epochs=epochs,
            cells=common_cells,
            value_m=value_m,
            random_m2=random_m2,
            weights=weights[common_cells[bounds]],
            void_m2=void_variance(cells[bounds], fill_distance, value_map_m, noise_map_m2),
            coverage=float(observed.mean()),
            above_surface=above_surface,
        )

    def sum_variance(self, area: ObservedArea, weights: Floats) -> tuple[float, float]:
        """Return the random and the total variance of a weighted sum of the cells (n,) of an area.

        The unit is m² times that of the squared weights. Source: equations.md, 6.2.
        """
        total = self._weighted_sum_variance(
            area.epochs, area.cells, weights, area.random_m2, above_surface=area.above_surface
        )
        return min(float(weights**2 @ np.sum(area.random_m2, axis=0)), total), total

    def cell_variances(self, area: ObservedArea) -> tuple[Floats, Floats]:
        """Return the random and the systematic variance (n,) of each cell of an area [m²].

        They are those of `sum_variance` for a weight of one in one cell.
        """
        random_m2 = np.asarray(np.sum(area.random_m2, axis=0, dtype=np.float64))
        total_m2, lower_m2, jacobians = np.zeros(len(random_m2)), np.zeros(len(random_m2)), []
        for epoch_cells, independent_m2 in zip(area.epochs, area.random_m2, strict=True):
            shared = shared_of(area.epochs, epoch_cells, above_surface=area.above_surface)
            if shared is None:
                total_m2, lower_m2 = total_m2 + independent_m2, lower_m2 + independent_m2
                continue
            jacobian = self.jacobian(epoch_cells, area.cells)
            absorbed = (
                self.leverage(epoch_cells, area.cells, jacobian, independent_m2)
                if len(area.epochs) > 1
                else None
            )
            independent = 1.0 if absorbed is None else 1 - absorbed
            shared_m2 = jacobian.variance(shared) * (2 * independent - 1)
            total_m2 += np.maximum(independent_m2 + shared_m2, independent_m2 * independent)
            lower_m2 += independent_m2 * independent
            factor = epoch_cells.jacobian_factor
            jacobians.append(jacobian if factor is None else jacobian.scaled(1 / factor[area.cells]))
        covariance = common_error_covariance(area.epochs)
        if covariance is not None:
            total_m2 -= 2 * cell_covariances(jacobians[0], jacobians[1], covariance)
        total_m2 = np.maximum(total_m2, lower_m2)
        random_m2 = np.minimum(random_m2, total_m2)
        return random_m2, total_m2 - random_m2

    def mean_elevation(self, epoch_cells: EpochCells, cells: Bools) -> Floats:
        """Return the heights (n,) that the change of an epoch is counted from [m]."""
        rows, columns = bounding_box(cells, 0)
        height_m = self._surfaces.height_m(epoch_cells.reference.version, rows, columns)
        selected_m = np.asarray(height_m[cells[rows, columns]], dtype=np.float64)
        return np.where(is_value(selected_m), selected_m, np.nan)

    def shared_variance_between(
        self, epoch: EpochRef, other: EpochRef, grid: Grid, elevation_m: Reals, cells: Bools
    ) -> Floats:
        """Return the shared part of the variance (n,) of the change between two epochs [m²].

        `cells` (ny, nx) selects cells of the surface `elevation_m` on `grid`, which may differ from the grid
        of the store. The random part of each cell is not included. Source: equations.md, 6.2.
        """
        no_cells = np.zeros(self.grid.shape, np.bool_)
        epochs = [self.read_cells(epoch_ref, no_cells) for epoch_ref in (epoch, other)]
        contributions = [
            (epoch_cells.scanner, epoch_cells.shared)
            for epoch_cells in epochs
            if epoch_cells.shared is not None
        ]
        common_m2 = common_error_covariance(epochs)
        if common_m2 is not None:
            (scanner, first), (_, second) = contributions
            difference = replace(
                first,
                covariance=first.covariance + second.covariance - common_m2 - common_m2.T,
                line_tilt_variance=first.line_tilt_variance + second.line_tilt_variance,
            )
            contributions = [(scanner, difference)]
        gradient = smooth_gradient(elevation_m, grid.cell_m)
        variance_m2 = np.zeros(np.count_nonzero(cells))
        for scanner, shared in contributions:
            params, position_m = layout_of_scanner(grid, scanner)
            jacobian = cell_jacobian(params, grid, position_m, elevation_m, gradient, cells)
            variance_m2 += jacobian.variance(shared)
        return variance_m2

    def _read_epochs(
        self, cells: Bools, epoch: EpochRef, other: EpochRef | EpochMean | None
    ) -> list[EpochCells]:
        return [
            self.read_cells(epoch_ref, cells) for epoch_ref in ([epoch] if other is None else [epoch, other])
        ]

    def _random_variances(
        self,
        epochs: list[EpochCells],
        common_cells: Bools,
        observed: Bools,
        *,
        above_surface: bool = False,
    ) -> list[Floats]:
        """Return the random variance of the cells (n,) in each epoch [m²]."""
        variances = []
        for epoch_cells in epochs:
            random_m2 = epoch_cells.random_m[observed] ** 2
            if len(epochs) > 1 or above_surface:  # errors of a common reference cancel in the difference
                reference_m2 = epoch_cells.reference.random_variance_m2[common_cells]
                random_m2 = np.maximum(random_m2 - reference_m2, 0.0)
                if len(epochs) > 1:
                    random_m2 = random_m2 + self._references_differ(epochs, common_cells) * reference_m2
            variances.append(random_m2)
        return variances

    def _weighted_sum_variance(
        self,
        epochs: list[EpochCells],
        common_cells: Bools,
        weights: Floats,
        random_m2: list[Floats],
        random_factor: float = 1.0,
        *,
        above_surface: bool = False,
    ) -> float:
        """Return the variance of the weighted sum of the cells (n,) over the epochs.

        The random part is multiplied by `random_factor`. For two epochs, the covariance of their common
        errors is subtracted, but the result is never below the random part.
        """
        variance, lower_bound, aggregated = 0.0, 0.0, []
        for epoch_cells, independent_m2 in zip(epochs, random_m2, strict=True):
            shared = shared_of(epochs, epoch_cells, above_surface=above_surface)
            scaled_m2 = random_factor * independent_m2
            if shared is None:
                variance, lower_bound = (
                    value + float(np.sum(weights**2 * scaled_m2)) for value in (variance, lower_bound)
                )
                continue
            jacobian = self.jacobian(epoch_cells, common_cells)
            factor = epoch_cells.jacobian_factor
            aggregated.append(
                jacobian.aggregate(weights if factor is None else weights / factor[common_cells])
            )
            noise_leverage = (
                self.leverage(epoch_cells, common_cells, jacobian, independent_m2)
                if len(epochs) > 1
                else None
            )
            variance += aggregate_variance(weights, scaled_m2, jacobian, shared, noise_leverage)
            lower_bound += float(
                np.sum(weights**2 * scaled_m2 * (1.0 if noise_leverage is None else 1 - noise_leverage))
            )
        common_covariance = common_error_covariance(epochs)
        if common_covariance is not None:
            variance -= 2 * float(aggregated[0] @ common_covariance @ aggregated[1])
        return max(variance, lower_bound)

    def leverage(
        self, epoch_cells: EpochCells, common_cells: Bools, jacobian: HeightJacobian, independent_m2: Floats
    ) -> Floats | None:
        """Return the leverage (n,) of the noise of the cells on the adjustment of an epoch; None if unknown.

        That of a mean of epochs is not counted, which makes sigma slightly too large.
        Used for differences only.
        Relative to the reference, it would remove about as much as the error of the reference itself, a tenth
        of a millimetre for an area, which is counted nowhere else.
        """
        known = epoch_cells.adjusted and np.isfinite(epoch_cells.noise_leverage).all()
        if epoch_cells.members or not known:
            return None
        grid, (row, column) = self.grid, np.nonzero(common_cells)
        holdout = ground_classes.is_holdout(grid.x_m[column], grid.y_m[row])
        stable_ground = _has_quality(epoch_cells.epoch, common_cells, Quality.STABLE_GROUND)
        smooth = jacobian.tan_slope < ground_classes.MAX_MOVING_SLOPE
        ground_class = ground_classes.classify(stable_ground, holdout, smooth, np.zeros_like(stable_ground))
        random_m2 = independent_m2 + epoch_cells.reference.random_variance_m2[common_cells]
        return leverage(independent_m2, random_m2, ground_class, epoch_cells.noise_leverage)

    def _references_differ(self, epochs: list[EpochCells], cells: Bools) -> Bools:
        """Return True where the reference surfaces of two epochs differ."""
        (first, first_mean), (second, second_mean) = (
            (epoch_cells.reference.elevation_m[cells], epoch_cells.reference.mean_residual_m[cells])
            for epoch_cells in epochs
        )
        return np.asarray((first != second) | (first_mean != second_mean))

    def jacobian(self, epoch_cells: EpochCells, cells: Bools) -> HeightJacobian:
        """Return the Jacobian of the selected cells (ny, nx) of an epoch by its shared parameters."""
        if (
            self._jacobian_cache is None
            or self._jacobian_cache[0] is not epoch_cells
            or self._jacobian_cache[1] is not cells
        ):
            self._jacobian_cache = epoch_cells, cells, self._compute_jacobian(epoch_cells, cells)
        return self._jacobian_cache[2]

    def _compute_jacobian(self, epoch_cells: EpochCells, cells: Bools) -> HeightJacobian:
        grid, elevation_m = self.grid, epoch_cells.reference.elevation_m
        params, position_m = layout_of_scanner(grid, epoch_cells.scanner)
        rows, columns = bounding_box(cells, MARGIN_CELLS)
        corner_m = grid.west_m + columns.start * grid.cell_m, grid.north_m - rows.start * grid.cell_m
        window_m = elevation_m[rows, columns]
        window_grid = Grid(*corner_m, grid.cell_m, window_m.shape[1], window_m.shape[0])
        gradient = smooth_gradient(window_m, grid.cell_m)
        rock = _has_quality(epoch_cells.epoch, cells, Quality.STABLE_GROUND | Quality.BARE_GROUND)
        jacobian = cell_jacobian(
            params, window_grid, position_m, window_m, gradient, cells[rows, columns], rock
        )
        if epoch_cells.has_positions:
            jacobian = _scaled_to_cells(jacobian, epoch_cells, cells)
        factor = epoch_cells.jacobian_factor
        return jacobian if factor is None else jacobian.scaled(factor[cells])


def _scaled_to_cells(jacobian: HeightJacobian, epoch_cells: EpochCells, cells: Bools) -> HeightJacobian:
    """Return the Jacobian that gives selected cells (ny, nx) their stored systematic variances.

    The covariance of an epoch of several positions is that of a mean cell. Source: equations.md, 6.13.
    """
    shared = epoch_cells.members[0] if epoch_cells.members else epoch_cells.shared
    if shared is None:
        return jacobian
    with h5py.File(epoch_cells.epoch.path, "r") as file:
        systematic_m = read_cells_of(file, SYSTEMATIC, epoch_cells.epoch.index, cells)
    sigma_m = np.sqrt(np.asarray(jacobian.variance(shared), np.float64))
    known = np.isfinite(systematic_m) & (sigma_m > 0)
    return jacobian.scaled(np.divide(systematic_m, sigma_m, out=np.ones(len(sigma_m)), where=known))


def _has_quality(epoch: EpochRef, cells: Bools, flags: Quality) -> Bools:
    """Return True for selected cells (n,) that have any of the flags in an epoch."""
    with h5py.File(epoch.path, "r") as file:
        quality = read_cells_of(file, "quality", epoch.index, cells).astype(np.int64)
    return np.asarray((quality & flags) > 0)
