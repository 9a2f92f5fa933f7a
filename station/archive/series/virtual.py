"""Building `series.nc` and `processing.nc`: virtual HDF5 files over the files of epochs, days and months.

`series.nc` contains the results, `processing.nc` everything about each scan but the rasters: how it was
processed, and what the variance of a sum needs.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby, product
from pathlib import Path
from typing import Any

import h5py
import netCDF4
import numpy as np

from station.archive.atomic_files import atomic_write
from station.archive.discovery import time_coverage
from station.archive.epochs import list_files
from station.archive.netcdf_layout import TIMES_PER_CHUNK, Series, attributes, create_file, create_variable
from station.archive.schema import FILL, VARIABLES, Variable
from station.archive.series.epoch_reader import (
    SMALL_VARIABLES,
    EpochSource,
    Parameters,
    contiguous_runs,
    copy_unchanged,
    read_source,
)
from station.archive.series.index import list_epochs
from station.archive.series.manifest import SeriesManifest, listed_sources, pending_epochs, write_manifest
from station.archive.small_variables import open_variable, write_epochs
from station.errors import StoreError
from station.quantities import Quality

LIBVER_VIRTUAL = ("v110", "v110")  # HDF5 version bounds; with newer ones only xarray can read the file
SMALL_DIMS = {"time": ("time",), "time_bnds": ("time", "bnds")} | {
    spec.name: spec.dims for spec in SMALL_VARIABLES
}
SCALE_ATTRIBUTES = ("CLASS", "NAME", "REFERENCE_LIST", "_FillValue")  # of a dimension scale, written by HDF5
NO_SOURCE, NO_COUNT = 1e30, -1  # in rasters whose file is missing: nobody takes them for measurements
COMMENT = (
    "This file is virtual: times and rasters are read from days/, months/ and epochs/ beside it; copy the"
    " whole folder. Without a source, its times are 9.96921e36 and its rasters 1e30, so that the number of"
    " valid cells of elevation_change is not valid_count. How each scan was processed is in processing.nc."
)
PROCESSING_COMMENT = (
    "This file is virtual: times and covariances are read from days/, months/ and epochs/ beside it; copy the"
    " whole folder. Without a source, its times are 9.96921e36. The results are in series.nc."
)


@dataclass(frozen=True)
class _VirtualFile:
    """One of the two files: its path, title, comment, and rows of the schema."""

    path: Path
    title: str
    comment: str
    variables: tuple[Variable, ...]


def _virtual_files(series: Series) -> tuple[_VirtualFile, ...]:
    """Return the two files in the order of writing: `series.nc` names nothing that is not in the other."""
    name = series.name or series.station_id
    own_comment = dict(series.metadata).get("comment")
    processing = tuple(spec for spec in VARIABLES if not spec.is_raster)
    results = tuple(spec for spec in VARIABLES if spec.is_result)
    return tuple(
        _VirtualFile(path, f"{title} at {name}", " ".join(filter(None, [own_comment, comment])), variables)
        for path, title, comment, variables in (
            (series.processing_path, "Processing of the scans", PROCESSING_COMMENT, processing),
            (series.path, "Elevation change", COMMENT, results),
        )
    )


def build_series(series: Series) -> Path:
    """Bring `series.nc` and `processing.nc` up to date with the store; return the path of `series.nc`.

    Each is replaced atomically. If only later epochs were added, the other epochs are copied from the old
    files and no other file is opened. If one is damaged, both are built again from the epochs. Raises
    StoreError if an epoch is damaged, nothing is stored yet, or a file cannot be written.
    """
    pending = pending_epochs(series)
    if pending is None:
        return _rebuild(series)
    manifest, new_sources = pending
    if not new_sources:
        return series.path
    try:
        return _append(series, manifest, new_sources)
    except StoreError:  # a file is damaged although it matches its fingerprint, or cannot be written
        return _rebuild(series)


def _append(series: Series, manifest: SeriesManifest, new_sources: list[EpochSource]) -> Path:
    """Add later epochs to both files; raise StoreError if one is damaged or cannot be written."""
    unchanged = manifest.count // TIMES_PER_CHUNK * TIMES_PER_CHUNK
    for virtual in _virtual_files(series):
        last_chunk = read_source(virtual.path, unchanged, unchanged, manifest.count - unchanged)
        with atomic_write(virtual.path) as tmp_path:
            _create(tmp_path, series, virtual, new_sources[-1], manifest.parameters)
            with h5py.File(tmp_path, "r+", libver=LIBVER_VIRTUAL) as file:
                write_scalars(file, [last_chunk, *new_sources], manifest.parameters)
                with h5py.File(virtual.path, "r") as old_file:
                    names = ("time_bnds", *(spec.name for spec in virtual.variables if not spec.is_large))
                    copy_unchanged(old_file, file, names, unchanged)
                _link_sources(file, series, virtual, [*manifest.sources, *new_sources], manifest.parameters)
    write_manifest(series, replace(manifest, sources=[*manifest.sources, *new_sources]))
    return series.path


def _rebuild(series: Series) -> Path:
    epochs = list_epochs(series)
    if not epochs:
        raise StoreError(f"{series.folder}: nothing is stored yet")
    epoch_sources = [read_source(*run) for run in contiguous_runs(epochs)]
    parameters: Parameters = {}
    for source in reversed(epoch_sources):
        parameters = source.parameters | parameters
    for virtual in _virtual_files(series):
        with atomic_write(virtual.path) as tmp_path:
            _create(tmp_path, series, virtual, epoch_sources[-1], parameters)
            with h5py.File(tmp_path, "r+", libver=LIBVER_VIRTUAL) as file:
                write_scalars(file, epoch_sources, parameters)
                _link_sources(file, series, virtual, epoch_sources, parameters)
            _touch_replaced(series, {source.path for source in epoch_sources})
    newest_start_s = max(epoch.start for epoch in epochs).timestamp()
    write_manifest(series, SeriesManifest(epoch_sources, parameters, epochs[-1].time_s, newest_start_s))
    return series.path


def _create(
    path: Path, series: Series, virtual: _VirtualFile, last: EpochSource, parameters: Parameters
) -> None:
    """Create a virtual file up to the last source, with all that it contains itself but the values."""
    has_parameters = any("parameter" in spec.dims for spec in virtual.variables)
    count = last.series_start + last.count
    with netCDF4.Dataset(path, "w", clobber=False) as file:
        create_scalars(
            file, series, virtual.title, count, parameters if has_parameters else {}, virtual.variables
        )
        file.comment = virtual.comment


def _touch_replaced(series: Series, used: set[Path]) -> None:
    """Restart the grace period of files that the series no longer refers to, or may have referred to."""
    earlier = listed_sources(series)
    if earlier is None:
        earlier = {series.folder / name for name in list_files(series)}
    for path in earlier - used:
        if path.is_file():
            os.utime(path)


def create_scalars(
    file: netCDF4.Dataset,
    series: Series,
    title: str,
    count: int,
    parameters: Parameters,
    variables: Sequence[Variable] = VARIABLES,
) -> None:
    """Create all of a file of `count` epochs but the large variables."""
    create_file(file, series, title, count, (tuple(parameters), tuple(parameters.values())))
    for spec in variables:
        if not spec.is_large and all(dim in file.dimensions for dim in spec.dims):
            create_variable(file, spec, series, count)


def write_scalars(file: Any, epoch_sources: list[EpochSource], parameters: Parameters) -> None:  # noqa: ANN401 - h5py has no types
    """Write the values of what `create_scalars` created; missing values keep the fill value.

    Epochs that precede the first source are not written.
    """
    first, count = epoch_sources[0].series_start, epoch_sources[-1].series_start + epoch_sources[-1].count
    names, values = set(file), {}
    for name, dims in SMALL_DIMS.items():
        if name not in names:
            continue
        variable = open_variable(file, name)
        fill = {"S": b"", "f": FILL}.get(variable.dtype.kind, 0)
        values[name] = np.full((count - first, *variable.shape[1:]), fill, variable.dtype)
        for source in epoch_sources:
            if name in source.scalars:
                target = slice(source.series_start - first, source.series_start + source.count - first)
                indices = _parameter_indices(source, parameters) if "parameter" in dims else ...
                values[name][target, indices] = source.scalars[name]
    write_epochs(file, values, first)


def write_time_coverage(file: Any) -> None:  # noqa: ANN401 - h5py has no types
    """Write from when to when the epochs of a file extend, after they were written."""
    bounds_s = file["time_bnds"]
    for name, value in time_coverage(float(bounds_s[0, 0]), float(bounds_s[-1, 1])).items():
        file.attrs[name] = np.bytes_(value)


def _parameter_indices(source: EpochSource, parameters: Parameters) -> list[int]:
    """Return the indices of the shared parameters of a source among all parameters (p,)."""
    if source.parameters is parameters:  # nearly always, when a series grows
        return list(range(len(parameters)))
    index_of = {name: index for index, name in enumerate(parameters)}
    return [index_of[name] for name in source.parameters]


def _link_sources(
    file: Any,  # noqa: ANN401 - h5py has no types
    series: Series,
    virtual: _VirtualFile,
    epoch_sources: list[EpochSource],
    parameters: Parameters,
) -> None:
    """Add the time and the large variables as virtual datasets, with paths relative to the series.

    Uses h5py's low-level API, because the high-level API dominates the time for a hundred files.
    """
    write_time_coverage(file)
    paths = [str(source.path.relative_to(series.folder)).encode() for source in epoch_sources]
    _link_time(file, epoch_sources, paths)
    spaces: dict[tuple[object, ...], list[tuple[Any, Any]]] = {}  # the same for all rasters
    for spec in virtual.variables:
        if not spec.is_large or not any(spec.name in source.raster_shapes for source in epoch_sources):
            continue
        shape = tuple(len(file[dim]) for dim in spec.dims)
        layout = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        layout.set_fill_value(np.array(_unmapped_value(spec, epoch_sources, shape), spec.dtype))
        for source, path in zip(epoch_sources, paths, strict=True):
            if spec.name in source.raster_shapes:
                key = (source.series_start, spec.dims, source.raster_shapes[spec.name])
                if key not in spaces:
                    spaces[key] = list(_hyperslabs(source, spec, parameters, shape))
                for series_space, file_space in spaces[key]:
                    layout.set_virtual(series_space, path, spec.name.encode(), file_space)
        dtype = h5py.h5t.py_create(np.dtype(spec.dtype), logical=True)
        dataset_id = h5py.h5d.create(
            file.id, spec.name.encode(), dtype, h5py.h5s.create_simple(shape), layout
        )
        _write_raster_attrs(h5py.Dataset(dataset_id), file, spec, series)


def _unmapped_value(spec: Variable, epoch_sources: list[EpochSource], shape: tuple[int, ...]) -> float:
    """Return the value of a large variable where no file is read: it is missing, or lacks the variable.

    Missing data if some epochs lack it, or a parameter; otherwise only a missing file shows this value.
    """
    is_covered = all(source.raster_shapes.get(spec.name, ())[1:] == shape[1:] for source in epoch_sources)
    if spec.dtype[0] == "f":
        return NO_SOURCE if is_covered else FILL
    return int(Quality.NOT_SEEN) if spec.name == "quality" else NO_COUNT if is_covered else 0


def _link_time(file: Any, epoch_sources: list[EpochSource], paths: list[bytes]) -> None:  # noqa: ANN401
    """Replace the time by a virtual dataset, so that an epoch has no valid time if its file is missing.

    The fill value is a time that xarray refuses to decode; NaN would pass as missing.
    """
    stored = file["time"]
    count, attached = len(stored), stored.attrs["REFERENCE_LIST"]
    attributes_of_time = {key: stored.attrs[key] for key in stored.attrs if key not in SCALE_ATTRIBUTES}
    dependents = [(h5py.Dataset(h5py.h5r.dereference(ref, file.id)), axis) for ref, axis in attached]
    for variable, axis in dependents:
        variable.dims[int(axis)].detach_scale(stored)
    del file["time"]
    layout = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    layout.set_fill_value(np.array(FILL))
    for source, path in zip(epoch_sources, paths, strict=True):
        series_space = h5py.h5s.create_simple((count,), (h5py.h5s.UNLIMITED,))
        series_space.select_hyperslab((source.series_start,), (source.count,))
        file_space = h5py.h5s.create_simple((source.file_length,))
        file_space.select_hyperslab((source.file_start,), (source.count,))
        layout.set_virtual(series_space, path, b"time", file_space)
    space = h5py.h5s.create_simple((count,), (h5py.h5s.UNLIMITED,))  # for tools that want a record dimension
    time = h5py.Dataset(h5py.h5d.create(file.id, b"time", h5py.h5t.IEEE_F64LE, space, layout))
    time.make_scale("time")
    for key, value in attributes_of_time.items():
        time.attrs[key] = value
    for variable, axis in dependents:
        variable.dims[int(axis)].attach_scale(time)


def _hyperslabs(
    source: EpochSource, spec: Variable, parameters: Parameters, shape: tuple[int, ...]
) -> Iterator[tuple[Any, Any]]:
    """Yield the HDF5 selections (series, file) that map a source to a large variable."""
    parameter_blocks = _contiguous_blocks(_parameter_indices(source, parameters))
    blocks = [
        parameter_blocks if dim.startswith("parameter") else [(0, 0, size)]
        for dim, size in zip(spec.dims[1:], shape[1:], strict=True)
    ]
    for (file_1, series_1, size_1), (file_2, series_2, size_2) in product(*blocks):
        series_corner, file_corner = (
            (source.series_start, series_1, series_2),
            (source.file_start, file_1, file_2),
        )
        size = source.count, size_1, size_2
        series_space, file_space = (
            h5py.h5s.create_simple(extent) for extent in (shape, source.raster_shapes[spec.name])
        )
        series_space.select_hyperslab(series_corner, size)
        file_space.select_hyperslab(file_corner, size)
        yield series_space, file_space


def _contiguous_blocks(indices: list[int]) -> list[tuple[int, int, int]]:
    """Split indices into contiguous blocks: (index in the source, index in the series, count)."""
    if indices == list(range(len(indices))):
        return [(0, 0, len(indices))]
    blocks = []
    for _, group in groupby(enumerate(indices), key=lambda pair: pair[1] - pair[0]):
        pairs = list(group)
        blocks.append((*pairs[0], len(pairs)))
    return blocks


def _write_raster_attrs(dataset: Any, file: Any, spec: Variable, series: Series) -> None:  # noqa: ANN401 - h5py has no types
    """Write dimensions and attributes of a virtual dataset the way netCDF expects them.

    The first dimension has two scales, of which netCDF and h5netcdf take the last. kerchunk and VirtualiZarr,
    which do not follow virtual datasets and would find no values, refuse a dimension of two scales.
    """
    dataset.dims[0].attach_scale(file[spec.dims[1]])
    for axis, dim in enumerate(spec.dims):
        dataset.dims[axis].attach_scale(file[dim])
    for key, value in attributes(spec, series).items():
        dataset.attrs[key] = np.bytes_(value) if isinstance(value, str) else value
    if spec.dtype[0] == "f":
        dataset.attrs["_FillValue"] = np.array([FILL], dtype=spec.dtype)
