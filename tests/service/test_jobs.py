"""The clockwork wakes the loop at its times, also after the clock was set."""

from __future__ import annotations

import time
from datetime import UTC, datetime
from queue import SimpleQueue

import pytest

from station.service.jobs import Clockwork, Wake


@pytest.fixture
def clock():
    return {"monotonic_s": 1000.0, "now_s": time.time()}


@pytest.fixture
def make(clock):
    made = []

    def build(wake, expected_every_s=3600.0):
        made.append(
            Clockwork(
                wake,
                expected_every_s=expected_every_s,
                monotonic_s=lambda: clock["monotonic_s"],
                now_s=lambda: clock["now_s"],
            )
        )
        return made[-1]

    yield build
    for clockwork in made:
        clockwork.stop()


def test_it_asks_often_whether_a_scan_is_overdue(make):
    woken = SimpleQueue()
    make(woken.put, expected_every_s=0.4)
    assert [woken.get(timeout=5.0) for _ in range(3)] == [Wake.EXPECTED] * 3


def test_jobs_are_in_utc_and_are_never_given_up(make):
    jobs = make(lambda _: None)._scheduler.get_jobs()
    assert {job.args[0] for job in jobs} == {Wake.EXPECTED, Wake.JOIN, Wake.SWEEP}
    for job in jobs:
        assert (job.misfire_grace_time, job.coalesce, job.max_instances) == (None, True, 1)
        assert job.next_run_time.utcoffset().total_seconds() == 0
    join = next(job for job in jobs if job.args[0] is Wake.JOIN)
    after_midnight = datetime(2026, 11, 21, 0, 0, tzinfo=UTC)
    assert join.trigger.get_next_fire_time(None, after_midnight) == datetime(2026, 11, 21, 1, 10, tzinfo=UTC)


@pytest.mark.parametrize("step_s", [-3600.0, 3600.0])
def test_a_clock_that_was_set_makes_it_schedule_anew(make, clock, step_s):
    clockwork = make(lambda _: None)
    before = clockwork._scheduler
    clock["now_s"] += 10 + 0.5
    clock["monotonic_s"] += 10
    assert clockwork.follow_clock() == 0.0
    assert clockwork._scheduler is before
    clock["now_s"] += step_s
    assert clockwork.follow_clock() == pytest.approx(step_s)
    assert clockwork._scheduler is not before
    assert not before.running
    assert clockwork.follow_clock() == 0.0
