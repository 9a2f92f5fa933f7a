"""Columns of weather logs in no dialect with usual names, found by the words in their names."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import BinaryIO

from station.readers.weather_dialects import (
    DELIMITERS,
    MAX_COLUMN_NAME,
    MAX_COLUMNS,
    MAX_HEADER_LINES,
    MAX_LINE_BYTES,
    decode,
    name_and_unit,
    split_line,
)

# How names of a quantity of the air begin, in English and German; `T` and the like are no parts of words.
BEGINNINGS = {
    "temperature_c": re.compile(
        r"(?i)(air|luft|ambient|out(side|door)?|au(ß|ss)en)[ _]*t|t[ _]?air|(t|ta|tl|taact)(?![a-z])|temp"
    ),
    "humidity_pct": re.compile(
        r"(?i)(rh|rf|rhact)(?![a-z])|(rel(ative?)?|air|luft|out)?[ _.]*(air|luft)?[ _]*(hum|feuchte)"
    ),
    "pressure_hpa": re.compile(
        r"(?i)(p|bp|pact)(?![a-z])|(abs(olute?)?|atm\w*|station)?[ _.]*(air|luft)?[ _]*(press|druck)|baro"
    ),
}
# What is not the mean state of the air at the station: whole words, and parts of words.
OTHER_WORDS = {
    "max",
    "min",
    "std",
    "sd",
    "tmx",
    "tmn",
    "in",
    "ir",
    "qc",
    "sea",
    "msl",
    "slp",
    "qnh",
    "qff",
    "nn",
}
OTHER_PARTS = re.compile(
    r"(?i)dew|taup|soil|boden|snow|schnee|panel|board|logger|batt|case|chill|heat|wet|surf|oberfl|water|wasser"
    r"|feels|inside|indoor|innen|flag|qualit|vapo|dampf|reduced|reduziert|trend|spec"
)
DATE_NAME = re.compile(r"(?i)date|datum|day|tag")
CLOCK_NAME = re.compile(r"(?i)time|zeit|uhrzeit|hour|clock")
TIME_NAME = re.compile(
    r"(?i)(utc[ _]?)?(time[ _]?stamp|date[ _&-]*time|datum[ _/&-]*(uhr)?zeit|time|date|zeit|datum)"
)


@dataclass(frozen=True)
class FoundColumns:
    """Names of columns by the keys of `weather.columns`; of `time`, one or date and time.

    A key with several candidates is in doubt, one without any is unknown.
    """

    time: tuple[str, ...]
    quantities: dict[str, tuple[str, ...]]

    @property
    def is_certain(self) -> bool:
        """True if there is a time, and one column for each quantity."""
        return bool(self.time) and all(len(names) == 1 for names in self.quantities.values())


def find_columns(file: BinaryIO, dialect: str) -> FoundColumns:
    """Return the columns of a log, open at its start, by the line that names the most of them."""
    found = [_columns_in(names) for names in _possible_names(file, dialect)]
    empty = FoundColumns((), dict.fromkeys(BEGINNINGS, ()))
    return max(
        [empty, *found], key=lambda columns: sum(map(bool, (columns.time, *columns.quantities.values())))
    )


def _possible_names(file: BinaryIO, dialect: str) -> Iterator[list[str]]:
    """Yield what may be the names of the columns, by line and delimiter."""
    for number in range(2 if dialect == "toa5" else MAX_HEADER_LINES):
        line = decode(file.readline(MAX_LINE_BYTES))
        if dialect == "toa5" and number == 0:
            continue
        for delimiter in [mark for mark in DELIMITERS if mark and mark in line]:
            with suppress(csv.Error):
                names = split_line(line, delimiter)
                if len(names) <= MAX_COLUMNS:
                    yield [name for name in names if len(name) <= MAX_COLUMN_NAME and name.isprintable()]


def _columns_in(names: Sequence[str]) -> FoundColumns:
    plain = {name: name_and_unit(name)[0] for name in names}
    quantities = {
        key: tuple(name for name in plain if beginning.match(plain[name]) and _is_of_the_air(plain[name]))
        for key, beginning in BEGINNINGS.items()
    }
    times = [name for name in plain if TIME_NAME.fullmatch(plain[name])]
    dates = [name for name in times if DATE_NAME.search(name) and not CLOCK_NAME.search(name)]
    clocks = [name for name in times if CLOCK_NAME.search(name) and not DATE_NAME.search(name)]
    if len(times) == 1:
        return FoundColumns((times[0],), quantities)
    is_pair = len(times) == len(dates) + len(clocks) and len(dates) == len(clocks) == 1
    return FoundColumns((dates[0], clocks[0]) if is_pair else (), quantities)


def _is_of_the_air(name: str) -> bool:
    words = set(re.split(r"[^a-zäöüß]+", name.lower()))
    return not words & OTHER_WORDS and not OTHER_PARTS.search(name)
