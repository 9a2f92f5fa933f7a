"""The station's weather log: one file that grows for years, by Campbell loggers (TOA5) or others (CSV)."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import BinaryIO, Literal

import numpy as np

from station.errors import ScanError
from station.quantities import Air, WeatherLog
from station.readers.scan import foreign_code
from station.sections import WeatherColumns

# What air can be (temperature_c, pressure_hpa, humidity_pct); loggers write -7999 and the like for faults.
LIMITS = ((-60.0, 50.0), (300.0, 1100.0), (0.0, 110.0))
LONGEST_LINE = 1 << 16
SHORT_ENOUGH = 1 << 16  # bytes to read through rather than halve
LINES_TO_TRY = 20  # for one with a time, where the file is torn
ROWS_PAST = 100  # rows after the window before the rest is left: a single row may have a wrong clock

Row = tuple[float, float, float, float]  # time_utc_s, temperature_c, pressure_hpa, humidity_pct


def read_weather(
    path: Path,
    *,
    format: Literal["toa5", "csv"],  # noqa: A002 - the key of the site file
    columns: WeatherColumns,
    utc_offset_h: float,
    window_utc_s: tuple[float, float] | None = None,
) -> WeatherLog:
    """Read temperature [°C], pressure [hPa] and humidity [%] over time (k,), NaN where one is missing.

    `utc_offset_h` is what the logger's clock is ahead of UTC; a zone written with a time goes before it. With
    `window_utc_s` only the rows in it are sought out, so that years of log cost nothing; the file is taken to
    be in the order of time then. A last line still being written is left out.
    Raises ScanError for a file whose columns cannot be found or of whose rows none is complete, NotReadyError
    where the disk or its rights fail.
    """
    with foreign_code(f"{path.name} cannot be read"), path.open("rb") as file:
        parse = _parser(_names(file, format, path.name), columns, utc_offset_h, path.name)
        if window_utc_s is not None:
            _seek_time(file, window_utc_s[0], parse)
        rows = list(_rows(file, parse, window_utc_s or (-math.inf, math.inf)))
    table = np.array(rows, dtype=np.float64).reshape(-1, 4)
    if len(table) and not np.isfinite(table).all(axis=1).any():
        raise ScanError(
            f"{path.name}: none of {len(table)} rows has temperature, pressure (hPa) and humidity within what"
            " air can be: sensor failed, or wrong columns or units"
        )
    # of rows with the same time the last in the file is meant
    _, last = np.unique(table[::-1, 0], return_index=True)
    time_utc_s, temperature_c, pressure_hpa, humidity_pct = table[::-1][last].T
    return WeatherLog(time_utc_s, temperature_c, pressure_hpa, np.minimum(humidity_pct, 100.0))


def air_at(weather: WeatherLog, time_utc_s: float, max_age_s: float) -> Air | None:
    """Return the air at a time, from complete samples no farther than `max_age_s` from it; None without any.

    Linear between the samples before and after; one of them alone is taken as it is.
    """
    values = np.stack([weather.temperature_c, weather.pressure_hpa, weather.humidity_pct], axis=1)
    complete = np.isfinite(values).all(axis=1) & (np.abs(weather.time_utc_s - time_utc_s) <= max_age_s)
    if not complete.any():
        return None
    temperature_c, pressure_hpa, humidity_pct = (
        float(np.interp(time_utc_s, weather.time_utc_s[complete], column)) for column in values[complete].T
    )
    return Air(temperature_c, pressure_hpa, humidity_pct)


def _names(file: BinaryIO, kind: Literal["toa5", "csv"], name: str) -> list[str]:
    """Read the head of the file, up to the first row, and return the names of its columns."""
    head = [
        file.readline(LONGEST_LINE).decode("utf-8-sig", "replace") for _ in range(4 if kind == "toa5" else 1)
    ]
    if kind == "toa5":
        if not head[0].strip('"').startswith("TOA5"):
            raise ScanError(f'{name}: does not begin with TOA5; is it weather.format = "csv"?')
        head = head[1:2]  # then come units and how each was averaged
    return [column.strip() for column in next(csv.reader(head), [])]


def _parser(
    names: list[str], columns: WeatherColumns, utc_offset_h: float, file_name: str
) -> Callable[[bytes], Row | None]:
    """Return what makes a row of a line, None of a line that is none."""
    wanted = (columns.time, columns.temperature_c, columns.pressure_hpa, columns.humidity_pct)
    lacking = [name for name in wanted if name not in names]
    if lacking:
        raise ScanError(f"{file_name}: has no column {', '.join(lacking)}; it has {', '.join(names)}")
    time_place, *places = (names.index(name) for name in wanted)

    def parse(line: bytes) -> Row | None:
        if not line.endswith(b"\n"):
            return None
        try:
            fields = next(csv.reader([line.decode("utf-8", "replace")]), [])
            if len(fields) != len(names):
                return None
            time_utc_s = _utc_s(fields[time_place], utc_offset_h)
        except (ValueError, csv.Error, OverflowError):
            return None
        temperature_c, pressure_hpa, humidity_pct = (
            _value(fields[place], *limits) for place, limits in zip(places, LIMITS, strict=True)
        )
        return time_utc_s, temperature_c, pressure_hpa, humidity_pct

    return parse


def _utc_s(text: str, utc_offset_h: float) -> float:
    moment = datetime.fromisoformat(text.strip())
    if moment.tzinfo is not None:
        return moment.timestamp()
    return moment.replace(tzinfo=UTC).timestamp() - utc_offset_h * 3600


def _value(text: str, low: float, high: float) -> float:
    """Return a number within limits, else NaN."""
    try:
        value = float(text)
    except ValueError:
        return math.nan
    return value if low <= value <= high else math.nan


def _rows(
    file: BinaryIO, parse: Callable[[bytes], Row | None], window_utc_s: tuple[float, float]
) -> Iterator[Row]:
    """Give the rows within a window of time, from where the file stands."""
    past = 0
    while past < ROWS_PAST and (line := file.readline(LONGEST_LINE)):
        row = parse(line)
        if row is None:
            continue
        past = past + 1 if row[0] > window_utc_s[1] else 0
        if window_utc_s[0] <= row[0] <= window_utc_s[1]:
            yield row


def _seek_time(file: BinaryIO, start_utc_s: float, parse: Callable[[bytes], Row | None]) -> None:
    """Go to a line before the first row at or after a time, by halving."""
    low = file.tell()
    high = file.seek(0, 2)
    while high - low > SHORT_ENOUGH:
        middle = (low + high) // 2
        file.seek(middle)
        file.readline(LONGEST_LINE)  # the rest of a line
        rows = (parse(file.readline(LONGEST_LINE)) for _ in range(LINES_TO_TRY))
        row = next((row for row in rows if row is not None), None)
        if row is None or row[0] >= start_utc_s:  # no row: going back only means to read more
            high = middle
        else:
            low = middle
    file.seek(low)
