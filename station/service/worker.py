"""Processes scan after scan: a worker process measures, the journal records, the series is updated."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import TypeVar

from station.config import Site
from station.errors import InconclusiveError, NotReadyError, ScanError, StationError, StoreError
from station.inbox.journal import Journal
from station.inbox.journal_reader import Entry, State
from station.inbox.listing import ScanFile
from station.logs import logfmt
from station.monitoring.daily_digest import write_digest, yesterday
from station.processing.integrity import holds_epochs
from station.processing.scan_tasks import (
    Duplicate,
    Rejected,
    ScanHistory,
    StoredResult,
    check_header,
    process_new,
)
from station.processing.scans.scan_files import ScanFinder
from station.processing.site_files import series_for
from station.processing.staleness import count_outdated, late_inputs
from station.processing.store_tasks import (
    MAX_STORE_TASK_S,
    MAX_UNCOMPACTED,
    Checksums,
    compact_epochs,
    delete_expired,
    update_between_scans,
    update_series,
    update_stored_levels,
)
from station.processing.usable_inputs import with_usable_inputs
from station.processing.workers.worker_process import Progress
from station.service.background_compaction import BackgroundCompaction
from station.service.host import Host
from station.service.publishing import publish
from station.service.reference_builder import ReferenceBuilder
from station.service.renewal import Renewals
from station.service.retention import apply_retention, expired_scans
from station.service.store_repair import StoreRepair, require_same_map

log = logging.getLogger("station")
T = TypeVar("T")


class Worker:
    """Processes scans one by one: worker process, journal, series, reference.

    `store` repairs what is damaged or missing in the store.
    """

    def __init__(
        self,
        site: Site,
        journal: Journal,
        *,
        on_progress: Progress = lambda: None,
        should_stop: Callable[[], bool] = lambda: False,
        on_compacted: Callable[[], None] = lambda: None,
        before_task: Callable[[], None] = lambda: None,
        in_service: bool = False,
        host: Host | None = None,
    ) -> None:
        """`on_compacted` is called, in another thread, when `publish_compacted` has something to do.

        `before_task` raises StoreError if the data folder cannot be used now.

        `in_service`: scans may wait for weather, and one with a new mtime but the same bytes is not processed
        again.

        Raises ConfigError if the stored series has another map or grid.
        """
        require_same_map(site)
        self._site = site
        self._series = series_for(site)
        self._journal = journal
        self._on_progress = on_progress
        self._should_stop = should_stop
        self._before_task = before_task
        self._in_service = in_service
        self._host = host or Host()
        self._processed: dict[str, ScanFile] = {}
        self._reported_outdated = 0
        self._reported_faults: tuple[str, ...] = ()
        self.store = StoreRepair(site, journal, self.run, self._update_series, self._host.clock)
        self._reference = ReferenceBuilder(site, journal, self.run, self.store, self._processed)
        self._compaction = BackgroundCompaction(site, on_compacted, self._host)
        self._renewals = Renewals(site, self._host)

    def process(self, scan: ScanFile, *, ahead: bool = False) -> bool:
        """Measure and store a scan, record it in journal and log; return True if it is stored.

        A live scan is measured `ahead` of a backlog, from the newest version of the reference, and goes on
        waiting: it is part of no reference, and measured again in its turn, as if nothing had come before.

        Raises StoreError if the store cannot be written; the scan is then still waiting.
        """
        if ahead:
            self._journal.mark_ahead(scan.name)
        is_stored = self._process(scan, ahead=ahead)
        self._reference.build_if_due()  # also if the scan is not stored: the reference may have waited for it
        return is_stored

    def _process(self, scan: ScanFile, *, ahead: bool) -> bool:
        self._processed[scan.name] = scan
        entry = self._journal.entry(scan.name)
        now_s = self._host.clock.now_s()
        history = ScanHistory(
            reference=entry.reference if entry and not entry.ahead else None,
            revision=(entry.revision if entry else None) or 0,
            last_content=_assessed_content(entry) if self._in_service else None,
            stored_scans=self._journal.others_stored(scan.name, scan.size),
            wait_for_weather=self._in_service and self._is_recent(scan, now_s),
            waiting_before=self._reference.earlier_unsettled(scan.name) if self._in_service else "",
            now_s=now_s,
        )
        try:
            result = self.store.with_repair(process_new, scan, history)
        except ScanError as error:
            return self._set_aside(scan, str(error))
        except InconclusiveError as error:
            return record_failure(self._journal, self._site, scan.name, str(error))
        except NotReadyError as error:
            pause_s = self._journal.defer_behind(scan.name, history.waiting_before, str(error))
            log.info("%s", logfmt(scan=scan.name, verdict="later", reason=error, retry_s=round(pause_s)))
            return False
        if isinstance(result, Rejected):
            return self._set_aside(scan, result.reason, result.sha256, result.log_sha256)
        if isinstance(result, Duplicate):
            return self._record_duplicate(scan, result)
        uncompacted = self._update_series()
        record_result(self._journal, scan.name, result, ahead=ahead)
        _log_result(scan.name, result)
        self.publish(scan.name, result)
        if self._in_service and uncompacted > MAX_UNCOMPACTED:
            self.start_compaction(in_backlog=True)
        return True

    def _is_recent(self, scan: ScanFile, now_s: float) -> bool:
        """Return True if the weather log may not be up to date yet for a scan."""
        weather = self._site.weather
        return weather is not None and now_s - scan.mtime_ns * 1e-9 < weather.wait_s

    def precheck(self, scan: ScanFile) -> None:
        """Set a scan with broken headers aside at once, without waiting for its log."""
        try:
            self.run(check_header, scan)
        except ScanError as error:
            self._set_aside(scan, str(error))
            self._reference.build_if_due()  # it may have waited for this scan
        except NotReadyError:
            return

    def recover(self) -> None:
        """Reconcile after a start or a fault; build the reference if it is due.

        The next scan is then measured from it, as without the interruption.
        """
        self.store.reconcile()
        self._reference.build_if_due()

    def compact(self) -> None:
        """Compact closed days and months; write the digest of yesterday."""
        self._record_compacted(
            self.store.with_repair(compact_epochs, self._journal.checksums(), self._host.clock.now_s())
        )

    def start_compaction(self, *, in_backlog: bool = False) -> None:
        """Start compaction in the background; `publish_compacted` completes it."""
        now_s = None if in_backlog else self._host.clock.now_s()
        self._compaction.start(self._journal.checksums(), now_s)

    def publish_compacted(self) -> None:
        """Publish the files of a finished compaction and write the digest of yesterday; else do nothing."""
        try:
            checksums = self._compaction.result()
        except StoreError:
            if not self.store.repair():
                raise
            return  # the next scheduled compaction tries again
        if checksums is not None:
            self._record_compacted(checksums)

    def close(self) -> None:
        """Stop what runs in the background."""
        self._compaction.close()
        self._renewals.close()

    def proceed_with_renewals(self) -> None:
        """Renew in the background what follows the series, see `Renewals`."""
        self._renewals.proceed()

    def finish_levels(self, *, verify: bool) -> None:
        """Bring the files of levels up to date without a running service, if there are to be any.

        `verify` also replaces those that are damaged. Raises StoreError if an epoch is damaged.
        """
        if self._site.products.levels and self._series.path.is_file():
            self.run(update_stored_levels, verify)

    def _update_series(self) -> int:
        """Update the series and what is derived from it; return the number of epochs to compact."""
        if self._in_service:
            uncompacted, is_behind = self.store.with_repair(update_between_scans)
        else:
            uncompacted, is_behind = self.store.with_repair(update_series), False
        self._renewals.require(derived=is_behind)
        return uncompacted

    def _record_compacted(self, checksums: Checksums) -> None:
        if checksums:
            self._journal.add_checksums(checksums)
            self._update_series()
        self._write_digest()

    def _write_digest(self) -> None:
        """Write the digest of yesterday; a failure is only logged, so that it never blocks scans."""
        try:
            if self.run(write_digest, yesterday(self._host.clock.now_s())):
                log.info("%s", logfmt(digest="written"))
        except (StationError, RuntimeError) as error:
            log.warning("%s", logfmt(digest="failed", reason=error))

    def run_maintenance(self) -> None:
        """Rebuild damaged files, delete expired ones, requeue scans with late inputs, build a due reference.

        Then report outdated epochs and apply retention.
        """
        now_s = self._host.clock.now_s()
        if holds_epochs(self._series):
            self._update_series()
        self._journal.drop_checksums(self.store.with_repair(delete_expired, now_s))
        affected = self.store.with_repair(late_inputs, self._journal.rows(State.STORED))
        finder = ScanFinder(self._site)
        names = [name for name in affected if finder.in_inbox(name)]
        for name in names:
            log.info("%s", logfmt(scan=name, reason="its log or weather arrived late: reprocessing"))
        self._journal.requeue(names)
        self._judge_again()
        self._reference.build_if_due()  # what it waits for may have taken too long, and no scan come since
        self._report_outdated()
        self._apply_retention(now_s)

    def _set_aside(
        self, scan: ScanFile, reason: str, sha256: str | None = None, log_sha256: str = ""
    ) -> bool:
        conditions = self._site.judging_conditions
        self._journal.set_aside(
            scan.name, reason, sha256=sha256, log_sha256=log_sha256, judged_under=conditions
        )
        log.warning("%s", logfmt(scan=scan.name, verdict="set_aside", reason=reason))
        self.publish()
        return False

    def publish(self, name: str = "", result: StoredResult | None = None) -> None:
        """Update the page; log a warning if the scan just stored reveals that the scanner moved.

        A failure is only logged, so that it never blocks scans.
        """
        try:
            published = self.run(publish, result)
        except (StationError, RuntimeError) as error:
            log.warning("%s", logfmt(page="failed", reason=error))
            return
        if published.input_faults != self._reported_faults:
            for fault in published.input_faults:
                log.warning("%s", logfmt(input="broken", reason=fault))
            self._reported_faults = published.input_faults
        if published.warning:
            log.warning("%s", logfmt(scan=name, moved=published.warning))
        if published.fault:
            log.warning("%s", logfmt(page="failed", reason=published.fault))

    def _record_duplicate(self, scan: ScanFile, duplicate: Duplicate) -> bool:
        """Restore the entry of an unchanged scan, or set aside a copy of another; return True if stored."""
        if duplicate.name != scan.name:
            return self._set_aside(
                scan, f"the same bytes as {duplicate.name}, which is stored", duplicate.sha256
            )
        self._journal.restore_unchanged(scan.name, duplicate.sha256)
        log.info("%s", logfmt(scan=scan.name, verdict="same", reason="content unchanged"))
        entry = self._journal.entry(scan.name)
        return entry is not None and entry.state is State.STORED

    def _judge_again(self) -> None:
        """Queue scans that were set aside or failed under other settings, limits or another version."""
        names, finder = self._journal.judged_otherwise(self._site.judging_conditions), ScanFinder(self._site)
        names = [name for name in names if finder.in_inbox(name)]
        reason = "settings, limits or version have changed since it was set aside or failed"
        for name in names:
            log.info("%s", logfmt(scan=name, verdict="waiting", reason=reason))
        self._journal.requeue(names, reason)
        reason = "rejected for now a week ago: one more attempt"
        for name in self._journal.rejected_for_now():
            if finder.in_inbox(name):
                log.info("%s", logfmt(scan=name, verdict="waiting", reason=reason))
                self._journal.try_once(name, reason, self._site.judging_conditions)

    def _report_outdated(self) -> None:
        """Log the number of epochs with outdated settings, whenever it changes."""
        queued = [entry.epoch for entry in self._journal.waiting() if entry.epoch]
        count = self.run(_count_outdated, queued)
        if count and count != self._reported_outdated:
            reason = "outdated SOP, setting, flag or reference: run station reprocess"
            log.warning("%s", logfmt(epochs=count, reason=reason))
        self._reported_outdated = count

    def _apply_retention(self, now_s: float) -> None:
        """Move or delete raw scans as configured in `[retention]`."""
        due = expired_scans(self._site, self._journal.rows(State.STORED), self._reference.reserved(), now_s)
        entries = [entry for entry in map(self._journal.entry, due) if entry is not None]
        if not entries or self._should_stop():
            return
        try:
            actions = self.run(apply_retention, entries, self._journal.checksums())
        except (ScanError, NotReadyError) as error:  # the worker process died, or the service is to stop
            log.warning("%s", logfmt(retention="waits", reason=error))
            return
        for name, action, reason in actions:
            extra = {"reason": reason} if reason else {}
            log.log(
                logging.WARNING if reason else logging.INFO,
                "%s",
                logfmt(scan=name, retention=action, **extra),
            )

    def run(self, task: Callable[..., T], *args: object) -> T:
        """Run a task in a worker process, limited to `timeout_s` per file of scans; without any, to hours."""
        items = [item for arg in args for item in (arg if isinstance(arg, list) else [arg])]
        self._before_task()
        file_count = sum(len(item.files) for item in items if isinstance(item, ScanFile))
        result: T = self._host.tasks.run(
            with_usable_inputs,
            task,
            self._site,
            *args,
            memory_gb=self._site.service.memory_gb,
            timeout_s=self._site.scans.timeout_s * file_count or MAX_STORE_TASK_S,
            on_progress=self._on_progress,
            should_stop=self._should_stop,
        )
        return result


def _assessed_content(entry: Entry | None) -> tuple[str, str] | None:
    """Return the checksums of the scan and log assessed under this name; None if there are none."""
    if entry is None or entry.outcome is None or not entry.sha256:
        return None
    return entry.sha256, entry.log_sha256


def record_failure(journal: Journal, site: Site, name: str, reason: str) -> bool:
    """Record and log an attempt that failed although the scan may be good; return False: it is not stored."""
    pause_s = journal.record_failure(name, reason, site.judging_conditions)
    verdict, extra = ("set_aside", {}) if pause_s is None else ("later", {"retry_s": round(pause_s)})
    log.warning("%s", logfmt(scan=name, verdict=verdict, reason=reason, **extra))
    return False


def record_result(journal: Journal, name: str, result: StoredResult, *, ahead: bool = False) -> None:
    """Record the result of a scan in the journal."""
    journal.record_stored(
        name,
        sha256=result.sha256,
        verdict=result.verdict,
        epoch=result.epoch,
        start_utc_s=result.start_utc_s,
        revision=result.revision,
        reference=result.reference,
        reason=result.reason,
        metrics=result.metrics,
        log_sha256=result.log_sha256,
        epoch_sha256=result.epoch_sha256,
        ahead=ahead,
    )


def _count_outdated(site: Site, queued: list[str], progress: Progress) -> int:
    progress()
    return count_outdated(site, queued)


def _log_result(name: str, result: StoredResult) -> None:
    """Log the line of a scan."""
    fields = {
        "scan": name,
        "verdict": result.verdict,
        **result.metrics,
        "reference": result.reference or "none",
        **({"reason": result.reason} if result.reason else {}),
    }
    log.log(logging.INFO if result.verdict == "good" else logging.WARNING, "%s", logfmt(**fields))
