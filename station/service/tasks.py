"""What is done with a scan, from the inbox into the archive: each function runs in a child process.

Its last argument is `progress()`, which tells the parent that it is alive.
"""

from __future__ import annotations

import hashlib
import math
import os
import stat
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from station import __version__
from station.archive import join, store
from station.archive.aggregate import Aggregates
from station.archive.areas import update_areas
from station.archive.layout import Series
from station.archive.reference import read_reference, write_reference
from station.archive.series import build_series
from station.config import Site
from station.errors import NotReadyError, ScanError, StoreError
from station.pipeline import (
    Told,
    corrections,
    gridder_for,
    level,
    measure,
    stable_figures,
    survey,
)
from station.quantities import Bools, Habits, Measurement, Quality, Reference
from station.readers.polygons import mask, read_polygons
from station.readers.raster import read_geotiff
from station.readers.scan import ScanReader, open_scan, utc_interval
from station.science import ground, verdict
from station.science.adjustment import Adjustment
from station.science.grid import Gridder, Stack
from station.science.master import improved, master
from station.science.prior import learned
from station.science.terrain import nodes_for
from station.service.gather import Gathered, gather
from station.service.inbox import Arrival

Progress = Callable[[], None]
MOST_REFUSED = 0.6  # of the stable ground; then the filtered log alone is safer
MOST_SOURCES = 400  # of the series: past the limit of open files some readers return wrong data
REFERENCE_PASSES = 3  # a third improves the second by a tenth, a fourth the third by nothing measurable


@dataclass(frozen=True)
class Outcome:
    """What became of a scan that was stored."""

    start_utc_s: float
    sha256: str
    epoch: str  # relative to the data folder
    revision: int
    verdict: str
    reason: str
    reference: str | None
    figures: dict[str, float | str]


def series_of(site: Site) -> Series:
    """Return the store of a site."""
    return Series(
        folder=site.station.data,
        station_id=site.station.id,
        grid=site.grid_cells,
        crs=site.map.crs,
        vertical_datum=site.map.vertical_datum,
        name=site.station.name,
        institution=site.station.institution,
    )


def process(
    site: Site,
    arrival: Arrival,
    progress: Progress,
    *,
    patient: bool = False,
) -> Outcome:
    """Measure a scan and store its epoch, unless just this is stored.

    Raises ScanError where the scan cannot be used; NotReadyError where it changes meanwhile, or `patient` and
    still without weather shortly after its arrival.
    """
    began_s = time.monotonic()
    series = series_of(site)
    with _held_still(arrival.path) as scan_sha256:
        progress()
        wait_s = site.weather.wait_s if patient and site.weather else 0.0
        young = time.time() - arrival.mtime_ns * 1e-9 < wait_s
        epoch = _measure(site, arrival, scan_sha256, progress, rehearsal=False, wait_for_weather=young)
    written = _same_as(series, epoch) or store.write_epoch(series, epoch)
    return Outcome(
        start_utc_s=epoch.start_s,
        sha256=scan_sha256,
        epoch=str(written.path.relative_to(series.folder)),
        revision=written.revision,
        verdict=epoch.verdict,
        reason=epoch.verdict_reason,
        reference=epoch.provenance["reference_version"] or None,
        figures=_figures(epoch, time.monotonic() - began_s),
    )


def process_patiently(site: Site, arrival: Arrival, progress: Progress) -> Outcome:
    """Process a scan that may wait a while for its weather."""
    return process(site, arrival, progress, patient=True)


def open_only(site: Site, arrival: Arrival, progress: Progress) -> None:
    """Raise ScanError where a scan's headers say that it cannot be used."""
    progress()
    with _opened(site, arrival.path) as reader:
        utc_interval(reader, site.scans.name)


def rehearse(site: Site, arrival: Arrival, progress: Progress) -> tuple[str, str, dict[str, float | str]]:
    """Measure a scan without storing anything: verdict, reason, figures."""
    began_s = time.monotonic()
    epoch = _measure(site, arrival, "", progress, rehearsal=True, wait_for_weather=False)
    return epoch.verdict, epoch.verdict_reason, _figures(epoch, time.monotonic() - began_s)


