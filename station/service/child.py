"""Work that may hang, abort or take all memory runs in a child process, which can be told to end.

Corrupt scans hang a decoder, abort the process, take 15 GB, or panic past `except Exception` (SERVICE.md).
Children are forked from a server that has the heavy modules loaded and no threads, so that one starts in
milliseconds. A task is a function a fresh interpreter can import; its last argument is `progress()`.
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

from station.errors import NotReadyError, ScanError, StationError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from multiprocessing.connection import Connection
    from multiprocessing.context import ForkServerProcess

T = TypeVar("T")

# Whatever of these cannot be imported is left out; the first brings nearly all of the rest.
PRELOAD = (
    "station.service.tasks",
    "station.service.show",
    "station.service.child",
    "typer",  # of the command that a child, too, has as its main module
    "PIL.WebPImagePlugin",  # without it, each child brings those of all kinds of pictures to write one
    "station.readers.las",
    "netCDF4",
)
# Two cores decode, all else of a scan is one core's work; and every further thread of a BLAS reserves address
# space against RLIMIT_AS. Memory that is let go is kept for the next array, for to clear it each time takes
# long; between steps that want arrays of other sizes a task may `give_back` what is kept. Arrays lie in small
# pages: huge ones that are free a virtual machine hands back to its host, and each scan would have to ask for
# them again, half a second's work; to look cells up in small ones costs nothing that can be measured.
SURROUNDINGS = {
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "RAYON_NUM_THREADS": "2",
    "MALLOC_TRIM_THRESHOLD_": str(2**28),
    "MALLOC_MMAP_THRESHOLD_": str(2**25),
    "NUMPY_MADVISE_HUGEPAGE": "0",
}
_TICK_S = 0.2
_GONE_WITH_ITS_SERVER = 255  # what multiprocessing reports where the fork server died
_NOT_STARTED = ("not started", None)
_ALONE = 1  # how a child ends whose parent is gone; nobody is left to see it
# A scan that needs too much meets RLIMIT_AS; the kernel kills where the machine or the unit has less.
_FROM_OUTSIDE = {signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP}

# Before a killed child is started again: what comes next in time shall not go before it for one kill.
PAUSES_S = (1.0, 5.0, 30.0)

_starting = threading.Lock()  # several threads may each run a child
_forks = multiprocessing.get_context("forkserver")


class _KilledError(NotReadyError):
    """The child was lost by no fault of its own."""


def prepare(preload: Sequence[str] = PRELOAD) -> None:
    """Start the server that children are forked from; the first call decides what it loads."""
    with _starting:
        before = {name: os.environ.get(name) for name in SURROUNDINGS}
        os.environ.update(SURROUNDINGS)
        try:
            _forks.set_forkserver_preload(list(preload))
            forkserver.ensure_running()
        finally:
            for name, value in before.items():
                os.environ.pop(name)
                if value is not None:
                    os.environ[name] = value


def run(
    task: Callable[..., T],
    *args: object,
    memory_gb: float,
    timeout_s: float,
    on_progress: Callable[[], None] = lambda: None,
    should_stop: Callable[[], bool] = lambda: False,
) -> T:
    """Return what `task(*args, progress)` returns, computed in a child with `memory_gb` of its own.

    `on_progress` is called here after `progress()` there, and while waiting within `timeout_s`. Raises the
    StationError the task raised; ScanError where the child ran out of memory or time, panicked, or died by a
    signal of its own making; NotReadyError where `should_stop()` became true, or the child could not be
    started or was killed from outside, again and again; RuntimeError with the child's traceback for a bug.
    """
    hooks = on_progress, should_stop
    for pause_s in PAUSES_S:
        try:
            return _run_once(task, args, memory_gb, timeout_s, *hooks)
        except _KilledError:
            _wait(pause_s, *hooks)
    return _run_once(task, args, memory_gb, timeout_s, *hooks)


def _run_once(
    task: Callable[..., T],
    args: tuple[object, ...],
    memory_gb: float,
    timeout_s: float,
    on_progress: Callable[[], None],
    should_stop: Callable[[], bool],
) -> T:
    prepare()
    here, there = _forks.Pipe()
    with here:
        child = _forks.Process(
            target=_work, args=(there, task, args, int(memory_gb * 2**30)), name=task.__name__, daemon=True
        )
        with there:
            try:
                child.start()
            except OSError as error:  # also of stderr, which is flushed first: its disk may be full
                raise _KilledError(f"the process for it could not be started: {error}") from error
        try:
            report = _await_report(here, time.monotonic() + timeout_s, on_progress, should_stop)
            if report is None:
                raise ScanError(
                    f"took longer than {timeout_s:g} s: the file is corrupt, or timeout_s too short"
                )
        finally:
            exit_status = _end(child)
    kind, value = report
    if kind == "returned":
        return value  # type: ignore[return-value] # it is what the task returned
    if report == _NOT_STARTED or exit_status == _GONE_WITH_ITS_SERVER:
        raise _KilledError(f"the process for it could not be started or was lost (exit status {exit_status})")
    if kind == "died":
        raise _cause_of_death(exit_status)
    if kind == "memory":
        raise ScanError(
            f"needs more than {memory_gb:g} GB: the file is corrupt, or service.memory_gb too small"
        )
    if kind == "refused":
        assert isinstance(value, StationError)  # noqa: S101 - by _work
        raise value
    if kind == "panicked":
        raise ScanError(f"the decoder panicked: {value}")
    raise RuntimeError(f"a bug in {task.__name__}, in the child:\n{value}")


def _wait(pause_s: float, on_progress: Callable[[], None], should_stop: Callable[[], bool]) -> None:
    until_s = time.monotonic() + pause_s
    while (left_s := until_s - time.monotonic()) > 0:
        if should_stop():
            raise NotReadyError("stopped before it was done")
        on_progress()
        time.sleep(min(left_s, _TICK_S))


def _await_report(
    here: Connection,
    deadline_s: float,
    on_progress: Callable[[], None],
    should_stop: Callable[[], bool],
) -> tuple[str, object] | None:
    """Wait for the child's last word; None where it had none in time."""
    started = False
    while time.monotonic() < deadline_s:
        if should_stop():
            raise NotReadyError("stopped before it was done")
        on_progress()
        try:
            if here.poll(_TICK_S):
                kind, value = here.recv()
                started = True
                if kind != "progress":
                    return kind, value
        except (EOFError, OSError):  # before a word, or amid one
            return ("died", None) if started else _NOT_STARTED
    return None


