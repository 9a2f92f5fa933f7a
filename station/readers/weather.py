"""The weather of the station: one log that grows for years, or several files, in many dialects."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np

from station.errors import NotReadyError, ScanError
from station.quantities import Air, Floats, WeatherLog
from station.readers.regular_file import open_regular
from station.readers.scan import decoder_errors
from station.readers.weather_dialects import MAX_LINE_BYTES, Header, decode, read_header, split_line
from station.sections.inputs import WeatherSection

# Physical limits (temperature_c, pressure_hpa, humidity_pct); loggers write -7999 and the like for faults.
VALID_RANGES = ((-60.0, 50.0), (300.0, 1100.0), (0.0, 110.0))
MAX_FRACTION = 1.5  # largest humidity that may be a fraction; air of 1.5 % is not that dry for long
LINEAR_SEARCH_BYTES = 1 << 16  # bytes read line by line rather than bisected
PROBE_LINES = 20  # read to find one with a time where the file is damaged
MAX_ROWS_PAST_WINDOW = 100  # rows after the window until reading stops: a single row may have a wrong time
MAX_FILES = 10_000
PATTERN = "*?["  # characters of a pattern of file names

WeatherRow = tuple[float, float, float, float]  # time_utc_s, temperature_c, pressure_hpa, humidity_pct
ParseRow = Callable[[bytes], WeatherRow | None]


def log_files(path: Path) -> list[Path]:
    """Return the files of a log, whose name may be a pattern; raise NotReadyError if there is none."""
    if not any(character in path.name for character in PATTERN):
        return [path]
    with decoder_errors(f"{path.parent} cannot be listed"):
        files = sorted(path.parent.glob(path.name))
    if not files:
        raise NotReadyError(f"{path}: no file has such a name")
    if len(files) > MAX_FILES:
        raise ScanError(f"{path}: {len(files):,} files have such names, more than {MAX_FILES:,}")
    return files


def read_weather(section: WeatherSection, window_utc_s: tuple[float, float] | None = None) -> WeatherLog:
    """Read temperature [°C], pressure [hPa] and humidity [%] over time (k,), NaN where one is missing.

    A zone written with a time takes precedence over that of the site file. With `window_utc_s` only the rows
    in that window are read, so that years of log cost nothing; a file must then be in time order, the oldest
    or the newest row first. A last line still being written is ignored. Units that the file states are
    converted. Of several files each may have some of the quantities.

    Raises ScanError if a column is missing, no row is complete, no time can be read, humidity is a fraction,
    or the rows are of several stations; NotReadyError if a file cannot be read or there is none.
    """
    files = log_files(section.file)
    tables = [_read_file(path, section, window_utc_s, is_part=len(files) > 1) for path in files]
    name = section.file.name
    table = _merged(np.concatenate(tables))
    if len(table) and not np.isfinite(table).all(axis=1).any():
        raise ScanError(
            f"{name}: none of {len(table)} rows has temperature, pressure (hPa) and humidity within"
            " physical limits: sensor failed, or wrong columns or units"
        )
    time_utc_s, temperature_c, pressure_hpa, humidity_pct = table.T
    return WeatherLog(time_utc_s, temperature_c, pressure_hpa, np.minimum(humidity_pct, 100.0))


def _read_file(
    path: Path, section: WeatherSection, window_utc_s: tuple[float, float] | None, *, is_part: bool
) -> Floats:
    """Return the rows (k, 4) of one file in a window."""
    with decoder_errors(f"{path.name} cannot be read"), open_regular(path) as file:
        header = read_header(file, section, path.name, is_part=is_part)
        stations: set[str] = set()
        parse = _parser(header, section.station, stations)
        whose = f"{path.name}: no row" + (f" of station {section.station}" if section.station else "")
        newest_first = _is_newest_first(file, header, parse, whose)
        file.seek(header.first_row)
        window = window_utc_s or (-math.inf, math.inf)
        if window_utc_s is not None:
            _seek_time(file, window[1 if newest_first else 0], parse, newest_first=newest_first)
        rows = list(_rows_in_window(file, parse, window, newest_first=newest_first))
    if len(stations) > 1:
        some = ", ".join(sorted(stations)[:3])
        raise ScanError(f"{path.name}: has rows of {len(stations)} stations ({some}, …): set weather.station")
    table = np.array(rows, dtype=np.float64).reshape(-1, 4)
    if not header.is_percent:
        _require_percent(table[:, 3], path.name)
    return table


def _merged(table: Floats) -> Floats:
    """Return rows (k, 4) in time order; of rows with the same time, the last value of each quantity."""
    time_s, index = np.unique(table[:, 0], return_inverse=True)
    merged = np.full((len(time_s), 4), np.nan)
    merged[:, 0] = time_s
    for column in (1, 2, 3):
        is_known = np.isfinite(table[:, column])
        merged[index[is_known], column] = table[is_known, column]  # the last assignment counts
    return merged


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


def _is_newest_first(file: BinaryIO, header: Header, parse: ParseRow, whose: str) -> bool:
    """Return True if the newest rows of a file come first; raise ScanError if no time can be read."""
    size = file.seek(0, 2)
    file.seek(header.first_row)
    head = [file.readline(MAX_LINE_BYTES) for _ in range(PROBE_LINES)]
    file.seek(max(header.first_row, size - LINEAR_SEARCH_BYTES))
    tail = file.read(LINEAR_SEARCH_BYTES).splitlines(keepends=True)[-PROBE_LINES:]
    head_s, tail_s = ([row[0] for line in lines if (row := parse(line))] for lines in (head, tail))
    if head_s and tail_s:
        return bool(np.median(head_s) > np.median(tail_s))
    if not head_s and not tail_s:
        lines = [decode(line) for line in [*head, *tail] if line.endswith(b"\n")]
        rows = [split_line(line, header.delimiter) for line in lines]
        fields = next((row for row in rows if len(row) > max(header.time_indices)), None)
        if fields is not None:
            raise ScanError(
                f"{whose} has a readable time: the first one is {header.time_text(fields)!r}, but"
                " times must be ISO 8601, such as 2025-07-15 00:10:00, or as weather.time_format says"
            )
    return False


def _require_percent(humidity_pct: Floats, name: str) -> None:
    """Raise ScanError if humidity (k,) is so small that it must be a fraction."""
    known_pct = humidity_pct[np.isfinite(humidity_pct)]
    if len(known_pct) and known_pct.max() <= MAX_FRACTION:
        raise ScanError(
            f"{name}: humidity is at most {known_pct.max():g}: a fraction of 1? It must be in percent"
        )


def _parser(header: Header, station: str | None, stations: set[str]) -> ParseRow:
    """Return a function that parses a line into a row, or into None if it is not one.

    Rows of other stations than `station` are not; without it, the stations are added to `stations`.
    """
    has_comma = header.delimiter != ","  # then one in a number is that of decimals

    def parse(line: bytes) -> WeatherRow | None:
        if not line.endswith(b"\n"):
            return None
        try:
            fields = split_line(decode(line), header.delimiter)
            if len(fields) != header.width:
                return None
            named = None if header.station_index is None else fields[header.station_index]
            if None not in (station, named) and named != station:
                return None
            time_utc_s = header.to_utc_s(header.time_text(fields))
        except (ValueError, csv.Error, OverflowError):
            return None
        if station is None and named is not None:
            stations.add(named)
        temperature_c, pressure_hpa, humidity_pct = (
            math.nan if index is None else _parse_value(fields[index], *scale, *limits, has_comma=has_comma)
            for index, scale, limits in zip(header.indices, header.scales, VALID_RANGES, strict=True)
        )
        return time_utc_s, temperature_c, pressure_hpa, humidity_pct

    return parse


def _parse_value(
    text: str, factor: float, offset: float, low: float, high: float, *, has_comma: bool
) -> float:
    """Return a number times a factor plus an offset if that is within limits, otherwise NaN."""
    try:
        value = float(text.replace(",", ".") if has_comma else text) * factor + offset
    except ValueError:
        return math.nan
    return value if low <= value <= high else math.nan


def _rows_in_window(
    file: BinaryIO, parse: ParseRow, window_utc_s: tuple[float, float], *, newest_first: bool
) -> Iterator[WeatherRow]:
    """Yield the rows within a time window, from the current position of the file."""
    rows_past = 0
    first_s, last_s = window_utc_s
    while rows_past < MAX_ROWS_PAST_WINDOW and (line := file.readline(MAX_LINE_BYTES)):
        row = parse(line)
        if row is None:
            continue
        is_past = row[0] < first_s if newest_first else row[0] > last_s
        rows_past = rows_past + 1 if is_past else 0
        if first_s <= row[0] <= last_s:
            yield row


def _seek_time(file: BinaryIO, start_utc_s: float, parse: ParseRow, *, newest_first: bool) -> None:
    """Move the file to a line before the first row at or after a time in its order, by bisection."""
    low = file.tell()
    high = file.seek(0, 2)
    while high - low > LINEAR_SEARCH_BYTES:
        middle = (low + high) // 2
        file.seek(middle)
        file.readline(MAX_LINE_BYTES)  # the rest of a line
        rows = (parse(file.readline(MAX_LINE_BYTES)) for _ in range(PROBE_LINES))
        row = next((row for row in rows if row is not None), None)
        # no row: going back only means reading more
        if row is None or (row[0] <= start_utc_s if newest_first else row[0] >= start_utc_s):
            high = middle
        else:
            low = middle
    file.seek(low)
