"""Isolation of tasks in worker processes with limited memory and time.

A corrupt scan can hang the decoder, abort the process, allocate 15 GB, or panic past `except Exception`.
Workers are forked from a server process without threads that has preloaded the large modules, so that they
start within milliseconds. A task is a function that a fresh interpreter can import; its last argument is
`progress()`. Source: service.md, 2.
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
from multiprocessing import forkserver
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from station.errors import InconclusiveError, NotReadyError, StationError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from multiprocessing.connection import Connection
    from multiprocessing.context import ForkServerProcess

T = TypeVar("T")

# Modules that cannot be imported are skipped; the first one imports nearly all of the others.
PRELOAD = (
    "station.processing.scan_tasks",
    "station.service.publishing",
    "station.processing.isolation",
    "typer",  # imported by the main module of the command, which a worker loads too
    "PIL.WebPImagePlugin",  # without it, each worker imports the plugins of all image formats to write one
    "station.readers.las",
    "netCDF4",
    "scipy.signal",  # for the spectrum of an inclination log; its import takes longer than the spectrum
)
# Decoding uses two cores, everything else one: each further BLAS thread reserves address space that counts
# against RLIMIT_AS. Freed memory is kept for the next array, because clearing fresh pages is slow; between
# steps with arrays of different sizes a task may call `trim_heap`. Arrays use small pages: a virtual machine
# returns free huge pages to its host, and requesting them again would take 0.5 s per scan. Cell look-ups in
# small pages are not measurably slower.
WORKER_ENV = {
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "RAYON_NUM_THREADS": "2",
    "MALLOC_TRIM_THRESHOLD_": str(2**28),
    "MALLOC_MMAP_THRESHOLD_": str(2**25),
    "NUMPY_MADVISE_HUGEPAGE": "0",
}
_POLL_S = 0.2
_FORKSERVER_LOST = 255  # exit status that multiprocessing reports if the fork server died
_NOT_STARTED = ("not started", None)
_ORPHANED = 1  # exit status of a worker whose parent died; nobody reads it
# A scan that needs too much memory hits RLIMIT_AS; the kernel kills if the machine or the unit has less.
_EXTERNAL_SIGNALS = {signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP}

# Delays before a killed worker is restarted: a single kill must not change the order of the scans.
RETRY_DELAYS_S = (1.0, 5.0, 30.0)

_start_lock = threading.Lock()  # several threads may run workers
_context = multiprocessing.get_context("forkserver")


class _WorkerLostError(NotReadyError):
    """The worker process was killed from outside or could not be started."""


def start_forkserver(preload: Sequence[str] = PRELOAD) -> None:
    """Start the server from which workers are forked; only the first call can choose what it preloads."""
    with _start_lock:
        saved = {name: os.environ.get(name) for name in WORKER_ENV}
        os.environ.update(WORKER_ENV)
        try:
            _context.set_forkserver_preload(list(preload))
            forkserver.ensure_running()
        finally:
            for name, value in saved.items():
                os.environ.pop(name)
                if value is not None:
                    os.environ[name] = value


def run_isolated(
    task: Callable[..., T],
    *args: object,
    memory_gb: float,
    timeout_s: float,
    on_progress: Callable[[], None] = lambda: None,
    should_stop: Callable[[], bool] = lambda: False,
) -> T:
    """Return the result of `task(*args, progress)`, computed in a worker process limited to `memory_gb`.

    `on_progress` is called in this process while it waits, up to `timeout_s`.

    Raises the StationError that the task raised. Raises InconclusiveError if the worker ran out of memory or
    time, panicked, or died by a signal that it caused: a corrupt scan does that, and so do a machine without
    memory and a disk that hangs. Raises NotReadyError if `should_stop()` returned true, or if the
    worker repeatedly could not be started or was killed from outside. Raises RuntimeError with the traceback
    of the worker for a bug.
    """
    hooks = on_progress, should_stop
    for delay_s in RETRY_DELAYS_S:
        try:
            return _run_once(task, args, memory_gb, timeout_s, *hooks)
        except _WorkerLostError:
            _pause(delay_s, *hooks)
    return _run_once(task, args, memory_gb, timeout_s, *hooks)


def _run_once(
    task: Callable[..., T],
    args: tuple[object, ...],
    memory_gb: float,
    timeout_s: float,
    on_progress: Callable[[], None],
    should_stop: Callable[[], bool],
) -> T:
    start_forkserver()
    parent_conn, child_conn = _context.Pipe()
    with parent_conn:
        process = _context.Process(
            target=_child_main,
            args=(child_conn, task, args, int(memory_gb * 2**30)),
            name=task.__name__,
            daemon=True,
        )
        with child_conn:
            try:
                process.start()
            except OSError as error:  # also from flushing stderr first: its disk may be full
                raise _WorkerLostError(f"the worker process could not be started: {error}") from error
        try:
            report = _await_report(parent_conn, time.monotonic() + timeout_s, on_progress, should_stop)
            if report is None:
                raise InconclusiveError(
                    f"took longer than {timeout_s:g} s: a disk or mount hangs, the file is corrupt, or"
                    " scans.timeout_s is too short"
                )
        finally:
            exit_status = _terminate(process)
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


def _pause(delay_s: float, on_progress: Callable[[], None], should_stop: Callable[[], bool]) -> None:
    until_s = time.monotonic() + delay_s
    while (remaining_s := until_s - time.monotonic()) > 0:
        if should_stop():
            raise NotReadyError("stopped before it was done")
        on_progress()
        time.sleep(min(remaining_s, _POLL_S))


def _await_report(
    parent_conn: Connection,
    deadline_s: float,
    on_progress: Callable[[], None],
    should_stop: Callable[[], bool],
) -> tuple[str, object] | None:
    """Return (kind, value) of the final report of the worker; None if it did not arrive in time."""
    has_started = False
    while time.monotonic() < deadline_s:
        if should_stop():
            raise NotReadyError("stopped before it was done")
        on_progress()
        try:
            if parent_conn.poll(_POLL_S):
                kind, value = parent_conn.recv()
                has_started = True
                if kind != "progress":
                    return kind, value
        except (EOFError, OSError):  # before or during a message
            return ("died", None) if has_started else _NOT_STARTED
    return None


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
