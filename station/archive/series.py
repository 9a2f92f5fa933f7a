"""`series.nc`: the whole series as one virtual file over the epochs, days and months that exist."""

from __future__ import annotations

import os
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import h5py
import netCDF4
import numpy as np

from station.archive import store
from station.archive.layout import Series, attributes, define, lay_out, put_raster, written_whole
from station.archive.variables import BY_NAME, FILL, VARIABLES, Variable
from station.errors import StoreError


@dataclass(frozen=True)
class Row:
    """One epoch and where it is: a file and the index in it."""

    epoch_file: str
    start: datetime
    revision: int
    path: Path
    index: int
    time_s: float


def rows(series: Series) -> list[Row]:
    """Return the epochs of the series in the order of time: of each start the newest revision.

    Where several files hold it, months go before days before epochs, and a newer joined file before an older.
    """
    best: dict[datetime, tuple[tuple[int, int, int], Row]] = {}
    for rank, kind in enumerate(("days", "months"), start=1):
        for path in joined(series, kind):
            for row in rows_in(path):
                key = (row.revision, rank, _joined_revision(path))
                if row.start not in best or key > best[row.start][0]:
                    best[row.start] = key, row
    for one in store.epochs(series):
        if one.start not in best or one.revision > best[one.start][0][0]:
            best[one.start] = (one.revision, 0, 0), rows_in(one.path)[0]
    return _increasing(sorted((row for _, row in best.values()), key=lambda row: (row.time_s, row.start)))


def _increasing(found: list[Row]) -> list[Row]:
    """Leave out epochs whose time is not after the one before: two scans cannot share a middle."""
    kept: list[Row] = []
    for row in found:
        if not kept or row.time_s > kept[-1].time_s:
            kept.append(row)
    return kept


def joined(series: Series, kind: str) -> list[Path]:
    """Return the joined files of days or months, oldest revision first."""
    found = (path for path in (series.folder / kind).glob("**/*.nc") if not path.name.startswith("."))
    return sorted(found, key=lambda path: (path.name.split("_r")[0], _joined_revision(path)))


def _joined_revision(path: Path) -> int:
    tail = path.stem.rpartition("_r")[2]
    return int(tail) if tail.isdigit() else 0


def rows_in(path: Path) -> list[Row]:
    """Return the epochs in a file; raise StoreError where it is damaged."""
    try:
        with netCDF4.Dataset(path) as file:
            file.set_auto_chartostring(False)
            times = np.asarray(file["time"][:], dtype=np.float64)
            names = netCDF4.chartostring(file["epoch_file"][:], encoding="ascii")
    except (OSError, RuntimeError, KeyError, IndexError) as error:
        raise StoreError(f"{path}: damaged, cannot be read: {error}") from error
    found = []
    for index, (time_s, name) in enumerate(zip(times.tolist(), names.tolist(), strict=True)):
        told = store.stored(Path(name))
        if told is None:
            raise StoreError(f"{path}: damaged, names no epoch file in row {index}")
        found.append(Row(name, told.start, told.revision, path, index, time_s))
    return found


def build_series(series: Series) -> Path:
    """Write `series.nc` anew over the files that exist and put it in place of the old one."""
    found = rows(series)
    if not found:
        raise StoreError(f"{series.folder}: nothing is stored yet")
    with written_whole(series.path) as beside:
        _write_words(beside, series, found)
        _point_to_rasters(beside, series, found)
    return series.path


def runs(found: list[Row]) -> list[tuple[Path, int, int, int]]:
    """Group rows that lie in one file in the same order: (path, first index, first row, count)."""
    grouped: list[tuple[Path, int, int, int]] = []
    for at, row in enumerate(found):
        if grouped:
            path, index, first, count = grouped[-1]
            if path == row.path and index + count == row.index:
                grouped[-1] = (path, index, first, count + 1)
                continue
        grouped.append((row.path, row.index, at, 1))
    return grouped


