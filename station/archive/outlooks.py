"""What the scanner looks at, kept beside the store as plain arrays: inflating it took as long as measuring.

Only a memory: named after all that it was made from, and where it is gone or damaged it is made anew. One
array after the other, each followed by its checksums; how long they are, the first of them tells. Not by the
HDF5 library, which on a full disk leaves a file half closed and may end the process with it.
"""

from __future__ import annotations

import math
import mmap
import os
import weakref
from collections.abc import Callable
from contextlib import suppress
from hashlib import sha256
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from isal import isal_zlib

from station import __version__
from station.archive.layout import Series
from station.archive.reference import held_at
from station.errors import StoreError
from station.quantities import Ints, Reference
from station.science import shared
from station.science.outlook import CELLS, COUNTED, COUNTED_MOST, Outlook, Position, counted

ROWS = 128  # of the grid, that a checksum covers
KEPT = 2  # at a time, of one station: a scanner that was moved may still have old scans to be done again
DENSE = {"rise_m": np.float32, "number": np.int32}  # on the grid

Array = np.ndarray[Any, Any]


def kept_outlook(
    series: Series,
    reference: Reference,
    place: tuple[Position | None, Position],
    made_with: str,
    look: Callable[[], Outlook],
) -> Outlook:
    """Return what `look` gives, from its file beside the store if there is one; else it is made.

    `place` of the scanner and its axis; `made_with` tells everything else that it depends on.
    """
    status = held_at(series, reference.version).stat()
    told = (
        __version__,
        [(name, np.dtype(kind).str) for name, kind in (DENSE | CELLS).items()],
        COUNTED_MOST,
        reference.version,
        status.st_size,
        status.st_mtime_ns,
        place,
        made_with,
    )
    path = series.folder / f".outlook-{sha256(repr(told).encode()).hexdigest()[:16]}.bin"
    if not path.is_file():
        made = look()
        if not _write(path, made):
            return made
    try:
        return _open(path, reference, *place)
    except FileNotFoundError:  # another process, which needs others, has just let it go
        return look()


def _write(path: Path, made: Outlook) -> bool:
    """Keep what was made; tell whether there was room. No fsync: checksums tell what the power took."""
    beside = path.with_name(f".{path.name}.{os.getpid()}.part")
    held: dict[str, Array] = {name: getattr(made, name) for name in DENSE} | {**made.cells}
    datum = np.float64(made.datum_m).view(np.int64)
    try:
        with beside.open("wb") as file:
            frame = np.concatenate([made.bounds, made.one_in, [datum]])
            file.write(np.array([len(frame), _crc(frame)]).data)
            file.write(frame.data)
            for name in (*DENSE, *CELLS):
                file.write(np.ascontiguousarray(held[name]).data)
                edges = _edges(name, len(held[name]), made.bounds)
                file.write(np.array([_crc(held[name][a:b]) for a, b in pairwise(edges)]).data)
        beside.replace(path)
        kept = sorted(path.parent.glob(".outlook-*"), key=lambda one: one.stat().st_mtime_ns)
        for old in kept[:-KEPT]:
            old.unlink(missing_ok=True)
    except OSError:
        return False
    finally:
        with suppress(OSError):
            beside.unlink(missing_ok=True)
    return True


def _open(path: Path, reference: Reference, position_m: Position | None, axis: Position) -> Outlook:
    kept = _Kept(path)
    held = {}
    try:
        with path.open("rb") as file:
            length, crc = _numbers(file.read(16)).tolist()
            frame = _numbers(file.read(8 * length))
            if _crc(frame) != crc:
                raise _damaged(path)
            bounds, datum_m = frame[:-3], float(frame[-1:].view(np.float64)[0])
            for name, dtype in (DENSE | CELLS).items():
                shape = reference.grid.shape if name in DENSE else (_length(name, int(bounds[-1])),)
                at = file.tell()
                file.seek(math.prod(shape) * np.dtype(dtype).itemsize, os.SEEK_CUR)
                edges = _edges(name, shape[0], bounds)
                crcs = _numbers(file.read(8 * (len(edges) - 1)))
                if len(crcs) < len(edges) - 1:
                    raise _damaged(path)
                held[name] = _Plain(path, kept, at, shape, np.dtype(dtype), edges, crcs)
    except FileNotFoundError:
        raise
    except (OSError, ValueError, IndexError, OverflowError, MemoryError) as error:
        raise _damaged(path) from error
    rise_m, number = held.pop("rise_m"), held.pop("number")
    of = shared.basis(reference.grid, position_m, axis) if position_m else None
    one_in = int(frame[-3]), int(frame[-2])
    return Outlook(reference, of, position_m, datum_m, rise_m, number, bounds, one_in, held)  # type: ignore[arg-type] # sliced only


