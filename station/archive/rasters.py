"""Rasters of a file, chunk by chunk, with a deflate of our own: the library's takes four times as long.

What comes out is the same format, shuffled and deflated, and what goes in is read as it is anywhere.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from isal import isal_zlib

from station.archive.variables import FILL, Variable
from station.errors import StoreError

LEVEL = 1
TOGETHER = 2  # chunks deflated or inflated at once
FILTERS = (h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_DEFLATE)
KEPT_BANDS = 3  # rows of chunks that are kept unpacked: a band of cells and what is around it

Array = np.ndarray[Any, Any]


def write_rasters(path: Path, rasters: Iterable[tuple[Variable, Array]]) -> None:
    """Write rasters (ny, nx), NaN as fill, into the variables that a file has for them, as the first time.

    Chunks without any value are left unwritten.
    """
    with h5py.File(path, "r+") as file, ThreadPoolExecutor(TOGETHER) as pool:
        for row, values in rasters:
            dataset = h5py.h5d.open(file.id, row.name.encode())
            if row.dims[0] == "time":
                dataset.set_extent((1, *values.shape))
            *_, height, width = chunk = dataset.get_create_plist().get_chunk()
            ny, nx = values.shape
            places = [(top, left) for top in range(0, ny, height) for left in range(0, nx, width)]
            deflated = pool.map(partial(_deflated, row, values, (height, width)), places)
            for place, packed in zip(places, deflated, strict=True):
                if packed is not None:
                    dataset.write_direct_chunk((0, *place)[-len(chunk) :], packed)


def _deflated(row: Variable, values: Array, size: tuple[int, int], place: tuple[int, int]) -> bytes | None:
    """Return a chunk of a raster as it stands in the file; None where it holds nothing."""
    (top, left), (height, width) = place, size
    tile = values[top : top + height, left : left + width].astype(row.dtype)
    fill = FILL if row.dtype[0] == "f" else 0
    if row.dtype[0] == "f":
        empty = np.isnan(tile)
        if empty.all():
            return None
        if row.digits is not None:
            steps = tile.dtype.type(2.0 ** math.ceil(row.digits * math.log2(10)))  # netCDF4's own rounding
            tile = np.around(steps * tile) / steps
        tile[empty] = fill
    if tile.shape != size:
        whole = np.full(size, fill, row.dtype)
        whole[: tile.shape[0], : tile.shape[1]] = tile
        tile = whole
    shuffled = tile.reshape(-1, 1).view(np.uint8).T
    return isal_zlib.compress(np.ascontiguousarray(shuffled), LEVEL)


class Raster:
    """A raster (ny, nx) of a file that is read as rows of it are asked for, or as a whole as an array."""

    def __init__(self, path: Path, name: str, made: Callable[[Array], Array]) -> None:
        """`made` turns what stands in the file, fill included, into what is wanted, cell by cell."""
        self._path = path
        self._made = made
        with h5py.File(path, "r") as file:
            dataset = file[name]
            self.shape: tuple[int, int] = dataset.shape
            self._stored = dataset.dtype
            self._fill = dataset.fillvalue
            self._size = dataset.chunks
            plist = dataset.id.get_create_plist()
            filters = tuple(plist.get_filter(k)[0] for k in range(plist.get_nfilters()))
            self._chunks: dict[tuple[int, int], tuple[int, int]] = {}
            self._whole: Array | None = None
            if filters == FILTERS:
                dataset.id.chunk_iter(self._note)
            else:  # another program's; no need to be fast
                self._whole = dataset[:]
        self._band = lru_cache(KEPT_BANDS)(self._read)

    def _note(self, chunk: Any) -> None:  # noqa: ANN401 - h5py has no types
        self._chunks[chunk.chunk_offset] = chunk.byte_offset, chunk.size

    @property
    def dtype(self) -> np.dtype[Any]:
        """What the values are."""
        return self[:1].dtype

    def __getitem__(self, rows: slice | Array) -> Array:
        """Return some rows (r, nx)."""
        if isinstance(rows, np.ndarray):
            first, last = int(rows.min()), int(rows.max())
            return np.asarray(self[first : last + 1][rows - first])
        if self._whole is not None:
            return self._made(self._whole[rows])
        first, stop, _ = rows.indices(self.shape[0])
        height = self._size[0]
        bands = range(first - first % height, stop, height)
        held = [self._band(top)[max(first - top, 0) : stop - top] for top in bands]
        return held[0] if len(held) == 1 else np.concatenate(held)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> Array:  # noqa: ANN401, FBT001 - numpy's
        """Return all of it."""
        return np.asarray(self[:], dtype=dtype)

    def __len__(self) -> int:
        """Return the number of rows."""
        return self.shape[0]

    def _read(self, top: int) -> Array:
        """Return the rows of chunks that begin at one."""
        height, width = self._size
        ny, nx = self.shape
        rows = np.full((min(height, ny - top), nx), self._fill, self._stored)
        with self._path.open("rb") as file:
            for left in range(0, nx, width):
                if (top, left) not in self._chunks:
                    continue
                at, size = self._chunks[top, left]
                try:
                    raw = isal_zlib.decompress(os.pread(file.fileno(), size, at))
                    shuffled = np.frombuffer(raw, np.uint8).reshape(self._stored.itemsize, -1)
                    tile = np.ascontiguousarray(shuffled.T).view(self._stored).reshape(height, width)
                except (OSError, ValueError, isal_zlib.error) as error:
                    raise StoreError(f"{self._path}: damaged, cannot be read: {error}") from error
                rows[:, left : left + width] = tile[: len(rows), : nx - left]
        return self._made(rows)
