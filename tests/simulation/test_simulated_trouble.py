"""Errors that no estimator expects: gusts, jerks, wobble, patches, fog, a scanner that was moved."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from station.simulation.air import air_of_scan, visibility_m
from station.simulation.motion import axes, line_jitter, moves, sensor_log
from station.simulation.scan import record
from station.simulation.scenario import ERRORS
from station.simulation.shakes import gusty_sway
from station.simulation.station import Scenario, Station, named, tiny
from station.simulation.terrain import Heights

HOURS = 6


def quiet(**more):
    return replace(Scenario().without_errors(), hours=HOURS, **more)


def test_wind_sways_the_mount_in_gusts_and_not_between_them():
    time_s = np.arange(0, HOURS * 3600, 0.25)
    both = np.degrees([axis.lean(time_s) + axis.zero_rad for axis in axes(quiet(wind_sway_deg=0.002))])
    calm = (both == 0).all(axis=0)
    edges = np.flatnonzero(np.diff(np.concatenate(([1], calm, [1]))))
    lasting_s = (edges[1::2] - edges[::2]) * 0.25
    assert len(lasting_s) > 60
    assert lasting_s.min() > 19
    assert lasting_s.max() < 121
    assert 0.4 < calm.mean() < 0.75
    assert both[:, ~calm].std() == pytest.approx(0.002, rel=0.1)
    gust = both[0, edges[0] : edges[1]]
    spectrum = np.abs(np.fft.rfft(gust)) ** 2
    per_s = np.fft.rfftfreq(len(gust), 0.25)
    assert spectrum[(per_s > 1 / 14) & (per_s < 1 / 1.4)].sum() > 0.95 * spectrum.sum()


def test_gusts_do_not_depend_on_how_they_are_asked():
    gusts = gusty_sway(3, 0, 1e-5)
    time_s = np.random.default_rng(1).uniform(-6, 3 * 3600, 500)
    one_by_one = [gusts(np.array([moment]))[0] for moment in time_s]
    np.testing.assert_allclose(gusts(time_s), one_by_one, atol=1e-18)


def test_jerks_are_sudden_as_many_as_told_and_fade():
    scenario = quiet(lean_jerk_deg=0.002)
    time_s = np.arange(0, 60 * 3600, 0.5)
    lean = np.degrees([axis.lean(time_s) + axis.zero_rad for axis in axes(scenario)])
    up = np.abs(np.diff(lean, axis=1))
    sudden = (up > 2e-4).any(axis=0)  # nothing that fades does so by as much in half a second
    scans = 60 * 3600 / scenario.scan_s
    assert sudden.sum() / scans == pytest.approx(2.0, rel=0.1)
    jumps = np.diff(lean, axis=1)[:, sudden]
    assert jumps.std() == pytest.approx(0.002, rel=0.1)
    alone = np.flatnonzero(sudden)
    alone = alone[:-1][np.diff(alone) > 1600]  # 800 s without another
    assert len(alone) > 15
    left = np.abs(lean[:, alone + 1600]).max(axis=0) / np.abs(lean[:, alone + 1]).max(axis=0)
    assert np.median(left) < 0.02


def test_the_mirrors_wobble_comes_back_every_seven_lines():
    jitter = np.degrees([line_jitter(quiet(mirror_wobble_deg=0.0005), scan) for scan in range(20)])
    assert jitter.std() == pytest.approx(0.0005, rel=0.1)
    spectrum = (np.abs(np.fft.rfft(jitter, axis=1)) ** 2).mean(axis=0)
    period = 1 / np.fft.rfftfreq(jitter.shape[1], 1.0)[1:]
    near = np.abs(period - 7.3) < 0.5
    assert spectrum[1:][near].sum() > 0.95 * spectrum.sum()
    blocks = jitter[0][:2628].reshape(-1, 73).std(axis=1)  # ten waves each
    assert blocks.max() > 1.3 * blocks.min()
    assert np.corrcoef(blocks[1:], blocks[:-1])[0, 1] > 0.5  # slowly
    assert not np.allclose(jitter[0], jitter[1])


def test_refraction_has_patches_with_edges_other_ones_in_every_scan():
    scenario = replace(quiet(refraction_patch_sigma=0.03), air=True)
    bearing_deg = np.arange(5.0, 350.0, 0.05)
    bend = np.array(
        [air_of_scan(scenario, scan).coefficient_at(np.radians(bearing_deg)) for scan in range(30)]
    )
    bend -= [[air_of_scan(scenario, scan).coefficient] for scan in range(30)]
    assert bend.std() == pytest.approx(0.03, rel=0.1)
    for one in bend:
        flat = np.abs(np.diff(one)) < 1e-12
        ends = np.flatnonzero(np.diff(flat.astype(int)))
        lasting_deg = np.diff(ends) * 0.05
        patches, edges = (lasting_deg[lasting_deg > 1], lasting_deg[lasting_deg < 1])
        assert edges.max() < 0.4
        assert patches.min() > 2.6
        assert patches.max() < 10
    together = np.corrcoef(bend)
    assert np.abs(together - np.eye(30)).mean() < 0.25


def bowl(radius_m):
    """Build a floor that rises from 500 m below to a wall, which faces the scanner at every distance."""
    axis = np.arange(-radius_m, radius_m + 1, 10.0)
    away = np.hypot(axis[None, :], axis[:, None])
    return Heights(-radius_m, -radius_m, 10.0, -500 + 0.1 * away)


def test_fog_swallows_what_is_far():
    """Koschmieder: at V/2 the light that comes back is 1/50, at V 1/2500 of that in clear air."""
    scenario = quiet(azimuth_deg=(160.0, 170.0), elevation_deg=(-40.0, -1.0), lines=60, shots_per_line=800)
    scenario = replace(scenario, range_noise_m=0.01, incidence_max_deg=88.0)
    ground = bowl(4000.0)
    station = Station(scenario)
    clear = station.conditions(1)

    def ranges_m(visibility):
        got = record(
            scenario, ground, ground.over(np.ones_like(ground.node)), replace(clear, visibility_m=visibility)
        )
        return np.linalg.norm(got.true_m - scenario.mount_position_m, axis=1)

    spans = [600, 900, 1200, 1800, 2500, 3500]
    everywhere, hazy, thick = (np.histogram(ranges_m(one), spans)[0] for one in (np.inf, 1500.0, 400.0))
    assert everywhere.min() > 500
    assert (np.abs(np.histogram(ranges_m(1e7), spans)[0] / everywhere - 1) < 0.01).all()
    assert hazy[0] > 0.98 * everywhere[0]
    assert (hazy[3:] == 0).all()
    assert (np.diff(hazy / everywhere) <= 0).all()
    assert (thick <= hazy).all()
    assert thick[0] < 0.02 * everywhere[0]


def test_fog_lies_only_in_its_hours():
    scenario = replace(tiny(hours=9), fog_visibility_m=200.0, fog_hours=(3.0, 6.0))
    seen = [visibility_m(scenario, scan) for scan in range(9)]
    assert seen == [np.inf] * 3 + [200.0] * 3 + [np.inf] * 3
    station = Station(scenario)
    thick, clear = station.scan(4), station.scan(2)
    assert 0 < len(thick.x_m) < 0.7 * len(clear.x_m)
    without = Station(tiny(hours=9)).scan(2)
    np.testing.assert_array_equal(clear.x_m, without.x_m)
    near = np.linalg.norm(without.true_m, axis=1) < 80
    assert (np.linalg.norm(thick.true_m, axis=1) < 80).sum() > 0.9 * near.sum()


def flat_scanner(**more):
    return quiet(mount_roll_deg=0.0, mount_pitch_deg=0.0, mount_heading_deg=0.0, **more)


def test_a_moved_scanner_tilts_turns_and_shifts_for_good():
    """A level scanner sees a level plain tilt: its plane's slope is the tilt, seen in world directions."""
    scenario = flat_scanner(moved_hour=3.0, moved_deg=0.02, moved_m=0.005)
    scenario = replace(
        scenario, azimuth_deg=(0.0, 360.0), elevation_deg=(-40.0, -15.0), lines=90, shots_per_line=60
    )
    axis = np.arange(-3000.0, 3001.0, 50.0)
    ground = Heights(-3000.0, -3000.0, 50.0, np.full((len(axis), len(axis)), -500.0))
    tilts = []
    for scan in range(HOURS):
        got = record(scenario, ground, ground.over(0 * ground.node), Station(scenario).conditions(scan))
        design = np.stack((np.ones_like(got.x_m), got.x_m, got.y_m), axis=1)
        tilts.append(np.degrees(np.linalg.lstsq(design, got.z_m, rcond=None)[0][1:]))
    tilts = np.array(tilts)
    assert np.abs(tilts[:3]).max() < 1e-6
    np.testing.assert_allclose(np.linalg.norm(tilts[3:], axis=1), 0.02, rtol=1e-3)
    np.testing.assert_allclose(tilts[3:], tilts[[3, 3, 3]], atol=1e-6)
    after = moves(scenario, 4)
    assert moves(scenario, 2).heading_rad == 0
    assert abs(np.degrees(after.heading_rad)) == pytest.approx(0.01)
    assert np.linalg.norm(after.position_m) == pytest.approx(0.005)
    np.testing.assert_array_equal(moves(scenario, 5).position_m, after.position_m)


