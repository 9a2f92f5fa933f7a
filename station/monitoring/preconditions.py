"""Preconditions of processing: free disk space and a plausible clock."""

from __future__ import annotations

import os
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from station.errors import StoreError

if TYPE_CHECKING:
    from pathlib import Path

    from station.config import Site

EARLIEST_S = datetime(2020, 1, 1, tzinfo=UTC).timestamp()
MAX_BEHIND_S = 86_400.0  # a clock this far behind our newest file is probably wrong
_RESERVE_BYTES = 16_000_000  # for the journal, the series and file system overhead
_EPOCH_BYTES_PER_CELL = 40  # uncompressed, with all error terms; `station check` reports the typical size


def require_disk_space(site: Site) -> None:
    """Raise StoreError if the disk is read-only, has too little space for another epoch, or no inodes."""
    folder = site.station.data
    cells = site.grid.shape[0] * site.grid.shape[1]
    required = _RESERVE_BYTES + _EPOCH_BYTES_PER_CELL * cells
    try:
        disk = os.statvfs(folder)
    except OSError as error:
        raise StoreError(f"{folder}: the data folder cannot be reached: {error.strerror}") from error
    if disk.f_flag & os.ST_RDONLY:
        raise StoreError(
            f"{folder}: its disk has gone read-only: check it and mount it again, the service then resumes"
        )
    free = disk.f_bavail * disk.f_frsize
    if free < required:
        raise StoreError(
            f"{folder}: {free / 1e6:.0f} MB free, {required / 1e6:.0f} MB needed: free some space,"
            " the service then resumes"
        )
    if disk.f_files and disk.f_favail < 16:
        raise StoreError(f"{folder}: no inodes left: delete some files, the service then resumes")


def clock_problem(data: Path, now_s: float) -> str | None:
    """Return why the clock is probably wrong: before 2020 or a day behind our newest file; else None."""
    clock_text = format_utc(now_s)
    if now_s < EARLIEST_S:
        return f"the clock shows {clock_text}: set it"
    newest_s = max((_mtime_s(data / name) for name in _WRITTEN_FILES), default=0.0)
    if now_s < newest_s - MAX_BEHIND_S:
        return (
            f"the clock shows {clock_text}, but the data folder was written at {format_utc(newest_s)}: set it"
        )
    return None


_WRITTEN_FILES = ("journal.sqlite", "journal.sqlite-wal", "series.nc")


def _mtime_s(path: Path) -> float:
    try:
        return path.stat().st_mtime
    except OSError:
        return 0.0


def format_utc(utc_s: float) -> str:
    """Return a time [s since 1970, UTC] as ISO 8601 text, to the second."""
    return f"{datetime.fromtimestamp(utc_s, UTC):%Y-%m-%dT%H:%M:%SZ}"
