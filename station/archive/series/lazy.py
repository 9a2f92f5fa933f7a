"""The whole series as one lazy xarray dataset."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from xarray.backends import NetCDF4DataStore
from xarray.backends.netCDF4_ import NetCDF4ArrayWrapper
from xarray.core.indexing import LazilyIndexedArray

from station.archive.derived.computed_rasters import CHANGE, OUTSIDE
from station.archive.netcdf_layout import CHUNK, decode_text
from station.archive.raster_io import Array
from station.archive.schema import BY_NAME
from station.archive.series.computed_arrays import ComputedArrays, Key
from station.archive.series.index import data_folder, source_files
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
    sources = source_files(path)
    missing = _missing(sources)
    if missing:
        raise StoreError(
            f"{path}: {len(missing)} of its source files are missing, the first is {missing[0]}: restore them"
        )
    store = _SeriesStore.open(path)  # type: ignore[no-untyped-call]
    store.folder, store.sources = path.parent, sources
    ds = xr.open_dataset(store, decode_timedelta=False)
    large = {str(name) for name, variable in ds.variables.items() if variable.ndim > 2}
    if chunks is not None:  # texts have no chunks that dask could choose
        small = set(map(str, ds.variables)) - large - set(map(str, ds.dims))
        if isinstance(chunks, Mapping):
            chunks = PREFERRED_CHUNKS | dict(chunks)
        rasters = xr.open_dataset(store, decode_timedelta=False, chunks=chunks, drop_variables=small)
        ds = ds.assign(rasters.data_vars)
    ds = ds.set_coords([name for name in COORDINATES if name in ds])
    ds.encoding["source"] = str(path.resolve())
    comment = ds.attrs.pop("comment", "")  # what is written is not virtual
    if comment := comment.removesuffix(COMMENT).removesuffix(PROCESSING_COMMENT).rstrip():
        ds.attrs["comment"] = comment
    _prepare_writing(ds)
    return ds


class _SeriesStore(NetCDF4DataStore):
    """The variables of a `series.nc`, and those that are computed from them.

    Reading a raster raises StoreError if a source has vanished.
    """

    folder = Path()
    sources: Collection[Path] = ()

    def get_variables(self) -> Mapping[str, xr.Variable]:
        """Return the lazy variables by name, rasters in the order of the schema."""
        stored: dict[str, xr.Variable] = dict(super().get_variables())  # type: ignore[no-untyped-call]
        if CHANGE not in stored:
            return stored
        # Opened here, because dask reads in threads and opening a variable of netCDF4 takes no lock.
        arrays = {name: _CheckedArray(name, self) for name in stored}  # type: ignore[no-untyped-call]

        def read_stored(name: str, key: Key) -> Array:
            return np.asarray(arrays[name]._getitem(key))  # noqa: SLF001 - of this module

        def read_versions() -> list[str]:
            return decode_text(read_stored("reference_version", (...,)))

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
        data = LazilyIndexedArray(_CheckedArray(name, self))  # type: ignore[no-untyped-call]
        encoding = {key: value for key, value in variable.encoding.items() if key != "contiguous"}
        if variable.dims == ("time", "y", "x"):
            encoding["chunksizes"] = (1, *(min(CHUNK, size) for size in variable.shape[1:]))
            encoding["preferred_chunks"] = dict(zip(variable.dims, encoding["chunksizes"], strict=True))
        encoding |= {"zlib": True, "shuffle": True, "complevel": 1}
        return xr.Variable(variable.dims, data, variable.attrs, encoding)


class _CheckedArray(NetCDF4ArrayWrapper):
    """A virtual variable, which reads as no data where a source is missing."""

    def _getitem(self, key: Any) -> Any:  # noqa: ANN401 - as in xarray
        values = super()._getitem(key)  # type: ignore[no-untyped-call]
        missing = _missing(self.datastore.sources)
        if missing:
            raise StoreError(
                f"{missing[0]}: deleted since the series was opened, with {len(missing) - 1} others:"
                " merged and replaced files are deleted after two days: open the series again"
            )
        return values


def _missing(sources: Collection[Path]) -> list[Path]:
    return sorted(source for source in sources if not source.is_file())


def _prepare_writing(ds: xr.Dataset) -> None:
    """Set encodings so that `to_netcdf` of any part writes a file without a warning or a missing value."""
    for name, variable in ds.variables.items():
        variable.encoding.pop("char_dim_name", None)  # texts of a part may be shorter
        if name in ds.dims or str(name) in COORDINATES:
            variable.encoding["_FillValue"] = None
