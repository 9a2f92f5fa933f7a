"""The station's weather log: one file that grows for years, from Campbell loggers (TOA5) or as CSV."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import BinaryIO, Literal

import numpy as np

from station.errors import ScanError
from station.quantities import Air, Floats, WeatherLog
from station.readers.regular_file import open_regular
from station.readers.scan import decoder_errors
from station.sections import WeatherColumns

# Physical limits (temperature_c, pressure_hpa, humidity_pct); loggers write -7999 and the like for faults.
VALID_RANGES = ((-60.0, 50.0), (300.0, 1100.0), (0.0, 110.0))
# Unit in the third line of a TOA5 file, in lower case without spaces, degree signs, `deg` and underscores:
# factor and offset to °C, hPa and %. Other units are taken to be these.
UNITS: tuple[dict[str, tuple[float, float]], ...] = (
    dict.fromkeys(("f", "fahrenheit"), (5 / 9, -160 / 9))
    | dict.fromkeys(("k", "kelvin", "kelvins"), (1.0, -273.15)),
    {"kpa": (10.0, 0.0), "pa": (0.01, 0.0), "bar": (1000.0, 0.0)}
    | dict.fromkeys(("inhg", "in.hg", "incheshg"), (33.8639, 0.0))  # NIST SP 811, B.8
    | dict.fromkeys(("mmhg", "torr"), (1.333224, 0.0)),
    dict.fromkeys(("0-1", "0..1", "frac", "fraction", "1"), (100.0, 0.0)),
)
PERCENT_UNITS = ("%", "%rh", "percent", "pct")
MAX_FRACTION = 1.5  # largest humidity that may be a fraction; air of 1.5 % is not that dry for long
MAX_LINE_BYTES = 1 << 16
LINEAR_SEARCH_BYTES = 1 << 16  # bytes read line by line rather than bisected
PROBE_LINES = 20  # read to find one with a time where the file is damaged
MAX_ROWS_PAST_WINDOW = 100  # rows after the window until reading stops: a single row may have a wrong time

WeatherRow = tuple[float, float, float, float]  # time_utc_s, temperature_c, pressure_hpa, humidity_pct


def read_weather(
    path: Path,
    *,
    format: Literal["toa5", "csv"],  # noqa: A002 - the key of the site file
    columns: WeatherColumns,
    utc_offset_h: float,
    window_utc_s: tuple[float, float] | None = None,
) -> WeatherLog:
    """Read temperature [°C], pressure [hPa] and humidity [%] over time (k,), NaN where one is missing.

    The logger's clock is `utc_offset_h` ahead of UTC; a zone written with a time takes precedence. With
    `window_utc_s` only the rows in that window are read, so that years of log cost nothing; the file must
    then be in time order. A last line still being written is ignored. Units in the third line of a TOA5 file
    are converted.
    Raises ScanError if a column is missing, no row is complete, no time can be read, the newest rows come
    first or humidity is a fraction; NotReadyError if the disk fails or access is denied.
    """
    with decoder_errors(f"{path.name} cannot be read"), open_regular(path) as file:
        names, units = _header(file, format, path.name)
        parse = _parser(names, units, columns, utc_offset_h, path.name)
        first_row = file.tell()
        if window_utc_s is not None:
            _seek_time(file, window_utc_s[0], parse)
        rows = list(_rows_in_window(file, parse, window_utc_s or (-math.inf, math.inf)))
        if window_utc_s is None or not rows:
            _check_times(file, first_row, parse, names.index(columns.time), path.name)
    table = np.array(rows, dtype=np.float64).reshape(-1, 4)
    humidity_unit = units[names.index(columns.humidity_pct)]
    if humidity_unit not in UNITS[2] and humidity_unit not in PERCENT_UNITS:
        _require_percent(table[:, 3], path.name)
    if len(table) and not np.isfinite(table).all(axis=1).any():
        raise ScanError(
            f"{path.name}: none of {len(table)} rows has temperature, pressure (hPa) and humidity within"
            " physical limits: sensor failed, or wrong columns or units"
        )
    # of rows with the same time, the last in the file counts
    _, last = np.unique(table[::-1, 0], return_index=True)
    time_utc_s, temperature_c, pressure_hpa, humidity_pct = table[::-1][last].T
    return WeatherLog(time_utc_s, temperature_c, pressure_hpa, np.minimum(humidity_pct, 100.0))


def interpolate_air(weather: WeatherLog, time_utc_s: float, max_age_s: float) -> Air | None:
    """Return the air at a time, from complete samples at most `max_age_s` from it; None if there are none.

    Linear between the samples before and after; a single sample is used as it is.
    """
    values = np.stack([weather.temperature_c, weather.pressure_hpa, weather.humidity_pct], axis=1)
    complete = np.isfinite(values).all(axis=1) & (np.abs(weather.time_utc_s - time_utc_s) <= max_age_s)
    if not complete.any():
        return None
    temperature_c, pressure_hpa, humidity_pct = (
        float(np.interp(time_utc_s, weather.time_utc_s[complete], column)) for column in values[complete].T
    )
    return Air(temperature_c, pressure_hpa, humidity_pct)


def _header(file: BinaryIO, kind: Literal["toa5", "csv"], name: str) -> tuple[list[str], list[str]]:
    """Return name and unit of each column, '' where it is not given; leave the file at its first row."""
    header_lines = [
        file.readline(MAX_LINE_BYTES).decode("utf-8-sig", "replace")
        for _ in range(4 if kind == "toa5" else 1)
    ]
    if kind == "toa5":
        if not header_lines[0].strip('"').startswith("TOA5"):
            raise ScanError(f'{name}: does not begin with TOA5; is it weather.format = "csv"?')
        header_lines = header_lines[1:3]  # the last line contains the kind of averaging
    names, units = (
        [field.strip() for field in next(csv.reader([line]), [])] for line in [*header_lines, ""][:2]
    )
    units = [re.sub(r"deg(rees?)?|[\s°_]", "", unit.lower()) for unit in units]
    return names, units + [""] * (len(names) - len(units))


def _check_times(
    file: BinaryIO, first_row: int, parse: Callable[[bytes], WeatherRow | None], time_index: int, name: str
) -> None:
    """Raise ScanError if no time at start and end of a file can be read, or the newest rows come first."""
    size = file.seek(0, 2)
    file.seek(first_row)
    head = [file.readline(MAX_LINE_BYTES) for _ in range(PROBE_LINES)]
    file.seek(max(first_row, size - LINEAR_SEARCH_BYTES))
    tail = file.read(LINEAR_SEARCH_BYTES).splitlines(keepends=True)[-PROBE_LINES:]
    head_s, tail_s = ([row[0] for line in lines if (row := parse(line))] for lines in (head, tail))
    if not head_s and not tail_s:
        lines = [line.decode("utf-8", "replace") for line in [*head, *tail] if line.endswith(b"\n")]
        fields = next((row for row in csv.reader(lines) if len(row) > time_index), None)
        if fields is not None:
            raise ScanError(
                f"{name}: no row has a readable time: the first one is {fields[time_index]!r}, but times must"
                " be ISO 8601, such as 2025-07-15 00:10:00"
            )
    elif head_s and tail_s and np.median(head_s) > np.median(tail_s):
        raise ScanError(
            f"{name}: the rows are not in time order, the newest come first: write the oldest first"
        )


def _require_percent(humidity_pct: Floats, name: str) -> None:
    """Raise ScanError if humidity (k,) is so small that it must be a fraction."""
    known_pct = humidity_pct[np.isfinite(humidity_pct)]
    if len(known_pct) and known_pct.max() <= MAX_FRACTION:
        raise ScanError(
            f"{name}: humidity is at most {known_pct.max():g}: a fraction of 1? It must be in percent"
        )


def _parser(
    names: list[str], units: list[str], columns: WeatherColumns, utc_offset_h: float, file_name: str
) -> Callable[[bytes], WeatherRow | None]:
    """Return a function that parses a line into a row, or into None if it is not one."""
    required = (columns.time, columns.temperature_c, columns.pressure_hpa, columns.humidity_pct)
    missing = [name for name in required if name not in names]
    if missing and any(";" in name for name in names):
        raise ScanError(f"{file_name}: its columns are separated by ';': write commas, and points in numbers")
    if missing:
        raise ScanError(f"{file_name}: has no column {', '.join(missing)}; it has {', '.join(names)}")
    time_index, *value_indices = (names.index(name) for name in required)
    scales = [known.get(units[index], (1.0, 0.0)) for known, index in zip(UNITS, value_indices, strict=True)]

    def parse(line: bytes) -> WeatherRow | None:
        if not line.endswith(b"\n"):
            return None
        try:
            fields = next(csv.reader([line.decode("utf-8", "replace")]), [])
            if len(fields) != len(names):
                return None
            time_utc_s = _utc_s(fields[time_index], utc_offset_h)
        except (ValueError, csv.Error, OverflowError):
            return None
        temperature_c, pressure_hpa, humidity_pct = (
            _parse_value(fields[index], *scale, *limits)
            for index, scale, limits in zip(value_indices, scales, VALID_RANGES, strict=True)
        )
        return time_utc_s, temperature_c, pressure_hpa, humidity_pct

    return parse


def _utc_s(text: str, utc_offset_h: float) -> float:
    time = datetime.fromisoformat(text.strip())
    if time.tzinfo is not None:
        return time.timestamp()
    return time.replace(tzinfo=UTC).timestamp() - utc_offset_h * 3600


def _parse_value(text: str, factor: float, offset: float, low: float, high: float) -> float:
    """Return a number times a factor plus an offset if that is within limits, otherwise NaN."""
    try:
        value = float(text) * factor + offset
    except ValueError:
        return math.nan
    return value if low <= value <= high else math.nan


def _rows_in_window(
    file: BinaryIO, parse: Callable[[bytes], WeatherRow | None], window_utc_s: tuple[float, float]
) -> Iterator[WeatherRow]:
    """Yield the rows within a time window, from the current position of the file."""
    rows_past = 0
    while rows_past < MAX_ROWS_PAST_WINDOW and (line := file.readline(MAX_LINE_BYTES)):
        row = parse(line)
        if row is None:
            continue
        rows_past = rows_past + 1 if row[0] > window_utc_s[1] else 0
        if window_utc_s[0] <= row[0] <= window_utc_s[1]:
            yield row


def _seek_time(file: BinaryIO, start_utc_s: float, parse: Callable[[bytes], WeatherRow | None]) -> None:
    """Move the file to a line before the first row at or after a time, by bisection."""
    low = file.tell()
    high = file.seek(0, 2)
    while high - low > LINEAR_SEARCH_BYTES:
        middle = (low + high) // 2
        file.seek(middle)
        file.readline(MAX_LINE_BYTES)  # the rest of a line
        rows = (parse(file.readline(MAX_LINE_BYTES)) for _ in range(PROBE_LINES))
        row = next((row for row in rows if row is not None), None)
        if row is None or row[0] >= start_utc_s:  # no row: going back only means reading more
            high = middle
        else:
            low = middle
    file.seek(low)
