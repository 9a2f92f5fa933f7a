"""Tells people: once when an alarm begins, again every so long while it lasts, and when it is over.

Runs as a process of its own, every few minutes (`station-alarms@.timer`), so that a dead mail server is never
in the way of a scan and a dead service is noticed. What it told is remembered in `alarms.json`.
"""

from __future__ import annotations

import fcntl
import logging
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from station.config import Site
from station.errors import ConfigError, StoreError
from station.service.alarm_memory import FILE, Memory, news, recall, remember
from station.service.alarm_rules import alarms_of
from station.service.area_series import newest_epoch_s
from station.service.digest import newest_digest
from station.service.logs import log_to_stderr, logfmt
from station.service.targets import send

log = logging.getLogger("station")

KEPT = 50  # messages for a target that cannot be reached; the newest


def look(
    site: Site, *, tell: Callable[[str], None] = lambda _: None, now_s: Callable[[], float] = time.time
) -> int:
    """Ask all rules, tell what is new, still so or over; return the exit status: 1 if a target failed.

    What a target could not be told stays for the next time. Raises ConfigError without `[alarms]`, StoreError
    where the memory cannot be written: after telling, rather twice than never.
    """
    if site.alarms is None:
        raise ConfigError(f"{site.path}: has no [alarms]: nothing to look for")
    log_to_stderr()
    with _alone(site.station.data) as is_alone:
        if not is_alone:
            return 0
        path = site.station.data / FILE
        moment_s = now_s()
        memory = recall(path) or Memory(since_utc_s=moment_s)
        newest_s = newest_epoch_s(site)
        found = alarms_of(
            site, since_utc_s=memory.since_utc_s, judged_utc_s=memory.judged_utc_s, now_s=moment_s
        )
        lines = news(memory, found, moment_s, site.alarms.repeat_h * 3600)
        memory.judged_utc_s = newest_s if newest_s is not None else memory.judged_utc_s
        for line in lines:
            tell(line)
            for target in site.alarms.targets:
                memory.unsent[target] = [*memory.unsent.get(target, []), line][-KEPT:]
        failed = _send_all(site, memory)
        remember(path, memory)
        return 1 if failed else 0


def test(site: Site, tell: Callable[[str], None]) -> int:
    """Send a test message by every target and tell how each did; return the exit status: 1 if one failed."""
    if site.alarms is None:
        raise ConfigError(f"{site.path}: has no [alarms]: nothing to try")
    named = (*site.alarms.targets, *([site.alarms.digest] if site.alarms.digest else []))
    names = tuple(dict.fromkeys(named))
    if not names:
        raise ConfigError(f"{site.path}: alarms.targets names none")
    log_to_stderr()
    text = f"{site.station.name or site.station.id}: a test; alarms would come this way."
    failed = send(dict.fromkeys(names, (_title(site, "test"), text)))
    for name in names:
        tell(f"{name}: {failed.get(name, 'delivered')}")
    return 1 if failed else 0


def _send_all(site: Site, memory: Memory) -> dict[str, str]:
    """Send each target all it was not told yet, in one message, and the digest; return who failed and why."""
    known = site.alarms.targets if site.alarms else ()
    memory.unsent = {target: lines for target, lines in memory.unsent.items() if target in known}
    failed = {}
    if memory.unsent:
        told = {
            target: (_title(site, _head(lines)), "\n".join(lines)) for target, lines in memory.unsent.items()
        }
        failed = send(told)
        memory.unsent = {target: lines for target, lines in memory.unsent.items() if target in failed}
    target = site.alarms.digest if site.alarms else None
    path = newest_digest(site.station.data)
    if target and path is not None and path.name > memory.digest:
        lost = send({target: (_title(site, f"digest {path.stem}"), path.read_text(encoding="utf-8"))})
        memory.digest = memory.digest if lost else path.name
        failed |= lost
    return failed


def _head(lines: list[str]) -> str:
    words = [line.partition(":")[0] for line in lines]
    return ", ".join(f"{words.count(word)} {word}" for word in dict.fromkeys(words))


def _title(site: Site, what: str) -> str:
    return f"[station {site.station.id}] {what}"


@contextmanager
def _alone(data: Path) -> Iterator[bool]:
    """Tell whether no other process looks after the alarms of this station, and keep others out."""
    try:
        data.mkdir(parents=True, exist_ok=True)
        held = os.open(data / "alarms.lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o640)
    except OSError as error:
        raise StoreError(f"{data}: the data folder cannot be written: {error.strerror}") from error
    try:
        try:
            fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            log.warning(logfmt(alarms="busy", reason="another process is at it"))
            yield False
        else:
            yield True
    finally:
        os.close(held)
