"""What lies in the inbox, against the journal: what may be taken now, and what the rest waits for.

The inbox is never changed by us. File events are not trusted: the listing is the truth (SERVICE.md).
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
from station.service.journal import LONGEST_PAUSE_S, State
from station.service.logs import logfmt

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from station.config import Site
    from station.service.journal import Glimpse, Journal

log = logging.getLogger("station")

# What needs no quotes in a log line or a shell; and `<name>.txt` must still be a possible file name.
_PLAIN_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._,+=@~()-]{0,99}")
WAITS_FOR_LOG = "its inclination log"
_LOOK_AGAIN_S = 5.0  # at a file someone holds open: nothing tells when it is closed
_KINDS = {
    stat.S_IFLNK: "a link",
    stat.S_IFIFO: "a pipe",
    stat.S_IFDIR: "a folder",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}


@dataclass(frozen=True)
class Arrival:
    """A scan that is complete as far as can be seen from outside, and its inclination log."""

    name: str  # of the file
    path: Path
    log: Path | None
    size: int
    mtime_ns: int


@dataclass(frozen=True)
class Listing:
    """What one look at the inbox gave."""

    first: Arrival | None  # the earliest that may be taken now
    unread: Arrival | None  # where there is none, one that waits for its log, once: is it worth waiting for?
    queued: int  # how many settled ones there are, the first among them
    new: int  # names never seen before
    next_s: float  # until another may be ready; inf where none waits


@dataclass(frozen=True)
class _Sight:
    """A scan as it lay there, and since when it has not changed."""

    print: tuple[int, ...]
    since_s: float  # monotonic


class Inbox:
    """Remembers since when each file has stood still; everything else is in the journal."""

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
        self._pattern = site.scans.name
        self._settle_s = site.scans.settle_s
        self._inclination = site.inclination
        self._journal = journal
        self._suffixes = tuple(suffixes)
        self._monotonic_s = monotonic_s
        self._now_s = now_s
        self._sights: dict[str, _Sight] = {}
        self._given_to_read: set[tuple[int, ...]] = set()

    def look(self) -> Listing:
        """List the folder, note in the journal what is new, changed or gone, and give the scan to take next.

        Raises NotReadyError where the folder cannot be listed.
        """
        there = list_folder(self._folder)
        known = self._journal.glimpses()
        scans = {name: status for name, status in there.items() if is_scan(name, self._suffixes)}
        new = len({quoted(name) for name in scans} - known.keys())
        settled: list[Arrival] = []
        unread: Arrival | None = None
        waiting: list[tuple[str, int, int, str]] = []
        next_s = math.inf
        for name, status in scans.items():
            if _is_done(known.get(quoted(name)), status):
                # To be done again it need not settle anew: later scans would be done before it.
                print_ = _print(status) + self._log_print(name, there)
                self._sights.setdefault(name, _Sight(print_, -math.inf))
                continue
            if why := _refusal(name, status):
                self._refuse(name, status, why)
                continue
            arrival, waits_for, wait_s = self._weigh(name, status, there, known.get(name))
            waiting.append((name, status.st_size, status.st_mtime_ns, waits_for))
            next_s = min(next_s, wait_s)
            if not waits_for:
                settled.append(arrival)
            elif waits_for.startswith(WAITS_FOR_LOG) and _print(status) not in self._given_to_read:
                unread = unread or arrival
        self._journal.seen(waiting)
        self._forget(known, scans)
        settled.sort(key=lambda arrival: (_start(arrival.name, self._pattern), arrival.name))
        first = next((arrival for arrival in settled if not _is_written(arrival)), None)
        if settled and first is None:
            next_s = min(next_s, _LOOK_AGAIN_S)
        if first is not None:
            unread = None
        if unread is not None:
            self._given_to_read.add(_print(scans[unread.name]))
        return Listing(first, unread, len(settled), new, next_s)

    def _weigh(
        self, name: str, status: os.stat_result, there: Mapping[str, os.stat_result], known: Glimpse | None
    ) -> tuple[Arrival, str, float]:
        """Return the arrival, what it still waits for ('' if nothing) and for how long [s]."""
        log_name = self._log_name(name)
        log_print = self._log_print(name, there)
        print_ = _print(status) + log_print
        now_s = self._monotonic_s()
        sight = self._sights.get(name)
        if sight is None or sight.print != print_:
            sight = self._sights[name] = _Sight(print_, now_s)
        log_path = self._folder / log_name if log_name and log_print else None
        arrival = Arrival(name, self._folder / name, log_path, status.st_size, status.st_mtime_ns)
        still_s = now_s - sight.since_s
        if still_s < self._settle_s:
            return arrival, f"size and time to stand still for {self._settle_s:g} s", self._settle_s - still_s
        if self._inclination and self._inclination.required and log_path is None:
            left_s = self._inclination.wait_s - still_s
            if left_s > 0:
                return arrival, f"{WAITS_FOR_LOG} {log_name}", left_s
        pause_s = self._pause_s(status, known)
        return arrival, "its next try" if pause_s else "", pause_s or math.inf

    def _log_print(self, name: str, there: Mapping[str, os.stat_result]) -> tuple[int, ...]:
        """Return the print of a scan's log; none for a link or one that is still empty."""
        status = there.get(self._log_name(name) or "")
        usable = status is not None and stat.S_ISREG(status.st_mode) and status.st_size
        return _print(status) if status is not None and usable else ()

    def _log_name(self, name: str) -> str | None:
        return f"{Path(name).stem}{self._inclination.suffix}" if self._inclination else None

    def _pause_s(self, status: os.stat_result, known: Glimpse | None) -> float:
        """Return how long a scan that was not ready still has to wait [s]."""
        if known is None or known.next_try_utc_s is None or not _is_same(known, status):
            return 0.0
        left_s = known.next_try_utc_s - self._now_s()
        return left_s if 0 < left_s <= LONGEST_PAUSE_S else 0.0  # more: the clock was set back

    def _refuse(self, name: str, status: os.stat_result, why: str) -> None:
        shown = quoted(name)
        self._journal.seen([(shown, status.st_size, status.st_mtime_ns, "")])
        self._journal.set_aside(shown, why)
        log.warning(logfmt(scan=shown, verdict="set_aside", reason=why))

    def _forget(self, known: Mapping[str, Glimpse], scans: Iterable[str]) -> None:
        """Drop what left the inbox before it was done."""
        undone = {name for name, row in known.items() if row.state in {State.WAITING, State.LATER}}
        gone = sorted(undone - set(scans))
        if gone:
            self._journal.gone(gone)
            for name in gone:
                log.warning(logfmt(scan=name, verdict="gone", reason="left the inbox before it was done"))
        for name in self._sights.keys() - set(scans):
            del self._sights[name]


