"""Paths of a scan and its inclination log, in the inbox or in the archive of raw scans."""

from __future__ import annotations

import stat
from datetime import UTC, datetime
from pathlib import Path

from station.config import Site
from station.errors import NotReadyError
from station.inbox.inbox import ScanFile
from station.scan_names import scan_stem


def is_present(path: Path) -> bool:
    """Return True if a path is that of a file; raise NotReadyError if the folder or disk does not tell."""
    try:
        return stat.S_ISREG(path.stat().st_mode)
    except (FileNotFoundError, NotADirectoryError):
        return False
    except OSError as error:  # as Path.is_file raises it, the service would take it for a bug
        raise NotReadyError(f"{path}: cannot be read: {error.strerror}") from error


def scan_file(site: Site, path: Path) -> ScanFile:
    """Return a scan with its inclination log, if that is in the same folder."""
    status = path.lstat()
    return ScanFile(path.name, path.absolute(), _log_path(site, path), status.st_size, status.st_mtime_ns)


def find_scan(site: Site, name: str, start_utc_s: float | None) -> ScanFile | None:
    """Return a processed scan from the inbox or the archive; None if it no longer exists.

    If the log arrived after the scan was archived, it is taken from the inbox.
    """
    path = site.scans.inbox / name
    if is_present(path) and not path.is_symlink():
        return scan_file(site, path)
    if site.retention.archive is None or start_utc_s is None:
        return None
    path = archive_path(site.retention.archive, name, start_utc_s)
    if not is_present(path):
        return None
    scan = scan_file(site, path)
    log = scan.log or _log_path(site, site.scans.inbox / name)
    return ScanFile(name, path, log, scan.size, scan.mtime_ns)


def archive_path(archive: Path, name: str, start_utc_s: float) -> Path:
    """Return the path of a scan in the archive: one folder per month."""
    return archive / datetime.fromtimestamp(start_utc_s, UTC).strftime("%Y/%m") / name


def _log_path(site: Site, scan: Path) -> Path | None:
    if site.inclination is None:
        return None
    log_path = scan.with_name(f"{scan_stem(scan)}{site.inclination.suffix}").absolute()
    return log_path if is_present(log_path) and not log_path.is_symlink() else None
