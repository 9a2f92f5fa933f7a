"""Where a scan and its inclination log lie: in the inbox, or in the archive of raw scans."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

from station.config import Site
from station.service.inbox import Arrival


def arrival_of(site: Site, path: Path) -> Arrival:
    """Return a scan with its inclination log, if that lies beside it."""
    status = path.lstat()
    return Arrival(path.name, path.absolute(), _log_of(site, path), status.st_size, status.st_mtime_ns)


def find_scan(site: Site, name: str, start_utc_s: float | None) -> Arrival | None:
    """Find a scan that was taken before, in the inbox or in the archive; None where it is gone.

    A log that came after its scan was archived is found in the inbox.
    """
    path = site.scans.inbox / name
    if path.is_file() and not path.is_symlink():
        return arrival_of(site, path)
    if site.retention.archive is None or start_utc_s is None:
        return None
    path = archived(site.retention.archive, name, start_utc_s)
    if not path.is_file():
        return None
    found = arrival_of(site, path)
    log = found.log or _log_of(site, site.scans.inbox / name)
    return Arrival(name, path, log, found.size, found.mtime_ns)


def archived(archive: Path, name: str, start_utc_s: float) -> Path:
    """Return the place of a scan in an archive: a folder a month."""
    return archive / datetime.fromtimestamp(start_utc_s, UTC).strftime("%Y/%m") / name


def _log_of(site: Site, scan: Path) -> Path | None:
    if site.inclination is None:
        return None
    beside = scan.with_name(f"{scan.stem}{site.inclination.suffix}").absolute()
    return beside if beside.is_file() and not beside.is_symlink() else None
