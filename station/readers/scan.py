"""The protocol of scan readers, the readers available, and the start time of a scan.

A format plugs in through the entry point group `station.readers`, with a class that implements `ScanReader`.
"""

from __future__ import annotations

import errno
import functools
import logging
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from enum import Enum
from importlib.metadata import entry_points
from pathlib import Path
from typing import ClassVar, Protocol, Self

import numpy as np

from station.errors import InconclusiveError, NotReadyError, ScanError, StationError
from station.quantities import AzimuthTrack, Floats, InclinationLog, IntensityScale, Shots
from station.scan_names import COMPRESSED, resolution_s, start_in_name

log = logging.getLogger(__name__)

GPS_EPOCH = datetime(1980, 1, 6, tzinfo=UTC)  # IS-GPS-200, 3.3.4
WEEK_S = 604_800.0
STANDARD_OFFSET_S = 1e9  # "adjusted standard GPS time" is GPS seconds minus this: LAS 1.4 R15, table 4
# GPS - UTC from each date on. Source: IERS Bulletin C (leap-seconds.list); none has been announced since.
LEAP_SECONDS = (
    (datetime(2017, 1, 1, tzinfo=UTC), 18),
    (datetime(2015, 7, 1, tzinfo=UTC), 17),
    (datetime(2012, 7, 1, tzinfo=UTC), 16),
    (datetime(2009, 1, 1, tzinfo=UTC), 15),
    (datetime(2006, 1, 1, tzinfo=UTC), 14),
    (datetime(1999, 1, 1, tzinfo=UTC), 13),
)
# Errors of disk, network, permissions, memory and tasks are transient; an invalid seek (EINVAL) is the file's
# own fault.
TRANSIENT_ERRNOS = {
    errno.EACCES, errno.EPERM, errno.ENOENT, errno.EIO, errno.ESTALE, errno.ETIMEDOUT, errno.EMFILE,
    errno.ENFILE, errno.EAGAIN, errno.ENOMEM, errno.ENODEV, errno.ENXIO, errno.ENOTCONN, errno.EHOSTDOWN,
    errno.EHOSTUNREACH,
}  # fmt: skip
_RUST_OS_ERROR = re.compile(r"Os \{ code: (\d+)")  # how a panic prints the system's error that caused it
MAX_SCAN_S = 86_400.0
TEXT = ".xyz"  # the suffix whose reader reads text
TEXT_SUFFIXES = (".csv", ".txt", ".dat")  # of text too, but also of logs: scans only if scans.suffix says so
RANGE_TOLERANCE = 0.01  # of the range: the last echoes have errors, and makers round
MIN_TURN = 0.5  # of the head, net over total; more turning to and fro is no head that scans line by line
MAX_CLOCK_DIFFERENCE_S = 900.0  # between name and GPS times of a scan; names are up to minutes early


class TimeBase(Enum):
    """The time base of the time stamps of a scan."""

    NONE = "none"
    SCANNER = "scanner"  # seconds since the scanner was switched on
    WEEK = "week"  # GPS seconds of the week
    STANDARD = "standard"  # GPS seconds minus 1e9


@dataclass(frozen=True)
class ScanHeader:
    """The metadata of a scan; checked against the file, but not yet against its points."""

    point_count: int
    low_m: tuple[float, float, float]
    high_m: tuple[float, float, float]
    has_time: bool  # the format has a time field; `time_range_s` is None if it is not filled
    standard_time: bool  # the flag for adjusted standard GPS time, which not every writer sets correctly
    crs_wkt: str | None  # None if the file declares none that can be parsed
    start_utc: datetime | None = None  # that the file states; its name and standard times come first
    has_inclination: bool = False  # the points carry roll and pitch of the scanner


