"""The dialects of weather logs: where their header is, how their columns are called, and in which units.

Sources: Campbell Scientific, TOA5; MeteoIO, SMET 1.1; DWD Climate Data Center, 10 minutes and hourly;
MeteoSwiss, open data of SwissMetNet; Davis, WeatherLink; HOBO loggers, HOBOware; Lufft, UMB Config Tool;
GeoSphere Austria, Data Hub.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta, timezone
from functools import lru_cache
from typing import BinaryIO
from zoneinfo import ZoneInfo

from station.errors import ScanError
from station.sections.inputs import WeatherSection

MAX_LINE_BYTES = 1 << 16
MAX_COLUMN_NAME = 200  # characters; in a longer one no unit is looked for, which would take long
MAX_HEADER_LINES, MAX_COLUMNS = 100, 1000  # of a log
DELIMITERS = (";", "\t", ",", "")  # '': any white space
QUANTITIES = ("temperature_c", "pressure_hpa", "humidity_pct")
# Units, in lower case without spaces, degree signs, `deg` and `_`: factor and offset to °C, hPa and %.
UNITS: tuple[dict[str, tuple[float, float]], ...] = (
    dict.fromkeys(("c", "celsius"), (1.0, 0.0))
    | dict.fromkeys(("f", "fahrenheit"), (5 / 9, -160 / 9))
    | dict.fromkeys(("k", "kelvin", "kelvins"), (1.0, -273.15)),
    {"kpa": (10.0, 0.0), "pa": (0.01, 0.0), "bar": (1000.0, 0.0)}
    | dict.fromkeys(("hpa", "mbar", "mb"), (1.0, 0.0))
    | dict.fromkeys(("inhg", "in.hg", "incheshg"), (33.8639, 0.0))  # NIST SP 811, B.8
    | dict.fromkeys(("mmhg", "torr"), (1.333224, 0.0)),
    dict.fromkeys(("%", "%rh", "percent", "pct"), (1.0, 0.0))
    | dict.fromkeys(("0-1", "0..1", "frac", "fraction", "1"), (100.0, 0.0)),
)
SI = ("k", "pa", "1")
FIRST_WORDS = {"TOA5": "toa5", "SMET": "smet", "Plot Title": "hobo"}
OWN_NAMES = ("dwd", "meteoswiss")  # one column tells these dialects from all others
TIME_NAME = re.compile(r"(?i)time|date|datum|zeit")
QUANTITY_NAME = re.compile(r"(?i)temp|press|druck|humid|feuchte|\brh\b")
UNIX = "unix"  # weather.time_format of seconds since 1970
EXAMPLE = datetime(2025, 11, 15, 13, 14, 15, tzinfo=UTC)  # whose fields have all their digits
# A name and the unit behind it: `T [C]`, `T (C)`, `Temp, °C (LGR S/N: 1)`, `Temp - C`, `Temp_C`.
NAME_AND_UNIT = re.compile(r"(.+?)\s*(?:\[([^\]]+)\]|\(([^)]+)\)|,\s*([^(]+?)\s*(?:\(.*\))?|\s-\s+(\S+))$")
GMT_OFFSET = re.compile(r"(?:GMT|UTC)\s*([+-])(\d{1,2}):?(\d{2})?")


@dataclass(frozen=True)
class Dialect:
    """The usual names of the columns, and the formats of the times, of one kind of log."""

    time: tuple[tuple[str, ...], ...]  # candidates; of several columns, date and time are joined
    temperature_c: tuple[str, ...] = ()
    pressure_hpa: tuple[str, ...] = ()
    humidity_pct: tuple[str, ...] = ()
    time_formats: tuple[str, ...] = ()
    station: tuple[str, ...] = ()  # column that tells the rows of several stations apart


_ANY = Dialect(time=(("TIMESTAMP",),))
DIALECTS = {
    "toa5": _ANY,
    "csv": _ANY,
    "smet": Dialect((("timestamp",),), ("TA",), ("P",), ("RH",)),
    "dwd": Dialect(
        (("MESS_DATUM",),), ("TT_10", "TT_TU"), ("PP_10", "P0"), ("RF_10", "RF_TU"),
        ("%Y%m%d%H%M", "%Y%m%d%H"), ("STATIONS_ID",),
    ),
    "meteoswiss": Dialect(
        (("reference_timestamp",), ("Date",), ("time",)), ("tre200s0",), ("prestas0",), ("ure200s0",),
        ("%d.%m.%Y %H:%M", "%Y%m%d%H%M"), ("station_abbr", "Station/Location", "stn"),
    ),
    "geosphere": Dialect((("time",),), ("tl", "TL"), ("p", "P"), ("rf", "RF"), station=("station",)),
    "davis": Dialect(
        (("Date", "Time"), ("Date & Time",)), ("Temp Out", "Temp"), ("Abs Pres", "Abs Press", "Bar"),
        ("Out Hum", "Hum"),
    ),
    "hobo": Dialect(
        (("Date Time",),), ("Temp",), ("Abs Pres", "Pressure"), ("RH",),
        ("%m/%d/%y %I:%M:%S %p",),
    ),
    "lufft": Dialect(
        (("Date time",), ("Datum Zeit",)), ("Temperature", "Lufttemperatur", "Temperatur"),
        ("Abs. air pressure", "Abs. Luftdruck"), ("Relative humidity", "Rel. Feuchte", "Relative Feuchte"),
        ("%d.%m.%Y %H:%M:%S", "%d.%m.%Y %H:%M"),
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Header:
    """What the beginning of a log tells about its rows."""

    delimiter: str  # '': any white space
    width: int  # columns of a row
    time_indices: tuple[int, ...]
    indices: tuple[int | None, ...]  # of QUANTITIES; None if the file has no such column
    scales: tuple[tuple[float, float], ...]  # factor and offset of each
    station_index: int | None  # of the column that names the station
    is_percent: bool  # humidity is known not to be a fraction
    first_row: int  # position in the file [bytes]
    to_utc_s: Callable[[str], float]

    def time_text(self, fields: Sequence[str]) -> str:
        """Return the time of a row as it is written, date and time joined."""
        return " ".join(fields[index] for index in self.time_indices)


@dataclass(frozen=True)
class _Names:
    """Names and units of the columns as they stand in a file."""

    names: list[str]
    units: list[str]
    delimiter: str = ","
    to_si: list[tuple[float, float]] | None = None  # factor and offset of each column, of SMET
    offset_h: float | None = None  # of the clock to UTC, if the file states it


def decode(line: bytes) -> str:
    """Return the text of a line in UTF-8, else in the code page of Windows."""
    try:
        return line.decode("utf-8-sig")
    except UnicodeDecodeError:
        return line.decode("cp1252", "replace")


def split_line(line: str, delimiter: str) -> list[str]:
    """Return the fields of a line without the white space around them; raise csv.Error if it has none."""
    if not delimiter:
        return line.split()
    return [text.strip() for text in next(csv.reader([line.rstrip("\r\n")], delimiter=delimiter), [])]


def read_header(file: BinaryIO, section: WeatherSection, name: str, *, is_part: bool) -> Header:
    """Return the header of a log, open at its start; raise ScanError if a column is missing.

    `is_part` is true for one of several files, which need not have all quantities.
    """
    dialect = DIALECTS[section.format]
    wanted = _Wanted.of(section, dialect)
    found = _find_names(file, section, wanted, is_part=is_part)
    time_indices, indices = wanted.locate(found.names)
    if missing := wanted.missing(found.names, is_part=is_part):
        raise ScanError(f"{name}: has no column {', '.join(missing)}; it has {', '.join(found.names)}")
    assert time_indices is not None  # noqa: S101 - it is not missing
    units = ["" if index is None else found.units[index] for index in indices]
    if not any(units):
        units = _units_row(file, found, time_indices, indices)
    if section.units is not None:
        units = [getattr(section.units, key) or unit for key, unit in zip(QUANTITIES, units, strict=True)]
    units = [plain_unit(unit) for unit in units]
    scales = [known.get(unit, (1.0, 0.0)) for known, unit in zip(UNITS, units, strict=True)]
    if found.to_si is not None:
        scales = [
            (1.0, 0.0) if index is None else _composed(found.to_si[index], UNITS[number][SI[number]])
            for number, index in enumerate(indices)
        ]
    return Header(
        delimiter=found.delimiter,
        width=len(found.names),
        time_indices=time_indices,
        indices=indices,
        scales=tuple(scales),
        station_index=next(
            (i for name in dialect.station if (i := _index_of(name, found.names)) is not None), None
        ),
        is_percent=found.to_si is not None or units[2] in UNITS[2],
        first_row=file.tell(),
        to_utc_s=_time_parser(section, dialect.time_formats, _stated_offset_h(found, time_indices)),
    )


def recognise_dialect(file: BinaryIO) -> str:
    """Return the dialect of the log in a file by its header; '' if it is no weather log.

    It is `csv` if a line names a time and a quantity in other words than a known dialect.
    """
    line = decode(file.readline(MAX_LINE_BYTES)).lstrip('"')
    if mark := next((mark for mark in FIRST_WORDS if line.startswith(mark)), ""):
        return FIRST_WORDS[mark]
    for kind, dialect in DIALECTS.items():
        if not any(getattr(dialect, key) for key in QUANTITIES):
            continue
        file.seek(0)
        given = {"time_format": "%d"} if kind == "davis" else {}
        section = WeatherSection.model_validate({"file": "log", "format": kind, **given})
        wanted = _Wanted.of(section, dialect)
        with suppress(ScanError, ValueError, csv.Error):
            is_part = kind in OWN_NAMES
            if not wanted.missing(_find_names(file, section, wanted, is_part=is_part).names, is_part=is_part):
                return kind
    file.seek(0)
    lines = (decode(file.readline(MAX_LINE_BYTES)) for _ in range(MAX_HEADER_LINES))
    return "csv" if any(TIME_NAME.search(line) and QUANTITY_NAME.search(line) for line in lines) else ""


@dataclass(frozen=True)
class _Wanted:
    """The names of the columns that are looked for, the best first."""

    times: tuple[tuple[str, ...], ...]
    quantities: tuple[tuple[str, ...], ...]  # of QUANTITIES

    @classmethod
    def of(cls, section: WeatherSection, dialect: Dialect) -> _Wanted:
        """Return the columns of the site file, and those of the dialect where it names none."""
        columns = section.columns
        time = columns.time if columns else None
        given = [getattr(columns, key) if columns else None for key in QUANTITIES]
        usual = [getattr(dialect, key) for key in QUANTITIES]
        return cls(
            dialect.time if time is None else ((time,) if isinstance(time, str) else time,),
            tuple(names if name is None else (name,) for name, names in zip(given, usual, strict=True)),
        )

    def locate(self, names: Sequence[str]) -> tuple[tuple[int, ...] | None, tuple[int | None, ...]]:
        """Return the columns of the time and of each quantity; None where there is none."""
        times = ([_index_of(part, names) for part in parts] for parts in self.times)
        known = (tuple(index for index in indices if index is not None) for indices in times)
        lengths = [len(parts) for parts in self.times]
        time = next((found for found, n in zip(known, lengths, strict=True) if len(found) == n), None)
        return time, tuple(
            next((index for name in wanted if (index := _index_of(name, names)) is not None), None)
            for wanted in self.quantities
        )

    def missing(self, names: Sequence[str], *, is_part: bool) -> list[str]:
        """Return the columns that are missing; with `is_part` one quantity is enough."""
        time, indices = self.locate(names)
        lacking = [wanted[0] for wanted, index in zip(self.quantities, indices, strict=True) if index is None]
        if is_part and len(lacking) < len(QUANTITIES):
            lacking = []
        return lacking if time is not None else [" ".join(self.times[0]), *lacking]


def _index_of(wanted: str, names: Sequence[str]) -> int | None:
    """Return the index of a column by its name: as it is, in other letters, or without its unit."""
    plain = wanted.casefold()
    for candidates in (
        names,
        [name.casefold() for name in names],
        [name_and_unit(name)[0].casefold() for name in names],
    ):
        for text in (wanted, plain):
            if text in candidates:
                return list(candidates).index(text)
    return None


@lru_cache(1 << 12)
def name_and_unit(text: str) -> tuple[str, str]:
    """Return the name of a column and the unit that stands behind it, '' if there is none."""
    match = NAME_AND_UNIT.fullmatch(text) if len(text) <= MAX_COLUMN_NAME else None
    if match is None:
        return text, ""
    return match[1], next(unit for unit in match.groups()[1:] if unit is not None)


def plain_unit(unit: str) -> str:
    """Return a unit in the form of the keys of UNITS."""
    return re.sub(r"deg(rees?)?|[\s°º_\ufffd]", "", unit.lower())


def _find_names(file: BinaryIO, section: WeatherSection, wanted: _Wanted, *, is_part: bool) -> _Names:
    """Return the names of the columns; leave the file at its first row, or that of the units."""
    if section.format == "smet":
        return _smet_names(file)
    if section.format == "toa5":
        return _toa5_names(file)
    if section.names:
        return _given_names(file, section.names)
    best: list[str] = []
    previous = ""
    for _ in range(MAX_HEADER_LINES):
        line = decode(file.readline(MAX_LINE_BYTES))
        for delimiter in [mark for mark in DELIMITERS if mark and mark in line] or [""]:
            names = split_line(line, delimiter)
            if len(names) > MAX_COLUMNS:
                continue
            if section.format == "davis" and delimiter == "\t":
                names = _two_lines(split_line(previous, delimiter), names)
            if not wanted.missing(names, is_part=is_part):
                return _Names(names, _units_behind(names), delimiter)
            if delimiter and len(names) > len(best):
                best = names
        previous = line
    return _Names(best, [""] * len(best))


def _two_lines(above: list[str], below: list[str]) -> list[str]:
    """Return names that stand in two lines, such as `Temp` above `Out`."""
    above += [""] * (len(below) - len(above))
    return [f"{first} {second}".strip() for first, second in zip(above, below, strict=False)]


def _units_behind(names: Sequence[str]) -> list[str]:
    """Return the units behind the names of columns; a mere 1 is a number."""
    units = [name_and_unit(name)[1] for name in names]
    return ["" if unit.isdigit() else unit for unit in units]


def _toa5_names(file: BinaryIO) -> _Names:
    lines = [decode(file.readline(MAX_LINE_BYTES)) for _ in range(4)]
    if not lines[0].strip('"').startswith("TOA5"):
        raise ScanError('does not begin with TOA5; is it weather.format = "csv"?')
    names, units = (split_line(line, ",") for line in lines[1:3])  # the last line is the kind of averaging
    return _Names(names, units + [""] * (len(names) - len(units)))


def _given_names(file: BinaryIO, names: Sequence[str]) -> _Names:
    line = decode(file.readline(MAX_LINE_BYTES))
    file.seek(0)
    widths = {mark: len(split_line(line, mark)) for mark in DELIMITERS}
    delimiter = next((mark for mark, width in widths.items() if width == len(names)), None)
    if delimiter is None:
        raise ScanError(f"its first line has {max(widths.values())} columns, weather.names {len(names)}")
    return _Names(list(names), [""] * len(names), delimiter)


def _smet_names(file: BinaryIO) -> _Names:
    """Return the columns of a SMET file, whose header says how to get SI units. Source: SMET 1.1."""
    header: dict[str, str] = {}
    if not decode(file.readline(MAX_LINE_BYTES)).startswith("SMET"):
        raise ScanError("does not begin with SMET")
    for _ in range(MAX_HEADER_LINES):
        line = decode(file.readline(MAX_LINE_BYTES)).strip()
        if line == "[DATA]":
            break
        key, _, value = line.partition("=")
        header[key.strip()] = value.strip()
    names = header.get("fields", "").split()
    factors = [float(text) for text in header.get("units_multiplier", "").split()] or [1.0] * len(names)
    offsets = [float(text) for text in header.get("units_offset", "").split()] or [0.0] * len(names)
    if not len(names) == len(factors) == len(offsets):
        raise ScanError(f"its header has {len(names)} fields, but other numbers of units")
    to_si = list(zip(factors, offsets, strict=True))
    return _Names(names, [""] * len(names), "", to_si, float(header.get("tz") or 0.0))


def _composed(first: tuple[float, float], then: tuple[float, float]) -> tuple[float, float]:
    """Return factor and offset of two linear conversions, one after the other."""
    return first[0] * then[0], first[1] * then[0] + then[1]


def _units_row(
    file: BinaryIO, found: _Names, time_indices: Sequence[int], indices: Sequence[int | None]
) -> list[str]:
    """Return the units in the line after the names, and skip it; '' each if it is none."""
    start = file.tell()
    fields = split_line(decode(file.readline(MAX_LINE_BYTES)), found.delimiter)
    units = [fields[index] if index is not None and index < len(fields) else "" for index in indices]
    is_row = any(
        unit.strip("-+.,0123456789") and plain_unit(unit) in UNITS[n] for n, unit in enumerate(units)
    )
    if is_row and not any(character.isdigit() for index in time_indices for character in fields[index]):
        return units
    file.seek(start)
    return [""] * len(indices)


def _stated_offset_h(found: _Names, time_indices: Sequence[int]) -> float | None:
    """Return the offset of the clock to UTC that the header states [h], None if it states none."""
    match = GMT_OFFSET.search(" ".join(found.names[index] for index in time_indices))
    if match is None:
        return found.offset_h
    hours = int(match[2]) + int(match[3] or 0) / 60
    return -hours if match[1] == "-" else hours


def _time_parser(
    section: WeatherSection, usual_formats: Sequence[str], stated_offset_h: float | None
) -> Callable[[str], float]:
    """Return a function from the text of a time to seconds since 1970 (UTC); it raises ValueError."""
    offset_h = section.utc_offset_h if stated_offset_h is None else stated_offset_h
    zone = ZoneInfo(section.zone) if section.zone else timezone(timedelta(hours=offset_h))
    formats = (section.time_format,) if section.time_format else usual_formats

    def to_utc_s(text: str) -> float:
        if section.time_format == UNIX:
            return float(text)
        time = _parsed_time(text, formats)
        return (time if time.tzinfo is not None else time.replace(tzinfo=zone)).timestamp()

    return to_utc_s


def _parsed_time(text: str, formats: Sequence[str]) -> datetime:
    """Return a time by the first format that fits, else in ISO 8601; strptime takes digits too leniently."""
    for pattern in formats:
        if text.isdigit() and len(text) != len(EXAMPLE.strftime(pattern)):
            continue
        with suppress(ValueError):
            return datetime.strptime(text, pattern)  # noqa: DTZ007 - the pattern may contain a zone
    return datetime.fromisoformat(text)
