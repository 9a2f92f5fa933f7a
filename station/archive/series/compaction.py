"""Compaction: one file per closed day and month; replaced files are deleted after a grace period."""

from __future__ import annotations

import fcntl
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime, timedelta
from itertools import groupby
from pathlib import Path
from typing import Any

import h5py
import netCDF4

from station.archive.atomic_files import atomic_write
from station.archive.epochs import (
    COMPACTED,
    EpochRef,
    compacted_files,
    compacted_revision,
    epoch_files,
    epochs_in_file,
    parse_epoch_filename,
)
from station.archive.netcdf_layout import Series, create_variable
from station.archive.series.epoch_reader import (
    LARGE_VARIABLES,
    LIBVER_COMPAT,
    EpochSource,
    contiguous_runs,
    copy_chunks,
    has_same_encoding,
    read_source,
)
from station.archive.series.index import SeriesIndex, list_epochs
from station.archive.series.manifest import listed_sources
from station.archive.series.virtual import create_scalars, write_scalars, write_time_coverage

DAY_CLOSED = timedelta(hours=6)  # after its end; a later scan causes a new revision
MONTH_CLOSED = timedelta(days=2)
METADATA_BLOCK_BYTES = 2**20  # HDF5 metadata per block: a reader needs parts of the whole chunk index
GRACE = timedelta(hours=48)  # a reader may keep an older series.nc open for this long


def compact(
    series: Series,
    now: datetime,
    progress: Callable[[], None],
    verify: Callable[[Path], None] = lambda _: None,
) -> list[Path]:
    """Compact the epochs of each closed day and month that are not compacted yet; return the new files.

    `series.nc` refers to them when it is built next. A day or month is skipped if its epochs differ in their
    shared parameters (the scanner was relocated). `progress` is called regularly; `verify` raises StoreError
    if a file about to be copied is damaged. Does nothing while another process is compacting.
    """
    written: list[Path] = []
    with _exclusive_lock(series) as is_locked:
        for kind, stamp in COMPACTED.items() if is_locked else ():
            for name, group in groupby(list_epochs(series), key=lambda epoch: epoch.start.strftime(stamp)):
                refs = list(group)
                if (
                    len(refs) < 2
                    or not _is_closed(kind, refs[0].start, now)
                    or _is_compacted(series, refs, kind)
                ):
                    continue
                epoch_sources = [read_source(*run) for run in contiguous_runs(refs)]
                if any(source.parameters != epoch_sources[0].parameters for source in epoch_sources):
                    continue
                revision = 1 + max(
                    (compacted_revision(path) for path in compacted_files(series, kind, name)), default=0
                )
                folder = series.folder / kind / refs[0].start.strftime("%Y/%m" if kind == "days" else "%Y")
                path = folder / f"{series.station_id}_{name}_r{revision}.nc"
                write_compacted(series, epoch_sources, path, name, progress, verify)
                written.append(path)
    return written


@contextmanager
def _exclusive_lock(series: Series) -> Iterator[bool]:
    """Lock the store for compaction; yield False if another process holds the lock.

    Two processes would give two files the same name.
    """
    folder = os.open(series.folder, os.O_RDONLY)
    try:
        fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield True
    except BlockingIOError:
        yield False
    finally:
        os.close(folder)


def latest_start(series: Series) -> datetime:
    """Return the start of the newest epoch in the series.

    It replaces the clock during a backlog, when days that ended long ago are still being filled.
    """
    return max(epoch.start for epoch in list_epochs(series))


def count_compactable(series: Series) -> int:
    """Return the number of single-epoch files whose day is closed at the newest epoch of the series."""
    index = SeriesIndex(series)
    now = datetime.fromtimestamp(float(index.start_s[-1]), UTC)
    lone_files = (parse_epoch_filename(path) for path in index.files)
    return sum(
        epoch_file is not None and _is_closed("days", epoch_file.start, now) for epoch_file in lone_files
    )


