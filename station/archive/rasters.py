"""Rasters of a file, chunk by chunk, with a deflate of our own: the library's takes four times as long.

What comes out is the same format, shuffled and deflated, and what goes in is read as it is anywhere.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from isal import isal_zlib
from isal.igzip_lib import IsalError
from numpy.typing import NDArray

from station.archive.tiles import Tiles, places, unpacked
from station.archive.variables import FILL, Variable
from station.errors import StoreError

LEVEL = 1
BESIDE = 8  # chunks that are shuffled together
KEPT_BANDS = 2  # rows of chunks that are kept unpacked: of a band of cells and what is around it

Array = np.ndarray[Any, Any]


def write_rasters(path: Path, rows: Sequence[Variable], band: Callable[[slice], Iterable[Array]]) -> None:
    """Write rasters into the variables that a file has for them, as the first time.

    `band` gives some rows (r, nx) of each of them, as `rounded`. Chunks without any value are left unwritten.
    One after the other: threads would spend a tenth of it on waiting for each other.
    """
    with h5py.File(path, "r+") as file:
        held = [h5py.h5d.open(file.id, row.name.encode()) for row in rows]
        for row, dataset in zip(rows, held, strict=True):
            if row.dims[0] == "time":
                dataset.set_extent((1, *dataset.shape[1:]))
        ny = held[0].shape[-2]
        *_, height, width = chunk = held[0].get_create_plist().get_chunk()
        for top in range(0, ny, height):
            for dataset, values in zip(held, band(slice(top, min(top + height, ny))), strict=True):
                for left, packed in _deflated((height, width), values):
                    dataset.write_direct_chunk((0, top, left)[-len(chunk) :], packed)


def rounded(row: Variable, values: Array) -> Array:
    """Return values of a variable as the file holds them: rounded, and fill for NaN."""
    if row.dtype[0] == "f":
        if row.digits is not None:
            steps = values.dtype.type(2.0 ** math.ceil(row.digits * math.log2(10)))  # netCDF4's own rounding
            values = np.rint(steps * values)
            values *= 1 / steps
        values = np.fmin(values, values.dtype.type(FILL))  # of NaN: ten times as fast as to ask for it
    return values.astype(row.dtype, copy=False)


def _deflated(size: tuple[int, int], band: Array) -> Iterator[tuple[int, bytes]]:
    """Give the chunks of a band of a raster that hold something, each with its first column."""
    width = size[1]
    for first in range(0, band.shape[1], BESIDE * width):
        chunks = _side_by_side(band[:, first : first + BESIDE * width], size)
        holds, shuffled = chunks.min(axis=1) < FILL, _shuffled(chunks)
        for at in np.flatnonzero(holds).tolist():
            yield first + at * width, isal_zlib.compress(shuffled[at], LEVEL)


def _side_by_side(part: Array, size: tuple[int, int]) -> Array:
    """Lay a part of a band out chunk by chunk (n, height * width), with nothing beyond its edges."""
    (rows, columns), (height, width) = part.shape, size
    count, over = divmod(columns, width)
    chunks = np.empty((count + (over > 0), height, width), part.dtype)
    if over or rows < height:
        chunks[:] = FILL if part.dtype.kind == "f" else 0
    chunks[:count, :rows] = part[:, : count * width].reshape(rows, count, width).swapaxes(0, 1)
    if over:
        chunks[count, :rows, :over] = part[:, count * width :]
    return chunks.reshape(-1, height * width)


def _shuffled(chunks: Array) -> NDArray[np.uint8]:
    """Return chunks (n, m) byte by byte (n, bytes, m), the lowest first; they are used up.

    To shift and cut them takes half the time of gathering bytes that lie apart.
    """
    shuffled = np.empty((len(chunks), chunks.itemsize, chunks.shape[1]), np.uint8)
    whole = chunks.view(f"u{chunks.itemsize}")
    shuffled[:, 0] = whole
    for at in range(1, chunks.itemsize):
        whole >>= whole.dtype.type(8)
        shuffled[:, at] = whole
    return shuffled


def around(cells: Array) -> tuple[slice, slice]:
    """Return the rows and columns that hold the chosen cells (ny, nx); the first where there is none."""
    rows = _span(np.asarray(cells.any(axis=1)))
    return rows, _span(np.asarray(cells[rows].any(axis=0)))  # of a few rows, for along columns it takes long


def _span(chosen: Array) -> slice:
    """Return where the chosen (n,) lie, and the first where there is none."""
    there = np.flatnonzero(chosen)
    return slice(int(there[0]), int(there[-1]) + 1) if len(there) else slice(0, 1)


def as_stored(values: Array) -> Array:
    """Return values as they stand in the file, fill included."""
    return values


class Raster:
    """A raster (ny, nx) of a file that is read as rows of it are asked for, or as a whole as an array."""

    def __init__(
        self, path: Path, name: str, made: Callable[[Array], Array] = as_stored, index: int | None = None
    ) -> None:
        """`made` turns what stands in the file, fill included, into what is wanted, cell by cell.

        `index` is of an epoch, in a file of some. Raises StoreError where it cannot be read.
        """
        self._path = path
        self._made = made
        self._epoch = () if index is None else (index,)
        self._band = lru_cache(KEPT_BANDS)(self._read)
        with self._file() as file:
            if name not in file:
                raise StoreError(f"{path}: damaged, has no {name}")
            dataset = file[name]
            self._name = name
            self.shape: tuple[int, int] = dataset.shape[-2:]
            self._stored = dataset.dtype
            self._fill = dataset.fillvalue
            self._size: tuple[int, int] = dataset.chunks[-2:] if dataset.chunks else self.shape

    def _file(self) -> h5py.File:
        try:
            return h5py.File(self._path, "r")
        except OSError as error:
            raise StoreError(f"{self._path}: cannot be read: {error}") from error

    @cached_property
    def _chunks(self) -> dict[tuple[int, ...], tuple[int, int]] | None:
        """Where each chunk that holds something begins in the file, and its length, by its corner.

        None where there are those of other epochs too, or they are packed in another way.
        """
        with self._file() as file:
            dataset = file[self._name]
            alone = dataset.ndim == 2 or len(dataset) == 1
            return places(dataset) if alone and Tiles(dataset).is_plain else None

    @property
    def dtype(self) -> np.dtype[Any]:
        """What the values are."""
        return np.asarray(self[:1]).dtype

    def __getitem__(self, rows: slice | tuple[slice, slice] | Array) -> Array:
        """Return some rows (r, nx), of some columns, or the chosen cells (n,) of a mask (ny, nx)."""
        if isinstance(rows, np.ndarray):
            box = around(rows)
            return np.asarray(self[box][rows[box]])
        rows, columns = rows if isinstance(rows, tuple) else (rows, slice(None))
        (first, stop, step), (left, right, _) = rows.indices(self.shape[0]), columns.indices(self.shape[1])
        height = self._size[0]
        bands = range(first - first % height, stop, height)
        held = [self._band(top, left, right)[max(first - top, 0) : stop - top] for top in bands]
        held = held or [self._band(0, left, right)[:0]]  # no rows, asked for where a band begins
        return (held[0] if len(held) == 1 else np.concatenate(held))[::step]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> Array:  # noqa: ANN401, FBT001 - numpy's
        """Return all of it."""
        return np.asarray(self[:], dtype=dtype)

    def __len__(self) -> int:
        """Return the number of rows."""
        return self.shape[0]

    def _read(self, top: int, left: int, right: int) -> Array:
        """Return the rows of chunks that begin at one, from a column to another."""
        height, width = self._size
        rows = np.full((min(height, self.shape[0] - top), right - left), self._fill, self._stored)
        try:
            for edge, tile in self._tiles(top, range(left - left % width, right, width)):
                first = max(edge, left)
                part = tile[: len(rows), first - edge : right - edge]
                rows[:, first - left : edge + width - left] = part
        except (OSError, RuntimeError, ValueError, IsalError) as error:  # type: ignore[misc] # the stub has no class
            raise StoreError(f"{self._path}: damaged, cannot be read: {error}") from error
        return self._made(rows)

    def _tiles(self, top: int, edges: range) -> Iterator[tuple[int, Array]]:
        """Give the chunks of some columns of a band, as far as they hold something."""
        if self._chunks is None:
            with self._file() as file:
                tiles = Tiles(file[self._name])
                for edge in edges:
                    yield edge, tiles.read((*self._epoch, top, edge))
            return
        with self._path.open("rb") as file:
            for edge in edges:
                if (corner := (*self._epoch, top, edge)) in self._chunks:
                    at, size = self._chunks[corner]
                    raw = os.pread(file.fileno(), size, at)
                    yield edge, unpacked(raw, self._stored, self._size)
