"""`areas.nc`: mean and volume change of named areas over time, computed from the epochs."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any, Protocol

import h5py
import netCDF4
import numpy as np
import shapely

from station.archive.atomic_files import atomic_write
from station.archive.derived import area_geometry
from station.archive.derived.fingerprints import is_intact, write_fingerprints
from station.archive.discovery import time_coverage
from station.archive.epochs import EpochRef
from station.archive.netcdf_layout import (
    TIMES_PER_CHUNK,
    Series,
    create_time_axis,
    create_variable,
    decode_text,
    write_global_attrs,
)
from station.archive.schema import BY_NAME, FILL, TEXT, TEXT_LENGTH, Variable
from station.archive.series.epoch_reader import LIBVER_COMPAT, contiguous_runs, copy_unchanged, read_source
from station.archive.series.index import SeriesIndex
from station.errors import StoreError
from station.quantities import Bools
from station.science.gridding.significance import SIGNIFICANT_SIGMAS

Columns = dict[str, np.ndarray[Any, Any]]  # variables over time, as stored

FILE_NAME = "areas.nc"
MASKS_ATTRIBUTE = "area_masks_sha256"
MISSING = -1
_OVER_TIME = ("time", "area")
_ONE_SIGMA = "one standard deviation, including errors shared by all cells of a scan and interpolation"


@dataclass(frozen=True)
class AreaChange:
    """Change of an area: mean with voids interpolated, median of the observed cells, one sigma each [m].

    NaN if no cell was observed.
    """

    mean_m: float
    mean_sigma_m: float
    median_m: float
    median_sigma_m: float
    coverage: float  # share of the cells that have a change


def _with_uncertainty(quantity: str, description: str, units: str, comment: str) -> tuple[Variable, ...]:
    """Return the variables of a quantity: value, one sigma, and the bounds of the 95 % interval."""
    return (
        Variable(
            quantity,
            _OVER_TIME,
            "f8",
            f"{description} of the area",
            units,
            comment=comment,
            ancillary=tuple(f"{quantity}_{bound}" for bound in ("uncertainty", "low", "high")),
        ),
        Variable(
            f"{quantity}_uncertainty",
            _OVER_TIME,
            "f8",
            f"uncertainty of the {description}",
            units,
            comment=_ONE_SIGMA,
        ),
        Variable(f"{quantity}_low", _OVER_TIME, "f8", f"lower bound of the {description} at 95 %", units),
        Variable(f"{quantity}_high", _OVER_TIME, "f8", f"upper bound of the {description} at 95 %", units),
    )


AREA_VARIABLES: tuple[Variable, ...] = (
    Variable("area_name", ("area", "area_text"), "S1", "name of the area"),
    Variable("area_size", ("area",), "f8", "horizontal size of the area's cells on the grid", "m2"),
    *_with_uncertainty(
        "mean_change", "mean elevation change", "m",
        "relative to the reference surface; cells without a change are interpolated from their neighbours",
    ),
    *_with_uncertainty("median_change", "median elevation change", "m", "of the cells that have a change"),
    *_with_uncertainty("volume_change", "volume change", "m3", "mean_change times area_size"),
    Variable("coverage", _OVER_TIME, "f8", "share of the area's cells that have a change", "1"),
    BY_NAME["epoch_file"],
    BY_NAME["reference_version"],
)  # fmt: skip


class Aggregator(Protocol):
    """Computes the change of an area and its uncertainty."""

    def area(self, cells: Bools, epoch: EpochRef) -> AreaChange:
        """Return the change of the cells (ny, nx) in an epoch; NaN if no cell has a change."""


def update_areas(
    series: Series,
    areas: dict[str, Bools],
    aggregator: Aggregator,
    progress: Callable[[], None],
    polygons: Mapping[str, shapely.Geometry] | None = None,
) -> Path | None:
    """Bring `areas.nc` up to date with `series.nc` and return its path; `areas` are masks (ny, nx) by name.

    `polygons` are the outlines of the areas, which the file contains too. Epochs already in the file are not
    computed again unless an area has changed or the file is damaged. Returns None and writes nothing if there
    is no area or no epoch. `progress` is called after each epoch computed. Raises StoreError if an epoch is
    damaged or the file cannot be written; the old file remains.
    """
    epochs = SeriesIndex(series) if areas else ()
    if not epochs:
        return None
    path = series.folder / FILE_NAME
    masks = masks_hash(series, areas)
    unchanged, known = 0, _blank(0, len(areas))
    if is_intact(path):
        unchanged, known = _read_known(path, masks, len(areas), epochs)
    known_row = {
        key: index
        for index, key in enumerate(_epoch_keys(known["time"], _join_characters(known["epoch_file"])))
    }
    known_rows = [
        known_row.get(key, MISSING)
        for key in _epoch_keys(epochs.time_s[unchanged:], epochs.epoch_file[unchanged:])
    ]
    if known_rows == list(range(len(known_row))) and _has_outlines(path, polygons):
        return path
    size_m2 = np.array([np.count_nonzero(cells) for cells in areas.values()]) * series.grid.cell_m**2
    missing = [
        epochs[unchanged + index] for index, known_row in enumerate(known_rows) if known_row == MISSING
    ]
    computed = _compute(missing, areas, size_m2, aggregator, progress)
    is_known = np.array(known_rows) != MISSING
    columns = _blank(len(known_rows), len(areas))
    for name, column in columns.items():
        column[is_known] = known[name][[index for index in known_rows if index != MISSING]]
        column[~is_known] = computed[name]
    with atomic_write(path) as tmp_path:
        with netCDF4.Dataset(tmp_path, "w", clobber=False) as file:
            _write(file, series, tuple(areas), size_m2, columns, unchanged)
            if polygons:
                _describe_outlines(file, series, polygons)
            file.setncattr(MASKS_ATTRIBUTE, masks)
            file.setncatts(time_coverage(epochs.start_s[0], columns["time_bnds"][-1, 1]))
        if unchanged:
            with h5py.File(path, "r") as old_file, h5py.File(tmp_path, "r+", libver=LIBVER_COMPAT) as file:
                copy_unchanged(old_file, file, tuple(columns), unchanged)
        write_fingerprints(path, tmp_path)
    return path


def masks_hash(series: Series, areas: dict[str, Bools]) -> str:
    """Return a hash of the areas: names, order, cells and grid."""
    digest = hashlib.sha256(json.dumps([astuple(series.grid), list(areas)]).encode())
    for cells in areas.values():
        digest.update(np.packbits(cells).tobytes())
    return digest.hexdigest()


def matches(path: Path, series: Series, areas: dict[str, Bools]) -> bool:
    """Return True if a file contains the series of exactly these areas."""
    try:
        with h5py.File(path, "r") as file:
            return bool(file.attrs[MASKS_ATTRIBUTE] == np.bytes_(masks_hash(series, areas)))
    except (OSError, RuntimeError, KeyError):
        return False


def area_polygons(series: Series) -> dict[str, shapely.Geometry]:
    """Return the outlines in `areas.nc` by the name of their area; empty without the file or outlines."""
    path = series.folder / FILE_NAME
    if not path.is_file():
        return {}
    try:
        with netCDF4.Dataset(path) as file:
            file.set_auto_chartostring(False)
            names = decode_text(np.ma.getdata(file["area_name"][:]))
            return dict(zip(names, area_geometry.read_polygons(file), strict=False))
    except (OSError, RuntimeError, KeyError, IndexError) as error:
        raise StoreError(f"{path}: cannot be read: {error}") from error


def _has_outlines(path: Path, polygons: Mapping[str, shapely.Geometry] | None) -> bool:
    """Return True if a file contains these outlines, or none if there are none."""
    expected = area_geometry.polygons_hash(polygons) if polygons else ""
    with h5py.File(path, "r") as file:
        return bool(file.attrs.get(area_geometry.POLYGONS_ATTRIBUTE, b"") == np.bytes_(expected))


def _describe_outlines(
    file: netCDF4.Dataset, series: Series, polygons: Mapping[str, shapely.Geometry]
) -> None:
    """Add the outlines of the areas, and refer to them from every variable over time and area."""
    area_geometry.write_polygons(file, series, polygons)
    for spec in AREA_VARIABLES:
        if spec.dims == _OVER_TIME:
            file[spec.name].setncatts(
                {"geometry": area_geometry.CONTAINER}
                | ({"grid_mapping": "crs"} if series.crs is not None else {})
            )


def _blank(times: int, areas: int) -> Columns:
    """Return empty columns."""
    return {
        "time": np.zeros(times),
        "time_bnds": np.zeros((times, 2)),
        **{spec.name: np.full((times, areas), FILL) for spec in AREA_VARIABLES if spec.dims == _OVER_TIME},
        **{
            spec.name: np.zeros((times, TEXT_LENGTH["text"]), "S1")
            for spec in AREA_VARIABLES
            if spec.dims == TEXT
        },
    }


def _epoch_keys(time_s: np.ndarray[Any, Any], epoch_file: np.ndarray[Any, Any]) -> list[tuple[float, bytes]]:
    """Return the keys that identify epochs: time and file name."""
    return list(zip(time_s.tolist(), epoch_file.tolist(), strict=True))


def _join_characters(characters: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Return characters (n, length) as byte strings (n,)."""
    return np.ascontiguousarray(characters).view(f"S{characters.shape[-1]}")[:, 0]


