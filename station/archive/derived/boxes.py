"""`boxes.nc`, `daily.nc` and `blocks/`: change of blocks of cells over time with its σ, from the epochs.

Ordinary files, which any program reads. They grow by one entry after the other: a new one is appended to a
copy, which then replaces the file. `blocks/` has a file for each day, because those of a year are too large
to copy. The name of such a file ends in a part of the hash of everything that it was computed from.
"""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import h5py
import netCDF4
import numpy as np

from station.archive.atomic_files import atomic_write
from station.archive.chunk_codec import read_column
from station.archive.derived.fingerprints import fingerprints_path, is_intact, write_fingerprints
from station.archive.discovery import time_coverage
from station.archive.netcdf_layout import (
    TIMES_PER_CHUNK,
    Series,
    create_file,
    create_variable,
    encode_text,
    write_global_attrs,
)
from station.archive.read_errors import read_errors
from station.archive.schema import BY_NAME, FILL, RASTER, SAFE_BOUND, TEXT, TEXT_LENGTH, Variable
from station.errors import StoreError
from station.quantities import Floats, Grid

Array = np.ndarray[Any, Any]
Rasters = Mapping[str, Array]

BOXES, DAILY, BLOCKS = "boxes.nc", "daily.nc", "blocks"
BOX_M, BLOCK_M = 100.0, 10.0
DAY_S = 86_400.0
KEY_DIGITS = 8  # of the hash in the name of a file of a day
ENTRIES_KEPT = 100  # at once: a file of years can be interrupted
_SOURCES = Variable("sources", TEXT, "S1", "name of the epoch file, or SHA-256 of the names of several")
_KEYS = (_SOURCES, BY_NAME["reference_version"])


@dataclass(frozen=True)
class BlockFile:
    """A file of blocks of cells."""

    name: str  # relative to the data folder
    title: str
    time: str  # what the time is
    grid: Grid  # of the blocks
    variables: tuple[Variable, ...]


@dataclass(frozen=True)
class Entries:
    """Time intervals of a block file, in order of time, and what each is computed from."""

    start_s: Floats  # (n,) since 1970
    end_s: Floats
    sources: Array  # (n,) texts as bytes
    reference_version: Array

    def __len__(self) -> int:
        """Return the number of entries."""
        return len(self.start_s)

    def __getitem__(self, chosen: slice) -> Entries:
        """Return some of the entries."""
        columns = (self.start_s, self.end_s, self.sources, self.reference_version)
        return Entries(*(column[chosen] for column in columns))

    @property
    def keys(self) -> Array:
        """What an entry is computed from, as one text (n,)."""
        return _joined(self.sources, self.reference_version)


def _joined(*texts: Array) -> Array:
    """Return texts (n,) of the length of `text`, joined one by one."""
    length = TEXT_LENGTH["text"]
    characters = [column.astype(f"S{length}").view("S1").reshape(-1, length) for column in texts]
    return np.concatenate(characters, axis=1).view(f"S{length * len(texts)}")[:, 0]


def _variables(cell_methods: str) -> tuple[Variable, ...]:
    one_sigma = "one standard deviation of the mean of the block"
    return (
        Variable(
            "elevation_change",
            RASTER,
            "f4",
            "mean elevation above the reference surface of the block's observed cells",
            "m",
            None,
            4,
            cell_methods,
            ancillary=("elevation_change_uncertainty", "elevation_change_random_uncertainty", "coverage"),
        ),
        Variable(
            "elevation_change_uncertainty",
            RASTER,
            "f4",
            "uncertainty of the elevation change of the block",
            "m",
            None,
            5,
            None,
            f"{one_sigma}, everything included; {SAFE_BOUND}",
        ),
        Variable(
            "elevation_change_random_uncertainty",
            RASTER,
            "f4",
            "random uncertainty of the elevation change of the block",
            "m",
            None,
            5,
            None,
            f"{one_sigma}; the part that is independent between blocks",
        ),
        Variable("coverage", RASTER, "f4", "share of the block's cells that have a change", "1", None, 3),
    )


_COUNT = Variable(
    "epoch_count", RASTER, "i2", "number of epochs of the day in which the block was observed", "1"
)
BOX_VARIABLES = _variables("area: mean")
DAILY_VARIABLES = (*_variables("area: mean time: mean"), _COUNT)


