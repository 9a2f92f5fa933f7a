"""Compare the inbox with the journal: which scan can be processed now, and what the others wait for.

The service never changes the inbox and never relies on file events: it works from a full listing.
Source: service.md, 1.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import logging
import math
import os
import signal
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from station.errors import NotReadyError
from station.inbox.file_hash import sample_file
from station.inbox.journal import LONGEST_RETRY_S
from station.inbox.journal_reader import UNFINISHED, State
from station.inbox.listing import ScanFile, ScanListing, safe_name, start_from_name
from station.logs import logfmt
from station.scan_names import path_stem

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from station.config import Site
    from station.inbox.journal import Journal
    from station.inbox.journal_reader import EntrySummary

log = logging.getLogger("station")

MAX_REJECTED = 1000  # per poll, so that thousands of odd files delay no scan and no sign of life
MAX_LOGGED = 10  # of them, one line each
WAITING_TO_SETTLE = "size and mtime to be stable"
WAITING_FOR_LOG = "its inclination log"
WAITING_FOR_MATRIX = "its registration"
WAITING_FOR_FILES = "the other files of its epoch"
WAITING_TO_BE_CLOSED = "another process to close it"
MAX_LIVE_INTERVALS = 2.0  # of the expected interval: a scan that began earlier is not live
_RECHECK_S = 5.0  # of a file that another process has open: its closing raises no event


@dataclass(frozen=True)
class InboxState:
    """Result of one poll of the inbox."""

    first: ScanFile | None  # scan to process now: the earliest, or a live one ahead of a backlog
    to_precheck: (
        ScanFile | None
    )  # else one that waits for its log, once per scan: its header is checked early
    queued: int  # number of scans ready for processing, including `first`
    new: int  # number of names that are not in the journal
    next_s: float  # until another scan may be ready; inf if none waits
    ahead: bool = False  # if `first` is to be measured ahead of earlier scans, and again in its turn


@dataclass(frozen=True)
class _FileState:
    """Identity of a file and the time since which it has not changed."""

    identity: tuple[object, ...]
    unchanged_since_s: float  # monotonic


class Inbox:
    """Track how long each file has been unchanged; everything else is kept in the journal."""

    def __init__(
        self,
        site: Site,
        journal: Journal,
        suffixes: Iterable[str],
        *,
        monotonic_s: Callable[[], float] = time.monotonic,
        now_s: Callable[[], float] = time.time,
    ) -> None:
        self._site = site
        self._pattern = site.row_pattern
        self._settle_s = site.scans.settle_s
        self._max_live_s = MAX_LIVE_INTERVALS * site.scans.expected_every_s
        self._journal = journal
        self._suffixes = tuple(suffixes)
        self._monotonic_s = monotonic_s
        self._now_s = now_s
        self._file_states: dict[str, _FileState] = {}
        self._prechecked: set[tuple[object, ...]] = set()
        self._last_was_ahead = False
        self._samples: dict[tuple[str, int, int], bytes] = {}  # by name, size and mtime

    def poll(self) -> InboxState:
        """Return the state of the inbox; record new, changed and removed scans in the journal.

        Raises NotReadyError if the folder cannot be listed.
        """
        listing = ScanListing(self._site, self._site.scans.inbox, self._suffixes)
        summaries = self._journal.summaries()
        present = {*listing.scans, *(safe_name(name) for name in listing.rejected)}
        stable: list[ScanFile] = []
        to_precheck: ScanFile | None = None
        waiting: dict[str, tuple[str, int, int, str]] = {}
        next_s = math.inf
        for name in listing.scans:
            size, mtime_ns = listing.size_and_mtime_ns(name)
            identity = listing.identity(name)
            if self._is_done(summaries.get(name), size, mtime_ns):
                # If requeued it need not settle again; otherwise later scans would overtake it.
                self._file_states.setdefault(name, _FileState(identity, -math.inf))
                continue
            scan = listing.scan(name)
            waiting_reason, wait_s = self._assess(scan, identity, summaries.get(name))
            waiting[name] = name, size, mtime_ns, waiting_reason
            next_s = min(next_s, wait_s)
            if not waiting_reason:
                stable.append(scan)
            elif waiting_reason.startswith(WAITING_FOR_LOG) and identity not in self._prechecked:
                to_precheck = to_precheck or scan
        stable.sort(key=lambda scan: (start_from_name(scan.name, self._pattern), scan.name))
        while stable and _is_open_for_writing(stable[0]):
            scan = stable.pop(0)
            waiting[scan.name] = scan.name, scan.size, scan.mtime_ns, WAITING_TO_BE_CLOSED
            next_s = min(next_s, _RECHECK_S)
        self._journal.record_seen(waiting.values())
        if self._reject(listing, summaries):
            next_s = 0.0
        self._drop_removed(summaries, present)
        live = self._live_scan(stable, waiting, summaries)
        self._last_was_ahead = live is not None
        first = live or next(iter(stable), None)
        if first is not None:
            to_precheck = None
        if to_precheck is not None:
            self._prechecked.add(listing.identity(to_precheck.name))
        new = len(present - summaries.keys())
        return InboxState(first, to_precheck, len(stable), new, next_s, ahead=live is not None)

    def _live_scan(
        self,
        ready: list[ScanFile],
        waiting: Mapping[str, tuple[str, int, int, str]],
        summaries: Mapping[str, EntrySummary],
    ) -> ScanFile | None:
        """Return the newest of the scans that are ready if it is live and would be more than one scan late.

        It began recently, is one file, and has no epoch. One that may be a copy of another that waits, or has
        its start, takes its turn: of two copies the earlier counts. Between two live scans one of the backlog
        is processed.
        """
        if len(ready) <= 2 or self._last_was_ahead or ready[-1].parts:
            return None
        scan = ready[-1]
        start, summary = start_from_name(scan.name, self._pattern), summaries.get(scan.name)
        is_live = abs(self._now_s() - start.timestamp()) < self._max_live_s
        if not is_live or (summary is not None and summary.has_epoch) or _is_open_for_writing(scan):
            return None
        others = [file for name, file in waiting.items() if name != scan.name]
        if any(start_from_name(name, self._pattern) == start for name, *_ in others):
            return None
        same_size = [file for file in others if file[1] == scan.size]
        return None if same_size and self._may_be_copy(scan, same_size) else scan

    def _may_be_copy(self, scan: ScanFile, others: Iterable[tuple[str, int, int, str]]) -> bool:
        """Return True unless a sample of the bytes shows that a scan differs from all others of its size.

        Scans in a format without compression all have the same size.
        """
        try:
            sample = self._sample(scan.name, scan.size, scan.mtime_ns)
            return any(
                reason.startswith((WAITING_TO_SETTLE, WAITING_TO_BE_CLOSED))  # its bytes may still change
                or self._sample(name, size, mtime_ns) == sample
                for name, size, mtime_ns, reason in others
            )
        except NotReadyError:
            return True

    def _sample(self, name: str, size: int, mtime_ns: int) -> bytes:
        """Return the digest of a sample of a file, which is read once."""
        key = name, size, mtime_ns
        if key not in self._samples:
            self._samples[key] = hashlib.sha256(sample_file(self._site.scans.inbox / name, size)).digest()
        return self._samples[key]

    def _assess(
        self, scan: ScanFile, identity: tuple[object, ...], summary: EntrySummary | None
    ) -> tuple[str, float]:
        """Return what a scan still waits for ('' if nothing) and for how long [s]."""
        now_s = self._monotonic_s()
        file_state = self._file_states.get(scan.name)
        if file_state is None or file_state.identity != identity:
            file_state = self._file_states[scan.name] = _FileState(identity, now_s)
        stable_s = now_s - file_state.unchanged_since_s
        if stable_s < self._settle_s:
            return f"{WAITING_TO_SETTLE} for {self._settle_s:g} s", self._settle_s - stable_s
        epoch, count = self._site.epoch, len(scan.parts)
        if epoch is not None and (epoch.files is None or count < epoch.files):
            remaining_s = epoch.wait_s - stable_s
            if remaining_s > 0:
                there = f"{count} of {epoch.files}" if epoch.files else f"{count}"
                return f"{WAITING_FOR_FILES}, of which {there} are there", remaining_s
        inclination = self._site.inclination
        if inclination and inclination.required and len(scan.logs) < len(scan.files):
            remaining_s = inclination.wait_s - stable_s
            if remaining_s > 0 and not (scan.parts and scan.logs):  # one may serve all files of an epoch
                return f"{WAITING_FOR_LOG} {path_stem(scan.files[0].name)}{inclination.suffix}", remaining_s
        registration = self._site.registration
        if registration and registration.suffix and len(scan.matrices) < len(scan.files):
            remaining_s = registration.wait_s - stable_s
            if remaining_s > 0:
                missing = next(file for file in scan.files if file.matrix is None)
                return f"{WAITING_FOR_MATRIX} {path_stem(missing.name)}{registration.suffix}", remaining_s
        retry_s = self._retry_delay_s(scan, summary)
        return "its next attempt" if retry_s else "", retry_s or math.inf

    def _retry_delay_s(self, scan: ScanFile, summary: EntrySummary | None) -> float:
        """Return the time until a deferred scan is tried again [s]; 0 if it can be tried now."""
        if summary is None or summary.next_try_utc_s is None:
            return 0.0
        if (summary.size, summary.mtime_ns) != (scan.size, scan.mtime_ns):
            return 0.0
        remaining_s = summary.next_try_utc_s - self._now_s()
        return remaining_s if 0 < remaining_s <= LONGEST_RETRY_S else 0.0  # longer: the clock was set back

    def _is_done(self, summary: EntrySummary | None, size: int, mtime_ns: int) -> bool:
        """Return True if a scan was processed and has not changed since.

        An epoch of which files were removed, and no other came, has not.
        """
        if summary is None or summary.state not in {State.STORED, State.SET_ASIDE}:
            return False
        if self._site.epoch is not None and summary.state is State.STORED and size < summary.size:
            return mtime_ns <= summary.mtime_ns
        return (summary.size, summary.mtime_ns) == (size, mtime_ns)

    def _reject(self, listing: ScanListing, summaries: Mapping[str, EntrySummary]) -> bool:
        """Set files aside whatever they contain; return True if there are more of them for the next poll."""
        files = []
        for name, reason in listing.rejected.items():
            size, mtime_ns = listing.files[name].st_size, listing.files[name].st_mtime_ns
            if not self._is_done(summaries.get(safe_name(name)), size, mtime_ns):
                files.append((safe_name(name), size, mtime_ns, reason))
        now = files[:MAX_REJECTED]
        if now:
            self._journal.reject(now)
        for name, _, _, reason in now[:MAX_LOGGED]:
            log.warning(logfmt(scan=name, verdict="set_aside", reason=reason))
        if len(now) > MAX_LOGGED:
            log.warning(logfmt(scans=len(now) - MAX_LOGGED, verdict="set_aside", reason="see set_aside/"))
        return len(files) > MAX_REJECTED

    def _drop_removed(self, summaries: Mapping[str, EntrySummary], scans: Iterable[str]) -> None:
        """Drop scans that were removed from the inbox before they were processed."""
        unfinished = {name for name, summary in summaries.items() if summary.state in UNFINISHED}
        removed = sorted(unfinished - set(scans))
        if removed:
            self._journal.record_removed(removed)
            for name in removed:
                log.warning(logfmt(scan=name, verdict="gone", reason="removed before it was processed"))
        for name in self._file_states.keys() - set(scans):
            del self._file_states[name]
        for key in [key for key in self._samples if key[0] not in unfinished]:
            del self._samples[key]


def _is_open_for_writing(scan: ScanFile) -> bool:
    """Return True if another process has the scan or its log open for writing.

    A read lease is granted only if no process has the file open for writing. Leases work for the owner of the
    file and on local disks only; elsewhere False is returned and the unchanged size has to suffice.
    """
    for path in (*scan.paths, *scan.logs):
        try:
            descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
        except OSError:
            continue  # the worker reports what is wrong with it
        try:
            # A writer that opens the file during the lease raises a signal; the default one would kill us.
            fcntl.fcntl(descriptor, fcntl.F_SETSIG, signal.SIGURG)
            fcntl.fcntl(descriptor, fcntl.F_SETLEASE, fcntl.F_RDLCK)
            fcntl.fcntl(descriptor, fcntl.F_SETLEASE, fcntl.F_UNLCK)
        except OSError as error:
            if error.errno == errno.EAGAIN:
                return True
        finally:
            os.close(descriptor)
    return False