def _end(child: ForkServerProcess) -> int | None:
    """Make sure the child has ended; its exit status, None where even SIGKILL has to wait for a disk."""
    child.join(_TICK_S if child.exitcode is None else 0)
    if child.exitcode is None:
        child.kill()
        child.join(5.0)
    exit_status = child.exitcode
    if exit_status is not None:
        child.close()
    return exit_status


def _cause_of_death(exit_status: int | None) -> ScanError | NotReadyError:
    """Say what a child died of: a decoder that crashes is the scan's fault, a kill from outside is not."""
    if exit_status is None or exit_status >= 0:
        return ScanError(f"the decoder ended the process without a word (exit status {exit_status})")
    name = signal.Signals(-exit_status).name
    if -exit_status in _FROM_OUTSIDE:
        return _KilledError(f"the process was killed ({name}): is the machine out of memory?")
    return ScanError(f"the decoder died by {name}")


def _work(there: Connection, task: Callable[..., object], args: tuple[object, ...], memory: int) -> None:
    """Run the task in the child and report once how it ended."""
    _end_with_the_parent()
    gc.freeze()  # to look for garbage in all that the server has loaded takes 0.04 CPU-s of a scan
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group: the parent decides
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    limit = _mapped() + memory
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    _say(there, "progress", None)  # from here on a death is the task's own
    try:
        _say(there, "returned", task(*args, _teller(there)))
    except StationError as error:
        _say(there, "refused", type(error)(str(error)))
    except MemoryError:
        _say(there, "memory", None)
    except Exception:  # noqa: BLE001 - goes to the parent whole, which raises it
        _say(there, "bug", traceback.format_exc())
    except BaseException as panic:  # noqa: BLE001 - lazrs panics past Exception
        _say(there, "panicked", f"{type(panic).__name__}: {panic}")


def _say(there: Connection, kind: str, value: object) -> None:
    """Tell the parent; where it is gone, end: the work was for it, and nobody is to read of it in the log."""
    try:
        there.send((kind, value))
    except ConnectionError:
        os._exit(_ALONE)


def _teller(there: Connection) -> Callable[[], None]:
    """Return what tells of progress, often enough and no more: each word takes the parent's time too."""
    told_s = -math.inf

    def progress() -> None:
        nonlocal told_s
        if (now_s := time.monotonic()) >= told_s + _TICK_S:
            told_s = now_s
            _say(there, "progress", None)

    return progress


def _end_with_the_parent() -> None:
    """Have the kernel kill this process when the parent is gone: no orphan writes beside a new service.

    A pipe whose other end the parent holds gives the signal; neither PR_SET_PDEATHSIG (the fork server lives
    as long as its children) nor a thread (a decoder may hold the interpreter's lock) would do.
    """
    parent = multiprocessing.parent_process()
    if parent is None:
        raise RuntimeError("runs in a child only")
    fcntl.fcntl(parent.sentinel, fcntl.F_SETOWN, os.getpid())
    fcntl.fcntl(parent.sentinel, fcntl.F_SETSIG, signal.SIGKILL)
    flags = fcntl.fcntl(parent.sentinel, fcntl.F_GETFL)
    fcntl.fcntl(parent.sentinel, fcntl.F_SETFL, flags | os.O_ASYNC)
    if multiprocessing.connection.wait([parent.sentinel], 0):  # it went before the kernel was asked
        os._exit(_ALONE)


def give_back() -> None:
    """Give memory that was let go back to the system, where glibc keeps it: milliseconds, for some 60 MB."""
    if trim := getattr(ctypes.CDLL(None), "malloc_trim", None):
        trim(0)


def _mapped() -> int:
    """Address space in use [bytes]: the loaded modules are not held against the scan."""
    return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0]) * resource.getpagesize()