def _measure(
    site: Site,
    arrival: Arrival,
    scan_sha256: str,
    progress: Progress,
    *,
    rehearsal: bool,
    wait_for_weather: bool,
) -> store.Epoch:
    with _opened(site, arrival.path) as reader:
        start, end, _ = utc_interval(reader, site.scans.name)
        gathered = gather(
            site,
            reader,
            arrival.log,
            start,
            end,
            keep_zero=not rehearsal,
            wait_for_weather=wait_for_weather,
        )
        reference = None if rehearsal and isinstance(site.reference.scans, Path) else reference_of(site)
        gridder = gridder_for(gathered.setup, reference)
        survey(gridder, reader.blocks(), gathered.setup, gathered.pose, progress)
    if not gridder.count.any():
        raise ScanError("no point falls on the grid: wrong scans.frame, SOP, CRS or units?")
    progress()
    levelled = _level(site, gridder, gathered, reference)
    unknown, found = gathered.unknown, levelled[1] if levelled else None
    if levelled is not None:
        if levelled[1].refused > MOST_REFUSED:
            levelled = None
        else:
            unknown = levelled[1].shared()
    measured = measure(gridder, gathered.setup, unknown, reference, levelled)
    progress()
    numbers = _numbers(measured, gathered, reader.header.point_count, levelled)
    word, reason = verdict.judge(
        gathered.lacking,
        measured,
        reference,
        (gathered.setup.position_m, gathered.setup.axis) if gathered.setup.position_m else None,
        found,
        numbers.get("stable_z_std"),
        None if levelled or reference is None else stable_ground(site, reference),
    )
    return store.Epoch(
        start_s=start.timestamp(),
        end_s=end.timestamp(),
        scan_id=arrival.path.stem,
        measurement=measured,
        shared=unknown,
        verdict=word,
        verdict_reason=reason,
        numbers=numbers,
        provenance={
            "scan_sha256": scan_sha256,
            "log_sha256": _sha256(arrival.log) if arrival.log else "",
            "science_hash": site.science_hash,
            "reference_version": reference.version if reference else "",
            "adjustment": "joint" if levelled else "none",
            "software_version": __version__,
            **gathered.provenance,
        },
    )


def _level(
    site: Site, gridder: Gridder, gathered: Gathered, reference: Reference | None
) -> tuple[Told, Adjustment, Bools] | None:
    """Adjust a scan to the reference, where the site asks for it and there is one to adjust to."""
    if not site.adjusts or gathered.told is None or reference is None:
        return None
    stable = stable_ground(site, reference)
    return gathered.told, level(gridder, gathered.setup, gathered.told, reference, stable), stable


def stable_ground(site: Site, reference: Reference) -> Bools:
    """Return which cells (ny, nx) are stable: those inside the owner's polygons, or those found."""
    given = site.adjustment.stable
    return polygons(given, site) if isinstance(given, Path) else reference.stable


def polygons(file: Path, site: Site) -> Bools:
    """Return the cells (ny, nx) inside any of the polygons of a file."""
    inside = np.zeros(site.grid_cells.shape, bool)
    for polygon in read_polygons(file, site.map.crs).values():
        inside |= mask(polygon, site.grid_cells)
    return inside


def _same_as(series: Series, epoch: store.Epoch) -> store.Stored | None:
    """Return the stored epoch of this start if it was made from the same inputs in the same way.

    So a scan whose epoch was written just before the power went is not stored twice.
    """
    held = store.revisions(series, datetime.fromtimestamp(epoch.start_s, UTC))
    if not held:
        return None
    said = store.said(held[-1].path)
    same = all(said.get(key) == value for key, value in epoch.provenance.items() if key in said)
    return held[-1] if same and said.get("scan_id") == epoch.scan_id else None


