"""The true lean and what the simulated sensor writes of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from station.simulation.motion import axes, line_jitter, moves, sensor_faults, sensor_log, sop
from station.simulation.station import Scenario


def quiet(**more):
    return replace(Scenario().without_errors(), **more)


def test_lean_is_zero_on_average_over_the_scan_of_the_sop():
    scenario = replace(Scenario(), lean_drift_deg=0.02)
    during = np.linspace(0, scenario.scan_s, 9001)
    for axis in axes(scenario):
        assert abs(axis.lean(during).mean()) < np.radians(1e-9)
        assert np.ptp(axis.lean(during)) > np.radians(0.003)  # yet it moves within it


def test_parts_of_the_lean_have_their_magnitudes():
    for part, sigma in (("lean_drift_deg", 0.004), ("lean_within_scan_deg", 0.002), ("sway_deg", 0.001)):
        found = [
            axis.lean(np.linspace(0, 5e5, 20001)).std()
            for seed in range(5)
            for axis in axes(quiet(seed=seed, **{part: sigma}))
        ]
        assert np.degrees(np.mean(found)) == pytest.approx(sigma, rel=0.05)


def test_first_scan_stands_where_the_sop_says():
    scenario = Scenario()
    assert moves(scenario, 0).heading_rad == 0
    assert not moves(scenario, 0).position_m.any()
    later = [moves(scenario, scan) for scan in range(1, 400)]
    assert np.degrees(np.std([one.heading_rad for one in later])) == pytest.approx(0.001, rel=0.1)
    assert np.std([one.position_m for one in later]) == pytest.approx(0.002, rel=0.1)
    jitter = np.degrees(line_jitter(scenario, 3))
    assert jitter.std() == pytest.approx(0.0008, rel=0.05)


def test_log_is_the_mounts_lean_plus_the_relative_lean():
    scenario = quiet(lean_drift_deg=0.01)
    lean = axes(scenario)
    log = sensor_log(scenario, 5, lean, 100.0)
    into = log.time_s - 100.0
    np.testing.assert_allclose(
        np.degrees(log.roll_rad), 2.1 + np.degrees(lean[0].lean(5 * 3600 + into)), atol=1e-9
    )
    np.testing.assert_allclose(
        np.degrees(log.pitch_rad), -1.3 + np.degrees(lean[1].lean(5 * 3600 + into)), atol=1e-9
    )
    assert into[0] < -5
    assert into[-1] > scenario.scan_s + 4
    assert np.median(np.diff(into)) == pytest.approx(1.0, abs=0.01)


def test_log_noise_and_bias_have_their_size():
    scenario = quiet(log_noise_deg=0.008)
    noisy = [sensor_log(scenario, scan, axes(scenario), 0.0).roll_rad.std() for scan in range(20)]
    assert np.degrees(np.mean(noisy)) == pytest.approx(0.008, rel=0.03)
    faults = [sensor_faults(Scenario(), scan) for scan in range(400)]
    assert np.degrees(np.std([one.bias_rad for one in faults])) == pytest.approx(0.0015, rel=0.08)
    clocks = np.array([one.clock_s for one in faults])
    assert np.abs(clocks).max() <= 5.0
    assert clocks.std() == pytest.approx(2.0, rel=0.1)


def test_the_wave_over_one_turn_keeps_its_phase_and_changes_its_height():
    scenario = quiet(log_cyclic_deg=0.04, log_cyclic_change=0.15)
    first, last = np.radians(scenario.azimuth_deg)
    heights = []
    for scan in range(60):
        log = sensor_log(scenario, scan, axes(scenario), 0.0)
        head = first + (last - first) * np.clip(log.time_s / scenario.scan_s, 0, 1)
        design = np.stack((np.ones_like(head), np.sin(head), np.cos(head)), axis=1)
        (mean, sine, cosine), residual, *_ = np.linalg.lstsq(design, np.degrees(log.roll_rad), rcond=None)
        assert mean == pytest.approx(2.1, abs=1e-9)
        assert residual[0] < 1e-15
        heights.append((np.hypot(sine, cosine), np.arctan2(cosine, sine)))
    height, phase = np.array(heights).T
    assert height.mean() == pytest.approx(0.04, rel=0.06)
    assert height.std() / height.mean() == pytest.approx(0.15, rel=0.3)
    assert np.ptp(phase) < 1e-6


def test_clock_of_the_log_runs_ahead_by_the_told_offset():
    scenario = quiet(log_clock_s=2.0, log_cyclic_deg=0.04)
    still = replace(scenario, log_clock_s=0.0)
    shifted, right = (sensor_log(one, 7, axes(one), 50.0) for one in (scenario, still))
    ahead = sensor_faults(scenario, 7).clock_s
    assert abs(ahead) > 0.01
    np.testing.assert_allclose(shifted.time_s - right.time_s, ahead, atol=1e-9)
    np.testing.assert_array_equal(shifted.roll_rad, right.roll_rad)


def test_sop_holds_the_lean_of_the_mount():
    matrix = sop(quiet(mount_roll_deg=3.0, mount_pitch_deg=0.0, mount_heading_deg=90.0))
    np.testing.assert_allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-15)
    assert np.linalg.det(matrix[:3, :3]) == pytest.approx(1.0)
    np.testing.assert_allclose(matrix[:3, 0], [0, 1, 0], atol=1e-15)  # x to the north
    assert np.degrees(np.arcsin(matrix[2, 1])) == pytest.approx(3.0)  # roll lifts y
