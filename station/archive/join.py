"""Closed days and months become one file each; what no longer serves goes after a grace."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from itertools import groupby
from pathlib import Path

from station.archive.layout import Series
from station.archive.series import Row, build_series, join, joined, rows, rows_in
from station.archive.store import epochs

DAY_CLOSED = timedelta(hours=6)  # after its end; a later scan makes a new revision
MONTH_CLOSED = timedelta(days=2)
GRACE = timedelta(hours=48)  # a reader may hold an older series.nc as long


def join_closed(series: Series, now: datetime, progress: Callable[[], None]) -> int:
    """Join the epochs of closed days, and of closed months, anew where they are not; return how many files.

    Ends with a `series.nc` that names the joined files.
    """
    made = 0
    for kind, stamp, closed in (("days", "%Y%m%d", _day_closed), ("months", "%Y%m", _month_closed)):
        folder = series.folder / kind
        for name, group in groupby(rows(series), key=lambda row: row.start.strftime(stamp)):
            found = list(group)
            if len(found) < 2 or not closed(found[0].start, now) or _is_joined(found, kind):
                continue
            revision = 1 + len([path for path in joined(series, kind) if f"_{name}_r" in path.name])
            place = folder / found[0].start.strftime("%Y/%m" if kind == "days" else "%Y")
            title = f"Elevation change at {series.name or series.station_id}, {name}"
            join(series, found, place / f"{series.station_id}_{name}_r{revision}.nc", title)
            progress()
            made += 1
    if made:
        build_series(series)
    return made


def _day_closed(start: datetime, now: datetime) -> bool:
    return now > datetime(start.year, start.month, start.day, tzinfo=UTC) + timedelta(days=1) + DAY_CLOSED


def _month_closed(start: datetime, now: datetime) -> bool:
    following = (datetime(start.year, start.month, 1, tzinfo=UTC) + timedelta(days=32)).replace(day=1)
    return now > following + MONTH_CLOSED


def _is_joined(found: list[Row], kind: str) -> bool:
    """Tell whether all epochs lie in one file of this kind, or of the next larger."""
    kinds = {"days": {"days", "months"}, "months": {"months"}}[kind]
    return len({row.path for row in found}) == 1 and not kinds.isdisjoint(found[0].path.parts)


def sweep(series: Series, now: datetime) -> list[Path]:
    """Delete files that the series has not named for the grace, and what writers left; return what went."""
    limit_s = (now - GRACE).timestamp()
    found = rows(series)
    used = {row.path for row in found}
    replaced_s = {row.start: row.path.stat().st_mtime for row in found}
    gone = [path for path in series.folder.glob("**/.*.part") if path.stat().st_mtime < limit_s]
    for path in [*(one.path for one in epochs(series)), *joined(series, "days"), *joined(series, "months")]:
        if path in used or path.stat().st_mtime >= limit_s:
            continue
        if all(replaced_s.get(row.start, limit_s) < limit_s for row in rows_in(path)):
            gone.append(path)
    for path in gone:
        path.unlink()
    return gone
