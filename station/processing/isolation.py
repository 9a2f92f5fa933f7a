"""Isolation of tasks in worker processes with limited memory and time.

A corrupt scan can hang the decoder, abort the process, allocate 15 GB, or panic past `except Exception`.
A task is a function that a fresh interpreter can import; its last argument is `progress()`.
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
import threading
import time
import traceback
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from station.errors import InconclusiveError, NotReadyError, StationError
from station.processing import fork_server

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from multiprocessing.connection import Connection
    from multiprocessing.context import ForkServerProcess

T = TypeVar("T")

_POLL_S = 0.2
_FORKSERVER_LOST = 255  # exit status that multiprocessing reports if the fork server died
_NOT_STARTED = ("not started", None)
STALL_S = 120.0  # without progress, after which a worker is ended; shorter than the watchdog of the service
_ORPHANED = 1  # exit status of a worker whose parent died; nobody reads it
# A scan that needs too much memory hits RLIMIT_AS; the kernel kills if the machine or the unit has less.
_EXTERNAL_SIGNALS = {signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP}

# Delays before a killed worker is restarted: a single kill must not change the order of the scans.
RETRY_DELAYS_S = (1.0, 5.0, 30.0)


class _WorkerLostError(InconclusiveError):
    """The worker process was killed from outside or could not be started."""


class _StartFailures:
    """Since when no worker process could be started; several threads may run workers."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._since_s: float | None = None

    def record(self, *, has_started: bool) -> None:
        """Record an attempt to start a worker."""
        with self._lock:
            if has_started:
                self._since_s = None
            elif self._since_s is None:
                self._since_s = time.monotonic()

    def duration_s(self) -> float:
        with self._lock:
            return 0.0 if self._since_s is None else time.monotonic() - self._since_s


_start_failures = _StartFailures()


def seconds_without_worker() -> float:
    """Return for how long every attempt to start a worker process has failed [s], 0 if the last succeeded."""
    return _start_failures.duration_s()


def run_isolated(
    task: Callable[..., T],
    *args: object,
    memory_gb: float,
    timeout_s: float,
    on_progress: Callable[[], None] = lambda: None,
    should_stop: Callable[[], bool] = lambda: False,
) -> T:
    """Return the result of `task(*args, progress)`, computed in a worker process limited to `memory_gb`.

    `on_progress` is called in this process when the worker reports progress or has used CPU time, so never
    while it is blocked, for instance by a network folder that hangs.

    Raises the StationError that the task raised. Raises InconclusiveError if the worker ran out of memory or
    time, panicked, died by a signal that it caused, or repeatedly could not be started or was killed from
    outside: a corrupt scan does that, and so do a machine without memory or tasks and a disk that hangs.
    Raises NotReadyError if `should_stop()` returned true, or if the worker was blocked for STALL_S. Raises
    RuntimeError with the traceback of the worker for a bug.
    """
    hooks = on_progress, should_stop
    for delay_s in RETRY_DELAYS_S:
        try:
            return _run_once(task, args, memory_gb, timeout_s, *hooks)
        except _WorkerLostError:
            _pause(delay_s, should_stop)
    return _run_once(task, args, memory_gb, timeout_s, *hooks)


def _run_once(
    task: Callable[..., T],
    args: tuple[object, ...],
    memory_gb: float,
    timeout_s: float,
    on_progress: Callable[[], None],
    should_stop: Callable[[], bool],
) -> T:
    parent_conn, child_conn = fork_server.context.Pipe()
    with parent_conn:
        process = fork_server.context.Process(
            target=_child_main,
            args=(child_conn, task, args, int(memory_gb * 2**30)),
            name=task.__name__,
            daemon=True,
        )
        with child_conn:
            _start(process)
        with _killed_at_end(process.pid):
            try:
                report = _await_report(
                    parent_conn, process.pid, time.monotonic() + timeout_s, on_progress, should_stop
                )
                if report is None:
                    raise InconclusiveError(
                        f"took longer than {timeout_s:g} s: the file is corrupt, a disk or mount hangs, or"
                        " scans.timeout_s is too short"
                    )
            finally:
                exit_status = _terminate(process)
    _start_failures.record(has_started=report != _NOT_STARTED)
    kind, value = report
    if kind == "returned":
        return value  # type: ignore[return-value] # the task returned it
    if report == _NOT_STARTED or exit_status == _FORKSERVER_LOST:
        raise _WorkerLostError(
            f"the worker process could not be started or was lost (exit status {exit_status})"
        )
    if kind == "died":
        raise _exit_error(exit_status)
    if kind == "memory":
        raise InconclusiveError(
            f"needs more than {memory_gb:g} GB: the file is corrupt, service.memory_gb is too small, or the"
            " machine has no memory to spare"
        )
    if kind == "error":
        assert isinstance(value, StationError)  # noqa: S101 - sent by _child_main
        raise value
    if kind == "panicked":
        raise InconclusiveError(f"the decoder panicked: {value}")
    raise RuntimeError(f"a bug in {task.__name__}, in the worker process:\n{value}")


