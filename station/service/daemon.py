"""The service: one loop that polls the inbox, processes scan after scan and waits out transient faults.

File events, scheduler and signals only put an event into its queue. All work is done in the loop, between
two scans.
"""

from __future__ import annotations

import faulthandler
import logging
import math
import os
import signal
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from queue import Empty
from typing import TYPE_CHECKING, NamedTuple, Protocol

from station.config import Site, read_site
from station.errors import ConfigError, NotReadyError, StationError
from station.inbox.inbox import Inbox
from station.inbox.journal import Journal
from station.inbox.journal_reader import State
from station.inbox.listing import ScanFile
from station.inbox.lock import LockedFolder, exclusive_lock, require_known
from station.logs import log_to_stderr, logfmt
from station.monitoring.arrivals import Arrivals
from station.monitoring.metrics import Metrics
from station.monitoring.preconditions import EARLIEST_S, clock_problem, require_disk_space
from station.processing.workers import fork_server
from station.readers.formats.conversion import scan_suffixes
from station.scan_names import folder_depth
from station.service.host import Host
from station.service.inbox_watcher import InboxWatcher
from station.service.scheduler import JobScheduler, LoopEvent

if TYPE_CHECKING:
    from collections.abc import Callable

log = logging.getLogger("station")


class ScanProcessor(Protocol):
    """What the loop needs of a worker; see `worker.Worker`."""

    def recover(self) -> None: ...  # noqa: D102
    def process(self, scan: ScanFile, *, ahead: bool = False) -> bool: ...  # noqa: D102
    def precheck(self, scan: ScanFile) -> None: ...  # noqa: D102
    def start_compaction(self) -> None: ...  # noqa: D102
    def publish_compacted(self) -> None: ...  # noqa: D102
    def close(self) -> None: ...  # noqa: D102
    def run_maintenance(self) -> None: ...  # noqa: D102
    def proceed_with_renewals(self) -> None: ...  # noqa: D102


class Components(NamedTuple):
    """What depends on the site file and is made again when it is reloaded."""

    worker: ScanProcessor
    inbox: Inbox
    watcher: InboxWatcher
    scheduler: JobScheduler

    def close(self) -> None:
        """End the worker's processes, the watcher's thread and the scheduler."""
        self.worker.close()
        self.watcher.close()
        self.scheduler.stop()


@dataclass(frozen=True)
class LoopTiming:
    """Waiting times of the loop [s]."""

    period_s: float = 60.0  # between two polls of the inbox without an event
    debounce_s: float = 1.0  # minimum between two polls, however many events arrive
    grace_s: float = 60.0  # for the running scan when the service is to stop
    first_pause_s: float = 5.0  # after a store error; doubled up to period_s
    give_up_s: float = 300.0  # without any worker process, after which systemd is to restart the service
    clock_wait_s: float = 3600.0  # for a doubtful clock; an impossible one is waited for without limit


def run(
    site_path: Path,
    *,
    make_worker: Callable[..., ScanProcessor] | None = None,
    timing: LoopTiming | None = None,
    host: Host | None = None,
) -> int:
    """Run the service until a signal stops it; return the exit status.

    Raises ConfigError if the site file cannot be used, NotReadyError if another process has locked the data
    folder, StoreError if that folder cannot be created.
    """
    log_to_stderr()
    if make_worker is None:
        with suppress(OSError):  # the first scan tries again
            fork_server.ensure_running()  # it imports modules while this process does
        from station.service.worker import Worker  # noqa: PLC0415 - a second of imports that tests avoid

        make_worker = Worker
    faulthandler.enable()  # the watchdog's SIGABRT then prints where the loop hung
    daemon = Daemon(site_path, make_worker, timing or LoopTiming(), host or Host())
    signal.signal(signal.SIGTERM, lambda *_: daemon.stop())
    signal.signal(signal.SIGINT, lambda *_: daemon.stop())
    signal.signal(signal.SIGHUP, lambda *_: daemon.post(LoopEvent.RELOAD))
    daemon.serve()
    return 0