def build_reference(site: Site, arrivals: list[Arrival], version: str, progress: Progress) -> str:
    """Make the master surface from scans, adjusted together, and store it; return its version.

    Thrice over the scans: their plain means, then twice their residuals to what there is, each scan adjusted
    to it. What the scans show of the station's habits is learned on the way.
    """
    series = series_of(site)
    scan_ids = tuple(arrival.path.stem for arrival in arrivals)
    surface: Reference | None = None
    for _ in range(REFERENCE_PASSES):
        stack = Stack(series.grid)
        laid = [_lay_on(stack, site, arrival, surface, progress) for arrival in arrivals]
        habits = _learned(surface.habits if surface else Habits(), laid)
        unknown = [one.unknown for one, _ in laid]
        surface = master(stack, surface, unknown, laid[0][0].setup.position_m, version, scan_ids, habits)
    if surface is not None:
        write_reference(series, surface)
    return version


def improve_reference(site: Site, arrivals: list[Arrival], version: str, progress: Progress) -> str:
    """Store a version of the reference that knows stable ground and the station's habits from more scans."""
    series = series_of(site)
    base = reference_of(site)
    if base is None:
        raise StoreError(f"{series.folder}: no reference to improve")
    stack = Stack(series.grid)
    laid = [_lay_on(stack, site, arrival, base, progress) for arrival in arrivals]
    habits = _learned(base.habits, laid)
    position_m = laid[0][0].setup.position_m
    if position_m is None:
        raise StoreError(f"{series.folder}: a reference without the scanner's place cannot be improved")
    write_reference(series, improved(base, stack, position_m, version, habits))
    return version


def _learned(habits: Habits, laid: list[tuple[Gathered, Adjustment | None]]) -> Habits:
    """Return what adjusted scans show of the station's habits."""
    found = [
        (g.told.lines, a.estimate, a.covariance) for g, a in laid if g.told is not None and a is not None
    ]
    told = laid[0][0].told
    return habits if told is None else learned(habits, told.of, found)


def _lay_on(
    stack: Stack, site: Site, arrival: Arrival, surface: Reference | None, progress: Progress
) -> tuple[Gathered, Adjustment | None]:
    """Add a scan to a stack, adjusted to the surface there is. Its own grid goes at once."""
    with _opened(site, arrival.path) as reader:
        start, end, _ = utc_interval(reader, site.scans.name)
        gathered = gather(site, reader, arrival.log, start, end)
        gridder = gridder_for(gathered.setup, surface)
        survey(gridder, reader.blocks(), gathered.setup, gathered.pose, progress)
    levelled = _level(site, gridder, gathered, surface)
    correction_m = None
    if levelled is not None and surface is not None:
        correction_m = corrections(gridder, gathered.setup, levelled[0], surface, levelled[1])
    stack.add(gridder, correction_m, surface.roughness_m2 if surface else None)
    progress()
    return gathered, levelled[1] if levelled else None


def reference_of(site: Site) -> Reference | None:
    """Return the master surface; one given as a file is taken into the store at first use."""
    series = series_of(site)
    held = read_reference(series)
    given = site.reference.scans
    if not isinstance(given, Path):
        return held
    version = f"{given.stem}-{_sha256(given)[:8]}"
    if held is None or held.version != version:
        elevation_m = nodes_for(read_geotiff(given, series.grid, series.crs))
        steep = ground.steep(elevation_m, series.grid.cell_m)
        write_reference(series, Reference.given(series.grid, version, elevation_m, steep))
        held = read_reference(series)
    return held


def publish(site: Site, progress: Progress) -> None:
    """Build `series.nc` anew over the epochs that exist, and `areas.nc` after it.

    Epochs are joined first where they are too many files.
    """
    series = series_of(site)
    if len(store.sources(series.path)) > MOST_SOURCES:
        join.join_closed(series, datetime.now(UTC), progress)
    build_series(series)
    progress()
    update_areas(series, areas_of(site), Aggregates(series), progress)


def areas_of(site: Site) -> dict[str, Bools]:
    """Return the cells (ny, nx) of the areas that the site names."""
    if site.areas is None:
        return {}
    found = read_polygons(site.areas.file, site.map.crs)
    return {name: mask(polygon, site.grid_cells) for name, polygon in found.items()}


