"""Consistency of journal and files: checksums, damaged files, epochs that one of the two lacks."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import Protocol, TypeVar

from station.archive.netcdf_layout import Series
from station.archive.series.index import list_epochs, stored_series
from station.clock import Clock
from station.config import Site
from station.errors import ConfigError, StoreError
from station.inbox.journal import Journal
from station.logs import logfmt
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
from station.processing.provenance import stored_epochs
from station.processing.scanner_pose import NO_SOP
from station.processing.scans.scan_files import ScanFinder
from station.processing.site_files import series_for
from station.science.geometry.pose import horizontal_crs, is_same_map

log = logging.getLogger("station")
T = TypeVar("T")
VERIFY_INTERVAL_S = 3600.0  # minimum interval between full checksum runs after store errors


class RunTask(Protocol):
    """Runs a task on the site in a worker process; see `Worker.run`."""

    def __call__(self, task: Callable[..., T], *args: object) -> T: ...  # noqa: D102


class StoreRepair:
    """Finds and repairs what is damaged or missing in the store; the tasks run in a worker process.

    `update_series` brings the series up to date.
    """

    def __init__(
        self, site: Site, journal: Journal, run: RunTask, update_series: Callable[[], object], clock: Clock
    ) -> None:
        self._site = site
        self._series = series_for(site)
        self._journal = journal
        self._run = run
        self._update_series = update_series
        self._clock = clock
        self._last_verified_s = -math.inf

    def reconcile(self) -> None:
        """Reconcile journal and files: add missing checksums and journal entries, rebuild the series.

        Lost or damaged epochs are reprocessed if their scan is still in the inbox. `scan_tasks.process`
        recognises an epoch written just before a power cut and does not store it twice.
        """
        self._quarantine(self._run(unreadable_files))
        self.add_checksums()
        self._import_unjournaled()
        self._requeue_missing()
        if holds_epochs(self._series):
            self._update_series()

    def add_checksums(self) -> None:
        """Record the checksums of files that have none; quarantine files that cannot be read."""
        result = self._run(add_checksums, self._journal.checksums())
        self._quarantine(result.damaged)
        self._journal.add_checksums(result.new_checksums)

    def verify_store(self) -> None:
        """Verify every file against its checksum; quarantine damaged ones."""
        damaged = self._run(verify_checksums, self._journal.checksums()).damaged
        self._quarantine(damaged)
        for name in filter(is_reference, damaged):  # a new version replaces it
            quarantine(self._series, [name])
            self._journal.drop_checksums([name])

    def with_repair(self, task: Callable[..., T], *args: object) -> T:
        """Run a task; if it finds the store damaged, quarantine the damaged files and run it once more."""
        try:
            return self._run(task, *args)
        except StoreError:
            if not self.repair():
                raise
            return self._run(task, *args)

    def repair(self) -> bool:
        """Quarantine damaged files and requeue their epochs; return True if any holds epochs."""
        damaged = self._run(unreadable_files)
        if not damaged and self._clock.monotonic_s() > self._last_verified_s + VERIFY_INTERVAL_S:
            self._last_verified_s = self._clock.monotonic_s()
            damaged = self._run(verify_checksums, self._journal.checksums()).damaged
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
        missing = self.with_repair(unjournaled_epochs, self._journal.epochs())
        if missing:
            log.warning("%s", logfmt(journal="completed", epochs=len(missing), reason="missing in it"))
        self._journal.import_entries(missing)
        self.with_repair(restore_tilt_offsets)

    def _requeue_missing(self) -> None:
        finder = ScanFinder(self._site)
        for name in self._run(missing_epochs, self._journal.current_epochs()):
            if finder.in_inbox(name):
                log.warning("%s", logfmt(scan=name, reason="epoch missing from the store: reprocessing"))
                self._journal.requeue([name])
            else:
                reason = "epoch missing from the store, scan missing from the inbox: run station reprocess"
                log.error("%s", logfmt(scan=name, reason=reason))


def require_same_map(site: Site) -> None:
    """Raise ConfigError if the stored series has another map or grid: a series has only one."""
    series = stored_series(series_for(site))
    if series is None:
        return
    crs = site.grid_crs
    if (crs is None) != (series.crs is None) or (
        crs and series.crs and not is_same_map(horizontal_crs(series.crs), horizontal_crs(crs))
    ):
        stored_name = horizontal_crs(series.crs).name if series.crs else "a local frame, without map.crs"
        raise ConfigError(
            f"map.crs = {crs!r} differs from that of {site.station.data}, {stored_name}: restore it, or give"
            " station.data a new folder"
        )
    _require_same_frame(site, series)
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
    if stored.plane != configured.plane:
        raise ConfigError(
            f"grid.plane differs from that of {site.station.data}: restore it, or give station.data a new"
            " folder"
        )
    if stored.shape != configured.shape or deviation_m > 1e-3 * configured.cell_m:
        raise ConfigError(
            f"[grid] differs from that of {site.station.data}: {stored.nx} x {stored.ny} cells of"
            f" {stored.cell_m:.6g} m from west {stored.west_m:.10g}, north {stored.north_m:.10g}: restore it,"
            " or give station.data a new folder"
        )


def _require_same_frame(site: Site, series: Series) -> None:
    """Raise ConfigError if the first stored epoch is on a local map without an SOP, and others would not be.

    An SOP moves every cell: the reference of the local map means nothing under it.
    """
    if site.scans.frame == "map":
        return
    with suppress(StoreError):  # damaged files are repaired later
        first = stored_epochs(series, list_epochs(series)[:1])
        sop_id = first[0].provenance.sop_id if first else ""
        if sop_id and (sop_id == NO_SOP) == bool(site.sop):
            stored, now = ("without an [[sop]]", "has one") if site.sop else ("with an [[sop]]", "has none")
            raise ConfigError(
                f"{site.station.data} is of a map {stored}, the site file {now}: restore it, or give"
                " station.data a new folder and process the scans again"
            )
