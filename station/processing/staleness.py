"""Outdated epochs and versions of the reference, and the plan for reprocessing them.

An epoch is outdated if its settings, its inputs or its reference differ from those in use now (`provenance`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from pathlib import Path

from station.archive.netcdf_layout import Series
from station.archive.reference_files import valid_versions
from station.archive.schema import VERDICTS
from station.config import Site
from station.inbox.journal_reader import Entry, State
from station.inbox.listing import ScanFile
from station.processing.provenance import CurrentConfig, ScanProvenance, StoredEpoch, stored_epochs
from station.processing.scans.scan_files import ScanFinder
from station.processing.site_files import file_version, series_for
from station.processing.workers.worker_process import Progress
from station.scan_names import scan_id

LATE_INPUTS = {
    "inclination log arrived later",
    "weather arrived later",
    "registration arrived later",
}  # the service reprocesses these
EPOCH_MISSING = "epoch damaged or missing"
REFERENCE_OUTDATED = "reference built with other settings or inputs"


@dataclass(frozen=True)
class Task:
    """An epoch to reprocess, the reasons, and its scan; None if the scan no longer exists."""

    name: str
    start_utc_s: float
    reasons: tuple[str, ...]
    scan: ScanFile | None
    reference: str | None
    revision: int


@dataclass(frozen=True)
class Plan:
    """Epochs to reprocess, and the versions of the reference to rebuild first."""

    tasks: tuple[Task, ...]
    references: tuple[str, ...]

    def available(self) -> list[Task]:
        """Return the tasks whose scan is available."""
        return [task for task in self.tasks if task.scan is not None]

    def reason_counts(self) -> dict[str, int]:
        """Return the number of epochs by reason, most frequent first."""
        return dict(Counter(reason for task in self.tasks for reason in task.reasons).most_common())


def plan_reprocessing(
    site: Site, entries: list[Entry], missing: set[str], span_s: tuple[float, float], progress: Progress
) -> Plan:
    """Return the epochs that are outdated, with the reasons, from the journal rows and the store.

    `missing` are the names of journal rows whose epoch cannot be read; `span_s` bounds the scan starts.
    Raises StoreError if an epoch is damaged.
    """
    series = series_for(site)
    config = CurrentConfig(site)
    by_epoch = {Path(entry.epoch).name: entry for entry in entries if entry.epoch}
    stored = stored_epochs(series)
    stale = stale_versions(site, series, config, entries)
    valid = _valid_versions(site, series, stored)
    if valid is not None:
        valid -= set(stale)
        stale = stale or (() if valid else tuple(sorted({epoch.reference for epoch in stored} - {""})))
    finder = ScanFinder(site)
    tasks = [_task_for_missing(finder, entry) for entry in entries if entry.name in missing]
    for epoch in stored:
        progress()
        entry = by_epoch.get(epoch.ref.epoch_file)
        if entry is None or entry.name in missing or entry.outcome is State.SET_ASIDE:
            continue  # set aside: the scan file of this epoch has been replaced
        scan = finder.find(entry.name, epoch.provenance.start_s)
        reasons = [
            *(["queued for reprocessing"] if entry.outcome is None else []),
            *(["other settings"] if epoch.science_hash != site.science_hash else []),
            *([REFERENCE_OUTDATED] if valid is not None and epoch.reference not in valid else []),
            *config.changed_settings(epoch.provenance),
            *config.changed_inputs(epoch.provenance, scan, entry),
        ]
        if reasons:
            revision = max(epoch.ref.revision, entry.revision or 0)
            tasks.append(
                Task(entry.name, epoch.provenance.start_s, tuple(reasons), scan, epoch.reference, revision)
            )
    selected = [task for task in tasks if span_s[0] <= task.start_utc_s < span_s[1]]
    return Plan(tuple(sorted(selected, key=lambda task: (task.start_utc_s, task.name))), stale)


def _task_for_missing(finder: ScanFinder, entry: Entry) -> Task:
    start_s = entry.start_utc_s or 0.0
    scan = finder.find(entry.name, start_s)
    return Task(entry.name, start_s, (EPOCH_MISSING,), scan, entry.reference, entry.revision or 0)


def usable_scans(site: Site, entries: list[Entry], progress: Progress) -> list[str]:
    """Return the scans usable for a reference, in order of time: verdict `good` and no flag."""
    progress()
    config = CurrentConfig(site)
    by_epoch = {Path(entry.epoch).name: entry for entry in entries if entry.epoch}
    return [
        by_epoch[epoch.ref.epoch_file].name
        for epoch in stored_epochs(series_for(site))
        if epoch.ref.epoch_file in by_epoch
        and VERDICTS[epoch.verdict] == "good"
        and not config.flag(epoch.provenance)
    ]


def late_inputs(site: Site, entries: list[Entry], progress: Progress) -> list[str]:
    """Return the names of scans whose log or weather arrived after they were stored without it."""
    config, finder = CurrentConfig(site), ScanFinder(site)
    by_epoch = {Path(entry.epoch).name: entry for entry in entries if entry.epoch}
    names = []
    for epoch in stored_epochs(series_for(site)):
        progress()
        entry = by_epoch.get(epoch.ref.epoch_file)
        has_registration = site.registration is None or bool(epoch.provenance.registration_sha256)
        if entry is None or (epoch.provenance.log_sha256 and epoch.provenance.air and has_registration):
            continue
        scan = finder.find(entry.name, epoch.provenance.start_s)
        if scan is not None and LATE_INPUTS & set(config.changed_inputs(epoch.provenance, scan, entry)):
            names.append(entry.name)
    return names


def count_outdated(site: Site, queued: Collection[str] = ()) -> int:
    """Return the number of epochs with another SOP, setting, flag or reference; opens no input file.

    `queued` are the epoch files, relative to the data folder, of scans that will be processed again anyway.
    """
    series, config = series_for(site), CurrentConfig(site)
    if not series.path.is_file():
        return 0
    names = {Path(file).name for file in queued}
    stored = [epoch for epoch in stored_epochs(series) if epoch.ref.epoch_file not in names]
    valid = _valid_versions(site, series, stored)
    return sum(
        epoch.science_hash != site.science_hash
        or bool(config.changed_settings(epoch.provenance))
        or (valid is not None and epoch.reference not in valid)
        for epoch in stored
    )


def _valid_versions(site: Site, series: Series, stored: list[StoredEpoch]) -> set[str] | None:
    """Return the valid versions of the reference; None if there never was one."""
    if isinstance(site.reference.scans, Path):
        return {file_version(site.reference.scans)}
    versions = set(valid_versions(series))
    return versions if versions or any(epoch.reference for epoch in stored) else None


def stale_versions(
    site: Site, series: Series, config: CurrentConfig, entries: Iterable[Entry]
) -> tuple[str, ...]:
    """Return the versions built with other settings or inputs, and those that build on them."""
    if isinstance(site.reference.scans, Path):
        return ()
    by_id, finder = {scan_id(entry.name): entry for entry in entries}, ScanFinder(site)
    versions = valid_versions(series)
    for index, reference_provenance in enumerate(versions.values()):
        is_stale = reference_provenance.science_hash not in {"", site.science_hash}
        for provenance in map(ScanProvenance.from_attrs, reference_provenance.scan_provenance):
            entry = by_id.get(provenance.scan_id)
            scan = finder.find(entry.name, provenance.start_s) if entry else None
            is_stale = is_stale or bool(
                config.changed_settings(provenance) or config.changed_inputs(provenance, scan, entry)
            )
        if is_stale:
            return tuple(versions)[index:]
    return ()