class ScanReader(Protocol):
    """One scan, open for reading.

    Opening checks whatever needs no decoding. Every fault of the file is raised as ScanError, on opening or
    from any method; NotReadyError if the disk fails, access is denied or the file has just changed.
    """

    suffixes: ClassVar[tuple[str, ...]]  # lower case, with the dot
    path: Path
    header: ScanHeader

    def __init__(self, path: Path, *, range_max_m: float | None = None) -> None:
        """Open the file; `range_max_m` limits the range of the echoes of a scan in the scanner's frame."""

    def blocks(self, size: int = 50_000, *, intensity: IntensityScale = "auto") -> Iterator[Shots]:
        """Yield the echoes of the ground in file order, from `size` points at a time; no block is empty.

        `intensity` is the scale in which the file tells brightness: `scans.intensity` of the site file.
        """

    def time_range_s(self) -> tuple[float, float] | None:
        """Return the earliest and latest time stamp [s], from samples; None if there are none."""

    def azimuth_track(self) -> AzimuthTrack | None:
        """Return the azimuth of the scanner head over time, from samples; None if it is unknown."""

    def inclination(self) -> InclinationLog | None:
        """Return the inclination log that the points carry, uncleaned; None if they carry none."""

    def close(self) -> None:
        """Close the file."""

    def __enter__(self) -> Self: ...

    def __exit__(self, *fault: object) -> None: ...


@contextmanager
def decoder_errors(action: str) -> Iterator[None]:
    """Turn whatever a decoder or plug-in raises into ScanError, or into NotReadyError if it is transient.

    Without memory or threads it becomes InconclusiveError: a corrupt file asks for too much, a good one finds
    a busy machine. Decoders written in Rust panic past `except Exception`, hence BaseException.
    """
    try:
        yield
    except (StationError, KeyboardInterrupt, SystemExit, GeneratorExit):
        raise
    except BaseException as error:
        if isinstance(error, OSError) and error.errno in TRANSIENT_ERRNOS:
            raise NotReadyError(f"{action}: {error.strerror}") from error
        kind = InconclusiveError if _lacks_resources(error) else ScanError
        raise kind(f"{action}: {type(error).__name__}: {error}") from error


def _lacks_resources(error: BaseException) -> bool:
    """Return True if a decoder failed for want of memory, tasks or another resource of the machine."""
    if isinstance(error, MemoryError) or "can't start new thread" in str(error):
        return True
    match = _RUST_OS_ERROR.search(str(error))
    return match is not None and int(match[1]) in TRANSIENT_ERRNOS


@functools.cache
def _readers() -> dict[str, type[ScanReader]]:
    """Return the readers by suffix; one that does not load is skipped with a warning."""
    readers: dict[str, type[ScanReader]] = {}
    for entry in sorted(entry_points(group="station.readers"), key=lambda entry: entry.name):
        try:
            with decoder_errors(f"reader {entry.name!r} ({entry.value})"):
                reader: type[ScanReader] = entry.load()
                for suffix in reader.suffixes:
                    readers.setdefault(suffix.lower(), reader)
        except StationError as error:
            log.warning("skipped: %s", error)
    return readers


def suffixes() -> tuple[str, ...]:
    """Return the file name suffixes that can be read, e.g. (".las", ".las.gz", ".laz")."""
    known = _readers()
    return tuple(sorted([*known, *(suffix + COMPRESSED for suffix in known)]))


def open_scan(path: Path, *, range_max_m: float | None = None, columns: Sequence[str] = ()) -> ScanReader:
    """Return the open scan; its suffix selects the reader.

    With `columns`, or a suffix that other files have too, it is text. Raises ScanError if there is no reader
    for it, or if the file is not a valid scan.
    """
    known, suffix = _readers(), path.suffix.lower()
    if TEXT in known and (columns or suffix in TEXT_SUFFIXES):
        with decoder_errors("cannot be opened"):
            return known[TEXT](path, range_max_m=range_max_m, columns=columns)  # type: ignore[call-arg]
    if suffix not in known:
        raise ScanError(f"no reader for {suffix or 'a name without suffix'!r}: {', '.join(sorted(known))}")
    with decoder_errors("cannot be opened"):
        return known[suffix](path, range_max_m=range_max_m)


