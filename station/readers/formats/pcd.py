"""Scans in the point cloud data format (PCD): text, binary, and compressed with the extra `pcd`.

Source: Point Cloud Library, The PCD file format, version 0.7.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import BinaryIO, ClassVar

import numpy as np

from station.errors import ScanError
from station.readers.formats.point_records import Layout, read_header_line, record_tables
from station.readers.formats.point_tables import Contents, Table, TableScan, field_of

KINDS = {"I": "i", "U": "u", "F": "f"}
MAX_HEADER_LINES = 100
MAX_EXPANSION = 100  # of LZF, which copies at most 264 bytes by three
SIZES = struct.Struct("<II")  # of the compressed data: compressed, uncompressed [bytes]


class PcdScan(TableScan):
    """A PCD file (see `ScanReader`); points that are NaN have no echo."""

    suffixes: ClassVar[tuple[str, ...]] = (".pcd",)

    def _open(self) -> Contents:
        with self.path.open("rb") as file:
            self._layout, self._is_compressed = _read_layout(file)
            size = file.seek(0, 2)
        if self._is_compressed:
            self._read_sizes(size)
        else:
            self._layout.check_size(size, is_last=False)
        return Contents(self._layout.count)

    def _tables(self, size: int) -> Iterator[Table]:
        return (
            self._decompressed(size) if self._is_compressed else record_tables(self.path, self._layout, size)
        )

    def _read_sizes(self, file_size: int) -> int:
        """Return the compressed size [bytes]; raise ScanError if the sizes contradict header or file."""
        expected = self._layout.count * self._layout.dtype.itemsize
        with self.path.open("rb") as file:
            file.seek(self._layout.offset)
            raw = file.read(SIZES.size)
        if len(raw) < SIZES.size:
            raise ScanError("cut off before its points")
        compressed: int
        uncompressed: int
        compressed, uncompressed = SIZES.unpack(raw)
        if uncompressed != expected:
            raise ScanError(
                f"corrupt: {self._layout.count:,} points need {expected:,} bytes, it states {uncompressed:,}"
            )
        if uncompressed > MAX_EXPANSION * compressed:
            raise ScanError(f"corrupt: {compressed:,} bytes cannot hold {uncompressed:,} bytes of points")
        if compressed > file_size - self._layout.offset - SIZES.size:
            raise ScanError(f"cut off: {compressed:,} bytes of compressed points are not there")
        return compressed

    def _decompressed(self, size: int) -> Iterator[Table]:
        """Yield the points; decompressed they lie in memory field by field."""
        try:
            import lzf  # noqa: PLC0415 - an extra
        except ImportError as error:
            raise ScanError("compressed PCD needs a library: pip install 'tls-station[pcd]'") from error
        layout = self._layout
        with self.path.open("rb") as file:
            file.seek(layout.offset + SIZES.size)
            compressed = file.read(self._read_sizes(self.path.stat().st_size))
        raw = lzf.decompress(compressed, layout.count * layout.dtype.itemsize)
        if raw is None or len(raw) != layout.count * layout.dtype.itemsize:
            raise ScanError("corrupt: its compressed points are not as long as stated")
        columns, offset = {}, 0
        for name in layout.keys:
            dtype = layout.dtype[name]
            columns[name] = np.frombuffer(raw, dtype, layout.count, offset)
            offset += layout.count * dtype.itemsize
        for first in range(0, layout.count, size):
            yield layout.table({name: column[first : first + size] for name, column in columns.items()})


def _read_layout(file: BinaryIO) -> tuple[Layout, bool]:
    """Return the layout of the points, and whether they are compressed; the file is at the first one."""
    header: dict[str, list[str]] = {}
    for _ in range(MAX_HEADER_LINES):
        key, *values = read_header_line(file).split() or [""]
        if not key.startswith("#"):
            header[key.upper()] = values
        if key.upper() == "DATA":
            break
    missing = [key for key in ("FIELDS", "SIZE", "TYPE", "POINTS", "DATA") if not header.get(key)]
    if missing:
        raise ScanError(f"its header lacks {', '.join(missing)}")
    encoding = header["DATA"][0].lower()
    if encoding not in {"ascii", "binary", "binary_compressed"}:
        raise ScanError(f"DATA {encoding} is unknown")
    names, fields = _unique(header["FIELDS"]), []
    counts = header.get("COUNT") or ["1"] * len(names)
    for name, size, kind, count in zip(names, header["SIZE"], header["TYPE"], counts, strict=True):
        if count != "1":
            raise ScanError(f"field {name} has {count} values a point: export fields of one value")
        fields.append((name, f"<{KINDS[kind.upper()]}{int(size)}"))
    keys = {name: field_of(name) for name in names}
    layout = Layout(
        np.dtype(fields), keys, int(header["POINTS"][0]), file.tell(), is_text=encoding == "ascii"
    )
    return layout, encoding == "binary_compressed"


def _unique(names: list[str]) -> list[str]:
    """Return the names of fields with a number after those of padding, which are all `_`."""
    return [name if names.count(name) == 1 else f"{name}{index}" for index, name in enumerate(names)]
