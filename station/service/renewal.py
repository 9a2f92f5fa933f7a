"""Files that the service renews from the series in a process of its own, while no scan waits."""

from __future__ import annotations

import logging
import os
import threading
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from pathlib import Path

from station.archive.atomic_files import atomic_write
from station.config import Site
from station.errors import NotReadyError, StationError
from station.logs import logfmt
from station.monitoring.status import fault_file, wanted_renewals
from station.processing.store_tasks import LOWEST_PRIORITY, MAX_STORE_TASK_S, renew_derived, renew_levels
from station.processing.workers.worker_process import Progress
from station.service.host import Host
from station.service.mirror import update_mirror

log = logging.getLogger("station")
RenewalTask = Callable[[Site, Progress], str]  # returns why files could not be renewed, or ''
TASKS: dict[str, RenewalTask] = {"mirror": update_mirror, "levels": renew_levels, "derived": renew_derived}


class Renewals:
    """All that the service renews in the background: the mirror, levels, derived files far behind."""

    def __init__(self, site: Site, host: Host) -> None:
        self._by_name = {
            name: Renewal(site, name, TASKS[name], host, is_due=name != "derived")
            for name in wanted_renewals(site)
        }

    def require(self, *, derived: bool) -> None:
        """Renew files when no scan waits: the series has changed; `derived` ones if they are far behind."""
        for name, renewal in self._by_name.items():
            if derived or name != "derived":
                renewal.require()

    def proceed(self) -> None:
        """Record what has finished, and start what is due."""
        for renewal in self._by_name.values():
            renewal.proceed()

    def close(self) -> None:
        """Stop at once; what is unfinished is renewed after the next start."""
        for renewal in self._by_name.values():
            renewal.close()


class Renewal:
    """A thread that waits for the process of a renewal; one that hangs delays no scan.

    A fault is logged once, and shown by `station status` until it is gone. `is_due`: renew at the start.
    """

    def __init__(self, site: Site, name: str, task: RenewalTask, host: Host, *, is_due: bool = True) -> None:
        self._site, self._name, self._task = site, name, task
        self._stop = threading.Event()
        self._tasks = host.tasks
        self._executor = host.make_executor()
        self._future: Future[str] | None = None
        self._is_due, self._fault = is_due or fault_file(site, name).is_file(), ""

    def require(self) -> None:
        """Renew the files when no scan waits: the series has changed."""
        self._is_due = True

    def proceed(self) -> None:
        """Record the result of a finished renewal, and start one if it is due and none is running."""
        fault = self._result()
        if fault is not None and fault != self._fault:
            if fault:
                log.warning("%s", logfmt(**{self._name: "failed"}, reason=fault))
            else:
                log.info("%s", logfmt(**{self._name: "renewed"}))
            self._fault = fault
        if fault is not None:
            _record_fault(fault_file(self._site, self._name), fault)
        if self._is_due and self._future is None and (self._site.station.data / "series.nc").is_file():
            self._is_due = False
            self._future = self._executor.submit(self._run)

    def _result(self) -> str | None:
        """Return why files could not be renewed, or '', once; None if no renewal has finished."""
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
        return self._tasks.run(
            renew_low_priority,
            self._site,
            self._task,
            memory_gb=self._site.service.memory_gb,
            timeout_s=MAX_STORE_TASK_S,
            should_stop=self._stop.is_set,
        )


def renew_low_priority(site: Site, task: RenewalTask, progress: Progress) -> str:
    """Run a renewal at low priority, so that scans come first."""
    with suppress(OSError):  # without permission it runs at normal priority
        os.nice(LOWEST_PRIORITY)
    return task(site, progress)


def _record_fault(path: Path, fault: str) -> None:
    with suppress(StationError, OSError):
        if fault:
            with atomic_write(path) as tmp_path:
                tmp_path.write_text(fault, encoding="utf-8")
        else:
            path.unlink(missing_ok=True)
