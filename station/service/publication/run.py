"""One run of `station publish`: notices of new epochs, and the files that each target lacks.

Runs as a process of its own, every minute (`station-publish@.timer`), so that a dead link never delays a
scan. It writes to `publish/` in the data folder only.
"""

from __future__ import annotations

import fcntl
import os
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from pathlib import Path

from station.archive.atomic_files import atomic_write
from station.config import Site
from station.errors import ConfigError, NotReadyError, StationError, StoreError
from station.logs import log_to_stderr
from station.monitoring.status import publish_folder
from station.sections.publish import PublishSection, PublishTarget
from station.service.publication.epoch_notices import send_notices
from station.service.publication.upload_record import UploadRecord
from station.service.publication.uploads import upload

NOTICE_PERIOD_S = 10.0  # while files are sent


def publish_once(site: Site, report: Callable[[str], None]) -> int:
    """Send notices and files once and report each target; return 1 if something failed, else 0.

    Raises ConfigError without `[publish]`, NotReadyError if another process publishes this station,
    StoreError if the data folder cannot be written.
    """
    settings = site.publish
    if settings is None:
        raise ConfigError(f"{site.path}: has no [publish]: nothing to do")
    log_to_stderr()
    os.nice(19)  # scans come first
    folder = publish_folder(site)
    with _single_instance(folder), UploadRecord(folder) as record:
        faults = _publish(site, settings, record, report)
        for fault in faults:
            report(f"failed: {fault}")
        with atomic_write(folder / "faults") as tmp_path:
            tmp_path.write_text("\n".join(faults), encoding="utf-8")
    return 1 if faults else 0


def _publish(
    site: Site, settings: PublishSection, record: UploadRecord, report: Callable[[str], None]
) -> list[str]:
    """Send to all targets at once, so that a slow one delays no other; notices go on meanwhile."""
    notice_faults = _notice_faults(site, settings, record)
    if not settings.target:
        return notice_faults
    with ThreadPoolExecutor(len(settings.target)) as pool:
        uploads = {pool.submit(upload, site, target): target for target in settings.target}
        while wait(uploads, timeout=NOTICE_PERIOD_S).not_done:
            notice_faults = _notice_faults(site, settings, record)
    return [*notice_faults, *_upload_faults(uploads, report)]


def _notice_faults(site: Site, settings: PublishSection, record: UploadRecord) -> list[str]:
    try:
        return send_notices(site, settings, record)
    except StationError as error:  # files are sent all the same
        return [str(error)]


def _upload_faults(
    uploads: dict[Future[tuple[int, str]], PublishTarget], report: Callable[[str], None]
) -> Iterator[str]:
    for finished, target in uploads.items():
        try:
            count, fault = finished.result()
        except StationError as error:  # the other targets get their files all the same
            count, fault = 0, str(error)
        report(f"{target.to}: {count} files sent")
        if fault:
            yield f"{target.to}: {fault}"


@contextmanager
def _single_instance(folder: Path) -> Iterator[None]:
    try:
        folder.mkdir(exist_ok=True)
        descriptor = os.open(folder / "lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o640)
    except OSError as error:
        raise StoreError(f"{folder}: cannot be written: {error.strerror}") from error
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    except BlockingIOError as error:
        raise NotReadyError(f"{folder}: another process is publishing") from error
    finally:
        os.close(descriptor)
