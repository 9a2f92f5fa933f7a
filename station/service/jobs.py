"""What happens by the clock. The clockwork only wakes the loop, which does it between two scans."""

from __future__ import annotations

import time
from datetime import UTC
from enum import Enum, auto
from typing import TYPE_CHECKING

from apscheduler.schedulers.background import BackgroundScheduler

if TYPE_CHECKING:
    from collections.abc import Callable

CLOCK_STEP_S = 5.0  # a wall clock that moved so much against the monotonic one was set, not drifting


class Wake(Enum):
    """What the loop is woken for."""

    LOOK = auto()  # something happened in the inbox
    EXPECTED = auto()  # is a scan overdue?
    JOIN = auto()  # closed days and months
    JOINED = auto()  # they are: the series may name them
    SWEEP = auto()  # files that no longer serve
    RELOAD = auto()
    STOP = auto()


class Clockwork:
    """Wakes the loop at the times of its jobs, also after the wall clock was set."""

    def __init__(
        self,
        wake: Callable[[Wake], None],
        *,
        expected_every_s: float,
        monotonic_s: Callable[[], float] = time.monotonic,
        now_s: Callable[[], float] = time.time,
    ) -> None:
        self._wake = wake
        self._expected_every_s = expected_every_s
        self._monotonic_s = monotonic_s
        self._now_s = now_s
        self._offset_s = now_s() - monotonic_s()
        self._scheduler = self._started()

    def follow_clock(self) -> float:
        """Schedule anew if the wall clock was set; return by how much it was [s], else 0.

        A scheduler whose clock is set back waits until the old time comes again (SERVICE.md).
        """
        offset_s = self._now_s() - self._monotonic_s()
        step_s = offset_s - self._offset_s
        self._offset_s = offset_s  # slow drift is followed
        if abs(step_s) < CLOCK_STEP_S:
            return 0.0
        self.stop()
        self._scheduler = self._started()
        return step_s

    def stop(self) -> None:
        """Wake no more."""
        self._scheduler.shutdown(wait=False)

    def _started(self) -> BackgroundScheduler:
        scheduler = BackgroundScheduler(
            timezone=UTC,
            job_defaults={"misfire_grace_time": None, "coalesce": True, "max_instances": 1},
            daemon=True,
        )
        often_s = min(self._expected_every_s / 4, 60.0)
        scheduler.add_job(self._wake, "interval", seconds=often_s, args=[Wake.EXPECTED])
        # After midnight, when the last scan of the day has had time to arrive and be stored.
        scheduler.add_job(self._wake, "cron", hour="1,13", minute=10, args=[Wake.JOIN])
        scheduler.add_job(self._wake, "cron", hour="*/6", minute=40, args=[Wake.SWEEP])
        scheduler.start()
        return scheduler
