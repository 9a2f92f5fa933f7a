"""Sums over the cells of each block, of 10 m or less: of an epoch, and of a reference surface.

They are formed while an epoch is written, because reading it back takes longer, and kept beside the store. A
file that is missing, damaged or of another epoch is replaced by sums of what is stored, which are the same to
the last bit.
"""

from __future__ import annotations

import math
import zipfile
from collections.abc import Collection, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from station.archive.derived.boxes import BLOCK_M
from station.archive.derived.computed_rasters import CHANGE, RANDOM, open_raster
from station.archive.epochs import EpochRef
from station.archive.netcdf_layout import CHUNK, Series
from station.archive.raster_io import Array
from station.archive.reference_files import reference_path
from station.archive.schema import FILL
from station.quantities import Floats, Grid, Quality, Reference
from station.science.time_series.events import BlockLevels

FOLDER = ".block_sums"  # in the data folder
MOST_SMALL_BLOCKS = 50_000  # of less than 10 m: they cost as much as those of a valley
FORMAT = 3  # of the kept sums
MIN_RANDOM_M = 0.001  # one sigma of a cell, for its weight
MAX_REFERENCE_SHARE = 0.5  # of the random variance of a block
QUALITY = "quality"
ROCK = int(Quality.STABLE_GROUND | Quality.BARE_GROUND)

Sums = dict[str, Floats]  # (by, bx) by name


def cells_per_block(grid: Grid) -> int:
    """Return the rows and columns of a block: 10 m, or fewer cells on a grid that is small.

    A block has at least 2 × 2 cells, if these are not larger than 10 m, and there are so many blocks at most.
    """
    finest = max(2, math.ceil(math.sqrt(grid.nx * grid.ny / MOST_SMALL_BLOCKS)))
    return min(finest, max(round(BLOCK_M / grid.cell_m), 1))


