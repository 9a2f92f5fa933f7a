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
from station.archive.layout import Series
from station.archive.reference import read_reference, write_reference
from station.archive.series import build_series
from station.config import Site
from station.errors import NotReadyError, ScanError
from station.pipeline import gridder_for, master, measure, survey
from station.quantities import Measurement, Quality, Reference, Shared
from station.readers.raster import read_geotiff
from station.readers.scan import ScanReader, open_scan, utc_interval
from station.science.grid import Stack
from station.science.terrain import nodes_for
from station.service.gather import Gathered, gather
from station.service.inbox import Arrival

Progress = Callable[[], None]
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
    measured = measure(gridder, gathered.setup, gathered.unknown, reference)
    progress()
    return store.Epoch(
        start_s=start.timestamp(),
        end_s=end.timestamp(),
        scan_id=arrival.path.stem,
        measurement=measured,
        shared=gathered.unknown,
        verdict="degraded" if gathered.lacking else "good",
        verdict_reason="; ".join(gathered.lacking),
        numbers=_numbers(measured, gathered, reader.header.point_count),
        provenance={
            "scan_sha256": scan_sha256,
            "log_sha256": _sha256(arrival.log) if arrival.log else "",
            "science_hash": site.science_hash,
            "reference_version": reference.version if reference else "",
            "software_version": __version__,
            **gathered.provenance,
        },
    )


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
    """Make the master surface from scans and store it; return its version.

    Thrice over the scans: their plain means, then twice their residuals to what there is.
    """
    series = series_of(site)
    scan_ids = tuple(arrival.path.stem for arrival in arrivals)
    surface: Reference | None = None
    for _ in range(REFERENCE_PASSES):
        stack = Stack(series.grid)
        laid = [_lay_on(stack, site, arrival, surface, progress) for arrival in arrivals]
        surface = master(stack, surface, [unknown for unknown, _ in laid], laid[0][1], version, scan_ids)
    if surface is not None:
        write_reference(series, surface)
    return version


def _lay_on(
    stack: Stack, site: Site, arrival: Arrival, surface: Reference | None, progress: Progress
) -> tuple[Shared | None, float]:
    """Add a scan to a stack; return what its points share and its datum [m]. Its own grid goes at once."""
    with _opened(site, arrival.path) as reader:
        start, end, _ = utc_interval(reader, site.scans.name)
        gathered = gather(site, reader, arrival.log, start, end)
        gridder = gridder_for(gathered.setup, surface)
        survey(gridder, reader.blocks(), gathered.setup, gathered.pose, progress)
    stack.add(gridder)
    return gathered.unknown, gridder.datum_m


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
        exact = np.where(np.isfinite(elevation_m), 0.0, np.nan).astype(np.float32)
        write_reference(series, Reference(series.grid, version, elevation_m, exact, exact, None, ()))
        held = read_reference(series)
    return held


def publish(site: Site, progress: Progress) -> None:
    """Build `series.nc` anew over the epochs that exist; join them first where they are too many files."""
    series = series_of(site)
    if len(store.sources(series.path)) > MOST_SOURCES:
        join.join_closed(series, datetime.now(UTC), progress)
    build_series(series)
    progress()


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


def _numbers(measured: Measurement, gathered: Gathered, points: int) -> dict[str, float]:
    """Return what the store keeps once per scan."""
    lean, air = gathered.lean, gathered.air
    told = {
        "point_total": float(points),
        "coverage": float(np.mean(measured.surface.count > 0)),
    }
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
    told["seconds"] = round(seconds, 2)
    return told
