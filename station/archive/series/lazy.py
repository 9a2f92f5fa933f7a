"""The whole series as one lazy xarray dataset."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import xarray as xr
from xarray.backends import BackendArray, NetCDF4DataStore
from xarray.backends.netCDF4_ import NetCDF4ArrayWrapper
from xarray.core.indexing import (
    ExplicitIndexer,
    IndexingSupport,
    LazilyIndexedArray,
    explicit_indexing_adapter,
)

from station.archive.chunk_codec import ChunkReader
from station.archive.derived.computed_rasters import CHANGE, OUTSIDE, is_value
from station.archive.netcdf_layout import CHUNK, EXTENTS, decode_text
from station.archive.raster_io import Array
from station.archive.read_errors import read_errors
from station.archive.schema import BY_NAME
from station.archive.series.computed_arrays import ComputedArrays, Key
from station.archive.series.index import LinkedEpochs, data_folder, linked_epochs
from station.archive.series.virtual import COMMENT, PROCESSING_COMMENT
from station.errors import StoreError

PREFERRED_CHUNKS = {"time": 24, "y": 4 * CHUNK, "x": 4 * CHUNK}  # 24 MiB
COORDINATES = ("crs", "time_bnds", "x_bnds", "y_bnds")  # no data of their own

Chunks = int | str | Mapping[Any, Any] | None


def open_series(site_or_folder: str | Path, chunks: Chunks = None) -> xr.Dataset:
    """Return the whole series of a site file, data folder or `series.nc` as a lazy dataset.

    `chunks` are those of `xarray.open_dataset` for the rasters; a mapping is completed by PREFERRED_CHUNKS.
    The service may write at the same time: it replaces `series.nc` as a whole and never changes the files
    that it refers to. Raises StoreError if there is no series, or if a source file is missing, which would
    read as no data. A source that vanishes later raises StoreError when rasters are read.
    """
    path = data_folder(site_or_folder) / "series.nc"
    if not path.is_file():
        raise StoreError(f"{path}: no series yet; has a scan been processed? (station status)")
    return open_virtual(path, chunks)


def open_virtual(path: Path, chunks: Chunks = None) -> xr.Dataset:
    """Return a `series.nc` or `processing.nc` as a lazy dataset, as `open_series` does."""
    store = _open_store(path)
    missing = _missing(store.sources)
    if missing:
        raise StoreError(
            f"{path}: {len(missing)} of its source files are missing, the first is {missing[0]}: restore them"
        )
    ds = xr.open_dataset(store, decode_timedelta=False)
    large = {str(name) for name, variable in ds.variables.items() if variable.ndim > 2}
    if chunks is not None:  # texts have no chunks that dask could choose
        small = set(map(str, ds.variables)) - large - set(map(str, ds.dims))
        if isinstance(chunks, Mapping):
            chunks = PREFERRED_CHUNKS | dict(chunks)
        rasters = xr.open_dataset(store, decode_timedelta=False, chunks=chunks, drop_variables=small)
        ds = ds.assign(rasters.data_vars)
    ds = ds.drop_vars(EXTENTS, errors="ignore")  # of the whole grid: wrong for a part of it
    ds = ds.set_coords([name for name in COORDINATES if name in ds])
    ds.encoding["source"] = str(path.resolve())
    comment = ds.attrs.pop("comment", "")  # what is written is not virtual
    if comment := comment.removesuffix(COMMENT).removesuffix(PROCESSING_COMMENT).rstrip():
        ds.attrs["comment"] = comment
    _prepare_writing(ds)
    return ds


def _open_store(path: Path) -> _SeriesStore:
    """Return a virtual file with its sources; the service may replace it while it is opened."""
    while True:
        opened = path.stat()
        with read_errors(path), h5py.File(path, "r") as file:
            sources = linked_epochs(file, path.parent)
            rasters = [name for name, variable in file.items() if variable.is_virtual and variable.ndim == 3]
            unmapped = {name: file[name].fillvalue for name in rasters}
        store: _SeriesStore = _SeriesStore.open(path)  # type: ignore[no-untyped-call]
        if path.stat() == opened:
            store.folder, store.sources, store.unmapped = path.parent, sources, unmapped
            return store
        store.close()  # type: ignore[no-untyped-call]


class _SeriesStore(NetCDF4DataStore):
    """The variables of a `series.nc`, and those that are computed from them.

    Reading a raster raises StoreError if a source has vanished.
    """

    folder = Path()
    sources: Sequence[LinkedEpochs] = ()
    unmapped: Mapping[str, float] = {}  # value of each raster in epochs whose file lacks it

    def get_variables(self) -> Mapping[str, xr.Variable]:
        """Return the lazy variables by name, rasters in the order of the schema."""
        stored: dict[str, xr.Variable] = dict(super().get_variables())  # type: ignore[no-untyped-call]
        if CHANGE not in stored:
            return stored
        # Opened here, because dask reads in threads and opening a variable of netCDF4 takes no lock.
        texts = _CheckedArray("reference_version", self)  # type: ignore[no-untyped-call]

        def read_stored(name: str, key: Key) -> Array:
            return _SourceArray(name, self, stored[name]).read(key)

        def read_versions() -> list[str]:
            return decode_text(np.asarray(texts._getitem((...,))))  # noqa: SLF001 - of this module

        computed = ComputedArrays(self.folder, stored, read_stored, read_versions)
        variables = stored | computed.variables()
        variables.pop(OUTSIDE, None)  # it is in the elevation
        position = {name: number for number, name in enumerate(BY_NAME)}
        return dict(sorted(variables.items(), key=lambda item: position.get(item[0], -1)))

    def open_store_variable(self, name: str, var: Any) -> xr.Variable:  # noqa: ANN401 - netCDF4 has no types
        """Return a lazy variable; that of a raster has chunks to read and to write it by."""
        variable: xr.Variable = super().open_store_variable(name, var)
        if variable.ndim <= 2:
            return variable
        encoding = {key: value for key, value in variable.encoding.items() if key != "contiguous"}
        encoding |= {"zlib": True, "shuffle": True, "complevel": 1}
        if variable.dims != ("time", "y", "x"):
            checked = LazilyIndexedArray(_CheckedArray(name, self))  # type: ignore[no-untyped-call]
            return xr.Variable(variable.dims, checked, variable.attrs, encoding)
        encoding["chunksizes"] = (1, *(min(CHUNK, size) for size in variable.shape[1:]))
        encoding["preferred_chunks"] = dict(zip(variable.dims, encoding["chunksizes"], strict=True))
        if "_FillValue" in variable.attrs:  # replaced by NaN while chunks are read, in a tenth of the time
            encoding["_FillValue"] = variable.attrs.pop("_FillValue")
        data = LazilyIndexedArray(_SourceArray(name, self, variable))
        return xr.Variable(variable.dims, data, variable.attrs, encoding)


class _CheckedArray(NetCDF4ArrayWrapper):
    """A virtual variable, which reads as no data where a source is missing."""

    def _getitem(self, key: Any) -> Any:  # noqa: ANN401 - as in xarray
        values = super()._getitem(key)  # type: ignore[no-untyped-call]
        _require(self.datastore.sources)
        return values


class _SourceArray(BackendArray):
    """A raster over time, read from the sources of the series themselves, with NaN for missing values."""

    def __init__(self, name: str, store: _SeriesStore, variable: xr.Variable) -> None:
        self._name, self._sources, self._unmapped = name, store.sources, store.unmapped[name]
        self.shape, self.dtype = variable.shape, variable.dtype

    def __getitem__(self, key: ExplicitIndexer) -> Any:  # noqa: ANN401 - as in xarray
        return explicit_indexing_adapter(key, self.shape, IndexingSupport.OUTER, self.read)

    def read(self, key: Key) -> Array:
        """Return a part, whose key has an integer, a slice or indices (n,) for each dimension."""
        _require(self._sources)
        times, rows, columns = (
            np.atleast_1d(np.arange(size)[part]) for part, size in zip(key, self.shape, strict=True)
        )
        values = np.empty((len(times), len(rows), len(columns)), self.dtype)
        if values.size:
            window = slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1)
            inner = rows - rows.min(), columns - columns.min()
            is_whole = all(np.array_equal(part, np.arange(len(part))) for part in inner)
            for position, raster in self._rasters(times, window):
                if self.dtype.kind == "f":
                    raster[~is_value(raster)] = np.nan
                values[position] = raster if is_whole else raster[np.ix_(*inner)]
        single = tuple(axis for axis, part in enumerate(key) if isinstance(part, int | np.integer))
        return np.asarray(values.squeeze(single))

    def _rasters(self, times: Array, window: tuple[slice, slice]) -> Iterator[tuple[int, Array]]:
        """Yield the position of each of some times, and a window of its raster, source by source."""
        starts = [source.series_start for source in self._sources]
        numbers = np.searchsorted(starts, times, side="right") - 1
        for number in np.unique(numbers).tolist():
            source = self._sources[number]
            shift = source.file_start - source.series_start
            with read_errors(source.path), h5py.File(source.path, "r") as file:
                reader = ChunkReader(file[self._name]) if self._name in file else None
                for position in np.flatnonzero(numbers == number).tolist():
                    if reader is None:
                        yield position, np.full([part.stop - part.start for part in window], self._unmapped)
                    else:
                        yield position, reader.read(int(times[position]) + shift, *window)


def _require(sources: Iterable[LinkedEpochs]) -> None:
    """Raise StoreError if a source is missing."""
    missing = _missing(sources)
    if missing:
        raise StoreError(
            f"{missing[0]}: deleted since the series was opened, with {len(missing) - 1} others:"
            " merged and replaced files are deleted after two days: open the series again"
        )


def _missing(sources: Iterable[LinkedEpochs]) -> list[Path]:
    return sorted({source.path for source in sources if not source.path.is_file()})


def _prepare_writing(ds: xr.Dataset) -> None:
    """Set encodings so that `to_netcdf` of any part writes a file without a warning or a missing value."""
    for name, variable in ds.variables.items():
        variable.encoding.pop("char_dim_name", None)  # texts of a part may be shorter
        if name in ds.dims or str(name) in COORDINATES:
            variable.encoding["_FillValue"] = None
