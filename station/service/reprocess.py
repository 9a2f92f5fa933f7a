"""`station reprocess`: redoes the epochs that a changed mind affects, and no others; on all cores.

What was redone is no longer stale, so that starting it again goes on where it ended.
"""

from __future__ import annotations

import math
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Protocol

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from station.archive.reference import current
from station.config import Site
from station.errors import NotReadyError, ScanError
from station.readers.scan import utc_interval
from station.readers.sop import sop_for
from station.service import child
from station.service.cluster import Cluster
from station.service.gather import gather, kept_zero, sop_identity
from station.service.health import need_room
from station.service.inbox import Arrival
from station.service.integrity import lost, verify
from station.service.journal import Journal
from station.service.lock import only_writer
from station.service.places import find_scan
from station.service.references import build_reference, improve_reference, next_version, scans_due
from station.service.stale import Plan, Task, plan, usable
from station.service.tasks import Outcome, Past, Refused, opened, redo, reference_of, series_of
from station.service.tasks import Progress as Tick
from station.service.worker import Worker, remember

_PROVING = "proving the store against its checksums …"
Tell = Callable[[str], None]
Span = tuple[datetime | None, datetime | None]


class Hands(Protocol):
    """What redoes scans, several at once."""

    count: int

    def start(self, site: Site, arrival: Arrival, past: Past) -> Future[Outcome | Refused]: ...  # noqa: D102
    def close(self) -> None: ...  # noqa: D102


def reprocess(
    site: Site, span: Span, tell: Tell, *, scheduler: str | None = None, dry_run: bool = False
) -> int:
    """Redo the stale epochs whose scan began within `span`; return the exit status.

    3 where a scan is gone or was set aside, 75 where it was interrupted: what is done stays done. Raises
    NotReadyError where the service runs, or the reference has to be made anew and its scans are gone.
    """
    data = site.station.data
    if dry_run:
        with Journal(data / "journal.sqlite", read_only=True) as journal:
            return _Redoing(site, journal, tell, threading.Event()).rehearse(_seconds(span))
    with only_writer(data), Journal(data / "journal.sqlite") as journal, _stopped_by_signals() as stop:
        return _Redoing(site, journal, tell, stop).do(_seconds(span), scheduler)


class Cores:
    """Redoes scans on this machine: each in a limited child, as many as cores and memory allow."""

    def __init__(self, site: Site, stop: threading.Event) -> None:
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
        fit = int(memory / (site.service.memory_gb * 2**30))
        self.count = max(1, min(len(os.sched_getaffinity(0)), fit))
        self._stop = stop
        self._threads = ThreadPoolExecutor(self.count)

    def start(self, site: Site, arrival: Arrival, past: Past) -> Future[Outcome | Refused]:
        """Begin to redo a scan."""
        return self._threads.submit(
            child.run,
            redo,
            site,
            arrival,
            past,
            memory_gb=site.service.memory_gb,
            timeout_s=site.scans.timeout_s,
            should_stop=self._stop.is_set,
        )

    def close(self) -> None:
        """End what runs."""
        self._threads.shutdown(cancel_futures=True)


class _Redoing:
    """The steps of a reprocessing."""

    def __init__(self, site: Site, journal: Journal, tell: Tell, stop: threading.Event) -> None:
        self._site = site
        self._series = series_of(site)
        self._journal = journal
        self._tell = tell
        self._stop = stop
        self._worker = Worker(site, journal, should_stop=stop.is_set)
        self._was_stopped = False
        self._console = Console(stderr=True)

    def rehearse(self, between_s: tuple[float, float]) -> int:
        """Tell what would be done again; return the exit status."""
        with self._console.status(_PROVING):
            damaged = self._worker.run(verify, self._journal.files()).damaged
        for name in damaged:
            self._tell(f"{name}: damaged: its epochs are among those to be done again")
        if damaged:
            return 1
        found = self._look(between_s)
        return ScanError.exit_status if any(task.arrival is None for task in found.tasks) else 0

    def do(self, between_s: tuple[float, float], scheduler: str | None) -> int:
        """Redo what is stale; return the exit status."""
        hands = Cluster(scheduler, self._site) if scheduler else Cores(self._site, self._stop)
        try:
            self._mend()
            found = self._look(between_s)
            if found.tasks:
                self._settle_zeros(found.there())
                found = self._with_reference(found, between_s)
            todo = found.there()
            self._settle_zeros(todo)
            try:
                failed = self._redo(todo, hands)
            finally:
                if todo:
                    self._publish()
        finally:
            hands.close()
        if self._was_stopped:
            self._tell("interrupted: what is done is stored; start it again and it goes on")
            return NotReadyError.exit_status
        return ScanError.exit_status if failed or len(todo) < len(found.tasks) else 0

    def _mend(self) -> None:
        """Make journal and store agree, and put damaged files aside, so that their epochs show as lost."""
        with self._console.status(_PROVING):
            self._worker.reconcile()
            self._worker.prove()

    def _look(self, between_s: tuple[float, float]) -> Plan:
        """Find what is stale and tell it."""
        found = self._plan(between_s)
        self._tell(f"{len(found.tasks)} epochs to be done again")
        for reason, count in found.why().items():
            self._tell(f"  {count} × {reason}")
        for task in found.tasks:
            if task.arrival is None:
                self._tell(f"  {task.name}: the scan is gone: its epoch stays as it is")
        return found

    def _plan(self, between_s: tuple[float, float]) -> Plan:
        entries = [entry for entry in self._journal.rows() if entry.epoch]
        gone = set(self._worker.run(lost, self._journal.epochs()))
        return self._worker.run(plan, entries, gone, between_s)

    def _with_reference(self, found: Plan, between_s: tuple[float, float]) -> Plan:
        """Make the reference anew where it is stale; return what is stale then."""
        wanted = self._site.reference.scans
        if isinstance(wanted, Path):
            self._worker.run(_take_reference)
        if not found.references or isinstance(wanted, Path):
            return found
        sound = [version for version in current(self._series) if version not in found.references]
        version = next_version(self._series, (row.reference for row in self._journal.rows()))
        with self._console.status(f"making version {version} of the reference …"):
            if sound:
                arrivals = self._scans_for(len(sound), at_least=wanted)
                self._worker.run(improve_reference, arrivals, version, sound[-1], found.references)
            else:
                arrivals = self._scans_for(0, at_least=wanted)
                self._worker.run(build_reference, arrivals, version)
        self._worker.seal()
        self._tell(
            f"reference {version} made of {len(arrivals)} scans, instead of {' '.join(found.references)}"
        )
        return self._plan(between_s)

    def _scans_for(self, made: int, at_least: int) -> list[Arrival]:
        """Return the usable scans for a version after `made` others; raise NotReadyError if too few."""
        names = scans_due(self._site, self._worker.run(usable, self._journal.rows()), made)
        rows = {row.name: row for row in self._journal.rows()}
        found = {name: find_scan(self._site, name, rows[name].start_utc_s) for name in names}
        arrivals = [arrival for arrival in found.values() if arrival is not None]
        if len(arrivals) < at_least:
            gone = [name for name in names if found[name] is None]
            why = f"there are {len(names)}"
            if gone:
                why = f"these are gone: {', '.join(gone)}: put them back"
            raise NotReadyError(
                f"the reference has to be made anew, of {at_least} usable scans, but {why},"
                " or restore the settings"
            )
        return arrivals

    def _settle_zeros(self, todo: Iterable[Task]) -> None:
        """Find the lean that each SOP holds before scans are redone side by side, so that no order matters.

        It is that of the scan the SOP was solved from, or of the first one processed under it.
        """
        if self._site.scans.frame == "map" or self._site.inclination is None:
            return
        if self._site.inclination.mode == "absolute":
            return
        tried: set[str] = set()
        for task in todo:
            assert task.arrival is not None  # noqa: S101 - by the caller
            try:
                sop = sop_for(self._site.sop, datetime.fromtimestamp(task.start_utc_s, UTC))
            except ScanError:
                continue  # it is told when the scan is redone
            sop_id = sop_identity(sop)
            if sop_id in tried or (task.arrival.log is None and sop.scan is None):
                continue
            if sop.scan is not None or kept_zero(self._site, sop_id) is not None:
                tried.add(sop_id)
            if kept_zero(self._site, sop_id) is None:
                with suppress(ScanError):
                    self._worker.run(_find_zero, task.arrival)

    def _redo(self, todo: list[Task], hands: Hands) -> int:
        """Redo scans side by side; return how many of them were set aside."""
        failed, waiting = 0, iter(todo)
        running: dict[Future[Outcome | Refused], Task] = {}
        with self._progress() as bar:
            shown = bar.add_task(f"redoing, {hands.count} at once", total=len(todo))
            while True:
                while len(running) < hands.count + 1 and not self._stop.is_set():
                    task = next(waiting, None)
                    if task is None:
                        break
                    need_room(self._site)
                    assert task.arrival is not None  # noqa: S101 - by the caller
                    running[hands.start(self._site, task.arrival, _past(task))] = task
                if not running:
                    return failed
                done, _ = wait(running, timeout=0.5, return_when=FIRST_COMPLETED)
                for future in done:
                    failed += self._note(running.pop(future), future)
                    bar.advance(shown)

    def _note(self, task: Task, future: Future[Outcome | Refused]) -> int:
        """Note in the journal what a scan gave; return 1 where it was set aside."""
        try:
            outcome = future.result()
        except NotReadyError as error:
            if not self._stop.is_set():
                self._tell(f"  {task.name}: not now: {error}")
            return 1
        except ScanError as error:
            outcome = Refused(str(error), "", "")
        if isinstance(outcome, Refused):
            self._tell(f"  {task.name}: set aside: {outcome.reason}")
            self._journal.set_aside(
                task.name, outcome.reason, sha256=outcome.sha256 or None, log_sha256=outcome.log_sha256
            )
            return 1
        remember(self._journal, task.name, outcome)
        return 0

    def _publish(self) -> None:
        """Join what can be joined and write `series.nc` anew, also after an interruption."""
        self._was_stopped = self._stop.is_set()
        self._stop.clear()
        with self._console.status("publishing series.nc …"):
            self._worker.join_closed()
            self._worker.reconcile()
            self._worker.show()

    def _progress(self) -> Progress:
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        return Progress(*columns, console=self._console, disable=not sys.stderr.isatty())


def _past(task: Task) -> Past:
    """Return what a redone epoch keeps: the version of the reference it was measured from."""
    return Past(reference=task.reference or None, revision=task.revision)


def _find_zero(site: Site, arrival: Arrival, progress: Tick) -> None:
    """Gather what goes with a scan, which keeps the zero of lean of its SOP."""
    progress()
    with opened(site, arrival.path) as reader:
        start, end, _ = utc_interval(reader, site.scans.name)
        gather(site, reader, arrival.log, start, end)


def _take_reference(site: Site, progress: Tick) -> None:
    """Take a reference that is given as a file into the store, before scans are redone side by side."""
    progress()
    reference_of(site)


def _seconds(span: Span) -> tuple[float, float]:
    begin, end = span
    return begin.timestamp() if begin else -math.inf, end.timestamp() if end else math.inf


@contextmanager
def _stopped_by_signals() -> Iterator[threading.Event]:
    """Give what SIGINT and SIGTERM set; the second one ends the program."""
    stop = threading.Event()

    def ask(number: int, _frame: object) -> None:
        stop.set()
        signal.signal(number, before[signal.Signals(number)])

    numbers = (signal.SIGINT, signal.SIGTERM)
    before = {number: signal.signal(number, ask) for number in numbers}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
