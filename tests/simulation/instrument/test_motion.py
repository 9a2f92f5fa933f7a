"""The true tilt of the simulated scanner, and the record of its inclination sensor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from station.simulation.instrument.motion import (
    faulty_log,
    line_jitter,
    pose_offset,
    sensor_faults,
    sensor_log,
    sop,
    tilt_axes,
)
from station.simulation.station import Scenario


def single_error(**settings):
    return replace(Scenario().without_errors(), **settings)


def test_mean_tilt_during_the_scan_of_the_sop_is_zero():
    scenario = replace(Scenario(), tilt_drift_deg=0.02)
    during = np.linspace(0, scenario.scan_s, 9001)
    for axis in tilt_axes(scenario):
        assert abs(axis.tilt(during).mean()) < np.radians(1e-9)
        assert np.ptp(axis.tilt(during)) > np.radians(0.003)  # but it varies


def test_components_of_the_tilt_have_their_magnitudes():
    for part, sigma in (("tilt_drift_deg", 0.004), ("tilt_within_scan_deg", 0.002), ("sway_deg", 0.001)):
        sigma_rad = [
            axis.tilt(np.linspace(0, 5e5, 20001)).std()
            for seed in range(5)
            for axis in tilt_axes(single_error(seed=seed, **{part: sigma}))
        ]
        assert np.degrees(np.mean(sigma_rad)) == pytest.approx(sigma, rel=0.05)


def test_pose_offset_is_zero_in_the_first_scan_and_has_its_magnitude_later():
    scenario = Scenario()
    assert pose_offset(scenario, 0).heading_rad == 0
    assert not pose_offset(scenario, 0).position_m.any()
    offsets = [pose_offset(scenario, scan) for scan in range(1, 400)]
    assert np.degrees(np.std([offset.heading_rad for offset in offsets])) == pytest.approx(0.001, rel=0.1)
    assert np.std([offset.position_m for offset in offsets]) == pytest.approx(0.002, rel=0.1)
    jitter = np.degrees(line_jitter(scenario, 3))
    assert jitter.std() == pytest.approx(0.0008, rel=0.05)


def test_log_is_the_tilt_of_the_mount_plus_the_relative_tilt():
    scenario = single_error(tilt_drift_deg=0.01)
    tilt = tilt_axes(scenario)
    log = sensor_log(scenario, 5, tilt, 100.0)
    elapsed_s = log.time_s - 100.0
    np.testing.assert_allclose(
        np.degrees(log.roll_rad), 2.1 + np.degrees(tilt[0].tilt(5 * 3600 + elapsed_s)), atol=1e-9
    )
    np.testing.assert_allclose(
        np.degrees(log.pitch_rad), -1.3 + np.degrees(tilt[1].tilt(5 * 3600 + elapsed_s)), atol=1e-9
    )
    assert elapsed_s[0] < -5
    assert elapsed_s[-1] > scenario.scan_s + 4
    assert np.median(np.diff(elapsed_s)) == pytest.approx(1.0, abs=0.01)


def test_noise_bias_and_clock_of_the_log_have_their_magnitudes():
    scenario = single_error(log_noise_deg=0.008)
    noisy = [sensor_log(scenario, scan, tilt_axes(scenario), 0.0).roll_rad.std() for scan in range(20)]
    assert np.degrees(np.mean(noisy)) == pytest.approx(0.008, rel=0.03)
    faults = [sensor_faults(Scenario(), scan) for scan in range(400)]
    assert np.degrees(np.std([fault.bias_rad for fault in faults])) == pytest.approx(0.0015, rel=0.08)
    clocks = np.array([fault.clock_s for fault in faults])
    assert np.abs(clocks).max() <= 5.0
    assert clocks.std() == pytest.approx(2.0, rel=0.1)


def test_cyclic_error_keeps_its_phase_and_varies_in_amplitude():
    scenario = single_error(log_cyclic_deg=0.04, log_cyclic_change=0.15)
    first, last = np.radians(scenario.azimuth_deg)
    waves = []
    for scan in range(60):
        log = sensor_log(scenario, scan, tilt_axes(scenario), 0.0)
        head = first + (last - first) * np.clip(log.time_s / scenario.scan_s, 0, 1)
        design = np.stack((np.ones_like(head), np.sin(head), np.cos(head)), axis=1)
        (mean, sine, cosine), residual, *_ = np.linalg.lstsq(design, np.degrees(log.roll_rad), rcond=None)
        assert mean == pytest.approx(2.1, abs=1e-9)
        assert residual[0] < 1e-15
        waves.append((np.hypot(sine, cosine), np.arctan2(cosine, sine)))
    amplitude, phase = np.array(waves).T
    assert amplitude.mean() == pytest.approx(0.04, rel=0.06)
    assert amplitude.std() / amplitude.mean() == pytest.approx(0.15, rel=0.3)
    assert np.ptp(phase) < 1e-6


def test_clock_offset_shifts_the_times_of_the_log():
    scenario = single_error(log_clock_s=2.0, log_cyclic_deg=0.04)
    synchronous = replace(scenario, log_clock_s=0.0)
    shifted, expected = (sensor_log(item, 7, tilt_axes(item), 50.0) for item in (scenario, synchronous))
    clock_s = sensor_faults(scenario, 7).clock_s
    assert abs(clock_s) > 0.01
    np.testing.assert_allclose(shifted.time_s - expected.time_s, clock_s, atol=1e-9)
    np.testing.assert_array_equal(shifted.roll_rad, expected.roll_rad)


def test_sop_contains_the_tilt_of_the_mount():
    matrix = sop(single_error(mount_roll_deg=3.0, mount_pitch_deg=0.0, mount_heading_deg=90.0))
    np.testing.assert_allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-15)
    assert np.linalg.det(matrix[:3, :3]) == pytest.approx(1.0)
    np.testing.assert_allclose(matrix[:3, 0], [0, 1, 0], atol=1e-15)  # x to the north
    assert np.degrees(np.arcsin(matrix[2, 1])) == pytest.approx(3.0)  # roll lifts y


def test_daily_wave_and_random_walk_have_their_magnitudes():
    day_s = np.arange(0, 5 * 86_400, 600.0)
    wave = [axis.tilt(day_s) + axis.mean_rad for axis in tilt_axes(single_error(tilt_daily_deg=0.005))]
    for tilt in np.degrees(wave):
        assert np.ptp(tilt) == pytest.approx(0.010, rel=1e-4)
        np.testing.assert_allclose(tilt[:144], tilt[144:288], atol=1e-12)
    walks_deg = np.degrees(
        [
            axis.tilt(day_s) + axis.mean_rad
            for seed in range(150)
            for axis in tilt_axes(single_error(seed=seed, tilt_walk_deg=0.004))
        ]
    )
    assert walks_deg[:, 144].std() == pytest.approx(0.004, rel=0.12)
    assert walks_deg[:, 576].std() == pytest.approx(0.008, rel=0.12)  # after four days twice as much
    assert abs(np.corrcoef(np.diff(walks_deg[:, ::36], axis=1)[:, :2].T)[0, 1]) < 0.2


def test_random_walk_does_not_depend_on_the_length_of_the_series():
    walk = tilt_axes(single_error(tilt_walk_deg=0.004))[0]
    long = walk.tilt(np.arange(0, 1e6, 30.0))
    np.testing.assert_array_equal(walk.tilt(np.arange(0, 1e4, 30.0)), long[:334])
    assert walk.tilt(np.array([-6.0]))[0] == pytest.approx(-walk.mean_rad)


@pytest.mark.integration
def test_heavy_tails_of_the_line_jitter():
    """Student's t with 5 degrees of freedom has kurtosis 9; 2.5 % lie beyond 2.571 · √(3/5) σ."""
    scenario = single_error(line_jitter_deg=0.001, lines=2000)
    jitters = {
        freedom: np.concatenate(
            [line_jitter(replace(scenario, line_jitter_freedom=freedom), scan) for scan in range(200)]
        )
        for freedom in (0.0, 5.0)
    }
    for jitter in jitters.values():
        assert np.degrees(jitter.std()) == pytest.approx(0.001, rel=0.02)
    kurtosis = {freedom: (jitter**4).mean() / jitter.var() ** 2 for freedom, jitter in jitters.items()}
    assert kurtosis[0.0] == pytest.approx(3.0, rel=0.03)
    assert 6.5 < kurtosis[5.0] < 12
    limit = np.radians(0.001) * 2.571 * np.sqrt(3 / 5)
    assert (jitters[5.0] > limit).mean() == pytest.approx(0.025, rel=0.05)


