"""Checks of site file, inputs and store that need no running service."""

from __future__ import annotations

import math
import os
import shutil
import time
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np

from station.archive.derived.product_files import units_of
from station.archive.reference_files import valid_versions
from station.config import Site, read_site
from station.errors import NotReadyError, ScanError, StationError
from station.inbox.journal_reader import JournalReader
from station.inbox.listing import start_from_name
from station.inbox.lock import is_locked
from station.monitoring.preconditions import EARLIEST_S
from station.operations.inbox_contents import MANUAL, inbox_findings
from station.operations.site_plausibility import (
    LevelAndMessage,
    alarm_findings,
    double_tilt_findings,
    overlap_findings,
    plane_findings,
    position_findings,
    rights_findings,
    setting_findings,
    tilt_findings,
    weather_time_findings,
)
from station.processing.integrity import check_store
from station.processing.scan_tasks import dry_run
from station.processing.scanner_pose import map_position, scanner_height_m, scanner_to_map
from station.processing.scans.open_scans import open_files
from station.processing.scans.scan_air import pressure_fault
from station.processing.scans.scan_files import inbox_scans, scan_file
from station.processing.site_files import load_areas, load_products, polygon_cells, series_for
from station.processing.workers import isolation
from station.products.site_products.observations import read_observations
from station.readers.flags import read_flags
from station.readers.inclination import read_inclination
from station.readers.polygons import mended_outlines
from station.readers.sop import valid_sop
from station.readers.weather import interpolate_air, log_files, read_weather
from station.scan_names import name_below, scan_stem
from station.science.analysis.verdict import BRIGHT_GROUND, NO_BRIGHTNESS
from station.science.geometry import inclination
from station.science.geometry.pose import ScannerToMap
from station.sections.inputs import SopSection
from station.service.store_repair import require_same_map

Finding = dict[str, str]  # level (ok, warning, fault), what, message
EPOCH_BYTES_PER_CELL = 16  # typical, uncompressed


def site_findings(site_path: Path) -> list[Finding]:
    """Return findings on the site file and all it names; raise ConfigError if the file cannot be read."""
    site = read_site(site_path)
    return [
        _finding("ok", "config", f"{site_path}: {site.station.name or site.station.id}"),
        *_named("settings", setting_findings(site)),
        *_sop_poses(site),
        *_polygons(site),
        *_products(site),
        *_folders(site),
        *_named("inbox", inbox_findings(site)),
        *_named("rights", rights_findings(site, _files_read(site))),
        *_flags(site),
        *_clock(),
        *_weather(site),
        *_inclination(site),
        *_unused_inclination(site),
        *_newest_scan(site),
    ]


def store_findings(site_path: Path) -> list[Finding]:
    """Return findings on the store, compared with journal and checksums; the service may be running.

    Raises ConfigError if the site file cannot be read, StoreError if the journal cannot.
    """
    site = read_site(site_path)
    findings = _check_store_isolated(site)
    if is_locked(site.station.data) and any(level != "ok" for level, *_ in findings):
        repeated = _check_store_isolated(site)  # work of the service in the meantime is no finding
        findings = [finding for finding in repeated if finding[0] == "ok" or finding in findings]
    return [_finding(level, what, message) for level, what, message in findings]


def _check_store_isolated(site: Site) -> list[tuple[str, str, str]]:
    with JournalReader(site.station.data / "journal.sqlite") as journal:
        entries, known = journal.rows(), journal.checksums()
    return isolation.TaskRunner().run(
        check_store, site, entries, known, memory_gb=site.service.memory_gb, timeout_s=math.inf
    )


def _named(what: str, findings: Iterable[LevelAndMessage]) -> Iterator[Finding]:
    for level, message in findings:
        yield _finding(level, what, message)


