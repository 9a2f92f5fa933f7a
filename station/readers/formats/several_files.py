"""Several files of one scan, such as its tiles, read as one."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import ClassVar, Self

import numpy as np

from station.quantities import AzimuthTrack, InclinationLog, IntensityScale, Shots
from station.readers.scan import MAX_SCAN_S, ScanHeader, ScanReader, head_track
from station.science.geometry.inclination import joined

MAX_TURN_RAD = 2.2 * np.pi  # of the head in one scan: a full circle and some overlap


class SeveralFiles:
    """Open files of one scan, on one clock and in one frame, as one scan (see `ScanReader`)."""

    suffixes: ClassVar[tuple[str, ...]] = ()

    def __init__(self, readers: Sequence[ScanReader]) -> None:
        self._readers = tuple(readers)
        self.path = self._readers[0].path
        headers = [reader.header for reader in self._readers]
        low_m = np.min([header.low_m for header in headers], axis=0).tolist()
        high_m = np.max([header.high_m for header in headers], axis=0).tolist()
        self.header = ScanHeader(
            point_count=sum(header.point_count for header in headers),
            low_m=(low_m[0], low_m[1], low_m[2]),
            high_m=(high_m[0], high_m[1], high_m[2]),
            has_time=all(header.has_time for header in headers),
            standard_time=all(header.standard_time for header in headers),
            crs_wkt=headers[0].crs_wkt,
            start_utc=min((header.start_utc for header in headers if header.start_utc), default=None),
            has_inclination=any(header.has_inclination for header in headers),
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *fault: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the files."""
        for reader in self._readers:
            reader.close()

    def blocks(self, size: int = 50_000, *, intensity: IntensityScale = "auto") -> Iterator[Shots]:
        """Yield the echoes of the ground of one file after the other; raises as the readers do."""
        for reader in self._readers:
            yield from reader.blocks(size, intensity=intensity)

    def time_range_s(self) -> tuple[float, float] | None:
        """Return the earliest and latest time stamp [s]; None if one of the files has none."""
        ranges = [reader.time_range_s() for reader in self._readers]
        known = [bounds for bounds in ranges if bounds is not None]
        if len(known) < len(ranges):
            return None
        return min(first for first, _ in known), max(last for _, last in known)

    def azimuth_track(self) -> AzimuthTrack | None:
        """Return the azimuth of the head over time, from that of the files.

        None if it is unknown for one of them, or if together they are no single turn of the head.
        """
        tracks = [reader.azimuth_track() for reader in self._readers]
        known = [track for track in tracks if track is not None]
        if len(known) < len(tracks):
            return None
        time_s = np.concatenate([track.time_s for track in known])
        azimuth_rad = np.concatenate([track.azimuth_rad for track in known])
        track = head_track(time_s, np.cos(azimuth_rad), np.sin(azimuth_rad))
        if track is None or np.ptp(track.time_s) > MAX_SCAN_S or np.ptp(track.azimuth_rad) > MAX_TURN_RAD:
            return None
        return track

    def inclination(self) -> InclinationLog | None:
        """Return the inclination that the points of the files carry; None if they carry none."""
        logs = [log for reader in self._readers if (log := reader.inclination()) is not None]
        return joined(logs) if logs else None


def as_one(readers: Sequence[ScanReader]) -> ScanReader:
    """Return the open files of one scan as one reader: the only one, or one of all of them."""
    return readers[0] if len(readers) == 1 else SeveralFiles(readers)
