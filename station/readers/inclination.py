"""The inclination log that a scanner writes for each scan."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from station.errors import ScanError
from station.quantities import Floats, InclinationLog
from station.readers.regular_file import open_regular
from station.readers.scan import WEEK_S, decoder_errors
from station.readers.weather_dialects import name_and_unit

COLUMNS = ("time", "roll", "pitch")
DELIMITERS = (";", "\t", ",")  # else white space
UNITS = {"rad": 180 / np.pi, "mrad": 0.18 / np.pi, "ms": 1e-3}  # factors to degrees and seconds, if not these
MAX_BYTES = 1 << 26  # 1 Hz for a month
MAX_TIME_DIFFERENCE_S = 86_400.0  # from the median time of the log; no scan lasts longer


def read_inclination(path: Path) -> InclinationLog:
    """Read time [s], roll and pitch [degrees] and return them uncleaned [rad]; an unreadable row is all NaN.

    The first line names the columns, `Time,Roll,Pitch`, with units behind them or not; without it they are
    these three. Other delimiters and decimal commas are recognised. Unreadable rows are kept so that the
    cleaning can count them. A last line without a newline is unreadable, because half a number is a wrong
    number, and so is a time more than a day from the others. GPS seconds of the week continue past the end of
    the week, as those of the scan do.
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
    delimiter = next((mark for mark in DELIMITERS if mark in lines[0]), None)
    columns = _columns(lines[0], delimiter, path.name)
    has_header = not np.isfinite(_parse_row(lines[0], delimiter, columns)).all()
    rows = np.array([_parse_row(line, delimiter, columns) for line in lines[has_header:]]).reshape(-1, 3)
    if partial_line.strip():
        rows = np.vstack([rows, [np.nan] * 3])
    readable = np.isfinite(rows).all(axis=-1)
    if not readable.any():
        raise ScanError(f"{path.name}: none of {len(rows)} rows can be read")
    time_s = _unwrap_week(rows[:, 0])
    readable &= np.abs(time_s - np.median(time_s[readable])) <= MAX_TIME_DIFFERENCE_S
    time_s[~readable] = rows[~readable] = np.nan
    return InclinationLog(time_s, np.radians(rows[:, 1]), np.radians(rows[:, 2]))


def _columns(first_line: str, delimiter: str | None, name: str) -> list[tuple[int, float]]:
    """Return index of each of COLUMNS, and the factor to its unit."""
    fields = [field.strip(' "\r') for field in first_line.split(delimiter)]
    named = [name_and_unit(field.lower()) for field in fields]
    found = {column: (index, unit) for index, (column, unit) in reversed(list(enumerate(named)))}
    if set(COLUMNS) <= found.keys():
        return [(found[column][0], UNITS.get(found[column][1], 1.0)) for column in COLUMNS]
    columns = [(index, 1.0) for index in range(len(COLUMNS))]
    if len(fields) == len(COLUMNS) and np.isfinite(_parse_row(first_line, delimiter, columns)).all():
        return columns
    raise ScanError(f"{name}: its first line is not Time,Roll,Pitch but {first_line[:60]!r}")


def align_gps_week(log: InclinationLog, time_s: float) -> InclinationLog:
    """Return a cleaned log with its times in the GPS week of the scan; `time_s` is a time of the scan [s].

    If the week ends between the starts of scan and log, only one of the two shows the rollover.
    """
    difference_s = time_s - float(np.median(log.time_s))
    weeks = round(difference_s / WEEK_S)
    if abs(weeks) != 1 or abs(difference_s - weeks * WEEK_S) > MAX_TIME_DIFFERENCE_S:
        return log
    return replace(log, time_s=log.time_s + weeks * WEEK_S)


def _parse_row(line: str, delimiter: str | None, columns: list[tuple[int, float]]) -> tuple[float, ...]:
    """Return the values of some columns of a line, each by its factor; all NaN if one is missing."""
    fields = line.split(delimiter)
    try:
        if delimiter != ",":
            fields = [field.replace(",", ".") for field in fields]
        return tuple(float(fields[index]) * factor for index, factor in columns)
    except (ValueError, IndexError):
        return (np.nan,) * len(columns)


def _unwrap_week(time_s: Floats) -> Floats:
    """Return seconds of the GPS week that continue past its end instead of falling back to zero [s].

    A log with times of the week's last day contains no times of its first day, except after the rollover.
    """
    if not np.any((time_s > WEEK_S - MAX_TIME_DIFFERENCE_S) & (time_s < WEEK_S)):
        return time_s
    return np.where((time_s >= 0) & (time_s < MAX_TIME_DIFFERENCE_S), time_s + WEEK_S, time_s)
