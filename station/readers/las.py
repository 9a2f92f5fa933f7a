"""LAS and LAZ scans: versions 1.0 to 1.4, all point formats.

laspy parses the header and the coordinate system. Its decoder, lazrs, is called directly, because laspy's
reader cannot decode into shared memory (see `station.readers.prefetch`).
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cached_property, partial, reduce
from io import BufferedReader
from pathlib import Path
from typing import ClassVar, Self

import lazrs
import numpy as np
from laspy import DecompressionSelection, LasHeader
from laspy.header import GpsTimeType

from station.errors import NotReadyError, ScanError
from station.quantities import AzimuthTrack, Bools, Floats, InclinationLog, IntensityScale, Ints, Shots
from station.readers.formats.point_inclination import PointInclination
from station.readers.las_echoes import Brightness, Records, brightness_candidates, discard_tables
from station.readers.las_header import LasFileHeader, read_header
from station.readers.prefetch import Buffer, prefetch
from station.readers.scan import (
    MAX_SCAN_S,
    ScanHeader,
    continue_week,
    decoder_errors,
    head_track,
    require_in_range,
)

TIME = DecompressionSelection.base().decompress_gps_time()  # of formats 6 and up
POSITION_AND_TIME = TIME.decompress_z()
GROUND = POSITION_AND_TIME.decompress_flags().decompress_classification()
BLOCKS_PER_BUFFER = 4  # decoded together, two chunks per core; converted one by one, in the cache
SAMPLE_COUNT = 200  # points sampled from a scan with no or few chunks
SKIP_POINTS = 50_000  # points decoded at a time to skip them
BRIGHTNESS_POINTS = 1000  # points at the start of a scan that show whether its brightness varies
MIN_CHUNKS = 20  # with fewer, chunk starts are too far apart to follow the azimuth


class LasScan:
    """A LAS/LAZ file whose headers agree with each other and with its size (see `ScanReader`).

    No file stays open between calls; if it is replaced in between, NotReadyError is raised.
    """

    suffixes: ClassVar[tuple[str, ...]] = (".las", ".laz")

    def __init__(self, path: Path, *, range_max_m: float | None = None) -> None:
        self.path = path
        self._range_max_m = range_max_m
        with decoder_errors("cannot be opened"), path.open("rb") as file:
            status = os.fstat(file.fileno())
            self._file_identity = _file_identity(status)
            self._las_header = read_header(file, status.st_size)
        las = self._las_header.las
        x_low_m, y_low_m, z_low_m = las.mins.tolist()
        x_high_m, y_high_m, z_high_m = las.maxs.tolist()
        self.header = ScanHeader(
            point_count=las.point_count,
            low_m=(x_low_m, y_low_m, z_low_m),
            high_m=(x_high_m, y_high_m, z_high_m),
            has_time=self._las_header.has_time,
            standard_time=las.global_encoding.gps_time_type is GpsTimeType.STANDARD,
            crs_wkt=_crs_wkt(las),
            has_inclination=self._las_header.tilt is not None and self._las_header.has_time,
        )
        nearest_m = float(np.linalg.norm(np.clip(0.0, las.mins, las.maxs)))
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
        """Do nothing: no file is open between calls."""

    def blocks(self, size: int = 50_000, *, intensity: IntensityScale = "auto") -> Iterator[Shots]:
        """Yield the echoes of the ground in file order, from `size` points at a time, in bounded memory.

        Returns before the last one, withheld points and noise are left out. Decoding runs ahead in a child
        process if possible, from this call on; without intensity an eighth of it is saved. Raises ScanError
        if the file contains fewer points than its header counts, or none of the ground, or if a point is
        outside the header's box, without a finite time, or, on the ground, beyond `range_max_m`.
        """
        brightness = self._brightness(intensity)
        has_time = self.time_range_s() is not None
        buffer_points, point_count = BLOCKS_PER_BUFFER * size, self.header.point_count
        record_bytes = self._las_header.record_dtype.itemsize
        lengths = [
            min(buffer_points, point_count - first) * record_bytes
            for first in range(0, point_count, buffer_points)
        ]
        layers = GROUND if brightness is None else _with_brightness(GROUND, brightness)
        buffers = prefetch(partial(self._open_decoder, layers), lengths)
        return self._iter_shots(buffers, size, brightness, has_time=has_time)

    def _iter_shots(
        self, buffers: Iterator[Buffer], size: int, brightness: Brightness | None, *, has_time: bool
    ) -> Iterator[Shots]:
        decoder = _ShotDecoder(self._las_header.las, self._range_max_m)
        tables, is_empty = discard_tables(self._las_header.las.point_format), True
        for buffer in buffers:
            records = buffer.view(self._las_header.record_dtype)
            for start in range(0, len(records), size):
                block = records[start : start + size]
                shots = decoder.decode(block, brightness, _ground(block, tables), has_time=has_time)
                if len(shots):
                    decoder.check_range(shots)
                    is_empty = False
                    yield shots
        if is_empty:
            raise ScanError(
                f"none of its {self.header.point_count:,} points is a last or only return that is neither"
                " withheld nor noise: export the last returns too"
            )

    @contextmanager
    def _open_decoder(self, layers: DecompressionSelection) -> Iterator[Callable[[Buffer], None]]:
        """Open the points; yield a function that decodes the next ones into a buffer until it is full."""
        with self._open_points(layers, all_cores=True) as points:
            yield points.fill

    def time_range_s(self) -> tuple[float, float] | None:
        """Return the earliest and latest time stamp [s] of sampled echoes.

        None if the format has no time or all stamps are zero.
        """
        if not self._las_header.has_time:
            return None
        time_s, *_ = self._sample
        range_s = float(time_s.min()), float(time_s.max())
        return range_s if any(range_s) else None

    def azimuth_track(self) -> AzimuthTrack | None:
        """Return the azimuth of the scanner head over time [rad], from sampled echoes.

        Decodes only the end of the file if there are enough chunks. None for a scan without time, not in the
        scanner's frame, or whose azimuth does not follow a head.
        """
        if self._range_max_m is None or self.time_range_s() is None:
            return None
        time_s, x_m, y_m = self._sample
        if self._las_header.laszip is not None and len(time_s) <= MIN_CHUNKS:  # its chunks and the last point
            blocks = self.blocks(max(self.header.point_count // SAMPLE_COUNT, 1), intensity="none")
            first_shots = [
                (shots.time_s[0], *shots.xyz_m[:2, 0]) for shots in blocks if shots.time_s is not None
            ]
            time_s, x_m, y_m = np.array(first_shots).T
        return head_track(time_s, x_m, y_m)

    def inclination(self) -> InclinationLog | None:
        """Return the inclination log of extra bytes called roll and pitch; None if there are none.

        Decodes the times and extra bytes of all points.
        """
        tilt, decoder = self._las_header.tilt, _ShotDecoder(self._las_header.las, self._range_max_m)
        if tilt is None or self.time_range_s() is None:
            return None
        collected, layers = PointInclination(), TIME.decompress_all_extra_bytes()
        fields = [(self._las_header.only(field.dtype, field.position), field, unit) for field, unit in tilt]
        with self._open_points(layers, all_cores=True) as points:
            while count := min(SKIP_POINTS * BLOCKS_PER_BUFFER, self.header.point_count - points.position):
                records = points.read(count)
                with np.errstate(all="ignore"):  # whatever the extra bytes hold
                    roll_rad, pitch_rad = (
                        (records.view(dtype)["value"].astype(np.float64) * field.scale + field.offset) * unit
                        for dtype, field, unit in fields
                    )
                collected.add(decoder.decode_times(records), roll_rad, pitch_rad)
        return collected.log()

    @cached_property
    def _sample(self) -> tuple[Floats, Floats, Floats]:
        """Time [s], x and y [m] (n,): the first echo of each chunk, or evenly spaced ones, and the last."""
        header, last = self._las_header, self.header.point_count - 1
        indices = (
            [last] if header.laszip else [*np.linspace(0, last, SAMPLE_COUNT).astype(int).tolist(), last]
        )
        raw = header.first_points
        with self._open_points(POSITION_AND_TIME, all_cores=False) as points:
            for index in indices:
                points.seek(index)
                raw += points.read(1).tobytes()
        records = np.frombuffer(raw, header.record_dtype)
        shots = _ShotDecoder(header.las, self._range_max_m).decode(records, has_time=True)
        assert shots.time_s is not None  # noqa: S101 - requested
        return shots.time_s, shots.xyz_m[0], shots.xyz_m[1]

    def _brightness(self, scale: IntensityScale) -> Brightness | None:
        """Return the field that holds the brightness of the echoes.

        None if there is none, or if it is the same for all echoes at the start of the scan and of each chunk.
        """
        candidates = brightness_candidates(self._las_header, scale)
        if not candidates:
            return None
        layers = _with_brightness(POSITION_AND_TIME, *candidates)
        with self._open_points(layers, all_cores=False) as points:
            first_points = points.read(min(BRIGHTNESS_POINTS, self.header.point_count))
        starts = np.frombuffer(self._las_header.first_points, first_points.dtype)
        for brightness in candidates:
            intensity = [*brightness.intensity(first_points), *brightness.intensity(starts)]
            if max(intensity) > min(intensity):
                return brightness
        return None

    @contextmanager
    def _open_points(self, layers: DecompressionSelection, *, all_cores: bool) -> Iterator[_PointStream]:
        """Open the file at its first point; raise NotReadyError if it changed since it was checked."""
        with decoder_errors("cannot be opened again"):
            file = self.path.open("rb")
        with file:
            if _file_identity(os.fstat(file.fileno())) != self._file_identity:
                raise NotReadyError("has changed since it was opened")
            yield _PointStream(file, self._las_header, layers, all_cores=all_cores)


class _PointStream:
    """The point records of an open file, read in order; seeking goes forward only."""

    def __init__(
        self, file: BufferedReader, header: LasFileHeader, layers: DecompressionSelection, *, all_cores: bool
    ) -> None:
        self._file = file
        self._header = header
        self._dtype = header.record_dtype
        self.position = 0
        self._decompressor = None
        file.seek(header.las.offset_to_point_data)
        if header.laszip is not None:
            with decoder_errors("cannot be decompressed"):
                decompressor = lazrs.ParLasZipDecompressor if all_cores else lazrs.LasZipDecompressor
                self._decompressor = decompressor(file, header.laszip, layers.to_lazrs())

    def seek(self, index: int) -> None:
        """Skip forward to a point."""
        if self._decompressor is not None and not self._header.equal_chunks:
            while self.position < index:  # lazrs 0.8 seeks to wrong points if chunks differ in length
                self.read(min(SKIP_POINTS, index - self.position))
            return
        self.position = index
        with decoder_errors(f"corrupt near point {index:,}"):
            if self._decompressor is None:
                self._file.seek(self._header.las.offset_to_point_data + index * self._dtype.itemsize)
            else:
                self._decompressor.seek(index)

    def read(self, count: int) -> Records:
        """Return the next `count` records, decoded; the file must contain them."""
        buffer = np.empty(count * self._dtype.itemsize, np.uint8)
        self.fill(buffer)
        return buffer.view(self._dtype)

    def fill(self, buffer: Buffer) -> None:
        """Decode the next records into a buffer until it is full; the file must contain them."""
        count = len(buffer) // self._dtype.itemsize
        with decoder_errors(f"corrupt after point {self.position:,}"):
            if self._decompressor is not None:
                self._decompressor.decompress_many(buffer)
            elif self._file.readinto(buffer.data) != len(buffer):
                raise ScanError(
                    f"cut off: ends before point {self.position + count:,}"
                    f" of {self._header.las.point_count:,}"
                )
        self.position += count


class _ShotDecoder:
    """Decodes point records into shots and checks them against the header."""

    def __init__(self, las: LasHeader, range_max_m: float | None) -> None:
        self._las = las
        tolerance_m = las.scales  # writers round the box before or after the points
        self._low_m, self._high_m = las.mins - tolerance_m, las.maxs + tolerance_m
        self._scanner_frame = range_max_m is not None
        # points need no check of their range if the farthest corner of the box is in range
        corner_m = np.linalg.norm(np.maximum(np.abs(las.mins), np.abs(las.maxs)))
        self._range_max_m = range_max_m if range_max_m is not None and corner_m > range_max_m else None
        self._first_s: float | None = None
        self._earliest_s = np.inf
        self._latest_s = -np.inf

    def decode(
        self,
        records: Records,
        brightness: Brightness | None = None,
        ground: Ints | None = None,
        *,
        has_time: bool,
    ) -> Shots:
        """Return the echoes of records, contiguous (n,), with their times if `has_time`.

        `ground` (m,) are the indices of those to return; None for all.
        """
        xyz_m = np.empty((3, len(records)))
        for axis, axis_m in enumerate(xyz_m):
            self._scale_axis(records, axis, axis_m)
        time_s = self.decode_times(records) if has_time else None
        intensity = None if brightness is None else brightness.intensity(records)
        if ground is not None:
            xyz_m = xyz_m.take(ground, axis=1)
            time_s = None if time_s is None else time_s.take(ground)
            intensity = None if intensity is None else intensity.take(ground)
        return Shots(xyz_m, time_s, intensity)

    def check_range(self, shots: Shots) -> None:
        """Raise ScanError if one of the shots, at least one, is out of range."""
        require_in_range(shots.xyz_m, self._range_max_m)

    def _scale_axis(self, records: Records, axis: int, values: Floats) -> None:
        """Write the coordinates (n,) along an axis into `values` [m]."""
        values[:] = records["XYZ"[axis]]
        values *= self._las.scales[axis]
        values += self._las.offsets[axis]
        if values.min() < self._low_m[axis] or values.max() > self._high_m[axis]:
            raise ScanError(
                f"corrupt, or written by a faulty program: {'xyz'[axis]} = {values.min():.3f} to"
                f" {values.max():.3f} m leaves the header's {self._las.mins[axis]:.3f} to"
                f" {self._las.maxs[axis]:.3f} m"
            )

    def decode_times(self, records: Records) -> Floats:
        """Return the times of records (n,), which must be those of one scan [s]."""
        time_s = np.array(records["gps_time"], dtype=np.float64)  # a copy: the buffer is used again
        low_s, high_s = float(time_s.min()), float(time_s.max())
        if not (np.isfinite(low_s) and np.isfinite(high_s)):
            raise ScanError("a time stamp is not a number: corrupt, or written by a faulty program")
        if self._first_s is None:
            self._first_s = float(time_s[0])
        time_s = continue_week(time_s, self._first_s)
        low_s, high_s = float(time_s.min()), float(time_s.max())
        self._earliest_s, self._latest_s = min(self._earliest_s, low_s), max(self._latest_s, high_s)
        if self._scanner_frame and self._latest_s - self._earliest_s > MAX_SCAN_S:
            raise ScanError(
                f"time stamps from {self._earliest_s:.3f} to {self._latest_s:.3f} s, more than a day apart:"
                " corrupt, or several scans in one file"
            )
        return time_s


def _with_brightness(layers: DecompressionSelection, *fields: Brightness) -> DecompressionSelection:
    """Return the layers together with those that hold the brightness."""
    for field in fields:
        layers = (
            layers.decompress_all_extra_bytes() if field.in_extra_bytes else layers.decompress_intensity()
        )
    return layers


def _ground(records: Records, tables: dict[str, Bools]) -> Ints | None:
    """Return the indices (m,) of the records of the ground; None if it is all of them."""
    discarded = reduce(np.logical_or, (table.take(records[name]) for name, table in tables.items()))
    return np.flatnonzero(~discarded) if discarded.any() else None


def _crs_wkt(las: LasHeader) -> str | None:
    """Return the coordinate system that a file declares; None if it declares none that can be parsed."""
    try:
        with decoder_errors("coordinate system"):
            crs = las.parse_crs()
            return None if crs is None else crs.to_wkt()
    except ScanError:
        return None


def _file_identity(status: os.stat_result) -> tuple[int, int, int, int]:
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns
