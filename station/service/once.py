"""Scans processed now, without a service: `station process` and `station demo`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from station.config import Site
from station.errors import NotReadyError, ScanError
from station.service.journal import Entry, Journal, State
from station.service.lock import only_writer
from station.service.places import arrival_of
from station.service.worker import Worker

Tell = Callable[[Entry], None]


def process_scans(site: Site, scans: Sequence[Path], tell: Tell) -> int:
    """Process scans in the order of their names, `tell` the journal row of each; return the exit status.

    Those from before the reference was there are done again as soon as it is, and told again.
    """
    site.station.data.mkdir(parents=True, exist_ok=True)
    with only_writer(site.station.data), Journal(site.station.data / "journal.sqlite") as journal:
        worker = Worker(site, journal)
        arrivals = {path.name: arrival_of(site, path) for path in sorted(scans, key=lambda path: path.name)}
        journal.seen((one.name, one.size, one.mtime_ns, "") for one in arrivals.values())
        todo = list(arrivals)
        while todo:
            name = todo.pop(0)
            worker.take(arrivals[name])
            entry = journal.entry(name)
            assert entry is not None  # noqa: S101 - it was just taken
            if entry.state is not State.WAITING:  # for the reference it just made possible
                tell(entry)
            again = {row.name for row in journal.waiting() if row.state is State.WAITING} - set(todo)
            todo[:0] = [name for name in arrivals if name in again]  # before later ones, as in the service
        states = {row.state for row in journal.rows() if row.name in arrivals}
    if State.SET_ASIDE in states:
        return ScanError.exit_status
    return NotReadyError.exit_status if State.LATER in states else 0


def one_line(entry: Entry) -> str:
    """Say what became of a scan, in one line."""
    figures = " ".join(f"{key}={value}" for key, value in entry.figures.items())
    if entry.state is State.STORED:
        measured = f" reference={entry.reference}" if entry.reference else " (no reference yet)"
        reason = f" ({entry.reason})" if entry.reason else ""
        return f"{entry.name}: {entry.verdict}{reason} {figures}{measured}"
    why = entry.reason if entry.state is State.SET_ASIDE else entry.waits_for
    return f"{entry.name}: {entry.state.value.replace('_', ' ')}: {why}"
