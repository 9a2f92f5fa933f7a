"""Tells people: once when an alarm begins, again every so long while it lasts, and when it is over.

Runs as a process of its own, every few minutes (`station-alarms@.timer`), so that a dead mail server is never
in the way of a scan and a dead service is noticed. What it told is remembered in `alarms.json`.
"""

from __future__ import annotations

import fcntl
import json
import logging
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path

from station.archive.layout import written_whole
from station.config import Site
from station.errors import ConfigError, StoreError
from station.service.alarm_rules import Alarm, alarms_of
from station.service.area_series import newest_epoch_s
from station.service.digest import newest_digest
from station.service.logs import log_to_stderr, logfmt
from station.service.targets import send

log = logging.getLogger("station")

CALM_S = 3600.0  # without it before an alarm is over: one on the edge is not told each time
KEPT = 50  # messages for a target that cannot be reached; the newest
ROOM_BYTES = 65536  # of the file, filled with blanks, so that it can be changed on a full disk


@dataclass
class Lasting:
    """An alarm that has begun and is not over."""

    text: str
    size: float
    since_utc_s: float
    seen_utc_s: float
    told_utc_s: float | None = None
    told_size: float = 0.0


@dataclass
class Memory:
    """What is remembered from one time to the next."""

    since_utc_s: float
    judged_utc_s: float | None = None
    digest: str = ""  # the last one sent
    lasting: dict[str, Lasting] = field(default_factory=dict)
    unsent: dict[str, list[str]] = field(default_factory=dict)


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
        path = site.station.data / "alarms.json"
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
        _remember(path, memory)
        return 1 if failed else 0


def test(site: Site, tell: Callable[[str], None]) -> int:
    """Send a test message by every target and tell how each did; return the exit status: 1 if one failed."""
    if site.alarms is None:
        raise ConfigError(f"{site.path}: has no [alarms]: nothing to try")
    named = (*site.alarms.targets, *([site.alarms.digest] if site.alarms.digest else []))
    names = tuple(dict.fromkeys(named))
    if not names:
        raise ConfigError(f"{site.path}: alarms.targets names none")
    text = f"{site.station.name or site.station.id}: a test; alarms would come this way."
    failed = send(dict.fromkeys(names, (_title(site, "test"), text)))
    for name in names:
        tell(f"{name}: {failed.get(name, 'delivered')}")
    return 1 if failed else 0


def firing(data: Path) -> dict[str, str]:
    """Return what is told and lasts, by its key; {} where nobody looks after alarms."""
    memory = recall(data / "alarms.json")
    lasting = memory.lasting if memory else {}
    return {key: alarm.text for key, alarm in lasting.items() if alarm.told_utc_s is not None}


def news(memory: Memory, found: list[Alarm], now_s: float, repeat_s: float) -> list[str]:
    """Return what is to be told now, one line each, and remember it as told."""
    lines = []
    for alarm in found:
        kept = memory.lasting.setdefault(alarm.key, Lasting(alarm.text, alarm.size, now_s, now_s))
        kept.text, kept.size, kept.seen_utc_s = alarm.text, alarm.size, now_s
        if kept.told_utc_s is None:
            word = "alarm" if now_s - kept.since_utc_s >= alarm.patience_s else ""
        elif kept.size >= 2 * kept.told_size > 0:
            word = "more"
        else:
            word = "still" if now_s - kept.told_utc_s >= repeat_s else ""
        if word:
            kept.told_utc_s, kept.told_size = now_s, kept.size
            since = f" (since {_utc(kept.since_utc_s)})" if word != "alarm" else ""
            lines.append(f"{word}: {alarm.text}{since}")
    for key in [key for key, kept in memory.lasting.items() if now_s - kept.seen_utc_s >= CALM_S]:
        over = memory.lasting.pop(key)
        if over.told_utc_s is not None:
            lines.append(f"over: {over.text} (since {_utc(over.since_utc_s)})")
    return lines


def recall(path: Path) -> Memory | None:
    """Read what is remembered; None where there is nothing that can be read."""
    try:
        kept = json.loads(path.read_text(encoding="utf-8"))
        lasting = {key: Lasting(**alarm) for key, alarm in kept.pop("lasting").items()}
        return Memory(**kept, lasting=lasting)
    except (OSError, ValueError, TypeError, KeyError, AttributeError):
        return None


def _remember(path: Path, memory: Memory) -> None:
    text = json.dumps(asdict(memory), ensure_ascii=False, indent=1).encode().ljust(ROOM_BYTES)
    try:
        with written_whole(path) as beside:
            beside.write_bytes(text)
    except StoreError:
        try:  # on a full disk in its own place: the very alarm that tells of it must not come every time
            with path.open("r+b") as file:
                file.write(text)
                file.truncate()
                os.fsync(file.fileno())
        except OSError:
            pass
        else:
            return
        raise


def _send_all(site: Site, memory: Memory) -> dict[str, str]:
    """Send each target all it was not told yet, in one message, and the digest; return who failed and why."""
    memory.unsent = {target: lines for target, lines in memory.unsent.items() if lines}
    failed = {}
    if memory.unsent:
        told = {target: (_title(site, _head(lines)), "\n".join(lines)) for target, lines in memory.unsent.items()}
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


def _utc(moment_s: float) -> str:
    return f"{datetime.fromtimestamp(moment_s, UTC):%Y-%m-%d %H:%M} UTC"


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
