"""Cloud-optimised point clouds: LAZ files whose points are sorted into an octree.

Source: COPC specification 1.0 (https://copc.io).
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, BinaryIO

import laspy
import lazrs
import numpy as np
from laspy.vlrs.known import LasZipVlr

from station.quantities import Ints

GRID_BITS = 7  # cells of a node along each axis, of which each keeps one point: 128
MAX_BITS = 21  # of each axis in a Morton code of 63 bits
MAX_DEPTH = MAX_BITS - GRID_BITS
LEAF_POINTS = 65_536  # nodes with fewer are not divided
USER_ID, INFO_ID, HIERARCHY_ID = "copc", 1, 1000
INFO = np.dtype(
    [("center", "<f8", 3), ("halfsize", "<f8"), ("spacing", "<f8"), ("hierarchy_offset", "<u8"),
     ("hierarchy_size", "<u8"), ("time_s", "<f8", 2), ("reserved", "<u8", 11)]
)  # fmt: skip
EVLR = np.dtype(
    [("reserved", "<u2"), ("user_id", "S16"), ("record_id", "<u2"), ("size", "<u8"), ("description", "S32")]
)
ENTRY = np.dtype([("key", "<i4", 4), ("offset", "<u8"), ("bytes", "<i4"), ("points", "<i4")])
# Bits of a number 21 bits long are moved three places apart in these steps.
SPREAD = (
    (32, 0x1F00000000FFFF), (16, 0x1F0000FF0000FF), (8, 0x100F00F00F00F00F), (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)  # fmt: skip


@dataclass(frozen=True)
class _Node:
    """A node of the octree: its key (level, x, y, z) and its points."""

    key: tuple[int, int, int, int]
    indices: Ints


def write_copc(file: BinaryIO, header: laspy.LasHeader, records: np.ndarray[Any, Any]) -> None:
    """Write point records (n,) of LAS 1.4, at least one, as an octree to an empty file.

    `header` gives scale, offset, CRS and extra bytes; its extent, counts and VLRs are set. The records may be
    mapped from a file: a node at a time is read.
    """
    coordinates = np.stack([records["X"], records["Y"], records["Z"]])
    low = coordinates.min(axis=1)
    width = max(1, int(np.ptp(coordinates, axis=1).max()))
    _complete_header(header, records, low, coordinates.max(axis=1))
    info = _info(header, records, low, width)
    compression = lazrs.LazVlr.new_for_compression(
        header.point_format.id, header.point_format.num_extra_bytes, use_variable_size_chunks=True
    )
    header.vlrs.insert(0, laspy.VLR(USER_ID, INFO_ID, "COPC info", info.tobytes()))  # must be the first
    header.vlrs.append(LasZipVlr(compression.record_data()))
    header.are_points_compressed = True
    header.write_to(file)
    nodes = list(_octree(_morton_codes(coordinates, low, width)))
    del coordinates
    compressor = lazrs.ParLasZipCompressor(file, compression)
    compressor.reserve_offset_to_chunk_table()
    for node in nodes:
        chunk = np.frombuffer(records[node.indices].tobytes(), np.uint8)
        compressor.compress_chunks([chunk])
    compressor.done()
    hierarchy = _hierarchy(file, header, compression, nodes)
    file.seek(0, io.SEEK_END)
    header.start_of_first_evlr, header.number_of_evlrs = file.tell(), 1
    start = np.zeros((), EVLR)
    start["user_id"], start["record_id"] = USER_ID.encode(), HIERARCHY_ID
    start["size"], start["description"] = hierarchy.nbytes, b"COPC hierarchy"
    file.write(start.tobytes() + hierarchy.tobytes())
    info["hierarchy_offset"] = header.start_of_first_evlr + EVLR.itemsize
    info["hierarchy_size"] = hierarchy.nbytes
    header.vlrs[0].record_data = info.tobytes()
    file.seek(0)
    header.write_to(file, ensure_same_size=True)


def _complete_header(header: laspy.LasHeader, records: np.ndarray[Any, Any], low: Ints, high: Ints) -> None:
    header.mins, header.maxs = (values * header.scales + header.offsets for values in (low, high))
    header.point_count = len(records)
    header.number_of_points_by_return = np.zeros(15, np.int64)
    numbers, counts = np.unique(records["bit_fields"] & 0x0F, return_counts=True)
    header.number_of_points_by_return[numbers.astype(np.int64) - 1] = counts


def _info(
    header: laspy.LasHeader, records: np.ndarray[Any, Any], low: Ints, width: int
) -> np.ndarray[Any, np.dtype[np.void]]:
    """Return the content of the first VLR; its cube is `width` steps of the coordinates wide."""
    halfsize_m = width / 2 * header.scales[0]  # that of all axes
    info = np.zeros((), INFO)
    info["center"] = low * header.scales + header.offsets + halfsize_m
    info["halfsize"] = halfsize_m
    info["spacing"] = 2 * halfsize_m / (1 << GRID_BITS)
    info["time_s"] = records["gps_time"].min(), records["gps_time"].max()
    return info


def _morton_codes(coordinates: Ints, low: Ints, width: int) -> Ints:
    """Return the interleaved bits of the coordinates (3, n) in the cube as codes (n,)."""
    code = np.zeros(coordinates.shape[1], np.int64)
    for axis, (values, lowest) in enumerate(zip(coordinates, low, strict=True)):
        position = (values.astype(np.float64) - lowest) * ((1 << MAX_BITS) / width)
        spread = np.minimum(position.astype(np.int64), (1 << MAX_BITS) - 1)
        for shift, mask in SPREAD:
            spread = (spread | (spread << shift)) & mask
        code |= spread << axis
    return code


def _octree(codes: Ints) -> Iterator[_Node]:
    """Yield the nodes, parents first; each keeps one point of each of its cells, and leaves all."""
    order = np.argsort(codes)
    codes = codes[order]
    for level in range(MAX_DEPTH + 1):
        if not len(codes):
            return
        node_of, starts, counts = _runs(codes >> 3 * (MAX_BITS - level))
        is_leaf = (counts <= LEAF_POINTS) | (level == MAX_DEPTH)
        kept = np.zeros(len(codes), bool)
        kept[_runs(codes >> 3 * (MAX_BITS - level - GRID_BITS))[1]] = True
        kept |= np.repeat(is_leaf, counts)
        for node, first, count in zip(node_of.tolist(), starts.tolist(), counts.tolist(), strict=True):
            part = slice(first, first + count)
            x, y, z = (sum((node >> 3 * bit + axis & 1) << bit for bit in range(level)) for axis in range(3))
            yield _Node((level, x, y, z), np.sort(order[part][kept[part]]))
        order, codes = order[~kept], codes[~kept]


def _runs(values: Ints) -> tuple[Ints, Ints, Ints]:
    """Return the value, the start and the length of each run of equal values."""
    starts = np.flatnonzero(np.diff(values, prepend=values[0] - 1))
    return values[starts], starts, np.diff(starts, append=len(values))


def _hierarchy(
    file: BinaryIO, header: laspy.LasHeader, compression: lazrs.LazVlr, nodes: list[_Node]
) -> np.ndarray[Any, np.dtype[np.void]]:
    """Return where each node is in the file."""
    file.seek(header.offset_to_point_data)
    chunks = np.array(lazrs.read_chunk_table(file, compression), dtype=np.int64)
    entries = np.zeros(len(nodes), ENTRY)
    entries["key"] = [node.key for node in nodes]
    entries["points"], entries["bytes"] = chunks.T
    first = header.offset_to_point_data + 8  # behind the offset of the table of chunks
    entries["offset"] = first + np.concatenate([[0], np.cumsum(chunks[:-1, 1])])
    return entries