def _files_read(site: Site) -> list[Path]:
    """Return the files that the service reads, as far as they exist."""
    files = [site.path, *(sop.file for sop in site.sop), *_scans(site)[-1:]]
    files += [section.file for section in (site.areas, site.flags) if section]
    with suppress(StationError):  # a finding of its own
        files += log_files(site.weather.file)[-1:] if site.weather else []
    files += [
        path
        for path in (site.map.pop, site.adjustment.stable, site.reference.scans)
        if isinstance(path, Path)
    ]
    if site.inclination:
        files += [
            log
            for scan in _scans(site)[-1:]
            if (log := scan.with_name(scan_stem(scan) + site.inclination.suffix)).exists()
        ]
    return files


def _finding(level: str, what: str, message: str) -> Finding:
    return {"level": level, "what": what, "message": message}


def _local_map(site: Site) -> Iterator[Finding]:
    """Yield where a map without an SOP is, and a warning if nothing makes it level."""
    message = "no [[sop]]: the map is local, with its origin at the scanner and east along its x axis"
    if site.registration is not None:
        yield _finding("ok", "map", f"{message}; it is the frame into which the registration leads")
    elif site.inclination is None:
        level = "it is as level as the scanner, because there is no [inclination]"
        yield _finding("warning", "map", f"{message}; {level}")
    else:
        yield _finding("ok", "map", f"{message}; the inclination log makes it level")


def _sop_pose(site: Site, sop: SopSection, frame: ScannerToMap) -> Iterator[Finding]:
    """Yield position and tilt of the scanner under an SOP."""
    east_m, north_m, height_m = frame.position_m
    tilt_deg = math.degrees(math.acos(min(1.0, frame.to_local[2, 2])))
    yield _finding(
        "ok",
        "sop",
        f"{sop.file.name} from {sop.from_:%Y-%m-%d}: scanner at"
        f" {east_m:.2f} {north_m:.2f} {height_m:.2f}, tilt {tilt_deg:.2f}°",
    )
    yield from _named("sop", position_findings(site, sop.file.name, frame.position_m, map_position(site)))


def _sop_poses(site: Site) -> Iterator[Finding]:
    """Yield position and tilt of the scanner under each SOP, and a fault if the grid is out of range."""
    grid = site.grid_cells
    if site.scans.frame == "map" and site.map.origin is None:
        message = "map.origin, the scanner's position, is missing: sigma contains only the scatter of points"
        yield _finding("warning", "map", message)
    if site.scans.frame == "scanner" and not site.sop:
        yield from _local_map(site)
    for sop in site.sop or ((None,) if site.scans.frame == "scanner" else ()):
        try:
            frame = scanner_to_map(site, sop)
        except StationError as error:
            yield _finding("fault", "sop", str(error))
            continue
        x_m, y_m, above_m = grid.plane.place_from_map(frame.position_m)
        if sop is not None:
            yield from _sop_pose(site, sop, frame)
        distance_m = math.hypot(
            max(grid.west_m - x_m, 0.0, x_m - grid.west_m - grid.nx * grid.cell_m),
            max(y_m - grid.north_m, 0.0, grid.north_m - grid.ny * grid.cell_m - y_m),
            0.0 if grid.plane.is_map else above_m,
        )
        if not grid.plane.is_map:
            yield from _named("grid", [plane_findings(site, above_m)])
        if distance_m > site.scanner_of(sop).range_max_m:
            yield _finding(
                "fault", "grid", f"begins {distance_m:,.0f} m from the scanner: beyond range_max_m"
            )


def _polygons(site: Site) -> Iterator[Finding]:
    """Yield the number of cells in each named polygon."""
    files = [site.areas.file] if site.areas else []
    files += [site.adjustment.stable] if isinstance(site.adjustment.stable, Path) else []
    try:
        for message in (text for file in files for text in mended_outlines(file, site.grid_crs)):
            yield _finding("warning", "polygons", message)
        named = load_areas(site)
        areas = {f"area {name}": cells for name, cells in named.items()}
        if isinstance(site.adjustment.stable, Path) and site.adjustment.method == "joint":
            areas["stable ground"] = polygon_cells(site.adjustment.stable, site)
    except StationError as error:
        yield _finding("fault", "polygons", str(error))
        return
    for name, cells in areas.items():
        message = f"{name}: {int(cells.sum()):,} cells of the grid"
        yield _finding("ok" if cells.any() else "fault", "polygons", message)
    if (stable := areas.get("stable ground")) is not None:
        yield from _named("polygons", overlap_findings(named, stable))
    yield from _named("alarms", alarm_findings(site, set(named)))


