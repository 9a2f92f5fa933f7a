"""The uncertainty of anything linear in the cells: a box, an area, a volume, a difference of two epochs."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import netCDF4
import numpy as np

from station.archive.layout import Series, strings
from station.archive.reference import read_reference
from station.archive.store import Row, rows
from station.errors import StoreError
from station.quantities import Bools, Floats, Reference, Shared
from station.science.shared import Sensitivities, aggregate_variance, basis, cell_sensitivities
from station.science.terrain import smooth_gradient

CHANGE, RANDOM = "elevation_change", "elevation_change_random_uncertainty"


class Aggregates:
    """Means and variances over cells of the epochs of a store, from what each epoch keeps."""

    def __init__(self, series: Series) -> None:
        self._series = series

    @cached_property
    def _reference(self) -> Reference:
        found = read_reference(self._series)
        if found is None:
            raise StoreError(f"{self._series.folder}: no reference yet, so there is no change to sum up")
        return found

    @cached_property
    def _gradient(self) -> tuple[Any, Any]:
        return smooth_gradient(self._reference.elevation_m, self._series.grid.cell_m)

    def row(self, epoch: int | str | np.datetime64) -> Row:
        """Find an epoch by its place in the series or by the time nearest to its middle (UTC)."""
        found = rows(self._series)
        if not found:
            raise StoreError(f"{self._series.folder}: nothing is stored yet")
        if isinstance(epoch, (int, np.integer)):
            return found[epoch]
        wanted_s = float((np.datetime64(str(epoch)) - np.datetime64(0, "s")) / np.timedelta64(1, "s"))
        return min(found, key=lambda row: abs(row.time_s - wanted_s))

    def variance(self, weights: Floats, row: Row, other: Row | None = None) -> float:
        """Variance of the weighted sum of the change in an epoch, or of its difference to another epoch.

        `weights` (ny, nx), nought outside. The unit is that of the weights squared, times m². Cells without a
        change count nothing. Source: EQUATIONS 6.2.
        """
        cells = np.isfinite(self._reference.elevation_m) & (weights != 0)
        epochs = [row] if other is None else [row, other]
        held = [self._read(one, cells) for one in epochs]
        seen = np.logical_and.reduce([np.isfinite(random_m) for _, random_m, _, _ in held])
        chosen = cells.copy()
        chosen[cells] = seen
        weights = weights[chosen]
        before_m2 = self._reference.random_variance_m2[chosen].astype(np.float64)
        total = 0.0
        for _, random_m, unknown, scanner in held:
            random_m2 = random_m[seen] ** 2
            if other is not None:  # what the reference does not know is in both and goes
                random_m2 = np.maximum(random_m2 - before_m2, 0.0)
            if unknown is None or scanner is None:
                total += float(np.sum(weights**2 * random_m2))
                continue
            if other is None:
                unknown = self._with_reference(unknown, row)
            total += aggregate_variance(weights, random_m2, self._felt(chosen, scanner), unknown)
        return total

    def mean_change(self, cells: Bools, row: Row) -> tuple[float, float, float]:
        """Mean change of the cells (ny, nx) in an epoch [m], one sigma [m], share of cells with a change."""
        change_m = self._read(row, cells)[0]
        seen = np.isfinite(change_m)
        if not seen.any():
            return np.nan, np.nan, 0.0
        weights = np.zeros(cells.shape)
        weights[cells] = seen / seen.sum()
        sigma_m = float(np.sqrt(self.variance(weights, row)))
        return float(change_m[seen].mean()), sigma_m, float(seen.mean())

    def _felt(self, cells: Bools, scanner: tuple[float, ...]) -> Sensitivities:
        east_m, north_m, height_m, axis_east, axis_north = scanner
        up = float(np.sqrt(max(1 - axis_east**2 - axis_north**2, 0.0)))
        position_m = east_m, north_m, height_m
        of = basis(self._series.grid, position_m, (axis_east, axis_north, up))
        return cell_sensitivities(
            of, self._series.grid, position_m, self._reference.elevation_m, self._gradient, cells
        )

    def _with_reference(self, unknown: Shared, row: Row) -> Shared:
        """Add what the reference does not know, unless the scan was adjusted to it."""
        with netCDF4.Dataset(row.path) as file:
            joint = str(file["adjustment"][row.index]) == "joint"
        common = self._reference.shared
        return unknown if joint or common is None else unknown + common

    def _read(self, row: Row, cells: Bools) -> tuple[Floats, Floats, Shared | None, tuple[float, ...] | None]:
        """Change and random sigma of some cells (n,) [m], what they share, and where the scanner stood."""
        with netCDF4.Dataset(row.path) as file:
            if cells.any():
                change_m, random_m = (_cells(file[name], row.index, cells) for name in (CHANGE, RANDOM))
            else:
                change_m, random_m = np.empty(0), np.empty(0)
            scanner = tuple(float(np.ma.filled(file[name][row.index], np.nan)) for name in SCANNER)
            if "parameter_name" not in file.variables or not np.isfinite(scanner).all():
                return change_m, random_m, None, None
            file.set_auto_chartostring(False)
            names, units = (tuple(strings(np.ma.getdata(file[name][:]))) for name in PARAMETER)
            estimate, covariance, noise = (
                np.asarray(file[name][row.index], dtype=np.float64)
                for name in (
                    "shared_parameter", "shared_parameter_covariance", "shared_parameter_noise_variance"
                )
            )  # fmt: skip
        return change_m, random_m, Shared(names, units, estimate, covariance, noise), scanner


SCANNER = ("scanner_east", "scanner_north", "scanner_height", "scanner_axis_east", "scanner_axis_north")
PARAMETER = ("parameter_name", "parameter_unit")


def _cells(variable: Any, index: int, cells: Bools) -> Floats:  # noqa: ANN401 - netCDF4 has no types
    """Read the chosen cells (n,) of a raster, and no more of it than their bounding box."""
    row, column = np.flatnonzero(cells.any(axis=1)), np.flatnonzero(cells.any(axis=0))
    box = slice(row[0], row[-1] + 1), slice(column[0], column[-1] + 1)
    values = np.ma.filled(variable[index, box[0], box[1]].astype(np.float64), np.nan)
    return np.asarray(values[cells[box]])
