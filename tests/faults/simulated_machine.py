"""A computer for the service whose clock nobody waits for: its clocks, processes and events are simulated.

A task runs in this process, and its process may die, hang or never start. The disk is that of the real
computer, because netCDF and SQLite write to it by themselves: each change of a file in the data folder is a
boundary (`hooks/boundaries.py`) at which the disk may be full, or a process dies. Deaths here run `finally`
blocks, and nothing is synced; `test_kills.py` kills real processes.
"""

from __future__ import annotations

import errno
import math
import os
import random
import sqlite3
from collections import deque
from concurrent.futures import Executor, Future
from contextlib import ExitStack, contextmanager
from queue import Empty
from unittest import mock

from hooks import boundaries

from station.clock import Clock
from station.errors import StationError
from station.processing.workers.isolation import TaskRunner
from station.processing.workers.worker_process import DIED
from station.service.host import Host

WATCHDOG_S = 180.0  # WatchdogSec= of the unit
HANG_STEP_S = 30.0  # in which time passes while a process hangs
SIGKILL_STATUS = -9


class DiedError(BaseException):
    """The "service" or the "child", the process of a task, is killed, or a child hangs ("hang")."""


class Machine:
    """Clock, disk and processes, and what will happen to them."""

    def __init__(self, start_s: float, seed: int) -> None:
        self.start_s = start_s
        self.rng = random.Random(seed)  # noqa: S311 - no secret
        self.elapsed_s = self.clock_error_s = self.pinged_s = 0.0
        self.timeline: list[tuple[float, int, object]] = []
        self.deaths = self.hangs = 0
        self.in_child = self.is_acting = False
        self.countdown: dict[str, int] = {}  # boundaries until a death
        self.is_disk_full = self.is_out_of_space = False
        self.start_error: OSError | None = None  # of every process that is to be started
        self.is_out_of_memory = self.is_socket_deleted = False
        self.is_finished = False  # the service was idle, and nothing will happen any more

    def host(self) -> Host:
        """Return what the service needs of this machine."""
        clock = Clock(now_s=self.now_s, monotonic_s=self.monotonic_s, sleep=self.advance)
        return Host(
            clock=clock,
            tasks=TaskRunner(self, clock),
            events=_Events(self),
            systemd=_Systemd(self),
            make_watcher=_Nothing,
            make_scheduler=_Nothing,
            make_executor=_AtOnce,
        )

    def is_over(self) -> bool:
        """Return True if the service, which is idle, may stop."""
        raise NotImplementedError

    def is_time_up(self) -> bool:
        """Return True if the service has had its time, whatever it does."""
        raise NotImplementedError

    def stop_service(self) -> None:
        """Tell the service to stop."""
        raise NotImplementedError

    # ---- clock

    def now_s(self) -> float:
        """Wall clock of the station."""
        return self.start_s + self.elapsed_s + self.clock_error_s

    def monotonic_s(self) -> float:
        """Clock that nobody sets."""
        return 1000.0 + self.elapsed_s

    def at(self, elapsed_s: float, action: object) -> None:
        """Plan an action."""
        self.timeline.append((elapsed_s, len(self.timeline), action))
        self.timeline.sort(key=lambda planned: planned[:2], reverse=True)

    def advance(self, duration_s: float) -> None:
        """Let time pass, and happen what is planned for it."""
        until_s = self.elapsed_s + duration_s
        while self.timeline and self.timeline[-1][0] <= until_s:
            at_s, _, action = self.timeline.pop()
            self.elapsed_s = max(self.elapsed_s, at_s)
            self.is_acting = True  # what the world changes on disk is no boundary
            try:
                action()
            finally:
                self.is_acting = False
        self.elapsed_s = until_s

    def next_s(self) -> float:
        """Time until the next planned action [s]."""
        return max(self.timeline[-1][0] - self.elapsed_s, 0.0) if self.timeline else math.inf

    # ---- processes, as `worker_process.ForkServer` starts them

    def start(self, task, args, memory_gb):  # noqa: ARG002
        """Start the process of a task."""
        if self.start_error is not None:
            raise self.start_error
        if self.is_socket_deleted:
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), "listener")
        return _Process(self, task, args)

    def stop(self) -> None:
        """Stop the fork server: the next one has a new socket."""
        self.is_socket_deleted = False

    def hang(self) -> None:
        """Let time pass while a process hangs; systemd kills a service that does not feed its watchdog."""
        self.advance(HANG_STEP_S)
        if self.elapsed_s > self.pinged_s + WATCHDOG_S or self.is_time_up():
            raise DiedError("service")

    # ---- disk

    def cross(self, label: str, full: Exception | None = None) -> None:
        """Pass a boundary of the disk: a death, a full disk, or nothing."""
        if self.is_acting:
            return
        for victim in ("child", "hang", "service") if self.in_child else ("service",):
            if victim in self.countdown:
                self.countdown[victim] -= 1
                if self.countdown[victim] <= 0:
                    del self.countdown[victim]
                    raise DiedError(victim)
        if self.is_disk_full and self.rng.random() < 0.3:
            raise full or OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), label)

    @contextmanager
    def disk(self):
        """Make the changes of this process on disk boundaries, and its free space that of the world."""
        real_statvfs, connect = os.statvfs, sqlite3.connect

        def statvfs(folder):
            disk = real_statvfs(folder)
            return os.statvfs_result((*disk[:3], 0, 0, *disk[5:])) if self.is_out_of_space else disk

        def connect_watched(*args, **options):
            return connect(*args, **{"factory": boundaries._Connection} | options)

        replacements = {name: boundaries._watched(name, getattr(os, name)) for name in
                        ("replace", "rename", "link", "unlink", "mkdir")}  # fmt: skip
        replacements |= {
            "fsync": boundaries._watched("fsync", lambda _: None),
            "statvfs": statvfs,
            "nice": lambda _: 0,  # of this process, in which the tasks run
        }
        with ExitStack() as stack:
            stack.enter_context(mock.patch.multiple(os, **replacements))
            stack.enter_context(mock.patch.object(sqlite3, "connect", connect_watched))
            stack.enter_context(mock.patch.object(boundaries, "_cross", self.cross))
            yield


