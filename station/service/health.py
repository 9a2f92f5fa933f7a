"""How the service is: what it tells systemd, what it needs of disk and clock, what `station status` shows."""

from __future__ import annotations

import math
import os
import shutil
import socket
import time
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from station.errors import NotReadyError, StationError, StoreError
from station.readers.scan import suffixes
from station.service.alarm_memory import firing
from station.service.inbox import is_scan, list_folder, quoted
from station.service.journal import Entry, Journal, State
from station.service.lock import in_use

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from station.config import Site

Status = dict[str, Any]  # what it holds is what `station status --json` prints

EARLIEST_S = datetime(2020, 1, 1, tzinfo=UTC).timestamp()
FAR_S = 86_400.0  # a clock this much behind our own newest file is likely wrong
_SPARE_BYTES = 16_000_000  # for the journal, the series and file system overhead
_EPOCH_BYTES_PER_CELL = 40  # uncompressed, with all its terms; `station check` tells the usual size
_PING_EVERY_S = 1.0
_LONGER_S = 120.0  # what a slow start asks systemd for, again and again while it makes progress


def notify(message: str) -> None:
    """Tell systemd, if it wants to be told. Source: sd_notify(3)."""
    address = os.environ.get("NOTIFY_SOCKET")
    if not address:
        return
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as sender:
        sender.settimeout(5.0)  # a systemd that does not listen must not stop the service
        try:
            sender.connect(f"\0{address[1:]}" if address.startswith("@") else address)
            sender.sendall(message.encode("utf-8"))
        except OSError:
            return


class Heart:
    """Beats when there is progress, never by itself: a stalled loop falls silent, systemd starts it anew."""

    def __init__(self, monotonic_s: Callable[[], float] = time.monotonic) -> None:
        self._monotonic_s = monotonic_s
        self._is_ready = False
        self._text = ""
        self._pinged_s = -math.inf
        meant_for_us = os.environ.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        watchdog_s = int(os.environ.get("WATCHDOG_USEC", "0")) / 1e6 if meant_for_us else 0.0
        self.longest_wait_s = watchdog_s / 3 if watchdog_s else 60.0  # between two pings of an idle loop

    def ping(self) -> None:
        """Say that there is progress; cheap enough for an inner loop."""
        now_s = self._monotonic_s()
        if now_s - self._pinged_s < min(_PING_EVERY_S, self.longest_wait_s):
            return
        self._pinged_s = now_s
        notify("WATCHDOG=1" if self._is_ready else f"EXTEND_TIMEOUT_USEC={_LONGER_S * 1e6:.0f}")

    def ready(self) -> None:
        """Say that the service is up, or that a reload is over."""
        if not self._is_ready:
            self._is_ready = True
            notify("READY=1")

    def reloading(self) -> None:
        """Say that a reload has begun; `ready()` ends it."""
        self._is_ready = False
        notify(f"RELOADING=1\nMONOTONIC_USEC={time.clock_gettime_ns(time.CLOCK_MONOTONIC) // 1000}")

    def stopping(self) -> None:
        """Say that the service is about to end."""
        notify("STOPPING=1")

    def status(self, text: str) -> None:
        """Say in one line what the service does."""
        if text != self._text:
            self._text = text
            notify(f"STATUS={text.replace(chr(10), ' ')}")


def need_room(site: Site) -> None:
    """Raise StoreError where the disk has no room for another epoch, or no inode."""
    folder = site.station.data
    cells = site.grid.shape[0] * site.grid.shape[1]
    need = _SPARE_BYTES + _EPOCH_BYTES_PER_CELL * cells
    try:
        disk = os.statvfs(folder)
    except OSError as error:
        raise StoreError(f"{folder}: the data folder cannot be reached: {error.strerror}") from error
    free = disk.f_bavail * disk.f_frsize
    if free < need:
        raise StoreError(
            f"{folder}: {free / 1e6:.0f} MB free, {need / 1e6:.0f} MB needed: make room, it goes on by itself"
        )
    if disk.f_files and disk.f_favail < 16:
        raise StoreError(f"{folder}: no inodes left: delete files, it goes on by itself")


def clock_fault(data: Path, now_s: float) -> str | None:
    """Say why the clock is likely wrong: before 2020, or a day before our own newest file."""
    told = _utc(now_s)
    if now_s < EARLIEST_S:
        return f"the clock says {told}: set it"
    newest_s = max((_written_s(data / name) for name in _OUR_FILES), default=0.0)
    if now_s < newest_s - FAR_S:
        return f"the clock says {told}, but the data folder was written at {_utc(newest_s)}: set it"
    return None


_OUR_FILES = ("journal.sqlite", "journal.sqlite-wal", "series.nc")


def _written_s(path: Path) -> float:
    try:
        return path.stat().st_mtime
    except OSError:
        return 0.0


