"""What becomes of raw scans in the inbox: left there, moved to an archive or deleted, once that is safe."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from pathlib import Path

from station.archive.layout import Series
from station.archive.store import JOINED, joined, rows_in, stored
from station.config import Site
from station.errors import NotReadyError, ScanError
from station.service.content import fingerprint, sha256_of
from station.service.inbox import Arrival
from station.service.journal import Entry
from station.service.places import archived, arrival_of
from station.service.tasks import Progress, series_of, sha256_of_log

MOST_AT_ONCE = 50  # scans a sweep lets go; there are four sweeps a day


def due_to_go(site: Site, entries: Iterable[Entry], kept: set[str]) -> list[str]:
    """Return the stored scans that have been kept long enough, oldest first, but for those in `kept`.

    What is moved can still be read: `kept` is for scans that are deleted.
    """
    given = site.retention
    if given.raw == "leave":
        return []
    sops = {sop.scan for sop in site.sop}  # whose log is looked for in the inbox
    listed = list(entries)
    newest_s = max((entry.start_utc_s or 0.0 for entry in listed), default=0.0)
    before_s = min(time.time(), newest_s) - given.keep_days * 86_400  # a clock far ahead lets nothing go
    found = [
        (entry.start_utc_s, entry.name)
        for entry in listed
        if entry.start_utc_s is not None
        and entry.start_utc_s < before_s
        and entry.outcome is not None
        and Path(entry.name).stem not in sops
        and (given.raw == "move" or entry.name not in kept)
        and (site.scans.inbox / entry.name).is_file()
    ]
    return [name for _, name in sorted(found)[:MOST_AT_ONCE]]


def retire(
    site: Site, entries: Iterable[Entry], files: Mapping[str, str], progress: Progress
) -> list[tuple[str, str, str]]:
    """Move or delete raw scans and their logs; return of each its name, what was done, and why not.

    `kept` are those whose bytes or epoch are not proved by their checksums, of the store in `files`. At one
    that `waits`, as the folders cannot be written, it ends. A file that holds many epochs is read once.
    """
    told: list[tuple[str, str, str]] = []
    proved: set[Path] = set()
    for entry in entries:
        try:
            told.append((entry.name, _retire(site, entry, files, proved, progress), ""))
        except ScanError as error:
            told.append((entry.name, "kept", str(error)))
        except NotReadyError as error:  # it would be so for the others too
            return [*told, (entry.name, "waits", str(error))]
    return told


def _retire(site: Site, entry: Entry, files: Mapping[str, str], proved: set[Path], progress: Progress) -> str:
    """Move or delete a raw scan and its log; say what was done. `proved` files of the store need no proof.

    Raises ScanError where the scan is not the one that was stored or its epoch is not proved; NotReadyError
    where the folders cannot be written. Nothing is lost then.
    """
    arrival = arrival_of(site, site.scans.inbox / entry.name)
    before = fingerprint(arrival.path)
    _require_proved(site, arrival, entry, files, proved, progress)
    going = [path for path in (arrival.log, arrival.path) if path is not None]  # the scan goes last
    archive = site.retention.archive
    try:
        if not os.access(site.scans.inbox, os.W_OK):
            raise NotReadyError(
                f"{site.scans.inbox} is read-only: with systemd give ReadWritePaths={site.scans.inbox}"
                " in a drop-in (systemctl edit), and the group the right to write"
            )
        if site.retention.raw == "move" and archive is not None:
            folder = archived(archive, entry.name, entry.start_utc_s or 0.0).parent
            for path in going:
                _copy(path, folder / path.name, sha256_of(path), progress)
        if fingerprint(arrival.path) != before:
            raise NotReadyError("the scan changed meanwhile")
        for path in going:
            path.unlink()
    except OSError as error:
        raise NotReadyError(f"cannot be let go: {error}") from error
    return "moved" if site.retention.raw == "move" else "deleted"


def _require_proved(
    site: Site,
    arrival: Arrival,
    entry: Entry,
    files: Mapping[str, str],
    proved: set[Path],
    progress: Progress,
) -> None:
    """Raise ScanError unless these very bytes are stored, in a file of the right checksum."""
    if sha256_of(arrival.path) != entry.sha256:
        raise ScanError("the scan is not the one that was stored: kept")
    if sha256_of_log(arrival) not in {"", entry.log_sha256}:
        raise ScanError("its inclination log is not the one it was measured with: kept (station reprocess)")
    progress()
    series = series_of(site)
    holder = _holder(series, entry)
    if holder in proved:
        return
    name = str(holder.relative_to(series.folder)) if holder else ""
    if holder is None or name not in files or sha256_of(holder) != files[name]:
        raise ScanError(f"its epoch {entry.epoch} is missing or damaged: kept (station check --store)")
    proved.add(holder)


def _holder(series: Series, entry: Entry) -> Path | None:
    """Return the file that holds a row's epoch: itself, or the newest joined one."""
    path = series.folder / str(entry.epoch)
    told = stored(path)
    if path.is_file() or told is None:
        return path if told else None
    for kind, stamp in JOINED.items():
        for joint in reversed(joined(series, kind, told.start.strftime(stamp))):
            if any(row.epoch_file == path.name for row in rows_in(joint)):
                return joint
    return None


def _copy(path: Path, place: Path, sha256: str, progress: Progress) -> None:
    """Copy a file for good: synced, read again, named last. One of the same bytes there stays."""
    if place.exists():
        if sha256_of(place) == sha256:
            return
        stamp = datetime.fromtimestamp(path.stat().st_mtime, UTC).strftime("%Y%m%dT%H%M%SZ")
        raise ScanError(f"{place} holds other bytes: rename that one (e.g. to {place.name}.{stamp})")
    place.parent.mkdir(parents=True, exist_ok=True)
    beside = place.with_name(f".{place.name}.part")
    try:
        shutil.copyfile(path, beside, follow_symlinks=False)
        shutil.copystat(path, beside, follow_symlinks=False)
        progress()
        _sync(beside)
        if sha256_of(beside) != sha256:
            raise ScanError(f"{place}: reads otherwise than it was written: is the disk failing?")
        beside.replace(place)
        _sync(place.parent)
    finally:
        beside.unlink(missing_ok=True)


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