def _start(process: ForkServerProcess) -> None:
    """Start a worker; raise _WorkerLostError if that fails. A fork server that is the cause is stopped."""
    try:
        fork_server.ensure_running()
        process.start()
    except (OSError, EOFError) as error:  # also from flushing stderr first: its disk may be full
        _start_failures.record(has_started=False)
        if isinstance(error, FileNotFoundError | ConnectionError | EOFError):
            fork_server.stop()
        raise _WorkerLostError(f"the worker process could not be started: {error}") from error


def _pause(delay_s: float, should_stop: Callable[[], bool]) -> None:
    until_s = time.monotonic() + delay_s
    while (remaining_s := until_s - time.monotonic()) > 0:
        if should_stop():
            raise NotReadyError("stopped before it was done")
        time.sleep(min(remaining_s, _POLL_S))


def _await_report(
    parent_conn: Connection,
    pid: int | None,
    deadline_s: float,
    on_progress: Callable[[], None],
    should_stop: Callable[[], bool],
) -> tuple[str, object] | None:
    """Return (kind, value) of the final report of the worker; None if it did not arrive in time.

    Raises NotReadyError if the worker was blocked for STALL_S or `should_stop()` returned true.
    """
    has_started, cpu_ticks, progress_s = False, 0, time.monotonic()
    while time.monotonic() < deadline_s:
        if should_stop():
            raise NotReadyError("stopped before it was done")
        try:
            if parent_conn.poll(_POLL_S):
                on_progress()
                progress_s = time.monotonic()
                kind, value = parent_conn.recv()
                has_started = True
                if kind != "progress":
                    return kind, value
        except (EOFError, OSError):  # before or during a message
            return ("died", None) if has_started else _NOT_STARTED
        if (used_ticks := _cpu_ticks(pid)) != cpu_ticks:
            on_progress()
            cpu_ticks, progress_s = used_ticks, time.monotonic()
        elif time.monotonic() > progress_s + STALL_S:
            raise NotReadyError(f"blocked for {STALL_S:g} s: does a disk or network folder not respond?")
    return None


def _cpu_ticks(pid: int | None) -> int:
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


@contextmanager
def _killed_at_end(pid: int | None) -> Iterator[None]:
    """Kill a worker at the end of the block even if the fork server, its parent process, has died."""
    try:
        descriptor = os.pidfd_open(pid or 0)
    except OSError:  # it has ended
        yield
        return
    try:
        yield
    finally:
        with suppress(OSError):
            signal.pidfd_send_signal(descriptor, signal.SIGKILL)
        multiprocessing.connection.wait([descriptor], _POLL_S)
        os.close(descriptor)


def _terminate(process: ForkServerProcess) -> int | None:
    """End the worker; return its exit status, None if even SIGKILL has to wait for a disk."""
    process.join(_POLL_S if process.exitcode is None else 0)
    if process.exitcode is None:
        process.kill()
        process.join(5.0)
    exit_status = process.exitcode
    if exit_status is not None:
        process.close()
    return exit_status


def _exit_error(exit_status: int | None) -> NotReadyError:
    """Return the error for a dead worker; a kill from outside is not the fault of the scan."""
    if exit_status is None or exit_status >= 0:
        message = f"the decoder ended the process without a message (exit status {exit_status})"
        return InconclusiveError(message)
    name = signal.Signals(-exit_status).name
    if -exit_status in _EXTERNAL_SIGNALS:
        return _WorkerLostError(f"the process was killed ({name}): is the machine out of memory?")
    return InconclusiveError(f"the decoder died by {name}")


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
        if (now_s := time.monotonic()) >= last_sent_s + _POLL_S:
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
