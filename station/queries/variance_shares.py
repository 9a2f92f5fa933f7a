"""Share of each input in the variance of an epoch: maps of its cells, tables of its areas."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import netCDF4
import numpy as np

from station.archive.atomic_files import atomic_write
from station.archive.epochs import EpochRef, read_provenance
from station.archive.netcdf_layout import Series, create_file, create_variable
from station.archive.raster_io import rounded, write_rasters
from station.archive.schema import Variable
from station.errors import StoreError
from station.quantities import Bools, Floats, Ints, Reference, SharedParameters
from station.queries.aggregates import Aggregates
from station.science.analysis.calibration import range_bands
from station.science.analysis.pose_errors import PoseErrorModel
from station.science.analysis.sensitivity import (
    INPUTS,
    block_diagonal,
    cell_shares,
    interactions,
    sobol,
    sum_shares,
)
from station.science.geometry import terrain
from station.science.uncertainty.jacobian import HeightJacobian
from station.science.uncertainty.propagation import difference_to_reference

BLOCK_CELLS = 100_000  # cells per block
SIMULATED_CELLS = 100  # sample of an area: the shares do not depend on every cell
SIMULATED_DRAWS = 64  # per repetition
MAX_INTERACTING_INPUTS = 3  # largest inputs, whose interactions are computed

SHARE_VARIABLES = tuple(
    Variable(
        f"share_{name}", ("y", "x"), "f4", f"share of {name} in the variance of the elevation change", "1",
        digits=3, comment="the shares of a cell add up to 1; negative if errors compensate each other",
    )
    for name in INPUTS
)  # fmt: skip


@dataclass(frozen=True)
class VarianceShares:
    """The cells (ny, nx) of an epoch that have a change, with all inputs of their variance."""

    series: Series
    epoch: EpochRef
    cells: Bools
    jacobian: HeightJacobian
    random_m2: Floats
    shared: SharedParameters
    reference: Reference
    position_m: tuple[float, float, float]

    def shares(self, index: Ints | slice) -> dict[str, Floats]:
        """Return the share of each input in the variance of the selected cells."""
        return cell_shares(self.jacobian.take(index), self.random_m2[index], self.shared)

    @cached_property
    def range_m(self) -> Floats:
        """Horizontal distance of each cell (n,) from the scanner [m]."""
        row, column = np.nonzero(self.cells)
        return np.asarray(self.series.grid.horizontal_range_m(row, column, self.position_m))

    def by_range(self) -> list[dict[str, Any]]:
        """Return the mean share of each input over single cells, by range band."""
        table = []
        for low_m, high_m in range_bands(self.range_m):
            inside = np.flatnonzero((self.range_m >= low_m) & (self.range_m < high_m))
            inside = inside[:: 1 + len(inside) // BLOCK_CELLS]
            if len(inside):
                shares = {name: float(values.mean()) for name, values in self.shares(inside).items()}
                shared_m2 = self.jacobian.take(inside).variance(self.shared)
                sigma = float(np.median(np.sqrt(shared_m2 + self.random_m2[inside])))
                table.append(
                    {"cells": f"{low_m:g}-{high_m:g} m", "sigma_m": sigma, "covariance_share": shares}
                )
        return table

    def area_shares(self, name: str, area_cells: Bools, *, simulate: bool = True) -> dict[str, Any] | None:
        """Return the shares of the inputs in the variance of the mean change of an area (ny, nx).

        None if no cell has a change. With `simulate`, also the Sobol indices of a sample of its cells and the
        first-order shares of the same sample; both assume that the inputs are independent.
        """
        inside = area_cells[self.cells]
        if not inside.any():
            return None
        variance_m2, shares = sum_shares(inside / inside.sum(), self.random_m2, self.jacobian, self.shared)
        result: dict[str, Any] = {
            "area": name,
            "cells": int(inside.sum()),
            "sigma_m": float(np.sqrt(variance_m2)),
        }
        for kind in ("covariance_share", "first", "total"):
            result[kind] = {name: asdict(share)[kind] for name, share in shares.items()}
        return result | (self._simulate(np.flatnonzero(inside)) if simulate else {})

    def _simulate(self, inside: np.ndarray[Any, Any]) -> dict[str, Any]:
        sample = inside[np.linspace(0, len(inside) - 1, min(len(inside), SIMULATED_CELLS)).astype(np.int64)]
        grid = self.series.grid
        row, column = (axis_index[sample] for axis_index in np.nonzero(self.cells))
        surface = terrain.bilinear_surface(self.reference)
        height_m = surface.height_and_gradient(column + 0.5, row + 0.5)[0]
        jacobian, random_m2 = self.jacobian.take(sample), self.random_m2[sample]
        weights = np.full(len(sample), 1 / len(sample))
        points = grid.x_m[column], grid.y_m[row], height_m
        error_model = PoseErrorModel(
            surface, self.position_m, points, weights, jacobian, self.shared, random_m2
        )
        groups = error_model.groups()
        sobol_indices = sobol(error_model, error_model.draw, groups, SIMULATED_DRAWS)
        largest = np.argsort(-sobol_indices.total)[:MAX_INTERACTING_INPUTS].tolist()
        shares_by_group = interactions(
            error_model, error_model.draw, [groups[number] for number in largest], SIMULATED_DRAWS
        )
        _, linear = sum_shares(weights, random_m2, jacobian, block_diagonal(self.shared))
        simulated = {
            name: dict(zip(INPUTS, values.tolist(), strict=True))
            for name, values in asdict(sobol_indices).items()
        }
        return {
            "simulated": simulated
            | {"linear": {name: share.covariance_share for name, share in linear.items()}},
            "interactions": [
                {"inputs": [INPUTS[largest[number]] for number in group], "share": share, "error": error}
                for group, (share, error) in shares_by_group.items()
                if len(group) > 1
            ],
        }

    def write(self, path: Path) -> None:
        """Write the shares as maps to a NetCDF file; raise StoreError if it cannot be written."""
        maps = {spec.name: np.full(self.cells.shape, np.nan, np.float32) for spec in SHARE_VARIABLES}
        cell_index = np.flatnonzero(self.cells)
        for first in range(0, len(cell_index), BLOCK_CELLS):
            block = slice(first, first + BLOCK_CELLS)
            for name, share in self.shares(block).items():
                maps[f"share_{name}"].ravel()[cell_index[block]] = share
        with atomic_write(path) as tmp_path:
            with netCDF4.Dataset(tmp_path, "w", clobber=False) as file:
                title = (
                    f"Variance shares of the elevation change at {self.series.name or self.series.station_id}"
                )
                create_file(file, self.series, title, None)
                file.setncattr("epoch_file", self.epoch.epoch_file)
                for spec in SHARE_VARIABLES:
                    create_variable(file, spec, self.series, 1)
            write_rasters(
                tmp_path,
                SHARE_VARIABLES,
                lambda grid_rows: [rounded(spec, maps[spec.name][grid_rows]) for spec in SHARE_VARIABLES],
            )


def compute_variance_shares(series: Series, epoch: int | str) -> VarianceShares:
    """Return the variance shares of an epoch; raise StoreError if its file lacks the inputs."""
    aggregates = Aggregates(series)
    epoch_ref = aggregates.find_epoch(epoch)
    all_cells = np.ones(series.grid.shape, bool)
    if not read_provenance(epoch_ref.path)["reference_version"]:
        raise StoreError(f"{epoch_ref.epoch_file}: has no reference yet, so its change is not known")
    epoch_cells = aggregates.read_cells(epoch_ref, all_cells)
    if epoch_cells.shared is None:
        raise StoreError(
            f"{epoch_ref.epoch_file}: has no shared parameters, because the scanner position is not known"
        )
    observed = (
        np.isfinite(epoch_cells.change_m)
        & np.isfinite(epoch_cells.random_m)
        & np.isfinite(np.asarray(epoch_cells.reference.elevation_m).ravel())
    )
    cells = observed.reshape(series.grid.shape)
    shared = epoch_cells.shared
    if not epoch_cells.adjusted:
        shared = difference_to_reference(shared, epoch_cells.reference.shared)
    return VarianceShares(
        series,
        epoch_ref,
        cells,
        aggregates.jacobian(epoch_cells, cells),
        epoch_cells.random_m[observed] ** 2,
        shared,
        epoch_cells.reference,
        (epoch_cells.scanner[0], epoch_cells.scanner[1], epoch_cells.scanner[2]),
    )