def join_epochs(site: Site, progress: Progress) -> int:
    """Join closed days and months; return how many files that made."""
    series = series_of(site)
    return join.join_closed(series, datetime.now(UTC), progress) if store.rows(series) else 0


def sweep_store(site: Site, progress: Progress) -> int:
    """Delete what the series has not named for two days; return how many files went."""
    progress()
    return len(join.sweep(series_of(site), datetime.now(UTC)))


@contextmanager
def _opened(site: Site, path: Path) -> Iterator[ScanReader]:
    range_max_m = site.scanner.range_max_m if site.scans.frame == "scanner" else None
    with open_scan(path, range_max_m=range_max_m) as reader:
        yield reader


@contextmanager
def _held_still(path: Path) -> Iterator[str]:
    """Give the SHA-256 of a regular file; raise NotReadyError if it changed meanwhile."""
    before = _fingerprint(path)
    yield _sha256(path)
    if _fingerprint(path) != before:
        raise NotReadyError("the file changed while it was read")


def _fingerprint(path: Path) -> tuple[int, int, int]:
    try:
        status = path.lstat()
    except FileNotFoundError as error:
        raise NotReadyError("the file is gone") from error
    except OSError as error:
        raise NotReadyError(f"the file cannot be looked at: {error.strerror}") from error
    if not stat.S_ISREG(status.st_mode):
        raise ScanError("not a regular file: links, pipes and devices are refused")
    return status.st_ino, status.st_size, status.st_mtime_ns


def _sha256(path: Path) -> str:
    try:
        with os.fdopen(os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK), "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise NotReadyError(f"{path.name} cannot be read: {error.strerror}") from error


def _numbers(
    measured: Measurement, gathered: Gathered, points: int, levelled: tuple[Told, Adjustment, Bools] | None
) -> dict[str, float]:
    """Return what the store keeps once per scan."""
    lean, air, setup = gathered.lean, gathered.air, gathered.setup
    told = {
        "point_total": float(points),
        "coverage": float(np.mean(measured.surface.count > 0)),
    }
    if setup.position_m is not None:
        told |= dict(zip(("scanner_east", "scanner_north", "scanner_height"), setup.position_m, strict=True))
        told |= {"scanner_axis_east": setup.axis[0], "scanner_axis_north": setup.axis[1]}
    if levelled is not None:
        told |= stable_figures(measured) | {"change_step": levelled[1].change_step_m}
    if lean is not None:
        told["platform_roll"] = math.degrees(lean.mean_roll_rad)
        told["platform_pitch"] = math.degrees(lean.mean_pitch_rad)
        told["tilt_residual"] = math.degrees(lean.noise_rad)
        told["log_offset"] = lean.offset_s
    if air is not None:
        told["air_temperature"] = air.temperature_c
        told["air_pressure"] = air.pressure_hpa
        told["relative_humidity"] = air.humidity_pct
    return told


def _figures(epoch: store.Epoch, seconds: float) -> dict[str, float | str]:
    """Return what the log line and the status show of a scan."""
    measured = epoch.measurement
    seen = np.isfinite(measured.uncertainty_m)
    told: dict[str, float | str] = {"points": int(epoch.numbers["point_total"]), "cells": int(seen.sum())}
    if seen.any():
        told["sigma_median_m"] = round(float(np.median(measured.uncertainty_m[seen])), 4)
    change_m = measured.surface.change_m[np.isfinite(measured.surface.change_m)]
    if len(change_m):
        told["change_median_m"] = round(float(np.median(change_m)), 4)
        significant = (measured.quality & Quality.CHANGE_SIGNIFICANT) > 0
        told["significant_pct"] = round(100 * float(significant.sum()) / len(change_m), 1)
    for figure in ("stable_nmad", "stable_z_std"):
        if np.isfinite(epoch.numbers.get(figure, np.nan)):
            told[figure] = round(epoch.numbers[figure], 3)
    told["seconds"] = round(seconds, 2)
    return told
