"""The inclination log a scanner writes beside each scan."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from station.errors import ScanError
from station.quantities import Floats, InclinationLog
from station.readers.scan import WEEK_S, foreign_code

COLUMNS = ("time", "roll", "pitch")
MOST_BYTES = 1 << 26  # 1 Hz for a month
FARTHEST_S = 86_400.0  # from the middle of the log: no scan lasts longer


def read_inclination(path: Path) -> InclinationLog:
    """Read `Time,Roll,Pitch` in degrees, as written, in radians; a row that cannot be read is all NaN.

    Such rows stay, so that who cleans the log can count them. A last line without its end is one of them:
    half a number is a wrong number; and so is a time more than a day from the others. GPS seconds of the week
    run on past the week's end, as the scan's do.
    Raises ScanError where no row can be read, NotReadyError where the disk or its rights fail.
    """
    with foreign_code(f"{path.name} cannot be read"), path.open("rb") as file:
        raw = file.read(MOST_BYTES + 1)
    if len(raw) > MOST_BYTES:
        raise ScanError(f"{path.name}: too large for an inclination log")
    whole, _, cut = raw.decode("utf-8-sig", "replace").rpartition("\n")
    lines = [line for line in whole.split("\n") if line.strip()]
    if not lines:
        raise ScanError(f"{path.name}: holds no row")
    names = [name.strip(' "\r').lower() for name in lines[0].split(",")]
    if not set(COLUMNS) <= set(names):
        raise ScanError(f"{path.name}: its first line is not Time,Roll,Pitch but {lines[0][:60]!r}")
    places = [names.index(name) for name in COLUMNS]
    rows = np.array([_numbers(line, places) for line in lines[1:]]).reshape(-1, 3)
    if cut.strip():
        rows = np.vstack([rows, [np.nan] * 3])
    readable = np.isfinite(rows).all(axis=-1)
    if not readable.any():
        raise ScanError(f"{path.name}: no row of {len(rows)} can be read")
    time_s = _past_week(rows[:, 0], rows[readable][0, 0])
    readable &= np.abs(time_s - np.median(time_s[readable])) <= FARTHEST_S
    time_s[~readable] = rows[~readable] = np.nan
    return InclinationLog(time_s, np.radians(rows[:, 1]), np.radians(rows[:, 2]))


def in_week_of(log: InclinationLog, time_s: float) -> InclinationLog:
    """Return a clean log in the GPS week that a scan counts its seconds in, of which `time_s` is one.

    Where the week ends between the starts of scan and log, only one of the two is seen to run on.
    """
    apart_s = time_s - float(np.median(log.time_s))
    weeks = round(apart_s / WEEK_S)
    if abs(weeks) != 1 or abs(apart_s - weeks * WEEK_S) > FARTHEST_S:
        return log
    return replace(log, time_s=log.time_s + weeks * WEEK_S)


def _numbers(line: str, places: list[int]) -> tuple[float, ...]:
    """Return the numbers in these places of a line, NaN for each where one is lacking."""
    fields = line.split(",")
    try:
        return tuple(float(fields[place]) for place in places)
    except (ValueError, IndexError):
        return (np.nan,) * len(places)


def _past_week(time_s: Floats, first_s: float) -> Floats:
    """Let week seconds that fall back to zero run on."""
    fallen = (time_s >= 0) & (time_s < first_s - WEEK_S / 2) & (first_s < WEEK_S)
    return np.where(fallen, time_s + WEEK_S, time_s)
