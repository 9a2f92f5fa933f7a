"""What is done with a scan, from the inbox into the archive: each function runs in a child process.

Its last argument is `progress()`, which tells the parent that it is alive.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from station import __version__
from station.archive import store
from station.archive.aggregate import SLACK
from station.archive.layout import Series, kept_of
from station.archive.outlooks import kept_outlook
from station.archive.reference import current, open_reference, write_reference
from station.config import Site
from station.errors import ScanError
from station.pipeline import (
    Told,
    gridder_for,
    level,
    measure,
    outlook_on,
    stable_figures,
    survey,
)
from station.products.look import Look
from station.quantities import Bools, Measurement, Quality, Reference, Setup
from station.readers.flags import flag_on, read_flags
from station.readers.polygons import mask, read_polygons
from station.readers.raster import read_geotiff
from station.readers.scan import ScanReader, open_scan, require_begun, utc_interval
from station.science import ground, sensor, verdict
from station.science.adjustment import Adjustment
from station.science.grid import Gridder
from station.science.outlook import Outlook
from station.science.terrain import nodes_for
from station.service.child import give_back
from station.service.content import held_still, sha256_of
from station.service.gather import Gathered, gather
from station.service.inbox import Arrival
from station.service.pictures import Watched

Progress = Callable[[], None]
CELLS_MOST = 100_000  # that the figures of a scan are of; of more, some
MOST_REFUSED = 0.6  # of the stable ground; then the filtered log alone is safer


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
    log_sha256: str
    epoch_sha256: str  # of the file
    look: Look | None = None  # for its pictures; without, they take it from the store


@dataclass(frozen=True)
class Past:
    """What the journal knows of a scan from before."""

    reference: str | None = None  # version it was measured from
    revision: int = 0
    content: tuple[str, str] | None = None  # SHA-256 of the scan and log that were judged under its name
    stored: Mapping[str, str] = field(default_factory=dict)  # names of other scans stored, by their SHA-256
    patient: bool = False  # it may wait a while for its weather


@dataclass(frozen=True)
class Same:
    """A scan whose bytes were judged before, under `name`."""

    name: str
    sha256: str


@dataclass(frozen=True)
class Refused:
    """A scan that cannot be used."""

    reason: str
    sha256: str
    log_sha256: str


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


def attend(site: Site, arrival: Arrival, past: Past, progress: Progress) -> Outcome | Same | Refused:
    """Measure a scan as it arrives, unless its bytes were judged before; raises as `process`."""
    sha256 = sha256_of(arrival.path) if past.content or past.stored else ""
    if past.content == (sha256, sha256_of_log(arrival)):
        return Same(arrival.name, sha256)
    if sha256 in past.stored:
        return Same(past.stored[sha256], sha256)
    progress()
    return redo(site, arrival, past, progress, looked_at=site.products.page)


def redo(
    site: Site, arrival: Arrival, past: Past, progress: Progress, *, looked_at: bool = False
) -> Outcome | Refused:
    """Measure a scan, whatever is known of it, from the version of the reference it was measured from."""
    try:
        return process(site, arrival, progress, patient=past.patient, past=past, looked_at=looked_at)
    except ScanError as error:
        is_file = arrival.path.is_file() and not arrival.path.is_symlink()
        return Refused(
            str(error), sha256_of(arrival.path) if is_file else "", sha256_of_log(arrival) if is_file else ""
        )


def process(
    site: Site,
    arrival: Arrival,
    progress: Progress,
    *,
    patient: bool = False,
    past: Past = Past(),
    looked_at: bool = False,
) -> Outcome:
    """Measure a scan and store its epoch, unless just this is stored; have a look at it if that is wanted.

    Raises ScanError where the scan cannot be used; NotReadyError where it changes meanwhile, begins in the
    future, or `patient` and still without weather shortly after its arrival.
    """
    began_s = time.monotonic()
    series = series_of(site)
    with held_still(arrival.path) as scan_sha256:
        progress()
        wait_s = site.weather.wait_s if patient and site.weather else 0.0
        young = time.time() - arrival.mtime_ns * 1e-9 < wait_s
        reference = reference_of(site, past.reference)
        epoch = _measure(
            site, arrival, scan_sha256, reference, progress, rehearsal=False, wait_for_weather=young
        )
    version, written = epoch.provenance["reference_version"], _same_as(series, epoch)
    watched = Watched(site, series, version if looked_at and written is None else "")
    written = written or store.write_epoch(series, epoch, past.revision, watched.add)
    return Outcome(
        start_utc_s=epoch.start_s,
        sha256=scan_sha256,
        epoch=str(written.path.relative_to(series.folder)),
        revision=written.revision,
        verdict=epoch.verdict,
        reason=epoch.verdict_reason,
        reference=version or None,
        figures=_figures(epoch, time.monotonic() - began_s),
        log_sha256=epoch.provenance["log_sha256"],
        epoch_sha256=sha256_of(written.path),
        look=watched.look,
    )


def open_only(site: Site, arrival: Arrival, progress: Progress) -> None:
    """Raise ScanError where a scan's headers say that it cannot be used."""
    progress()
    with opened(site, arrival.path) as reader:
        utc_interval(reader, site.scans.name)


