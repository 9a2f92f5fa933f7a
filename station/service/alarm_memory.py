"""What was told of which alarm: a small file in the data folder, so that a restart repeats nothing."""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path

from station.errors import StoreError

FILE = "alarms.json"
CALM_S = 3600.0  # without it before an alarm is over: one on the edge is not told each time
ROOM_BYTES = 65536  # of the file, filled with blanks, so that it can be changed on a full disk


@dataclass(frozen=True)
class Alarm:
    """Something to tell. The same `key` is the same alarm, whatever it says."""

    key: str
    text: str
    size: float = 0.0  # told anew before its time when it has doubled
    patience_s: float = 0.0  # how long it must last before it is told


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


def firing(data: Path) -> dict[str, str]:
    """Return what is told and lasts, by its key; {} where nobody looks after alarms."""
    memory = recall(data / FILE)
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


def remember(path: Path, memory: Memory) -> None:
    """Write what is remembered, as far as there is any way; raise StoreError where there is none."""
    from station.archive.layout import written_whole  # noqa: PLC0415 - half a second for those who only read

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


def _utc(moment_s: float) -> str:
    return f"{datetime.fromtimestamp(moment_s, UTC):%Y-%m-%d %H:%M} UTC"