def _write_words(place: Path, series: Series, found: list[Row]) -> None:
    """Copy what is small: times, numbers, texts."""
    with netCDF4.Dataset(found[-1].path) as newest:
        parameters = _parameters_of(newest)
    title = f"Elevation change at {series.name or series.station_id}"
    with netCDF4.Dataset(place, "w", clobber=False) as file:
        file.set_auto_chartostring(False)
        lay_out(file, series, title, len(found), parameters)
        light = [row for row in VARIABLES if not row.is_heavy and row.name != "shared_parameter"]
        made = {row.name: define(file, row, series) for row in light}
        for path, index, at, count in runs(found):
            with netCDF4.Dataset(path) as source:
                source.set_auto_chartostring(False)
                here, there = slice(at, at + count), slice(index, index + count)
                for name in ("time", "time_bnds"):
                    file[name][here] = source[name][there]
                for name, variable in made.items():
                    variable[here] = source[name][there]


def _parameters_of(file: netCDF4.Dataset) -> tuple[tuple[str, ...], tuple[str, ...]]:
    if "parameter_name" not in file.variables:
        return (), ()
    file.set_auto_chartostring(False)
    names, units = (
        tuple(netCDF4.chartostring(file[name][:], encoding="ascii").tolist())
        for name in ("parameter_name", "parameter_unit")
    )
    return names, units


def _point_to_rasters(place: Path, series: Series, found: list[Row]) -> None:
    """Add the large variables as virtual ones, with paths relative to the series."""
    grouped = runs(found)
    held = {path: _variables_of(path) for path, *_ in grouped}
    with h5py.File(place, "r+", libver=("v110", "v110")) as file:
        sizes = {dim: len(file[dim]) for dim in ("time", "y", "x", "parameter", "parameter_2") if dim in file}
        for row in VARIABLES:
            if not (row.is_heavy or row.name == "shared_parameter"):
                continue
            if any(dim not in sizes for dim in row.dims) or not any(
                row.name in names for names in held.values()
            ):
                continue
            shape = tuple(sizes[dim] for dim in row.dims)
            layout = h5py.VirtualLayout(shape, row.dtype)
            for path, index, at, count in grouped:
                if held[path].get(row.name) != shape[1:]:
                    continue
                relative = os.path.relpath(path, place.parent)
                source = h5py.VirtualSource(relative, row.name, (index + count, *shape[1:]), row.dtype)
                layout[at : at + count] = source[index : index + count]
            fill = FILL if row.dtype[0] == "f" else 0
            _dress(file.create_virtual_dataset(row.name, layout, fillvalue=fill), file, row, series)


def _variables_of(path: Path) -> dict[str, tuple[int, ...]]:
    with h5py.File(path, "r") as file:
        return {name: item.shape[1:] for name, item in file.items() if isinstance(item, h5py.Dataset)}


def _dress(made: Any, file: Any, row: Variable, series: Series) -> None:  # noqa: ANN401 - h5py has no types
    """Give a virtual variable its dimensions and attributes the way netCDF expects them."""
    for axis, dim in enumerate(row.dims):
        made.dims[axis].attach_scale(file[dim])
    for key, value in attributes(row, mapped=series.crs is not None).items():
        made.attrs[key] = np.bytes_(value) if isinstance(value, str) else value
    if row.dtype[0] == "f":
        made.attrs["_FillValue"] = np.array([FILL], dtype=row.dtype)
    if row.digits is not None:
        made.attrs["least_significant_digit"] = np.int32(row.digits)


def join(series: Series, found: list[Row], path: Path, title: str) -> None:
    """Copy epochs into one file, raster by raster."""
    with netCDF4.Dataset(found[-1].path) as newest:
        parameters = _parameters_of(newest)
    with written_whole(path) as beside, netCDF4.Dataset(beside, "w", clobber=False) as file:
        file.set_auto_chartostring(False)
        lay_out(file, series, title, len(found), parameters)
        for at, row in enumerate(found):
            with netCDF4.Dataset(row.path) as source:
                source.set_auto_chartostring(False)
                _copy(file, series, at, source, row.index)


def _copy(file: netCDF4.Dataset, series: Series, at: int, source: netCDF4.Dataset, index: int) -> None:
    for name in ("time", "time_bnds"):
        file[name][at] = source[name][index]
    for name in source.variables:
        row = BY_NAME.get(name)
        if row is None or any(dim not in file.dimensions for dim in row.dims):
            continue
        variable = file[name] if name in file.variables else define(file, row, series)
        if row.is_raster:
            values = source[name][index]
            put_raster(variable, at, values.filled(np.nan) if row.dtype[0] == "f" else np.asarray(values))
        else:
            variable[at] = source[name][index]
