"""Points as records of one length, or lines of text, after a header that tells their fields and number."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from typing import BinaryIO

import numpy as np

from station.errors import ScanError
from station.readers.formats.point_tables import Table
from station.readers.formats.point_text import parse_rows

MAX_LINE = 4096  # bytes, of a header or a point
MIN_TEXT_BYTES = 2  # of a number and what separates it from the next


@dataclass(frozen=True)
class Layout:
    """The fields of the points of a file, and where they are."""

    dtype: np.dtype[np.void]
    keys: dict[str, str | None]  # what each field holds, see `point_tables.field_of`
    count: int
    offset: int  # of the first point [bytes]
    is_text: bool

    def __post_init__(self) -> None:
        if not {"x", "y", "z"} <= set(self.keys.values()):
            raise ScanError(f"has no fields x, y and z, but {', '.join(self.keys) or 'none'}")
        if self.count <= 0:
            raise ScanError("contains no points")

    def check_size(self, size: int, *, is_last: bool) -> None:
        """Raise ScanError if a file of `size` bytes cannot hold the points; `is_last` if nothing follows."""
        bytes_each = MIN_TEXT_BYTES * len(self.keys) if self.is_text else self.dtype.itemsize
        needed, available = self.count * bytes_each, size - self.offset
        # the last line of a text may have no end
        if needed > available + self.is_text:
            raise ScanError(
                f"cut off: {self.count:,} points need {needed:,} bytes, the file has {available:,} for them"
            )
        if is_last and not self.is_text and needed < available:
            raise ScanError(f"corrupt: {available - needed:,} bytes more than its {self.count:,} points need")

    def table(self, columns: dict[str, np.ndarray]) -> Table:
        """Return the columns that are needed, by what they hold."""
        table: Table = {}
        for name, key in self.keys.items():
            if key is not None and key not in table:
                table[key] = columns[name]
        return table


def read_header_line(file: BinaryIO) -> str:
    """Return the next line of a header; raise ScanError if there is none that is short enough."""
    line = file.readline(MAX_LINE)
    if not line.endswith(b"\n"):
        raise ScanError("its header is cut off, or not of this format")
    return line.decode("utf-8", "replace").strip()


def record_tables(path: Path, layout: Layout, size: int) -> Iterator[Table]:
    """Yield the points of a file, at most `size` at a time; fewer than stated if it is cut off."""
    if layout.is_text:
        yield from _text_tables(path, layout, size)
        return
    with path.open("rb") as file:
        file.seek(layout.offset)
        for first in range(0, layout.count, size):
            raw = file.read(min(size, layout.count - first) * layout.dtype.itemsize)
            records = np.frombuffer(raw, layout.dtype)
            yield layout.table({name: records[name] for name in layout.keys})


def _text_tables(path: Path, layout: Layout, size: int) -> Iterator[Table]:
    with path.open("rb") as file:
        file.seek(layout.offset)
        raw_lines = (file.readline(MAX_LINE) for _ in range(layout.count))
        lines = (line.decode("utf-8", "replace") for line in takewhile(bool, raw_lines))
        for rows in parse_rows(lines, size):
            if rows.shape[1] != len(layout.keys):
                raise ScanError(f"a line has {rows.shape[1]} of {len(layout.keys)} values")
            yield layout.table(dict(zip(layout.keys, rows.T, strict=True)))
