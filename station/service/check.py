"""Everything that can be known before going live."""

from __future__ import annotations

import math
import os
import shutil
import time
from collections.abc import Iterator
from pathlib import Path

from station.config import Site, read_site
from station.errors import NotReadyError, ScanError, StationError
from station.readers.flags import read_flags
from station.readers.scan import suffixes
from station.readers.weather import air_at, read_weather
from station.service import child
from station.service.gather import frame_of
from station.service.integrity import prove
from station.service.journal import Journal
from station.service.lock import in_use
from station.service.places import arrival_of
from station.service.tasks import areas_of, polygons, rehearse, series_of

Finding = dict[str, str]  # level (ok, warning, fault), what, says
EPOCH_BYTES_PER_CELL = 16  # of an epoch without compression
EARLIEST_S = 1_577_836_800  # 2020-01-01: no clock of a running station is before


def check(site_path: Path) -> list[Finding]:
    """Look at the site file and at all it names; raise ConfigError where the file itself cannot be read."""
    site = read_site(site_path)
    return [
        _finding("ok", "config", f"{site_path}: {site.station.name or site.station.id}"),
        *_pose(site),
        *_polygons(site),
        *_folders(site),
        *_flags(site),
        *_clock(),
        *_weather(site),
        *_newest_scan(site),
    ]


def check_store(site_path: Path) -> list[Finding]:
    """Prove the store against the journal and the checksums, also beside a running service.

    Raises ConfigError where the site file cannot be read, StoreError where the journal cannot.
    """
    site = read_site(site_path)
    found = _proved(site)
    if in_use(site.station.data) and any(level != "ok" for level, *_ in found):
        again = _proved(site)  # what the service was at meanwhile is no finding
        found = [one for one in again if one[0] == "ok" or one in found]
    return [_finding(level, what, says) for level, what, says in found]


def _proved(site: Site) -> list[tuple[str, str, str]]:
    with Journal(site.station.data / "journal.sqlite", read_only=True) as journal:
        entries, known = journal.rows(), journal.files()
    return child.run(prove, site, entries, known, memory_gb=site.service.memory_gb, timeout_s=math.inf)


def _finding(level: str, what: str, says: str) -> Finding:
    return {"level": level, "what": what, "says": says}


def _pose(site: Site) -> Iterator[Finding]:
    """Tell where each SOP puts the scanner, and whether the grid is within its reach."""
    grid = site.grid_cells
    if site.scans.frame == "map" and site.map.origin is None:
        says = "map.origin, the scanner's place, is not given: sigma holds the scatter of points alone"
        yield _finding("warning", "map", says)
    for sop in site.sop:
        try:
            frame = frame_of(site, sop)
        except StationError as error:
            yield _finding("fault", "sop", str(error))
            continue
        east_m, north_m, height_m = frame.position_m
        lean_deg = math.degrees(math.acos(min(1.0, frame.to_local[2, 2])))
        yield _finding(
            "ok",
            "sop",
            f"{sop.file.name} from {sop.from_:%Y-%m-%d}: scanner at"
            f" {east_m:.2f} {north_m:.2f} {height_m:.2f}, leaning {lean_deg:.2f}°",
        )
        away_m = math.hypot(
            max(grid.west_m - east_m, 0.0, east_m - grid.west_m - grid.nx * grid.cell_m),
            max(north_m - grid.north_m, 0.0, grid.north_m - grid.ny * grid.cell_m - north_m),
        )
        if away_m > site.scanner.range_max_m:
            yield _finding("fault", "grid", f"begins {away_m:,.0f} m from the scanner: beyond range_max_m")


def _polygons(site: Site) -> Iterator[Finding]:
    """Tell how many cells the named polygons hold."""
    try:
        named = {f"area {name}": cells for name, cells in areas_of(site).items()}
        if isinstance(site.adjustment.stable, Path) and site.adjustment.method == "joint":
            named["stable ground"] = polygons(site.adjustment.stable, site)
    except StationError as error:
        yield _finding("fault", "polygons", str(error))
        return
    for name, cells in named.items():
        says = f"{name}: {int(cells.sum()):,} cells of the grid"
        yield _finding("ok" if cells.any() else "fault", "polygons", says)


