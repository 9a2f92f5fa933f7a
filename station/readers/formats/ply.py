"""Scans in the Stanford polygon format (PLY): text and binary, vertices first.

Source: Turk (1994), The PLY polygon file format.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import BinaryIO, ClassVar

import numpy as np

from station.errors import ScanError
from station.readers.formats.point_records import Layout, read_header_line, record_tables
from station.readers.formats.point_tables import Contents, Table, TableScan, field_of

TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8", "int64": "i8", "uint64": "u8", "long": "i8", "ulong": "u8",
}  # fmt: skip
BYTE_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
MAX_HEADER_LINES = 500


class PlyScan(TableScan):
    """A PLY file whose vertices are the echoes (see `ScanReader`)."""

    suffixes: ClassVar[tuple[str, ...]] = (".ply",)

    def _open(self) -> Contents:
        with self.path.open("rb") as file:
            self._layout = _read_layout(file)
            self._layout.check_size(file.seek(0, 2), is_last=False)
        return Contents(self._layout.count)

    def _tables(self, size: int) -> Iterator[Table]:
        return record_tables(self.path, self._layout, size)


def _read_layout(file: BinaryIO) -> Layout:
    """Return the layout of the vertices, with the file at their first one."""
    lines = _header_lines(file)
    encodings = [words[1] for words in lines if words[0] == "format" and len(words) > 1]
    if not encodings or encodings[0] not in BYTE_ORDERS:
        raise ScanError("its header states no format that is known")
    starts = [index for index, words in enumerate(lines) if words[0] == "element"]
    if not starts or lines[starts[0]][1:2] != ["vertex"]:
        raise ScanError("its vertices do not come first: write them before any other element")
    end = starts[1] if len(starts) > 1 else len(lines)
    order, fields = BYTE_ORDERS[encodings[0]], []
    for words in lines[starts[0] + 1 : end]:
        if words[0] == "property":
            if words[1] not in TYPES:
                raise ScanError(f"a vertex has a property {' '.join(words[1:])}: export single numbers")
            fields.append((words[2], order + TYPES[words[1]]))
    keys = {name: field_of(name) for name, _ in fields}
    return Layout(np.dtype(fields), keys, int(lines[starts[0]][2]), file.tell(), is_text=not order)


def _header_lines(file: BinaryIO) -> list[list[str]]:
    """Return the words of the lines of the header."""
    if read_header_line(file) != "ply":
        raise ScanError("does not begin with ply")
    lines: list[list[str]] = []
    while len(lines) < MAX_HEADER_LINES:
        words = read_header_line(file).split()
        if words == ["end_header"]:
            return lines
        lines += [words] if words else []
    raise ScanError(f"its header has more than {MAX_HEADER_LINES} lines")
