"""Closed days and months become one file each; what no longer serves goes after a grace."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from itertools import groupby
from pathlib import Path
from typing import Any

import h5py
import netCDF4

from station.archive.layout import Series, define, written_whole
from station.archive.series import build_series, write_words
from station.archive.sources import HEAVY, ORDINARY, Source, copy_chunks, is_laid_out_alike, read_source, runs
from station.archive.store import JOINED, Row, epochs, joined, joined_revision, rows, rows_in, sources

DAY_CLOSED = timedelta(hours=6)  # after its end; a later scan makes a new revision
MONTH_CLOSED = timedelta(days=2)
GRACE = timedelta(hours=48)  # a reader may hold an older series.nc as long


def join_closed(series: Series, now: datetime, progress: Callable[[], None]) -> int:
    """Join the epochs of closed days, and of closed months, anew where they are not; return how many files.

    Ends with a `series.nc` that names the joined files. Epochs that differ in their shared parameters (the
    scanner was moved) are not joined with each other. `progress` is called after every epoch.
    """
    made = 0
    for kind, stamp in JOINED.items():
        for name, group in groupby(rows(series), key=lambda row: row.start.strftime(stamp)):
            found = list(group)
            if len(found) < 2 or not _closed(kind, found[0].start, now) or _is_joined(series, found, kind):
                continue
            held = [read_source(*run) for run in runs(found)]
            if any(source.parameters != held[0].parameters for source in held):
                continue
            revision = 1 + max((joined_revision(path) for path in joined(series, kind, name)), default=0)
            place = series.folder / kind / found[0].start.strftime("%Y/%m" if kind == "days" else "%Y")
            write_joined(series, held, place / f"{series.station_id}_{name}_r{revision}.nc", name, progress)
            made += 1
    if made:
        build_series(series)
    return made


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


def write_joined(series: Series, held: list[Source], path: Path, name: str, progress: Callable[[], None]) -> None:
    """Copy epochs into one file."""
    title = f"Elevation change at {series.name or series.station_id}, {name}"
    with written_whole(path) as beside:
        with netCDF4.Dataset(beside, "w", clobber=False) as file:
            write_words(file, series, title, held, held[0].parameters)
            for row in HEAVY:
                if any(row.name in source.shapes for source in held):
                    define(file, row, series, len(file["time"]))
        with h5py.File(beside, "r+", libver=ORDINARY) as file:
            for row in HEAVY:
                if row.name in file:
                    file[row.name].resize(len(file["time"]), axis=0)
            for source in held:
                _copy_rows(file, source, progress)


def _copy_rows(file: Any, source: Source, progress: Callable[[], None]) -> None:  # noqa: ANN401 - h5py has no types
    with h5py.File(source.path, "r") as origin:
        for row in range(source.count):
            for name in source.shapes:
                _copy(origin[name], source.first + row, file[name], source.at + row)
            progress()


def _copy(origin: Any, first: int, made: Any, at: int) -> None:  # noqa: ANN401 - h5py has no types
    """Copy a row of a large variable."""
    if is_laid_out_alike(origin, made):
        copy_chunks(origin, first, made, at)
    else:  # written by an older version
        made[at] = origin[first]


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
