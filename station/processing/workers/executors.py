"""Executors that reprocess several scans at once: the interface, and the one for this machine.

`dask_executor` is the one for a cluster.
"""

from __future__ import annotations

import os
import threading
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Protocol

from station.config import Site
from station.inbox.listing import ScanFile
from station.processing.scan_tasks import Rejected, ScanHistory, StoredResult, reprocess_scan
from station.processing.workers import isolation


class Executor(Protocol):
    """Executor that reprocesses up to `count` scans at once."""

    count: int

    def start(self, site: Site, scan: ScanFile, history: ScanHistory) -> Future[StoredResult | Rejected]: ...  # noqa: D102
    def close(self) -> None: ...  # noqa: D102


class LocalExecutor:
    """Executor on this machine: one isolated worker process per scan, as many as cores and memory allow."""

    def __init__(self, site: Site, stop: threading.Event) -> None:
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
        fitting = int(memory / (site.service.memory_gb * 2**30))
        self.count = max(1, min(len(os.sched_getaffinity(0)), fitting))
        self._stop = stop
        self._threads = ThreadPoolExecutor(self.count)

    def start(self, site: Site, scan: ScanFile, history: ScanHistory) -> Future[StoredResult | Rejected]:
        """Start reprocessing a scan."""
        return self._threads.submit(
            isolation.TaskRunner().run,
            reprocess_scan,
            site,
            scan,
            history,
            memory_gb=site.service.memory_gb,
            timeout_s=site.scans.timeout_s,
            should_stop=self._stop.is_set,
        )

    def close(self) -> None:
        """Cancel queued scans and wait for running ones."""
        self._threads.shutdown(cancel_futures=True)
