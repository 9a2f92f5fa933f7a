"""The service: one loop that looks at the inbox and takes scans one by one; it waits out what may pass.

Events, clockwork and signals only put a word into its queue; everything is done here, between two scans.
"""

from __future__ import annotations

import faulthandler
import logging
import math
import signal
import time
from contextlib import ExitStack
from dataclasses import dataclass
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Protocol

from station.config import Site, read_site
from station.errors import ConfigError, StationError
from station.readers.scan import suffixes
from station.service import child
from station.service.health import EARLIEST_S, Heart, clock_fault, need_room
from station.service.inbox import Arrival, Inbox
from station.service.jobs import Clockwork, Wake
from station.service.journal import Journal, State
from station.service.lock import only_writer
from station.service.logs import log_to_stderr, logfmt
from station.service.metrics import Metrics
from station.service.watch import Ear

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

log = logging.getLogger("station")


class Takes(Protocol):
    """What the loop asks of a worker; see `worker.Worker`."""

    def recover(self) -> None: ...  # noqa: D102
    def take(self, arrival: Arrival) -> bool: ...  # noqa: D102
    def glance(self, arrival: Arrival) -> None: ...  # noqa: D102
    def begin_joining(self) -> None: ...  # noqa: D102
    def note_joined(self) -> None: ...  # noqa: D102
    def close(self) -> None: ...  # noqa: D102
    def sweep(self) -> None: ...  # noqa: D102


@dataclass(frozen=True)
class Pace:
    """How long the loop waits for what [s]."""

    period_s: float = 60.0  # between two looks at the inbox without any event
    calm_s: float = 1.0  # at least, between two looks, however many events there are
    grace_s: float = 60.0  # for the running scan, when the service is to stop
    first_pause_s: float = 5.0  # after a fault of the store; doubled up to period_s
    clock_s: float = (
        3600.0  # for a clock that may be wrong; one that cannot be right is waited for without end
    )


def run(site_path: Path, *, make_worker: Callable[..., Takes] | None = None, pace: Pace | None = None) -> int:
    """Be the service until told to stop; return the exit status.

    Raises ConfigError where the site file cannot be used, NotReadyError where another process has the data
    folder, StoreError where that folder cannot be made.
    """
    log_to_stderr()
    if make_worker is None:
        child.prepare()  # the server of children loads beside this, what this loads
        from station.service.worker import Worker  # noqa: PLC0415 - a second of imports, which tests do without

        make_worker = Worker
    faulthandler.enable()  # a watchdog's SIGABRT then tells where the loop hung
    daemon = Daemon(site_path, make_worker, pace or Pace())
    signal.signal(signal.SIGTERM, lambda *_: daemon.stop())
    signal.signal(signal.SIGINT, lambda *_: daemon.stop())
    signal.signal(signal.SIGHUP, lambda *_: daemon.wake(Wake.RELOAD))
    daemon.serve()
    return 0