def _folders(site: Site) -> Iterator[Finding]:
    inbox, data = site.scans.inbox, site.station.data
    if not inbox.is_dir():
        yield _finding("fault", "inbox", f"{inbox}: no such folder")
    elif not os.access(inbox, os.R_OK | os.X_OK):
        yield _finding("fault", "inbox", f"{inbox}: may not be read")
    else:
        yield _finding("ok", "inbox", f"{inbox}: {len(_scans(site))} scans")
    if site.retention.raw != "leave" and not os.access(inbox, os.W_OK):
        says = f"{inbox}: may not be written, but retention.raw is {site.retention.raw!r}"
        yield _finding("warning", "retention", says)
    place = next(parent for parent in (data, *data.parents) if parent.exists())
    if not os.access(place, os.W_OK | os.X_OK):
        yield _finding("fault", "data", f"{place}: may not be written")
        return
    free, need = (
        shutil.disk_usage(place).free,
        24 * EPOCH_BYTES_PER_CELL * math.prod(series_of(site).grid.shape),
    )
    says = f"{data}: {free / 1e9:.1f} GB free; a day of hourly epochs takes up to {need / 1e9:.2f} GB"
    yield _finding("ok" if free > need else "warning", "data", says)


def _flags(site: Site) -> Iterator[Finding]:
    """Tell how many bad intervals a person has noted."""
    if site.flags is None:
        return
    try:
        yield _finding("ok", "flags", f"{site.flags.file}: {len(read_flags(site.flags.file))} intervals")
    except StationError as error:
        yield _finding("fault", "flags", str(error))


def _clock() -> Iterator[Finding]:
    now_s = time.time()
    good = now_s > EARLIEST_S
    yield _finding(
        "ok" if good else "fault", "clock", time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime(now_s))
    )


def _weather(site: Site) -> Iterator[Finding]:
    given = site.weather
    if given is None:
        return
    try:
        log = read_weather(
            given.file, format=given.format, columns=given.columns, utc_offset_h=given.utc_offset_h
        )
    except (ScanError, NotReadyError) as error:
        yield _finding("warning", "weather", str(error))
        return
    if len(log.time_utc_s) == 0:
        yield _finding("warning", "weather", f"{given.file}: no rows yet")
        return
    last_s = float(log.time_utc_s[-1])
    air = air_at(log, last_s, given.max_age_s)
    says = f"{len(log.time_utc_s)} rows up to {time.strftime('%Y-%m-%d %H:%M UTC', time.gmtime(last_s))}"
    if air is not None:
        says += f": {air.temperature_c:.1f} °C, {air.pressure_hpa:.1f} hPa, {air.humidity_pct:.0f} %"
    yield _finding("ok", "weather", says)


def _scans(site: Site) -> list[Path]:
    return sorted(path for path in site.scans.inbox.iterdir() if path.suffix.lower() in suffixes())


def _newest_scan(site: Site) -> Iterator[Finding]:
    """Measure the newest scan without storing it."""
    scans = _scans(site) if site.scans.inbox.is_dir() else []
    if not scans:
        yield _finding("warning", "scan", "none in the inbox to try")
        return
    arrival = arrival_of(site, scans[-1])
    try:
        verdict, reason, figures = child.run(
            rehearse,
            site,
            arrival,
            memory_gb=site.service.memory_gb,
            timeout_s=site.scans.timeout_s,
        )
    except StationError as error:
        yield _finding("fault", "scan", f"{arrival.name}: {error}")
        return
    told = " ".join(f"{key}={value}" for key, value in figures.items())
    says = f"{arrival.name}: {verdict}{f' ({reason})' if reason else ''} {told}"
    yield _finding("ok" if verdict == "good" else "warning", "scan", says)
