"""The header of a LAS/LAZ file, checked against the file before any decoder touches it.

Decoders hang, abort or allocate gigabytes on headers that contradict the file, or silently read too little.
laspy parses the header once its records are known to fit; only the headers and the chunk table are read.
Source: LAS 1.4 R15 (ASPRS, 2019); LASzip 3.4 for the chunk table and the layers of a chunk.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from typing import BinaryIO, NamedTuple

import lazrs
import numpy as np
from laspy import LasHeader

from station.errors import ScanError
from station.quantities import Ints
from station.readers.formats.point_inclination import AXES, tilt_field
from station.readers.scan import decoder_errors

FIXED = struct.Struct("<24xBB68xHIIBHI")  # the fields of _Start
HEADER_BYTES = {0: 227, 1: 227, 2: 227, 3: 235, 4: 375}  # by minor version
POINT_BYTES = (20, 28, 26, 34, 57, 63, 30, 36, 38, 59, 67)  # by point format
VLR = struct.Struct("<2x16sHH32x")  # header of a variable length record: owner, number, length
LASZIP_KEY, EXTRA_BYTES_KEY = (b"laszip encoded", 22204), (b"LASF_Spec", 4)  # owner and number
MAX_VLRS = 10_000  # the largest number met in practice is 390
MAX_RECORD_BYTES = 4096
MAX_POINTS_OFFSET = 1 << 27  # read into memory; 390 records of the largest size take 26 MB
MAX_CHUNK_BYTES = 1 << 28  # uncompressed; the usual 50,000 points of 67 bytes take 3.4 MB
MAX_COORDINATE_M = 1e9
LASZIP = struct.Struct("<HHBBHIIqqH")
VARIABLE_CHUNKS = 2**32 - 1
CHUNKED, LAYERED = 2, 3  # compressors; 1 is the oldest of LASzip, without chunks
LAYERS_BY_ITEM = {10: 9, 11: 1, 12: 2, 13: 1}  # by item type: Point14, RGB14, RGBNIR14, Wavepacket14
BYTE14_ITEM = 14  # item type with one layer per byte
EXTRA_BYTES = np.dtype(  # LAS 1.4 R15, table 24
    {
        "names": ["type", "options", "name", "scale", "offset", "description"],
        "formats": ["u1", "u1", "S32", "<f8", "<f8", "S32"],
        "offsets": [2, 3, 4, 112, 136, 160],
        "itemsize": 192,
    }
)
EXTRA_TYPES = ("u1", "i1", "<u2", "<i2", "<u4", "<i4", "<u8", "<i8", "<f4", "<f8")  # table 25, from 1
SCALED, SHIFTED = 8, 16  # bits of the options: scale and offset are valid


@dataclass(frozen=True)
class ExtraField:
    """A number in the extra bytes of a record; its value is `scale` times the stored one plus `offset`."""

    name: str
    description: str
    position: int  # in the record [bytes]
    dtype: str
    scale: float
    offset: float


@dataclass(frozen=True)
class LasFileHeader:
    """The checked header of a LAS/LAZ file, and how its points are compressed."""

    las: LasHeader
    laszip: bytes | None  # the record that describes the compression; None if there is none
    first_points: bytes  # the first point of each chunk, which is stored uncompressed
    equal_chunks: bool  # all chunks but the last have the same length
    extra_fields: tuple[ExtraField, ...]

    @property
    def record_dtype(self) -> np.dtype[np.void]:
        """The dtype of a point record: X, Y, Z, intensity and gps_time, if it has one, among others."""
        dtype: np.dtype[np.void] = self.las.point_format.dtype()
        return dtype

    @property
    def has_time(self) -> bool:
        """True if the point format has a time field."""
        return "gps_time" in (self.record_dtype.names or ())

    @property
    def reflectance(self) -> ExtraField | None:
        """The extra bytes called Reflectance, if any."""
        return next((field for field in self.extra_fields if field.name.lower() == "reflectance"), None)

    @property
    def tilt(self) -> tuple[tuple[ExtraField, float], ...] | None:
        """The extra bytes that hold roll and pitch of the scanner, with factors to radians; None without."""
        found: dict[str, tuple[ExtraField, float]] = {}
        for field in self.extra_fields:
            if (known := tilt_field(field.name, field.description)) is not None:
                found.setdefault(known[0], (field, known[1]))
        return tuple(found[axis] for axis in AXES) if set(AXES) <= found.keys() else None

    def only(self, dtype: str, position: int) -> np.dtype[np.void]:
        """Return the dtype of a record with one field `value`, which is at a position [bytes]."""
        size = self.record_dtype.itemsize
        return np.dtype({"names": ["value"], "formats": [dtype], "offsets": [position], "itemsize": size})


class _Start(NamedTuple):
    """The fields of the header, in all versions, that locate records and points."""

    major: int
    minor: int
    header_bytes: int
    points_offset: int
    vlr_count: int
    format_byte: int
    record_bytes: int
    point_count: int  # may be 0 in version 1.4


class _Record(NamedTuple):
    """A variable length record: its owner and number, and where it begins and ends [bytes]."""

    owner: bytes
    number: int
    first: int
    end: int

    @property
    def key(self) -> tuple[bytes, int]:
        """Owner and number, which together tell what the record holds."""
        return self.owner, self.number

    def content(self, raw: bytearray) -> bytes:
        """Return what follows the header of the record."""
        return bytes(raw[self.first + VLR.size : self.end])


@dataclass(frozen=True)
class _LasZip:
    """The record that describes the compression."""

    record: bytes
    layers: int  # 0: the chunks are not layered
    chunk_points: int


def read_header(file: BinaryIO, size: int) -> LasFileHeader:
    """Return the checked header of a LAS/LAZ file of `size` bytes, open at its start.

    Raises ScanError if it contradicts itself or the file.
    """
    start = _check_start(file.read(HEADER_BYTES[4]), size)
    file.seek(0)
    raw = bytearray(file.read(start.points_offset))
    records = _variable_length_records(raw, start)
    laszip, extra_fields = _find_laszip(raw, start, records), tuple(_extra_fields(raw, start, records))
    _erase_owners(raw, records)
    with decoder_errors("corrupt header"):
        las = LasHeader.read_from(BytesIO(raw))
    if start.point_count not in {0, las.point_count}:
        raise ScanError(
            f"header contradicts itself: {las.point_count:,} points,"
            f" or {start.point_count:,} in its legacy field"
        )
    _check_values(las)
    points_end = _points_end(las, size)
    if not start.format_byte & 0xC0:
        _check_point_count(las, points_end)
        return LasFileHeader(las, None, b"", equal_chunks=False, extra_fields=extra_fields)
    if laszip is None:
        raise ScanError("compressed, but the record that says how (LASzip VLR) is missing")
    first_points = _check_chunks(file, las, laszip, points_end)
    equal_chunks = laszip.chunk_points != VARIABLE_CHUNKS
    return LasFileHeader(las, laszip.record, first_points, equal_chunks, extra_fields)


def _check_start(raw: bytes, size: int) -> _Start:
    """Return the fields that locate records and points, after checking them against the size of the file."""
    if raw[:4] != b"LASF":
        raise ScanError("not a LAS or LAZ file: it does not begin with LASF" if size else "the file is empty")
    if len(raw) < HEADER_BYTES[0]:
        raise ScanError(f"cut off inside its header, after {size} bytes")
    start = _Start(*FIXED.unpack_from(raw))
    if start.major != 1 or start.minor not in HEADER_BYTES:
        raise ScanError(f"LAS version {start.major}.{start.minor} is not known: 1.0 to 1.4 are")
    if size < HEADER_BYTES[start.minor]:
        raise ScanError(f"cut off inside its header, after {size} bytes")
    if not HEADER_BYTES[start.minor] <= start.header_bytes <= start.points_offset:
        raise ScanError(
            f"corrupt header: it is {start.header_bytes:,} bytes by itself,"
            f" and the points start at byte {start.points_offset:,}"
        )
    if start.points_offset > size:
        raise ScanError(f"cut off: {size:,} bytes, but the points start at byte {start.points_offset:,}")
    if start.points_offset > MAX_POINTS_OFFSET:
        raise ScanError(f"corrupt header: {start.points_offset:,} bytes before the points")
    point_format = start.format_byte & 0x3F
    if point_format >= (len(POINT_BYTES) if start.minor == 4 else 6):
        raise ScanError(f"point format {point_format} does not exist in LAS 1.{start.minor}")
    if not POINT_BYTES[point_format] <= start.record_bytes <= MAX_RECORD_BYTES:
        raise ScanError(f"corrupt header: {start.record_bytes} bytes a point in point format {point_format}")
    return start


def _variable_length_records(raw: bytearray, start: _Start) -> list[_Record]:
    """Return the variable length records, all of which must end before the points."""
    position = start.header_bytes
    if start.vlr_count > min(MAX_VLRS, (len(raw) - position) // VLR.size):
        raise ScanError(f"corrupt header: no room for {start.vlr_count:,} variable length records")
    records = []
    for index in range(start.vlr_count):
        first = position
        fits = first + VLR.size <= len(raw)
        owner, number, length = VLR.unpack_from(raw, first) if fits else (b"", 0, 0)
        position = first + VLR.size + length
        if position > len(raw):
            raise ScanError(
                f"corrupt header: variable length record {index + 1} of {start.vlr_count}"
                " runs into the points"
            )
        records.append(_Record(owner.rstrip(b"\0"), number, first, position))
    return records


def _erase_owners(raw: bytearray, records: list[_Record]) -> None:
    """Erase the owners of records that laspy need not know: it rejects a file for one invalid character."""
    for record in records:
        if record.key != LASZIP_KEY and record.owner != b"LASF_Projection":
            raw[record.first + 2 : record.first + 18] = bytes(16)


def _find_laszip(raw: bytearray, start: _Start, records: list[_Record]) -> _LasZip | None:
    """Return the last LASzip record; None if there is none."""
    content = [record.content(raw) for record in records if record.key == LASZIP_KEY]
    return _parse_laszip(content[-1], start.record_bytes) if content else None


def _extra_fields(raw: bytearray, start: _Start, records: list[_Record]) -> Iterator[ExtraField]:
    """Yield the extra bytes that hold one number each."""
    content = b"".join(record.content(raw) for record in records if record.key == EXTRA_BYTES_KEY)
    position = POINT_BYTES[start.format_byte & 0x3F]
    for row in np.frombuffer(content, EXTRA_BYTES, len(content) // EXTRA_BYTES.itemsize):
        kind, options = int(row["type"]), int(row["options"])
        if kind > 3 * len(EXTRA_TYPES):  # of unknown size: what follows cannot be located
            return
        values, index = divmod(kind - 1, len(EXTRA_TYPES))  # deprecated types have two or three values
        size = np.dtype(EXTRA_TYPES[index]).itemsize * (values + 1) if kind else options
        scale = float(row["scale"]) if options & SCALED else 1.0
        offset = float(row["offset"]) if options & SHIFTED else 0.0
        is_number = 1 <= kind <= len(EXTRA_TYPES) and np.isfinite([scale, offset]).all() and scale
        is_inside = position + size <= start.record_bytes
        if is_number and is_inside:
            name, description = (row[key].decode("latin-1").strip() for key in ("name", "description"))
            yield ExtraField(name, description, position, EXTRA_TYPES[index], scale, offset)
        position += size


def _parse_laszip(record: bytes, record_bytes: int) -> _LasZip:
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
    kinds = [struct.unpack_from("<HH", record, LASZIP.size + 6 * item) for item in range(items)]
    if sum(size for _, size in kinds) != record_bytes:
        raise ScanError("corrupt LASzip record: its items do not add up to a point")
    fixed = chunk_points != VARIABLE_CHUNKS
    if chunk_points == 0 or (fixed and chunk_points * record_bytes > MAX_CHUNK_BYTES):
        raise ScanError(f"corrupt LASzip record: chunks of {chunk_points:,} points")
    layers = sum(size if kind == BYTE14_ITEM else LAYERS_BY_ITEM.get(kind, 0) for kind, size in kinds)
    return _LasZip(record, layers if compressor == LAYERED else 0, chunk_points)


def _check_values(las: LasHeader) -> None:
    """Check point counts, scale, offset and bounding box."""
    by_return = sum(las.number_of_points_by_return.tolist())
    if las.point_count == 0:
        raise ScanError("holds no points: still being written, or an empty scan")
    if by_return > las.point_count:
        raise ScanError(
            f"header contradicts itself: {las.point_count:,} points, {by_return:,} by their returns"
        )
    lengths_m = np.concatenate([las.offsets, las.mins, las.maxs])
    if not np.isfinite([*las.scales, *lengths_m]).all():
        raise ScanError("corrupt header: scale, offset or bounding box is not a finite number")
    if (las.scales <= 0).any() or (las.scales > 1).any():
        raise ScanError(f"corrupt header: scale {las.scales.tolist()} is not within 0 to 1 m")
    if (np.abs(lengths_m) > MAX_COORDINATE_M).any():
        raise ScanError("corrupt header: offset or bounding box is beyond any map")
    if (las.mins > las.maxs).any():
        raise ScanError("corrupt header: the bounding box ends before it begins")


def _points_end(las: LasHeader, size: int) -> int:
    """Return the first byte after the points [bytes]: the records that may follow, or the end of the file."""
    following = [size]
    if las.point_format.has_waveform_packet and las.start_of_waveform_data_packet_record:
        following.append(las.start_of_waveform_data_packet_record)
    if las.number_of_evlrs:
        following.append(las.start_of_first_evlr)
    if min(following) < las.offset_to_point_data:
        raise ScanError("corrupt header: records that follow the points start before them")
    return min(following)


def _check_point_count(las: LasHeader, points_end: int) -> None:
    """Check the point count against the bytes available for the points."""
    capacity = (points_end - las.offset_to_point_data) // las.point_format.size
    if capacity < las.point_count:
        raise ScanError(f"cut off: the header counts {las.point_count:,} points, the file holds {capacity:,}")
    if capacity > las.point_count:
        raise ScanError(
            f"the header counts {las.point_count:,} points, the file holds {capacity:,}:"
            " still being written, or its writer did not finish"
        )


def _check_chunks(file: BinaryIO, las: LasHeader, laszip: _LasZip, points_end: int) -> bytes:
    """Return the first point of each chunk, after checking the chunks against point count and file size."""
    first_chunk_offset = las.offset_to_point_data + 8
    file.seek(las.offset_to_point_data)
    table_offset = struct.unpack("<q", file.read(8))[0] if first_chunk_offset <= points_end else -1
    if table_offset == -1:
        raise ScanError("no chunk table yet: still being written, or its writer did not finish")
    if not first_chunk_offset < table_offset <= points_end - 8:
        raise ScanError(f"cut off or corrupt: its chunk table should start at byte {table_offset:,}")
    file.seek(table_offset)
    version, chunk_count = struct.unpack("<II", file.read(8))
    fixed = laszip.chunk_points != VARIABLE_CHUNKS
    expected = math.ceil(las.point_count / laszip.chunk_points) if fixed else chunk_count
    record_bytes = las.point_format.size
    # each chunk starts with a complete point
    fits = 0 < chunk_count <= (table_offset - first_chunk_offset) // record_bytes
    if version != 0 or chunk_count != expected or not fits:
        raise ScanError(
            f"the header counts {las.point_count:,} points, which is not what {chunk_count:,} chunks hold:"
            " corrupt, or its writer did not finish"
        )
    file.seek(las.offset_to_point_data)
    with decoder_errors("corrupt chunk table"):
        table = lazrs.read_chunk_table(file, lazrs.LazVlr(laszip.record))
    entries = [row for row in table if any(row)]  # writers of variable chunks may end with an empty one
    points, sizes = np.asarray(entries, dtype=np.uint64).astype(np.int64).reshape(-1, 2).T
    if fixed:
        points[-1:] = las.point_count - (chunk_count - 1) * laszip.chunk_points
    if (
        points.sum() != las.point_count
        or sizes.sum() != table_offset - first_chunk_offset
        or (sizes < record_bytes).any()
    ):
        raise ScanError("corrupt chunk table: its chunks do not add up to the points and bytes there are")
    if points.min() <= 0 or points.max() * record_bytes > MAX_CHUNK_BYTES:
        raise ScanError(f"corrupt chunk table: a chunk of {points.max():,} points")
    return _read_first_points(file, first_chunk_offset, points, sizes, record_bytes, laszip.layers)


def _read_first_points(
    file: BinaryIO, position: int, points: Ints, sizes: Ints, record_bytes: int, layers: int
) -> bytes:
    """Return the first point of each chunk; check the point counts and layer sizes of layered chunks.

    Decoders allocate the size that a layer states, up to 4 GB each.
    """
    first_points = []
    layer_struct = struct.Struct(f"<{1 + layers}I")
    for index, (count, size) in enumerate(zip(points.tolist(), sizes.tolist(), strict=True)):
        file.seek(position)
        first_points.append(file.read(record_bytes))
        raw = file.read(layer_struct.size) if layers else b""
        stored_count, *lengths = layer_struct.unpack(raw) if len(raw) == layer_struct.size else (0,)
        if layers and (stored_count != count or record_bytes + layer_struct.size + sum(lengths) != size):
            raise ScanError(
                f"corrupt in chunk {index + 1} of {len(points)}: {stored_count:,} points where"
                f" {count:,} belong, or layers that do not add up"
            )
        position += size
    return b"".join(first_points)
