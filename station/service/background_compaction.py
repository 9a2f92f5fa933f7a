"""Compaction of closed days and months in a process of its own, during scan processing.

A month takes minutes.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from concurrent.futures import Future

from station.config import Site
from station.errors import NotReadyError
from station.processing.store_tasks import MAX_STORE_TASK_S, Checksums, compact_low_priority
from station.service.host import Host


class BackgroundCompaction:
    """A thread that waits for the compaction process; it touches neither journal nor series."""

    def __init__(self, site: Site, on_done: Callable[[], None], host: Host) -> None:
        """`on_done` is called, in another thread, when `result` has something to return."""
        self._site = site
        self._on_done = on_done
        self._stop = threading.Event()
        self._tasks = host.tasks
        self._executor = host.make_executor()
        self._future: Future[Checksums] | None = None

    def start(self, checksums: Mapping[str, str], now_s: float | None) -> None:
        """Start a compaction unless one is running; see `store_tasks.compact_epochs`."""
        if self._future is None:
            self._future = self._executor.submit(self._run, dict(checksums), now_s)
            self._future.add_done_callback(lambda _: self._on_done())

    def result(self) -> Checksums | None:
        """Return the checksums of the compacted files, once; None if no compaction has finished.

        Raises the error of the compaction process: StoreError if a file is damaged or cannot be written.
        """
        if self._future is None or not self._future.done():
            return None
        future, self._future = self._future, None
        try:
            return future.result()
        except NotReadyError:  # stopped, or killed repeatedly: the next scheduled time tries again
            return {}

    def close(self) -> None:
        """Stop the compaction at once; unfinished work is repeated at the next scheduled time."""
        self._stop.set()
        self._executor.shutdown()

    def _run(self, checksums: Mapping[str, str], now_s: float | None) -> Checksums:
        return self._tasks.run(
            compact_low_priority,
            self._site,
            checksums,
            now_s,
            memory_gb=self._site.service.memory_gb,
            timeout_s=MAX_STORE_TASK_S,
            should_stop=self._stop.is_set,
        )
