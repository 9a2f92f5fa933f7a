"""What a scan reader is, which there are, and when a scan was made.

A format plugs in through the entry point group `station.readers`: name -> a class that keeps `ScanReader`.
"""

from __future__ import annotations

import errno
import functools
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from enum import Enum
from importlib.metadata import entry_points
from pathlib import Path
from typing import ClassVar, Protocol, Self

from station.errors import NotReadyError, ScanError, StationError
from station.quantities import HeadTrack, Shots

log = logging.getLogger(__name__)

GPS_EPOCH = datetime(1980, 1, 6, tzinfo=UTC)  # IS-GPS-200, 3.3.4
WEEK_S = 604_800.0
STANDARD_OFFSET_S = 1e9  # "adjusted standard GPS time" is GPS seconds less this: LAS 1.4 R15, table 4
# GPS - UTC from each date on. Source: IERS Bulletin C (leap-seconds.list); none has been announced since.
LEAP_SECONDS = (
    (datetime(2017, 1, 1, tzinfo=UTC), 18),
    (datetime(2015, 7, 1, tzinfo=UTC), 17),
    (datetime(2012, 7, 1, tzinfo=UTC), 16),
    (datetime(2009, 1, 1, tzinfo=UTC), 15),
    (datetime(2006, 1, 1, tzinfo=UTC), 14),
    (datetime(1999, 1, 1, tzinfo=UTC), 13),
)
# Faults of the disk or of rights pass; a seek to nowhere (EINVAL) is the file's own fault.
PASSING = {errno.EACCES, errno.EPERM, errno.ENOENT, errno.EIO, errno.ESTALE, errno.ETIMEDOUT, errno.EMFILE}
CLOCKS_AGREE_S = 900.0  # the name of a scan and its GPS times; real names are up to minutes early


class TimeKind(Enum):
    """What the time stamps of a scan count."""

    NONE = "none"
    SCANNER = "scanner"  # seconds since the scanner was switched on
    WEEK = "week"  # GPS seconds of the week
    STANDARD = "standard"  # GPS seconds less 1e9


@dataclass(frozen=True)
class ScanHeader:
    """What a scan says of itself; checked against the file, not yet against its points."""

    point_count: int
    low_m: tuple[float, float, float]
    high_m: tuple[float, float, float]
    has_time: bool  # there is a field for it; `time_range_s` tells whether anything is in it
    standard_time: bool  # the flag for adjusted standard GPS time, which not every writer sets rightly
    crs_wkt: str | None  # None where it says none, or none that can be understood
    software: str


class ScanReader(Protocol):
    """One scan, open for reading.

    Opening checks what can be known without decoding. Whatever is wrong with the file leaves as ScanError, at
    opening or from any method; NotReadyError where the disk or its rights fail or the file has just changed.
    """

    suffixes: ClassVar[tuple[str, ...]]  # lower case, with the dot
    path: Path
    header: ScanHeader

    def __init__(self, path: Path, *, range_max_m: float | None = None) -> None:
        """Open; `range_max_m` is given for a scan in the scanner's frame, where no echo can be farther."""

    def blocks(self, size: int = 50_000, *, brightness: bool = True) -> Iterator[Shots]:
        """Give all echoes in the order of the file, `size` at a time; `brightness` only if asked for."""

    def time_range_s(self) -> tuple[float, float] | None:
        """Give the earliest and latest time stamp [s], from samples; None where there are none."""

    def head_track(self) -> HeadTrack | None:
        """Give where the head looked when, from samples; None where it cannot be told."""

    def close(self) -> None:
        """Let the file go."""

    def __enter__(self) -> Self: ...

    def __exit__(self, *fault: object) -> None: ...


@contextmanager
def foreign_code(doing: str) -> Iterator[None]:
    """Turn all that a decoder or plug-in may raise into ScanError, or NotReadyError if it may pass.

    Decoders written in Rust panic past `except Exception`, hence BaseException.
    """
    try:
        yield
    except (StationError, KeyboardInterrupt, SystemExit, GeneratorExit):
        raise
    except BaseException as error:
        if isinstance(error, OSError) and error.errno in PASSING:
            raise NotReadyError(f"{doing}: {error.strerror}") from error
        raise ScanError(f"{doing}: {type(error).__name__}: {error}") from error


@functools.cache
def _readers() -> dict[str, type[ScanReader]]:
    """Return every reader by suffix; one that does not load is left out with a warning."""
    found: dict[str, type[ScanReader]] = {}
    for entry in sorted(entry_points(group="station.readers"), key=lambda entry: entry.name):
        try:
            with foreign_code(f"reader {entry.name!r} ({entry.value})"):
                reader: type[ScanReader] = entry.load()
                for suffix in reader.suffixes:
                    found.setdefault(suffix.lower(), reader)
        except StationError as error:
            log.warning("left out: %s", error)
    return found


def suffixes() -> tuple[str, ...]:
    """Return the file name endings that can be read, e.g. (".las", ".laz")."""
    return tuple(sorted(_readers()))


def open_scan(path: Path, *, range_max_m: float | None = None) -> ScanReader:
    """Open a scan with the reader its suffix asks for.

    Raises ScanError where there is none for it, or where the file is not a sound scan.
    """
    reader = _readers().get(path.suffix.lower())
    if reader is None:
        raise ScanError(f"no reader for {path.suffix or 'a name without suffix'!r}: {', '.join(suffixes())}")
    with foreign_code("cannot be opened"):
        return reader(path, range_max_m=range_max_m)


