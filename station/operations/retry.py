"""`station retry`: queue scans that were set aside or failed, also beside the running service."""

from __future__ import annotations

from collections.abc import Sequence

from station.config import Site
from station.errors import StationError
from station.inbox.journal import Journal
from station.inbox.journal_reader import Entry, State
from station.inbox.lock import is_locked
from station.processing.scans.scan_files import ScanFinder

_FINAL = {State.SET_ASIDE, State.LATER}


def retry_scans(site: Site, names: Sequence[str]) -> list[str]:
    """Queue these scans, or all that were set aside or failed; return what was done, a line each.

    Raises StationError, and queues none, if one of the names is not that of such a scan in the inbox.
    """
    if not (site.station.data / "journal.sqlite").is_file():
        raise StationError(f"{site.station.data}: has no journal: nothing was ever processed")
    with Journal(site.station.data / "journal.sqlite") as journal:
        entries = {entry.name: entry for entry in journal.rows()}
        if names:
            faults = [fault for name in names if (fault := _fault(site, name, entries.get(name)))]
            if faults:
                raise StationError("\n".join(faults))
        chosen = names or [name for name, entry in entries.items() if entry.state in _FINAL]
        finder = ScanFinder(site)
        queued = [name for name in chosen if finder.in_inbox(name)]
        journal.requeue(queued, "station retry")
    if not queued:
        return ["nothing to retry: no scan in the inbox was set aside or failed"]
    when = "within a minute" if is_locked(site.station.data) else "when the service runs: it is not running"
    return [*(f"{name}: queued" for name in queued), f"{len(queued)} scans, tried again {when}"]


def _fault(site: Site, name: str, entry: Entry | None) -> str:
    """Return why a scan cannot be retried, '' if it can."""
    if entry is None:
        return f"{name}: no such scan in the journal: give a file name that station status lists"
    if entry.state not in _FINAL:
        state = "stored: see station reprocess" if entry.state is State.STORED else "already waiting"
        return f"{name}: is {state}"
    if not ScanFinder(site).in_inbox(name):
        return f"{name}: is not in the inbox {site.scans.inbox}: copy it there, and it is tried by itself"
    return ""