def _read_known(path: Path, masks: str, areas: int, index: SeriesIndex) -> tuple[int, Columns]:
    """Return the number of leading epochs that can be copied unchanged, and the columns of those after them.

    The unchanged epochs fill whole chunks. Zero and empty columns if the file is missing, damaged or of
    other areas.
    """
    blank = _blank(0, areas)
    try:
        with h5py.File(path, "r") as file:
            if file.attrs[MASKS_ATTRIBUTE] != np.bytes_(masks):
                return 0, blank
            times = len(file["time"])
            if any(file[name].shape != (times, *column.shape[1:]) for name, column in blank.items()):
                return 0, blank
            is_unchanged = np.array_equal(file["time"][:], index.time_s[:times])
            is_unchanged = is_unchanged and np.array_equal(
                _join_characters(file["epoch_file"][:]), index.epoch_file[:times]
            )
            is_unchanged = is_unchanged and all(file[name].chunks[0] == TIMES_PER_CHUNK for name in blank)
            unchanged = times // TIMES_PER_CHUNK * TIMES_PER_CHUNK if is_unchanged else 0
            return unchanged, {
                name: np.asarray(file[name][unchanged:], dtype=column.dtype) for name, column in blank.items()
            }
    except (OSError, RuntimeError, KeyError, TypeError, ValueError):
        return 0, blank


