"""Sends alarms: when one begins, at intervals while it lasts, and when it is over.

Runs as a process of its own, every few minutes (`station-alarms@.timer`), so that a dead mail server never
delays a scan and a dead service is noticed. `alarms.json` records what was sent.
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
from station.logs import log_to_stderr, logfmt
from station.monitoring.alarm_rules import evaluate_rules
from station.monitoring.alarm_state import FILE_NAME, AlarmState, due_messages, load, save
from station.monitoring.area_curves import newest_epoch_s
from station.monitoring.daily_digest import newest_digest
from station.monitoring.notifiers import send

log = logging.getLogger("station")

MAX_UNSENT = 50  # newest messages stored for a target that cannot be reached


def evaluate(
    site: Site, *, report: Callable[[str], None] = lambda _: None, now_s: Callable[[], float] = time.time
) -> int:
    """Evaluate all rules and send new, repeated and cleared alarms; return 1 if a target failed, else 0.

    Undelivered messages are sent at the next run. Raises ConfigError without `[alarms]`; StoreError if the
    state cannot be written. That happens after sending: an alarm is rather sent twice than never.
    """
    if site.alarms is None:
        raise ConfigError(f"{site.path}: has no [alarms]: nothing to check")
    log_to_stderr()
    with _single_instance(site.station.data) as is_single_instance:
        if not is_single_instance:
            return 0
        path = site.station.data / FILE_NAME
        evaluated_utc_s = now_s()
        state = load(path) or AlarmState(since_utc_s=evaluated_utc_s)
        newest_s = newest_epoch_s(site)
        alarms = evaluate_rules(
            site,
            since_utc_s=state.since_utc_s,
            assessed_until_utc_s=state.assessed_until_utc_s,
            now_s=evaluated_utc_s,
        )
        lines = due_messages(state, alarms, evaluated_utc_s, site.alarms.repeat_h * 3600)
        state.assessed_until_utc_s = newest_s if newest_s is not None else state.assessed_until_utc_s
        for line in lines:
            report(line)
            for target in site.alarms.targets:
                state.unsent[target] = [*state.unsent.get(target, []), line][-MAX_UNSENT:]
        failed = _send_all(site, state)
        save(path, state)
        return 1 if failed else 0


def test(site: Site, report: Callable[[str], None]) -> int:
    """Send a test message to every target and report each delivery; return 1 if one failed, else 0."""
    if site.alarms is None:
        raise ConfigError(f"{site.path}: has no [alarms]: nothing to test")
    all_targets = (*site.alarms.targets, *([site.alarms.digest] if site.alarms.digest else []))
    targets = tuple(dict.fromkeys(all_targets))
    if not targets:
        raise ConfigError(f"{site.path}: alarms.targets is empty")
    log_to_stderr()
    text = f"{site.station.name or site.station.id}: test message; alarms will arrive this way."
    failed = send(dict.fromkeys(targets, (_title(site, "test"), text)))
    for target in targets:
        report(f"{target}: {failed.get(target, 'delivered')}")
    return 1 if failed else 0


def _send_all(site: Site, state: AlarmState) -> dict[str, str]:
    """Send each target its unsent lines in one message, and the digest; return failures by target."""
    targets = site.alarms.targets if site.alarms else ()
    state.unsent = {target: lines for target, lines in state.unsent.items() if target in targets}
    failed = {}
    if state.unsent:
        messages = {
            target: (_title(site, _subject(lines)), "\n".join(lines))
            for target, lines in state.unsent.items()
        }
        failed = send(messages)
        state.unsent = {target: lines for target, lines in state.unsent.items() if target in failed}
    target = site.alarms.digest if site.alarms else None
    path = newest_digest(site.station.data)
    if target and path is not None and path.name > state.sent_digest:
        undelivered = send({target: (_title(site, f"digest {path.stem}"), path.read_text(encoding="utf-8"))})
        state.sent_digest = state.sent_digest if undelivered else path.name
        failed |= undelivered
    return failed


def _subject(lines: list[str]) -> str:
    words = [line.partition(":")[0] for line in lines]
    return ", ".join(f"{words.count(word)} {word}" for word in dict.fromkeys(words))


def _title(site: Site, subject: str) -> str:
    return f"[station {site.station.id}] {subject}"


@contextmanager
def _single_instance(data: Path) -> Iterator[bool]:
    """Lock the alarms of this station; yield False if another process has locked them."""
    try:
        data.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(data / "alarms.lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o640)
    except OSError as error:
        raise StoreError(f"{data}: the data folder cannot be written: {error.strerror}") from error
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            log.warning(logfmt(alarms="busy", reason="another process is checking alarms"))
            yield False
        else:
            yield True
    finally:
        os.close(descriptor)
