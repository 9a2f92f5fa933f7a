"""Processing of given scans without a running service: `station process` and `station demo`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from station.config import Site
from station.errors import NotReadyError, ScanError
from station.inbox.journal import Journal
from station.inbox.journal_reader import Entry, State
from station.inbox.lock import exclusive_lock
from station.processing.scans.scan_files import scan_of_files
from station.service.worker import Worker

Report = Callable[[Entry], None]


def process_scans(site: Site, scans: Sequence[Path], report: Report) -> int:
    """Process scans in order of their names and report the journal row of each; return the exit status.

    Scans processed without a reference are reprocessed, and reported again, once the reference exists.
    """
    site.station.data.mkdir(parents=True, exist_ok=True)
    with exclusive_lock(site.station.data), Journal(site.station.data / "journal.sqlite") as journal:
        worker = Worker(site, journal)
        files = {scan.name: scan for scan in scan_of_files(site, scans)}
        journal.record_seen((scan.name, scan.size, scan.mtime_ns, "") for scan in files.values())
        todo = list(files)
        while todo:
            name = todo.pop(0)
            worker.process(files[name])
            entry = journal.entry(name)
            assert entry is not None  # noqa: S101 - it was just processed
            if entry.state is not State.WAITING:  # waiting means: requeued, as it completed the reference
                report(entry)
            requeued = {other.name for other in journal.waiting() if other.state is State.WAITING} - set(todo)
            todo[:0] = [name for name in files if name in requeued]  # before later scans, as in the service
        worker.finish_levels(verify=False)
        states = {other.state for other in journal.rows() if other.name in files}
    if State.SET_ASIDE in states:
        return ScanError.exit_status
    return NotReadyError.exit_status if State.LATER in states else 0


def format_entry(entry: Entry) -> str:
    """Return one line that describes the result of a scan."""
    metrics = " ".join(f"{key}={value}" for key, value in entry.metrics.items())
    if entry.state is State.STORED:
        reference = f" reference={entry.reference}" if entry.reference else " (no reference yet)"
        reason = f" ({entry.reason})" if entry.reason else ""
        return f"{entry.name}: {entry.verdict}{reason} {metrics}{reference}"
    explanation = entry.reason if entry.state is State.SET_ASIDE else entry.waiting_reason
    return f"{entry.name}: {entry.state.value.replace('_', ' ')}: {explanation}"
