"""The inclination log that a scanner writes for each scan."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from station.errors import ScanError
from station.quantities import Floats, InclinationLog
from station.readers.regular_file import open_regular
from station.readers.scan import WEEK_S, decoder_errors

COLUMNS = ("time", "roll", "pitch")
MAX_BYTES = 1 << 26  # 1 Hz for a month
MAX_TIME_DIFFERENCE_S = 86_400.0  # from the median time of the log; no scan lasts longer


def read_inclination(path: Path) -> InclinationLog:
    """Read `Time,Roll,Pitch` [degrees] and return it uncleaned [rad]; an unreadable row is all NaN.

    Unreadable rows are kept so that the cleaning can count them. A last line without a newline is unreadable,
    because half a number is a wrong number, and so is a time more than a day from the others. GPS seconds of
    the week continue past the end of the week, as those of the scan do.
    Raises ScanError if no row can be read, NotReadyError if the disk fails or access is denied.
    """
    with decoder_errors(f"{path.name} cannot be read"), open_regular(path) as file:
        raw = file.read(MAX_BYTES + 1)
    if len(raw) > MAX_BYTES:
        raise ScanError(f"{path.name}: too large for an inclination log")
    complete, _, partial_line = raw.decode("utf-8-sig", "replace").rpartition("\n")
    lines = [line for line in complete.split("\n") if line.strip()]
    if not lines:
        raise ScanError(f"{path.name}: contains no rows")
    names = [name.strip(' "\r').lower() for name in lines[0].split(",")]
    if not set(COLUMNS) <= set(names):
        raise ScanError(f"{path.name}: its first line is not Time,Roll,Pitch but {lines[0][:60]!r}")
    indices = [names.index(name) for name in COLUMNS]
    rows = np.array([_parse_row(line, indices) for line in lines[1:]]).reshape(-1, 3)
    if partial_line.strip():
        rows = np.vstack([rows, [np.nan] * 3])
    readable = np.isfinite(rows).all(axis=-1)
    if not readable.any():
        raise ScanError(f"{path.name}: none of {len(rows)} rows can be read")
    time_s = _unwrap_week(rows[:, 0])
    readable &= np.abs(time_s - np.median(time_s[readable])) <= MAX_TIME_DIFFERENCE_S
    time_s[~readable] = rows[~readable] = np.nan
    return InclinationLog(time_s, np.radians(rows[:, 1]), np.radians(rows[:, 2]))


def align_gps_week(log: InclinationLog, time_s: float) -> InclinationLog:
    """Return a cleaned log with its times in the GPS week of the scan; `time_s` is a time of the scan [s].

    If the week ends between the starts of scan and log, only one of the two shows the rollover.
    """
    difference_s = time_s - float(np.median(log.time_s))
    weeks = round(difference_s / WEEK_S)
    if abs(weeks) != 1 or abs(difference_s - weeks * WEEK_S) > MAX_TIME_DIFFERENCE_S:
        return log
    return replace(log, time_s=log.time_s + weeks * WEEK_S)


def _parse_row(line: str, indices: list[int]) -> tuple[float, ...]:
    """Return the values of some columns of a line; all NaN if one is missing."""
    fields = line.split(",")
    try:
        return tuple(float(fields[index]) for index in indices)
    except (ValueError, IndexError):
        return (np.nan,) * len(indices)


def _unwrap_week(time_s: Floats) -> Floats:
    """Return seconds of the GPS week that continue past its end instead of falling back to zero [s].

    A log with times of the week's last day contains no times of its first day, except after the rollover.
    """
    if not np.any((time_s > WEEK_S - MAX_TIME_DIFFERENCE_S) & (time_s < WEEK_S)):
        return time_s
    return np.where((time_s >= 0) & (time_s < MAX_TIME_DIFFERENCE_S), time_s + WEEK_S, time_s)
