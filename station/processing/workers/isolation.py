"""Isolation of tasks in worker processes with limited memory and time.

A corrupt scan can hang the decoder, abort the process, allocate 15 GB, or panic past `except Exception`.
A task is a function that a fresh interpreter can import; its last argument is `progress()`.
Source: service.md, 2.
"""

from __future__ import annotations

import signal
import threading
from typing import TYPE_CHECKING, TypeVar

from station.clock import Clock
from station.errors import InconclusiveError, NotReadyError, StationError
from station.processing.workers.worker_process import (
    DIED,
    NOT_STARTED,
    POLL_S,
    SERVER_LOST,
    ForkServer,
    Launcher,
    Message,
    Process,
)

if TYPE_CHECKING:
    from collections.abc import Callable

T = TypeVar("T")

STALL_S = 120.0  # without progress, after which a worker is ended; shorter than the watchdog of the service
# A scan that needs too much memory hits RLIMIT_AS; the kernel kills if the machine or the unit has less.
_EXTERNAL_SIGNALS = {signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP}

# Delays before a killed worker is restarted: a single kill must not change the order of the scans.
RETRY_DELAYS_S = (1.0, 5.0, 30.0)


class _WorkerLostError(InconclusiveError):
    """The worker process was killed from outside or could not be started."""


class TaskRunner:
    """Runs tasks in worker processes, and knows since when none could be started; for several threads."""

    def __init__(self, launcher: Launcher | None = None, clock: Clock | None = None) -> None:
        self._launcher = launcher or ForkServer()
        self._clock = clock or Clock()
        self._lock = threading.Lock()
        self._failing_since_s: float | None = None

    def run(
        self,
        task: Callable[..., T],
        *args: object,
        memory_gb: float,
        timeout_s: float,
        on_progress: Callable[[], None] = lambda: None,
        should_stop: Callable[[], bool] = lambda: False,
    ) -> T:
        """Return the result of `task(*args, progress)`, computed in a worker process limited to `memory_gb`.

        `on_progress` is called in this process when the worker reports progress or has used CPU time, so
        never while it is blocked, for instance by a network folder that hangs.

        Raises the StationError that the task raised. Raises InconclusiveError if the worker ran out of memory
        or time, panicked, died by a signal that it caused, or repeatedly could not be started or was killed
        from outside: a corrupt scan does that, and so do a machine without memory or tasks and a disk that
        hangs. Raises NotReadyError if `should_stop()` returned true, or if the worker was blocked for
        STALL_S. Raises RuntimeError with the traceback of the worker for a bug.
        """
        hooks = on_progress, should_stop
        for delay_s in RETRY_DELAYS_S:
            try:
                return self._run_once(task, args, memory_gb, timeout_s, *hooks)
            except _WorkerLostError:
                self._pause(delay_s, should_stop)
        return self._run_once(task, args, memory_gb, timeout_s, *hooks)

    def seconds_without_worker(self) -> float:
        """Return for how long every attempt to start a worker has failed [s], 0 if the last succeeded."""
        with self._lock:
            since_s = self._failing_since_s
        return 0.0 if since_s is None else self._clock.monotonic_s() - since_s

    def _run_once(
        self,
        task: Callable[..., T],
        args: tuple[object, ...],
        memory_gb: float,
        timeout_s: float,
        on_progress: Callable[[], None],
        should_stop: Callable[[], bool],
    ) -> T:
        process = self._start(task, args, memory_gb)
        deadline_s = self._clock.monotonic_s() + timeout_s
        try:
            report = self._await_report(process, deadline_s, on_progress, should_stop)
            if report is None:
                raise InconclusiveError(
                    f"took longer than {timeout_s:g} s: the file is corrupt, a disk or mount hangs, or"
                    " scans.timeout_s is too short"
                )
        finally:
            exit_status = process.end()
        self._record_start(has_started=report != NOT_STARTED)
        kind, value = report
        if kind == "returned":
            return value  # type: ignore[return-value] # the task returned it
        if kind == "bug":
            raise RuntimeError(f"a bug in {task.__name__}, in the worker process:\n{value}")
        raise _error_of(report, exit_status, memory_gb)

    def _start(self, task: Callable[..., T], args: tuple[object, ...], memory_gb: float) -> Process:
        """Start a worker; raise _WorkerLostError if that fails. A server that is the cause is stopped."""
        try:
            return self._launcher.start(task, args, memory_gb)
        except (OSError, EOFError) as error:  # also from flushing stderr first: its disk may be full
            self._record_start(has_started=False)
            if isinstance(error, FileNotFoundError | ConnectionError | EOFError):
                self._launcher.stop()
            raise _WorkerLostError(f"the worker process could not be started: {error}") from error

    def _record_start(self, *, has_started: bool) -> None:
        with self._lock:
            if has_started:
                self._failing_since_s = None
            elif self._failing_since_s is None:
                self._failing_since_s = self._clock.monotonic_s()

    def _pause(self, delay_s: float, should_stop: Callable[[], bool]) -> None:
        until_s = self._clock.monotonic_s() + delay_s
        while (remaining_s := until_s - self._clock.monotonic_s()) > 0:
            if should_stop():
                raise NotReadyError("stopped before it was done")
            self._clock.sleep(min(remaining_s, POLL_S))

    def _await_report(
        self,
        process: Process,
        deadline_s: float,
        on_progress: Callable[[], None],
        should_stop: Callable[[], bool],
    ) -> Message | None:
        """Return the final report of the worker; None if it did not arrive in time.

        Raises NotReadyError if the worker was blocked for STALL_S or `should_stop()` returned true.
        """
        monotonic_s = self._clock.monotonic_s
        cpu_ticks, progress_s = 0, monotonic_s()
        while monotonic_s() < deadline_s:
            if should_stop():
                raise NotReadyError("stopped before it was done")
            message = process.receive(POLL_S)
            if message in (DIED, NOT_STARTED):
                return message
            if message is not None:
                on_progress()
                progress_s = monotonic_s()
                if message[0] != "progress":
                    return message
            if (used_ticks := process.cpu_ticks()) != cpu_ticks:
                on_progress()
                cpu_ticks, progress_s = used_ticks, monotonic_s()
            elif monotonic_s() > progress_s + STALL_S:
                raise NotReadyError(f"blocked for {STALL_S:g} s: does a disk or network folder not respond?")
        return None


def _error_of(report: Message, exit_status: int | None, memory_gb: float) -> StationError:
    """Return the error of a worker that returned no result and found no bug."""
    kind, value = report
    if report == NOT_STARTED or exit_status == SERVER_LOST:
        return _WorkerLostError(
            f"the worker process could not be started or was lost (exit status {exit_status})"
        )
    if kind == "died":
        return _exit_error(exit_status)
    if kind == "memory":
        return InconclusiveError(
            f"needs more than {memory_gb:g} GB: the file is corrupt, service.memory_gb is too small, or the"
            " machine has no memory to spare"
        )
    if kind == "panicked":
        return InconclusiveError(f"the decoder panicked: {value}")
    assert isinstance(value, StationError)  # noqa: S101 - sent by the worker
    return value


def _exit_error(exit_status: int | None) -> NotReadyError:
    """Return the error for a dead worker; a kill from outside is not the fault of the scan."""
    if exit_status is None or exit_status >= 0:
        message = f"the decoder ended the process without a message (exit status {exit_status})"
        return InconclusiveError(message)
    name = signal.Signals(-exit_status).name
    if -exit_status in _EXTERNAL_SIGNALS:
        return _WorkerLostError(f"the process was killed ({name}): is the machine out of memory?")
    return InconclusiveError(f"the decoder died by {name}")