def _compute(
    missing: list[EpochRef],
    areas: dict[str, Bools],
    size_m2: np.ndarray[Any, Any],
    aggregator: Aggregator,
    progress: Callable[[], None],
) -> Columns:
    """Compute the columns of the missing epochs; fill values for epochs without a reference."""
    columns = _blank(len(missing), len(areas))
    for path, first, start, count in contiguous_runs(missing):
        scalars = read_source(path, first, start, count).scalars
        for name in ("time", "time_bnds", "epoch_file", "reference_version"):
            columns[name][start : start + count] = scalars[name]
    for index, version in enumerate(decode_text(columns["reference_version"])):
        for area, cells in enumerate(areas.values()):
            if version and size_m2[area] > 0:
                statistics = area_statistics(aggregator.area(cells, missing[index]), float(size_m2[area]))
                for name, value in statistics.items():
                    columns[name][index, area] = value if np.isfinite(value) else FILL
        progress()
    return columns


def area_statistics(change: AreaChange, size_m2: float) -> dict[str, float]:
    """Return mean, median and volume change of an area of `size_m2` with 95 % bounds, by variable name."""
    statistics: dict[str, float] = {}
    for name, value, sigma in (
        ("mean_change", change.mean_m, change.mean_sigma_m),
        ("median_change", change.median_m, change.median_sigma_m),
        ("volume_change", change.mean_m * size_m2, change.mean_sigma_m * size_m2),
    ):
        half_width = SIGNIFICANT_SIGMAS * sigma
        statistics |= {
            name: value,
            f"{name}_uncertainty": sigma,
            f"{name}_low": value - half_width,
            f"{name}_high": value + half_width,
        }
    return statistics | {"coverage": change.coverage}


def _write(
    file: netCDF4.Dataset,
    series: Series,
    names: tuple[str, ...],
    size_m2: np.ndarray[Any, Any],
    columns: Columns,
    first: int,
) -> None:
    """Write the areas, and their columns starting at epoch `first`."""
    times = first + len(columns["time"])
    encoded_names = np.array([name.encode() for name in names])
    write_global_attrs(file, series, f"Elevation change of areas at {series.name or series.station_id}")
    for dim, length in {
        "time": None,
        "bnds": 2,
        "area": len(names),
        "area_text": encoded_names.dtype.itemsize,
        "text": TEXT_LENGTH["text"],
    }.items():
        file.createDimension(dim, length)
    file.setncatts({"featureType": "timeSeries", "cdm_data_type": "Station"})
    create_time_axis(file, times)
    for spec in AREA_VARIABLES:
        variable = create_variable(file, spec, series, times)
        if spec.dims == _OVER_TIME:
            variable.coordinates = "area_name"  # a label that CDO and NCO preserve and xarray selects by
    file.set_auto_mask(False)
    file.set_auto_chartostring(False)
    file["area_name"].setncatts({"_Encoding": "utf-8", "cf_role": "timeseries_id"})
    characters = encoded_names.view("S1").reshape(len(names), -1)
    file["area_name"][:], file["area_size"][:] = characters, size_m2
    for name, column in columns.items():
        file[name][first:times] = column
