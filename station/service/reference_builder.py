"""When a version of the reference is built, from which scans, and which epochs are measured again then."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path

from station.archive.reference_files import valid_versions
from station.config import Site
from station.errors import NotReadyError, ScanError
from station.inbox.journal import Journal
from station.inbox.journal_reader import State
from station.inbox.listing import ScanFile, start_from_name
from station.logs import logfmt
from station.processing.reference_tasks import (
    build_reference_version,
    next_version,
    scans_for_version,
    scans_needed,
    update_reference_version,
)
from station.processing.scans.scan_files import ScanFinder, is_present
from station.processing.site_files import series_for
from station.service.store_repair import RunTask, StoreRepair

log = logging.getLogger("station")


class ReferenceBuilder:
    """Builds the versions of the reference, in whatever order scans arrive, from the same scans."""

    def __init__(
        self,
        site: Site,
        journal: Journal,
        run: RunTask,
        store: StoreRepair,
        processed: Mapping[str, ScanFile],
    ) -> None:
        """`processed` are the scans processed so far by name, which may lie outside the inbox."""
        self._site = site
        self._series = series_for(site)
        self._journal = journal
        self._run = run
        self._store = store
        self._processed = processed

    def reserved(self) -> set[str]:
        """Return the names of the scans for the next version, as far as they are known."""
        return set(scans_for_version(self._site, self._journal.usable(), len(valid_versions(self._series))))

    def build_if_due(self) -> None:
        """Build the reference surface once enough usable scans are stored; update it as more arrive."""
        setting, usable = self._site.reference.scans, self._journal.usable()
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
        finder = ScanFinder(self._site)
        scans = [self._find_scan(finder, name) for name in chosen]
        available = [scan for scan in scans if scan is not None]
        if len(available) < (setting if versions else len(chosen)):
            missing = [name for name, scan in zip(chosen, scans, strict=True) if scan is None]
            if not versions:
                log.warning("%s", logfmt(reference="waiting", reason=f"missing scans: {', '.join(missing)}"))
            return
        try:
            version = next_version(self._series, (row.reference for row in self._journal.rows()))
            if versions:
                self._run(update_reference_version, available, version, list(versions)[-1], ())
            else:
                self._run(build_reference_version, available, version)
        except (ScanError, NotReadyError) as error:
            log.warning("%s", logfmt(reference="failed", reason=error))
            return
        self._store.add_checksums()
        log.info("%s", logfmt(reference=version, scans=len(available)))
        self._requeue_for_version(version, last_s if versions else None)

    def _requeue_for_version(self, version: str, update_s: float | None) -> None:
        """Requeue epochs that were not measured from a version of the reference, but should have been.

        These are all epochs of a first version; of an update, to the scans before `update_s`, those of later
        scans that were processed while the update waited for an earlier one, if they are still in the inbox.
        """
        finder = ScanFinder(self._site)
        outdated = (
            row.name
            for row in self._journal.rows()
            if row.epoch and row.outcome is not State.SET_ASIDE and row.reference != version
            if update_s is None or ((row.start_utc_s or 0.0) > update_s and finder.in_inbox(row.name))
        )
        self._journal.requeue(outdated, keep_reference=False)

    def earlier_unsettled(self, name: str) -> str:
        """Return the name of a scan before this one that will be judged soon, '' if there is none."""
        return self._unsettled_before(self._start_s(name))

    def _unsettled_before(self, start_utc_s: float, *, however_often_failed: bool = False) -> str:
        unsettled = self._journal.unsettled(however_often_failed=however_often_failed)
        for name, known_s in unsettled.items():
            if (known_s or start_from_name(name, self._site.row_pattern).timestamp()) < start_utc_s:
                return name
        return ""

    def _start_s(self, name: str) -> float:
        """Return the start of a scan, from its epoch or else its name; the year 9999 if neither tells it."""
        entry = self._journal.entry(name)
        if entry is not None and entry.start_utc_s is not None:
            return entry.start_utc_s
        return start_from_name(name, self._site.row_pattern).timestamp()

    def _requeue_without_reference(self) -> None:
        """Requeue epochs without change: power failed between building the reference and its first use."""
        finder = ScanFinder(self._site)
        names = [
            name
            for name in self._journal.without_reference()
            if name in self._processed or finder.in_inbox(name)
        ]
        self._journal.requeue(names)

    def _find_scan(self, finder: ScanFinder, name: str) -> ScanFile | None:
        """Return a scan file from where it was processed, the inbox or the archive; None if it is gone."""
        scan = self._processed.get(name)
        if scan is not None and all(is_present(path) for path in scan.paths):
            return scan
        entry = self._journal.entry(name)
        return finder.find(name, entry.start_utc_s if entry else None)