def box_file(grid: Grid, cells: int) -> BlockFile:
    """Return the description of `boxes.nc`: blocks of `cells` × `cells`, every epoch."""
    title = "Elevation change of blocks of cells"
    return BlockFile(BOXES, title, "middle of the scan", _coarse(grid, cells), BOX_VARIABLES)


def day_file(series: Series, cells: int, start_s: float, keys: Array) -> BlockFile:
    """Return the description of a file in `blocks/`: blocks of `cells` × `cells`, the epochs of a day.

    `start_s` is the start of the first, `keys` (n,) are those of their entries.
    """
    day = f"{datetime.fromtimestamp(start_s, UTC):%Y%m%d}"
    key = hashlib.sha256(keys.tobytes()).hexdigest()[:KEY_DIGITS]
    return replace(
        box_file(series.grid, cells), name=f"{BLOCKS}/{day[:4]}/{series.station_id}_{day}_{key}.nc"
    )


def daily_file(grid: Grid, cells: int) -> BlockFile:
    """Return the description of `daily.nc`: daily means of blocks of `cells` × `cells`."""
    title = "Daily mean elevation change of blocks of cells"
    return BlockFile(DAILY, title, "middle of the day", _coarse(grid, cells), DAILY_VARIABLES)


def _coarse(grid: Grid, cells: int) -> Grid:
    """Return the grid of blocks; those at the east and south edges may extend beyond the grid."""
    return replace(grid, cell_m=grid.cell_m * cells, nx=-(-grid.nx // cells), ny=-(-grid.ny // cells))


def update_days(
    series: Series,
    cells: int,
    entries: Entries,
    compute: Callable[[int], Rasters],
    progress: Callable[[], None],
) -> None:
    """Bring the files of `blocks/` up to date with the epochs, which are in order of time.

    Files of days that did not change are not opened. Otherwise as `update_blocks`.
    """
    if not len(entries):
        return
    folder, keys, current = series.folder / BLOCKS, entries.keys, set[str]()
    existing = {path.name: path for path in block_files(series)}
    recorded = {path.name for path in folder.glob(f"*/.{series.station_id}_*.json")}
    by_day = {_day_of(path): path for path in existing.values()}
    changes = np.flatnonzero(np.diff(entries.start_s // DAY_S)) + 1
    for first, end in pairwise([0, *changes.tolist(), len(entries)]):
        block_file = day_file(series, cells, entries.start_s[first], keys[first:end])
        path = series.folder / block_file.name
        current.add(path.name)
        if not (path.name in existing and fingerprints_path(path).name in recorded):
            older = by_day.get(_day_of(path))
            compute_of_day = partial(_shifted, compute, first)
            update_blocks(series, block_file, entries[first:end], compute_of_day, progress, older)
    for name in existing.keys() - current:
        for file in (existing[name], fingerprints_path(existing[name])):
            with suppress(OSError):
                file.unlink()


def _shifted(compute: Callable[[int], Rasters], first: int, index: int) -> Rasters:
    return compute(first + index)


def _day_of(path: Path) -> str:
    """Return the name of a file of a day without the hash."""
    return path.stem.rpartition("_")[0]


def block_files(series: Series) -> set[Path]:
    """Return the files of `blocks/`."""
    return set((series.folder / BLOCKS).glob(f"*/{series.station_id}_*.nc"))


def update_blocks(
    series: Series,
    block_file: BlockFile,
    entries: Entries,
    compute: Callable[[int], Rasters],
    progress: Callable[[], None],
    older: Path | None = None,
) -> Path | None:
    """Bring a file of blocks up to date with its entries and return its path.

    `compute` returns the rasters of the entry at an index; those already in the file are copied, unless it is
    damaged. `older` is the file to copy them from, if it has another name. Many new ones are written in
    steps, so that an interrupted update continues. Returns None and writes nothing without entries.
    `progress` is called after each entry written. Raises StoreError if an epoch is damaged or the file cannot
    be written; the old file remains.
    """
    path = series.folder / block_file.name
    if not len(entries):
        return None
    known, keys = older or path, entries.keys
    stored = _stored_keys(known, replace(series, grid=block_file.grid)) if is_intact(known) else keys[:0]
    if known == path and np.array_equal(stored, keys):
        return path
    for count in (*range(len(stored) + ENTRIES_KEPT, len(entries), ENTRIES_KEPT), len(entries)):
        _write_entries(series, block_file, entries[:count], compute, progress, (known, stored))
        known, stored = path, keys[:count]
    return path


def _write_entries(
    series: Series,
    block_file: BlockFile,
    entries: Entries,
    compute: Callable[[int], Rasters],
    progress: Callable[[], None],
    previous: tuple[Path, Array],
) -> None:
    """Write a file of blocks with all its entries; `previous` is a file with some of them, and their keys."""
    path, blocks = series.folder / block_file.name, replace(series, grid=block_file.grid)
    wanted, (known, stored) = entries.keys, previous
    is_kept = 0 < len(stored) <= len(wanted)  # a file cannot become shorter
    unchanged = np.zeros(len(wanted), np.bool_)
    if is_kept:
        unchanged[: len(stored)] = stored == wanted[: len(stored)]
    position = {key: index for index, key in enumerate(stored.tolist())}
    with atomic_write(path) as tmp_path, ExitStack() as stack:
        if is_kept:
            shutil.copyfile(known, tmp_path)
        old = stack.enter_context(netCDF4.Dataset(known)) if position else None
        with netCDF4.Dataset(tmp_path, "r+" if is_kept else "w") as file:
            if is_kept:
                write_global_attrs(file, blocks, _title(blocks, block_file))
            else:
                _create(file, blocks, block_file)
            for index in np.flatnonzero(~unchanged).tolist():
                old_index = position.get(wanted[index])
                if old is None or old_index is None:
                    rasters = compute(index)
                else:
                    rasters = _read(old, block_file, old_index)
                _write(file, block_file, entries, index, rasters)
                progress()
            file.setncatts(time_coverage(entries.start_s[0], entries.end_s[-1]))
        write_fingerprints(path, tmp_path)


def _stored_keys(path: Path, blocks: Series) -> Array:
    """Return the keys of the entries in a file; none if it is of another grid, or damaged.

    A file can match its fingerprint and be damaged all the same: by a fault while it was written.
    """
    try:
        with read_errors(path), netCDF4.Dataset(path), h5py.File(path, "r") as file:
            is_same_grid = all(
                np.array_equal(file[axis][:], centres_m)
                for axis, centres_m in (("x", blocks.grid.x_m), ("y", blocks.grid.y_m))
            )
            columns = [read_column(file[spec.name]) for spec in _KEYS]
    except StoreError:
        return np.array([], "S1")
    texts = [np.ascontiguousarray(column).view(f"S{column.shape[1]}")[:, 0] for column in columns]
    return _joined(*texts)[: None if is_same_grid else 0]


def _title(blocks: Series, block_file: BlockFile) -> str:
    return f"{block_file.title} at {blocks.name or blocks.station_id}"


def _create(file: netCDF4.Dataset, blocks: Series, block_file: BlockFile) -> None:
    create_file(file, blocks, _title(blocks, block_file), TIMES_PER_CHUNK)
    file["time"].long_name = block_file.time
    for spec in (*block_file.variables, *_KEYS):
        create_variable(file, spec, blocks, TIMES_PER_CHUNK)


def _write(
    file: netCDF4.Dataset, block_file: BlockFile, entries: Entries, index: int, rasters: Rasters
) -> None:
    start_s, end_s = entries.start_s[index], entries.end_s[index]
    file["time"][index] = (start_s + end_s) / 2
    file["time_bnds"][index] = (start_s, end_s)
    for spec, texts in zip(_KEYS, (entries.sources, entries.reference_version), strict=True):
        file[spec.name][index] = encode_text([texts[index].decode()], "text")[0]
    for spec in block_file.variables:
        values = rasters[spec.name]
        file[spec.name][index] = np.where(np.isfinite(values), values, FILL) if spec.dtype == "f4" else values


def _read(file: netCDF4.Dataset, block_file: BlockFile, index: int) -> Rasters:
    """Return the stored rasters of an entry."""
    file.set_auto_mask(False)
    return {spec.name: np.asarray(file[spec.name][index]) for spec in block_file.variables}


def read_entry(series: Series, name: str, start_s: float) -> dict[str, Array] | None:
    """Return the rasters of the entry that begins at a time, NaN where missing; None if there is none."""
    path = series.folder / name
    if not path.is_file():
        return None
    with read_errors(path), netCDF4.Dataset(path) as file:
        found = np.flatnonzero(np.asarray(file["time_bnds"][:, 0]) == start_s)
        if not len(found):
            return None
        names = [spec.name for spec in BOX_VARIABLES]
        return {key: np.ma.filled(file[key][int(found[0])].astype(np.float64), np.nan) for key in names}
