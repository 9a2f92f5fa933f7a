"""Retention of raw scans: left in the inbox, moved to an archive, or deleted, once that is safe."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from pathlib import Path

from station.archive.epochs import COMPACTED, compacted_files, epochs_in_file, parse_epoch_filename
from station.archive.netcdf_layout import Series
from station.config import Site
from station.errors import NotReadyError, ScanError
from station.inbox.file_hash import file_identity, sha256_file, sha256_files
from station.inbox.journal_reader import Entry
from station.inbox.listing import ScanFile
from station.processing.scans.scan_files import ScanFinder, archive_folder, find_scan
from station.processing.site_files import series_for, sha256_log
from station.processing.workers.worker_process import Progress
from station.scan_names import path_stem, scan_stem

MAX_PER_RUN = 50  # scans per maintenance run; there are four runs a day


def expired_scans(site: Site, entries: Iterable[Entry], reserved: set[str], now_s: float) -> list[str]:
    """Return the names of stored scans older than `keep_days`, oldest first, except those in `reserved`.

    Moved scans can still be read, so `reserved` applies only to deletion.
    """
    settings = site.retention
    if settings.raw == "leave":
        return []
    sop_scans = {sop.scan for sop in site.sop}  # their logs are searched for in the inbox
    finder = ScanFinder(site)
    all_entries = list(entries)
    newest_s = max((entry.start_utc_s or 0.0 for entry in all_entries), default=0.0)
    cutoff_s = min(now_s, newest_s) - settings.keep_days * 86_400  # a clock far ahead expires nothing
    candidates = [
        (entry.start_utc_s, entry.name)
        for entry in all_entries
        if entry.start_utc_s is not None
        and entry.start_utc_s < cutoff_s
        and entry.outcome is not None
        and not sop_scans & {path_stem(entry.name), scan_stem(entry.name)}
        and (settings.raw == "move" or entry.name not in reserved)
        and finder.in_inbox(entry.name)
    ]
    return [name for _, name in sorted(candidates)[:MAX_PER_RUN]]


def apply_retention(
    site: Site, entries: Iterable[Entry], files: Mapping[str, str], progress: Progress
) -> list[tuple[str, str, str]]:
    """Move or delete raw scans and their logs; return (name, action, reason) for each.

    The action is "kept" if the checksums of scan, log or epoch do not match; `files` has those of the store.
    It is "waits" if the folders cannot be written; the run then ends. A file of many epochs is read once.
    """
    actions: list[tuple[str, str, str]] = []
    verified: set[Path] = set()
    for entry in entries:
        try:
            actions.append((entry.name, _move_or_delete(site, entry, files, verified, progress), ""))
        except ScanError as error:
            actions.append((entry.name, "kept", str(error)))
        except NotReadyError as error:  # the others would fail likewise
            return [*actions, (entry.name, "waits", str(error))]
    return actions


def _move_or_delete(
    site: Site, entry: Entry, files: Mapping[str, str], verified: set[Path], progress: Progress
) -> str:
    """Move or delete a raw scan and its log; return "moved" or "deleted".

    Store files in `verified` are not read again. Raises ScanError if the scan is not the stored one or its
    epoch cannot be verified, NotReadyError if the folders cannot be written. Nothing is lost then.
    """
    scan = find_scan(site, entry.name, entry.start_utc_s)
    if scan is None:
        raise ScanError("kept: the scan is no regular file, or no longer there")
    identities = [file_identity(path) for path in scan.paths]
    _require_verified(site, scan, entry, files, verified, progress)
    inbox, archive = site.scans.inbox, site.retention.archive
    # The scans last; what an interrupted run has moved stays where it is.
    paths = [path for path in (*scan.logs, *scan.matrices, *scan.paths) if path.is_relative_to(inbox)]
    try:
        for folder in {path.parent for path in paths}:
            _require_writable(folder)
        if site.retention.raw == "move" and archive is not None:
            month = archive_folder(archive, entry.start_utc_s or 0.0)
            for path in paths:
                _copy(path, month / path.relative_to(inbox), sha256_file(path), progress)
        if [file_identity(path) for path in scan.paths] != identities:
            raise NotReadyError("the scan has changed since it was checked")
        for path in paths:
            path.unlink()
    except OSError as error:
        raise NotReadyError(f"cannot be moved or deleted: {error}") from error
    return "moved" if site.retention.raw == "move" else "deleted"


def _require_writable(folder: Path) -> None:
    if not os.access(folder, os.W_OK):
        raise NotReadyError(
            f"{folder} is read-only: with systemd, add ReadWritePaths={folder}"
            " in a drop-in (systemctl edit) and give the group write permission"
        )


def _require_verified(
    site: Site,
    scan: ScanFile,
    entry: Entry,
    files: Mapping[str, str],
    verified: set[Path],
    progress: Progress,
) -> None:
    """Raise ScanError unless exactly these bytes are stored, in a file with the right checksum."""
    if sha256_files(scan.paths) != entry.sha256:
        raise ScanError("kept: the scan is not the one that was stored")
    if sha256_log(scan) not in {"", entry.log_sha256}:
        raise ScanError(
            "kept: its inclination log is not the one it was measured with (run station reprocess)"
        )
    progress()
    series = series_for(site)
    holding_file = _file_holding(series, entry)
    if holding_file in verified:
        return
    name = str(holding_file.relative_to(series.folder)) if holding_file else ""
    if holding_file is None or name not in files or sha256_file(holding_file) != files[name]:
        raise ScanError(f"kept: its epoch {entry.epoch} is missing or damaged (run station check --store)")
    verified.add(holding_file)


def _file_holding(series: Series, entry: Entry) -> Path | None:
    """Return the file that holds an entry's epoch: its own, or the newest compacted one; None without."""
    path = series.folder / str(entry.epoch)
    parsed = parse_epoch_filename(path)
    if path.is_file() or parsed is None:
        return path if parsed else None
    for kind, date_format in COMPACTED.items():
        for compacted_file in reversed(compacted_files(series, kind, parsed.start.strftime(date_format))):
            if any(epoch.epoch_file == path.name for epoch in epochs_in_file(compacted_file)):
                return compacted_file
    return None


def _copy(path: Path, target: Path, sha256: str, progress: Progress) -> None:
    """Copy a file durably: sync, read back, then rename. An identical file at the target is left as it is."""
    if target.exists():
        if sha256_file(target) == sha256:
            return
        timestamp = datetime.fromtimestamp(path.stat().st_mtime, UTC).strftime("%Y%m%dT%H%M%SZ")
        raise ScanError(f"{target} holds other bytes: rename it (e.g. to {target.name}.{timestamp})")
    target.parent.mkdir(parents=True, exist_ok=True)
    tmp_path = target.with_name(f".{target.name}.part")
    try:
        shutil.copyfile(path, tmp_path, follow_symlinks=False)
        shutil.copystat(path, tmp_path, follow_symlinks=False)
        progress()
        _sync(tmp_path)
        if sha256_file(tmp_path) != sha256:
            raise ScanError(f"{target}: reads back differently from what was written: is the disk failing?")
        tmp_path.replace(target)
        _sync(target.parent)
    finally:
        tmp_path.unlink(missing_ok=True)


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