class Daemon:
    """The loop and what it holds between two passes."""

    def __init__(self, site_path: Path, make_worker: Callable[..., Takes], pace: Pace) -> None:
        self._site_path = site_path
        self._site = read_site(site_path)
        self._make_worker = make_worker
        self._pace = pace
        self._heart = Heart()
        # SimpleQueue, because its put() may be called from a signal handler while get() waits.
        self._wakes: SimpleQueue[Wake] = SimpleQueue()
        # Housekeeping too: a station that is never up at night has it done at start.
        self._due = {Wake.EXPECTED, Wake.JOIN, Wake.SWEEP}
        self._stop_s = math.inf  # when a running scan is given up
        self._pauses = 0  # faults in a row
        self._looked_s = -math.inf
        self._last_new_s = time.monotonic()
        self._is_overdue = False
        self._refused_site = ""  # why the last reload was refused
        self._closing = ExitStack()
        self._journal: Journal | None = None
        self._parts: tuple[Takes, Inbox, Ear, Clockwork] | None = None
        self._is_recovered = False
        self._metrics = Metrics(lambda: self._site)

    def wake(self, wake: Wake) -> None:
        """Have the loop do something as soon as the running scan is done; from any thread or signal."""
        self._wakes.put(wake)

    def stop(self) -> None:
        """Have the loop end: the running scan is finished within the grace; when told twice, at once."""
        now_s = time.monotonic()
        self._stop_s = now_s if self._is_stopping() else now_s + self._pace.grace_s
        self._heart.stopping()
        self._wakes.put(Wake.STOP)

    def serve(self) -> None:
        """Be the loop."""
        self._await_clock()
        with only_writer(self._site.station.data), self._metrics.serving(), self._closing:
            self._closing.callback(self._let_go)
            while not self._is_stopping():
                try:
                    wait_s = self._pass()
                    self._go_on()
                except StationError as error:
                    wait_s = self._pause(error)
                    self._heart.ready()  # up, though paused: nothing is gained by starting it anew
                self._wait(wait_s)
            log.info(logfmt(service="stopped"))

    # ---- one pass

    def _pass(self) -> float:
        """Do what is due and take one scan; return how long nothing will be due [s]."""
        self._heart.ping()
        if Wake.RELOAD in self._due:
            self._due.discard(Wake.RELOAD)
            self._reload()
        need_room(self._site)
        worker, inbox, ear, clockwork = self._opened()
        ear.listen()
        if step_s := clockwork.follow_clock():
            log.warning(logfmt(clock="set", step_s=round(step_s)))
        if Wake.EXPECTED in self._due:
            self._due.discard(Wake.EXPECTED)
            self._note_silence()
            self._metrics.write()
        if Wake.JOINED in self._due:
            self._due.discard(Wake.JOINED)
            self._spared(Wake.JOINED, worker.note_joined)
        self._looked_s = time.monotonic()
        listing = inbox.look()
        self._note_new(listing.new)
        if listing.first is None and listing.unread is not None:
            worker.glance(listing.unread)
            return 0.0
        if listing.first is None:
            self._tidy(worker)
            self._say_idle()
            return min(self._pace.period_s, listing.next_s)
        self._heart.status(f"measuring {listing.first.name}, {listing.queued - 1} more wait")
        self._take(worker, listing.first)
        return 0.0

    def _take(self, worker: Takes, arrival: Arrival) -> None:
        try:
            worker.take(arrival)
        except StationError:
            self._is_recovered = False  # it may have been broken off between file and journal
            raise
        except Exception as bug:  # one that a scan wakes must not keep the others out
            log.exception(logfmt(scan=arrival.name, verdict="later", reason="a bug: please report it"))
            self._opened_journal().later(arrival.name, f"a bug: {type(bug).__name__}: {bug}"[:500])

    def _tidy(self, worker: Takes) -> None:
        """Do what the clockwork asked for, when no scan waits for it; what fails comes again at its time."""
        for wake, tidy in ((Wake.JOIN, worker.begin_joining), (Wake.SWEEP, worker.sweep)):
            if wake in self._due and not self._is_stopping():
                self._due.discard(wake)
                self._spared(wake, tidy)

    @staticmethod
    def _spared(what: Wake, tidy: Callable[[], None]) -> None:
        """Do what no scan waits for: a bug there must not keep the scans out."""
        try:
            tidy()
        except StationError:
            raise
        except Exception:
            log.exception(logfmt(failed=what.name.lower(), reason="a bug: please report it"))

    # ---- opening, reloading

    def _opened(self) -> tuple[Takes, Inbox, Ear, Clockwork]:
        """Return what the loop works with; at first it is made, and journal and store are reconciled."""
        if self._parts is None:
            self._parts = self._make(self._site)
        if not self._is_recovered:
            self._heart.status("reconciling journal and store")
            self._parts[0].recover()
            self._is_recovered = True
            self._heart.ready()
            log.info(logfmt(service="running", station=self._site.station.id, inbox=self._site.scans.inbox))
        return self._parts

    def _make(self, site: Site) -> tuple[Takes, Inbox, Ear, Clockwork]:
        journal = self._opened_journal()
        worker = self._make_worker(
            site,
            journal,
            on_progress=self._heart.ping,
            should_stop=lambda: time.monotonic() > self._stop_s,
            on_joined=lambda: self.wake(Wake.JOINED),
            patient=True,
        )
        inbox = Inbox(site, journal, suffixes())
        ear = Ear(site.scans.inbox, lambda: self.wake(Wake.LOOK), polling=site.scans.polling)
        return worker, inbox, ear, Clockwork(self.wake, expected_every_s=site.scans.expected_every_s)

    def _opened_journal(self) -> Journal:
        if self._journal is None:
            self._journal = self._closing.enter_context(Journal(self._site.station.data / "journal.sqlite"))
        return self._journal

    def _reload(self) -> None:
        """Take the site file as it is now; keep the old one, and say so, where it cannot be used."""
        self._heart.reloading()
        try:
            site = read_site(self._site_path)
            if site.station.data != self._site.station.data:
                raise ConfigError("station.data has changed: that takes a restart")
            parts = self._make(site)
        except StationError as error:
            self._refused_site = str(error)
            log.error(logfmt(reload="refused", kept="the old site file", reason=error))  # noqa: TRY400 - its text says it all
        else:
            self._let_go()
            self._site, self._parts, self._refused_site = site, parts, ""
            self._due.add(Wake.SWEEP)  # which tells how many epochs another setting made
            log.info(logfmt(reload="done", station=site.station.id))
        self._heart.ready()

    def _let_go(self) -> None:
        if self._parts is not None:
            self._parts[0].close()
            self._parts[2].close()
            self._parts[3].stop()
            self._parts = None

    # ---- faults, waiting, ends

    def _pause(self, error: StationError) -> float:
        """Say what is wrong, once; return how long to wait before the next try [s]."""
        pause_s = min(self._pace.first_pause_s * 2.0**self._pauses, self._pace.period_s)
        self._heart.status(f"paused: {error}")
        if self._pauses == 0 and not self._is_stopping():
            log.error(logfmt(service="paused", reason=error))
        self._pauses = min(self._pauses + 1, 20)
        return pause_s

    def _go_on(self) -> None:
        if self._pauses:
            self._pauses = 0
            log.info(logfmt(service="goes on"))

    def _wait(self, wait_s: float) -> None:
        """Wait until something is due; events shorten the wait, unless it is for a fault to pass."""
        until_s = time.monotonic() + wait_s
        while True:
            left_s = max(0.0, until_s - time.monotonic())
            try:
                wake = self._wakes.get(timeout=min(left_s, self._heart.longest_wait_s))
            except Empty:
                self._heart.ping()
                if until_s <= time.monotonic():
                    return
                continue
            if wake is Wake.LOOK:
                if not self._pauses:
                    until_s = min(until_s, self._looked_s + self._pace.calm_s)
                continue
            if wake is not Wake.STOP:
                self._due.add(wake)
            until_s = 0.0

    def _await_clock(self) -> None:
        """Wait for a clock that can be right (SERVICE.md)."""
        until_s = time.monotonic() + self._pace.clock_s
        while (fault := clock_fault(self._site.station.data, time.time())) and not self._is_stopping():
            if time.time() > EARLIEST_S and time.monotonic() > until_s:
                log.warning(logfmt(clock="doubtful", reason=fault, does="starts all the same"))
                return
            self._heart.status(f"waiting: {fault}")
            self._pause_for_clock(fault)

    def _pause_for_clock(self, fault: str) -> None:
        if self._pauses == 0:
            log.error(logfmt(service="waiting", reason=fault))
        self._pauses = 1
        self._wait(self._pace.first_pause_s)

    def _is_stopping(self) -> bool:
        return self._stop_s < math.inf

    # ---- what it says

    def _note_new(self, count: int) -> None:
        if count:
            self._last_new_s = time.monotonic()
            if self._is_overdue:
                log.info(logfmt(scans="arrive again", new=count))
            self._is_overdue = False

    def _note_silence(self) -> None:
        """Warn, once, when a scan is overdue."""
        every_s = self._site.scans.expected_every_s
        silent_s = time.monotonic() - self._last_new_s
        if silent_s > 1.5 * every_s and not self._is_overdue:
            self._is_overdue = True
            log.warning(
                logfmt(
                    scans="overdue",
                    silent_s=round(silent_s),
                    expected_every_s=round(every_s),
                    reason="nothing new in the inbox: look at the scanner and the transfer",
                )
            )

    def _say_idle(self) -> None:
        counts = self._opened_journal().counts()
        waits = counts[State.WAITING] + counts[State.LATER]
        text = f"{counts[State.STORED]} stored, {waits} waiting, {counts[State.SET_ASIDE]} set aside"
        if self._is_overdue:
            text += "; a scan is overdue"
        if self._refused_site:
            text += f"; the site file was refused, the old one is kept: {self._refused_site}"
        self._heart.status(text)
