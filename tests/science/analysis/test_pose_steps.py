"""Step detection in pose series: false alarms, detection of steps, and a real station."""

import csv
import math

import numpy as np
import pytest

from station.quantities import VarianceComponents
from station.science.analysis import pose_steps
from station.science.analysis.pose_steps import detect_steps, pose_sigma

PRIOR_SIGMA = pose_sigma(VarianceComponents())
HOUR_S = 3600.0
STEP_RAD = math.radians(0.02)
URAD = 1e-6


def simulate_poses(seed, scans=120, *, walk=26.0, noise=20.0, odd_even=58.0, outlier_share=0.05):
    """Poses like those of the station at Kijkduin: rotations as observed there, shifts of 20 µm per µrad."""
    rng = np.random.default_rng(seed)
    pose = np.cumsum(rng.normal(0, walk, (scans, 6)), axis=0) + rng.normal(0, noise, (scans, 6))
    pose += np.where(np.arange(scans) % 2, 0.5, -0.5)[:, None] * odd_even
    outliers = rng.uniform(size=scans) < outlier_share
    pose[outliers] += rng.choice((-1, 1), (outliers.sum(), 6)) * rng.uniform(250, 784, (outliers.sum(), 6))
    return pose * URAD * np.array([1, 1, 1, 20, 20, 20])


def times(pose):
    return HOUR_S * np.arange(len(pose))


@pytest.mark.parametrize("window", [1, 6, 7, 40])
def test_rolling_median_matches_a_plain_loop(window):
    values = simulate_poses(3, 30)
    expected = [
        np.median(values[max(last - window + 1, 0) : last + 1], axis=0) for last in range(len(values))
    ]
    assert pose_steps._rolling_median(values, window) == pytest.approx(np.array(expected), rel=1e-12)


def test_random_walk_and_noise_are_estimated():
    """Estimates from a long series, where the prior has little weight."""
    pose = simulate_poses(4, 4000, walk=26.0, noise=20.0, odd_even=58.0, outlier_share=0.02)[:, :3]
    model = pose_steps._estimate_random_walk(times(pose), pose, np.full(3, 30 * URAD))
    walk, noise = (np.median(values[500:], axis=0) for values in (model.walk * HOUR_S, model.noise))
    assert np.sqrt(walk) / URAD == pytest.approx(26.0, rel=0.2)
    assert np.sqrt(noise) / URAD == pytest.approx(20.0, rel=0.25)


@pytest.mark.integration
def test_drift_odd_even_differences_and_outliers_are_not_steps():
    """At most one false alarm in 1,000 scans with more drift and noise than at Kijkduin."""
    alarms = sum(
        len(detect_steps(times(pose), pose, PRIOR_SIGMA))
        for pose in (simulate_poses(seed) for seed in range(8))
    )
    assert alarms <= 1


@pytest.mark.slow
def test_false_alarms_are_rare():
    """With 5 % outliers: one in 2,000 scans; of a calm series: none in 5,000."""
    noisy = (simulate_poses(seed, 1000) for seed in range(100, 106))
    assert sum(len(detect_steps(times(pose), pose, PRIOR_SIGMA)) for pose in noisy) <= 3
    calm = (simulate_poses(s, 1000, walk=5.0, odd_even=0.0, outlier_share=0.01) for s in range(200, 205))
    assert sum(len(detect_steps(times(pose), pose, PRIOR_SIGMA)) for pose in calm) == 0


@pytest.mark.integration
def test_a_step_is_detected_once_early_and_with_its_size():
    z, delay = [], []
    for seed in range(10):
        pose = simulate_poses(seed + 50, 80, outlier_share=0.0)
        pose[45:, seed % 2] += STEP_RAD
        (step,) = detect_steps(times(pose), pose, PRIOR_SIGMA)
        assert abs(step.last_before - 44) <= 1
        delay.append(step.detected_at - 45)
        z.append((step.size[seed % 2] - STEP_RAD) / step.sigma[seed % 2])
    assert max(delay) <= 6
    assert np.sqrt(np.mean(np.square(z))) < 1.8
    assert np.abs(z).max() < 4