def test_logs_have_the_scenarios_fault_from_its_hour_on():
    scenario = replace(Scenario(), log_fault_hour=3.0)
    tilt = tilt_axes(scenario)
    sound = [sensor_log(scenario, scan, tilt, 50.0) for scan in (2, 3)]
    faulty = {
        fault: [
            faulty_log(replace(scenario, log_fault=fault), scan, log)
            for scan, log in zip((2, 3), sound, strict=True)
        ]
        for fault in ("cut", "missing", "time", "swapped", "flipped")
    }
    assert all(before is sound[0] for before, _ in faulty.values())
    assert faulty["missing"][1] is None
    cut, wrong, swapped, flipped = (faulty[name][1] for name in ("cut", "time", "swapped", "flipped"))
    assert 0.25 < (cut.time_s[-1] - 50.0) / scenario.scan_s < 0.75
    np.testing.assert_array_equal(cut.roll_rad, sound[1].roll_rad[: len(cut.roll_rad)])
    late_s = wrong.time_s - sound[1].time_s
    assert np.sort(late_s)[-2:].tolist() == [0.0, pytest.approx(3600.0)]
    np.testing.assert_array_equal(swapped.roll_rad, sound[1].pitch_rad)
    np.testing.assert_array_equal(swapped.pitch_rad, sound[1].roll_rad)
    assert np.degrees(flipped.pitch_rad.mean()) == pytest.approx(1.3, abs=0.05)  # the mount's is -1.3°
    np.testing.assert_array_equal(flipped.roll_rad, sound[1].roll_rad)
