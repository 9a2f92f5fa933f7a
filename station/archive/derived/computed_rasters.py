"""Rasters that are computed from what is stored, because storing them too would double the size of an epoch.

The elevation is the mean elevation of the cell in the reference plus the change, the random uncertainty what
the systematic one leaves of the total. Epochs of older versions have both stored, but no systematic
uncertainty. Source: store.md, 3.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np

from station.archive.netcdf_layout import Series
from station.archive.raster_io import Array, LazyRaster
from station.archive.read_errors import read_errors
from station.archive.reference_files import open_mean_elevation
from station.archive.schema import FILL
from station.errors import StoreError

ELEVATION, OUTSIDE, CHANGE = "elevation", "elevation_outside_reference", "elevation_change"
TOTAL, SYSTEMATIC, RANDOM = (f"{CHANGE}{part}_uncertainty" for part in ("", "_systematic", "_random"))
COMPUTED = {  # what each raster is computed from; the second is stored instead of it
    ELEVATION: (CHANGE, OUTSIDE),
    RANDOM: (TOTAL, SYSTEMATIC),
    SYSTEMATIC: (TOTAL, RANDOM),
}

Read = Callable[[str], Array | None]  # returns a stored raster by its name, None if there is none


def read_raster(name: str, read: Read, surface: Callable[[], Array]) -> Array:
    """Return a raster with fill values, computed where it is not stored.

    `surface` returns the surface that the changes are counted from [m]. Raises StoreError if the raster is
    neither stored nor can be computed.
    """
    stored = read(name)
    computed = None if name not in COMPUTED else _compute(name, stored, read, surface)
    if stored is None or computed is None:
        if stored is None and computed is None:
            raise StoreError(f"damaged, variable {name} is missing")
        return np.asarray(computed if stored is None else stored)
    return np.where(is_value(stored), stored, computed)


def _compute(name: str, stored: Array | None, read: Read, surface: Callable[[], Array]) -> Array | None:
    """Return the computed values of a raster; None if the file does not have what they are computed from."""
    first, second = (read(source) for source in COMPUTED[name])
    if first is None or (second is None and name != ELEVATION):
        return None
    if name != ELEVATION:
        return other_part(first, np.asarray(second))
    elevation_m = np.full(first.shape, FILL, np.float32) if second is None else second
    counted = is_value(first) if stored is None else is_value(first) & ~is_value(stored)
    if not counted.any():
        return elevation_m
    return np.where(counted, (surface() + first).astype(np.float32, copy=False), elevation_m)


def is_value(values: Array) -> Array:
    """Return True where stored values are not the fill value."""
    return np.asarray(values < FILL / 2)


def other_part(total_m: Array, part_m: Array) -> Array:
    """Return the random part of total σ if `part_m` is the systematic one, and vice versa [m]."""
    known = is_value(total_m) & is_value(part_m)
    total_m, part_m = (np.where(known, values, 0) for values in (total_m, part_m))
    other_m = np.sqrt(np.maximum((total_m - part_m) * (total_m + part_m), 0))
    return np.where(known, other_m, np.float32(FILL))


class ReferenceSurfaces:
    """The surfaces that changes are counted from, by version of the reference."""

    def __init__(self, series: Series) -> None:
        self._series = series
        self._surfaces: dict[str, Callable[[slice, slice], Array]] = {}
        self._last: tuple[object, Array] | None = None  # window and its heights: epochs share them

    def height_m(self, version: str, rows: slice, columns: slice) -> Array:
        """Return the mean height of cells in a window of the grid [m]; raise StoreError without the file."""
        window = version, rows.start, rows.stop, columns.start, columns.stop
        last = self._last
        if last is None or last[0] != window:
            last = self._last = window, self._read(version, rows, columns)
        return last[1]

    def _read(self, version: str, rows: slice, columns: slice) -> Array:
        if version not in self._surfaces:
            surface = open_mean_elevation(self._series, version)
            if surface is None:
                raise StoreError(
                    f"{self._series.folder}: reference_{version}.nc is missing, without which there is no"
                    " elevation: restore it"
                )
            self._surfaces[version] = surface
        return self._surfaces[version](rows, columns)


class ComputedRaster:
    """A random uncertainty (ny, nx) in a file, read and computed row by row on access."""

    def __init__(self, path: Path, name: str, rasters: dict[str, LazyRaster]) -> None:
        self._path, self._name, self._rasters = path, name, rasters
        self.shape = next(iter(rasters.values())).shape

    def __getitem__(self, rows: slice | tuple[slice, slice]) -> Array:
        """Return rows (r, nx), or rows and columns (r, c), fill values included."""

        def read(name: str) -> Array | None:
            return self._rasters[name][rows] if name in self._rasters else None

        return read_raster(self._name, read, lambda: np.empty(0))


def open_raster(path: Path, name: str, index: int | None = None) -> LazyRaster | ComputedRaster:
    """Return a raster of a file, computed if need be, fill values included; not for the elevation.

    `index` selects the epoch in a file of several. Raises StoreError if it cannot be read.
    """
    if name != RANDOM:
        return LazyRaster(path, name, index=index)
    with read_errors(path), h5py.File(path, "r") as file:
        names = [stored for stored in (RANDOM, *COMPUTED[RANDOM]) if stored in file]
    if SYSTEMATIC not in names:
        return LazyRaster(path, name, index=index)
    return ComputedRaster(path, name, {stored: LazyRaster(path, stored, index=index) for stored in names})