def rehearse(site: Site, arrival: Arrival, progress: Progress) -> tuple[str, str, dict[str, float | str]]:
    """Measure a scan without storing anything: verdict, reason, figures."""
    began_s = time.monotonic()
    reference = None if isinstance(site.reference.scans, Path) else reference_of(site)
    epoch = _measure(site, arrival, "", reference, progress, rehearsal=True, wait_for_weather=False)
    return epoch.verdict, epoch.verdict_reason, _figures(epoch, time.monotonic() - began_s)


def _measure(
    site: Site,
    arrival: Arrival,
    scan_sha256: str,
    reference: Reference | None,
    progress: Progress,
    *,
    rehearsal: bool,
    wait_for_weather: bool,
) -> store.Epoch:
    with opened(site, arrival.path) as reader:
        start, end, _ = utc_interval(reader, site.scans.name)
        require_begun(start, time.time())
        gathered = gather(
            site,
            reader,
            arrival.log,
            start,
            end,
            keep_zero=not rehearsal,
            wait_for_weather=wait_for_weather,
        )
        outlook = outlook_of(site, gathered.setup, reference) if reference else None
        progress()
        blocks = reader.blocks(brightness=site.adjusts)  # which come from now on
        gridder = gridder_for(gathered.setup, outlook)
        survey(gridder, blocks, gathered.pose, progress)
    if gridder.is_empty():
        raise ScanError("no point falls on the grid: wrong scans.frame, SOP, CRS or units?")
    progress()
    levelled = levelled_to(site, gridder, gathered, outlook)
    flag = flag_of(site, start.timestamp(), end.timestamp())
    found = levelled[1] if levelled else None
    if levelled is not None and levelled[1].refused > MOST_REFUSED:
        levelled = None
    unknown = levelled[1].shared() if levelled is not None else gathered.unknown
    doubts, late = _log_against_ground(levelled, reference)
    measured = measure(gridder, gathered.setup, unknown, outlook, levelled)
    progress()
    numbers = _numbers(measured, gathered, reader.header.point_count)
    if levelled is not None and outlook is not None:
        numbers |= stable_figures(measured, outlook) | {"change_step": levelled[1].change_step_m}
        numbers |= dict(zip(SLACK, levelled[1].slack_m2, strict=True))
    word, reason = verdict.judge(
        flag,
        [*gathered.lacking, *doubts],
        measured,
        outlook,
        found,
        numbers.get("stable_z_std", 0.0) if levelled else None,
    )
    return store.Epoch(
        start_s=start.timestamp(),
        end_s=end.timestamp(),
        scan_id=arrival.path.stem,
        measurement=measured,
        shared=unknown,
        verdict=word,
        verdict_reason=reason,
        numbers=numbers | late,
        provenance={
            "scan_sha256": scan_sha256,
            "log_sha256": sha256_of_log(arrival),
            "flag": flag,
            "science_hash": site.science_hash,
            "reference_version": reference.version if reference else "",
            "adjustment": "joint" if levelled else "none",
            "software_version": __version__,
            **gathered.provenance,
        },
    )


def outlook_of(site: Site, setup: Setup, reference: Reference) -> Outlook:
    """Look at a stored version of the reference as the scans of a setup do."""
    given = site.adjustment.stable
    polygons = sha256_of(given) if isinstance(given, Path) and given.is_file() else ""
    return kept_outlook(
        series_of(site),
        reference,
        (setup.position_m, setup.axis),
        repr((setup.grid, setup.scanner, setup.published_budget, site.map.crs, polygons)),
        lambda: outlook_on(reference, setup, stable_ground(site, reference)),
    )


def levelled_to(
    site: Site, gridder: Gridder, gathered: Gathered, outlook: Outlook | None
) -> tuple[Told, Adjustment] | None:
    """Adjust a scan to the reference, where the site asks for it and there is one to adjust to."""
    if not site.adjusts or gathered.told is None or outlook is None:
        return None
    found = level(gridder, gathered.setup, gathered.told, outlook)
    give_back()
    return gathered.told, found


def _log_against_ground(
    levelled: tuple[Told, Adjustment] | None, reference: Reference | None
) -> tuple[list[str], dict[str, float]]:
    """Say what the ground has against a scan's log, and how late that is as the store keeps it."""
    if levelled is None or reference is None:
        return [], {}
    expected = sensor.expected(levelled[0].lines, levelled[1])
    if expected is None:
        return [], {}
    doubts = sensor.off_habit(expected)
    late = sensor.lateness(expected, reference.habits, len(reference.scan_ids))
    give_back()
    if late is None:
        return doubts, {}
    return doubts + late.words(), {"log_lateness": late.late_s, "log_lateness_uncertainty": late.sigma_s}


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
    told = {
        **epoch.provenance,
        "scan_id": epoch.scan_id,
        "verdict": epoch.verdict,
        "verdict_reason": kept_of(epoch.verdict_reason, "sentence"),
    }
    same = all(said.get(key) == value for key, value in told.items() if key in said)
    return held[-1] if same and store.air_in(held[-1].path) == air_of(epoch.numbers) else None


