"""`series.nc`: the whole series as one virtual file over the epochs, days and months that exist."""

from __future__ import annotations

import os
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import h5py
import netCDF4
import numpy as np

from station.archive.layout import Series, attributes, define, lay_out, strings, written_whole
from station.archive.store import Row, rows, sources
from station.archive.variables import FILL, VARIABLES, Variable
from station.errors import StoreError

Parameters = dict[str, str]  # unit of each shared parameter, by its name

PARAMETER = ("parameter_name", "parameter_unit")
LIGHT = tuple(row for row in VARIABLES if not row.is_heavy)
HEAVY = tuple(row for row in VARIABLES if row.is_heavy)


@dataclass(frozen=True)
class Source:
    """A file that holds epochs: which of its rows are wanted, and all of it that is small."""

    path: Path
    first: int  # row of the file
    at: int  # row of the series
    count: int
    words: dict[str, np.ndarray[Any, Any]]  # the wanted rows of every small variable
    shapes: dict[str, tuple[int, ...]]  # of the large variables
    parameters: Parameters


def build_series(series: Series) -> Path:
    """Write `series.nc` anew over the files that exist and put it in place of the old one.

    Raises StoreError where a file is damaged, nothing is stored yet, or it cannot write.
    """
    found = rows(series)
    if not found:
        raise StoreError(f"{series.folder}: nothing is stored yet")
    held = [read_source(*run) for run in runs(found)]
    parameters: Parameters = {}
    for source in reversed(held):
        parameters = source.parameters | parameters
    with written_whole(series.path) as beside:
        with netCDF4.Dataset(beside, "w", clobber=False) as file:
            title = f"Elevation change at {series.name or series.station_id}"
            write_words(file, series, title, held, parameters)
        with h5py.File(beside, "r+", libver=("v110", "v110")) as file:
            for row in HEAVY:
                if any(row.name in source.shapes for source in held):
                    _point(file, series, row, held, parameters)
        _retire(sources(series.path) - {source.path for source in held})
    return series.path


def _retire(paths: set[Path]) -> None:
    """Let the grace of files that the series names no longer begin now."""
    for path in paths:
        if path.is_file():
            os.utime(path)


def runs(found: list[Row]) -> list[tuple[Path, int, int, int]]:
    """Group rows that lie in one file in the same order: (path, first row there, first row here, count)."""
    grouped = groupby(enumerate(found), key=lambda pair: (pair[1].path, pair[1].index - pair[0]))
    runs = []
    for (path, shift), group in grouped:
        at = [place for place, _ in group]
        runs.append((path, at[0] + shift, at[0], len(at)))
    return runs


def read_source(path: Path, first: int, at: int, count: int) -> Source:
    """Read what is small of some rows of a file; raise StoreError where it is damaged."""
    wanted = slice(first, first + count)
    try:
        with h5py.File(path, "r") as file:
            names = set(file)
            light = {"time", "time_bnds", *(row.name for row in LIGHT)} & names
            told = [
                strings(_read(file, name)) for name in ("parameter_name", "parameter_unit") if name in names
            ]
            return Source(
                path=path,
                first=first,
                at=at,
                count=count,
                words={name: _read(file, name)[wanted] for name in light},
                shapes={row.name: _open(file, row.name).shape for row in HEAVY if row.name in names},
                parameters=dict(zip(*told, strict=True)) if told else {},
            )
    except (OSError, RuntimeError, KeyError) as error:
        raise StoreError(f"{path}: damaged, cannot be read: {error}") from error


def _open(file: Any, name: str) -> Any:  # noqa: ANN401 - h5py has no types
    """Open a variable. Below h5py's comfort, which takes most of the time of hundreds of small files."""
    return h5py.h5d.open(file.id, name.encode())


def _read(file: Any, name: str) -> np.ndarray[Any, Any]:  # noqa: ANN401
    variable = _open(file, name)
    values = np.empty(variable.shape, variable.dtype)
    variable.read(h5py.h5s.ALL, h5py.h5s.ALL, values)
    return values


def write_words(
    file: netCDF4.Dataset, series: Series, title: str, held: list[Source], parameters: Parameters
) -> None:
    """Write a file of many epochs but for its large variables. What a source lacks stays missing."""
    file.set_auto_mask(False)
    file.set_auto_chartostring(False)
    count = sum(source.count for source in held)
    lay_out(file, series, title, count, (tuple(parameters), tuple(parameters.values())))
    for row in LIGHT:
        if all(dim in file.dimensions for dim in row.dims):
            define(file, row, series, count)
    for name, variable in file.variables.items():
        if variable.dimensions[:1] != ("time",):
            continue
        fill = {"S": b"", "f": FILL}.get(variable.dtype.kind, 0)
        values = np.full((count, *variable.shape[1:]), fill, variable.dtype)
        for source in held:
            if name in source.words:
                at = slice(source.at, source.at + source.count)
                where = _places(source, parameters) if "parameter" in variable.dimensions else ...
                values[at, where] = source.words[name]
        variable[:] = values


def _places(source: Source, parameters: Parameters) -> list[int]:
    """Return where the source's shared parameters stand among all (p,)."""
    place = {name: index for index, name in enumerate(parameters)}
    return [place[name] for name in source.parameters]


def _point(file: Any, series: Series, row: Variable, held: list[Source], parameters: Parameters) -> None:  # noqa: ANN401 - h5py has no types
    """Add a large variable as a virtual one, with paths relative to the series."""
    shape = tuple(len(file[dim]) for dim in row.dims)
    layout = h5py.VirtualLayout(shape, row.dtype)
    for source in held:
        if row.name not in source.shapes:
            continue
        whole = source.shapes[row.name]
        origin = h5py.VirtualSource(os.path.relpath(source.path, series.folder), row.name, whole, row.dtype)
        at, there = (slice(start, start + source.count) for start in (source.at, source.first))
        if row.is_raster:
            layout[at] = origin if source.count == whole[0] else origin[there]
            continue
        blocks = _blocks(_places(source, parameters))
        for there_1, at_1 in blocks:
            for there_2, at_2 in blocks:
                layout[at, at_1, at_2] = origin[there, there_1, there_2]
    fill = FILL if row.dtype[0] == "f" else 0
    _dress(file.create_virtual_dataset(row.name, layout, fillvalue=fill), file, row, series)


def _blocks(places: list[int]) -> list[tuple[slice, slice]]:
    """Cut places into stretches that follow one another: pairs of (from, to)."""
    blocks = []
    for _, group in groupby(enumerate(places), key=lambda pair: pair[1] - pair[0]):
        pairs = list(group)
        (first, to), count = pairs[0], len(pairs)
        blocks.append((slice(first, first + count), slice(to, to + count)))
    return blocks


def _dress(made: Any, file: Any, row: Variable, series: Series) -> None:  # noqa: ANN401 - h5py has no types
    """Give a virtual variable its dimensions and attributes the way netCDF expects them."""
    for axis, dim in enumerate(row.dims):
        made.dims[axis].attach_scale(file[dim])
    for key, value in attributes(row, mapped=series.crs is not None).items():
        made.attrs[key] = np.bytes_(value) if isinstance(value, str) else value
    if row.dtype[0] == "f":
        made.attrs["_FillValue"] = np.array([FILL], dtype=row.dtype)
