"""The rasters of a series that are computed from stored ones when they are read."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from xarray.backends import BackendArray
from xarray.backends.netCDF4_ import NETCDF4_PYTHON_LOCK
from xarray.core.indexing import (
    ExplicitIndexer,
    IndexingSupport,
    LazilyIndexedArray,
    explicit_indexing_adapter,
)

from station.archive.derived.computed_rasters import (
    COMPUTED,
    ELEVATION,
    OUTSIDE,
    RANDOM,
    SYSTEMATIC,
    ReferenceSurfaces,
    is_value,
    read_raster,
)
from station.archive.raster_io import Array
from station.archive.schema import BY_NAME
from station.archive.series.index import series_in

TEMPLATES = {ELEVATION: OUTSIDE, RANDOM: SYSTEMATIC, SYSTEMATIC: RANDOM}  # whose attributes a raster has

Key = tuple[Any, ...]  # of the three dimensions: integers, slices, or arrays (n,) of indices
ReadStored = Callable[[str, Key], Array]


class ComputedArrays:
    """The computed rasters of a series over its stored ones.

    `read_stored` returns a part of a stored raster, `read_versions` the reference version of each epoch.
    """

    def __init__(
        self,
        folder: Path,
        stored: Mapping[str, xr.Variable],
        read_stored: ReadStored,
        read_versions: Callable[[], list[str]],
    ) -> None:
        self._folder, self._stored = folder, stored
        self._read_stored, self._read_versions = read_stored, read_versions

    def variables(self) -> dict[str, xr.Variable]:
        """Return the lazy variables by name, with the attributes that they would have if they were stored."""
        variables = {}
        for name, template in TEMPLATES.items():
            like = self._stored.get(name, self._stored.get(template))
            if like is not None:
                spec = BY_NAME[name]
                attributes = like.attrs | {"long_name": spec.long_name, "comment": spec.comment}
                data = LazilyIndexedArray(_ComputedArray(name, self, like.shape))
                variables[name] = xr.Variable(like.dims, data, attributes, like.encoding)
        return variables

    def read(self, name: str, key: Key) -> Array:
        """Return a part of a raster, with NaN for missing values."""

        def read(stored: str) -> Array | None:
            return self._read_stored(stored, key) if stored in self._stored else None

        values = read_raster(name, read, lambda: self._surface_m(key))
        return np.where(is_value(values), values, np.float32(np.nan))

    def _surface_m(self, key: Key) -> Array:
        """Return the surface that each epoch's change is counted from [m]; NaN without a reference."""
        times, rows, columns = (
            np.atleast_1d(np.arange(size)[part]) for part, size in zip(key, self._shape, strict=True)
        )
        surface_m = np.full((len(times), len(rows), len(columns)), np.nan, np.float32)
        if surface_m.size:
            window = slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1)
            versions = np.array([self._versions[time] for time in times.tolist()])
            for version in set(versions.tolist()) - {""}:
                with NETCDF4_PYTHON_LOCK:  # netCDF4 reads the reference, and dask calls this in threads
                    height_m = self._surfaces.height_m(version, *window)
                inner = (rows - rows.min(), columns - columns.min())
                if not all(isinstance(part, slice) and part.step in {None, 1} for part in key[1:]):
                    height_m = height_m[np.ix_(*inner)]
                surface_m[versions == version] = height_m
        single = tuple(axis for axis, part in enumerate(key) if isinstance(part, int | np.integer))
        return np.asarray(surface_m.squeeze(single))

    @property
    def _shape(self) -> tuple[int, ...]:
        return next(variable.shape for name, variable in self._stored.items() if name in COMPUTED[RANDOM])

    @cached_property
    def _versions(self) -> list[str]:
        return self._read_versions()

    @cached_property
    def _surfaces(self) -> ReferenceSurfaces:
        return ReferenceSurfaces(series_in(self._folder))


class _ComputedArray(BackendArray):
    """A raster that is computed when it is read."""

    def __init__(self, name: str, arrays: ComputedArrays, shape: tuple[int, ...]) -> None:
        self._name, self._arrays = name, arrays
        self.shape, self.dtype = shape, np.dtype(np.float32)

    def __getitem__(self, key: ExplicitIndexer) -> Any:  # noqa: ANN401 - as in xarray
        return explicit_indexing_adapter(key, self.shape, IndexingSupport.OUTER, self._getitem)

    def _getitem(self, key: Key) -> Array:
        return self._arrays.read(self._name, key)
