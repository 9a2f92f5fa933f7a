"""Events over time: what later scans show at the same place is one event. Source: equations.md, 6.11."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from station.quantities import Bools, Floats
from station.science.time_series.events import WIDESPREAD_SHARE, Region, distance_blocks, overlaps

REST_SCANS = 3  # an event that so many scans no longer show has come to rest
GROWN = 1.2  # factor of the volume by which an event has grown
PAIR_BLOCKS = 50.0  # farthest distance of a deposit from its scar


@dataclass(eq=False)
class Track:
    """An event, as its detections show it; scans are counted along the series."""

    first: int  # scan that confirmed it
    last: int  # newest scan that shows it
    grew: int  # newest scan in which it had grown
    blocks: Bools  # all that ever belonged to it
    sign: int
    widespread: bool
    sigmas: float  # of its most significant window
    largest: float  # sum over its blocks of the change, as detected [m]
    lag: int  # scans between those it was compared with and its first
    front: bool = False  # a local change that spread over much of the ground

    def is_open(self, scan: int) -> bool:
        """Return True if the event has not come to rest at a scan."""
        return scan - self.last < REST_SCANS

    def is_same(self, region: Region, scan: int) -> bool:
        """Return True if a region detected at a scan belongs to this event."""
        if not self.is_open(scan) or self.sign != region.sign:
            return False
        if region.widespread:
            return self.widespread
        return self.front == self.widespread and overlaps(self.blocks, region.blocks)

    def has_reached(self, other: Track, scan: int) -> bool:
        """Return True if this is a front, and the other is what widespread change it was part of."""
        return self.front and other.widespread and other.sign == self.sign and other.is_open(scan)

    def add(self, region: Region, scan: int, many: float) -> None:
        """Add a region; the event has grown if its volume is a fifth above the largest so far.

        With more than `many` blocks it is widespread: a front has passed over them.
        """
        size = abs(region.mean_m) * float(np.count_nonzero(region.blocks))
        if size > GROWN * self.largest:
            self.grew = scan
        self.largest, self.last = max(self.largest, size), scan
        self.blocks = self.blocks | region.blocks
        if not self.widespread and np.count_nonzero(self.blocks) > many:
            self.widespread = self.front = True
        self.sigmas = max(self.sigmas, region.sigmas)


def track_events(detections: Iterable[tuple[int, list[Region]]], observed: int) -> list[Track]:
    """Return the events of the regions detected at each scan, in order of time, the oldest first.

    A region that touches several events joins them to one. `observed` is the number of observed blocks.
    """
    many = WIDESPREAD_SHARE * observed
    tracks: list[Track] = []
    for scan, regions in detections:
        for region in regions:
            same = [track for track in tracks if track.is_same(region, scan)]
            if not same:
                size = abs(region.mean_m) * float(np.count_nonzero(region.blocks))
                tracks.append(
                    Track(
                        scan, scan, scan, region.blocks, region.sign, region.widespread, region.sigmas, size,
                        region.lag,
                    )
                )  # fmt: skip
                continue
            track = same[0]
            track.add(region, scan, many)
            for other in tracks.copy():
                if other is not track and (other in same or track.has_reached(other, scan)):
                    track.blocks = track.blocks | other.blocks
                    tracks.remove(other)
    return tracks


def pair_tracks(tracks: list[Track], elevation_m: Floats) -> Mapping[int, int]:
    """Return the partner of each event that has one, both ways, as positions in `tracks`.

    A deposit belongs to the largest scar above it that appeared with it, within a scan, and not far away.
    `elevation_m` (by, bx) are the blocks of the reference surface.
    """
    mean_m = [float(np.nanmean(elevation_m[track.blocks])) for track in tracks]
    candidates = sorted(
        (-min(tracks[scar].largest, tracks[deposit].largest), scar, deposit)
        for scar in range(len(tracks)) for deposit in range(len(tracks))
        if tracks[scar].sign < 0 < tracks[deposit].sign
        and not tracks[scar].widespread and not tracks[deposit].widespread
        and abs(tracks[scar].first - tracks[deposit].first) <= 1 and mean_m[scar] > mean_m[deposit]
    )  # fmt: skip
    partners: dict[int, int] = {}
    for _, scar, deposit in candidates:
        if scar in partners or deposit in partners:
            continue
        if distance_blocks(tracks[scar].blocks, tracks[deposit].blocks) <= PAIR_BLOCKS:
            partners |= {scar: deposit, deposit: scar}
    return partners
