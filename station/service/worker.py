"""Takes scans one by one: a child process measures, the journal remembers, the series is published."""

from __future__ import annotations

import logging
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import TypeVar

from station.config import Site
from station.errors import NotReadyError, ScanError, StationError
from station.service import child
from station.service.inbox import Arrival
from station.service.journal import Entry, Journal, State
from station.service.logs import logfmt
from station.service.moved import moved_by
from station.service.show import show
from station.service.tasks import (
    Outcome,
    Progress,
    build_reference,
    improve_reference,
    join_epochs,
    open_only,
    process,
    process_patiently,
    publish,
    sweep_store,
)

log = logging.getLogger("station")
T = TypeVar("T")
IMPROVED_EVERY = 4  # a version is due at four times the scans of the one before
IMPROVED_MOST = 32  # scans that are read for it


class Worker:
    """Takes scans one by one: child process, journal, series, reference."""

    def __init__(
        self,
        site: Site,
        journal: Journal,
        *,
        on_progress: Progress = lambda: None,
        should_stop: Callable[[], bool] = lambda: False,
        patient: bool = False,
    ) -> None:
        """`patient`: scans may wait a while for their weather, as in the service."""
        self._site = site
        self._journal = journal
        self._on_progress = on_progress
        self._should_stop = should_stop
        self._patient = patient
        self._taken: dict[str, Arrival] = {}

    def take(self, arrival: Arrival) -> bool:
        """Measure and store a scan, and say so in the journal and in one log line; tell whether it is stored.

        Raises StoreError where the store cannot be written; the scan stays waiting then.
        """
        self._taken[arrival.name] = arrival
        try:
            outcome = self._run(process_patiently if self._patient else process, arrival)
        except ScanError as error:
            self._set_aside(arrival, error)
            return False
        except NotReadyError as error:
            pause_s = self._journal.later(arrival.name, str(error))
            log.info("%s", logfmt(scan=arrival.name, verdict="later", reason=error, retry_s=round(pause_s)))
            return False
        self._run(publish)
        self._journal.stored(
            arrival.name,
            sha256=outcome.sha256,
            verdict=outcome.verdict,
            epoch=outcome.epoch,
            start_utc_s=outcome.start_utc_s,
            revision=outcome.revision,
            reference=outcome.reference,
            reason=outcome.reason,
            figures=outcome.figures,
        )
        _say(arrival.name, outcome)
        if self._site.adjusts and (moved := self._run(moved_by, outcome.start_utc_s)):
            log.warning("%s", logfmt(scan=arrival.name, moved=moved))
        self._show()
        self._make_reference_when_due()
        return True

    def glance(self, arrival: Arrival) -> None:
        """Set a scan aside at once if its headers are broken, rather than after waiting for its log."""
        try:
            self._run(open_only, arrival)
        except ScanError as error:
            self._set_aside(arrival, error)
        except NotReadyError:
            return

    def recover(self) -> None:
        """Make journal and files agree: epochs without their journal row are redone, the series is rebuilt.

        An epoch written just before a power cut is found by `process` as the same and not stored twice.
        """
        data = self._site.station.data
        lost = [row.name for row in self._journal.rows(State.STORED) if row.epoch and not self._is_there(row)]
        for name in lost:
            log.warning("%s", logfmt(scan=name, reason="its epoch is missing from the store: done again"))
        self._journal.again(lost)
        if any(path for kind in ("epochs", "days", "months") for path in (data / kind).glob("**/*.nc")):
            self._run(publish)

    def join_closed(self) -> None:
        """Join closed days and months."""
        self._run(join_epochs)

    def sweep(self) -> None:
        """Delete what no longer serves."""
        self._run(sweep_store)

    def _set_aside(self, arrival: Arrival, error: ScanError) -> None:
        self._journal.set_aside(arrival.name, str(error))
        log.warning("%s", logfmt(scan=arrival.name, verdict="set_aside", reason=error))
        self._show()

    def _show(self) -> None:
        """Bring the page up to what is stored; what fails there keeps no scan from the store."""
        try:
            self._run(show)
        except (StationError, RuntimeError) as error:
            log.warning("%s", logfmt(page="failed", reason=error))

    def _is_there(self, row: Entry) -> bool:
        """Tell whether a stored epoch still is: as itself, or joined into its day or month."""
        data = self._site.station.data
        start = datetime.fromtimestamp(row.start_utc_s or 0.0, UTC)
        if (data / str(row.epoch)).is_file():
            return True
        days = (data / "days" / start.strftime("%Y/%m")).glob(f"*_{start:%Y%m%d}_r*.nc")
        months = (data / "months" / start.strftime("%Y")).glob(f"*_{start:%Y%m}_r*.nc")
        return any(days) or any(months)

    def _make_reference_when_due(self) -> None:
        """Build the master surface once enough usable scans are stored; make a better one of ever more.

        All epochs are measured from the first. Later versions change it on stable ground only, so that
        epochs measured from an older one stay as they are.
        """
        wanted = self._site.reference.scans
        if isinstance(wanted, Path):
            return
        usable = [row for row in self._journal.rows(State.STORED) if row.verdict == "good"]
        usable.sort(key=lambda row: row.start_utc_s or 0.0)
        version = self._versions() + 1
        due = wanted * IMPROVED_EVERY ** (version - 1)
        if len(usable) < due or (version > 1 and not self._site.adjusts):
            return
        chosen = usable[:wanted]
        if version > 1:
            step = max(1, due // IMPROVED_MOST)
            chosen = usable[:due][::step][:IMPROVED_MOST]
        arrivals = [self._arrival(row.name) for row in chosen]
        missing = [arrival.name for arrival in arrivals if not arrival.path.is_file()]
        if missing and version == 1:
            log.warning("%s", logfmt(reference="waiting", reason=f"no longer there: {', '.join(missing)}"))
            return
        arrivals = [arrival for arrival in arrivals if arrival.path.is_file()]
        if len(arrivals) < wanted:
            return
        try:
            made = self._run(build_reference if version == 1 else improve_reference, arrivals, str(version))
        except (ScanError, NotReadyError) as error:
            log.warning("%s", logfmt(reference="failed", reason=error))
            return
        log.info("%s", logfmt(reference=made, scans=len(arrivals)))
        if version == 1:
            others = (row.name for row in self._journal.rows(State.STORED) if row.reference != made)
            self._journal.again(others)

    def _versions(self) -> int:
        """Return the newest version of the reference, nought where there is none."""
        found = self._site.station.data.glob("reference_*.nc")
        numbers = (path.stem.removeprefix("reference_") for path in found)
        return max((int(number) for number in numbers if number.isdigit()), default=0)

    def _arrival(self, name: str) -> Arrival:
        """Find a scan again: where it was taken from, or in the inbox."""
        if name in self._taken:
            return self._taken[name]
        path = self._site.scans.inbox / name
        log_path = None
        if self._site.inclination is not None:
            beside = path.with_name(f"{path.stem}{self._site.inclination.suffix}")
            log_path = beside if beside.is_file() else None
        status = path.stat() if path.is_file() else None
        return Arrival(
            name=name,
            path=path,
            log=log_path,
            size=status.st_size if status else 0,
            mtime_ns=status.st_mtime_ns if status else 0,
        )

    def _run(self, task: Callable[..., T], *args: object) -> T:
        return child.run(
            task,
            self._site,
            *args,
            memory_gb=self._site.service.memory_gb,
            timeout_s=self._site.scans.timeout_s,
            on_progress=self._on_progress,
            should_stop=self._should_stop,
        )


def _say(name: str, outcome: Outcome) -> None:
    """Log the one line of a scan."""
    words = {
        "scan": name,
        "verdict": outcome.verdict,
        **outcome.figures,
        "reference": outcome.reference or "none",
        **({"reason": outcome.reason} if outcome.reason else {}),
    }
    log.log(logging.INFO if outcome.verdict == "good" else logging.WARNING, "%s", logfmt(**words))
