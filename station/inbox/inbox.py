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
import re
import signal
import stat
import time
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from station.errors import NotReadyError
from station.inbox.file_hash import sample_file
from station.inbox.journal import LONGEST_RETRY_S
from station.inbox.journal_reader import UNFINISHED, State
from station.logs import logfmt
from station.scan_names import scan_stem, start_in_name

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from station.config import Site
    from station.inbox.journal import Journal
    from station.inbox.journal_reader import EntrySummary

log = logging.getLogger("station")

# Names that need no quotes in a log line or a shell, short enough for `<name>.txt` to be a valid file name.
_SAFE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._,+=@~()-]{0,99}")
MAX_REJECTED = 1000  # per poll, so that thousands of odd files delay no scan and no sign of life
MAX_LOGGED = 10  # of them, one line each
WAITING_TO_SETTLE = "size and mtime to be stable"
WAITING_FOR_LOG = "its inclination log"
WAITING_TO_BE_CLOSED = "another process to close it"
MAX_LIVE_INTERVALS = 2.0  # of the expected interval: a scan that began earlier is not live
_RECHECK_S = 5.0  # of a file that another process has open: its closing raises no event
_FILE_TYPES = {
    stat.S_IFLNK: "a link",
    stat.S_IFIFO: "a pipe",
    stat.S_IFDIR: "a folder",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}


@dataclass(frozen=True)
class ScanFile:
    """A scan in the inbox, with its inclination log if there is one."""

    name: str  # file name
    path: Path
    log: Path | None
    size: int
    mtime_ns: int


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

    identity: tuple[int, ...]
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
        self._folder = site.scans.inbox
        self._pattern = site.scans.pattern
        self._settle_s = site.scans.settle_s
        self._max_live_s = MAX_LIVE_INTERVALS * site.scans.expected_every_s
        self._inclination = site.inclination
        self._journal = journal
        self._suffixes = tuple(suffixes)
        self._monotonic_s = monotonic_s
        self._now_s = now_s
        self._file_states: dict[str, _FileState] = {}
        self._prechecked: set[tuple[int, ...]] = set()
        self._last_was_ahead = False
        self._samples: dict[tuple[str, int, int], bytes] = {}  # by name, size and mtime

    def poll(self) -> InboxState:
        """Return the state of the inbox; record new, changed and removed scans in the journal.

        Raises NotReadyError if the folder cannot be listed.
        """
        files = list_folder(self._folder)
        summaries = self._journal.summaries()
        log_suffix = self._inclination.suffix if self._inclination else ""
        scans = {name: status for name, status in files.items() if is_scan(name, self._suffixes, log_suffix)}
        new = len({safe_name(name) for name in scans} - summaries.keys())
        stable: list[ScanFile] = []
        to_precheck: ScanFile | None = None
        waiting: dict[str, tuple[str, int, int, str]] = {}
        rejected: list[tuple[str, int, int, str]] = []
        next_s = math.inf
        for name, status in scans.items():
            if _is_done(summaries.get(safe_name(name)), status):
                # If requeued it need not settle again; otherwise later scans would overtake it.
                identity = _identity(status) + self._log_identity(name, files)
                self._file_states.setdefault(name, _FileState(identity, -math.inf))
                continue
            if reason := _rejection_reason(name, status):
                rejected.append((safe_name(name), status.st_size, status.st_mtime_ns, reason))
                continue
            scan, waiting_reason, wait_s = self._assess(name, status, files, summaries.get(name))
            waiting[name] = name, status.st_size, status.st_mtime_ns, waiting_reason
            next_s = min(next_s, wait_s)
            if not waiting_reason:
                stable.append(scan)
            elif waiting_reason.startswith(WAITING_FOR_LOG) and _identity(status) not in self._prechecked:
                to_precheck = to_precheck or scan
        stable.sort(key=lambda scan: (start_from_name(scan.name, self._pattern), scan.name))
        while stable and _is_open_for_writing(stable[0]):
            scan = stable.pop(0)
            waiting[scan.name] = scan.name, scan.size, scan.mtime_ns, WAITING_TO_BE_CLOSED
            next_s = min(next_s, _RECHECK_S)
        self._journal.record_seen(waiting.values())
        self._reject(rejected[:MAX_REJECTED])
        if len(rejected) > MAX_REJECTED:
            next_s = 0.0
        self._drop_removed(summaries, scans)
        live = self._live_scan(stable, waiting, summaries)
        self._last_was_ahead = live is not None
        first = live or next(iter(stable), None)
        if first is not None:
            to_precheck = None
        if to_precheck is not None:
            self._prechecked.add(_identity(scans[to_precheck.name]))
        return InboxState(first, to_precheck, len(stable), new, next_s, ahead=live is not None)

    def _live_scan(
        self,
        ready: list[ScanFile],
        waiting: Mapping[str, tuple[str, int, int, str]],
        summaries: Mapping[str, EntrySummary],
    ) -> ScanFile | None:
        """Return the newest of the scans that are ready if it is live and would be more than one scan late.

        It began recently and has no epoch. One that may be a copy of another that waits, or has its start,
        takes its turn: of two copies the earlier counts. Between two live scans one of the backlog is
        processed.
        """
        if len(ready) <= 2 or self._last_was_ahead:
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
            self._samples[key] = hashlib.sha256(sample_file(self._folder / name, size)).digest()
        return self._samples[key]

    def _assess(
        self,
        name: str,
        status: os.stat_result,
        files: Mapping[str, os.stat_result],
        summary: EntrySummary | None,
    ) -> tuple[ScanFile, str, float]:
        """Return the scan, what it still waits for ('' if nothing) and for how long [s]."""
        log_name = self._log_name(name)
        log_identity = self._log_identity(name, files)
        identity = _identity(status) + log_identity
        now_s = self._monotonic_s()
        file_state = self._file_states.get(name)
        if file_state is None or file_state.identity != identity:
            file_state = self._file_states[name] = _FileState(identity, now_s)
        log_path = self._folder / log_name if log_name and log_identity else None
        scan = ScanFile(name, self._folder / name, log_path, status.st_size, status.st_mtime_ns)
        stable_s = now_s - file_state.unchanged_since_s
        if stable_s < self._settle_s:
            return scan, f"{WAITING_TO_SETTLE} for {self._settle_s:g} s", self._settle_s - stable_s
        if self._inclination and self._inclination.required and log_path is None:
            remaining_s = self._inclination.wait_s - stable_s
            if remaining_s > 0:
                return scan, f"{WAITING_FOR_LOG} {log_name}", remaining_s
        retry_s = self._retry_delay_s(status, summary)
        return scan, "its next attempt" if retry_s else "", retry_s or math.inf

    def _log_identity(self, name: str, files: Mapping[str, os.stat_result]) -> tuple[int, ...]:
        """Return the identity of a scan's log; () if it is missing, empty or not a regular file."""
        status = files.get(self._log_name(name) or "")
        is_usable = status is not None and stat.S_ISREG(status.st_mode) and status.st_size
        return _identity(status) if status is not None and is_usable else ()

    def _log_name(self, name: str) -> str | None:
        return f"{scan_stem(name)}{self._inclination.suffix}" if self._inclination else None

    def _retry_delay_s(self, status: os.stat_result, summary: EntrySummary | None) -> float:
        """Return the time until a deferred scan is tried again [s]; 0 if it can be tried now."""
        if summary is None or summary.next_try_utc_s is None or not _is_unchanged(summary, status):
            return 0.0
        remaining_s = summary.next_try_utc_s - self._now_s()
        return remaining_s if 0 < remaining_s <= LONGEST_RETRY_S else 0.0  # longer: the clock was set back

    def _reject(self, files: list[tuple[str, int, int, str]]) -> None:
        """Set files aside whatever they contain: (name, size, mtime_ns, reason)."""
        if not files:
            return
        self._journal.reject(files)
        for name, _, _, reason in files[:MAX_LOGGED]:
            log.warning(logfmt(scan=name, verdict="set_aside", reason=reason))
        if len(files) > MAX_LOGGED:
            log.warning(logfmt(scans=len(files) - MAX_LOGGED, verdict="set_aside", reason="see set_aside/"))

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