def list_folder(folder: Path) -> dict[str, os.stat_result]:
    """Return what lies in a folder, links not followed; raise NotReadyError where it cannot be listed."""
    there = {}
    try:
        with os.scandir(folder) as entries:
            for entry in entries:
                try:
                    there[entry.name] = entry.stat(follow_symlinks=False)
                except FileNotFoundError:
                    continue  # it went between the listing and the look
    except OSError as error:
        raise NotReadyError(f"the inbox {folder} cannot be listed: {error.strerror}") from error
    return there


def is_scan(name: str, suffixes: tuple[str, ...]) -> bool:
    """Tell whether a file name is that of a scan; hidden ones are transfers under way."""
    return name.lower().endswith(suffixes) and not name.startswith(".")


def quoted(name: str) -> str:
    """Return a file name as the journal and a log line can hold it; a plain one as it is."""
    if _PLAIN_NAME.fullmatch(name):
        return name
    shown = name.encode("unicode_escape").decode("ascii").replace("/", "")
    if len(shown) <= 100:
        return shown
    return f"{shown[:90]}~{hashlib.sha256(os.fsencode(name)).hexdigest()[:9]}"


def _refusal(name: str, status: os.stat_result) -> str | None:
    """Say why a file cannot be a scan, whatever is in it."""
    if not stat.S_ISREG(status.st_mode):
        kind = _KINDS.get(stat.S_IFMT(status.st_mode), "something else")
        return f"is {kind}: only regular files are read; put the scan itself there"
    if not _PLAIN_NAME.fullmatch(name):
        return "the name has spaces, control or other odd characters, or is too long: rename it"
    return None


def _is_same(known: Glimpse, status: os.stat_result) -> bool:
    return (known.size, known.mtime_ns) == (status.st_size, status.st_mtime_ns)


def _is_done(known: Glimpse | None, status: os.stat_result) -> bool:
    return known is not None and known.state in {State.STORED, State.SET_ASIDE} and _is_same(known, status)


def _print(status: os.stat_result) -> tuple[int, ...]:
    return status.st_ino, status.st_size, status.st_mtime_ns


def _start(name: str, pattern: str) -> datetime:
    """Return the start of the scan by its name; those that do not say it come last."""
    try:
        return datetime.strptime(Path(name).stem, pattern).replace(tzinfo=UTC)
    except ValueError:
        return datetime.max.replace(tzinfo=UTC)


def _is_written(arrival: Arrival) -> bool:
    """Tell whether someone has the scan or its log open for writing, as far as the kernel tells us.

    A read lease is granted only where nobody has. It is for owners and local disks: elsewhere the settled
    size has to do.
    """
    for path in filter(None, (arrival.path, arrival.log)):
        try:
            opened = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
        except OSError:
            continue  # the worker says what is wrong with it
        try:
            # A writer that comes while we hold the lease makes a signal: by default one that ends us.
            fcntl.fcntl(opened, fcntl.F_SETSIG, signal.SIGURG)
            fcntl.fcntl(opened, fcntl.F_SETLEASE, fcntl.F_RDLCK)
            fcntl.fcntl(opened, fcntl.F_SETLEASE, fcntl.F_UNLCK)
        except OSError as error:
            if error.errno == errno.EAGAIN:
                return True
        finally:
            os.close(opened)
    return False
