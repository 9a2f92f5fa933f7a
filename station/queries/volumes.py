"""Volumes between epochs with the sources of their uncertainty; covariance of points and of cells."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import h5py
import numpy as np
import xarray as xr

from station.archive.derived.computed_rasters import CHANGE, RANDOM, SYSTEMATIC, TOTAL
from station.archive.epochs import EpochRef
from station.errors import StationError, StoreError
from station.grid_plane import MAP_PLANE
from station.quantities import Bools, Floats
from station.queries.aggregates import Aggregates, ObservedArea
from station.queries.common_errors import common_error_covariance, shared_of
from station.queries.epoch_cells import EpochCells, layout_of_scanner, observed_in_all, read_cells_of
from station.science.analysis.voids import area_weights
from station.science.analysis.volume import common_contributions, shared_contributions
from station.science.uncertainty.point_covariance import shared_covariance, shot_covariance

MAX_CELLS = 4096  # their correlations take 0.13 GB
CORRELATION = "error_correlation"
_DIMS = ["y", "x"]


class Volumes(Aggregates):
    """Volumes of the epochs of a store, and the covariance of their points."""

    def volume_change(self, cells: Bools, epoch: EpochRef, other: EpochRef | None = None) -> xr.Dataset:
        """Return the volume change over cells (ny, nx) in an epoch, or from a second epoch to it [m³].

        As in `areas.nc`, cells without a change are interpolated; `coverage` is the share of the others.
        Three sigmas [m³]: total; random part only; and as published, with the total errors of all cells
        independent. The maps contain the share of each cell in the variance of the observed part, and in the
        published variance; each sums to 1. Raises StoreError if no cell was observed.
        """
        epochs = self._read_epochs(cells, epoch, other)
        common_cells = observed_in_all(epochs, cells)
        if not common_cells.any():
            raise StoreError(f"{epoch.path}: none of the {np.count_nonzero(cells)} cells has a change")
        size_m2 = self.grid.cell_m**2 * np.count_nonzero(cells)
        weights_m2 = size_m2 * area_weights(cells, common_cells)[0][common_cells]
        random_part, shared_part = self._variance_contributions(
            epochs,
            common_cells,
            weights_m2,
            self._random_variances(epochs, common_cells, common_cells[cells]),
        )
        sigmas_m = [
            self._sigma(epoch_ref, common_cells)
            for epoch_ref in ([epoch] if other is None else [epoch, other])
        ]
        published = weights_m2**2 * sum(sigma_m**2 for sigma_m in sigmas_m)
        area_change = self.area(cells, epoch, other)

        def volume_variable(value_m3: float) -> tuple[tuple[()], float, dict[str, str]]:
            return (), value_m3, {"units": "m3"}

        def share_map(values: Floats) -> tuple[tuple[str, str], Floats, dict[str, str]]:
            share = np.full(cells.shape, np.nan)
            share[common_cells] = values / values.sum()
            return ("y", "x"), share, {"units": "1"}

        return xr.Dataset(
            {
                "volume_change": volume_variable(area_change.mean_m * size_m2),
                "volume_change_uncertainty": volume_variable(area_change.mean_sigma_m * size_m2),
                "volume_change_random_uncertainty": volume_variable(float(np.sqrt(random_part.sum()))),
                "volume_change_uncertainty_hartzell2015": volume_variable(float(np.sqrt(published.sum()))),
                "area_size": ((), size_m2, {"units": "m2"}),
                "coverage": ((), area_change.coverage, {"units": "1"}),
                "variance_share": share_map(random_part + shared_part),
                "variance_share_hartzell2015": share_map(published),
            },
            {"y": self.grid.y_m, "x": self.grid.x_m},
        )

    def change_between(self, epoch: EpochRef, other: EpochRef) -> xr.Dataset:
        """Return the elevation change of each cell from another epoch to an epoch, with its uncertainty [m].

        The errors of a common reference cancel, and the errors that both epochs share.
        """
        everywhere = np.ones(self.grid.shape, np.bool_)
        epochs = self._read_epochs(everywhere, epoch, other)
        cells = observed_in_all(epochs, everywhere)
        random_m2 = np.sum(self._random_variances(epochs, cells, cells.ravel()), axis=0)
        surface_m = np.asarray(epochs[0].reference.elevation_m)
        shared_m2 = self.shared_variance_between(epoch, other, self.grid, surface_m, cells)
        change_m = epochs[0].change_m - epochs[1].change_m

        def on_map(values: Floats, long_name: str) -> tuple[tuple[str, str], Floats, dict[str, str]]:
            raster = np.full(cells.shape, np.nan)
            raster[cells] = values
            return ("y", "x"), raster, {"long_name": long_name, "units": "m"}

        return xr.Dataset(
            {
                CHANGE: on_map(change_m[cells.ravel()], "elevation change between two scans"),
                TOTAL: on_map(
                    np.sqrt(random_m2 + shared_m2), "uncertainty of the elevation change between two scans"
                ),
                RANDOM: on_map(
                    np.sqrt(random_m2), "random uncertainty of the elevation change between two scans"
                ),
            },
            {"y": self.grid.y_m, "x": self.grid.x_m},
        )

    def _sigma(self, epoch: EpochRef, common_cells: Bools) -> Floats:
        """Return one sigma (n,) of the selected cells in an epoch, random and shared errors [m]."""
        with h5py.File(epoch.path, "r") as file:
            return read_cells_of(file, TOTAL, epoch.index, common_cells)

    def _variance_contributions(
        self, epochs: list[EpochCells], common_cells: Bools, weights: Floats, random_m2: list[Floats]
    ) -> tuple[Floats, Floats]:
        """Return the random and the shared contribution of each cell (n,) to a weighted sum's variance."""
        random_part, shared_part, jacobians = np.zeros(len(weights)), np.zeros(len(weights)), []
        for epoch_cells, independent_m2 in zip(epochs, random_m2, strict=True):
            random_part += weights**2 * independent_m2
            shared_params = shared_of(epochs, epoch_cells, above_surface=False)
            if shared_params is None:
                continue
            jacobian = self.jacobian(epoch_cells, common_cells)
            noise_leverage = (
                self.leverage(epoch_cells, common_cells, jacobian, independent_m2)
                if len(epochs) > 1
                else None
            )
            jacobians.append(jacobian)
            shared_part += shared_contributions(weights, jacobian, shared_params, noise_leverage)
        common_covariance = common_error_covariance(epochs)
        if common_covariance is not None:
            shared_part -= common_contributions(weights, (jacobians[0], jacobians[1]), common_covariance)
        return random_part, shared_part

    def error_structure(self, cells: Bools, epoch: EpochRef) -> xr.Dataset:
        """Return the change of a rectangle of cells (ny, nx) in an epoch, with its errors [m].

        In the form of obsarray, after the project FIDUCEO (Mittaz et al., 2019): `error_correlation` is that
        of the systematic errors of all pairs of cells, row after row. Cells without a change are NaN, and
        their errors not correlated with others. Raises StationError if there are too many cells.
        """
        rows, columns = (np.flatnonzero(cells.any(axis=axis)) for axis in (1, 0))
        count = len(rows) * len(columns)
        if count > MAX_CELLS:
            raise StationError(
                f"the correlations of {count:,} cells do not fit the memory: select at most {MAX_CELLS:,},"
                f" for example {int(MAX_CELLS**0.5)} x {int(MAX_CELLS**0.5)} with .isel(y=..., x=...)"
            )
        area = self.observe(cells, epoch)
        seen = np.zeros(cells.shape, np.bool_) if area is None else area.cells
        inside = seen[np.ix_(rows, columns)]
        covariance_m2 = np.zeros((np.count_nonzero(inside),) * 2)
        values = {name: np.full(inside.shape, np.nan) for name in (CHANGE, RANDOM, SYSTEMATIC)}
        if area is not None:
            covariance_m2 = self._systematic_covariance(area)
            values[CHANGE][inside] = area.value_m
            values[RANDOM][inside] = np.sqrt(area.random_m2[0])
            values[SYSTEMATIC][inside] = np.sqrt(np.diag(covariance_m2))
        correlation, index = np.eye(count), np.flatnonzero(inside)
        correlation[np.ix_(index, index)] = _correlation(covariance_m2)
        variables: dict[str, Any] = {name: (_DIMS, raster) for name, raster in values.items()}
        variables[CORRELATION] = (("cell", "other_cell"), correlation, {"units": "1"})
        grid = self.grid
        dataset = xr.Dataset(variables, {"y": grid.y_m[rows], "x": grid.x_m[columns]})
        dataset[CHANGE].attrs = {"units": "m", "unc_comps": [RANDOM, SYSTEMATIC]}
        dataset[RANDOM].attrs = _error_attributes("random", [])
        dataset[SYSTEMATIC].attrs = _error_attributes("err_corr_matrix", [CORRELATION])
        return dataset

    def _systematic_covariance(self, area: ObservedArea) -> Floats:
        """Return the systematic covariance (n, n) of the cells of an area in one epoch [m²]: J C Jᵀ.

        Source: equations.md, 6.2.
        """
        shared = shared_of(area.epochs, area.epochs[0], above_surface=area.above_surface)
        if shared is None:
            return np.zeros((len(area.value_m),) * 2)
        return self.jacobian(area.epochs[0], area.cells).covariance(shared)

    def point_covariance(self, points_m: Floats, epoch: EpochRef) -> Floats:
        """Return the covariance (n, 3, 3) of map points (n, 3) in an epoch [m²]: shot, pose, tilt, air.

        Raises StoreError if the epoch has no shared parameters, or the store does not name its scanner.
        """
        scanner = self.series.scanner
        if scanner is None:
            raise StoreError(
                f"{self.series.path}: an older version, which did not name the scanner, has written it: give"
                " the site file instead of the folder"
            )
        epoch_cells = self.read_shared(epoch)
        if epoch_cells.shared is None:
            raise StoreError(
                f"{epoch.path}: no scanner pose is stored, because the scan is in map coordinates"
            )
        params, position_m = layout_of_scanner(self.grid, epoch_cells.scanner)
        offset_m = points_m - np.array(self.grid.plane.place_to_map(position_m))
        shot_m2 = shot_covariance(offset_m, np.array(params.axis), scanner)
        on_map = replace(params, plane=MAP_PLANE)
        return shot_m2 + shared_covariance(on_map, offset_m, epoch_cells.shared)


def _error_attributes(form: str, parameters: list[str]) -> dict[str, Any]:
    return {
        "units": "m",
        "pdf_shape": "gaussian",
        "err_corr_1_dim": _DIMS,
        "err_corr_1_form": form,
        "err_corr_1_units": [],
        "err_corr_1_params": parameters,
    }


def _correlation(covariance: Floats) -> Floats:
    """Return the correlation matrix (n, n) of a covariance; where the variance is zero there is none."""
    sigma = np.sqrt(np.diag(covariance))
    scale = np.outer(sigma, sigma)
    correlation: Floats = np.divide(covariance, scale, out=np.zeros_like(covariance), where=scale > 0)
    np.fill_diagonal(correlation, 1.0)
    return correlation
