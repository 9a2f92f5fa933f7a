"""Check a LAS/LAZ file by its own numbers before any decoder touches it.

Decoders hang, abort or take gigabytes on headers that contradict the file, or read silently short. Nothing
here reads more than headers and the chunk table.
Source: LAS 1.4 R15 (ASPRS, 2019); LASzip 3.4 for the chunk table and the layers of a chunk.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO

import lazrs
import numpy as np

from station.errors import ScanError
from station.quantities import Floats, Ints
from station.readers.scan import foreign_code

HEADER = struct.Struct("<4sHH16sBB32s32sHHHIIBHI5I12d")  # 227 bytes, all versions
HEADER_1_4 = struct.Struct("<QQIQ15Q")  # follows in 1.4
HEADER_BYTES = {0: 227, 1: 227, 2: 227, 3: 235, 4: 375}  # by minor version
POINT_BYTES = (20, 28, 26, 34, 57, 63, 30, 36, 38, 59, 67)  # by point format
TIMED = {1, 3, 4, 5, 6, 7, 8, 9, 10}  # point formats with gps_time
WAVES = {4, 5, 9, 10}  # point formats with waveforms
VLR_BYTES = 54  # of the head of a variable length record
MOST_VLRS = 10_000  # 390 is the most met in the wild
MOST_RECORD_BYTES = 4096
MOST_CHUNK_BYTES = 1 << 28  # unpacked; the usual 50,000 points of 67 bytes take 3.4 MB
MOST_METRES = 1e9
LASZIP = struct.Struct("<HHBBHIIqqH")
VARIABLE_CHUNKS = 2**32 - 1
CHUNKED, LAYERED = 2, 3  # ways to compress; 1 is LASzip's first, without chunks
LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}  # by item type: Point14, RGB14, RGBNIR14, Wavepacket14
BYTE14 = 14  # item type with one layer a byte


@dataclass(frozen=True)
class Layout:
    """What the points of a LAS/LAZ file must amount to, and where and how a decoder can enter."""

    point_format: int
    record_bytes: int
    count: int
    points_at: int  # byte
    scale: Floats  # (3,)
    offset: Floats  # (3,)
    low_m: Floats  # (3,)
    high_m: Floats  # (3,)
    standard_time: bool
    software: str
    laszip: bytes | None  # the record that tells how the points are compressed; None: they are not
    chunks: int  # nought where not compressed
    chunk_firsts: bytes  # the first point of each, which stands there as it is
    even_chunks: bool  # all of one length but the last

    @property
    def has_time(self) -> bool:
        """Whether the point format has a field for the time."""
        return self.point_format in TIMED

    @property
    def record(self) -> np.dtype[np.void]:
        """Where in a point its whole numbers X, Y, Z, its intensity and its gps_time stand."""
        names, kinds, places = ["X", "Y", "Z", "intensity"], ["<i4"] * 3 + ["<u2"], [0, 4, 8, 12]
        if self.has_time:
            names, kinds = [*names, "gps_time"], [*kinds, "<f8"]
            places = [*places, 22 if self.point_format >= 6 else 20]
        return np.dtype({"names": names, "formats": kinds, "offsets": places, "itemsize": self.record_bytes})


@dataclass(frozen=True)
class _Header:
    """The fields that lead to the points, as they stand in the file."""

    flags: int
    minor: int
    software: str
    header_bytes: int
    points_at: int
    vlrs: int
    point_format: int
    compressed: bool
    record_bytes: int
    count: int
    returns: tuple[int, ...]
    box: tuple[float, ...]  # 3 scales, 3 offsets, then max and min of x, of y, of z
    points_end: int  # as far as the header tells


@dataclass(frozen=True)
class _LasZip:
    """The record that tells how the points are compressed."""

    record: bytes
    layers: int  # 0: the chunks are not layered
    chunk_points: int


def read_layout(file: BinaryIO, size: int) -> Layout:
    """Check the headers of a LAS/LAZ file of `size` bytes, open at its start; ScanError says what is off."""
    header = _read_header(file, size)
    _check_sizes(header, size)
    scale, offset, low_m, high_m = _check_numbers(header.box)
    laszip = _find_laszip(file, header)
    if not header.compressed:
        _check_room(header)
        record, chunk_firsts = None, b""
    elif laszip is None:
        raise ScanError("compressed, but the record that says how (LASzip VLR) is missing")
    else:
        record, chunk_firsts = laszip.record, _check_chunks(file, header, laszip)
    return Layout(
        point_format=header.point_format,
        record_bytes=header.record_bytes,
        count=header.count,
        points_at=header.points_at,
        scale=scale,
        offset=offset,
        low_m=low_m,
        high_m=high_m,
        standard_time=bool(header.flags & 1),
        software=header.software,
        laszip=record,
        chunks=len(chunk_firsts) // header.record_bytes,
        chunk_firsts=chunk_firsts,
        even_chunks=laszip is not None and laszip.chunk_points != VARIABLE_CHUNKS,
    )


def _read_header(file: BinaryIO, size: int) -> _Header:
    start = file.read(HEADER.size + HEADER_1_4.size)
    if start[:4] != b"LASF":
        raise ScanError("not a LAS or LAZ file: it does not begin with LASF" if size else "the file is empty")
    if len(start) < HEADER.size:
        raise ScanError(f"cut off inside its header, after {size} bytes")
    (_, _, flags, _, major, minor, _, software, _, _, header_bytes, points_at, vlrs, kind, record_bytes,
     count, *rest) = HEADER.unpack_from(start)  # fmt: skip
    returns = rest[:5]
    if major != 1 or minor not in HEADER_BYTES:
        raise ScanError(f"LAS version {major}.{minor} is not known: 1.0 to 1.4 are")
    if size < HEADER_BYTES[minor]:
        raise ScanError(f"cut off inside its header, after {size} bytes")
    points_end = size
    if minor >= 3 and kind & 0x3F in WAVES:
        waves_at = struct.unpack_from("<Q", start, HEADER.size)[0]
        points_end = min(points_end, waves_at or size)
    if minor == 4:
        legacy = count
        _, extended_at, extended, count, *returns = HEADER_1_4.unpack_from(start, HEADER.size)
        if legacy not in {0, count}:
            raise ScanError(f"header contradicts itself: {count:,} points, or {legacy:,} in its legacy field")
        points_end = min(points_end, extended_at if extended else size)
    return _Header(
        flags=flags,
        minor=minor,
        software=software.split(b"\0")[0].decode("ascii", "replace").strip(),
        header_bytes=header_bytes,
        points_at=points_at,
        vlrs=vlrs,
        point_format=kind & 0x3F,
        compressed=bool(kind & 0xC0),
        record_bytes=record_bytes,
        count=count,
        returns=tuple(returns),
        box=tuple(rest[5:]),
        points_end=points_end,
    )


def _check_sizes(header: _Header, size: int) -> None:
    if not HEADER_BYTES[header.minor] <= header.header_bytes <= header.points_at:
        raise ScanError(
            f"corrupt header: it is {header.header_bytes:,} bytes by itself,"
            f" and the points start at byte {header.points_at:,}"
        )
    if header.points_at > size:
        raise ScanError(f"cut off: {size:,} bytes, but the points start at byte {header.points_at:,}")
    if header.points_end < header.points_at:
        raise ScanError("corrupt header: records that follow the points start before them")
    known = header.point_format < (len(POINT_BYTES) if header.minor == 4 else 6)
    if not known:
        raise ScanError(f"point format {header.point_format} does not exist in LAS 1.{header.minor}")
    if not POINT_BYTES[header.point_format] <= header.record_bytes <= MOST_RECORD_BYTES:
        raise ScanError(
            f"corrupt header: {header.record_bytes} bytes a point in point format {header.point_format}"
        )
    if header.count == 0:
        raise ScanError("holds no points: still being written, or an empty scan")
    by_return = sum(header.returns)
    if by_return > header.count:
        raise ScanError(f"header contradicts itself: {header.count:,} points, {by_return:,} by their returns")


def _check_numbers(box: tuple[float, ...]) -> tuple[Floats, Floats, Floats, Floats]:
    """Return scale, offset, low and high corner (3,) each."""
    numbers = np.asarray(box, dtype=np.float64)
    if not np.isfinite(numbers).all():
        raise ScanError("corrupt header: scale, offset or bounding box is not a finite number")
    scale, offset, low_m, high_m = numbers[:3], numbers[3:6], numbers[7::2], numbers[6::2]
    if (scale <= 0).any() or (scale > 1).any():
        raise ScanError(f"corrupt header: scale {scale.tolist()} is not within 0 to 1 m")
    if (np.abs(numbers[3:]) > MOST_METRES).any():
        raise ScanError("corrupt header: offset or bounding box is beyond any map")
    if (low_m > high_m).any():
        raise ScanError("corrupt header: the bounding box ends before it begins")
    return scale, offset, low_m, high_m


def _check_room(header: _Header) -> None:
    """Compare the points counted with the bytes there are for them."""
    room = (header.points_end - header.points_at) // header.record_bytes
    if room < header.count:
        raise ScanError(f"cut off: the header counts {header.count:,} points, the file holds {room:,}")
    if room > header.count:
        raise ScanError(
            f"the header counts {header.count:,} points, the file holds {room:,}:"
            " still being written, or its writer did not finish"
        )


def _find_laszip(file: BinaryIO, header: _Header) -> _LasZip | None:
    """Walk the variable length records, which must fit before the points."""
    place = header.header_bytes
    if header.vlrs > min(MOST_VLRS, (header.points_at - place) // VLR_BYTES):
        raise ScanError(f"corrupt header: no room for {header.vlrs:,} variable length records")
    found = None
    for number in range(header.vlrs):
        file.seek(place)
        head = file.read(VLR_BYTES)
        user, kind, length = struct.unpack_from("<2x16sHH", head) if len(head) == VLR_BYTES else (b"", 0, 0)
        place += VLR_BYTES + length
        if place > header.points_at:
            raise ScanError(
                f"corrupt header: variable length record {number + 1} of {header.vlrs} runs into the points"
            )
        if user.rstrip(b"\0") == b"laszip encoded" and kind == 22204:
            found = _read_laszip(file.read(length), header.record_bytes)
    return found


def _read_laszip(record: bytes, record_bytes: int) -> _LasZip:
    if len(record) < LASZIP.size:
        raise ScanError("corrupt LASzip record: cut short")
    compressor, _, major, minor, *_, chunk_points, _, _, items = LASZIP.unpack_from(record)
    if compressor not in {CHUNKED, LAYERED}:
        raise ScanError(
            f"compressed by LASzip {major}.{minor} in a way without chunks that cannot be read (kind"
            f" {compressor}): rewrite it with a newer LASzip, or deliver LAS"
        )
    if len(record) != LASZIP.size + 6 * items:
        raise ScanError("corrupt LASzip record: its length does not fit its items")
    kinds = [struct.unpack_from("<HHH", record, LASZIP.size + 6 * item)[:2] for item in range(items)]
    if sum(size for _, size in kinds) != record_bytes:
        raise ScanError("corrupt LASzip record: its items do not add up to a point")
    fixed = chunk_points != VARIABLE_CHUNKS
    if chunk_points == 0 or (fixed and chunk_points * record_bytes > MOST_CHUNK_BYTES):
        raise ScanError(f"corrupt LASzip record: chunks of {chunk_points:,} points")
    layers = sum(size if kind == BYTE14 else LAYERS.get(kind, 0) for kind, size in kinds)
    return _LasZip(record, layers if compressor == LAYERED else 0, chunk_points)


def _check_chunks(file: BinaryIO, header: _Header, laszip: _LasZip) -> bytes:
    """Return the first point of each chunk, once all chunks fit count and file."""
    first_at = header.points_at + 8
    file.seek(header.points_at)
    table_at = struct.unpack("<q", file.read(8))[0] if first_at <= header.points_end else -1
    if table_at == -1:
        raise ScanError("no chunk table yet: still being written, or its writer did not finish")
    if not first_at < table_at <= header.points_end - 8:
        raise ScanError(f"cut off or corrupt: its chunk table should start at byte {table_at:,}")
    file.seek(table_at)
    version, chunks = struct.unpack("<II", file.read(8))
    fixed = laszip.chunk_points != VARIABLE_CHUNKS
    expected = math.ceil(header.count / laszip.chunk_points) if fixed else chunks
    fits = 0 < chunks <= (table_at - first_at) // header.record_bytes  # a chunk starts with a whole point
    if version != 0 or chunks != expected or not fits:
        raise ScanError(
            f"the header counts {header.count:,} points, which is not what {chunks:,} chunks hold:"
            " corrupt, or its writer did not finish"
        )
    file.seek(header.points_at)
    with foreign_code("corrupt chunk table"):
        table = lazrs.read_chunk_table(file, lazrs.LazVlr(laszip.record))
    told = [row for row in table if any(row)]  # writers of variable chunks may close with an empty one
    points, sizes = np.asarray(told, dtype=np.uint64).astype(np.int64).reshape(-1, 2).T
    if fixed:
        points[-1:] = header.count - (chunks - 1) * laszip.chunk_points
    whole = sizes >= header.record_bytes
    if points.sum() != header.count or sizes.sum() != table_at - first_at or not whole.all():
        raise ScanError("corrupt chunk table: its chunks do not add up to the points and bytes there are")
    if points.min() <= 0 or points.max() * header.record_bytes > MOST_CHUNK_BYTES:
        raise ScanError(f"corrupt chunk table: a chunk of {points.max():,} points")
    return b"".join(_first_points(file, first_at, points, sizes, header.record_bytes, laszip.layers))


def _first_points(
    file: BinaryIO, first_at: int, points: Ints, sizes: Ints, record_bytes: int, layers: int
) -> Iterator[bytes]:
    """Give the first point of each chunk; layered ones hold the points they should, in layers that add up.

    Decoders allocate what a layer says it takes, up to 4 GB each.
    """
    place = first_at
    head = struct.Struct(f"<{1 + layers}I")
    for number, (count, size) in enumerate(zip(points.tolist(), sizes.tolist(), strict=True)):
        file.seek(place)
        yield file.read(record_bytes)
        if layers:
            told = file.read(head.size)
            counted, *lengths = head.unpack(told) if len(told) == head.size else (0,)
            if counted != count or record_bytes + head.size + sum(lengths) != size:
                raise ScanError(
                    f"corrupt in chunk {number + 1} of {len(points)}: {counted:,} points where"
                    f" {count:,} belong, or layers that do not add up"
                )
        place += size
