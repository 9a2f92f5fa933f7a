"""Errors that no estimator models: gusts, steps, wobble, refraction patches, fog, a displaced scanner."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from station.simulation.instrument.disturbances import gusty_sway
from station.simulation.instrument.motion import line_jitter, pose_offset, sensor_log, tilt_axes
from station.simulation.instrument.scan import simulate_scan
from station.simulation.scenario import ERRORS
from station.simulation.station import Scenario, Station, named, small
from station.simulation.world.air import air_of_scan, fog_visibility_m
from station.simulation.world.terrain import NodeField

HOURS = 6


def single_error(**settings):
    return replace(Scenario().without_errors(), hours=HOURS, **settings)


def test_wind_sways_the_mount_in_gusts_only():
    time_s = np.arange(0, HOURS * 3600, 0.25)
    axes = tilt_axes(single_error(wind_sway_deg=0.002))
    tilt_deg = np.degrees([axis.tilt(time_s) + axis.mean_rad for axis in axes])
    calm = (tilt_deg == 0).all(axis=0)
    edges = np.flatnonzero(np.diff(np.concatenate(([1], calm, [1]))))
    duration_s = (edges[1::2] - edges[::2]) * 0.25
    assert len(duration_s) > 60
    assert duration_s.min() > 19
    assert duration_s.max() < 121
    assert 0.4 < calm.mean() < 0.75
    assert tilt_deg[:, ~calm].std() == pytest.approx(0.002, rel=0.1)
    gust = tilt_deg[0, edges[0] : edges[1]]
    spectrum = np.abs(np.fft.rfft(gust)) ** 2
    per_s = np.fft.rfftfreq(len(gust), 0.25)
    assert spectrum[(per_s > 1 / 14) & (per_s < 1 / 1.4)].sum() > 0.95 * spectrum.sum()


def test_gusts_do_not_depend_on_the_order_of_evaluation():
    gusts = gusty_sway(3, 0, 1e-5)
    time_s = np.random.default_rng(1).uniform(-6, 3 * 3600, 500)
    singly = [gusts(np.array([moment]))[0] for moment in time_s]
    np.testing.assert_allclose(gusts(time_s), singly, atol=1e-18)


@pytest.mark.integration
def test_steps_have_their_rate_and_magnitude_and_decay():
    scenario = single_error(tilt_jerk_deg=0.002)
    time_s = np.arange(0, 60 * 3600, 0.5)
    tilt_deg = np.degrees([axis.tilt(time_s) + axis.mean_rad for axis in tilt_axes(scenario)])
    step_deg = np.abs(np.diff(tilt_deg, axis=1))
    sudden = (step_deg > 2e-4).any(axis=0)  # no decay is as large in half a second
    scans = 60 * 3600 / scenario.scan_s
    assert sudden.sum() / scans == pytest.approx(2.0, rel=0.1)
    jumps = np.diff(tilt_deg, axis=1)[:, sudden]
    assert jumps.std() == pytest.approx(0.002, rel=0.1)
    isolated = np.flatnonzero(sudden)
    isolated = isolated[:-1][np.diff(isolated) > 1600]  # 800 s without another step
    assert len(isolated) > 15
    at_step, later = (np.abs(tilt_deg[:, isolated + after]).max(axis=0) for after in (1, 1600))
    assert np.median(later / at_step) < 0.02


def test_mirror_wobble_has_a_period_of_7_lines_and_a_varying_amplitude():
    jitter = np.degrees([line_jitter(single_error(mirror_wobble_deg=0.0005), scan) for scan in range(20)])
    assert jitter.std() == pytest.approx(0.0005, rel=0.1)
    spectrum = (np.abs(np.fft.rfft(jitter, axis=1)) ** 2).mean(axis=0)
    period = 1 / np.fft.rfftfreq(jitter.shape[1], 1.0)[1:]
    near = np.abs(period - 7.3) < 0.5
    assert spectrum[1:][near].sum() > 0.95 * spectrum.sum()
    blocks = jitter[0][:2628].reshape(-1, 73).std(axis=1)  # ten waves each
    assert blocks.max() > 1.3 * blocks.min()
    assert np.corrcoef(blocks[1:], blocks[:-1])[0, 1] > 0.5  # slowly
    assert not np.allclose(jitter[0], jitter[1])


def test_refraction_patches_have_sharp_edges_and_differ_between_scans():
    scenario = replace(single_error(refraction_patch_sigma=0.03), air=True)
    bearing_deg = np.arange(5.0, 350.0, 0.05)
    coefficient = np.array(
        [air_of_scan(scenario, scan).coefficient_at(np.radians(bearing_deg)) for scan in range(30)]
    )
    coefficient -= [[air_of_scan(scenario, scan).coefficient] for scan in range(30)]
    assert coefficient.std() == pytest.approx(0.03, rel=0.1)
    for row in coefficient:
        flat = np.abs(np.diff(row)) < 1e-12
        ends = np.flatnonzero(np.diff(flat.astype(int)))
        width_deg = np.diff(ends) * 0.05
        patches, edges = (width_deg[width_deg > 1], width_deg[width_deg < 1])
        assert edges.max() < 0.4
        assert patches.min() > 2.6
        assert patches.max() < 10
    correlation = np.corrcoef(coefficient)
    assert np.abs(correlation - np.eye(30)).mean() < 0.25


def bowl(radius_m):
    """Return ground that rises in all directions and thus faces the scanner at every distance."""
    axis = np.arange(-radius_m, radius_m + 1, 10.0)
    distance_m = np.hypot(axis[None, :], axis[:, None])
    return NodeField(-radius_m, -radius_m, 10.0, -500 + 0.1 * distance_m)


def test_fog_limits_the_range():
    """Koschmieder: at half the visibility 1/50 of the light returns, at the visibility 1/2500."""
    scenario = single_error(
        azimuth_deg=(160.0, 170.0), elevation_deg=(-40.0, -1.0), lines=60, shots_per_line=800
    )
    scenario = replace(scenario, range_noise_m=0.01, incidence_max_deg=88.0)
    ground = bowl(4000.0)
    station = Station(scenario)
    clear = station.conditions(1)

    def ranges_m(visibility):
        scan = simulate_scan(
            scenario,
            ground,
            ground.with_nodes(np.ones_like(ground.node)),
            replace(clear, visibility_m=visibility),
        )
        return np.linalg.norm(scan.true_m - scenario.mount_position_m, axis=1)

    spans = [600, 900, 1200, 1800, 2500, 3500]
    in_clear_air, in_haze, in_fog = (
        np.histogram(ranges_m(visibility), spans)[0] for visibility in (np.inf, 1500.0, 400.0)
    )
    assert in_clear_air.min() > 500
    assert (np.abs(np.histogram(ranges_m(1e7), spans)[0] / in_clear_air - 1) < 0.01).all()
    assert in_haze[0] > 0.98 * in_clear_air[0]
    assert (in_haze[3:] == 0).all()
    assert (np.diff(in_haze / in_clear_air) <= 0).all()
    assert (in_fog <= in_haze).all()
    assert in_fog[0] < 0.02 * in_clear_air[0]


@pytest.mark.integration
def test_fog_occurs_in_its_hours_only():
    scenario = replace(small(hours=9), fog_visibility_m=200.0, fog_hours=(3.0, 6.0))
    visibility = [fog_visibility_m(scenario, scan) for scan in range(9)]
    assert visibility == [np.inf] * 3 + [200.0] * 3 + [np.inf] * 3
    station = Station(scenario)
    foggy, clear = station.scan(4), station.scan(2)
    assert 0 < len(foggy.x_m) < 0.7 * len(clear.x_m)
    without = Station(small(hours=9)).scan(2)
    np.testing.assert_array_equal(clear.x_m, without.x_m)
    near = np.linalg.norm(without.true_m, axis=1) < 80
    assert (np.linalg.norm(foggy.true_m, axis=1) < 80).sum() > 0.9 * near.sum()


def level_mount(**settings):
    return single_error(mount_roll_deg=0.0, mount_pitch_deg=0.0, mount_heading_deg=0.0, **settings)


def test_displacement_is_permanent_and_tilts_rotates_and_shifts():
    """The slope of a level plane in the scanner's frame is the tilt of the scanner."""
    scenario = level_mount(moved_hour=3.0, moved_deg=0.02, moved_m=0.005)
    scenario = replace(
        scenario, azimuth_deg=(0.0, 360.0), elevation_deg=(-40.0, -15.0), lines=90, shots_per_line=60
    )
    axis = np.arange(-3000.0, 3001.0, 50.0)
    ground = NodeField(-3000.0, -3000.0, 50.0, np.full((len(axis), len(axis)), -500.0))
    tilts = []
    for scan in range(HOURS):
        points = simulate_scan(
            scenario, ground, ground.with_nodes(0 * ground.node), Station(scenario).conditions(scan)
        )
        design = np.stack((np.ones_like(points.x_m), points.x_m, points.y_m), axis=1)
        tilts.append(np.degrees(np.linalg.lstsq(design, points.z_m, rcond=None)[0][1:]))
    tilts = np.array(tilts)
    assert np.abs(tilts[:3]).max() < 1e-6
    np.testing.assert_allclose(np.linalg.norm(tilts[3:], axis=1), 0.02, rtol=1e-3)
    np.testing.assert_allclose(tilts[3:], tilts[[3, 3, 3]], atol=1e-6)
    after = pose_offset(scenario, 4)
    assert pose_offset(scenario, 2).heading_rad == 0
    assert abs(np.degrees(after.heading_rad)) == pytest.approx(0.01)
    assert np.linalg.norm(after.position_m) == pytest.approx(0.005)
    np.testing.assert_array_equal(pose_offset(scenario, 5).position_m, after.position_m)


