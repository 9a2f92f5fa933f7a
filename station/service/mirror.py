"""The mirror: descriptions of the series for the cloud and for data servers, renewed by the service."""

from __future__ import annotations

import os
import threading
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from station.archive.atomic_files import atomic_write
from station.config import Site
from station.errors import NotReadyError, StationError
from station.monitoring.status import MIRROR_FAULT
from station.processing import isolation
from station.processing.scan_tasks import Progress, series_for
from station.processing.store_tasks import LOWEST_PRIORITY, MAX_STORE_TASK_S
from station.products.area_tables import Span
from station.products.exports.formats import FORMATS
from station.products.exports.selection import pending, select, split

PERIODS = {"references": "1D"}  # of each file: one for all days would be written again with each epoch


def update_mirror(site: Site, progress: Progress) -> str:
    """Renew the files of the mirror whose epochs have changed; return why some could not be, or ''.

    Each file is replaced atomically.
    """
    with suppress(OSError):  # without permission it runs at normal priority
        os.nice(LOWEST_PRIORITY)
    faults = []
    for kind in site.mirror.formats if site.mirror else ():
        progress()
        try:
            _renew(site, kind, progress)
        except (StationError, OSError) as error:
            faults.append(f"{kind}: {error}")
    return "; ".join(faults)


def _renew(site: Site, kind: str, progress: Progress) -> None:
    assert site.mirror is not None  # noqa: S101 - the caller's case
    file_format, every = FORMATS[kind], PERIODS.get(kind)
    selection = select(series_for(site), Span.parse(None, None))
    if kind == "references":
        selection = replace(selection, url=site.mirror.url or site.station.data.resolve().as_uri())
    folder = site.mirror.folder
    folder.mkdir(parents=True, exist_ok=True)
    out = folder if every else folder / f"{site.station.id}{file_format.suffix}"
    parts = pending(selection, split(selection, out, file_format.suffix, every), file_format.read_fingerprint)
    for _ in file_format.write(selection, parts, lambda _: progress(), lambda _: progress()):
        progress()


class BackgroundMirror:
    """A thread that waits for the process that renews the mirror; a folder that hangs delays no scan."""

    def __init__(self, site: Site) -> None:
        self._site = site
        self._stop = threading.Event()
        self._executor = ThreadPoolExecutor(max_workers=1)
        self._future: Future[str] | None = None

    def start(self) -> bool:
        """Start to renew the mirror and return True; False while it is being renewed."""
        if self._future is not None:
            return False
        self._future = self._executor.submit(self._run)
        return True

    def result(self) -> str | None:
        """Return why the mirror could not be renewed, or '', once; None if nothing has finished."""
        if self._future is None or not self._future.done():
            return None
        future, self._future = self._future, None
        try:
            return future.result()
        except (StationError, RuntimeError) as error:
            return "" if isinstance(error, NotReadyError) and self._stop.is_set() else str(error)

    def close(self) -> None:
        """Stop at once; what is unfinished is renewed after the next start."""
        self._stop.set()
        self._executor.shutdown()

    def _run(self) -> str:
        return isolation.run_isolated(
            update_mirror,
            self._site,
            memory_gb=self._site.service.memory_gb,
            timeout_s=MAX_STORE_TASK_S,
            should_stop=self._stop.is_set,
        )


def record_mirror_fault(data: Path, fault: str) -> None:
    """Record the fault of the mirror for `station status`; '' if there is none."""
    path = data / MIRROR_FAULT
    with suppress(StationError, OSError):
        if fault:
            with atomic_write(path) as tmp_path:
                tmp_path.write_text(fault, encoding="utf-8")
        else:
            path.unlink(missing_ok=True)
