"""Reading epochs: their data at some cells, the parameters that the cells share, and their reference."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import h5py
import numpy as np

from station.archive.derived.computed_rasters import CHANGE, RANDOM, is_value, read_raster
from station.archive.epochs import EpochRef
from station.archive.netcdf_layout import Series, decode_parameters
from station.archive.raster_io import bounding_slices
from station.archive.reference_files import open_reference
from station.archive.series.index import list_epochs, nearest_epoch
from station.archive.small_variables import read_epochs, read_number, read_text, read_variable
from station.errors import StationError, StoreError
from station.quantities import Bools, ChangeErrors, Floats, Floats32, Grid, Reference, SharedParameters
from station.queries.grid_arrays import to_index_or_time
from station.science.uncertainty.parameters import ParameterLayout, parameter_layout
from station.science.uncertainty.propagation import align_to

if TYPE_CHECKING:
    from station.queries.grid_arrays import Epoch

SCANNER_VARIABLES = (
    "scanner_east",
    "scanner_north",
    "scanner_height",
    "scanner_axis_east",
    "scanner_axis_north",
)
MAX_CACHED = 4  # epochs of which all but the cells is kept: an epoch and those that it is compared with
PARAMETER_VARIABLES = ("parameter_name", "parameter_unit")
SHARED_VARIABLES = ("shared_parameter", "shared_parameter_covariance", "shared_parameter_line_tilt_variance")
POSITIONS = "position_count"
LEVERAGE_VARIABLES = ("adjustment_leverage_moving", "adjustment_leverage_stable")
CHANGE_ERROR_VARIABLES = ("change_errors", "change_pattern")  # in the order of the fields of `ChangeErrors`


@dataclass(frozen=True)
class EpochCells:
    """Data of an epoch at some cells (n,), and the error parameters they share."""

    change_m: Floats
    random_m: Floats
    shared: SharedParameters | None
    scanner: tuple[float, ...]  # position on the grid [m], east and north component of the rotation axis
    reference: Reference
    adjusted: bool  # to the reference; `shared` is then relative to it
    has_positions: bool  # several, against each other in error
    epoch: EpochRef
    noise_leverage: tuple[float, float]  # of moving and stable cells on the adjustment; NaN if unknown
    members: tuple[SharedParameters, ...] = ()  # of a mean of epochs, those of each; the first is of `epoch`
    jacobian_factor: Floats32 | None = None  # (ny, nx) of a mean, where some epochs lack a cell


@dataclass(frozen=True)
class EpochMean:
    """Mean change of several epochs at the selected cells (ny, nx), from which that of others is counted.

    It has the reference, the scanner and the ground classes of one of them. A cell is the mean of the epochs
    that observed it, of which `count` (ny, nx) is the number.
    """

    cells: Bools
    values: EpochCells
    count: Floats32

    def at(self, cells: Bools) -> EpochCells:
        """Return the mean at some of its cells (ny, nx)."""
        inside = cells[self.cells]
        return replace(
            self.values, change_m=self.values.change_m[inside], random_m=self.values.random_m[inside]
        )


class EpochReader:
    """The epochs of a store and their references."""

    def __init__(self, series: Series) -> None:
        self.series = series
        self.grid = series.grid
        self._references: dict[str | None, Reference] = {}
        self._without_cells: dict[EpochRef, EpochCells] = {}  # areas are queried one by one

    def reference(self, version: str | None = None) -> Reference:
        """Return the newest reference surface or a version; raise StoreError if there is none."""
        if version not in self._references:
            reference = open_reference(self.series, version)
            if reference is None:
                raise StoreError(f"{self.series.folder}: no reference {version or 'yet'}: no change")
            self._references[version] = reference
        return self._references[version]

    def find_epoch(self, epoch: Epoch) -> EpochRef:
        """Return the epoch at an index in the series, or the nearest one within 12 h of a time (UTC).

        Raises StationError if there is none, ValueError if `epoch` is neither.
        """
        epochs, wanted = list_epochs(self.series), to_index_or_time(epoch)
        if not epochs:
            raise StoreError(f"{self.series.folder}: nothing is stored yet")
        if not isinstance(wanted, int):
            return nearest_epoch(epochs, float((wanted - np.datetime64(0, "s")) / np.timedelta64(1, "s")))
        if not -len(epochs) <= wanted < len(epochs):
            raise StationError(f"no epoch {wanted}: the series has {len(epochs)}")
        return epochs[wanted]

    def read_cells(self, epoch: EpochRef | EpochMean, cells: Bools) -> EpochCells:
        """Return the data of an epoch at the selected cells (ny, nx); raise ValueError on another grid."""
        if cells.shape != self.grid.shape:
            raise ValueError(f"the array has shape {cells.shape}, the grid {self.grid.shape}")
        if isinstance(epoch, EpochMean):
            return epoch.at(cells)
        without_cells = self.read_shared(epoch)
        with h5py.File(epoch.path, "r") as file:
            change_m, random_m = (read_cells_of(file, name, epoch.index, cells) for name in (CHANGE, RANDOM))
        return replace(without_cells, change_m=change_m, random_m=random_m)

    def read_shared(self, epoch: EpochRef) -> EpochCells:
        """Return the data of an epoch without any cell."""
        if epoch not in self._without_cells:
            if len(self._without_cells) == MAX_CACHED:
                self._without_cells.clear()
            self._without_cells[epoch] = self._read(epoch)
        return self._without_cells[epoch]

    def _read(self, epoch: EpochRef) -> EpochCells:
        with h5py.File(epoch.path, "r") as file:
            scanner = read_scanner(file, epoch.index, self.grid)
            moving, stable = (
                read_number(file, name, epoch.index) if name in file else np.nan
                for name in LEVERAGE_VARIABLES
            )
            return EpochCells(
                change_m=np.empty(0),
                random_m=np.empty(0),
                shared=self._read_shared(file, epoch, scanner),
                scanner=scanner,
                reference=self.reference(read_text(file, "reference_version", epoch.index)),
                adjusted=read_text(file, "adjustment", epoch.index) == "joint",
                has_positions=POSITIONS in file and read_number(file, POSITIONS, epoch.index) > 1,
                epoch=epoch,
                noise_leverage=(moving, stable),
            )

    def _read_shared(
        self, file: h5py.File, epoch: EpochRef, scanner: tuple[float, ...]
    ) -> SharedParameters | None:
        """Return the shared parameters of an epoch; None if the file does not contain them."""
        if "parameter_name" not in file or not np.isfinite(scanner).all():
            return None
        names, units = (tuple(decode_parameters(read_variable(file, name))) for name in PARAMETER_VARIABLES)
        has_change_errors = set(CHANGE_ERROR_VARIABLES) <= set(file)
        estimate, covariance, line_tilt_variance, *change_fields = (
            np.where(is_value(values), values.astype(np.float64), 0.0)  # 0 where not this epoch's
            for name in (*SHARED_VARIABLES, *(CHANGE_ERROR_VARIABLES if has_change_errors else ()))
            for values in read_epochs(file, name, epoch.index, 1)
        )
        change_errors = ChangeErrors(*change_fields) if change_fields else None
        shared = SharedParameters(names, units, estimate, covariance, line_tilt_variance, change_errors)
        return align_to(layout_of_scanner(self.grid, scanner)[0], shared)


def layout_of_scanner(
    grid: Grid, scanner: tuple[float, ...]
) -> tuple[ParameterLayout, tuple[float, float, float]]:
    """Return parameter layout and position [m] of a scanner, see `EpochCells`."""
    east_m, north_m, height_m, axis_east, axis_north = scanner
    axis_up = float(np.sqrt(max(1 - axis_east**2 - axis_north**2, 0.0)))
    position_m = east_m, north_m, height_m
    return parameter_layout(grid, position_m, (axis_east, axis_north, axis_up)), position_m


def read_scanner(file: h5py.File, index: int, grid: Grid) -> tuple[float, ...]:
    """Return position on the grid [m], and east and north component of the rotation axis, of a scanner.

    NaN what the epoch does not know.
    """
    east_m, north_m, height_m, *axis = (read_number(file, name, index) for name in SCANNER_VARIABLES)
    return *grid.plane.place_from_map((east_m, north_m, height_m)), *axis


def read_cells_of(file: h5py.File, name: str, index: int, cells: Bools) -> Floats:
    """Return the selected cells (n,) of a raster of a file; only their bounding box is read."""
    if not cells.any():
        return np.empty(0)
    bounds = bounding_box(cells, 0)
    return np.asarray(read_window(file, name, index, bounds)[cells[bounds]])


def observed_in_all(epochs: list[EpochCells], cells: Bools) -> Bools:
    """Return the mask (ny, nx) of the cells with a change and a reference in every epoch."""
    observed, bounds = np.zeros(cells.shape, np.bool_), bounding_box(cells, 0)
    observed[bounds][cells[bounds]] = np.logical_and.reduce(
        [
            np.isfinite(epoch_cells.change_m) & np.isfinite(epoch_cells.reference.elevation_m[cells])
            for epoch_cells in epochs
        ]
    )
    return observed


def read_window(file: h5py.File, name: str, index: int, window: tuple[slice, slice]) -> Floats:
    """Return a window of a raster of a file, NaN without a value; not of the elevation."""

    def read(stored: str) -> Floats | None:
        return file[stored][(index, *window)].astype(np.float64) if stored in file else None

    values = read_raster(name, read, lambda: np.empty(0))
    return np.where(is_value(values), values, np.nan)


def bounding_box(cells: Bools, margin: int) -> tuple[slice, slice]:
    """Return the rows and columns that bound the selected cells (ny, nx), extended by a margin."""
    rows, columns = bounding_slices(cells)
    return (
        slice(max(rows.start - margin, 0), rows.stop + margin),
        slice(max(columns.start - margin, 0), columns.stop + margin),
    )