def test_the_sensor_sees_the_scanner_being_moved():
    scenario = quiet(moved_hour=3.0, moved_deg=0.02)
    lean = axes(scenario)
    logs = [sensor_log(scenario, scan, lean, 0.0) for scan in (2, 3)]
    begin = logs[1].time_s > 0
    change = [
        np.degrees(getattr(logs[1], name)[begin].mean() - getattr(logs[0], name).mean())
        for name in ("roll_rad", "pitch_rad")
    ]
    assert np.hypot(*change) == pytest.approx(0.02, rel=1e-6)
    directions = [
        np.arctan2(*(axis.lean(np.array([4 * 3600.0]))[0] for axis in axes(replace(scenario, seed=seed))))
        for seed in range(40)
    ]
    assert np.ptp(directions) > 5  # any direction


def test_truth_tells_of_all_that_is_new():
    scenario = replace(
        tiny(hours=4),
        fog_visibility_m=300.0,
        fog_hours=(1.0, 2.0),
        moved_hour=2.0,
        moved_deg=0.5,
        wind_sway_deg=0.002,
        lean_jerk_deg=0.002,
        mirror_wobble_deg=0.001,
        refraction_patch_sigma=0.05,
        terrain_step_m=4.0,
    )
    station = Station(scenario)
    told = station.truth()
    assert told.fog_visibility.to_numpy().tolist() == [np.inf, 300.0, np.inf, np.inf]
    assert told.moved.to_numpy().tolist() == [0, 0, 1, 1]
    tilt = np.hypot(told.relative_roll, told.relative_pitch).mean("into_scan").to_numpy()
    np.testing.assert_allclose(tilt, [0, 0, 0.5, 0.5], atol=0.03)
    np.testing.assert_allclose(told.line_jitter[1], np.degrees(line_jitter(scenario, 1)))
    bend = told.refraction.to_numpy()
    assert np.diff(told.bearing).max() <= 0.3
    assert np.abs(np.diff(bend, axis=1)).max() > 0.02  # a patch's edge
    assert told.stable_polygons.dtype == np.int8


def test_nothing_new_is_left_without_errors():
    new = {
        "wind_sway_deg": 0.002,
        "lean_jerk_deg": 0.002,
        "mirror_wobble_deg": 0.0005,
        "refraction_patch_sigma": 0.03,
        "fog_visibility_m": 300.0,
        "moved_hour": 1.0,
        "moved_deg": 0.02,
        "moved_m": 0.005,
    }
    assert set(new) <= set(ERRORS)
    told = replace(tiny(hours=2), **new).without_errors()
    assert told == tiny(hours=2).without_errors()
    assert not any(getattr(tiny(), name) for name in new)
    assert not any(getattr(named("quiet"), name) for name in new)
