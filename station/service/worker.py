"""Processes scan after scan: a worker process measures, the journal records, the series is updated."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TypeVar

from station.archive.reference_files import valid_versions
from station.archive.series.index import stored_series
from station.config import Site
from station.errors import (
    ConfigError,
    InconclusiveError,
    NotReadyError,
    ScanError,
    StationError,
    StoreError,
)
from station.inbox.inbox import ScanFile, start_from_name
from station.inbox.journal import Entry, Journal, State
from station.inbox.scan_files import find_scan
from station.logs import logfmt
from station.monitoring.daily_digest import write_digest, yesterday
from station.processing import isolation
from station.processing.integrity import (
    add_checksums,
    holds_epochs,
    is_reference,
    missing_epochs,
    quarantine,
    restore_tilt_offsets,
    unjournaled_epochs,
    unreadable_files,
    verify_checksums,
)
from station.processing.reference_tasks import (
    build_reference_version,
    next_version,
    scans_for_version,
    scans_needed,
    update_reference_version,
)
from station.processing.scan_tasks import (
    Duplicate,
    Progress,
    Rejected,
    ScanHistory,
    StoredResult,
    check_header,
    process_new,
    series_for,
)
from station.processing.staleness import count_outdated, late_inputs
from station.processing.store_tasks import (
    MAX_STORE_TASK_S,
    MAX_UNCOMPACTED,
    Checksums,
    compact_epochs,
    delete_expired,
    update_series,
)
from station.processing.usable_inputs import with_usable_inputs
from station.science.geometry.pose import horizontal_crs, is_same_map
from station.service.background_compaction import BackgroundCompaction
from station.service.publishing import publish
from station.service.retention import apply_retention, expired_scans

log = logging.getLogger("station")
T = TypeVar("T")
VERIFY_INTERVAL_S = 3600.0  # minimum interval between full checksum runs after store errors


class Worker:
    """Processes scans one by one: worker process, journal, series, reference."""

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
    ) -> None:
        """`on_compacted` is called, in another thread, when `publish_compacted` has something to do.

        `before_task` raises StoreError if the data folder cannot be used now.

        `in_service`: scans may wait for weather, and one with a new mtime but the same bytes is not processed
        again.

        Raises ConfigError if the stored series has another map or grid.
        """
        _require_same_map(site)
        self._site = site
        self._series = series_for(site)
        self._journal = journal
        self._on_progress = on_progress
        self._should_stop = should_stop
        self._before_task = before_task
        self._in_service = in_service
        self._processed: dict[str, ScanFile] = {}
        self._last_verified_s = -math.inf
        self._reported_outdated = 0
        self._reported_faults: tuple[str, ...] = ()
        self._compaction = BackgroundCompaction(site, on_compacted)

    def process(self, scan: ScanFile, *, ahead: bool = False) -> bool:
        """Measure and store a scan, record it in journal and log; return True if it is stored.

        A live scan is measured `ahead` of a backlog, from the newest version of the reference, and goes on
        waiting: it is part of no reference, and measured again in its turn, as if nothing had come before.

        Raises StoreError if the store cannot be written; the scan is then still waiting.
        """
        if ahead:
            self._journal.mark_ahead(scan.name)
        is_stored = self._process(scan, ahead=ahead)
        self._build_reference_if_due()  # also if the scan is not stored: the reference may have waited for it
        return is_stored

    def _process(self, scan: ScanFile, *, ahead: bool) -> bool:
        self._processed[scan.name] = scan
        entry = self._journal.entry(scan.name)
        history = ScanHistory(
            reference=entry.reference if entry and not entry.ahead else None,
            revision=(entry.revision if entry else None) or 0,
            last_content=_assessed_content(entry) if self._in_service else None,
            stored_scans=self._journal.others_stored(scan.name, scan.size),
            wait_for_weather=self._in_service,
            waiting_before=self._unsettled_before(self._start_s(scan.name)) if self._in_service else "",
        )
        try:
            result = self._with_repair(process_new, scan, history)
        except ScanError as error:
            return self._set_aside(scan, str(error))
        except InconclusiveError as error:
            return record_failure(self._journal, self._site, scan.name, str(error))
        except NotReadyError as error:
            pause_s = self._journal.defer(scan.name, str(error))
            log.info("%s", logfmt(scan=scan.name, verdict="later", reason=error, retry_s=round(pause_s)))
            return False
        if isinstance(result, Rejected):
            return self._set_aside(scan, result.reason, result.sha256, result.log_sha256)
        if isinstance(result, Duplicate):
            return self._record_duplicate(scan, result)
        uncompacted = self._with_repair(update_series)
        record_result(self._journal, scan.name, result, ahead=ahead)
        _log_result(scan.name, result)
        self.publish(scan.name, result)
        if self._in_service and uncompacted > MAX_UNCOMPACTED:
            self.start_compaction(in_backlog=True)
        return True

    def precheck(self, scan: ScanFile) -> None:
        """Set a scan with broken headers aside at once, without waiting for its log."""
        try:
            self.run(check_header, scan)
        except ScanError as error:
            self._set_aside(scan, str(error))
            self._build_reference_if_due()  # it may have waited for this scan
        except NotReadyError:
            return

    def recover(self) -> None:
        """Reconcile after a start or a fault; build the reference if it is due.

        The next scan is then measured from it, as without the interruption.
        """
        self.reconcile()
        self._build_reference_if_due()

    def reconcile(self) -> None:
        """Reconcile journal and files: add missing checksums and journal entries, rebuild the series.

        Lost or damaged epochs are reprocessed if their scan is still in the inbox. `scan_tasks.process`
        recognises an epoch written just before a power cut and does not store it twice.
        """
        self._quarantine(self.run(unreadable_files))
        self.add_checksums()
        self._import_unjournaled()
        self._requeue_missing()
        if holds_epochs(self._series):
            self._with_repair(update_series)

    def add_checksums(self) -> None:
        """Record the checksums of files that have none; quarantine files that cannot be read."""
        result = self.run(add_checksums, self._journal.checksums())
        self._quarantine(result.damaged)
        self._journal.add_checksums(result.new_checksums)

    def verify_store(self) -> None:
        """Verify every file against its checksum; quarantine damaged ones."""
        damaged = self.run(verify_checksums, self._journal.checksums()).damaged
        self._quarantine(damaged)
        for name in filter(is_reference, damaged):  # a new version replaces it
            quarantine(self._series, [name])
            self._journal.drop_checksums([name])

    def compact(self) -> None:
        """Compact closed days and months; write the digest of yesterday."""
        self._record_compacted(self._with_repair(compact_epochs, self._journal.checksums()))

    def start_compaction(self, *, in_backlog: bool = False) -> None:
        """Start compaction in the background; `publish_compacted` completes it."""
        self._compaction.start(self._journal.checksums(), in_backlog=in_backlog)

    def publish_compacted(self) -> None:
        """Publish the files of a finished compaction and write the digest of yesterday; else do nothing."""
        try:
            checksums = self._compaction.result()
        except StoreError:
            if not self._repair():
                raise
            return  # the next scheduled compaction tries again
        if checksums is not None:
            self._record_compacted(checksums)

    def close(self) -> None:
        """Stop background compaction."""
        self._compaction.close()

    def _record_compacted(self, checksums: Checksums) -> None:
        if checksums:
            self._journal.add_checksums(checksums)
            self._with_repair(update_series)
        self._write_digest()

    def _write_digest(self) -> None:
        """Write the digest of yesterday; a failure is only logged, so that it never blocks scans."""
        try:
            if self.run(write_digest, yesterday(time.time())):
                log.info("%s", logfmt(digest="written"))
        except (StationError, RuntimeError) as error:
            log.warning("%s", logfmt(digest="failed", reason=error))

    def run_maintenance(self) -> None:
        """Rebuild damaged files, delete expired ones, requeue scans with late inputs, build a due reference.

        Then report outdated epochs and apply retention.
        """
        if holds_epochs(self._series):
            self._with_repair(update_series)
        self._journal.drop_checksums(self._with_repair(delete_expired))
        affected = self._with_repair(late_inputs, self._journal.rows(State.STORED))
        names = [name for name in affected if (self._site.scans.inbox / name).is_file()]
        for name in names:
            log.info("%s", logfmt(scan=name, reason="its log or weather arrived late: reprocessing"))
        self._journal.requeue(names)
        self._judge_again()
        self._build_reference_if_due()  # what it waits for may have taken too long, and no scan come since
        self._report_outdated()
        self._apply_retention()

    def _with_repair(self, task: Callable[..., T], *args: object) -> T:
        """Run a task; if it finds the store damaged, quarantine the damaged files and run it once more."""
        try:
            return self.run(task, *args)
        except StoreError:
            if not self._repair():
                raise
            return self.run(task, *args)

    def _repair(self) -> bool:
        """Quarantine damaged files and requeue their epochs; return True if any holds epochs."""
        damaged = self.run(unreadable_files)
        if not damaged and time.monotonic() > self._last_verified_s + VERIFY_INTERVAL_S:
            self._last_verified_s = time.monotonic()
            damaged = self.run(verify_checksums, self._journal.checksums()).damaged
        self._quarantine(damaged)
        if damaged:
            self._requeue_missing()
        return not all(map(is_reference, damaged))

    def _quarantine(self, damaged: Iterable[str]) -> None:
        for name in damaged:
            if is_reference(name):
                log.error("%s", logfmt(file=name, reason="damaged: restore it, or run station reprocess"))
                continue
            quarantine(self._series, [name])
            self._journal.drop_checksums([name])
            log.error(
                "%s",
                logfmt(file=name, reason="damaged: excluded from the series, kept as *.damaged"),
            )

    def _import_unjournaled(self) -> None:
        """Import epochs that the journal lacks because it was lost or is older than the store."""
        missing = self._with_repair(unjournaled_epochs, self._journal.epochs())
        if missing:
            log.warning("%s", logfmt(journal="completed", epochs=len(missing), reason="missing in it"))
        self._journal.import_entries(missing)
        self.run(restore_tilt_offsets)

    def _requeue_missing(self) -> None:
        for name in self.run(missing_epochs, self._journal.epochs(State.STORED)):
            if (self._site.scans.inbox / name).is_file():
                log.warning("%s", logfmt(scan=name, reason="epoch missing from the store: reprocessing"))
                self._journal.requeue([name])
            else:
                reason = "epoch missing from the store, scan missing from the inbox: run station reprocess"
                log.error("%s", logfmt(scan=name, reason=reason))

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
        names = self._journal.judged_otherwise(self._site.judging_conditions)
        names = [name for name in names if (self._site.scans.inbox / name).is_file()]
        reason = "settings, limits or version have changed since it was set aside or failed"
        for name in names:
            log.info("%s", logfmt(scan=name, verdict="waiting", reason=reason))
        self._journal.requeue(names, reason)
        reason = "rejected for now a week ago: one more attempt"
        for name in self._journal.rejected_for_now():
            if (self._site.scans.inbox / name).is_file():
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

    def _apply_retention(self) -> None:
        """Move or delete raw scans as configured in `[retention]`."""
        due = expired_scans(self._site, self._journal.rows(State.STORED), self._reserved_for_reference())
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

    def _reserved_for_reference(self) -> set[str]:
        return set(scans_for_version(self._site, self._usable_scans(), len(valid_versions(self._series))))

    def _usable_scans(self) -> list[str]:
        """Return the names of the scans that a reference may be built from, by time."""
        return self._journal.usable()

    def _build_reference_if_due(self) -> None:
        """Build the reference surface once enough usable scans are stored; update it as more arrive."""
        setting, usable = self._site.reference.scans, self._usable_scans()
        versions = valid_versions(self._series)
        if versions and not isinstance(setting, Path):
            self._requeue_without_reference()
        chosen = scans_for_version(self._site, usable, len(versions))
        needed = scans_needed(self._site, len(versions))
        if isinstance(setting, Path) or not chosen or len(usable) < needed:
            return
        last_s = self._start_s(usable[needed - 1])
        if self._unsettled_before(last_s, however_often_failed=True):  # it may belong to the reference
            return
        scans = [self._find_scan(name) for name in chosen]
        available = [scan for scan in scans if scan is not None]
        if len(available) < (setting if versions else len(chosen)):
            missing = [name for name, scan in zip(chosen, scans, strict=True) if scan is None]
            if not versions:
                log.warning("%s", logfmt(reference="waiting", reason=f"missing scans: {', '.join(missing)}"))
            return
        try:
            version = next_version(self._series, (row.reference for row in self._journal.rows()))
            if versions:
                self.run(update_reference_version, available, version, list(versions)[-1], ())
            else:
                self.run(build_reference_version, available, version)
        except (ScanError, NotReadyError) as error:
            log.warning("%s", logfmt(reference="failed", reason=error))
            return
        self.add_checksums()
        log.info("%s", logfmt(reference=version, scans=len(available)))
        self._requeue_for_version(version, last_s if versions else None)

    def _requeue_for_version(self, version: str, update_s: float | None) -> None:
        """Requeue epochs that were not measured from a version of the reference, but should have been.

        These are all epochs of a first version; of an update, to the scans before `update_s`, those of later
        scans that were processed while the update waited for an earlier one, if they are still in the inbox.
        """
        outdated = (
            row.name
            for row in self._journal.rows()
            if row.epoch and row.outcome is not State.SET_ASIDE and row.reference != version
            if update_s is None
            or ((row.start_utc_s or 0.0) > update_s and (self._site.scans.inbox / row.name).is_file())
        )
        self._journal.requeue(outdated, keep_reference=False)

    def _unsettled_before(self, start_utc_s: float, *, however_often_failed: bool = False) -> str:
        """Return the name of an earlier scan that will be judged soon, '' if there is none."""
        unsettled = self._journal.unsettled(however_often_failed=however_often_failed)
        for name, known_s in unsettled.items():
            if (known_s or start_from_name(name, self._site.scans.pattern).timestamp()) < start_utc_s:
                return name
        return ""

    def _start_s(self, name: str) -> float:
        """Return the start of a scan, from its epoch or else its name; the year 9999 if neither tells it."""
        entry = self._journal.entry(name)
        if entry is not None and entry.start_utc_s is not None:
            return entry.start_utc_s
        return start_from_name(name, self._site.scans.pattern).timestamp()

    def _requeue_without_reference(self) -> None:
        """Requeue epochs without change: power failed between building the reference and its first use."""
        inbox = self._site.scans.inbox
        names = [
            name
            for name in self._journal.without_reference()
            if name in self._processed or (inbox / name).is_file()
        ]
        self._journal.requeue(names)

    def _find_scan(self, name: str) -> ScanFile | None:
        """Return a scan file from where it was processed, the inbox or the archive; None if it is gone."""
        scan = self._processed.get(name)
        if scan is not None and scan.path.is_file():
            return scan
        entry = self._journal.entry(name)
        return find_scan(self._site, name, entry.start_utc_s if entry else None)

    def run(self, task: Callable[..., T], *args: object) -> T:
        """Run a task in a worker process, limited to `timeout_s` per scan; without scans, to hours."""
        items = [item for arg in args for item in (arg if isinstance(arg, list) else [arg])]
        self._before_task()
        scan_count = sum(isinstance(item, ScanFile) for item in items)
        result: T = isolation.run_isolated(
            with_usable_inputs,
            task,
            self._site,
            *args,
            memory_gb=self._site.service.memory_gb,
            timeout_s=self._site.scans.timeout_s * scan_count or MAX_STORE_TASK_S,
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


def _require_same_map(site: Site) -> None:
    """Raise ConfigError if the stored series has another map or grid: a series has only one."""
    series = stored_series(series_for(site))
    if series is None:
        return
    crs = site.map.crs
    if (crs is None) != (series.crs is None) or (
        crs and series.crs and not is_same_map(horizontal_crs(series.crs), horizontal_crs(crs))
    ):
        stored_name = horizontal_crs(series.crs).name if series.crs else "a local frame, without map.crs"
        raise ConfigError(
            f"map.crs = {crs!r} differs from that of {site.station.data}, {stored_name}: restore it, or give"
            " station.data a new folder"
        )
    stored = series.grid
    configured = site.grid_cells
    deviation_m = max(
        abs(stored_m - configured_m)
        for stored_m, configured_m in (
            (stored.west_m, configured.west_m),
            (stored.north_m, configured.north_m),
            (stored.cell_m * stored.nx, configured.cell_m * configured.nx),
        )
    )
    if stored.shape != configured.shape or deviation_m > 1e-3 * configured.cell_m:
        raise ConfigError(
            f"[grid] differs from that of {site.station.data}: {stored.nx} x {stored.ny} cells of"
            f" {stored.cell_m:.6g} m from west {stored.west_m:.10g}, north {stored.north_m:.10g}: restore it,"
            " or give station.data a new folder"
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