def continue_week(time_s: Floats, first_s: float) -> Floats:
    """Return GPS seconds of the week (n,) that continue past its end instead of falling back to zero [s].

    `first_s` is the first time stamp of the scan; other time bases are returned as they are.
    """
    low_s = float(time_s.min())
    if not (0 <= low_s < first_s - WEEK_S / 2 and first_s < WEEK_S):
        return time_s
    return np.where(time_s < first_s - WEEK_S / 2, time_s + WEEK_S, time_s)


def require_in_range(xyz_m: Floats, range_max_m: float | None) -> None:
    """Raise ScanError if one of the points (3, n), at least one, is beyond the range of the scanner."""
    if range_max_m is None:
        return
    farthest_m = float(np.sqrt((xyz_m**2).sum(axis=0).max()))
    if farthest_m > range_max_m * (1 + RANGE_TOLERANCE):
        raise ScanError(
            f"an echo {farthest_m:,.0f} m away, beyond scanner.range_max_m = {range_max_m:g}:"
            " corrupt, or not of the unit, frame or scanner that the site file states"
        )


def head_track(time_s: Floats, x_m: Floats, y_m: Floats) -> AzimuthTrack | None:
    """Return the azimuth of the head [rad] by samples of the echoes (k,), in any order.

    None if it does not turn steadily: scanners without scan lines look everywhere at any time.
    """
    time_s, first = np.unique(time_s, return_index=True)
    if len(time_s) < 2:
        return None
    azimuth_rad = np.unwrap(np.arctan2(y_m[first], x_m[first]))
    turned_rad = np.diff(azimuth_rad)
    if abs(turned_rad.sum()) < MIN_TURN * np.abs(turned_rad).sum():
        return None
    return AzimuthTrack(time_s, azimuth_rad)


def _leap_seconds(time_utc: datetime) -> int:
    """Return GPS - UTC [s]."""
    for since, seconds in LEAP_SECONDS:
        if time_utc >= since:
            return seconds
    raise ScanError(
        f"time {time_utc:%Y-%m-%d} is before terrestrial laser scanners: check the clocks and the name"
    )


def gps_seconds(time_utc: datetime) -> float:
    """Seconds of GPS time since its epoch [s]."""
    return (time_utc - GPS_EPOCH).total_seconds() + _leap_seconds(time_utc)


def gps_to_utc(gps_s: float) -> datetime:
    """Return the UTC of seconds since the GPS epoch; raise ScanError if it is out of range."""
    try:
        approximate = GPS_EPOCH + timedelta(seconds=gps_s)
    except OverflowError as error:
        raise ScanError(f"{gps_s:g} s of GPS time is not a date: the time stamps are corrupt") from error
    return approximate - timedelta(
        seconds=_leap_seconds(approximate - timedelta(seconds=_leap_seconds(approximate)))
    )


def detect_time_base(
    first_s: float, last_s: float, start_utc: datetime | None, *, standard: bool
) -> TimeBase:
    """Return the time base of time stamps from `first_s` to `last_s`.

    `start_utc` is the start in the file name. `standard` is the header's flag, which is trusted only as far
    as the numbers allow, because writers leave scanner seconds under either flag. Week seconds differ from
    scanner seconds only if the start is known; otherwise they are taken for scanner seconds.
    """
    if first_s == last_s == 0:
        return TimeBase.NONE
    if start_utc is not None:
        start_gps_s = gps_seconds(start_utc)
        if abs(first_s + STANDARD_OFFSET_S - start_gps_s) < 86_400:
            return TimeBase.STANDARD
        difference_s = (first_s - start_gps_s + WEEK_S / 2) % WEEK_S - WEEK_S / 2
        if 0 <= first_s < WEEK_S and abs(difference_s) < MAX_CLOCK_DIFFERENCE_S:
            return TimeBase.WEEK
    # No scanner stays on for three years (1e8 s), and hardly any for 116 days (1e7 s).
    if abs(first_s) >= (1e7 if standard else 1e8):
        return TimeBase.STANDARD
    return TimeBase.SCANNER