def test_a_shift_with_a_rotation_is_detected():
    pose = simulate_poses(7, 60, walk=3.0, odd_even=0.0, outlier_share=0.0)
    pose[30:, 2] -= math.radians(0.01)
    pose[30:, 3:] += 0.006
    (step,) = detect_steps(times(pose), pose, PRIOR_SIGMA)
    assert (step.last_before, step.detected_at) == (29, 34)
    assert step.size[2] == pytest.approx(-math.radians(0.01), abs=3 * step.sigma[2])
    assert np.all(step.size[3:] > 4 * step.sigma[3:])
    assert np.all(np.abs(step.size[:2]) < 3 * step.sigma[:2])


def test_an_outlier_after_a_step_does_not_hide_it():
    pose = simulate_poses(8, 60, outlier_share=0.0)
    pose[30:, 0] += STEP_RAD
    pose[31, 0] -= 2 * STEP_RAD
    steps = detect_steps(times(pose), pose, PRIOR_SIGMA)
    assert [step.last_before for step in steps] == [29]


def test_a_change_that_reverts_after_two_scans_is_no_step():
    pose = simulate_poses(9, 60, outlier_share=0.0)
    pose[30:32, 0] += 2 * STEP_RAD
    assert detect_steps(times(pose), pose, PRIOR_SIGMA) == []


@pytest.mark.parametrize("outliers", [(27, 28, 29), (29, 31, 33), (23, 24, 27, 29), (24, 26, 28, 29)])
def test_outliers_close_together_are_no_step(outliers):
    pose = simulate_poses(9, 60, outlier_share=0.0)
    pose[list(outliers), 0] -= 2 * STEP_RAD
    assert detect_steps(times(pose), pose, PRIOR_SIGMA) == []


def test_a_gap_in_the_series_allows_more_drift():
    """The same difference is a step within an hour, but drift over five days without scans."""
    pose = simulate_poses(10, 60, outlier_share=0.0)
    pose[30:, 0] += STEP_RAD
    assert len(detect_steps(times(pose), pose, PRIOR_SIGMA)) == 1
    gap_s = np.where(np.arange(60) < 30, 0, 120 * HOUR_S)
    assert detect_steps(times(pose) + gap_s, pose, PRIOR_SIGMA) == []


def test_too_few_scans_give_no_steps():
    pose = simulate_poses(11, 19, outlier_share=0.0)
    pose[10:] += STEP_RAD
    assert detect_steps(times(pose), pose, PRIOR_SIGMA) == []
    assert detect_steps(np.empty(0), np.empty((0, 6)), PRIOR_SIGMA) == []


@pytest.fixture
def kijkduin(shared_data):
    """28 hourly poses of the station at Kijkduin (topo4d, Apache-2.0)."""
    with (shared_data / "kijkduin_topo4d" / "transforms.csv").open() as file:
        rows = list(csv.DictReader(file))
    rotation_rad = (
        np.array([[float(row[k]) for k in ("rx_urad", "ry_urad", "rz_urad")] for row in rows]) * URAD
    )
    shift = np.array([[float(row[k]) for k in ("tx_mm", "ty_mm", "tz_mm")] for row in rows]) * 1e-3
    return np.hstack([rotation_rad, shift])


def test_the_station_at_kijkduin_has_no_step(kijkduin):
    assert detect_steps(times(kijkduin), kijkduin, PRIOR_SIGMA) == []


@pytest.mark.parametrize("first", [17, 18, 19, 21, 22])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_step_of_the_station_at_kijkduin_is_detected(kijkduin, axis, first):
    """0.02°, despite odd-even differences of 58 µrad and three outliers of 250-784 µrad just before it."""
    kijkduin[first:, axis] += STEP_RAD
    (step,) = detect_steps(times(kijkduin), kijkduin, PRIOR_SIGMA)
    assert abs(step.last_before + 1 - first) <= 1
    assert step.detected_at - first <= 5
    assert step.size[axis] == pytest.approx(STEP_RAD, abs=2.5 * step.sigma[axis])
    assert step.sigma[axis] < 0.2 * STEP_RAD
