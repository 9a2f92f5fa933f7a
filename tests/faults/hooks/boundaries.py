"""Count what a service does to the disk, and have it die, or the disk be full, at a chosen step.

Loaded into every process of the service under test, and there only: by `sitecustomize` beside it where the
service is started by its command, by `warm.py` where it is forked. `FAULTS_PLAN` (JSON) says what to do:

    steps     file; each boundary that any process crosses appends a record of 96 bytes to it
    kills     [[step, delay_s, whom], ...]: at that step or the first after it, so much later
    once      whom to kill at every boundary that has no file in the folder `died` yet; "full": nobody dies,
              but the disk is full there
    died      folder with an empty file for each boundary where that has been

`whom`: "child" (that decodes), "service" (its child must end by itself), "both" at once. A boundary is the
moment before and the moment after each fsync, rename, link, new folder, deletion and commit.
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
from contextlib import suppress
from datetime import datetime
from pathlib import Path

RECORD = 96
_state = {"plan": None, "service": 0, "pending": set()}
_append = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC


def install():
    """Hook into the calls that make changes last, in this process and those forked from it.

    At SIGUSR1 each of them writes to stderr what its threads are at.
    """
    faulthandler.register(signal.SIGUSR1)
    _state["plan"] = json.loads(os.environ["FAULTS_PLAN"])
    _state["service"] = int(os.environ.setdefault("FAULTS_SERVICE", str(os.getpid())))
    for name in ("fsync", "replace", "rename", "link", "unlink", "mkdir"):
        setattr(os, name, _watched(name, getattr(os, name)))
    sqlite3.connect = functools.partial(sqlite3.connect, factory=_Rows)


def set_clock(by_path):
    """Have all of the service believe in a wall clock that is off by what stands in a file [s]."""
    from station.service import daemon, inbox, jobs, journal, tasks

    true_s = time.time

    def now_s():
        return true_s() + float(Path(by_path).read_text(encoding="ascii"))

    class Clock(datetime):
        @classmethod
        def now(cls, tz=None):
            return cls.fromtimestamp(now_s(), tz)

    time.time = now_s
    tasks.datetime = Clock
    for made in (inbox.Inbox, journal.Journal, jobs.Clockwork):
        made.__init__.__kwdefaults__["now_s"] = now_s
    assert daemon.time.time is now_s


def hurry(period_s=5.0):
    """Have the service wait for fractions of a second where it waits for minutes."""
    from station.service import child, daemon, journal

    journal.FIRST_PAUSE_S = journal.LONGEST_PAUSE_S = 0.1
    child.PAUSES_S = (0.01,) * 100
    daemon.Pace.__init__.__defaults__ = (period_s, 0.02, 5.0, 0.05, 3600.0)


def _watched(name, call):
    @functools.wraps(call)
    def watched(target, *args, **kwargs):
        shown = _shown(args[0] if name in {"replace", "rename", "link"} else target)
        if shown is None:
            return call(target, *args, **kwargs)
        _cross(f"before {name} {shown}")
        told = call(target, *args, **kwargs)
        _cross(f"after {name} {shown}")
        return told

    return watched


class _Rows(sqlite3.Connection):
    """A connection whose commits are boundaries, by the statement they make last."""

    _last = ""

    def execute(self, statement, values=()):
        if statement != "COMMIT":
            if statement.lstrip().startswith(("UPDATE", "INSERT", "DELETE")):
                self._last = f"{statement.split()[0]} {values[-1] if values else ''}"
            return super().execute(statement, values)
        full = sqlite3.OperationalError("database or disk is full")
        _cross(f"before commit {self._last}", full)
        told = super().execute(statement, values)
        _cross(f"after commit {self._last}", full)
        return told

    def executemany(self, statement, rows):
        rows = list(rows)
        if rows:
            self._last = f"{statement.split()[0]} many {next(v for v in rows[-1] if isinstance(v, str))}"
        return super().executemany(statement, rows)


def _shown(target):
    """Name a file or descriptor in the data folder, without what differs from run to run; None elsewhere."""
    path = Path(f"/proc/self/fd/{target}").readlink() if isinstance(target, int) else Path(target)
    _, found, below = f"{path}/".partition("/data/")
    return re.sub(r"\.\d+\.part/$", ".part/", below) if found else None


def _cross(label, full=None):
    plan = _state["plan"]
    step = _record(plan["steps"], label)
    for number, (at, delay_s, whom) in enumerate(plan.get("kills", ())):
        ours = whom != "child" or multiprocessing.parent_process() is not None
        claim = f"{plan['steps']}.kill{number}"
        if step < at or not ours or number in _state["pending"] or os.path.exists(claim):  # noqa: PTH110 - is quick
            continue
        _state["pending"].add(number)
        if delay_s:
            threading.Thread(target=_kill, args=(whom, delay_s, claim), daemon=True).start()
        else:
            _kill(whom, 0.0, claim)
    if not plan.get("once"):
        return
    claim = os.path.join(plan["died"], f"{plan['once']} {label}".replace("/", "|"))  # noqa: PTH118 - is quick
    if plan["once"] != "full":
        _kill(plan["once"], 0.0, claim)
    elif _is_first(claim) and label.split(" ", 2)[2]:  # without its data folder no service starts
        raise full or OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), label)


def _kill(whom, delay_s, claim):
    time.sleep(delay_s)
    if not _is_first(claim):
        return
    if whom == "child" and multiprocessing.parent_process() is not None:
        os.kill(os.getpid(), signal.SIGKILL)
    os.kill(_state["service"], signal.SIGKILL)
    if whom == "both":
        os.kill(os.getpid(), signal.SIGKILL)


def _record(path, label):
    """Append a record; return how many there are."""
    steps = os.open(path, _append, 0o666)
    try:
        with suppress(OSError):  # where no file may grow we count on when one may
            os.write(steps, label.encode("utf-8", "replace")[:RECORD].ljust(RECORD))
        return os.fstat(steps).st_size // RECORD
    finally:
        os.close(steps)


def _is_first(claim):
    """Claim a death for this process; False where it or another was quicker."""
    try:
        os.close(os.open(claim, os.O_CREAT | os.O_EXCL | os.O_WRONLY))
    except FileExistsError:
        return False
    return True