def scan_start(
    name: str,
    pattern: str,
    times_s: tuple[float, float] | None = None,
    *,
    standard: bool = False,
    stated_utc: datetime | None = None,
) -> datetime:
    """Return the start of a scan (UTC): from its name by the pattern, else from standard GPS time.

    A name that states only the hour or the day leaves the rest to the GPS times.
    `stated_utc` is the start that the file states, used if neither contains one. Raises ScanError if there is
    none, or if name and GPS time contradict each other.
    """
    name_start = start_in_name(name, pattern)
    if times_s is None or detect_time_base(*times_s, name_start, standard=standard) is not TimeBase.STANDARD:
        if name_start is None and stated_utc is not None:
            return stated_utc
        if name_start is None:
            raise ScanError(
                f"start unknown: the name does not match scans.name = {pattern!r}"
                " and the points carry no absolute time: its start must be in its name"
            )
        return name_start
    gps_start = gps_to_utc(times_s[0] + STANDARD_OFFSET_S)
    if name_start is None:
        return gps_start
    difference_s = (name_start - gps_start).total_seconds()
    exact_s = resolution_s(pattern)
    if exact_s > MAX_CLOCK_DIFFERENCE_S and -exact_s < difference_s <= 0:
        return gps_start
    if abs(difference_s) > MAX_CLOCK_DIFFERENCE_S:
        repeated = start_in_name(name, pattern, fold=1)  # as summer time ends, the same names come again
        if repeated is not None and abs((repeated - gps_start).total_seconds()) < MAX_CLOCK_DIFFERENCE_S:
            return repeated
        hours = round(difference_s / 3600)
        is_local = hours and abs(difference_s - hours * 3600) < MAX_CLOCK_DIFFERENCE_S and abs(hours) <= 14
        raise ScanError(
            f"the name says {name_start:%Y-%m-%d %H:%M:%S}, the GPS times {gps_start:%Y-%m-%d %H:%M:%S} UTC: "
            + (f"is the name in local time (UTC{hours:+d} h)?" if is_local else "check the scanner's clock")
        )
    return name_start


def reject_future(start: datetime, now_s: float) -> None:
    """Raise NotReadyError if a scan begins in the future: a clock or the time zone of its name is wrong."""
    ahead_s = start.timestamp() - now_s
    if ahead_s > MAX_CLOCK_DIFFERENCE_S:
        raise NotReadyError(
            f"begins at {start:%Y-%m-%d %H:%M:%S} UTC, {timedelta(seconds=round(ahead_s))} ahead of this"
            " computer's clock: postponed until then; is one of the clocks wrong, or its name in local time?"
        )


def utc_interval(reader: ScanReader, pattern: str, name: str = "") -> tuple[datetime, datetime, TimeBase]:
    """Return start and end of a scan (UTC) and its time base; end = start if it has no time stamps.

    The start is that in the name, by default that of the file, if any; the duration is from the time stamps.
    Raises as `scan_start`.
    """
    times_s = reader.time_range_s()
    header = reader.header
    start = scan_start(
        name or reader.path.name, pattern, times_s, standard=header.standard_time, stated_utc=header.start_utc
    )
    if times_s is None:
        return start, start, TimeBase.NONE
    time_base = detect_time_base(*times_s, start, standard=header.standard_time)
    try:
        return start, start + timedelta(seconds=times_s[1] - times_s[0]), time_base
    except OverflowError as error:
        raise ScanError(
            f"time stamps from {times_s[0]:g} to {times_s[1]:g} s: no scan lasts so long: they are corrupt"
        ) from error
