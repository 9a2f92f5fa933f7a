"""LAS and LAZ scans: 1.0 to 1.4, all point formats.

lazrs decodes, laspy tells the coordinate system. Points are not read through laspy, for it refuses a scan
over any odd letter in a record that nobody needs.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cached_property, partial
from io import BufferedReader
from pathlib import Path
from typing import BinaryIO, ClassVar, Self

import lazrs
import numpy as np
from laspy import DecompressionSelection, LasHeader
from numpy.typing import NDArray

from station.errors import NotReadyError, ScanError
from station.quantities import Floats, HeadTrack, Shots
from station.readers.ahead import Room, filled
from station.readers.las_layout import Layout, read_layout
from station.readers.scan import WEEK_S, ScanHeader, foreign_code

NEEDED = DecompressionSelection.base().decompress_z().decompress_gps_time()  # heeded in formats 6 and up
BRIGHT = NEEDED.decompress_intensity()
BLOCKS_AT_ONCE = 8  # decoded together, some chunks a core; conversion still goes block by block, in the cache
LONGEST_SCAN_S = 86_400.0
PLACES = 200  # where a scan is looked at that has no chunks, or few
SKIP = 50_000  # points decoded at a time only to pass them
BRIGHTEST = 1 / 65535  # intensity is of 16 bits: LAS 1.4 R15, table 7
FEW_CHUNKS = 20  # with fewer, chunk starts are too far apart to follow the head

Records = NDArray[np.void]


class LasScan:
    """A LAS/LAZ file whose headers agree with each other and with its size (see `ScanReader`).

    Holds no open file between calls; a file that is replaced meanwhile gives NotReadyError.
    """

    suffixes: ClassVar[tuple[str, ...]] = (".las", ".laz")

    def __init__(self, path: Path, *, range_max_m: float | None = None) -> None:
        self.path = path
        self._range_max_m = range_max_m
        with foreign_code("cannot be opened"), path.open("rb") as file:
            status = os.fstat(file.fileno())
            self._identity = _identity(status)
            self._layout = read_layout(file, status.st_size)
            file.seek(0)
            crs_wkt = _crs_wkt(file)
        low_m, high_m = self._layout.low_m, self._layout.high_m
        self.header = ScanHeader(
            point_count=self._layout.count,
            low_m=(float(low_m[0]), float(low_m[1]), float(low_m[2])),
            high_m=(float(high_m[0]), float(high_m[1]), float(high_m[2])),
            has_time=self._layout.has_time,
            standard_time=self._layout.standard_time,
            crs_wkt=crs_wkt,
            software=self._layout.software,
        )
        nearest_m = float(np.linalg.norm(np.clip(0.0, low_m, high_m)))
        if range_max_m is not None and nearest_m > range_max_m:
            raise ScanError(
                f"the nearest point is {nearest_m:,.0f} m from the origin, beyond scanner.range_max_m ="
                f' {range_max_m:g}: not in the scanner\'s own frame; is it scans.frame = "map"?'
            )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *fault: object) -> None:
        self.close()

    def close(self) -> None:
        """Nothing is open between calls."""

    def blocks(self, size: int = 50_000, *, brightness: bool = True) -> Iterator[Shots]:
        """Give all echoes in the order of the file, `size` at a time; memory does not grow with the file.

        They are decoded from the call on, if that can be done beside. Without `brightness` an eighth of the
        decoding is saved. Raises ScanError where fewer points are there than the header counts, or one lies
        outside the header's box, farther than `range_max_m`, or has no finite time.
        """
        timed = self.time_range_s() is not None
        together, width, count = BLOCKS_AT_ONCE * size, self._layout.record_bytes, self._layout.count
        lengths = [min(together, count - first) * width for first in range(0, count, together)]
        rooms = filled(partial(self._filling, BRIGHT if brightness else NEEDED), lengths)
        return self._shots(rooms, size, timed=timed, brightness=brightness)

    def _shots(self, rooms: Iterator[Room], size: int, *, timed: bool, brightness: bool) -> Iterator[Shots]:
        check = _Check(self._layout, self._range_max_m)
        for room in rooms:
            records = room.view(self._layout.record)
            for start in range(0, len(records), size):
                yield check.shots(records[start : start + size], timed=timed, brightness=brightness)

    @contextmanager
    def _filling(self, layers: DecompressionSelection) -> Iterator[Callable[[Room], None]]:
        """Open the points; give what decodes as many of the next as a room holds."""
        with self._points(layers, all_cores=True) as points:
            yield points.fill

    def time_range_s(self) -> tuple[float, float] | None:
        """Give the earliest and latest time stamp [s] of echoes here and there.

        None where the format has no time or all stamps are zero.
        """
        if not self._layout.has_time:
            return None
        time_s, *_ = self._glance
        range_s = float(time_s.min()), float(time_s.max())
        return range_s if any(range_s) else None

    def head_track(self) -> HeadTrack | None:
        """Give where the head looked when, from echoes here and there.

        Decodes no more than the end where there are chunks enough. None for a scan without time or not in the
        scanner's frame.
        """
        if self._range_max_m is None or self.time_range_s() is None:
            return None
        time_s, x_m, y_m = self._glance
        if 0 < self._layout.chunks < FEW_CHUNKS:
            blocks = self.blocks(max(self._layout.count // PLACES, 1), brightness=False)
            firsts = [(one.time_s[0], *one.xyz_m[:2, 0]) for one in blocks if one.time_s is not None]
            time_s, x_m, y_m = np.array(firsts).T
        time_s, first = np.unique(time_s, return_index=True)
        if len(time_s) < 2:
            return None
        return HeadTrack(time_s, np.unwrap(np.arctan2(y_m[first], x_m[first])))

    @cached_property
    def _glance(self) -> tuple[Floats, Floats, Floats]:
        """Time [s], x and y [m] of echoes (n,): the first of each chunk, or some on the way, and the last."""
        layout = self._layout
        places = [] if layout.laszip else np.linspace(0, layout.count - 1, PLACES).astype(np.int64).tolist()
        seen = [layout.chunk_firsts]
        with self._points(NEEDED, all_cores=False) as points:
            for number in [*places, layout.count - 1]:
                points.seek(number)
                seen.append(points.read(1).tobytes())
        records = np.frombuffer(b"".join(seen), layout.record)
        shots = _Check(layout, self._range_max_m).shots(records, timed=True)
        assert shots.time_s is not None  # noqa: S101 - asked for
        return shots.time_s, shots.xyz_m[0], shots.xyz_m[1]

    @contextmanager
    def _points(self, layers: DecompressionSelection, *, all_cores: bool) -> Iterator[_Points]:
        """Open the points, at the first; passes see the file that was checked or NotReadyError."""
        with foreign_code("cannot be opened again"):
            file = self.path.open("rb")
        with file:
            if _identity(os.fstat(file.fileno())) != self._identity:
                raise NotReadyError("has changed since it was opened")
            yield _Points(file, self._layout, layers, all_cores=all_cores)


class _Points:
    """The records of an open file, one after the other from wherever one seeks; onwards only."""

    def __init__(
        self, file: BufferedReader, layout: Layout, layers: DecompressionSelection, *, all_cores: bool
    ) -> None:
        self._file = file
        self._layout = layout
        self.at = 0
        self._decompressor = None
        file.seek(layout.points_at)
        if layout.laszip is not None:
            with foreign_code("cannot be decompressed"):
                decompressor = lazrs.ParLasZipDecompressor if all_cores else lazrs.LasZipDecompressor
                self._decompressor = decompressor(file, layout.laszip, layers.to_lazrs())

    def seek(self, number: int) -> None:
        """Go on to a point."""
        if self._decompressor is not None and not self._layout.even_chunks:
            while self.at < number:  # lazrs 0.8 seeks to wrong points where chunks differ in length
                self.read(min(SKIP, number - self.at))
            return
        self.at = number
        with foreign_code(f"corrupt near point {number:,}"):
            if self._decompressor is None:
                self._file.seek(self._layout.points_at + number * self._layout.record_bytes)
            else:
                self._decompressor.seek(number)

    def read(self, count: int) -> Records:
        """Decode the next `count` records; they must be there."""
        room = np.empty(count * self._layout.record_bytes, np.uint8)
        self.fill(room)
        return room.view(self._layout.record)

    def fill(self, room: Room) -> None:
        """Decode the next records into a room; as many as it holds must be there."""
        count = len(room) // self._layout.record_bytes
        with foreign_code(f"corrupt after point {self.at:,}"):
            if self._decompressor is not None:
                self._decompressor.decompress_many(room)
            elif self._file.readinto(room.data) != len(room):
                raise ScanError(f"cut off: ends before point {self.at + count:,} of {self._layout.count:,}")
        self.at += count


class _Check:
    """Turns records into shots and holds them against what the header says."""

    def __init__(self, layout: Layout, range_max_m: float | None) -> None:
        self._layout = layout
        slack_m = layout.scale  # writers round the box before or after the points
        self._low_m, self._high_m = layout.low_m - slack_m, layout.high_m + slack_m
        self._scanner_frame = range_max_m is not None
        # the box is enough where its farthest corner is in range
        corner_m = np.linalg.norm(np.maximum(np.abs(layout.low_m), np.abs(layout.high_m)))
        self._range_max_m = range_max_m if range_max_m is not None and corner_m > range_max_m else None
        self._first_s: float | None = None
        self._earliest_s = np.inf
        self._latest_s = -np.inf

    def shots(self, records: Records, *, timed: bool, brightness: bool = False) -> Shots:
        """Give the echoes of some records, contiguous (n,), with their times if `timed`."""
        xyz_m = np.empty((3, len(records)))
        for axis, axis_m in enumerate(xyz_m):
            self._lay(records, axis, axis_m)
        if self._range_max_m is not None:
            farthest_m = float(np.sqrt((xyz_m**2).sum(axis=0).max()))
            if farthest_m > self._range_max_m:
                raise ScanError(
                    f"an echo {farthest_m:,.0f} m away, beyond scanner.range_max_m = {self._range_max_m:g}:"
                    " corrupt, or another unit, frame or scanner than the site file says"
                )
        bright = records["intensity"] * BRIGHTEST if brightness else None
        return Shots(xyz_m, self._times(records) if timed else None, bright)

    def _lay(self, records: Records, axis: int, values: Floats) -> None:
        """Lay the coordinates (n,) along an axis into `values` [m]."""
        values[:] = records["XYZ"[axis]]
        values *= self._layout.scale[axis]
        values += self._layout.offset[axis]
        if values.min() < self._low_m[axis] or values.max() > self._high_m[axis]:
            raise ScanError(
                f"corrupt, or written by a faulty program: {'xyz'[axis]} = {values.min():.3f} to"
                f" {values.max():.3f} m leaves the header's {self._layout.low_m[axis]:.3f} to"
                f" {self._layout.high_m[axis]:.3f} m"
            )

    def _times(self, records: Records) -> Floats:
        time_s = np.ascontiguousarray(records["gps_time"], dtype=np.float64)
        low_s, high_s = float(time_s.min()), float(time_s.max())
        if not (np.isfinite(low_s) and np.isfinite(high_s)):
            raise ScanError("a time stamp is not a number: corrupt, or written by a faulty program")
        if self._first_s is None:
            self._first_s = float(time_s[0])
        if low_s < self._first_s - WEEK_S / 2 and low_s >= 0 and self._first_s < WEEK_S:
            time_s = np.where(time_s < self._first_s - WEEK_S / 2, time_s + WEEK_S, time_s)
            low_s, high_s = float(time_s.min()), float(time_s.max())
        self._earliest_s, self._latest_s = min(self._earliest_s, low_s), max(self._latest_s, high_s)
        if self._scanner_frame and self._latest_s - self._earliest_s > LONGEST_SCAN_S:
            raise ScanError(
                f"time stamps from {self._earliest_s:.3f} to {self._latest_s:.3f} s, more than a day apart:"
                " corrupt, or several scans in one file"
            )
        return time_s


def _crs_wkt(file: BinaryIO) -> str | None:
    """Give the coordinate system a file names, None where it names none that can be understood."""
    try:
        with foreign_code("coordinate system"):
            crs = LasHeader.read_from(file).parse_crs()
            return None if crs is None else crs.to_wkt()
    except ScanError:
        return None


def _identity(status: os.stat_result) -> tuple[int, int, int, int]:
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns
