"""Scheduled tasks. The scheduler only queues events; the loop does the work between two scans."""

from __future__ import annotations

import time
from datetime import UTC
from enum import Enum, auto
from typing import TYPE_CHECKING

from apscheduler.schedulers.background import BackgroundScheduler

if TYPE_CHECKING:
    from collections.abc import Callable

MIN_CLOCK_STEP_S = 5.0  # against the monotonic clock: a larger deviation is a clock that was set, not drift


class LoopEvent(Enum):
    """Reasons to wake the loop."""

    INBOX_CHANGED = auto()  # the inbox has changed
    OVERDUE_CHECK = auto()  # is a scan overdue?
    COMPACT = auto()  # compact closed days and months
    COMPACTED = auto()  # compaction has finished: publish the files
    MAINTENANCE = auto()  # delete expired files, reprocess late inputs, apply retention
    RELOAD = auto()
    STOP = auto()


class JobScheduler:
    """Queues the scheduled events, also after the wall clock was set."""

    def __init__(
        self,
        post: Callable[[LoopEvent], None],
        *,
        expected_every_s: float,
        monotonic_s: Callable[[], float] = time.monotonic,
        now_s: Callable[[], float] = time.time,
    ) -> None:
        self._post = post
        self._expected_every_s = expected_every_s
        self._monotonic_s = monotonic_s
        self._now_s = now_s
        self._offset_s = now_s() - monotonic_s()
        self._scheduler = self._start_scheduler()

    def resync_clock(self) -> float:
        """Return the step of the wall clock [s], 0 without one; after a step, restart the scheduler.

        A scheduler whose clock is set back would wait for the old time to come again (service.md, 4).
        """
        offset_s = self._now_s() - self._monotonic_s()
        step_s = offset_s - self._offset_s
        self._offset_s = offset_s  # slow drift is tolerated
        if abs(step_s) < MIN_CLOCK_STEP_S:
            return 0.0
        self.stop()
        self._scheduler = self._start_scheduler()
        return step_s

    def stop(self) -> None:
        """Stop the scheduler."""
        self._scheduler.shutdown(wait=False)

    def _start_scheduler(self) -> BackgroundScheduler:
        scheduler = BackgroundScheduler(
            timezone=UTC,
            job_defaults={"misfire_grace_time": None, "coalesce": True, "max_instances": 1},
            daemon=True,
        )
        interval_s = min(self._expected_every_s / 4, 60.0)
        scheduler.add_job(self._post, "interval", seconds=interval_s, args=[LoopEvent.OVERDUE_CHECK])
        # After midnight, once the last scan of the day has had time to arrive and be stored.
        scheduler.add_job(self._post, "cron", hour="1,13", minute=10, args=[LoopEvent.COMPACT])
        scheduler.add_job(self._post, "cron", hour="*/6", minute=40, args=[LoopEvent.MAINTENANCE])
        scheduler.start()
        return scheduler
