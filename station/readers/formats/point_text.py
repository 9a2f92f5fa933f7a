"""Scans as text, one point a line: XYZ, ASC, PTS and CSV, with or without a line of column names."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import ClassVar, TextIO

import numpy as np

from station.errors import ScanError
from station.quantities import Floats
from station.readers.formats.point_tables import Contents, Table, TableScan, field_of

MAX_LINE = 4096  # characters
MAX_HEADER_LINES = 50
COMMENTS = ("#", "//")
DELIMITERS = (";", "\t", ",", None)  # None: any white space
USUAL_COLUMNS = {3: ("x", "y", "z"), 4: ("x", "y", "z", "intensity")}


@dataclass(frozen=True)
class _Layout:
    """How the lines of a file are read."""

    columns: dict[str, int]  # index of the column by what it holds
    delimiter: str | None
    decimal_comma: bool
    first_line: int  # of the points, from 0
    point_count: int | None  # in the first line of PTS files


class TextScan(TableScan):
    """A scan as text (see `ScanReader`); its columns are named in the file, in the site file, or usual."""

    suffixes: ClassVar[tuple[str, ...]] = (".xyz", ".asc", ".pts")
    drops_nan = False  # a value that is missing in a line is NaN too

    def __init__(self, path: Path, *, range_max_m: float | None = None, columns: Sequence[str] = ()) -> None:
        self._column_names = tuple(columns)
        super().__init__(path, range_max_m=range_max_m)

    def _open(self) -> Contents:
        with self.path.open("rb") as file:
            size = file.seek(0, 2)
            file.seek(max(size - 1, 0))
            if file.read(1) not in (b"\n", b"\r"):
                raise ScanError("empty, or its last line has no end: cut off, or still being written")
        with self._lines() as file:
            lines = list(islice((line for line in _bounded(file)), MAX_HEADER_LINES))
        self._layout = _layout(lines, self._column_names)
        return Contents(self._layout.point_count)

    def _lines(self) -> TextIO:
        return self.path.open(encoding="utf-8-sig", errors="replace")

    def _tables(self, size: int) -> Iterator[Table]:
        layout = self._layout
        names = list(layout.columns)
        with self._lines() as file:
            lines: Iterator[str] = islice(_bounded(file), layout.first_line, None)
            for rows in parse_rows(lines, size, layout.delimiter, decimal_comma=layout.decimal_comma):
                if rows.shape[1] <= max(layout.columns.values()):
                    raise ScanError(f"a line has {rows.shape[1]} columns only")
                yield {name: rows[:, layout.columns[name]] for name in names}


def parse_rows(
    lines: Iterator[str], size: int, delimiter: str | None = None, *, decimal_comma: bool = False
) -> Iterator[Floats]:
    """Yield the numbers (n, columns) of lines, at most `size` at a time; raise ValueError for other text."""
    if decimal_comma:
        lines = (line.replace(",", ".") for line in lines)
    while True:
        block = list(islice(lines, size))
        if not block:
            return
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of lines that are all empty
            rows = np.loadtxt(block, delimiter=delimiter, comments=COMMENTS, ndmin=2)
        if rows.size:
            yield rows


def _bounded(file: TextIO) -> Iterator[str]:
    """Yield the lines of a file; raise ScanError for one that is too long to be a point."""
    while line := file.readline(MAX_LINE):
        if len(line) == MAX_LINE:
            raise ScanError(f"a line has more than {MAX_LINE:,} characters: not a scan as text")
        yield line


def _layout(lines: Sequence[str], column_names: Sequence[str]) -> _Layout:
    """Return how the lines of a file are read, from its first lines and the columns in the site file."""
    names: Sequence[str] = column_names
    point_count = None
    for number, line in enumerate(lines):
        text = line.strip()
        if not text:
            continue
        delimiter = next(mark for mark in DELIMITERS if mark is None or mark in text)
        decimal_comma = delimiter in {";", "\t"} and "," in text
        if delimiter == "," and len(text.split()) > text.count(",") - 1 > 0 and ", " not in text:
            delimiter, decimal_comma = None, True  # 1,5 2,5 3,5
        fields = text.lstrip("#/ ").split(delimiter)
        if _is_number(fields[0], decimal_comma=decimal_comma):
            if text.startswith(COMMENTS):
                continue
            if len(fields) == 1 and text.isdigit() and point_count is None:
                point_count = int(text)
                continue
            return _Layout(_columns(names, len(fields)), delimiter, decimal_comma, number, point_count)
        if not column_names and {"x", "y", "z"} <= {field_of(name) for name in fields}:
            names = fields
    raise ScanError("no line of numbers at its start: not a scan as text")


def _is_number(text: str, *, decimal_comma: bool) -> bool:
    try:
        float(text.replace(",", ".") if decimal_comma else text)
    except ValueError:
        return False
    return True


def _columns(names: Sequence[str], count: int) -> dict[str, int]:
    """Return the index of each column that is needed; raise ScanError if that is not known."""
    names = names or USUAL_COLUMNS.get(count, ())
    if not names:
        raise ScanError(
            f"has {count} columns without names: name them in the site file, such as"
            ' scans.columns = ["x", "y", "z", "intensity", "time"], "-" for others'
        )
    if len(names) != count:
        raise ScanError(f"has {count} columns, but {len(names)} names: {', '.join(names)}")
    columns: dict[str, int] = {}
    for index, name in enumerate(names):
        if (key := field_of(name)) is not None:
            columns.setdefault(key, index)
    if not {"x", "y", "z"} <= columns.keys():
        raise ScanError(f"has no columns x, y and z, but {', '.join(names)}")
    return columns