def list_folder(folder: Path) -> dict[str, os.stat_result]:
    """Return the `lstat` of each entry of a folder by name; raise NotReadyError if it cannot be listed."""
    files = {}
    try:
        with os.scandir(folder) as entries:
            for entry in entries:
                try:
                    files[entry.name] = entry.stat(follow_symlinks=False)
                except FileNotFoundError:
                    continue  # it was removed between the listing and the stat
    except OSError as error:
        raise NotReadyError(f"the inbox {folder} cannot be listed: {error.strerror}") from error
    return files


def is_scan(name: str, suffixes: tuple[str, ...], log_suffix: str = "") -> bool:
    """Return True if a file name is that of a scan; hidden files are transfers in progress.

    `log_suffix` is that of inclination logs, which may end like scans in text.
    """
    is_log = bool(log_suffix) and name.endswith(log_suffix)
    return name.lower().endswith(suffixes) and not name.startswith(".") and not is_log


def safe_name(name: str) -> str:
    """Return a file name escaped for the journal and for log lines; a plain name is returned unchanged."""
    if _SAFE_NAME.fullmatch(name):
        return name
    escaped = name.encode("unicode_escape").decode("ascii").replace("/", "")
    if len(escaped) <= 100:
        return escaped
    return f"{escaped[:90]}~{hashlib.sha256(os.fsencode(name)).hexdigest()[:9]}"


def _rejection_reason(name: str, status: os.stat_result) -> str | None:
    """Return why a file is rejected whatever its content, None if it is not."""
    if not stat.S_ISREG(status.st_mode):
        file_type = _FILE_TYPES.get(stat.S_IFMT(status.st_mode), "something else")
        return f"is {file_type}: only regular files are read; copy the scan itself into the inbox"
    if not _SAFE_NAME.fullmatch(name):
        return "the name has spaces, control or other special characters, or is too long: rename it"
    return None


def _is_unchanged(summary: EntrySummary, status: os.stat_result) -> bool:
    return (summary.size, summary.mtime_ns) == (status.st_size, status.st_mtime_ns)


def _is_done(summary: EntrySummary | None, status: os.stat_result) -> bool:
    return (
        summary is not None
        and summary.state in {State.STORED, State.SET_ASIDE}
        and _is_unchanged(summary, status)
    )


def _identity(status: os.stat_result) -> tuple[int, ...]:
    return status.st_ino, status.st_size, status.st_mtime_ns


def start_from_name(name: str, pattern: str) -> datetime:
    """Return the start of a scan according to its name; datetime.max (sorted last) if the name has none."""
    return start_in_name(name, pattern) or datetime.max.replace(tzinfo=UTC)


def _is_open_for_writing(scan: ScanFile) -> bool:
    """Return True if another process has the scan or its log open for writing.

    A read lease is granted only if no process has the file open for writing. Leases work for the owner of the
    file and on local disks only; elsewhere False is returned and the unchanged size has to suffice.
    """
    for path in filter(None, (scan.path, scan.log)):
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