def test_sensor_records_the_displacement():
    scenario = single_error(moved_hour=3.0, moved_deg=0.02)
    tilt = tilt_axes(scenario)
    logs = [sensor_log(scenario, scan, tilt, 0.0) for scan in (2, 3)]
    begin = logs[1].time_s > 0
    change = [
        np.degrees(getattr(logs[1], name)[begin].mean() - getattr(logs[0], name).mean())
        for name in ("roll_rad", "pitch_rad")
    ]
    assert np.hypot(*change) == pytest.approx(0.02, rel=1e-6)
    directions = [
        np.arctan2(
            *(axis.tilt(np.array([4 * 3600.0]))[0] for axis in tilt_axes(replace(scenario, seed=seed)))
        )
        for seed in range(40)
    ]
    assert np.ptp(directions) > 5  # any direction


@pytest.mark.integration
def test_truth_contains_the_disturbances():
    scenario = replace(
        small(hours=4),
        fog_visibility_m=300.0,
        fog_hours=(1.0, 2.0),
        moved_hour=2.0,
        moved_deg=0.5,
        wind_sway_deg=0.002,
        tilt_jerk_deg=0.002,
        mirror_wobble_deg=0.001,
        refraction_patch_sigma=0.05,
        terrain_step_m=4.0,
    )
    station = Station(scenario)
    truth = station.truth()
    assert truth.fog_visibility.to_numpy().tolist() == [np.inf, 300.0, np.inf, np.inf]
    assert truth.moved.to_numpy().tolist() == [0, 0, 1, 1]
    tilt = np.hypot(truth.relative_roll, truth.relative_pitch).mean("into_scan").to_numpy()
    np.testing.assert_allclose(tilt, [0, 0, 0.5, 0.5], atol=0.03)
    np.testing.assert_allclose(truth.line_jitter[1], np.degrees(line_jitter(scenario, 1)))
    coefficient = truth.refraction.to_numpy()
    assert np.diff(truth.bearing).max() <= 0.3
    assert np.abs(np.diff(coefficient, axis=1)).max() > 0.02  # the edge of a patch
    assert truth.stable_polygons.dtype == np.int8


def test_disturbances_are_off_by_default_and_without_errors():
    disturbances = {
        "wind_sway_deg": 0.002,
        "tilt_jerk_deg": 0.002,
        "mirror_wobble_deg": 0.0005,
        "refraction_patch_sigma": 0.03,
        "fog_visibility_m": 300.0,
        "moved_hour": 1.0,
        "moved_deg": 0.02,
        "moved_m": 0.005,
    }
    assert set(disturbances) <= set(ERRORS)
    scenario = replace(small(hours=2), **disturbances).without_errors()
    assert scenario == small(hours=2).without_errors()
    assert not any(getattr(small(), name) for name in disturbances)
    assert not any(getattr(named("quiet"), name) for name in disturbances)
