"""One worker process: started by the fork server, limited in memory, watched through a pipe.

Its messages are (kind, value): "progress", then one report: "returned", "error", "memory", "bug", "panicked".
Source: service.md, 2.
"""

from __future__ import annotations

import ctypes
import fcntl
import gc
import math
import multiprocessing
import multiprocessing.connection
import os
import resource
import signal
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from station.errors import StationError
from station.processing.workers import fork_server

if TYPE_CHECKING:
    from multiprocessing.connection import Connection

Message = tuple[str, object]
Progress = Callable[[], None]  # tells the parent of a worker process that it is alive

DIED = ("died", None)  # in place of a report, if there will be none
NOT_STARTED = ("not started", None)  # likewise, before the first message: the task is not the cause
SERVER_LOST = 255  # exit status that multiprocessing reports if the fork server died
POLL_S = 0.2  # between two looks at a worker, and between two reports of its progress
_ORPHANED = 1  # exit status of a worker whose parent died; nobody reads it


class Process(Protocol):
    """What `isolation` needs of a process that runs a task; see `WorkerProcess`."""

    def receive(self, timeout_s: float) -> Message | None: ...  # noqa: D102
    def cpu_ticks(self) -> int: ...  # noqa: D102
    def end(self) -> int | None: ...  # noqa: D102


class Launcher(Protocol):
    """What `isolation` needs to start worker processes; see `ForkServer`."""

    def start(self, task: Callable[..., object], args: tuple[object, ...], memory_gb: float) -> Process: ...  # noqa: D102
    def stop(self) -> None: ...  # noqa: D102


class ForkServer:
    """Starts worker processes by the fork server, which is itself started when it is needed."""

    def start(self, task: Callable[..., object], args: tuple[object, ...], memory_gb: float) -> WorkerProcess:
        """Start a worker; raise OSError or EOFError if that fails."""
        fork_server.ensure_running()
        return WorkerProcess(task, args, memory_gb)

    def stop(self) -> None:
        """Stop a server that cannot start workers, so that the next worker gets a new one."""
        fork_server.stop()


class WorkerProcess:
    """A process that runs a task with at most `memory_gb` more than its modules need."""

    def __init__(self, task: Callable[..., object], args: tuple[object, ...], memory_gb: float) -> None:
        self._connection, child_conn = fork_server.context.Pipe()
        self._process = fork_server.context.Process(
            target=_child_main,
            args=(child_conn, task, args, int(memory_gb * 2**30)),
            name=task.__name__,
            daemon=True,
        )
        self._has_started = False
        try:
            with child_conn:
                self._process.start()
        except BaseException:
            self._connection.close()
            raise
        self._pid = self._process.pid or 0
        self._pidfd: int | None = None  # by which it is killed even if the fork server, its parent, has died
        with suppress(OSError):  # it has ended
            self._pidfd = os.pidfd_open(self._pid)

    def receive(self, timeout_s: float) -> Message | None:
        """Return the next message, DIED or NOT_STARTED; None if there is none within `timeout_s`."""
        try:
            if not self._connection.poll(timeout_s):
                return None
            kind, value = self._connection.recv()
        except (EOFError, OSError):  # before or during a message
            return DIED if self._has_started else NOT_STARTED
        self._has_started = True
        return kind, value

    def cpu_ticks(self) -> int:
        """Return the CPU time used so far, in clock ticks, with that of processes it has started."""
        return _cpu_ticks(self._pid)

    def end(self) -> int | None:
        """End the process; return its exit status, None if even SIGKILL has to wait for a disk."""
        process = self._process
        process.join(POLL_S if process.exitcode is None else 0)
        if process.exitcode is None:
            process.kill()
            process.join(5.0)
        exit_status = process.exitcode
        if exit_status is not None:
            process.close()
        if self._pidfd is not None:
            with suppress(OSError):
                signal.pidfd_send_signal(self._pidfd, signal.SIGKILL)
            multiprocessing.connection.wait([self._pidfd], POLL_S)
            os.close(self._pidfd)
        self._connection.close()
        return exit_status


def _cpu_ticks(pid: int) -> int:
    """Return the CPU time that a process and those it has started have used, in clock ticks.

    0 if it has ended. A worker waits for the command that converts its scan. Source: proc(5).
    """
    try:
        fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    except OSError:
        return 0
    try:
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text(encoding="ascii").split()
    except OSError:  # it has ended, or the kernel does not list them
        children = []
    return int(fields[11]) + int(fields[12]) + sum(_cpu_ticks(int(child)) for child in children)


# ---- in the worker process


def _child_main(
    child_conn: Connection, task: Callable[..., object], args: tuple[object, ...], memory_bytes: int
) -> None:
    """Run the task in the worker process and send one final report."""
    _die_with_parent()
    gc.freeze()  # garbage collection over all preloaded modules would take 0.04 CPU-s per scan
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole process group: the parent decides
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    limit = _address_space() + memory_bytes
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    _send(child_conn, "progress", None)  # from here on, the task is responsible if the process dies
    try:
        _send(child_conn, "returned", task(*args, _progress_reporter(child_conn)))
    except StationError as error:
        _send(child_conn, "error", type(error)(str(error)))
    except MemoryError:
        _send(child_conn, "memory", None)
    except Exception:  # noqa: BLE001 - sent to the parent, which raises it
        _send(child_conn, "bug", traceback.format_exc())
    except BaseException as panic:  # noqa: BLE001 - lazrs panics past Exception
        _send(child_conn, "panicked", f"{type(panic).__name__}: {panic}")


def _send(child_conn: Connection, kind: str, value: object) -> None:
    """Send a message to the parent; exit silently if the parent no longer exists."""
    try:
        child_conn.send((kind, value))
    except ConnectionError:
        os._exit(_ORPHANED)


def _progress_reporter(child_conn: Connection) -> Callable[[], None]:
    """Return `progress()`, which sends at most one message per poll interval: each costs the parent time."""
    last_sent_s = -math.inf

    def progress() -> None:
        nonlocal last_sent_s
        if (now_s := time.monotonic()) >= last_sent_s + POLL_S:
            last_sent_s = now_s
            _send(child_conn, "progress", None)

    return progress


def _die_with_parent() -> None:
    """Have the kernel kill this process when the parent dies: no orphan may write while a new service runs.

    A pipe whose other end is open in the parent raises the signal. PR_SET_PDEATHSIG would not work (the fork
    server lives as long as its children), nor would a thread (a decoder may keep the interpreter lock).
    """
    parent = multiprocessing.parent_process()
    if parent is None:
        raise RuntimeError("runs in a worker process only")
    fcntl.fcntl(parent.sentinel, fcntl.F_SETOWN, os.getpid())
    fcntl.fcntl(parent.sentinel, fcntl.F_SETSIG, signal.SIGKILL)
    flags = fcntl.fcntl(parent.sentinel, fcntl.F_GETFL)
    fcntl.fcntl(parent.sentinel, fcntl.F_SETFL, flags | os.O_ASYNC)
    if multiprocessing.connection.wait([parent.sentinel], 0):  # it died before the signal was set up
        os._exit(_ORPHANED)


def trim_heap() -> None:
    """Return freed memory that glibc keeps to the system: about 60 MB, in milliseconds."""
    if trim := getattr(ctypes.CDLL(None), "malloc_trim", None):
        trim(0)


def _address_space() -> int:
    """Return the address space in use [bytes]; preloaded modules do not count against the memory limit."""
    return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0]) * resource.getpagesize()