class _Kept:
    """A file that stays readable when another process lets it go, until nobody here needs it."""

    def __init__(self, path: Path) -> None:
        self.descriptor = os.open(path, os.O_RDONLY)
        weakref.finalize(self, os.close, self.descriptor)


class _Plain:
    """An array of a file, read as it is sliced; parts with a checksum of their own are held against it."""

    def __init__(
        self,
        path: Path,
        kept: _Kept,
        at: int,
        shape: tuple[int, ...],
        dtype: np.dtype[Any],
        edges: Ints,
        crc: Array,
    ) -> None:
        self._path = path
        self._kept = kept
        self._at = at
        self._shape = shape
        self._dtype = dtype
        self._row_bytes = math.prod(shape[1:]) * dtype.itemsize
        self._edges = edges
        self._crc = crc

    def __getitem__(self, rows: slice) -> Array:
        """Return some rows."""
        first, stop, step = rows.indices(self._shape[0])
        values = np.empty((stop - first) * self._row_bytes, np.uint8)
        try:
            read = os.preadv(self._kept.descriptor, [values.data], self._at + first * self._row_bytes)
        except OSError as error:
            raise StoreError(f"{self._path}: cannot be read: {error}") from error
        if read != len(values):
            raise _damaged(self._path)
        for number in range(*np.searchsorted(self._edges, (first, stop)).tolist()):
            begin, end = (int(row - first) * self._row_bytes for row in self._edges[number : number + 2])
            if end <= len(values) and _crc(values[begin:end]) != self._crc[number]:
                raise _damaged(self._path)
        return values.view(self._dtype).reshape(-1, *self._shape[1:])[::step]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> Array:  # noqa: ANN401, FBT001 - numpy's
        """Return all of it, where the system keeps the file, to be read only; or a copy."""
        if copy:
            return np.asarray(self[:], dtype=dtype)
        for begin, end in pairwise(self._edges.tolist()):
            self[begin:end]  # for the checksums; and a disk that fails tells so here, not by a signal
        skipped = self._at % mmap.ALLOCATIONGRANULARITY
        size = self._shape[0] * self._row_bytes
        try:
            held = mmap.mmap(
                self._kept.descriptor, skipped + size, access=mmap.ACCESS_READ, offset=self._at - skipped
            )
        except OSError as error:
            raise StoreError(f"{self._path}: cannot be read: {error}") from error
        values = np.frombuffer(held, self._dtype, size // self._dtype.itemsize, skipped)
        return np.asarray(values.reshape(self._shape), dtype=dtype)


def _numbers(raw: bytes) -> Ints:
    return np.frombuffer(raw, np.int64)


def _length(name: str, count: int) -> int:
    """Return how long an array is of an outlook with so many cells."""
    return len(range(count)[counted(count)]) if name in COUNTED else count


def _edges(name: str, rows: int, bounds: Ints) -> Ints:
    """Return where the parts of an array begin that have a checksum each, and where the last ends."""
    if name in DENSE:
        return np.append(np.arange(0, rows, ROWS), rows)
    return np.array([0, rows]) if name in COUNTED else bounds


def _crc(values: Array) -> int:
    return isal_zlib.crc32(np.ascontiguousarray(values).reshape(-1).view(np.uint8))


def _damaged(path: Path) -> StoreError:
    with suppress(OSError):
        path.unlink(missing_ok=True)
    return StoreError(f"{path}: damaged; it has been deleted and is made anew with the next scan")
