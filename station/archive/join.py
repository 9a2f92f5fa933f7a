"""Closed days and months become one file each; what no longer serves goes after a grace."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from itertools import groupby
from pathlib import Path
from typing import Any

import h5py
import netCDF4

from station.archive.layout import Series, define, written_whole
from station.archive.series import write_words
from station.archive.sources import HEAVY, ORDINARY, Source, copy_chunks, is_laid_out_alike, read_source, runs
from station.archive.store import (
    JOINED,
    Named,
    Row,
    epochs,
    joined,
    joined_revision,
    rows,
    rows_in,
    sources,
    stored,
)

DAY_CLOSED = timedelta(hours=6)  # after its end; a later scan makes a new revision
MONTH_CLOSED = timedelta(days=2)
INDEX_BYTES = 2**20  # of where the chunks are, that lie together: a reader needs some of all of it
GRACE = timedelta(hours=48)  # a reader may hold an older series.nc as long


def join_closed(
    series: Series,
    now: datetime,
    progress: Callable[[], None],
    prove: Callable[[Path], None] = lambda _: None,
) -> list[Path]:
    """Join the epochs of closed days, and of closed months, anew where they are not; return the files made.

    `series.nc` names them when it is built next. Epochs that differ in their shared parameters (the scanner
    was moved) are not joined with each other. `progress` is called again and again; `prove` raises StoreError
    where a file about to be copied is damaged. Nothing is done while another process joins.
    """
    made: list[Path] = []
    with _only_here(series) as is_ours:
        for kind, stamp in JOINED.items() if is_ours else ():
            for name, group in groupby(rows(series), key=lambda row: row.start.strftime(stamp)):
                found = list(group)
                if (
                    len(found) < 2
                    or not _closed(kind, found[0].start, now)
                    or _is_joined(series, found, kind)
                ):
                    continue
                held = [read_source(*run) for run in runs(found)]
                if any(source.parameters != held[0].parameters for source in held):
                    continue
                revision = 1 + max((joined_revision(path) for path in joined(series, kind, name)), default=0)
                place = series.folder / kind / found[0].start.strftime("%Y/%m" if kind == "days" else "%Y")
                path = place / f"{series.station_id}_{name}_r{revision}.nc"
                write_joined(series, held, path, name, progress, prove)
                made.append(path)
    return made


@contextmanager
def _only_here(series: Series) -> Iterator[bool]:
    """Tell whether no other process joins, and keep others from it: two would give one name to two files."""
    folder = os.open(series.folder, os.O_RDONLY)
    try:
        fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield True
    except BlockingIOError:
        yield False
    finally:
        os.close(folder)


def now_of(series: Series) -> datetime:
    """Return when the newest epoch of the series began: amid a backlog, days long over still fill."""
    return datetime.fromtimestamp(float(Named(series).start_s[-1]), UTC)


def count_closed(series: Series) -> int:
    """Return how many epochs of days that are closed in the time of the series lie in files of their own."""
    named = Named(series)
    now = datetime.fromtimestamp(float(named.start_s[-1]), UTC)
    alone = (stored(path) for path in named.files)
    return sum(one is not None and _closed("days", one.start, now) for one in alone)


def _closed(kind: str, start: datetime, now: datetime) -> bool:
    day = datetime(start.year, start.month, start.day, tzinfo=UTC)
    if kind == "days":
        return now > day + timedelta(days=1) + DAY_CLOSED
    return now > (day.replace(day=1) + timedelta(days=32)).replace(day=1) + MONTH_CLOSED


def _is_joined(series: Series, found: list[Row], kind: str) -> bool:
    """Tell whether all epochs lie in one file of this kind, or in those of the next larger.

    A day may lie in two: in its month, and what came later in a file of the day, until that is made anew.
    """
    paths = {row.path.relative_to(series.folder) for row in found}
    kinds = {path.parts[0] for path in paths}
    return kinds <= {"days", "months"} if kind == "days" else kinds == {"months"} and len(paths) == 1


def write_joined(
    series: Series,
    held: list[Source],
    path: Path,
    name: str,
    progress: Callable[[], None],
    prove: Callable[[Path], None] = lambda _: None,
) -> None:
    """Copy epochs into one file, called `name` in its title."""
    title = f"Elevation change at {series.name or series.station_id}, {name}"
    with written_whole(path) as beside:
        with netCDF4.Dataset(beside, "w", clobber=False) as file:
            write_words(file, series, title, held, held[0].parameters)
            for row in HEAVY:
                if any(row.name in source.shapes for source in held):
                    define(file, row, series, len(file["time"]))
        with h5py.File(beside, "r+", libver=ORDINARY, meta_block_size=INDEX_BYTES) as file:
            for row in HEAVY:
                if row.name in file:
                    file[row.name].resize(len(file["time"]), axis=0)
            for source in held:
                prove(source.path)
                _copy_rows(file, source, progress)


def _copy_rows(file: Any, source: Source, progress: Callable[[], None]) -> None:  # noqa: ANN401 - h5py has no types
    """Copy the wanted rows of the large variables of a source."""
    with h5py.File(source.path, "r") as origin:
        for name in source.shapes:
            one, made = origin[name], file[name]
            if is_laid_out_alike(one, made):
                copy_chunks(one, source.first, made, source.at, source.count, progress)
                continue
            for row in range(source.count):  # written by an older version
                made[source.at + row] = one[source.first + row]
                progress()


def sweep(series: Series, now: datetime) -> list[Path]:
    """Delete what has not served for the grace, and what killed writers left; return what went.

    A file serves while `series.nc` names it, is about to name it, or an epoch is nowhere else.
    """
    limit_s = (now - GRACE).timestamp()
    found = rows(series)
    serving = {row.path for row in found} | sources(series.path)
    starts = {row.start for row in found}
    gone = [path for path in series.folder.glob("**/.*.part") if path.stat().st_mtime < limit_s]
    for path in [*(one.path for one in epochs(series)), *joined(series, "days"), *joined(series, "months")]:
        if path in serving or path.stat().st_mtime >= limit_s:
            continue
        if all(row.start in starts for row in rows_in(path)):
            gone.append(path)
    for path in gone:
        path.unlink()
    return gone