def _leap_seconds(when: datetime) -> int:
    """Return GPS - UTC [s]."""
    for since, seconds in LEAP_SECONDS:
        if when >= since:
            return seconds
    raise ScanError(
        f"time {when:%Y-%m-%d} is before terrestrial laser scanners: check the clocks and the name"
    )


def gps_seconds(when: datetime) -> float:
    """Seconds of GPS time since its epoch [s]."""
    return (when - GPS_EPOCH).total_seconds() + _leap_seconds(when)


def gps_to_utc(gps_s: float) -> datetime:
    """Return the UTC of seconds since the GPS epoch; raises ScanError where that is no date."""
    try:
        near = GPS_EPOCH + timedelta(seconds=gps_s)
    except OverflowError as error:
        raise ScanError(f"{gps_s:g} s of GPS time is no date: the time stamps are corrupt") from error
    return near - timedelta(seconds=_leap_seconds(near - timedelta(seconds=_leap_seconds(near))))


def time_kind(first_s: float, last_s: float, start_utc: datetime | None, *, standard: bool) -> TimeKind:
    """Tell what time stamps from `first_s` to `last_s` count.

    `start_utc` is what the name says, `standard` the header's flag, which is believed only as far as the
    numbers allow: writers leave scanner seconds under either flag. Week seconds can be told from scanner
    seconds only where the start is known; else they pass for scanner seconds.
    """
    if first_s == last_s == 0:
        return TimeKind.NONE
    if start_utc is not None:
        start_gps_s = gps_seconds(start_utc)
        if abs(first_s + STANDARD_OFFSET_S - start_gps_s) < 86_400:
            return TimeKind.STANDARD
        into_week_s = (first_s - start_gps_s + WEEK_S / 2) % WEEK_S - WEEK_S / 2
        if 0 <= first_s < WEEK_S and abs(into_week_s) < CLOCKS_AGREE_S:
            return TimeKind.WEEK
    # No scanner stays on for three years (1e8 s), hardly one for 116 days (1e7 s).
    if abs(first_s) >= (1e7 if standard else 1e8):
        return TimeKind.STANDARD
    return TimeKind.SCANNER


def _start_in_name(path: Path, pattern: str) -> datetime | None:
    try:
        start = datetime.strptime(path.stem, pattern)  # noqa: DTZ007 - a pattern may hold a zone
    except ValueError:
        return None
    return start.astimezone(UTC) if start.tzinfo else start.replace(tzinfo=UTC)


def scan_start(
    path: Path, pattern: str, times_s: tuple[float, float] | None = None, *, standard: bool = False
) -> datetime:
    """Return when the scan began (UTC): from its name by the strptime pattern, else from standard GPS time.

    Raises ScanError where neither tells, or where they contradict each other.
    """
    named = _start_in_name(path, pattern)
    if times_s is None or time_kind(*times_s, named, standard=standard) is not TimeKind.STANDARD:
        if named is None:
            raise ScanError(
                f"start unknown: the name does not match scans.name = {pattern!r}"
                " and the points carry no absolute time"
            )
        return named
    measured = gps_to_utc(times_s[0] + STANDARD_OFFSET_S)
    if named is None:
        return measured
    off_s = (named - measured).total_seconds()
    if abs(off_s) > CLOCKS_AGREE_S:
        hours = round(off_s / 3600)
        local = hours and abs(off_s - hours * 3600) < CLOCKS_AGREE_S and abs(hours) <= 14
        raise ScanError(
            f"the name says {named:%Y-%m-%d %H:%M:%S}, the GPS times {measured:%Y-%m-%d %H:%M:%S} UTC: "
            + (f"is the name in local time (UTC{hours:+d} h)?" if local else "check the scanner's clock")
        )
    return named


def require_begun(start: datetime, now_s: float) -> None:
    """Raise NotReadyError where a scan begins in the future: then a clock is wrong, or its name's zone."""
    ahead_s = start.timestamp() - now_s
    if ahead_s > CLOCKS_AGREE_S:
        raise NotReadyError(
            f"begins at {start:%Y-%m-%d %H:%M:%S} UTC, {timedelta(seconds=round(ahead_s))} ahead of this"
            " computer's clock: held back until then; is one of the clocks wrong, or its name in local time?"
        )


def utc_interval(reader: ScanReader, pattern: str) -> tuple[datetime, datetime, TimeKind]:
    """Return start and end of a scan (UTC) and what its time stamps count; end = start where none are.

    The name tells the start where it can, the time stamps the duration. Raises as `scan_start`.
    """
    times_s = reader.time_range_s()
    start = scan_start(reader.path, pattern, times_s, standard=reader.header.standard_time)
    if times_s is None:
        return start, start, TimeKind.NONE
    kind = time_kind(*times_s, start, standard=reader.header.standard_time)
    try:
        return start, start + timedelta(seconds=times_s[1] - times_s[0]), kind
    except OverflowError as error:
        raise ScanError(
            f"time stamps from {times_s[0]:g} to {times_s[1]:g} s: no scan lasts so long: they are corrupt"
        ) from error