class Daemon:
    """The loop of the service and its state between two iterations."""

    def __init__(
        self,
        site_path: Path,
        make_worker: Callable[..., ScanProcessor],
        timing: LoopTiming,
        host: Host,
    ) -> None:
        self._site_path = site_path
        self._site = read_site(site_path)
        self._make_worker = make_worker
        self._timing = timing
        self._host = host
        self._clock = host.clock
        self._systemd = host.systemd
        self._events = host.events
        # Housekeeping is due at start: some stations never run at night.
        self._due = {LoopEvent.OVERDUE_CHECK, LoopEvent.COMPACT, LoopEvent.MAINTENANCE}
        self._stop_deadline_s = math.inf  # monotonic time at which the running scan is abandoned
        self._consecutive_faults = 0
        self._last_poll_s = -math.inf
        self._arrivals = Arrivals(self._clock.monotonic_s)
        self._site_file_fault = ""  # why the last reload was rejected
        self._exit_stack = ExitStack()
        self._folder: LockedFolder
        self._journal: Journal | None = None
        self._open_components: Components | None = None
        self._is_reconciled = False
        self._metrics = Metrics(lambda: self._site)

    def post(self, event: LoopEvent) -> None:
        """Queue an event for after the running scan; safe from any thread or signal handler."""
        self._events.put(event)

    def stop(self) -> None:
        """End the loop after the running scan, or after `grace_s`; a second call ends it at once."""
        now_s = self._clock.monotonic_s()
        self._stop_deadline_s = now_s if self._is_stopping() else now_s + self._timing.grace_s
        self._systemd.stopping()
        self._events.put(LoopEvent.STOP)

    def serve(self) -> None:
        """Run the loop until `stop` is called; raise NotReadyError if only a restart helps."""
        self._wait_for_clock()
        data = self._site.station.data
        self._require_known_folder()
        with exclusive_lock(data) as self._folder, self._metrics.serving(), self._exit_stack:
            self._require_known_folder()  # remembers the one that the lock has just created
            self._exit_stack.callback(self._close_components)
            while not self._is_stopping():
                try:
                    wait_s = self._iterate()
                    self._resume()
                except StationError as error:
                    wait_s = self._pause(error)
                    self._systemd.ready()  # up although paused: a restart would gain nothing
                self._require_no_restart()
                self._wait(wait_s)
            log.info(logfmt(service="stopped"))

    def _require_known_folder(self) -> None:
        if state_folder := os.environ.get("STATE_DIRECTORY", "").partition(":")[0]:
            require_known(self._site.station.data, Path(state_folder))

    # ---- one iteration

    def _iterate(self) -> float:
        """Do what is due and process one scan; return the time until the next work is due [s]."""
        self._systemd.watchdog()
        if LoopEvent.RELOAD in self._due:
            self._due.discard(LoopEvent.RELOAD)
            self._reload()
        self._folder.require_same()
        require_disk_space(self._site)
        worker, inbox, watcher, scheduler = self._components()
        watcher.ensure_watching()
        if step_s := scheduler.resync_clock():
            log.warning(logfmt(clock="set", step_s=round(step_s)))
        if LoopEvent.OVERDUE_CHECK in self._due:
            self._due.discard(LoopEvent.OVERDUE_CHECK)
            self._arrivals.check(self._site.scans.expected_every_s)
            self._metrics.write()
        if LoopEvent.COMPACTED in self._due:
            self._due.discard(LoopEvent.COMPACTED)
            self._guarded(LoopEvent.COMPACTED, worker.publish_compacted)
        self._last_poll_s = self._clock.monotonic_s()
        state = inbox.poll()
        self._arrivals.record(state.new)
        if state.first is None and state.to_precheck is not None:
            worker.precheck(state.to_precheck)
            return 0.0
        if state.first is None:
            self._housekeeping(worker)
            worker.proceed_with_renewals()
            self._report_idle()
            return min(self._timing.period_s, state.next_s)
        self._systemd.status(f"measuring {state.first.name}, {state.queued - 1} more waiting")
        self._process(worker, state.first, ahead=state.ahead)
        return 0.0

    def _process(self, worker: ScanProcessor, scan: ScanFile, *, ahead: bool) -> None:
        try:
            worker.process(scan, ahead=ahead)
        except StationError:
            self._is_reconciled = False  # it may have stopped between writing the file and the journal
            raise
        except Exception as bug:  # a bug triggered by one scan must not block the others
            log.exception(logfmt(scan=scan.name, verdict="later", reason="a bug: please report it"))
            cause = f"{type(bug).__name__}: {bug}".strip().splitlines()[-1]  # of a traceback the last line
            reason = f"a bug: {cause}"[:500]
            self._open_journal().record_failure(scan.name, reason, self._site.judging_conditions)

    def _housekeeping(self, worker: ScanProcessor) -> None:
        """Run scheduled tasks while no scan is waiting; a failed task runs again at its next time."""
        for event, task in (
            (LoopEvent.COMPACT, worker.start_compaction),
            (LoopEvent.MAINTENANCE, worker.run_maintenance),
        ):
            if event in self._due and not self._is_stopping():
                self._due.discard(event)
                self._guarded(event, task)

    def _guarded(self, event: LoopEvent, task: Callable[[], None]) -> None:
        """Run a task and log any bug in it: housekeeping must not block the scans."""
        try:
            task()
        except StationError:
            self._is_reconciled = False  # it may have stopped between two steps of a repair
            raise
        except Exception:
            log.exception(logfmt(failed=event.name.lower(), reason="a bug: please report it"))

    # ---- opening, reloading

    def _components(self) -> Components:
        """Return the components; create them on first use and reconcile journal and store."""
        if self._open_components is None:
            self._open_components = self._create_components(self._site)
        if not self._is_reconciled:
            self._systemd.status("reconciling journal and store")
            self._open_components.worker.recover()
            self._is_reconciled = True
            self._systemd.ready()
            log.info(logfmt(service="running", station=self._site.station.id, inbox=self._site.scans.inbox))
        return self._open_components

    def _create_components(self, site: Site) -> Components:
        journal = self._open_journal()
        worker = self._make_worker(
            site,
            journal,
            on_progress=self._systemd.watchdog,
            before_task=self._folder.require_same,
            should_stop=lambda: self._clock.monotonic_s() > self._stop_deadline_s,
            on_compacted=lambda: self.post(LoopEvent.COMPACTED),
            in_service=True,
            host=self._host,
        )
        suffixes = scan_suffixes(site.scans)
        inbox = Inbox(site, journal, suffixes, monotonic_s=self._clock.monotonic_s, now_s=self._clock.now_s)
        watcher = self._host.make_watcher(
            site.scans.inbox,
            lambda: self.post(LoopEvent.INBOX_CHANGED),
            polling=site.scans.polling,
            recursive=folder_depth(site.scans.pattern) > 0,
        )
        scheduler = self._host.make_scheduler(
            self.post,
            expected_every_s=site.scans.expected_every_s,
            monotonic_s=self._clock.monotonic_s,
            now_s=self._clock.now_s,
        )
        return Components(worker, inbox, watcher, scheduler)

    def _open_journal(self) -> Journal:
        if self._journal is None:
            self._journal = self._exit_stack.enter_context(
                Journal(self._site.station.data / "journal.sqlite", now_s=self._clock.now_s)
            )
        return self._journal

    def _reload(self) -> None:
        """Read the site file again; if it cannot be used, log why and keep the old one."""
        self._systemd.reloading()
        try:
            site = read_site(self._site_path)
            if site.station.data != self._site.station.data:
                raise ConfigError("station.data has changed: restart the service")
            components = self._create_components(site)
        except StationError as error:
            self._site_file_fault = str(error)
            log.error(  # noqa: TRY400 - the message suffices
                logfmt(reload="rejected", kept="the old site file", reason=error)
            )
        else:
            self._close_components()
            self._site, self._open_components, self._site_file_fault = site, components, ""
            self._due.add(LoopEvent.MAINTENANCE)  # reports how many epochs have outdated settings
            log.info(logfmt(reload="done", station=site.station.id))
        self._systemd.ready()

    def _close_components(self) -> None:
        if self._open_components is not None:
            self._open_components.close()
            self._open_components = None

    # ---- faults, waiting, stopping

    def _require_no_restart(self) -> None:
        """Raise NotReadyError if only a restart by systemd helps."""
        if self._is_stopping():
            return
        lost_s = self._host.tasks.seconds_without_worker()
        if lost_s > self._timing.give_up_s:
            raise NotReadyError(f"no worker process could be started for {lost_s:.0f} s: restart the service")
        if self._folder.is_remounted():
            raise NotReadyError(f"{self._site.station.data} was mounted again: restart the service")

    def _pause(self, error: StationError) -> float:
        """Log the first of consecutive faults; return the pause before the next attempt [s]."""
        pause_s = min(self._timing.first_pause_s * 2.0**self._consecutive_faults, self._timing.period_s)
        self._systemd.status(f"paused: {error}")
        self._folder.record_pause(str(error))
        if self._consecutive_faults == 0 and not self._is_stopping():
            log.error(logfmt(service="paused", reason=error))
        self._consecutive_faults = min(self._consecutive_faults + 1, 20)
        return pause_s

    def _resume(self) -> None:
        if self._consecutive_faults:
            self._consecutive_faults = 0
            self._folder.record_pause("")
            log.info(logfmt(service="resumed"))

    def _wait(self, wait_s: float) -> None:
        """Wait until something is due; inbox events shorten the wait, except after a fault."""
        deadline_s = self._clock.monotonic_s() + wait_s
        while True:
            remaining_s = max(0.0, deadline_s - self._clock.monotonic_s())
            try:
                event = self._events.get(timeout=min(remaining_s, self._systemd.max_wait_s))
            except Empty:
                self._systemd.watchdog()
                if deadline_s <= self._clock.monotonic_s():
                    return
                continue
            if event is LoopEvent.INBOX_CHANGED:
                if not self._consecutive_faults:
                    deadline_s = min(deadline_s, self._last_poll_s + self._timing.debounce_s)
                continue
            if event is not LoopEvent.STOP:
                self._due.add(event)
            deadline_s = 0.0

    def _wait_for_clock(self) -> None:
        """Wait until the clock is plausible (service.md, 4)."""
        deadline_s = self._clock.monotonic_s() + self._timing.clock_wait_s
        data, now_s = self._site.station.data, self._clock.now_s
        while (problem := clock_problem(data, now_s())) and not self._is_stopping():
            if now_s() > EARLIEST_S and self._clock.monotonic_s() > deadline_s:
                log.warning(logfmt(clock="doubtful", reason=problem, does="starting anyway"))
                return
            self._systemd.status(f"waiting: {problem}")
            self._pause_for_clock(problem)

    def _pause_for_clock(self, problem: str) -> None:
        if self._consecutive_faults == 0:
            log.error(logfmt(service="waiting", reason=problem))
        self._consecutive_faults = 1
        self._wait(self._timing.first_pause_s)

    def _is_stopping(self) -> bool:
        return self._stop_deadline_s < math.inf

    # ---- reports

    def _report_idle(self) -> None:
        counts = self._open_journal().counts()
        waiting = counts[State.WAITING] + counts[State.LATER]
        text = f"{counts[State.STORED]} stored, {waiting} waiting, {counts[State.SET_ASIDE]} set aside"
        if self._arrivals.is_overdue:
            text += "; a scan is overdue"
        if self._site_file_fault:
            text += f"; the new site file was rejected, the old one is in use: {self._site_file_fault}"
        self._systemd.status(text)
