"""Takes scans one by one: a child process measures, the journal remembers, the series is published."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TypeVar

from station.archive.reference import current
from station.archive.store import series_in
from station.config import Site
from station.errors import ConfigError, NotReadyError, ScanError, StationError, StoreError
from station.service import child
from station.service.digest import write_digest, yesterday
from station.service.inbox import Arrival
from station.service.integrity import (
    holds_epochs,
    is_reference,
    lost,
    quarantine,
    restore_zeros,
    seal,
    unknown,
    unopened,
    verify,
)
from station.service.joining import Joining
from station.service.journal import Entry, Journal, State
from station.service.logs import logfmt
from station.service.places import find_scan
from station.service.references import (
    build_reference,
    improve_reference,
    next_version,
    number_due,
    scans_due,
)
from station.service.retention import due_to_go, retire
from station.service.show import show
from station.service.stale import count_by_settings, late
from station.service.tasks import Outcome, Past, Progress, Refused, Same, attend, open_only, series_of
from station.service.upkeep import OPEN_EPOCHS, Checksums, join_epochs, publish, sweep_store

log = logging.getLogger("station")
T = TypeVar("T")
VERIFIED_EVERY_S = 3600.0  # at most, all checksums, when the store makes trouble


class Worker:
    """Takes scans one by one: child process, journal, series, reference."""

    def __init__(
        self,
        site: Site,
        journal: Journal,
        *,
        on_progress: Progress = lambda: None,
        should_stop: Callable[[], bool] = lambda: False,
        on_joined: Callable[[], None] = lambda: None,
        patient: bool = False,
    ) -> None:
        """`on_joined` is called, in another thread, when `note_joined` has something to do.

        `patient`: as in the service, scans may wait for weather, and one only touched is not done again.

        Raises ConfigError where the store is of another grid.
        """
        _require_same_grid(site)
        self._site = site
        self._series = series_of(site)
        self._journal = journal
        self._on_progress = on_progress
        self._should_stop = should_stop
        self._patient = patient
        self._taken: dict[str, Arrival] = {}
        self._verified_s = -math.inf
        self._told_stale = 0
        self._joining = Joining(site, on_joined)

    def take(self, arrival: Arrival) -> bool:
        """Measure and store a scan, and say so in the journal and in one log line; tell whether it is stored.

        Raises StoreError where the store cannot be written; the scan stays waiting then.
        """
        self._taken[arrival.name] = arrival
        entry = self._journal.entry(arrival.name)
        past = Past(
            reference=entry.reference if entry else None,
            revision=(entry.revision if entry else None) or 0,
            content=_judged(entry) if self._patient else None,
            stored=self._journal.others_stored(arrival.name, arrival.size),
            patient=self._patient,
        )
        try:
            outcome = self._mending(attend, arrival, past)
        except ScanError as error:
            return self._set_aside(arrival, str(error))
        except NotReadyError as error:
            pause_s = self._journal.later(arrival.name, str(error))
            log.info("%s", logfmt(scan=arrival.name, verdict="later", reason=error, retry_s=round(pause_s)))
            return False
        if isinstance(outcome, Refused):
            return self._set_aside(arrival, outcome.reason, outcome.sha256, outcome.log_sha256)
        if isinstance(outcome, Same):
            return self._note_same(arrival, outcome)
        alone = self._mending(publish)
        remember(self._journal, arrival.name, outcome)
        _say(arrival.name, outcome)
        self.show(arrival.name, outcome)
        self._make_reference_when_due()
        if self._patient and alone > OPEN_EPOCHS:
            self.begin_joining(in_backlog=True)
        return True

    def glance(self, arrival: Arrival) -> None:
        """Set a scan aside at once if its headers are broken, rather than after waiting for its log."""
        try:
            self.run(open_only, arrival)
        except ScanError as error:
            self._set_aside(arrival, str(error))
        except NotReadyError:
            return

    def recover(self) -> None:
        """Reconcile after a start or a fault; make a reference that was due.

        What comes next is to be measured from it, as without the cut.
        """
        self.reconcile()
        self._make_reference_when_due()

    def reconcile(self) -> None:
        """Make journal and files agree: checksums are completed, lost rows made anew, the series is rebuilt.

        Epochs that are lost or damaged are redone where their scan is still in the inbox. One written just
        before a power cut is found by `tasks.process` as the same and not stored twice.
        """
        self._put_aside(self.run(unopened))
        self.seal()
        self._adopt()
        self._have_lost_done_again()
        if holds_epochs(self._series):
            self._mending(publish)

    def seal(self) -> None:
        """Note the checksums of files that have none; put aside those that cannot be read."""
        found = self.run(seal, self._journal.files())
        self._put_aside(found.damaged)
        self._journal.note_files(found.fresh)

    def prove(self) -> None:
        """Prove every file against its checksum and put aside those that are damaged."""
        damaged = self.run(verify, self._journal.files()).damaged
        self._put_aside(damaged)
        for name in filter(is_reference, damaged):  # a new version is made instead
            quarantine(self._series, [name])
            self._journal.forget_files([name])

    def join_closed(self) -> None:
        """Join closed days and months; sum up the day that is over."""
        self._note_joined(self._mending(join_epochs, self._journal.files()))

    def begin_joining(self, *, in_backlog: bool = False) -> None:
        """Have closed days and months joined while scans are taken; `note_joined` ends it."""
        self._joining.begin(self._journal.files(), in_backlog=in_backlog)

    def note_joined(self) -> None:
        """Have the series name what was joined meanwhile, if that is done; sum up the day that is over."""
        try:
            made = self._joining.take()
        except StoreError:
            if not self._mend():
                raise
            return  # it is joined at its next time
        if made is not None:
            self._note_joined(made)

    def close(self) -> None:
        """End what is done beside the scans."""
        self._joining.close()

    def _note_joined(self, made: Checksums) -> None:
        if made:
            self._journal.note_files(made)
            self._mending(publish)
        self._sum_up()

    def _sum_up(self) -> None:
        """Write the digest of yesterday; what fails there keeps no scan from the store."""
        try:
            if self.run(write_digest, yesterday(time.time())):
                log.info("%s", logfmt(digest="written"))
        except (StationError, RuntimeError) as error:
            log.warning("%s", logfmt(digest="failed", reason=error))

    def sweep(self) -> None:
        """Delete what no longer serves, redo what came late, tell what is stale, let raw scans go."""
        self._journal.forget_files(self._mending(sweep_store))
        came = self._mending(late, self._journal.rows(State.STORED))
        names = [name for name in came if (self._site.scans.inbox / name).is_file()]
        for name in names:
            log.info("%s", logfmt(scan=name, reason="its log or weather came: done again"))
        self._journal.again(names)
        self._tell_stale()
        self._let_raw_scans_go()

    def _mending(self, task: Callable[..., T], *args: object) -> T:
        """Run a task; where the store is found damaged, put the damaged files aside and run it once more."""
        try:
            return self.run(task, *args)
        except StoreError:
            if not self._mend():
                raise
            return self.run(task, *args)

    def _mend(self) -> bool:
        """Put damaged files aside and have their epochs done again; tell whether there were any."""
        damaged = self.run(unopened)
        if not damaged and time.monotonic() > self._verified_s + VERIFIED_EVERY_S:
            self._verified_s = time.monotonic()
            damaged = self.run(verify, self._journal.files()).damaged
        self._put_aside(damaged)
        if damaged:
            self._have_lost_done_again()
        return not all(map(is_reference, damaged))

    def _put_aside(self, damaged: Iterable[str]) -> None:
        for name in damaged:
            if is_reference(name):
                log.error("%s", logfmt(file=name, reason="damaged: restore it, or station reprocess"))
                continue
            quarantine(self._series, [name])
            self._journal.forget_files([name])
            log.error(
                "%s", logfmt(file=name, reason="damaged: left out of the series, kept as *.damaged beside it")
            )

    def _adopt(self) -> None:
        """Make rows for epochs that the journal does not know: it was lost, or older than the store."""
        found = self._mending(unknown, self._journal.epochs())
        if found:
            log.warning("%s", logfmt(journal="made anew", epochs=len(found), reason="it knew not of them"))
        self._journal.adopt(found)
        self.run(restore_zeros)

    def _have_lost_done_again(self) -> None:
        for name in self.run(lost, self._journal.epochs(State.STORED)):
            if (self._site.scans.inbox / name).is_file():
                log.warning("%s", logfmt(scan=name, reason="its epoch is missing from the store: done again"))
                self._journal.again([name])
            else:
                says = "its epoch is missing from the store, and the scan from the inbox: station reprocess"
                log.error("%s", logfmt(scan=name, reason=says))

    def _set_aside(
        self, arrival: Arrival, reason: str, sha256: str | None = None, log_sha256: str = ""
    ) -> bool:
        self._journal.set_aside(arrival.name, reason, sha256=sha256, log_sha256=log_sha256)
        log.warning("%s", logfmt(scan=arrival.name, verdict="set_aside", reason=reason))
        self.show()
        return False

    def show(self, name: str = "", outcome: Outcome | None = None) -> None:
        """Bring the page up to what is stored, and say if the scan just stored shows that the scanner moved.

        What fails there keeps no scan from the store.
        """
        try:
            shown = self.run(show, outcome)
        except (StationError, RuntimeError) as error:
            log.warning("%s", logfmt(page="failed", reason=error))
            return
        if shown.news:
            log.warning("%s", logfmt(scan=name, moved=shown.news))
        if shown.fault:
            log.warning("%s", logfmt(page="failed", reason=shown.fault))

    def _note_same(self, arrival: Arrival, same: Same) -> bool:
        """Put a scan back where it was, or aside if it is another's copy; tell whether it is stored."""
        if same.name != arrival.name:
            return self._set_aside(arrival, f"the same bytes as {same.name}, which is stored", same.sha256)
        self._journal.same_again(arrival.name, same.sha256)
        log.info("%s", logfmt(scan=arrival.name, verdict="same", reason="the bytes are those done before"))
        entry = self._journal.entry(arrival.name)
        return entry is not None and entry.state is State.STORED

    def _tell_stale(self) -> None:
        """Say, when the number changes, how many epochs were made with another SOP or setting."""
        count = self.run(_count_stale)
        if count and count != self._told_stale:
            says = "made with another SOP, setting, flag or reference: station reprocess"
            log.warning("%s", logfmt(epochs=count, reason=says))
        self._told_stale = count

    def _let_raw_scans_go(self) -> None:
        """Move or delete raw scans as `[retention]` says."""
        due = due_to_go(self._site, self._journal.rows(State.STORED), self._kept_for_reference())
        entries = [entry for entry in map(self._journal.entry, due) if entry is not None]
        if not entries or self._should_stop():
            return
        try:
            told = self.run(retire, entries, self._journal.files())
        except (ScanError, NotReadyError) as error:  # the child was lost, or the service is to stop
            log.warning("%s", logfmt(retention="waits", reason=error))
            return
        for name, done, why in told:
            says = {"reason": why} if why else {}
            log.log(logging.WARNING if why else logging.INFO, "%s", logfmt(scan=name, retention=done, **says))

    def _kept_for_reference(self) -> set[str]:
        return set(scans_due(self._site, self._usable(), len(current(self._series))))

    def _usable(self) -> list[str]:
        """Return the scans that a reference may be made of, by their time."""
        return self._journal.usable()

    def _make_reference_when_due(self) -> None:
        """Build the master surface once enough usable scans are stored; make a better one of ever more."""
        wanted, usable = self._site.reference.scans, self._usable()
        made = current(self._series)
        if made and not isinstance(wanted, Path):
            self._have_bare_done_again()
        chosen = scans_due(self._site, usable, len(made))
        if isinstance(wanted, Path) or not chosen or len(usable) < number_due(self._site, len(made)):
            return
        arrivals = [self._arrival(name) for name in chosen]
        there = [arrival for arrival in arrivals if arrival is not None]
        if len(there) < (wanted if made else len(chosen)):
            gone = [name for name, arrival in zip(chosen, arrivals, strict=True) if arrival is None]
            if not made:
                log.warning("%s", logfmt(reference="waiting", reason=f"no longer there: {', '.join(gone)}"))
            return
        try:
            version = next_version(self._series, (row.reference for row in self._journal.rows()))
            if made:
                self.run(improve_reference, there, version, list(made)[-1], ())
            else:
                self.run(build_reference, there, version)
        except (ScanError, NotReadyError) as error:
            log.warning("%s", logfmt(reference="failed", reason=error))
            return
        self.seal()
        log.info("%s", logfmt(reference=version, scans=len(there)))
        if not made:
            others = (row.name for row in self._journal.rows(State.STORED) if row.reference != version)
            self._journal.again(others)

    def _have_bare_done_again(self) -> None:
        """Redo what is stored without change: the power went between the reference and its first use."""
        inbox = self._site.scans.inbox
        again = [name for name in self._journal.bare() if name in self._taken or (inbox / name).is_file()]
        self._journal.again(again)

    def _arrival(self, name: str) -> Arrival | None:
        """Find a scan again: where it was taken from, in the inbox or in the archive."""
        taken = self._taken.get(name)
        if taken is not None and taken.path.is_file():
            return taken
        entry = self._journal.entry(name)
        return find_scan(self._site, name, entry.start_utc_s if entry else None)

    def run(self, task: Callable[..., T], *args: object) -> T:
        """Run a task of this site in a child: at most `timeout_s` a scan, one without scans for ever."""
        listed = [one for arg in args for one in (arg if isinstance(arg, list) else [arg])]
        scans = sum(isinstance(one, Arrival) for one in listed)
        return child.run(
            task,
            self._site,
            *args,
            memory_gb=self._site.service.memory_gb,
            timeout_s=self._site.scans.timeout_s * scans if scans else math.inf,
            on_progress=self._on_progress,
            should_stop=self._should_stop,
        )


