"""A scanner that was moved is told from one that drifts."""

import csv
import math

import numpy as np
import pytest

from station.quantities import Habits
from station.science import motion
from station.science.motion import steps, usual

HABIT = usual(Habits())
HOUR = 3600.0
STEP = math.radians(0.02)
URAD = 1e-6


def restless(seed, scans=120, *, walk=26.0, noise=20.0, odd_even=58.0, wrong=0.05):
    """Poses like those of the real station: turns as measured there, shifts 20 µm for a µrad."""
    rng = np.random.default_rng(seed)
    pose = np.cumsum(rng.normal(0, walk, (scans, 6)), axis=0) + rng.normal(0, noise, (scans, 6))
    pose += np.where(np.arange(scans) % 2, 0.5, -0.5)[:, None] * odd_even
    bad = rng.uniform(size=scans) < wrong
    pose[bad] += rng.choice((-1, 1), (bad.sum(), 6)) * rng.uniform(250, 784, (bad.sum(), 6))
    return pose * URAD * np.array([1, 1, 1, 20, 20, 20])


def times(pose):
    return HOUR * np.arange(len(pose))


@pytest.mark.parametrize("most", [1, 6, 7, 40])
def test_running_medians_against_plain_loops(most):
    values = restless(3, 30)
    told = [np.median(values[max(last - most + 1, 0) : last + 1], axis=0) for last in range(len(values))]
    assert motion._medians(values, most) == pytest.approx(np.array(told), rel=1e-12)


def test_drift_and_noise_are_learned_as_they_are():
    """Of a long series, where habits hardly count; between odd and even scans one more noise."""
    pose = restless(4, 4000, walk=26.0, noise=20.0, odd_even=58.0, wrong=0.02)[:, :3]
    learned = motion._drifts(times(pose), pose, np.full(3, 30 * URAD))
    walk, noise = (np.median(one[500:], axis=0) for one in (learned.walk * HOUR, learned.noise))
    assert np.sqrt(walk) / URAD == pytest.approx(26.0, rel=0.2)
    assert np.sqrt(noise) / URAD == pytest.approx(20.0, rel=0.25)


def test_no_alarm_from_drift_zigzag_and_single_wrong_scans():
    """At most one false alarm in 1,000 scans of a station more restless than any known to us."""
    alarms = sum(len(steps(times(pose), pose, HABIT)) for pose in (restless(seed) for seed in range(8)))
    assert alarms <= 1


@pytest.mark.slow
def test_false_alarms_are_rare():
    """Restless with one scan in twenty wrong: one in 2,000 scans; calm: none in 5,000."""
    busy = (restless(seed, 1000) for seed in range(100, 106))
    assert sum(len(steps(times(pose), pose, HABIT)) for pose in busy) <= 3
    calm = (restless(s, 1000, walk=5.0, odd_even=0.0, wrong=0.01) for s in range(200, 205))
    assert sum(len(steps(times(pose), pose, HABIT)) for pose in calm) == 0


def test_a_step_is_told_once_soon_and_with_its_size():
    z, late = [], []
    for seed in range(10):
        pose = restless(seed + 50, 80, wrong=0.0)
        pose[45:, seed % 2] += STEP
        found = [one for one in steps(times(pose), pose, HABIT) if one.sigmas > 0]
        assert len(found) == 1
        assert abs(found[0].last_before - 44) <= 1
        late.append(found[0].told_at - 45)
        z.append((found[0].size[seed % 2] - STEP) / found[0].sigma[seed % 2])
    assert max(late) <= 6
    assert np.sqrt(np.mean(np.square(z))) < 1.8
    assert np.abs(z).max() < 4


def test_a_shift_and_a_turn_are_told_too():
    pose = restless(7, 60, walk=3.0, odd_even=0.0, wrong=0.0)
    pose[30:, 2] -= math.radians(0.01)
    pose[30:, 3:] += 0.006
    (found,) = steps(times(pose), pose, HABIT)
    assert (found.last_before, found.told_at) == (29, 34)
    assert found.size[2] == pytest.approx(-math.radians(0.01), abs=3 * found.sigma[2])
    assert np.all(found.size[3:] > 4 * found.sigma[3:])
    assert np.all(np.abs(found.size[:2]) < 3 * found.sigma[:2])


def test_one_wrong_scan_after_the_step_does_not_hide_it():
    pose = restless(8, 60, wrong=0.0)
    pose[30:, 0] += STEP
    pose[31, 0] -= 2 * STEP
    found = steps(times(pose), pose, HABIT)
    assert [one.last_before for one in found] == [29]


def test_who_comes_back_after_two_scans_was_not_moved():
    pose = restless(9, 60, wrong=0.0)
    pose[30:32, 0] += 2 * STEP
    assert steps(times(pose), pose, HABIT) == []


@pytest.mark.parametrize("wrong", [(27, 28, 29), (29, 31, 33), (23, 24, 27, 29), (24, 26, 28, 29)])
def test_wrong_scans_close_together_are_no_step(wrong):
    pose = restless(9, 60, wrong=0.0)
    pose[list(wrong), 0] -= 2 * STEP
    assert steps(times(pose), pose, HABIT) == []


def test_gaps_in_the_series_let_it_drift_farther():
    """The same difference is a step from hour to hour, and drift within five days without scans."""
    pose = restless(10, 60, wrong=0.0)
    pose[30:, 0] += STEP
    assert len(steps(times(pose), pose, HABIT)) == 1
    pause_s = np.where(np.arange(60) < 30, 0, 120 * HOUR)
    assert steps(times(pose) + pause_s, pose, HABIT) == []


def test_too_few_scans_tell_nothing():
    pose = restless(11, 19, wrong=0.0)
    pose[10:] += STEP
    assert steps(times(pose), pose, HABIT) == []
    assert steps(np.empty(0), np.empty((0, 6)), HABIT) == []


@pytest.fixture
def kijkduin(shared_data):
    """28 hourly poses of the real station of Kijkduin (topo4d, Apache-2.0)."""
    with (shared_data / "kijkduin_topo4d" / "transforms.csv").open() as file:
        rows = list(csv.DictReader(file))
    told = np.array([[float(row[k]) for k in ("rx_urad", "ry_urad", "rz_urad")] for row in rows]) * URAD
    shift = np.array([[float(row[k]) for k in ("tx_mm", "ty_mm", "tz_mm")] for row in rows]) * 1e-3
    return np.hstack([told, shift])


def test_the_real_station_did_not_move(kijkduin):
    assert steps(times(kijkduin), kijkduin, HABIT) == []


@pytest.mark.parametrize("first", [17, 18, 19, 21, 22])
@pytest.mark.parametrize("about", [0, 1, 2])
def test_a_step_of_the_real_station_would_be_told(kijkduin, about, first):
    """0.02°, in spite of a zig-zag of 58 µrad and three scans wrong by 250-784 µrad just before."""
    kijkduin[first:, about] += STEP
    (found,) = steps(times(kijkduin), kijkduin, HABIT)
    assert abs(found.last_before + 1 - first) <= 1
    assert found.told_at - first <= 5
    assert found.size[about] == pytest.approx(STEP, abs=2.5 * found.sigma[about])
    assert found.sigma[about] < 0.2 * STEP
