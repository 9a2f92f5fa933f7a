"""The whole series as one lazy dataset, whose rasters are unpacked by several threads.

The library's own way through a virtual variable takes several times as long for a box over a year.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import xarray as xr
from isal.igzip_lib import IsalError
from xarray.backends import BackendArray, BackendEntrypoint
from xarray.core import indexing

from station.archive.store import folder_of, sources
from station.archive.tiles import Tiles
from station.archive.variables import BY_NAME, FILL
from station.errors import StoreError

THREADS = 4  # at most
TOGETHER = 64  # tiles that a thread takes at once

Array = np.ndarray[Any, Any]


def open_series(site_or_folder: str | Path) -> xr.Dataset:
    """Return the whole series of a site file or data folder, lazily.

    Raises StoreError where there is none, or where a file it points to is gone: that would read as missing.
    """
    path = folder_of(site_or_folder) / "series.nc"
    if not path.is_file():
        raise StoreError(f"{path}: no series yet; has a scan been processed? (station status)")
    gone = sorted(str(source) for source in sources(path) if not source.is_file())
    if gone:
        raise StoreError(
            f"{path}: {len(gone)} of its files are gone, first {gone[0]}: put them back beside it"
        )
    return xr.open_dataset(path, engine=_Engine)


class _Engine(BackendEntrypoint):
    """Opens a `series.nc` as xarray's own does, but for its rasters."""

    def open_dataset(self, filename_or_obj: Any, *, drop_variables: Any = None) -> xr.Dataset:  # noqa: ANN401
        path = Path(filename_or_obj)
        while True:  # both ways have to open the same file: it may be replaced at any moment
            before = path.stat()
            rasters = _rasters(path)
            told = xr.open_dataset(
                path, engine="netcdf4", decode_timedelta=False, cache=False, drop_variables=drop_variables
            )
            if os.path.samestat(before, path.stat()):
                break
            told.close()
        for name in rasters.keys() & told.keys():
            old = told[name].variable
            data = indexing.LazilyIndexedArray(rasters[name])
            told[name] = xr.Variable(old.dims, data, old.attrs, old.encoding)
        return told


@dataclass(frozen=True)
class _Piece:
    """Epochs of a raster variable that lie in one file: `count` from the row `first` there, `at` here."""

    path: Path
    name: str
    first: int
    at: int
    count: int


@dataclass(frozen=True)
class _Cut:
    """What of the cells wanted along an axis lies in the chunks that begin at `corner`."""

    corner: int
    part: slice  # of the chunk
    inside: slice | Array  # of that part
    where: slice | Array  # of what is wanted


def _rasters(path: Path) -> dict[str, _Stack]:
    """Return the rasters of a `series.nc`, by name."""
    found = {}
    with h5py.File(path, "r") as file:
        for name in file.keys() & {row.name for row in BY_NAME.values() if row.is_raster}:
            if file[name].is_virtual:
                found[name] = _Stack(file[name].shape, file[name].dtype, list(_pieces(path, file[name])))
    return found


def _pieces(path: Path, dataset: Any) -> Iterator[_Piece]:  # noqa: ANN401 - h5py has no types
    for one in dataset.virtual_sources():
        first, last = (int(bound[0]) for bound in one.vspace.get_select_bounds())
        whole = one.src_space.get_select_type() == h5py.h5s.SEL_ALL
        there = 0 if whole else int(one.src_space.get_select_bounds()[0][0])
        yield _Piece(path.parent / one.file_name, one.dset_name, there, first, last - first + 1)


class _Stack(BackendArray):
    """A raster over time (n, ny, nx), NaN (or nought) where nothing is stored."""

    def __init__(self, shape: tuple[int, ...], dtype: np.dtype[Any], pieces: list[_Piece]) -> None:
        self.shape, self.dtype = shape, dtype
        self._pieces = pieces

    def __getitem__(self, key: indexing.ExplicitIndexer) -> Array:
        """Return what xarray asks for."""
        outer = indexing.IndexingSupport.OUTER
        return np.asarray(indexing.explicit_indexing_adapter(key, self.shape, outer, self._read))

    def _read(self, key: tuple[Any, ...]) -> Array:
        """Return the epochs, rows and columns that integers, slices or arrays of integers tell."""
        times, rows, columns = (
            np.atleast_1d(np.arange(size)[one]) for size, one in zip(self.shape, key, strict=True)
        )
        lacks = np.nan if self.dtype.kind == "f" else 0
        found = np.full((len(times), len(rows), len(columns)), lacks, self.dtype)
        with ThreadPoolExecutor(min(THREADS, len(os.sched_getaffinity(0)))) as pool:
            for piece in self._pieces:
                wanted = np.flatnonzero((times >= piece.at) & (times < piece.at + piece.count))
                if found[wanted].size:
                    there = times[wanted] - piece.at + piece.first
                    _fill(found, wanted, piece, there, (rows, columns), pool)
        return found[
            tuple(0 if np.ndim(one) == 0 and not isinstance(one, slice) else slice(None) for one in key)
        ]


def _fill(
    found: Array, at: Array, piece: _Piece, there: Array, cells: tuple[Array, Array], pool: ThreadPoolExecutor
) -> None:
    """Read the cells of some epochs, which lie `there` in a file, to where they are wanted (`at`)."""
    try:
        with h5py.File(piece.path, "r") as file:
            tiles = Tiles(file[piece.name])
            cuts = [list(_cuts(wanted, size)) for wanted, size in zip(cells, tiles.size, strict=True)]
            epochs = list(zip(at.tolist(), there.tolist(), strict=True))
            units = list(product(*cuts, epochs))  # as joined files hold them: place by place
            lots = (units[first : first + TOGETHER] for first in range(0, len(units), TOGETHER))
            for _ in pool.map(partial(_paste, found, tiles), lots):
                pass
    except (OSError, RuntimeError, KeyError, ValueError, IsalError) as error:  # type: ignore[misc] # the stub has no class
        raise StoreError(f"{piece.path}: damaged, cannot be read: {error}") from error


def _paste(found: Array, tiles: Tiles, units: list[tuple[_Cut, _Cut, tuple[int, int]]]) -> None:
    for down, across, (at, there) in units:
        told = tiles.read((there, down.corner, across.corner), (down.part, across.part))
        values = told[_both(down.inside, across.inside)]
        if values.dtype.kind == "f":
            values = np.where(values == values.dtype.type(FILL), values.dtype.type(np.nan), values)
        found[at][_both(down.where, across.where)] = values


def _cuts(wanted: Array, size: int) -> Iterator[_Cut]:
    """Cut cells along an axis, in any order, by the chunks they lie in."""
    for corner in np.unique(wanted - wanted % size).tolist():
        where = np.flatnonzero(wanted // size == corner // size)
        inside = wanted[where] - corner
        part = slice(int(inside.min()), int(inside.max()) + 1)
        yield _Cut(corner, part, _simple(inside - part.start), _simple(where))


def _simple(places: Array) -> slice | Array:
    """Return places as a slice if they follow one another."""
    one_by_one = np.array_equal(places, np.arange(places[0], places[0] + len(places)))
    return slice(int(places[0]), int(places[0]) + len(places)) if one_by_one else places


def _both(down: slice | Array, across: slice | Array) -> Any:  # noqa: ANN401 - what numpy takes as an index
    """Index rows and columns, each for itself."""
    if isinstance(down, np.ndarray) and isinstance(across, np.ndarray):
        return np.ix_(down, across)
    return down, across
