"""Events over time: what later scans show at the same place is one event. Source: equations.md, 6.11."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from station.quantities import Bools, Floats
from station.science.time_series.events import BEFORE, WIDESPREAD_SHARE, Region, distance_blocks, overlaps

REST_SCANS = 3  # an event that so many scans no longer show has come to rest
GROWN = 1.2  # factor of the volume by which an event has grown
EDGE_DEPTH = 1.5  # of the depth of widespread loss: an event of its own is deeper
PAIR_M = 500.0  # farthest distance of a deposit from its scar


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
    depth_m: float  # mean of the change then
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
        if self.widespread and not self.front:
            return self.spreads_to(region.blocks, abs(region.mean_m))
        return overlaps(self.blocks, region.blocks)

    def spreads_to(self, blocks: Bools, depth_m: float) -> bool:
        """Return True if a local loss is the edge of this widespread one: beside it, and not much deeper."""
        is_edge = self.widespread and self.sign < 0 and depth_m < EDGE_DEPTH * self.depth_m
        return is_edge and overlaps(self.blocks, blocks)

    def has_reached(self, other: Track, scan: int) -> bool:
        """Return True if another event turns out to be part of this one, which spread over its ground.

        A local loss may have come to rest, but not before the scans that this one was compared with.
        """
        if other.sign != self.sign:
            return False
        if other.widespread:
            return self.front and other.is_open(scan)
        return scan - other.last <= BEFORE and self.spreads_to(other.blocks, other.depth_m)

    def add(self, region: Region, scan: int, many: float) -> None:
        """Add a region; the event has grown if its volume is a fifth above the largest so far.

        With more than `many` blocks it is widespread: a front has passed over them.
        """
        size = abs(region.mean_m) * float(np.count_nonzero(region.blocks))
        if size > self.largest:
            self.grew = scan if size > GROWN * self.largest else self.grew
            self.largest, self.depth_m = size, abs(region.mean_m)
        self.last, self.blocks = scan, self.blocks | region.blocks
        if not self.widespread and np.count_nonzero(self.blocks) > many:
            self.widespread = self.front = True
        self.sigmas = max(self.sigmas, region.sigmas)

    def join(self, other: Track) -> None:
        """Add another event, which turned out to be the same."""
        self.first, self.lag = min((self.first, self.lag), (other.first, other.lag))
        self.blocks, self.widespread = self.blocks | other.blocks, self.widespread or other.widespread


def track_events(detections: Iterable[tuple[int, list[Region]]], observed: int) -> list[Track]:
    """Return the events of the regions detected at each scan, in order of time, the oldest first.

    A region that touches several events joins them to one. `observed` is the number of observed blocks.
    """
    tracks: list[Track] = []
    for scan, regions in detections:
        for region in regions:
            same = [track for track in tracks if track.is_same(region, scan)]
            if same:
                same[0].add(region, scan, WIDESPREAD_SHARE * observed)
            else:
                tracks.append(_track_of(region, scan))
            track = same[0] if same else tracks[-1]
            for other in tracks.copy():
                if other is not track and (other in same or track.has_reached(other, scan)):
                    track.join(other)
                    tracks.remove(other)
    return sorted(tracks, key=lambda track: track.first)


def _track_of(region: Region, scan: int) -> Track:
    """Return the event of a region that a scan confirms first."""
    depth_m = abs(region.mean_m)
    return Track(
        scan, scan, scan, region.blocks, region.sign, region.widespread, region.sigmas,
        depth_m * float(np.count_nonzero(region.blocks)), depth_m, region.lag,
    )  # fmt: skip


def pair_tracks(tracks: list[Track], elevation_m: Floats, block_m: float) -> Mapping[int, int]:
    """Return the partner of each event that has one, both ways, as positions in `tracks`.

    A deposit belongs to the largest scar above it that appeared with it, within a scan, and not far away.
    `elevation_m` (by, bx) is that of the reference surface, `block_m` the edge of a block.
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
        if distance_blocks(tracks[scar].blocks, tracks[deposit].blocks) * block_m <= PAIR_M:
            partners |= {scar: deposit, deposit: scar}
    return partners