def _is_closed(kind: str, start: datetime, now: datetime) -> bool:
    day = datetime(start.year, start.month, start.day, tzinfo=UTC)
    if kind == "days":
        return now > day + timedelta(days=1) + DAY_CLOSED
    return now > (day.replace(day=1) + timedelta(days=32)).replace(day=1) + MONTH_CLOSED


def _is_compacted(series: Series, refs: list[EpochRef], kind: str) -> bool:
    """Return True if all epochs are in one file of this kind, or of the next larger kind.

    A day may be in two files, its month and a file of the day with later scans, until the month is rewritten.
    """
    paths = {epoch.path.relative_to(series.folder) for epoch in refs}
    kinds = {path.parts[0] for path in paths}
    return kinds <= {"days", "months"} if kind == "days" else kinds == {"months"} and len(paths) == 1


def write_compacted(
    series: Series,
    epoch_sources: list[EpochSource],
    path: Path,
    name: str,
    progress: Callable[[], None],
    verify: Callable[[Path], None] = lambda _: None,
) -> None:
    """Copy epochs into one file with `name` in its title."""
    title = f"Elevation change at {series.name or series.station_id}, {name}"
    count = epoch_sources[-1].series_start + epoch_sources[-1].count
    with atomic_write(path) as tmp_path:
        with netCDF4.Dataset(tmp_path, "w", clobber=False) as file:
            create_scalars(file, series, title, count, epoch_sources[0].parameters)
            for spec in LARGE_VARIABLES:
                if any(spec.name in source.raster_shapes for source in epoch_sources):
                    create_variable(file, spec, series, count)
        with h5py.File(tmp_path, "r+", libver=LIBVER_COMPAT, meta_block_size=METADATA_BLOCK_BYTES) as file:
            write_scalars(file, epoch_sources, epoch_sources[0].parameters)
            write_time_coverage(file)
            for spec in LARGE_VARIABLES:
                if spec.name in file:
                    file[spec.name].resize(count, axis=0)
            for source in epoch_sources:
                verify(source.path)
                _copy_epochs(file, source, progress)


def _copy_epochs(file: Any, source: EpochSource, progress: Callable[[], None]) -> None:  # noqa: ANN401 - h5py has no types
    """Copy the epochs of a source, large variables only."""
    with h5py.File(source.path, "r") as source_file:
        for name in source.raster_shapes:
            source_variable, target = source_file[name], file[name]
            if has_same_encoding(source_variable, target):
                copy_chunks(
                    source_variable, source.file_start, target, source.series_start, source.count, progress
                )
                continue
            for offset in range(source.count):  # encoded differently by an older version
                target[source.series_start + offset] = source_variable[source.file_start + offset]
                progress()


def delete_expired(series: Series, now: datetime) -> list[Path]:
    """Delete files not in use for the grace period, and temporary files of killed processes; return them.

    What cannot be deleted now is tried again the next time.

    A file is in use while `series.nc` refers to it, will refer to it, or has the only copy of an epoch; all
    are while `series.nc` is damaged.
    """
    limit_s = (now - GRACE).timestamp()
    refs = list_epochs(series)
    in_series = listed_sources(series)
    in_use = {epoch.path for epoch in refs} | (in_series or set())
    starts = {epoch.start for epoch in refs}
    expired = [path for path in series.folder.glob("**/.*.part") if path.stat().st_mtime < limit_s]
    for path in [
        *(epoch_file.path for epoch_file in epoch_files(series)),
        *compacted_files(series, "days"),
        *compacted_files(series, "months"),
    ]:
        if in_series is None or path in in_use or path.stat().st_mtime >= limit_s:
            continue
        if all(epoch.start in starts for epoch in epochs_in_file(path)):
            expired.append(path)
    for path in expired:
        if path.is_dir():  # of the cache of the viewing geometry
            shutil.rmtree(path, ignore_errors=True)
        else:
            with suppress(OSError):
                path.unlink()
    return [path for path in expired if not path.exists()]