def _products(site: Site) -> Iterator[Finding]:
    """Yield which products can be computed, and why others cannot."""
    products, faults = load_products(site)
    for product in products:
        section, cells = product.section, sum(int(place.sum()) for place in product.places.values())
        yield _finding("ok", "products", f"{section.name}: {cells:,} cells of the grid")
        if section.observations:
            try:
                read_observations(section.observations, units_of(section.kind))
            except StationError as error:
                yield _finding("fault", "products", f"{section.name}: {error}")
    for fault in faults:
        yield _finding("fault", "products", fault)


def _folders(site: Site) -> Iterator[Finding]:
    inbox, data = site.scans.inbox, site.station.data
    if not os.path.isdir(inbox):  # noqa: PTH112 - Path raises an error if a parent cannot be read
        yield _finding("fault", "inbox", f"{inbox}: no such folder, or no permission to see it")
    elif not os.access(inbox, os.R_OK | os.X_OK):
        yield _finding("fault", "inbox", f"{inbox}: no permission to read")
    else:
        files = len(_scans(site))
        count = f"{len(inbox_scans(site))} epochs of {files} files" if site.epoch else f"{files} scans"
        yield _finding("ok", "inbox", f"{inbox}: {count}")
    if site.retention.raw != "leave" and not os.access(inbox, os.W_OK):
        message = f"{inbox}: no permission to write, but retention.raw is {site.retention.raw!r}"
        yield _finding("warning", "retention", message)
    existing = next(parent for parent in (data, *data.parents) if parent.exists())
    if not os.access(existing, os.W_OK | os.X_OK):
        yield _finding("fault", "data", f"{existing}: no permission to write")
        return
    free = shutil.disk_usage(existing).free
    required = 24 * EPOCH_BYTES_PER_CELL * math.prod(series_for(site).grid.shape)
    message = f"{data}: {free / 1e9:.1f} GB free; a day of hourly epochs needs up to {required / 1e9:.2f} GB"
    yield _finding("ok" if free > required else "warning", "data", message)
    try:
        require_same_map(site)
    except StationError as error:
        yield _finding("fault", "data", str(error))


def _flags(site: Site) -> Iterator[Finding]:
    """Yield the number of bad intervals in the flags file."""
    if site.flags is None:
        return
    try:
        yield _finding("ok", "flags", f"{site.flags.file}: {len(read_flags(site.flags.file))} intervals")
    except StationError as error:
        yield _finding("fault", "flags", str(error))


def _clock() -> Iterator[Finding]:
    now_s = time.time()
    text = time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime(now_s))
    yield _finding("ok" if now_s > EARLIEST_S else "fault", "clock", text)


def _weather(site: Site) -> Iterator[Finding]:
    settings = site.weather
    if settings is None:
        return
    try:
        log = read_weather(settings)
    except (ScanError, NotReadyError) as error:
        yield _finding("warning", "weather", str(error))
        return
    if len(log.time_utc_s) == 0:
        yield _finding("warning", "weather", f"{settings.file}: no rows yet")
        return
    last_s = float(log.time_utc_s[-1])
    yield from _named("weather", weather_time_findings(last_s))
    air = interpolate_air(log, last_s, settings.max_age_s)
    message = f"{len(log.time_utc_s)} rows up to {time.strftime('%Y-%m-%d %H:%M UTC', time.gmtime(last_s))}"
    if air is None:
        yield _finding("ok", "weather", message)
        return
    message += f": {air.temperature_c:.1f} °C, {air.pressure_hpa:.1f} hPa, {air.humidity_pct:.0f} %"
    fault = pressure_fault(air, _newest_height_m(site))
    yield _finding("warning" if fault else "ok", "weather", f"{message}; {fault}" if fault else message)