class EpochSummer:
    """Sums of the cells that have a change, formed while the rasters of an epoch are written or read.

    The rows come in order, any number at a time. A block is summed when all its rows are there: the sums do
    not depend on how many come at once.
    """

    def __init__(self, grid: Grid) -> None:
        self._grid, self._cells = grid, cells_per_block(grid)
        self._columns = np.arange(grid.nx) // self._cells
        self._top = 0  # row of the grid where the waiting rows begin
        self._waiting: dict[str, Array] = {}
        self._bands: list[Sums] = []

    def add(self, rows: slice, rasters: Mapping[str, Array]) -> None:
        """Add the next rows (r, nx) of the rasters as stored, fill values included."""
        waiting = {name: rasters[name] for name in (CHANGE, RANDOM, QUALITY)}
        if self._waiting:
            waiting = {name: np.concatenate([self._waiting[name], waiting[name]]) for name in waiting}
        count = len(waiting[CHANGE])
        if rows.stop < self._grid.ny:
            count -= count % self._cells
        if count:
            self._bands.append(self._sums({name: values[:count] for name, values in waiting.items()}))
            self._top += count
        self._waiting = {name: values[count:].copy() for name, values in waiting.items()}

    def sums(self) -> Sums:
        """Return the sums (by, bx) over the cells of each block, when all rows were added."""
        return {name: np.concatenate([band[name] for band in self._bands]) for name in self._bands[0]}

    def _sums(self, rasters: Mapping[str, Array]) -> Sums:
        grid, change_m = self._grid, rasters[CHANGE].ravel()
        cell = np.flatnonzero(change_m < FILL / 2)
        row, column = np.divmod(cell, grid.nx)
        width = int(self._columns[-1]) + 1
        height = -(-len(rasters[CHANGE]) // self._cells)
        random_m2 = rasters[RANDOM].ravel()[cell].astype(np.float64) ** 2
        weight = 1 / np.maximum(random_m2, MIN_RANDOM_M**2)
        fields = {
            "count": None,
            "change_m": change_m[cell],
            "random_m2": random_m2,
            "weight": weight,
            "weighted_change_m": weight * change_m[cell],
            "rock": (rasters[QUALITY].ravel()[cell] & ROCK) > 0,
            "x_m": grid.x_m[column],
            "y_m": grid.y_m[self._top :][row],
        }
        block = row // self._cells * width + self._columns[column]
        return _block_sums(block, fields, (height, width))


def _block_sums(block: Array, fields: Mapping[str, Array | None], shape: tuple[int, int]) -> Sums:
    size = shape[0] * shape[1]
    return {
        name: np.bincount(block, values, size).astype(np.float64).reshape(shape)
        for name, values in fields.items()
    }


def epoch_sums(series: Series, epoch: EpochRef, *, keep: bool = False) -> Sums:
    """Return the sums of an epoch: those kept while it was written, otherwise of its stored rasters.

    `keep` keeps the latter too.
    """
    path = _path(series, epoch.epoch_file)
    kept = _read(path, epoch.path)
    if kept is not None:
        return kept
    rasters = {name: open_raster(epoch.path, name, epoch.index) for name in (CHANGE, RANDOM, QUALITY)}
    summer = EpochSummer(series.grid)
    for top in range(0, series.grid.ny, CHUNK):
        rows = slice(top, min(top + CHUNK, series.grid.ny))
        summer.add(rows, {name: np.asarray(raster[rows]) for name, raster in rasters.items()})
    sums = summer.sums()
    if keep:
        _keep(path, epoch.path, sums)
    return sums


def keep_epoch_sums(series: Series, epoch_path: Path, summer: EpochSummer) -> None:
    """Keep the sums of an epoch that was written; skipped without an error if the disk is full."""
    _keep(_path(series, epoch_path.name), epoch_path, summer.sums())


def reference_sums(series: Series, reference: Reference) -> Sums:
    """Return count, height [m] and random variance [m²] of the known cells, summed over each block."""
    source = reference_path(series, reference.version)
    path = _path(series, f"reference_{reference.version}")
    kept = _read(path, source)
    if kept is not None:
        return kept
    grid, cells = series.grid, cells_per_block(series.grid)
    columns = np.arange(grid.nx) // cells
    height, width = -(-CHUNK // cells) * cells, int(columns[-1]) + 1
    bands: list[Sums] = []
    for top in range(0, grid.ny, height):
        rows = slice(top, min(top + height, grid.ny))
        surface_m = np.asarray(reference.elevation_m[rows]).ravel()
        cell = np.flatnonzero(np.isfinite(surface_m))
        row, column = np.divmod(cell, grid.nx)
        fields = {
            "known": None,
            "surface_m": surface_m[cell],
            "random_m2": np.asarray(reference.random_variance_m2[rows]).ravel()[cell],
        }
        shape = -(-(rows.stop - top) // cells), width
        bands.append(_block_sums(row // cells * width + columns[column], fields, shape))
    sums = {name: np.concatenate([band[name] for band in bands]) for name in bands[0]}
    _keep(path, source, sums)
    return sums


def block_levels(epoch: Sums, reference: Sums) -> BlockLevels:
    """Return the plain means over blocks of an epoch, as a volume needs them."""
    count = np.maximum(epoch["count"], 1)
    return _levels(epoch["change_m"] / count, epoch["random_m2"] / count**2, epoch, reference)


def precise_levels(epoch: Sums, reference: Sums) -> BlockLevels:
    """Return the means over blocks of an epoch with the smallest random variance: the weights are 1/σ²."""
    weight = np.where(epoch["count"] > 0, epoch["weight"], 1.0)
    return _levels(epoch["weighted_change_m"] / weight, 1 / weight, epoch, reference)


def _levels(change_m: Floats, random_m2: Floats, epoch: Sums, reference: Sums) -> BlockLevels:
    """Return levels without the variance of the reference, which is the same share of it in all cells.

    It is at most half: that of a single scan. The mean over the known cells may be more, where only the best
    were observed.
    """
    observed = (epoch["count"] > 0) & (reference["known"] > 0)
    reference_m2 = epoch["count"] * reference["random_m2"] / np.maximum(reference["known"], 1)
    with np.errstate(invalid="ignore", divide="ignore"):
        own_share = 1 - np.minimum(reference_m2 / epoch["random_m2"], MAX_REFERENCE_SHARE)
    return BlockLevels(np.where(observed, change_m, np.nan), np.where(observed, own_share * random_m2, 0.0))


def drop_epoch_sums(series: Series, needed: Collection[str]) -> None:
    """Delete the kept sums of epochs whose file is not among those still needed."""
    for path in (series.folder / FOLDER).glob(f"{series.station_id}_*.npz"):
        if path.stem not in needed:
            with suppress(OSError):
                path.unlink()


def _path(series: Series, name: str) -> Path:
    return series.folder / FOLDER / f"{name}.npz"


def _keep(path: Path, source: Path, sums: Sums) -> None:
    """Write sums beside the store, those of blocks without a cell left out."""
    first = next(iter(sums.values()))
    block = np.flatnonzero(first)
    columns: dict[str, Any] = {name: values.ravel()[block] for name, values in sums.items()}
    tmp_path = path.with_name(f".{path.name}.part")
    with suppress(OSError):
        path.parent.mkdir(exist_ok=True)
        with tmp_path.open("wb") as file:
            np.savez(file, stamp=_stamp(source), shape=first.shape, block=block, **columns)
        tmp_path.replace(path)


def _read(path: Path, source: Path) -> Sums | None:
    """Return kept sums; None if there are none of this source, or if they are damaged."""
    try:
        with path.open("rb") as opened, np.load(opened) as file:
            if file["stamp"].tolist() != _stamp(source):
                return None
            shape, block = tuple(file["shape"]), file["block"]
            sums = {}
            for name in set(file.files) - {"stamp", "shape", "block"}:
                sums[name] = np.zeros(shape)
                sums[name].ravel()[block] = file[name]
            return sums
    except (OSError, ValueError, KeyError, IndexError, EOFError, zipfile.BadZipFile):
        return None


def _stamp(source: Path) -> list[int]:
    """Return format, and size and modification time of a file, which never changes under its name."""
    status = source.stat()
    return [FORMAT, status.st_size, status.st_mtime_ns]