def _judged(entry: Entry | None) -> tuple[str, str] | None:
    """Return the checksums of the scan and log that were judged under a name; None where none were."""
    if entry is None or entry.outcome is None or not entry.sha256:
        return None
    return entry.sha256, entry.log_sha256


def remember(journal: Journal, name: str, outcome: Outcome) -> None:
    """Note in the journal what a scan gave."""
    journal.stored(
        name,
        sha256=outcome.sha256,
        verdict=outcome.verdict,
        epoch=outcome.epoch,
        start_utc_s=outcome.start_utc_s,
        revision=outcome.revision,
        reference=outcome.reference,
        reason=outcome.reason,
        figures=outcome.figures,
        log_sha256=outcome.log_sha256,
        epoch_sha256=outcome.epoch_sha256,
    )


def _require_same_grid(site: Site) -> None:
    """Raise ConfigError where what is stored lies on another grid: a series has one."""
    try:
        held = series_in(site.station.data).grid
    except StoreError:  # nothing yet, or to be made anew
        return
    given = site.grid_cells
    off_m = max(
        abs(one - other)
        for one, other in (
            (held.west_m, given.west_m),
            (held.north_m, given.north_m),
            (held.cell_m * held.nx, given.cell_m * given.nx),
        )
    )
    if held.shape != given.shape or off_m > 1e-3 * given.cell_m:
        raise ConfigError(
            f"[grid] is not that of {site.station.data}: {held.nx} x {held.ny} cells of {held.cell_m:.6g} m"
            f" from west {held.west_m:.10g}, north {held.north_m:.10g}: restore it, or give station.data a"
            " new folder"
        )


def _count_stale(site: Site, progress: Progress) -> int:
    progress()
    return count_by_settings(site)


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