def _inclination(site: Site) -> Iterator[Finding]:
    """Yield a comparison of the newest inclination log with the tilt that the SOP contains.

    A log that cannot be read, or shows the limit of the sensor's range, is a finding on its scan.
    """
    scans = _scans(site)
    if site.inclination is None or not scans or not site.sop:
        return
    try:
        name = name_below(scans[-1], site.scans.pattern)
        sop = valid_sop(site.sop, start_from_name(name, site.scans.pattern), name)
        assert sop is not None  # noqa: S101 - there are some
        rotation = scanner_to_map(site, sop).to_local[:3, :3]
        log_path = scans[-1].with_name(scan_stem(scans[-1]) + site.inclination.suffix)
        range_rad = site.scanner_of(sop).instrument.inclination_range_rad
        log, _ = inclination.clean(read_inclination(log_path), range_rad)
    except StationError:
        return
    if not len(log.time_s):
        return
    expected_deg = np.degrees(inclination.mount_inclination(rotation))
    log_deg = math.degrees(log.roll_rad.mean()), math.degrees(log.pitch_rad.mean())
    expected = float(expected_deg[0]), float(expected_deg[1])
    if site.inclination.mode == "absolute":
        yield from _named("inclination", double_tilt_findings(sop.file.name, expected, log_deg))
    elif math.degrees(range_rad) > max(map(abs, expected)):
        yield from _named("inclination", [tilt_findings(sop.file.name, expected, log_deg)])


def _unused_inclination(site: Site) -> Iterator[Finding]:
    """Yield a warning if the points of the newest scan carry roll and pitch, which nobody asked to use."""
    scans = _scans(site)
    if site.inclination is not None or site.scans.frame == "map" or not scans:
        return
    service = site.service
    with suppress(StationError):  # a finding on the scan
        if isolation.TaskRunner().run(
            carries_inclination, site, scans[-1], memory_gb=service.memory_gb, timeout_s=site.scans.timeout_s
        ):
            message = "the points carry roll and pitch, which are not used: [inclination] wait_s = 0 would"
            yield _finding("warning", "inclination", f"{message}, see {MANUAL}")


def carries_inclination(site: Site, path: Path, _progress: object) -> bool:
    """Return True if the points of a scan carry roll and pitch; runs in a worker process."""
    with open_files(site, [scan_file(site, path)]) as reader:
        return reader.header.has_inclination


def _newest_height_m(site: Site) -> float | None:
    """Return the height of the scanner under the newest SOP [m]; None if it is unknown."""
    try:
        return scanner_height_m(site, max(site.sop, key=lambda sop: sop.from_)) if site.sop else None
    except StationError:  # a finding of its own
        return None


def _scans(site: Site) -> list[Path]:
    """Return the files of scans in the inbox, by name; none if it cannot be read."""
    try:
        return [path for scan in inbox_scans(site) for path in scan.paths]
    except NotReadyError:  # a finding of its own
        return []


def _newest_scan(site: Site) -> Iterator[Finding]:
    """Measure the newest scan without storing it."""
    try:
        scans = inbox_scans(site)
    except NotReadyError:  # a finding of its own
        scans = []
    if not scans:
        yield _finding("warning", "scan", "no scan in the inbox to measure")
        return
    scan = scans[-1]
    try:
        verdict, reason, metrics = isolation.TaskRunner().run(
            dry_run,
            site,
            scan,
            memory_gb=site.service.memory_gb,
            timeout_s=site.scans.timeout_s,
        )
    except StationError as error:
        yield _finding("fault", "scan", f"{scan.name}: {error}")
        return
    text = " ".join(f"{key}={value}" for key, value in metrics.items())
    message = f"{scan.name}: {verdict}{f' ({reason})' if reason else ''} {text}"
    if not valid_versions(series_for(site)) and not isinstance(site.reference.scans, Path):
        message += " (no reference yet: once there is one, sigma is smaller)"
    yield _finding("ok" if verdict == "good" else "warning", "scan", message)
    if any(fault in reason for fault in (NO_BRIGHTNESS, BRIGHT_GROUND)):
        yield _finding(
            "warning",
            "brightness",
            "no brightness: snow on stable ground is recognised by slope only, and none below 50° is used:"
            " export reflectance or intensity, and see scans.intensity",
        )
