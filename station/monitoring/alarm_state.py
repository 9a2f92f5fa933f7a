"""State of the alarms: a small file in the data folder, so that a restart repeats no message."""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path

from station.errors import StoreError

FILE_NAME = "alarms.json"
CLEAR_AFTER_S = 3600.0  # an alarm must be absent for this long: one at its threshold is not sent each time
MAX_LOG = 20  # newest messages that the page lists
FILE_BYTES = 65536  # size of the file, padded with blanks, so that it can be rewritten on a full disk


@dataclass(frozen=True)
class Alarm:
    """A condition to report. Alarms of the same `key` are the same alarm, whatever their text."""

    key: str
    text: str
    size: float = 0.0  # sent again early if it has doubled
    min_duration_s: float = 0.0  # how long it must last before it is sent


@dataclass
class ActiveAlarm:
    """An alarm that has begun and has not cleared."""

    text: str
    size: float
    since_utc_s: float
    last_active_utc_s: float
    notified_utc_s: float | None = None
    notified_size: float = 0.0


@dataclass
class AlarmState:
    """State kept between two evaluations."""

    since_utc_s: float
    assessed_until_utc_s: float | None = None
    sent_digest: str = ""  # name of the last digest sent
    active: dict[str, ActiveAlarm] = field(default_factory=dict)
    unsent: dict[str, list[str]] = field(default_factory=dict)
    log: list[tuple[float, str]] = field(
        default_factory=list
    )  # newest messages and their times, for the page


def active(data: Path) -> dict[str, str]:
    """Return the text of each active alarm that was sent, by key; {} without a state file."""
    state = load(data / FILE_NAME)
    alarms = state.active if state else {}
    return {key: alarm.text for key, alarm in alarms.items() if alarm.notified_utc_s is not None}


def active_since(data: Path) -> dict[str, float]:
    """Return since when each active alarm that was sent lasts [s since 1970], by its text."""
    state = load(data / FILE_NAME)
    alarms = state.active.values() if state else ()
    return {alarm.text: alarm.since_utc_s for alarm in alarms if alarm.notified_utc_s is not None}


def recent_messages(data: Path) -> list[tuple[float, str]]:
    """Return time [s since 1970] and text of the newest messages, the oldest first."""
    state = load(data / FILE_NAME)
    return state.log if state else []


def due_messages(state: AlarmState, alarms: list[Alarm], now_s: float, repeat_s: float) -> list[str]:
    """Return the messages due now, one line each, and record them in `state` as sent."""
    lines = []
    for alarm in alarms:
        tracked = state.active.setdefault(alarm.key, ActiveAlarm(alarm.text, alarm.size, now_s, now_s))
        tracked.text, tracked.size, tracked.last_active_utc_s = alarm.text, alarm.size, now_s
        if tracked.notified_utc_s is None:
            kind = "alarm" if now_s - tracked.since_utc_s >= alarm.min_duration_s else ""
        elif tracked.size >= 2 * tracked.notified_size > 0:
            kind = "more"
        else:
            kind = "still" if now_s - tracked.notified_utc_s >= repeat_s else ""
        if kind:
            tracked.notified_utc_s, tracked.notified_size = now_s, tracked.size
            since = f" (since {_format_utc(tracked.since_utc_s)})" if kind != "alarm" else ""
            lines.append(f"{kind}: {alarm.text}{since}")
    for key in [
        key for key, tracked in state.active.items() if now_s - tracked.last_active_utc_s >= CLEAR_AFTER_S
    ]:
        cleared = state.active.pop(key)
        if cleared.notified_utc_s is not None:
            lines.append(f"over: {cleared.text} (since {_format_utc(cleared.since_utc_s)})")
    state.log = [*state.log, *((now_s, line) for line in lines)][-MAX_LOG:]
    return lines


def load(path: Path) -> AlarmState | None:
    """Return the stored state; None if there is none that can be read."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        alarms = {key: ActiveAlarm(**alarm) for key, alarm in content.pop("active").items()}
        messages = [(float(time_s), str(text)) for time_s, text in content.pop("log", [])]
        return AlarmState(**content, active=alarms, log=messages)
    except (OSError, ValueError, TypeError, KeyError, AttributeError):
        return None


def save(path: Path, state: AlarmState) -> None:
    """Write the state, in place if the disk is full; raise StoreError if neither works."""
    from station.archive.atomic_files import atomic_write  # noqa: PLC0415 - half a second, for writers only

    content = json.dumps(asdict(state), ensure_ascii=False, indent=1).encode().ljust(FILE_BYTES)
    try:
        with atomic_write(path) as tmp_path:
            tmp_path.write_bytes(content)
    except StoreError:
        try:  # on a full disk, in place: the alarm about it must not be repeated at every run
            with path.open("r+b") as file:
                file.write(content)
                file.truncate()
                os.fsync(file.fileno())
        except OSError:
            pass
        else:
            return
        raise


def _format_utc(utc_s: float) -> str:
    return f"{datetime.fromtimestamp(utc_s, UTC):%Y-%m-%d %H:%M} UTC"
