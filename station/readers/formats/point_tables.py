"""Scans that a format's library gives as tables of points: what all formats but LAS have in common.

A format tells where its fields are; last returns, brightness, times, ranges and their checks are the same for
all of them.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from station.errors import NotReadyError, ScanError
from station.quantities import AzimuthTrack, Bools, Floats, InclinationLog, IntensityScale, Shots
from station.readers.formats.point_inclination import AXES, UNITS, PointInclination, tilt_field
from station.readers.las_echoes import LOWEST_DB, MAX_INTENSITY, NOISE_CLASSES, SPAN_DB, from_decibels
from station.readers.scan import (
    MAX_SCAN_S,
    ScanHeader,
    continue_week,
    decoder_errors,
    head_track,
    require_in_range,
)

Table = dict[str, NDArray[Any]]  # columns (n,) by the names of FIELDS and TILT; x, y and z are always there

MAX_COORDINATE_M = 1e8  # no map of the Earth is larger
SURVEY_POINTS = 16_384  # read at a time when a file is opened
TRACK_SAMPLES = 1000  # of the azimuth of the head
UNKNOWN_COUNT_STEP = 64  # points between samples if a file does not state their number
# The largest value of an intensity that a format does not limit itself: fractions, 8, 12 and 16 bits.
FULL_SCALES = (1.0, 255.0, 4095.0, float(MAX_INTENSITY))
PTS_LIMITS = (-2048.0, 2047.0)  # of the intensity of Leica's PTS files
# Names of fields, in lower case without units, by what they hold.
FIELDS = {
    "x": ("x", "cartesianx", "x_coordinate", "easting"),
    "y": ("y", "cartesiany", "y_coordinate", "northing"),
    "z": ("z", "cartesianz", "z_coordinate", "height", "elevation"),
    "time": ("time", "gps_time", "gpstime", "timestamp", "time_stamp", "t"),
    "intensity": ("intensity", "intensities", "i", "reflectivity"),
    "reflectance": ("reflectance", "riegl_reflectance"),
    "return_number": ("return_number", "returnnumber", "target_index", "return"),
    "number_of_returns": ("number_of_returns", "numberofreturns", "target_count", "num_returns"),
    "classification": ("classification", "class"),
}

TILT = {f"{axis}_{unit}": (axis, factor) for axis in AXES for unit, factor in UNITS.items()}


def field_of(name: str) -> str | None:
    """Return what a column of the given name holds, by the keys of FIELDS and TILT; None if it is not needed.

    Units in brackets and the prefix that CloudCompare writes to PLY files do not count.
    """
    if (tilt := tilt_field(name)) is not None:
        return next(key for key, known in TILT.items() if known == tilt)
    plain = name.strip(" \"'/#\r\n").lower().partition("[")[0].partition("(")[0].strip(" _")
    plain = plain.removeprefix("scalar_").replace(" ", "_").replace(".", "_")
    return next((key for key, names in FIELDS.items() if plain in names), None)


@dataclass(frozen=True)
class Contents:
    """What a file says about itself."""

    point_count: int | None  # None if only reading it shows
    intensity_limits: tuple[float, float] | None = None
    crs_wkt: str | None = None
    start_utc: datetime | None = None


@dataclass
class _Survey:
    """What one reading of all points shows."""

    count: int = 0
    low_m: Floats = field(default_factory=lambda: np.full(3, np.inf))
    high_m: Floats = field(default_factory=lambda: np.full(3, -np.inf))
    first_s: float | None = None
    time_range_s: tuple[float, float] = (np.inf, -np.inf)
    limits: dict[str, tuple[float, float]] = field(default_factory=dict)  # of the brightness, by its field
    samples: list[Floats] = field(default_factory=list)  # time [s], x, y [m] (3, k)
    has_inclination: bool = False
    inclination: PointInclination = field(default_factory=PointInclination)


class TableScan(ABC):
    """A scan whose points come as tables (see `ScanReader`); no file stays open between calls."""

    suffixes: ClassVar[tuple[str, ...]] = ()
    drops_nan: ClassVar[bool] = True  # if a format writes NaN where there was no echo

    def __init__(self, path: Path, *, range_max_m: float | None = None) -> None:
        self.path = path
        self._range_max_m = range_max_m
        with decoder_errors("cannot be opened"):
            self._file_identity = _file_identity(path)
            self._contents = self._open()
        self._survey = self._read_all()
        low_m, high_m = self._survey.low_m.tolist(), self._survey.high_m.tolist()
        self.header = ScanHeader(
            point_count=self._survey.count,
            low_m=(low_m[0], low_m[1], low_m[2]),
            high_m=(high_m[0], high_m[1], high_m[2]),
            has_time=self._survey.first_s is not None,
            standard_time=False,
            crs_wkt=self._contents.crs_wkt,
            start_utc=self._contents.start_utc,
            has_inclination=self._survey.has_inclination,
        )

    @abstractmethod
    def _open(self) -> Contents:
        """Check what can be checked without decoding; raise ScanError, or whatever the library raises."""

    @abstractmethod
    def _tables(self, size: int) -> Iterator[Table]:
        """Yield all points in file order, at most `size` at a time; their number must be the stated one."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *fault: object) -> None:
        self.close()

    def close(self) -> None:  # noqa: B027 - no reader has more to do
        """Do nothing: no file is open between calls."""

    def blocks(self, size: int = 50_000, *, intensity: IntensityScale = "auto") -> Iterator[Shots]:
        """Yield the echoes of the ground in file order, from `size` points at a time, in bounded memory.

        Returns before the last one, noise and points without an echo are left out.
        """
        brightness, is_empty = self._brightness(intensity), True
        has_time = self.time_range_s() is not None
        for table in self._checked_tables(size):
            is_ground = self._is_echo(table) & _is_last(table)
            if not is_ground.any():
                continue
            is_empty = False
            xyz_m = np.stack([table[axis][is_ground].astype(np.float64) for axis in "xyz"])
            require_in_range(xyz_m, self._range_max_m)
            time_s = self._times(table)[is_ground] if has_time else None
            yield Shots(xyz_m, time_s, None if brightness is None else brightness(table)[is_ground])
        if is_empty:
            raise ScanError(
                f"none of its {self.header.point_count:,} points is a last return that is no noise"
            )

    def time_range_s(self) -> tuple[float, float] | None:
        """Return the earliest and latest time stamp [s]; None if there are none or all are zero."""
        low_s, high_s = self._survey.time_range_s
        return (low_s, high_s) if low_s <= high_s and (low_s or high_s) else None

    def azimuth_track(self) -> AzimuthTrack | None:
        """Return the azimuth of the scanner head over time [rad], from samples.

        None for a scan without time, not in the scanner's frame, or whose azimuth does not follow a head.
        """
        if self._range_max_m is None or self.time_range_s() is None:
            return None
        return head_track(*np.concatenate(self._survey.samples, axis=1))

    def inclination(self) -> InclinationLog | None:
        """Return the inclination log of columns called roll and pitch; None if there are none."""
        return None if self.time_range_s() is None else self._survey.inclination.log()

    def _checked_tables(self, size: int) -> Iterator[Table]:
        """Yield the tables; turn what the library raises into ScanError."""
        with decoder_errors("cannot be opened again"):
            if _file_identity(self.path) != self._file_identity:
                raise NotReadyError("has changed since it was opened")
        tables, count = self._tables(size), 0
        while True:
            with decoder_errors(f"corrupt after point {count:,}"):
                table = next(tables, None)
            if table is None:
                return
            count += len(table["x"])
            yield table

    def _read_all(self) -> _Survey:
        """Return what reading all points shows; raise ScanError if they are not what the file says."""
        survey, expected = _Survey(), self._contents.point_count
        step = UNKNOWN_COUNT_STEP if expected is None else max(expected // TRACK_SAMPLES, 1)
        for table in self._checked_tables(SURVEY_POINTS):
            survey.count += len(table["x"])
            is_echo = self._is_echo(table)
            if is_echo.any():
                self._add(survey, {name: column[is_echo] for name, column in table.items()}, step)
        if expected is not None and survey.count != expected:
            raise ScanError(f"cut off: {survey.count:,} of {expected:,} points")
        if not np.isfinite(survey.low_m).all():
            raise ScanError("contains no points")
        low_s, high_s = survey.time_range_s
        if self._range_max_m is not None and high_s - low_s > MAX_SCAN_S:
            raise ScanError(
                f"time stamps from {low_s:.3f} to {high_s:.3f} s, more than a day apart: corrupt, not in"
                " seconds, or several scans in one file"
            )
        nearest_m = float(np.linalg.norm(np.clip(0.0, survey.low_m, survey.high_m)))
        if self._range_max_m is not None and nearest_m > self._range_max_m:
            raise ScanError(
                f"the nearest point is {nearest_m:,.0f} m from the origin, beyond scanner.range_max_m ="
                f' {self._range_max_m:g}: not in the scanner\'s own frame; is it scans.frame = "map"?'
            )
        return survey

    def _add(self, survey: _Survey, table: Table, step: int) -> None:
        """Add a table of echoes to a survey."""
        xyz_m = np.stack([table[axis] for axis in "xyz"]).astype(np.float64)
        if not (np.isfinite(xyz_m).all() and np.abs(xyz_m).max() <= MAX_COORDINATE_M):
            raise ScanError("a coordinate is not a number or beyond any map: corrupt")
        survey.low_m = np.minimum(survey.low_m, xyz_m.min(axis=1))
        survey.high_m = np.maximum(survey.high_m, xyz_m.max(axis=1))
        for name in ("intensity", "reflectance"):
            if name in table:
                known = table[name].astype(np.float64)
                known = known[np.isfinite(known)]
                low, high = survey.limits.get(name, (np.inf, -np.inf))
                survey.limits[name] = (
                    min(low, float(known.min(initial=np.inf))),
                    max(high, float(known.max(initial=-np.inf))),
                )
        if "time" not in table:
            return
        if survey.first_s is None:
            survey.first_s = float(table["time"][0])
        time_s = continue_week(table["time"].astype(np.float64), survey.first_s)
        if not np.isfinite(time_s).all():
            raise ScanError("a time stamp is not a number: corrupt, or written by a faulty program")
        low_s, high_s = survey.time_range_s
        survey.time_range_s = min(low_s, float(time_s.min())), max(high_s, float(time_s.max()))
        survey.samples.append(np.stack([time_s, xyz_m[0], xyz_m[1]])[:, ::step])
        tilts = [(axis, key, factor) for key, (axis, factor) in TILT.items() if key in table]
        tilt_rad = {axis: table[key].astype(np.float64) * factor for axis, key, factor in tilts}
        survey.has_inclination = set(AXES) <= tilt_rad.keys()
        if survey.has_inclination and self._range_max_m is not None:  # else the times have no limit
            survey.inclination.add(time_s, *(tilt_rad[axis] for axis in AXES))

    def _times(self, table: Table) -> Floats:
        assert self._survey.first_s is not None  # noqa: S101 - there are times
        return continue_week(table["time"].astype(np.float64), self._survey.first_s)

    def _is_echo(self, table: Table) -> Bools:
        """Return True for points (n,) with an echo; NaN, zero or a flag stand where there was none."""
        xyz = [table[axis] for axis in "xyz"]
        is_echo = np.ones(len(xyz[0]), bool)
        if self.drops_nan:
            is_echo &= ~(np.isnan(xyz[0]) | np.isnan(xyz[1]) | np.isnan(xyz[2]))
        if self._range_max_m is not None:
            is_echo &= (xyz[0] != 0) | (xyz[1] != 0) | (xyz[2] != 0)
        if "invalid" in table:
            is_echo &= table["invalid"] == 0
        return is_echo

    def _brightness(self, scale: IntensityScale) -> Callable[[Table], Floats] | None:
        """Return a function from a table to intensity (n,), 0-1; None without brightness that varies."""
        varying = {name: limits for name, limits in self._survey.limits.items() if limits[0] < limits[1]}
        if scale in {"auto", "reflectance"} and "reflectance" in varying:
            convert = from_decibels(1.0, 0.0)
            return lambda table: convert(table["reflectance"].astype(np.float64))
        if scale not in {"auto", "linear", "decibel"} or "intensity" not in varying:
            return None
        if scale == "decibel":
            convert = from_decibels(SPAN_DB / MAX_INTENSITY, LOWEST_DB)
            return lambda table: convert(table["intensity"].astype(np.float64))
        limits = self._contents.intensity_limits or _full_scale(*varying["intensity"])
        if limits is None:
            return None
        low, span = limits[0], limits[1] - limits[0]
        return lambda table: np.nan_to_num(
            np.clip((table["intensity"].astype(np.float64) - low) / span, 0.0, 1.0), nan=0.0
        )


def _is_last(table: Table) -> Bools:
    """Return True for points (n,) that are the last return of their shot and no noise."""
    is_last = np.ones(len(table["x"]), bool)
    if "return_number" in table and "number_of_returns" in table:
        number, count = table["return_number"], table["number_of_returns"]
        is_last &= ~((number > 0) & (number < count))
    if "classification" in table:
        is_last &= ~np.isin(table["classification"], NOISE_CLASSES)
    return is_last


def _full_scale(low: float, high: float) -> tuple[float, float] | None:
    """Return the limits of an intensity of which only the values of a scan are known; None if there are none.

    Fixed steps, so that scans of a series have the same scale.
    """
    if low < 0:
        return PTS_LIMITS if low >= PTS_LIMITS[0] and high <= PTS_LIMITS[1] else None
    return next(((0.0, full) for full in FULL_SCALES if high <= full), None)


def _file_identity(path: Path) -> tuple[int, int, int, int]:
    status = path.stat()
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns
