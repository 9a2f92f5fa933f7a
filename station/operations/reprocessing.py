"""`station reprocess`: reprocess the outdated epochs, and only those, on all cores.

A reprocessed epoch is no longer outdated, so that an interrupted run continues when it is started again.
"""

from __future__ import annotations

import math
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from station.archive.reference_files import valid_versions
from station.archive.tilt_offsets import read_tilt_offset
from station.config import Site
from station.errors import NotReadyError, ScanError
from station.inbox.journal import Journal
from station.inbox.journal_reader import JournalReader
from station.inbox.listing import ScanFile
from station.inbox.lock import exclusive_lock
from station.monitoring.preconditions import require_disk_space
from station.processing.integrity import missing_epochs, verify_checksums
from station.processing.reference_tasks import (
    build_reference_version,
    next_version,
    scans_for_version,
    update_reference_version,
)
from station.processing.scan_tasks import Rejected, ScanHistory, StoredResult, load_reference
from station.processing.scanner_pose import sop_identity
from station.processing.scans.epoch_inputs import load_scan_inputs
from station.processing.scans.open_scans import open_scan_for
from station.processing.scans.scan_files import ScanFinder
from station.processing.site_files import series_for
from station.processing.staleness import Plan, Task, plan_reprocessing, usable_scans
from station.processing.store_tasks import MAX_STORE_TASK_S
from station.processing.usable_inputs import usable_site
from station.processing.workers.dask_executor import DaskExecutor
from station.processing.workers.executors import Executor, LocalExecutor
from station.processing.workers.isolation import TaskRunner
from station.processing.workers.worker_process import Progress as Tick
from station.readers.sop import valid_sop
from station.service.worker import Worker, record_result

_VERIFYING = "verifying the checksums of the store …"
Report = Callable[[str], None]
T = TypeVar("T")
Span = tuple[datetime | None, datetime | None]


def reprocess(
    site: Site, span: Span, report: Report, *, scheduler: str | None = None, dry_run: bool = False
) -> int:
    """Reprocess the outdated epochs whose scan began within `span`; return the exit status.

    The status is 3 if a scan is missing or was set aside, 75 if interrupted; finished epochs are kept. Raises
    NotReadyError if the service is running, or if the reference has to be rebuilt and its scans are missing.
    """
    site, data = usable_site(site, save=not dry_run), site.station.data
    for fault in site.input_faults:
        report(f"fault: {fault}")
    if dry_run:
        with JournalReader(data / "journal.sqlite") as journal:
            return _Planning(site, journal, report).dry_run(_seconds(span))
    with exclusive_lock(data), Journal(data / "journal.sqlite") as journal, _stop_on_signals() as stop:
        return Reprocessing(site, journal, report, stop).run(_seconds(span), scheduler)


class _Planning:
    """What is to be reprocessed; changes nothing."""

    def __init__(self, site: Site, journal: JournalReader, report: Report) -> None:
        self._site = site
        self._series = series_for(site)
        self._reader = journal
        self._report = report
        self._console = Console(stderr=True)

    def dry_run(self, span_s: tuple[float, float]) -> int:
        """Report what would be reprocessed; return the exit status."""
        with self._console.status(_VERIFYING):
            damaged = self._run_task(verify_checksums, self._reader.checksums()).damaged
        for name in damaged:
            self._report(f"{name}: damaged: its epochs will be reprocessed")
        if damaged:
            return 1
        plan = self._report_plan(span_s)
        return ScanError.exit_status if any(task.scan is None for task in plan.tasks) else 0

    def _report_plan(self, span_s: tuple[float, float]) -> Plan:
        """Return the reprocessing plan and report it."""
        plan = self._plan(span_s)
        self._report(f"{len(plan.tasks)} epochs to reprocess")
        for reason, count in plan.reason_counts().items():
            self._report(f"  {count} × {reason}")
        for task in plan.tasks:
            if task.scan is None:
                self._report(f"  {task.name}: the scan is missing: its epoch is kept unchanged")
        return plan

    def _plan(self, span_s: tuple[float, float]) -> Plan:
        entries = [entry for entry in self._reader.rows() if entry.epoch]
        missing = set(self._run_task(missing_epochs, self._reader.epochs()))
        return self._run_task(plan_reprocessing, entries, missing, span_s)

    def _run_task(self, task: Callable[..., T], *args: object) -> T:
        memory_gb = self._site.service.memory_gb
        return TaskRunner().run(task, self._site, *args, memory_gb=memory_gb, timeout_s=MAX_STORE_TASK_S)


class Reprocessing(_Planning):
    """The steps of one reprocessing run."""

    def __init__(self, site: Site, journal: Journal, report: Report, stop: threading.Event) -> None:
        super().__init__(site, journal, report)
        self._journal = journal
        self._stop = stop
        self._worker = Worker(site, journal, should_stop=stop.is_set)
        self._was_stopped = False

    def run(self, span_s: tuple[float, float], scheduler: str | None) -> int:
        """Reprocess the outdated epochs; return the exit status."""
        executor = DaskExecutor(scheduler, self._site) if scheduler else LocalExecutor(self._site, self._stop)
        try:
            self._repair()
            plan = self._report_plan(span_s)
            if plan.tasks:
                self._fix_tilt_offsets(plan.available())
                plan = self._rebuild_reference(plan, span_s)
            todo = plan.available()
            self._fix_tilt_offsets(todo)
            try:
                failed = self._run_tasks(todo, executor)
            finally:
                if todo:
                    self._publish()
                if not self._was_stopped:
                    self._finish_levels()
        finally:
            executor.close()
        if self._was_stopped:
            self._report("interrupted: finished epochs are stored; start it again to continue")
            return NotReadyError.exit_status
        return ScanError.exit_status if failed or len(todo) < len(plan.tasks) else 0

    def _repair(self) -> None:
        """Reconcile journal and store and quarantine damaged files, so that their epochs count as missing."""
        with self._console.status(_VERIFYING):
            self._worker.store.reconcile()
            self._worker.store.verify_store()

    def _rebuild_reference(self, plan: Plan, span_s: tuple[float, float]) -> Plan:
        """Rebuild the reference if it is outdated; return the plan after that."""
        setting = self._site.reference.scans
        if isinstance(setting, Path):
            self._worker.run(_import_reference)
        if not plan.references or isinstance(setting, Path):
            return plan
        valid = [version for version in valid_versions(self._series) if version not in plan.references]
        version = next_version(self._series, (entry.reference for entry in self._journal.rows()))
        with self._console.status(f"building version {version} of the reference …"):
            if valid:
                scans = self._scans_for(len(valid), at_least=setting)
                self._worker.run(update_reference_version, scans, version, valid[-1], plan.references)
            else:
                scans = self._scans_for(0, at_least=setting)
                self._worker.run(build_reference_version, scans, version)
        self._worker.store.add_checksums()
        self._report(
            f"reference {version} built from {len(scans)} scans, replaces {' '.join(plan.references)}"
        )
        return self._plan(span_s)

    def _scans_for(self, version_count: int, at_least: int) -> list[ScanFile]:
        """Return the usable scans for the next version; raise NotReadyError if they are too few."""
        names = scans_for_version(
            self._site, self._worker.run(usable_scans, self._journal.rows()), version_count
        )
        entries = {entry.name: entry for entry in self._journal.rows()}
        finder = ScanFinder(self._site)
        scan_by_name = {name: finder.find(name, entries[name].start_utc_s) for name in names}
        scans = [scan for scan in scan_by_name.values() if scan is not None]
        if len(scans) < at_least:
            missing = [name for name in names if scan_by_name[name] is None]
            problem = f"there are only {len(names)}"
            if missing:
                problem = f"these are missing: {', '.join(missing)}: restore them"
            raise NotReadyError(
                f"the reference has to be rebuilt from {at_least} usable scans, but {problem},"
                " or restore the settings"
            )
        return scans

    def _fix_tilt_offsets(self, todo: Iterable[Task]) -> None:
        """Determine the tilt offset of each SOP before scans run in parallel; their order must not matter.

        It is the tilt of the scan from which the SOP was determined, or of the first scan processed under it.
        """
        if self._site.scans.frame == "map" or self._site.inclination is None:
            return
        if self._site.inclination.mode == "absolute":
            return
        tried: set[str] = set()
        for task in todo:
            assert task.scan is not None  # noqa: S101 - checked by the caller
            try:
                sop = valid_sop(self._site.sop, datetime.fromtimestamp(task.start_utc_s, UTC))
            except ScanError:
                continue  # reported when the scan is reprocessed
            sop_id = sop_identity(sop)
            if sop is None or sop_id in tried or (task.scan.log is None and sop.scan is None):
                continue
            if sop.scan is not None or read_tilt_offset(self._site, sop_id) is not None:
                tried.add(sop_id)
            if read_tilt_offset(self._site, sop_id) is None:
                with suppress(ScanError):
                    self._worker.run(_load_tilt_offset, task.scan)

    def _run_tasks(self, todo: list[Task], executor: Executor) -> int:
        """Reprocess scans in parallel; return the number that failed."""
        failed, queue = 0, iter(todo)
        running: dict[Future[StoredResult | Rejected], Task] = {}
        with self._progress_bar() as bar:
            bar_task = bar.add_task(f"reprocessing, {executor.count} at once", total=len(todo))
            while True:
                while len(running) < executor.count + 1 and not self._stop.is_set():
                    task = next(queue, None)
                    if task is None:
                        break
                    require_disk_space(self._site)
                    assert task.scan is not None  # noqa: S101 - checked by the caller
                    running[executor.start(self._site, task.scan, _history(task))] = task
                if not running:
                    return failed
                done, _ = wait(running, timeout=0.5, return_when=FIRST_COMPLETED)
                for future in done:
                    failed += self._record(running.pop(future), future)
                    bar.advance(bar_task)

    def _record(self, task: Task, future: Future[StoredResult | Rejected]) -> int:
        """Record the result of a scan in the journal; return 1 if it failed, else 0."""
        try:
            result = future.result()
        except NotReadyError as error:
            if not self._stop.is_set():
                self._report(f"  {task.name}: deferred: {error}")
            return 1
        except ScanError as error:
            result = Rejected(str(error), "", "")
        if isinstance(result, Rejected):
            self._report(f"  {task.name}: set aside: {result.reason}")
            self._journal.set_aside(
                task.name,
                result.reason,
                sha256=result.sha256 or None,
                log_sha256=result.log_sha256,
                judged_under=self._site.judging_conditions,
            )
            return 1
        record_result(self._journal, task.name, result)
        return 0

    def _publish(self) -> None:
        """Compact the store and rebuild `series.nc`, also after an interruption."""
        self._was_stopped = self._stop.is_set()
        self._stop.clear()
        with self._console.status("publishing series.nc …"):
            self._worker.compact()
            self._worker.store.reconcile()
            self._worker.publish()

    def _finish_levels(self) -> None:
        """Bring the files of levels up to date, also where one is damaged or an epoch came late."""
        with self._console.status("filtering levels …"):
            self._worker.finish_levels(verify=True)

    def _progress_bar(self) -> Progress:
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        return Progress(*columns, console=self._console, disable=not sys.stderr.isatty())


def _history(task: Task) -> ScanHistory:
    """Return the history of a scan: the reference version used before, which is kept, and the revision."""
    return ScanHistory(reference=task.reference or None, revision=task.revision)


def _load_tilt_offset(site: Site, scan: ScanFile, progress: Tick) -> None:
    """Load the inputs of a scan, which saves the tilt offset of its SOP."""
    progress()
    with open_scan_for(site, scan) as opened:
        load_scan_inputs(site, opened)


def _import_reference(site: Site, progress: Tick) -> None:
    """Import a reference given as a file into the store, before scans run in parallel."""
    progress()
    load_reference(site)


def _seconds(span: Span) -> tuple[float, float]:
    begin, end = span
    return begin.timestamp() if begin else -math.inf, end.timestamp() if end else math.inf


@contextmanager
def _stop_on_signals() -> Iterator[threading.Event]:
    """Yield an event that SIGINT and SIGTERM set; a second signal ends the program."""
    stop = threading.Event()

    def request_stop(number: int, _frame: object) -> None:
        stop.set()
        signal.signal(number, previous[signal.Signals(number)])

    numbers = (signal.SIGINT, signal.SIGTERM)
    previous = {number: signal.signal(number, request_stop) for number in numbers}
    try:
        yield stop
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
