"""Events of a store: regions in each scan, volumes with σ, and the table. Source: equations.md, 6.11."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import lru_cache
from typing import Any

import h5py
import numpy as np
import shapely

from station.archive.derived.computed_rasters import CHANGE, RANDOM
from station.archive.derived.event_table import (
    KEY_LENGTH,
    Event,
    Found,
    decode_blocks,
    encode_blocks,
    outline,
    read_found,
    write_events,
    write_found,
)
from station.archive.epochs import EpochRef
from station.archive.netcdf_layout import Series
from station.archive.series.index import SeriesIndex, references_and_usable
from station.errors import StoreError
from station.quantities import Bools, Floats, Grid, Ints, SharedParameters
from station.queries.block_sums import Sums, block_levels, epoch_sums, precise_levels
from station.queries.blocks import BlockQueries, Blocks
from station.queries.common_errors import common_error_covariance
from station.queries.epoch_cells import EpochCells, EpochReader, read_window
from station.science.time_series import event_errors, event_volumes
from station.science.time_series.event_tracks import Track, pair_tracks, track_events
from station.science.time_series.events import (
    BEFORE,
    BlockLevels,
    Region,
    before_level,
    detect_regions,
    event_thresholds,
)
from station.science.time_series.window_scores import agreement_sigmas

HISTORY = 24  # scans before the two newest, which show how a block scatters
LEAST_HISTORY = 8
YEAR_S = 365.25 * 86_400
CACHED_EPOCHS = 5  # whose shared parameters are in memory
RETAINED_SIGMA = 0.02  # of the share of a change that cells with few points retain (accuracy.md)
LEAST_AGREEMENT = 3.0  # sigma by which the cells of a place must have changed together
SEARCHES_KEPT = 200  # at once: a long search of a whole series can be interrupted


@dataclass(frozen=True)
class _Volume:
    """Volume of an event and its σ."""

    volume_m3: float
    sigma_m3: float


class EventQueries:
    """Search for events in the epochs of a store, in windows of consecutive usable scans of one reference."""

    def __init__(self, series: Series, queries: BlockQueries, expected_every_s: float) -> None:
        self._series, self._queries, self._scans_per_year = series, queries, YEAR_S / expected_every_s
        self._index = SeriesIndex(series)
        self._positions, self._versions = self._usable_epochs()
        self._names = self._index.epoch_file[self._positions]
        self._reader = EpochReader(series)
        self._shared = lru_cache(CACHED_EPOCHS)(self._read_shared)
        self._levels = lru_cache(HISTORY + 2)(self._read_levels)
        self._found = read_found(series)
        self._used: dict[str, Any] = {}  # of what was found, what is still of these epochs

    def _usable_epochs(self) -> tuple[Ints, np.ndarray[Any, Any]]:
        """Return the positions and the reference versions (n,) of the usable epochs that have one."""
        if not len(self._index):
            return np.empty(0, np.int64), np.empty(0, "S1")
        versions, usable = references_and_usable(self._series)
        positions = np.flatnonzero((versions != b"") & usable)
        return positions, versions[positions]

    def _epoch(self, scan: int) -> EpochRef:
        return self._index[int(self._positions[scan])]

    def _version(self, scan: int) -> str:
        return str(self._versions[scan].decode())

    @property
    def grid(self) -> Grid:
        """Grid of the blocks; those at the east and south edges may extend beyond the cells."""
        grid, cells = self._series.grid, self._queries.cells
        return replace(grid, cell_m=grid.cell_m * cells, nx=-(-grid.nx // cells), ny=-(-grid.ny // cells))

    def update(self, progress: Callable[[], None]) -> set[str]:
        """Bring the table up to date; return the epochs whose sums the next scan will need.

        While a reference is damaged, which stops no scan that is measured from another, the table remains as
        it is. Raises StoreError if an epoch is damaged or the table cannot be written.
        """
        if not len(self._names):
            return set()
        try:
            return self._update(progress)
        except StoreError:
            if all(self._is_readable(version.decode()) for version in np.unique(self._versions).tolist()):
                raise
            return set()

    def _is_readable(self, version: str) -> bool:
        try:
            self._queries.reference_blocks(version)
        except StoreError:
            return False
        return True

    def _update(self, progress: Callable[[], None]) -> set[str]:
        keys = self._unchanged_keys()
        known = self._queries.reference_blocks(self._version(-1))["known"] > 0
        tracks = track_events(self._detections(keys, progress), int(np.count_nonzero(known)))
        write_events(self._series, self._events(tracks))
        self._keep(keys)
        newest = len(self._names) - 1
        needed = set(range(newest - HISTORY, newest + 1))
        for track in tracks:
            if track.is_open(newest):
                needed.update(self._window(track.first))
        return {self._names[number].decode() for number in needed if number >= 0}

    def _unchanged_keys(self) -> list[str]:
        """Return the keys of the windows that were searched, if no scan came between theirs; else none."""
        keys = self._found.keys
        return keys.copy() if self._hash_of_scans(len(keys)) == self._found.scans else []

    def _hash_of_scans(self, count: int) -> str:
        """Return a hash of the first scans and of all else that the keys of their windows depend on."""
        rate = f"{self._scans_per_year:.6g}".encode()
        return hashlib.sha256(
            rate + self._names[:count].tobytes() + self._versions[:count].tobytes()
        ).hexdigest()

    def _detections(
        self, keys: list[str], progress: Callable[[], None]
    ) -> Iterator[tuple[int, list[Region]]]:
        """Yield the scans that show regions, with these; add the keys of the other windows to `keys`."""
        known, searched = self._found.values, set(self._found.keys)
        for scan, key in enumerate(keys):
            if key in known:
                self._used[key] = known[key]
                yield scan, self._regions(key)
        unkept = 0
        for scan in range(len(keys), len(self._names)):
            window = self._window(scan)
            key = self._key("regions", window)
            if key in known:
                self._used[key] = known[key]
            elif key not in searched and len(window) >= LEAST_HISTORY + 2:
                if found := self._search(window, progress):
                    self._used[key] = found
                unkept += 1
            keys.append(key)
            if unkept == SEARCHES_KEPT:
                self._keep(keys)
                unkept = 0
            yield scan, self._regions(key)

    def _regions(self, key: str) -> list[Region]:
        found = self._used.get(key, [])
        return [Region(decode_blocks(blocks, self.grid.shape), *values) for blocks, *values in found]

    def _keep(self, keys: list[str]) -> None:
        """Keep what was found, unless it is kept already."""
        found = Found(self._hash_of_scans(len(keys)), keys, self._used)
        if found != self._found:
            write_found(self._series, found)

    def _window(self, scan: int) -> range:
        """Return the scans up to this one that are compared: as long as the reference is the same."""
        first = max(scan - HISTORY - 1, 0)
        while self._versions[first] != self._versions[scan]:
            first += 1
        return range(first, scan + 1)

    def _key(self, kind: str, scans: Sequence[int], *texts: str) -> str:
        names = [self._names[scan].decode() for scan in scans]
        parts = [kind, f"{self._scans_per_year:.6g}", self._version(scans[-1]), *names, *texts]
        return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:KEY_LENGTH]

    def _read_levels(self, scan: int) -> BlockLevels:
        """Return the levels of a scan: of its sums alone, which is all that most scans of a window need."""
        return precise_levels(*self._sums(scan))

    def _sums(self, scan: int) -> tuple[Sums, Sums]:
        """Return the sums of a scan and of its reference."""
        is_needed_again = scan >= len(self._names) - 1 - HISTORY
        sums = epoch_sums(self._series, self._epoch(scan), keep=is_needed_again)
        return sums, self._queries.reference_blocks(self._version(scan))

    def _read_shared(self, scan: int) -> EpochCells:
        return self._reader.read_shared(self._epoch(scan))

    def _search(self, window: range, progress: Callable[[], None]) -> list[list[Any]]:
        """Return the regions that the two newest scans of a window show: encoded blocks, and the rest."""
        *history, first, second = window
        newest = self._queries.read(self._epoch(second))
        errors = _systematic_errors(newest)
        old, new = self._shared(history[min(BEFORE, len(history)) - 1]), self._shared(history[-1])
        known = self._queries.reference_blocks(self._version(second))["known"] > 0
        regions = detect_regions(
            [self._levels(scan) for scan in history],
            [self._levels(scan) for scan in (first, second)],
            [
                errors.of_scan(*(_difference(self._shared(scan), before) for before in (new, old)))
                for scan in (first, second)
            ],
            newest.rock > 0.5,
            event_thresholds(int(np.count_nonzero(known)), self._scans_per_year),
        )
        progress()
        return [
            [
                encode_blocks(region.blocks),
                region.sign,
                region.widespread,
                round(region.mean_m, 6),
                round(region.sigmas, 3),
                region.lag,
            ]
            for region in regions
            if self._changed_together(region, window)
        ]

    def _changed_together(self, region: Region, scans: range) -> bool:
        """Return True if the cells of a local region changed together, in the two newest of the scans."""
        if region.window is None:
            return True
        cells = self._queries.cells
        rows, columns = (slice(axis.start * cells, axis.stop * cells) for axis in region.window)

        def read(scan: int, name: str) -> Floats:
            epoch = self._epoch(scan)
            with h5py.File(epoch.path, "r") as file:
                return read_window(file, name, epoch.index, (rows, columns)).ravel()

        change_m = np.stack([read(scan, CHANGE) for scan in scans[-2 - BEFORE :]])
        sigmas = agreement_sigmas(change_m[:-2], change_m[-2:], read(scans[-1], RANDOM), region.around_m)
        return region.sign * sigmas > LEAST_AGREEMENT

    def _events(self, tracks: list[Track]) -> Iterator[tuple[Event, shapely.Geometry]]:
        volumes = []
        for track in tracks:
            others = [
                other.blocks
                for other in tracks
                if other is not track
                and not other.widespread  # it is what is taken off
                and abs(other.first - track.first) <= BEFORE
            ]
            volumes.append(
                self._volume_of(track, np.any(others, axis=0) if others else np.zeros_like(track.blocks))
            )
        surface = self._queries.reference_blocks(self._version(-1))
        with np.errstate(invalid="ignore"):
            surface_m = surface["surface_m"] / surface["known"]
        place_m = self.grid.x_m[None, :], self.grid.y_m[:, None], surface_m
        elevation_m = self.grid.plane.in_map_axes(place_m)[2]
        partners = pair_tracks(tracks, elevation_m, self.grid.cell_m)
        ids = self._ids(tracks)
        for number, (track, volume) in enumerate(zip(tracks, volumes, strict=True)):
            event = self._event(ids[number], track, volume)
            if number in partners:
                other = volumes[partners[number]]
                event = replace(
                    event,
                    kind="paired",
                    partner=ids[partners[number]],
                    balance_m3=round(volume.volume_m3 + other.volume_m3, 2),
                    balance_sigma_m3=round(float(np.hypot(volume.sigma_m3, other.sigma_m3)), 2),
                )
            yield event, outline(track.blocks, self.grid)

    def _ids(self, tracks: list[Track]) -> list[str]:
        """Return the time of the first scan that shows each event, with a number if there are several."""
        ids: list[str] = []
        for track in tracks:
            start = f"{self._epoch(track.first - 1).start:%Y%m%dT%H%M%SZ}"
            ids.append(f"{start}-{1 + sum(name.startswith(start) for name in ids)}")
        return ids

    def _event(self, name: str, track: Track, volume: _Volume) -> Event:
        grid, (row, column) = self.grid, np.nonzero(track.blocks)
        size_m2 = np.count_nonzero(track.blocks) * grid.cell_m**2
        kinds = ("snowfall", "melt_front") if track.widespread else ("gain", "loss")
        newest = len(self._names) - 1
        window = self._window(track.first)
        return Event(
            id=name,
            kind=kinds[0 if track.sign > 0 else 1],
            state="active" if track.is_open(newest) else "closed",
            after=self._time(window[-3 - track.lag]),
            begin=self._time(track.first - 1),
            confirmed=self._time(track.first),
            end=self._time(track.grew - 1 if track.grew == track.first else track.grew),
            east_m=round(float(grid.x_m[column].mean()), 2),
            north_m=round(float(grid.y_m[row].mean()), 2),
            area_m2=round(size_m2, 2),
            volume_m3=round(volume.volume_m3, 2),
            volume_sigma_m3=round(volume.sigma_m3, 2),
            mean_depth_m=round(volume.volume_m3 / size_m2, 4),
            sigmas=round(track.sigmas, 1),
            reference_version=self._version(track.first),
        )

    def _time(self, scan: int) -> str:
        return f"{datetime.fromtimestamp(self._index.time_s[self._positions[scan]], UTC):%Y-%m-%dT%H:%M:%SZ}"

    def _volume_of(self, track: Track, others: Bools) -> _Volume:
        before = self._window(track.first)[: -2 - track.lag][-BEFORE:]
        after = [track.last - 1, track.last]
        texts = encode_blocks(track.blocks), encode_blocks(others)
        key = self._key("volume", [*before, *after], *texts)
        known = self._found.values
        self._used[key] = known[key] if key in known else self._measure(track, others, before, after)
        return _Volume(*self._used[key])

    def _measure(self, track: Track, others: Bools, before: range, after: list[int]) -> list[float]:
        """Return the volume of an event and its σ [m³], from the scans before and after it."""
        newest = self._queries.read(self._epoch(after[-1]))
        levels = [block_levels(*self._sums(scan)) for scan in (*after, *before)]
        level, base = event_volumes.mean_level(*levels[:2]), before_level(levels[2:])
        change_m = np.where(newest.observed, level.change_m - base.change_m, np.nan)
        change = BlockLevels(change_m, level.random_m2 + base.random_m2)
        surface = self._queries.reference_blocks(self._version(after[-1]))["known"] > 0
        parts = event_volumes.volume_parts(track, change, newest.rock > 0.5, others, surface)
        if parts is None:
            return [0.0, 0.0]
        difference = _difference(newest.cells, self._shared(before[-1]))
        variance_m2 = (
            parts.variance_m2
            + _systematic_errors(newest).of_sum(parts.weights, difference)
            + event_errors.sampling_variance(newest.count, self._queries.cells, parts.weights, change_m)
            + (RETAINED_SIGMA * parts.sum_m) ** 2
        )
        block_m2 = self.grid.cell_m**2
        return [round(block_m2 * parts.sum_m, 4), round(block_m2 * float(np.sqrt(variance_m2)), 4)]


def _systematic_errors(blocks: Blocks) -> event_errors.SystematicErrors:
    return event_errors.SystematicErrors(blocks.jacobian, blocks.observed, blocks.rock > 0.5)


def _difference(scan: EpochCells, before: EpochCells) -> SharedParameters | None:
    """Return the shared parameters of the difference of two scans: both errors, less what is common."""
    first, second = scan.shared, before.shared
    if first is None or second is None or first.names != second.names:
        return first if first is None or second is None else first + first
    common = common_error_covariance([scan, before])
    covariance = first.covariance + second.covariance
    if common is not None:
        covariance = covariance - common - common.T
    line_m2 = first.line_tilt_variance + second.line_tilt_variance
    return replace(first, covariance=covariance, line_tilt_variance=line_m2)
