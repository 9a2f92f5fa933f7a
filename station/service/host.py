"""What the service needs of the machine it runs on.

The tests pass a simulated one, in which the same service lives through years of faults in minutes.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, field
from queue import SimpleQueue

from station.clock import Clock
from station.processing.workers.isolation import TaskRunner
from station.service.inbox_watcher import InboxWatcher
from station.service.scheduler import JobScheduler, LoopEvent
from station.service.systemd import SystemdNotifier


def _one_thread() -> Executor:
    return ThreadPoolExecutor(max_workers=1)


@dataclass(frozen=True)
class Host:
    """Clocks, worker processes, the queue in which the loop waits, and what puts events into it."""

    clock: Clock = field(default_factory=Clock)
    tasks: TaskRunner = field(default_factory=TaskRunner)
    # SimpleQueue: its put() may be called from a signal handler while get() waits.
    events: SimpleQueue[LoopEvent] = field(default_factory=SimpleQueue)
    systemd: SystemdNotifier = field(default_factory=SystemdNotifier)
    make_watcher: Callable[..., InboxWatcher] = InboxWatcher
    make_scheduler: Callable[..., JobScheduler] = JobScheduler
    make_executor: Callable[[], Executor] = _one_thread  # of compaction in the background
