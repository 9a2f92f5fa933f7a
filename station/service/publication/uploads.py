"""Sending the files of a station to one target: what is missing there, newest first, within its limits."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path

from station.archive.atomic_files import DAMAGED
from station.archive.epochs import COMPACTED, epochs_in_file, parse_epoch_filename
from station.config import Site
from station.errors import StationError, StoreError
from station.monitoring.preconditions import require_disk_space
from station.monitoring.status import publish_folder
from station.sections.publish import PublishTarget
from station.service.publication import rclone
from station.service.publication.upload_record import SourceFile, UploadRecord

FILES = {  # patterns below the data folder, by the word for them in the site file
    "page": ("page/**/*",),
    "areas": ("areas.nc", "products/*.nc"),
    "events": ("events.geojson",),
    "digest": ("digest/*.txt",),
    "geotiff": ("geotiff/**/*",),
    "levels": ("levels/*/*.nc",),
    "epochs": ("reference_*.nc", "epochs/*/*/*/*.nc", "days/**/*.nc", "months/**/*.nc"),
}
IMMUTABLE = {"digest", "epochs"}  # their files never change once they are written
BATCH_BYTES = 16_000_000  # after which newer files get their turn
BATCH_FILES = 1000


def upload(site: Site, target: PublishTarget, *, now_s: Callable[[], float] = time.time) -> tuple[int, str]:
    """Send a target what it lacks until it has all or a limit is reached; return files sent, and the fault.

    What could not be sent is sent by the next call. Raises StoreError if the record cannot be kept,
    ConfigError without rclone.
    """
    count = 0
    with UploadRecord(publish_folder(site)) as record:
        while True:
            if fault := _folder_fault(site, target):
                return count, fault
            budget = _remaining_bytes(record, target, now_s())
            batch, what, fault = _next_batch(site, target, record, budget)
            if not batch:
                return count, fault
            sent, fault = _send(site, target, record, batch, what=what, day=_day(now_s()))
            count += sent
            if fault or not sent:
                return count, fault or "the files change while they are sent"


def _send(
    site: Site, target: PublishTarget, record: UploadRecord, batch: list[SourceFile], *, what: str, day: str
) -> tuple[int, str]:
    """Send files and record which arrived; bytes count before they are sent, so that a crash hides none."""
    to, data = str(target.to), site.station.data
    reserved = sum(file.size for file in batch)
    record.add_traffic(to, day, reserved)
    transfer = rclone.copy(
        data,
        [file.path for file in batch],
        to,
        oldest_first=what == "page",  # its index is written last
        immutable=what in IMMUTABLE,
        bandwidth_kbit_s=target.bandwidth_kbit_s,
    )
    record.add_traffic(to, day, transfer.sent_bytes - reserved)
    # A file that is gone now may have been gone before rclone reached it.
    arrived = [file for file in batch if file.path in transfer.copied and (data / file.path).exists()]
    record.add_sent(to, arrived)
    return len(arrived), transfer.fault


def _next_batch(
    site: Site, target: PublishTarget, record: UploadRecord, budget: float
) -> tuple[list[SourceFile], str, str]:
    """Return the next files to send, the kind they are of, and why others cannot be sent."""
    fault = ""
    for what in target.what:
        batch, size = list[SourceFile](), 0
        for file in _due_files(site, target, record, what):
            if target.daily_mb and file.size > target.daily_mb * 1e6:
                fault = f"{file.path} has {file.size / 1e6:.1f} MB, more than daily_mb: increase it"
                continue
            is_full = len(batch) >= BATCH_FILES or (batch and size + file.size > BATCH_BYTES)
            if is_full or size + file.size > budget:
                break
            batch.append(file)
            size += file.size
        if batch:
            return batch, what, fault
    return [], "", fault


def _due_files(site: Site, target: PublishTarget, record: UploadRecord, what: str) -> Iterator[SourceFile]:
    """Yield the files that a target lacks, newest first."""
    to, data = str(target.to), site.station.data
    sent, epochs = record.sent(to), record.epochs(to)
    files = (_source_file(data, path) for pattern in FILES[what] for path in data.glob(pattern))
    due = [file for file in files if file and sent.get(file.path) != (file.size, file.mtime_ns)]
    for file in sorted(due, key=lambda file: file.mtime_ns, reverse=True):
        if what != "epochs":
            yield file
            continue
        names = _epoch_names(data / file.path)
        if file.path.startswith(tuple(COMPACTED)) and epochs.issuperset(names):
            record.add_sent(to, [file])  # all its epochs were sent one by one
        else:
            yield SourceFile(file.path, file.size, file.mtime_ns, names)


def _source_file(data: Path, path: Path) -> SourceFile | None:
    """Return a file with size and time; None for folders, and files being written or damaged."""
    if path.name.startswith(".") or path.name.endswith(DAMAGED) or not path.is_file():
        return None
    try:
        status = path.stat()
    except OSError:  # deleted since it was listed
        return None
    return SourceFile(os.path.relpath(path, data), status.st_size, status.st_mtime_ns)


def _epoch_names(path: Path) -> tuple[str, ...]:
    if parse_epoch_filename(path):
        return (path.name,)
    if path.name.startswith("reference_"):
        return ()
    try:
        return tuple(ref.epoch_file for ref in epochs_in_file(path))
    except StoreError:  # damaged: `check --store` and the service report it; the copy may still be of use
        return ()


def _remaining_bytes(record: UploadRecord, target: PublishTarget, now_s: float) -> float:
    if target.daily_mb is None:
        return float("inf")
    return target.daily_mb * 1e6 - record.traffic_bytes(str(target.to), _day(now_s))


def _day(now_s: float) -> str:
    return f"{datetime.fromtimestamp(now_s, UTC):%Y-%m-%d}"


def _folder_fault(site: Site, target: PublishTarget) -> str:
    """Return why a folder cannot be published to; '' if it can, or is a remote."""
    if not isinstance(target.to, Path):
        return ""
    if not target.to.is_dir():
        return "no such folder: mount its disk, or create it"
    try:
        if target.to.stat().st_dev == site.station.data.stat().st_dev:
            require_disk_space(site)  # scans come first
    except (OSError, StationError) as error:
        return str(error)
    return ""
