"""The job scheduler posts events on time, also after a step of the system clock."""

from __future__ import annotations

import time
from datetime import UTC, datetime
from queue import SimpleQueue

import pytest

from station.service.scheduler import JobScheduler, LoopEvent


@pytest.fixture
def clock():
    return {"monotonic_s": 1000.0, "now_s": time.time()}


@pytest.fixture
def make(clock):
    schedulers = []

    def build(on_event, expected_every_s=3600.0):
        schedulers.append(
            JobScheduler(
                on_event,
                expected_every_s=expected_every_s,
                monotonic_s=lambda: clock["monotonic_s"],
                now_s=lambda: clock["now_s"],
            )
        )
        return schedulers[-1]

    yield build
    for scheduler in schedulers:
        scheduler.stop()


def test_overdue_check_is_frequent(make):
    events = SimpleQueue()
    make(events.put, expected_every_s=0.4)
    assert [events.get(timeout=5.0) for _ in range(3)] == [LoopEvent.OVERDUE_CHECK] * 3


def test_jobs_run_in_utc_and_never_misfire(make):
    jobs = make(lambda _: None)._scheduler.get_jobs()
    assert {job.args[0] for job in jobs} == {
        LoopEvent.OVERDUE_CHECK,
        LoopEvent.COMPACT,
        LoopEvent.MAINTENANCE,
    }
    for job in jobs:
        assert (job.misfire_grace_time, job.coalesce, job.max_instances) == (None, True, 1)
        assert job.next_run_time.utcoffset().total_seconds() == 0
    compaction = next(job for job in jobs if job.args[0] is LoopEvent.COMPACT)
    after_midnight = datetime(2026, 11, 21, 0, 0, tzinfo=UTC)
    assert compaction.trigger.get_next_fire_time(None, after_midnight) == datetime(
        2026, 11, 21, 1, 10, tzinfo=UTC
    )


@pytest.mark.parametrize("step_s", [-3600.0, 3600.0])
def test_clock_step_reschedules_the_jobs(make, clock, step_s):
    scheduler = make(lambda _: None)
    initial = scheduler._scheduler
    clock["now_s"] += 10 + 0.5
    clock["monotonic_s"] += 10
    assert scheduler.resync_clock() == 0.0
    assert scheduler._scheduler is initial
    clock["now_s"] += step_s
    assert scheduler.resync_clock() == pytest.approx(step_s)
    assert scheduler._scheduler is not initial
    assert not initial.running
    assert scheduler.resync_clock() == 0.0