class _Process:
    """The process of a task, which runs here."""

    def __init__(self, machine, task, args):
        self._machine, self._task, self._args = machine, task, args
        self._has_started = self._hangs = False
        self._exit_status = 0

    def receive(self, timeout_s):  # noqa: ARG002
        if self._hangs:
            self._machine.hang()
            return None
        if not self._has_started:
            self._has_started = True
            return "progress", None
        if self._machine.is_out_of_memory:
            return "memory", None
        return self._run()

    def _run(self):
        machine = self._machine
        was_in_child, machine.in_child = machine.in_child, True
        try:
            return "returned", self._task(*self._args, lambda: None)
        except DiedError as death:
            if str(death) == "service":
                raise
            self._hangs = str(death) == "hang"
            machine.hangs += self._hangs
            machine.deaths += not self._hangs
            self._exit_status = SIGKILL_STATUS
            return None if self._hangs else DIED
        except StationError as error:
            return "error", type(error)(str(error))
        except Exception as bug:  # noqa: BLE001 - as a worker process does
            return "bug", repr(bug)
        finally:
            machine.in_child = was_in_child

    def cpu_ticks(self):
        return 0

    def end(self):
        return self._exit_status


class _Events:
    """The queue of the service, which waits by letting the time of its machine pass."""

    def __init__(self, machine):
        self._machine, self._events = machine, deque()

    def put(self, event):
        self._events.append(event)

    def get(self, timeout):
        machine = self._machine
        if not machine.is_finished and machine.is_over():
            machine.is_finished = True
            machine.stop_service()
        until_s = machine.elapsed_s + (max(timeout, 1e-3) if timeout else 0.0)
        while not self._events:
            if machine.elapsed_s >= until_s:
                raise Empty
            machine.advance(min(machine.next_s() + 1e-3, until_s - machine.elapsed_s))
        return self._events.popleft()


class _Systemd:
    """The service manager, which looks at its watchdog while a process hangs."""

    max_wait_s = math.inf

    def __init__(self, machine):
        self._machine = machine

    def watchdog(self):
        self._machine.pinged_s = self._machine.elapsed_s

    ready = reloading = stopping = lambda _: None

    def status(self, text):
        pass


class _Nothing:
    """File watcher and scheduler: their events come from the world."""

    def __init__(self, *_: object, **__: object) -> None:
        pass

    def ensure_watching(self) -> None:
        pass

    def resync_clock(self) -> float:
        return 0.0

    def close(self) -> None:
        pass

    stop = close


class _AtOnce(Executor):
    """Compaction at once instead of in another thread."""

    def submit(self, call, *args):
        future = Future()
        try:
            future.set_result(call(*args))
        except Exception as error:  # noqa: BLE001 - as a thread does
            future.set_exception(error)
        return future
