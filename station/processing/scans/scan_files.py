"""Scans and their inclination logs, in the inbox or in the archive of raw scans."""

from __future__ import annotations

import stat
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from functools import cache
from pathlib import Path

from station.config import Site
from station.errors import NotReadyError
from station.inbox.listing import ScanFile, ScanListing, name_in_journal
from station.readers.formats.conversion import scan_suffixes
from station.scan_names import name_below, path_stem, scan_id, scan_stem


def is_present(path: Path) -> bool:
    """Return True if a path is that of a file; raise NotReadyError if the folder or disk does not tell."""
    try:
        return stat.S_ISREG(path.stat().st_mode)
    except (FileNotFoundError, NotADirectoryError):
        return False
    except OSError as error:  # as Path.is_file raises it, the service would take it for a bug
        raise NotReadyError(f"{path}: cannot be read: {error.strerror}") from error


def scan_file(site: Site, path: Path) -> ScanFile:
    """Return a file as a scan, with its inclination log and registration, if they are in the same folder."""
    status, name = path.lstat(), name_below(path.absolute(), site.scans.pattern)
    log, matrix = _log_path(site, path), _matrix_path(site, path)
    return ScanFile(name, path.absolute(), log, status.st_size, status.st_mtime_ns, matrix=matrix)


def scan_of_files(site: Site, paths: Sequence[Path]) -> list[ScanFile]:
    """Return the scans that files are, in order of their names in the journal."""
    files = sorted((scan_file(site, path) for path in paths), key=lambda file: file.name)
    scans: dict[str, list[ScanFile]] = {}
    for file in files:
        scans.setdefault(name_in_journal(site, file.name), []).append(file)
    return [
        parts[0] if site.epoch is None else joined(name, {part.name: part for part in parts})
        for name, parts in sorted(scans.items())
    ]


def inbox_scans(site: Site) -> list[ScanFile]:
    """Return the scans in the inbox, by their names; raise NotReadyError if it cannot be listed."""
    listing = ScanListing(site, site.scans.inbox, scan_suffixes(site.scans))
    return [listing.scan(name) for name in sorted(listing.scans)]


def find_in_inbox(site: Site, stem: str) -> ScanFile | None:
    """Return the scan in the inbox of a name without suffix, with or without its folders; None without one.

    Raises NotReadyError if it cannot be listed.
    """
    listing = ScanListing(site, site.scans.inbox, scan_suffixes(site.scans))
    names = (name for name in sorted(listing.scans) if stem in {path_stem(name), scan_stem(name)})
    return next((listing.scan(name) for name in names), None)


def joined(name: str, parts: dict[str, ScanFile]) -> ScanFile:
    """Return the epoch of several files, by their names."""
    files = tuple(parts[part] for part in sorted(parts))
    size, mtime_ns = sum(file.size for file in files), max(file.mtime_ns for file in files)
    return ScanFile(name, files[0].path, files[0].log, size, mtime_ns, files)


class ScanFinder:
    """Finds processed scans; the folders of epochs of several files are listed once.

    Methods raise NotReadyError if a folder cannot be read.
    """

    def __init__(self, site: Site) -> None:
        self._site = site
        self._listing = cache(lambda folder: ScanListing(site, folder, scan_suffixes(site.scans)))
        self._names_by_id = cache(
            lambda folder: {scan_id(name): name for name in sorted(self._listing(folder).scans)}
        )

    def in_inbox(self, name: str) -> bool:
        """Return True if a scan, or at least one file of an epoch, lies in the inbox."""
        if self._site.epoch is None:
            return is_present(self._site.scans.inbox / name)
        return name in self._listing(self._site.scans.inbox).scans

    def name_of(self, stored_id: str, start_utc_s: float) -> str | None:
        """Return the name of a scan in the inbox or the archive by that in the store; None without one."""
        folders = [self._site.scans.inbox]
        if self._site.retention.archive is not None:
            folders.append(archive_folder(self._site.retention.archive, start_utc_s))
        names = (self._names_by_id(folder).get(stored_id) for folder in folders if folder.is_dir())
        return next(filter(None, names), None)

    def find(self, name: str, start_utc_s: float | None) -> ScanFile | None:
        """Return a scan from the inbox or the archive; None if it no longer exists.

        If log or registration arrived after the scan was archived, they are taken from the inbox. The files
        of an epoch are those of both folders.
        """
        site, archive = self._site, self._site.retention.archive
        month = None if archive is None or start_utc_s is None else archive_folder(archive, start_utc_s)
        if site.epoch is None:
            return self._find_file(name, month)
        parts: dict[str, ScanFile] = {}
        for folder in (month, site.scans.inbox):
            if folder is not None and folder.is_dir() and name in self._listing(folder).scans:
                parts |= {part.name: part for part in self._listing(folder).scan(name).parts}
        return joined(name, parts) if parts else None

    def _find_file(self, name: str, month: Path | None) -> ScanFile | None:
        path = self._site.scans.inbox / name
        if is_present(path) and not path.is_symlink():
            return scan_file(self._site, path)
        if month is None or not is_present(month / name):
            return None
        scan = scan_file(self._site, month / name)
        return replace(
            scan,
            name=name,
            log=scan.log or _log_path(self._site, path),
            matrix=scan.matrix or _matrix_path(self._site, path),
        )


def find_scan(site: Site, name: str, start_utc_s: float | None) -> ScanFile | None:
    """Return a processed scan (see `ScanFinder.find`)."""
    return ScanFinder(site).find(name, start_utc_s)


def archive_folder(archive: Path, start_utc_s: float) -> Path:
    """Return the folder of a scan in the archive: one per month."""
    return archive / datetime.fromtimestamp(start_utc_s, UTC).strftime("%Y/%m")


def _log_path(site: Site, scan: Path) -> Path | None:
    return _beside(scan, site.inclination.suffix) if site.inclination else None


def _matrix_path(site: Site, scan: Path) -> Path | None:
    return _beside(scan, site.registration.suffix) if site.registration else None


def _beside(scan: Path, suffix: str | None) -> Path | None:
    """Return the file of a suffix beside a scan; None if it is none, or a link."""
    if suffix is None:
        return None
    path = scan.with_name(f"{scan_stem(scan)}{suffix}").absolute()
    return path if is_present(path) and not path.is_symlink() else None
