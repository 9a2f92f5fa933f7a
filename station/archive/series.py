"""`series.nc`: the whole series as one virtual file over the epochs, days and months that exist."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import replace
from itertools import groupby, product
from pathlib import Path
from typing import Any

import h5py
import netCDF4
import numpy as np

from station.archive.layout import TIMES_TOGETHER, Series, attributes, define, lay_out, written_whole
from station.archive.made import Made, newer, note
from station.archive.sources import (
    HEAVY,
    LIGHT,
    Parameters,
    Source,
    read_source,
    runs,
    take_over,
)
from station.archive.store import rows, sources
from station.archive.variables import FILL, Variable
from station.errors import StoreError

VIRTUAL = ("v110", "v110")  # bounds of the format: with newer ones only xarray can read it


def build_series(series: Series) -> Path:
    """Bring `series.nc` up to the files that exist: a new one takes the place of the old.

    Where only newer epochs came, what the old one holds of the others is taken over, and of the files only
    theirs are opened. Raises StoreError where a file is damaged, nothing is stored yet, or it cannot write.
    """
    grown = newer(series)
    if grown is None:
        return _build_anew(series)
    made, fresh = grown
    if not fresh:
        return series.path
    whole = made.count // TIMES_TOGETHER * TIMES_TOGETHER
    known = read_source(series.path, whole, whole, made.count - whole)
    with written_whole(series.path) as beside:
        with netCDF4.Dataset(beside, "w", clobber=False) as file:
            write_words(file, series, _title(series), [known, *fresh], made.parameters)
        with h5py.File(beside, "r+", libver=VIRTUAL) as file:
            with h5py.File(series.path, "r") as old:
                take_over(old, file, ("time", "time_bnds", *(row.name for row in LIGHT)), whole)
            _point_all(file, series, [*made.sources, *fresh], made.parameters)
    note(series, replace(made, sources=[*made.sources, *fresh]))
    return series.path


def _build_anew(series: Series) -> Path:
    found = rows(series)
    if not found:
        raise StoreError(f"{series.folder}: nothing is stored yet")
    held = [read_source(*run) for run in runs(found)]
    parameters: Parameters = {}
    for source in reversed(held):
        parameters = source.parameters | parameters
    with written_whole(series.path) as beside:
        with netCDF4.Dataset(beside, "w", clobber=False) as file:
            write_words(file, series, _title(series), held, parameters)
        with h5py.File(beside, "r+", libver=VIRTUAL) as file:
            _point_all(file, series, held, parameters)
        _retire(sources(series.path) - {source.path for source in held})
    newest_start_s = max(row.start for row in found).timestamp()
    note(series, Made(held, parameters, found[-1].time_s, newest_start_s))
    return series.path


def _title(series: Series) -> str:
    return f"Elevation change at {series.name or series.station_id}"


def _retire(paths: set[Path]) -> None:
    """Let the grace of files that the series names no longer begin now."""
    for path in paths:
        if path.is_file():
            os.utime(path)


def write_words(
    file: netCDF4.Dataset, series: Series, title: str, held: list[Source], parameters: Parameters
) -> None:
    """Write a file of many epochs but for its large variables. What a source lacks stays missing.

    Epochs before the first source are left for others to write.
    """
    file.set_auto_mask(False)
    file.set_auto_chartostring(False)
    first, count = held[0].at, held[-1].at + held[-1].count
    lay_out(file, series, title, count, (tuple(parameters), tuple(parameters.values())))
    for row in LIGHT:
        if all(dim in file.dimensions for dim in row.dims):
            define(file, row, series, count)
    for name, variable in file.variables.items():
        if variable.dimensions[:1] != ("time",):
            continue
        fill = {"S": b"", "f": FILL}.get(variable.dtype.kind, 0)
        values = np.full((count - first, *variable.shape[1:]), fill, variable.dtype)
        for source in held:
            if name in source.words:
                at = slice(source.at - first, source.at + source.count - first)
                where = _places(source, parameters) if "parameter" in variable.dimensions else ...
                values[at, where] = source.words[name]
        variable[first:count] = values


def _places(source: Source, parameters: Parameters) -> list[int]:
    """Return where the source's shared parameters stand among all (p,)."""
    if source.parameters is parameters:  # as nearly always in a series that grows
        return list(range(len(parameters)))
    place = {name: index for index, name in enumerate(parameters)}
    return [place[name] for name in source.parameters]


def _point_all(file: Any, series: Series, held: list[Source], parameters: Parameters) -> None:  # noqa: ANN401 - h5py has no types
    """Add the large variables as virtual ones, with paths relative to the series.

    Below h5py's comfort, which takes most of the time of a hundred files.
    """
    paths = [str(source.path.relative_to(series.folder)).encode() for source in held]
    known: dict[tuple[object, ...], list[tuple[Any, Any]]] = {}  # rasters lie alike
    for row in HEAVY:
        if not any(row.name in source.shapes for source in held):
            continue
        shape = tuple(len(file[dim]) for dim in row.dims)
        layout = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        layout.set_fill_value(np.array(FILL if row.dtype[0] == "f" else 0, row.dtype))
        for source, path in zip(held, paths, strict=True):
            if row.name in source.shapes:
                key = (source.at, row.dims, source.shapes[row.name])
                if key not in known:
                    known[key] = list(_spaces(source, row, parameters, shape))
                for here, origin in known[key]:
                    layout.set_virtual(here, path, row.name.encode(), origin)
        kind = h5py.h5t.py_create(np.dtype(row.dtype), logical=True)
        made = h5py.h5d.create(file.id, row.name.encode(), kind, h5py.h5s.create_simple(shape), layout)
        _dress(h5py.Dataset(made), file, row, series)


def _spaces(
    source: Source, row: Variable, parameters: Parameters, shape: tuple[int, ...]
) -> Iterator[tuple[Any, Any]]:
    """Yield what of a large variable lies where: in the series, and in the file."""
    named = _blocks(_places(source, parameters))
    blocks = [
        named if dim.startswith("parameter") else [(0, 0, size)]
        for dim, size in zip(row.dims[1:], shape[1:], strict=True)
    ]
    for (there_1, at_1, size_1), (there_2, at_2, size_2) in product(*blocks):
        at, there = (source.at, at_1, at_2), (source.first, there_1, there_2)
        size = source.count, size_1, size_2
        here, origin = (h5py.h5s.create_simple(one) for one in (shape, source.shapes[row.name]))
        here.select_hyperslab(at, size)
        origin.select_hyperslab(there, size)
        yield here, origin


def _blocks(places: list[int]) -> list[tuple[int, int, int]]:
    """Cut places into stretches that follow one another: (from, to, how many)."""
    if places == list(range(len(places))):
        return [(0, 0, len(places))]
    blocks = []
    for _, group in groupby(enumerate(places), key=lambda pair: pair[1] - pair[0]):
        pairs = list(group)
        blocks.append((*pairs[0], len(pairs)))
    return blocks


def _dress(made: Any, file: Any, row: Variable, series: Series) -> None:  # noqa: ANN401 - h5py has no types
    """Give a virtual variable its dimensions and attributes the way netCDF expects them."""
    for axis, dim in enumerate(row.dims):
        made.dims[axis].attach_scale(file[dim])
    for key, value in attributes(row, mapped=series.crs is not None).items():
        made.attrs[key] = np.bytes_(value) if isinstance(value, str) else value
    if row.dtype[0] == "f":
        made.attrs["_FillValue"] = np.array([FILL], dtype=row.dtype)