def status(site: Site) -> Status:
    """Return what was done, what waits and why, what was set aside and why, how good the last scan was.

    Reads the journal beside a running service or without one; raises StoreError where it cannot be read.
    """
    data = site.station.data
    with Journal(data / "journal.sqlite", read_only=True) as journal:
        queue = _queue(site, journal)
        counts = journal.counts()
        last = journal.last_stored()
    return {
        "station": site.station.id,
        "name": site.station.name,
        "service": "running" if in_use(data) else "not running",
        "counts": counts,
        "waiting": queue["waiting"],
        "set_aside": queue["set_aside"],
        "last": _last(last) if last else None,
        "moved": _moved(site),
        "alarms": firing(data),
        "stale": _stale(site),
        "series": str(data / "series.nc") if (data / "series.nc").exists() else None,
        "disk_free_gb": round(shutil.disk_usage(data).free / 1e9, 2) if data.is_dir() else None,
        "faults": [*queue["faults"], *filter(None, [_late_log(site)])],
    }


def queue(site: Site) -> Status:
    """Return of `status` what waits, what was set aside and what is wrong: all that needs no series."""
    with Journal(site.station.data / "journal.sqlite", read_only=True) as journal:
        return _queue(site, journal)


def _queue(site: Site, journal: Journal) -> Status:
    waiting = [_waits(entry) for entry in journal.waiting()]
    set_aside = [
        {"scan": entry.name, "reason": entry.reason, "since": _utc(entry.changed_utc_s)}
        for entry in journal.rows(State.SET_ASIDE)
    ]
    inbox_fault = ""
    try:
        names = {quoted(name) for name in list_folder(site.scans.inbox) if is_scan(name, suffixes())}
    except NotReadyError as error:
        names, inbox_fault = set(), str(error)
    running = in_use(site.station.data)
    unseen = "the service to look at it" if running else "the service, which is not running"
    waiting += [
        {"scan": name, "state": "new", "for": unseen, "next_try": None} for name in journal.unseen(names)
    ]
    faults = (inbox_fault, _room_fault(site), clock_fault(site.station.data, time.time()))
    return {"waiting": waiting, "set_aside": set_aside, "faults": [fault for fault in faults if fault]}


def describe(found: Status) -> str:
    """Return a status as lines for a person."""
    counts, waits = found["counts"], len(found["waiting"])
    lines = [
        f"{found['name'] or found['station']}: service {found['service']}",
        f"scans    {counts['stored']} stored, {len(found['set_aside'])} set aside, {waits} waiting",
    ]
    if last := found["last"]:
        words = " ".join(f"{key}={value}" for key, value in last["figures"].items() if value is not None)
        reason = f" ({last['reason']})" if last["reason"] else ""
        lines.append(f"last     {last['scan']} of {last['start']}: {last['verdict']}{reason} {words}")
    if stale := found["stale"]:
        lines.append(
            f"stale    {stale} epochs made with another SOP, setting, flag or reference: station reprocess"
        )
    free = found["disk_free_gb"]
    lines.append(f"disk     {f'{free:.2f} GB free' if free is not None else 'no data folder yet'}")
    lines.append(f"series   {found['series'] or 'none yet'}")
    lines += [f"moved    {found['moved']}"] if found["moved"] else []
    lines += [f"alarm    {text}" for text in found["alarms"].values()]
    lines += [f"fault    {fault}" for fault in found["faults"]]
    for one in found["waiting"]:
        then = f", next try {one['next_try']}" if one["next_try"] else ""
        lines.append(f"waits    {one['scan']}: {one['for'] or 'its turn'}{then}")
    lines += [f"aside    {one['scan']}: {one['reason']}" for one in found["set_aside"]]
    return "\n".join(lines)


def _waits(entry: Entry) -> dict[str, str | None]:
    then = _utc(entry.next_try_utc_s) if entry.next_try_utc_s is not None else None
    return {
        "scan": entry.name,
        "state": entry.state.value,
        "for": entry.waits_for or "its turn",
        "next_try": then,
    }


def _last(entry: Entry) -> Status:
    figures = {
        key: None if isinstance(value, float) and not math.isfinite(value) else value  # JSON knows no NaN
        for key, value in entry.figures.items()
    }
    return {
        "scan": entry.name,
        "start": _utc(entry.start_utc_s) if entry.start_utc_s is not None else None,
        "stored": _utc(entry.changed_utc_s),
        "verdict": entry.verdict,
        "reason": entry.reason,
        "epoch": entry.epoch,
        "reference": entry.reference,
        "figures": figures,
    }


def _moved(site: Site) -> str:
    from station.service.moved import moved  # noqa: PLC0415 - a status without series needs none of it

    try:
        return moved(site) if (site.station.data / "series.nc").is_file() else ""
    except StoreError as error:
        return str(error)


def _late_log(site: Site) -> str:
    from station.service.late_log import late_log  # noqa: PLC0415 - as above

    try:
        return late_log(site) if site.adjusts and (site.station.data / "series.nc").is_file() else ""
    except StoreError as error:
        return str(error)


def _stale(site: Site) -> int | None:
    """Return how many epochs today's settings would make otherwise; None where that cannot be told now."""
    if not (site.station.data / "series.nc").is_file():
        return 0
    from station.service.stale import count_by_settings  # noqa: PLC0415 - a second of imports

    try:
        return count_by_settings(site)
    except StationError:
        return None


def _room_fault(site: Site) -> str:
    try:
        need_room(site)
    except StoreError as error:
        return str(error)
    return ""


def _utc(moment_s: float) -> str:
    return f"{datetime.fromtimestamp(moment_s, UTC):%Y-%m-%dT%H:%M:%SZ}"
