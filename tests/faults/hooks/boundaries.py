"""Count the changes a service makes on disk, and kill it, or report a full disk, at a chosen one.

Loaded into every process of the service under test: by `sitecustomize` if the service is started by its
command, by `warm.py` if it is forked. `FAULTS_PLAN` (JSON) has the keys:

    steps     file to which each boundary crossed by any process appends a record of 96 bytes
    kills     [[step, delay_s, victim], ...]: kills, delayed, at that step or the first after it
    once      victim at every boundary that has no file in the folder `died` yet; "full": no process dies,
              but the disk is full
    died      folder with an empty file for each boundary at which that has happened
    draw      [share, seed]: `once` at one in `share` boundaries only, drawn by the seed

`victim`: "child" (the worker process), "service" (its worker must then end without help), or "both". There is
a boundary before and one after each fsync, rename, link, mkdir, unlink and commit.
"""

from __future__ import annotations

import errno
import faulthandler
import functools
import json
import multiprocessing
import os
import re
import signal
import sqlite3
import threading
import time
import zlib
from contextlib import suppress
from pathlib import Path

RECORD = 96
_state = {"plan": None, "service": 0, "pending": set()}
_append = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC


def install():
    """Wrap the calls that make changes durable, in this process and those forked from it.

    At SIGUSR1 each of them writes the stacks of its threads to stderr.
    """
    faulthandler.register(signal.SIGUSR1)
    _state["plan"] = json.loads(os.environ["FAULTS_PLAN"])
    _state["service"] = int(os.environ.setdefault("FAULTS_SERVICE", str(os.getpid())))
    for name in ("fsync", "replace", "rename", "link", "unlink", "mkdir"):
        setattr(os, name, _watched(name, getattr(os, name)))
    sqlite3.connect = functools.partial(sqlite3.connect, factory=_Connection)


def set_clock(offset_path):
    """Offset the wall clock of the service by the content of a file [s]."""
    from station.clock import Clock

    true_s = time.time

    def now_s():
        return true_s() + float(Path(offset_path).read_text(encoding="ascii"))

    time.time = now_s
    Clock.__init__.__defaults__ = (now_s, time.monotonic, time.sleep)
    assert Clock().now_s is now_s


def shorten_delays(period_s=5.0):
    """Shorten the delays of the service from minutes to fractions of a second."""
    from station.inbox import journal
    from station.processing.workers import isolation
    from station.service import daemon

    journal.FIRST_RETRY_S = journal.MAX_RETRY_S = 0.1
    isolation.RETRY_DELAYS_S = (0.01,) * 100
    daemon.LoopTiming.__init__.__defaults__ = (period_s, 0.02, 5.0, 0.05, 300.0, 3600.0)


def _watched(name, call):
    @functools.wraps(call)
    def watched(target, *args, **kwargs):
        label = _label(args[0] if name in {"replace", "rename", "link"} else target)
        if label is None:
            return call(target, *args, **kwargs)
        _cross(f"before {name} {label}")
        result = call(target, *args, **kwargs)
        _cross(f"after {name} {label}")
        return result

    return watched


class _Connection(sqlite3.Connection):
    """A connection whose commits are boundaries, labelled by their last statement."""

    _last = ""

    def execute(self, statement, values=()):
        if statement != "COMMIT":
            if statement.lstrip().startswith(("UPDATE", "INSERT", "DELETE")):
                self._last = f"{statement.split()[0]} {values[-1] if values else ''}"
            return super().execute(statement, values)
        full = sqlite3.OperationalError("database or disk is full")
        _cross(f"before commit {self._last}", full)
        result = super().execute(statement, values)
        _cross(f"after commit {self._last}", full)
        return result

    def executemany(self, statement, rows):
        rows = list(rows)
        if rows:
            self._last = f"{statement.split()[0]} many {next(v for v in rows[-1] if isinstance(v, str))}"
        return super().executemany(statement, rows)


def _label(target):
    """Return a name of a file or descriptor in the data folder that is equal in all runs; None elsewhere.

    The files that the page has of each epoch are one boundary.
    """
    path = Path(f"/proc/self/fd/{target}").readlink() if isinstance(target, int) else Path(target)
    _, separator, relative = f"{path}/".partition("/data/")
    if relative.startswith("page/"):
        relative = re.sub(r"\d{8}T\d{6}Z(_r\d+)?", "EPOCH", relative)
    elif relative.startswith("blocks/"):
        relative = re.sub(r"_[0-9a-f]{8}(?=\.)", "_HASH", relative)
    return re.sub(r"\.\d+\.part/$", ".part/", relative) if separator else None


def _cross(label, full=None):
    plan = _state["plan"]
    step = _record(plan["steps"], label)
    for number, (at, delay_s, victim) in enumerate(plan.get("kills", ())):
        is_this_process = victim != "child" or multiprocessing.parent_process() is not None
        claim = f"{plan['steps']}.kill{number}"
        if step < at or not is_this_process or number in _state["pending"]:
            continue
        if os.path.exists(claim):  # noqa: PTH110 - is faster
            continue
        _state["pending"].add(number)
        if delay_s:
            threading.Thread(target=_kill, args=(victim, delay_s, claim), daemon=True).start()
        else:
            _kill(victim, 0.0, claim)
    if not plan.get("once") or not _is_drawn(label, *plan.get("draw", (1, ""))):
        return
    claim = os.path.join(plan["died"], f"{plan['once']} {label}".replace("/", "|"))  # noqa: PTH118 - is faster
    if plan["once"] != "full":
        _kill(plan["once"], 0.0, claim)
    elif _is_first(claim) and label.split(" ", 2)[2]:  # without its data folder the service does not start
        raise full or OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), label)


def _is_drawn(label, share, seed):
    return zlib.crc32(f"{seed} {label}".encode()) % share == 0


def _kill(victim, delay_s, claim):
    time.sleep(delay_s)
    if not _is_first(claim):
        return
    if victim == "child" and multiprocessing.parent_process() is not None:
        os.kill(os.getpid(), signal.SIGKILL)
    os.kill(_state["service"], signal.SIGKILL)
    if victim == "both":
        os.kill(os.getpid(), signal.SIGKILL)


def _record(path, label):
    """Append a record; return the number of records."""
    steps = os.open(path, _append, 0o666)
    try:
        with suppress(OSError):  # under a limit of the file size the count goes on later
            os.write(steps, label.encode("utf-8", "replace")[:RECORD].ljust(RECORD))
        return os.fstat(steps).st_size // RECORD
    finally:
        os.close(steps)


def _is_first(claim):
    """Return True if this process is the first to claim a kill."""
    try:
        os.close(os.open(claim, os.O_CREAT | os.O_EXCL | os.O_WRONLY))
    except FileExistsError:
        return False
    return True