def air_of(numbers: Mapping[str, float]) -> tuple[float, ...]:
    """Return the air an epoch was measured in, () where it is not known."""
    found = tuple(numbers[name] for name in store.AIR if name in numbers)
    return found if len(found) == len(store.AIR) else ()


def flag_of(site: Site, start_utc_s: float, end_utc_s: float) -> str:
    """Return why a person says that a scan is not to be used, as the store keeps it; '' where nobody does."""
    reason = flag_on(read_flags(site.flags.file), start_utc_s, end_utc_s) if site.flags else ""
    return kept_of(reason, "sentence")


def reference_of(site: Site, version: str | None = None) -> Reference | None:
    """Return the master surface: a version where epochs may still be measured from it, else the newest.

    One given as a file is taken into the store at first use.
    """
    series = series_of(site)
    given = site.reference.scans
    if not isinstance(given, Path):
        made = current(series)
        newest = list(made)[-1] if made else None
        return open_reference(series, version if version in made else newest)
    held = open_reference(series)
    version = version_of_given(given)
    if held is None or held.version != version:
        elevation_m = nodes_for(read_geotiff(given, series.grid, series.crs))
        steep = ground.steep(elevation_m, series.grid.cell_m)
        write_reference(series, Reference.given(series.grid, version, elevation_m, steep))
        held = open_reference(series)
    return held


def version_of_given(file: Path) -> str:
    """Name the version of a master surface that is given as a file."""
    return f"{file.stem}-{sha256_of(file)[:8]}"


def areas_of(site: Site) -> dict[str, Bools]:
    """Return the cells (ny, nx) of the areas that the site names."""
    if site.areas is None:
        return {}
    found = read_polygons(site.areas.file, site.map.crs)
    return {name: mask(polygon, site.grid_cells) for name, polygon in found.items()}


@contextmanager
def opened(site: Site, path: Path) -> Iterator[ScanReader]:
    """Open a scan as the site says; raise ScanError or NotReadyError where it cannot be used."""
    range_max_m = site.scanner.range_max_m if site.scans.frame == "scanner" else None
    with open_scan(path, range_max_m=range_max_m) as reader:
        yield reader


def sha256_of_log(arrival: Arrival) -> str:
    """Return the SHA-256 of a scan's inclination log, '' where there is none."""
    return sha256_of(arrival.log) if arrival.log else ""


def _numbers(measured: Measurement, gathered: Gathered, points: int) -> dict[str, float]:
    """Return what the store keeps once per scan."""
    lean, setup = gathered.lean, gathered.setup
    told = {
        "point_total": float(points),
        "coverage": float(np.count_nonzero(measured.count) / measured.number.size),
    }
    if setup.position_m is not None:
        told |= dict(zip(("scanner_east", "scanner_north", "scanner_height"), setup.position_m, strict=True))
        told |= {"scanner_axis_east": setup.axis[0], "scanner_axis_north": setup.axis[1]}
    if lean is not None:
        told["platform_roll"] = math.degrees(lean.mean_roll_rad)
        told["platform_pitch"] = math.degrees(lean.mean_pitch_rad)
        told["tilt_residual"] = math.degrees(lean.noise_rad)
        told["log_offset"] = lean.offset_s
    return told | numbers_of_air(gathered)


def numbers_of_air(gathered: Gathered) -> dict[str, float]:
    """Return the air of a scan by the names of the variables that keep it; nothing where it is not known."""
    air = gathered.air
    if air is None:
        return {}
    return dict(zip(store.AIR, (air.temperature_c, air.pressure_hpa, air.humidity_pct), strict=True))


def _figures(epoch: store.Epoch, seconds: float) -> dict[str, float | str]:
    """Return what the log line and the status show of a scan."""
    measured = epoch.measurement
    told: dict[str, float | str] = {
        "points": int(epoch.numbers["point_total"]),
        "cells": round(epoch.numbers["coverage"] * measured.number.size),
    }
    part = slice(None, None, 1 + len(measured.cells) // CELLS_MOST)
    change_m, sigma_m = measured.change_m[part], measured.cells["uncertainty_m"][part]
    seen = np.isfinite(sigma_m)
    if seen.any():
        told["sigma_median_m"] = round(float(np.median(sigma_m[seen])), 4)
    seen = np.isfinite(change_m)
    if seen.any():
        told["change_median_m"] = round(float(np.median(change_m[seen])), 4)
        significant = measured.quality[part][seen] & np.uint8(Quality.CHANGE_SIGNIFICANT)
        told["significant_pct"] = round(100 * float(np.mean(significant > 0)), 1)
    for figure in ("stable_nmad", "stable_z_std"):
        if np.isfinite(epoch.numbers.get(figure, np.nan)):
            told[figure] = round(epoch.numbers[figure], 3)
    for figure, name in (("platform_roll", "roll_deg"), ("platform_pitch", "pitch_deg")):
        if figure in epoch.numbers:
            told[name] = round(epoch.numbers[figure], 4)
    told["seconds"] = round(seconds, 2)
    return told
