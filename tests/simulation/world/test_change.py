"""Slow change of moving and of stable ground, and what months do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from station.simulation.instrument.motion import pose_offset, tilt_axes
from station.simulation.scenario import Deposit
from station.simulation.station import Scenario, Station, small
from station.simulation.world.change import ground_at, surface_changes
from station.simulation.world.terrain import NodeField, Valley


def slope_valley(slope, size=1.0, ice=0.0):
    """Return rock that falls evenly to the north, 3.6 km square, the scanner in its middle."""
    axis = np.arange(-1800.0, 1801.0, 20.0)
    node = np.tile(-slope * axis[:, None], len(axis))
    return Valley(
        NodeField(-1800.0, -1800.0, 20.0, node), NodeField(-1800.0, -1800.0, 20.0, node * 0 + ice), size
    )


def test_ice_settles_in_proportion_to_its_distance():
    scenario = replace(Scenario().without_errors(), settling_m_per_h=0.004, settling_from_hour=2.0)
    (settling,) = surface_changes(scenario, slope_valley(0.1, ice=1.0))
    amount = settling.amount(12.0)
    assert settling.amount(1.9) == 0
    for distance_m in (500.0, 1500.0):
        lowered_m = amount * settling.pattern.at(np.array([distance_m]), np.array([0.0]))[0]
        assert lowered_m == pytest.approx(-0.04 * distance_m / 3000, rel=1e-3)  # 4 mm/h at 3 km for 10 h
    quiet = replace(small(hours=4), melt_m_per_h=0.0, avalanche_m=0.0, terrain_step_m=4.0, cell_m=10.0)
    station = Station(replace(quiet, settling_m_per_h=0.004))
    assert station.stable  # rock does not settle
    change_m = station.surface.change_m(station.changes, 3.0)
    assert np.abs(change_m[station.surface.ice < 1e-4]).max() == 0
    assert -0.018 < change_m.min() < -0.012  # the far end of the ice, at 4 km of the valley's full size


def test_a_deposit_has_its_volume_from_its_hour_on_and_lies_on_ground_known_to_be_stable():
    deposit = Deposit(2.5, east_m=61.3, north_m=-47.2, area_m2=5000.0, depth_m=0.3)
    (debris,) = surface_changes(replace(Scenario().without_errors(), deposits=(deposit,)), slope_valley(0.1))
    assert [debris.amount(hour) for hour in (2.4, 2.5, 9.0)] == [0, 0.3, 0.3]
    assert debris.pattern.node.sum() * 20.0**2 == pytest.approx(5000.0, rel=0.02)
    assert debris.pattern.at(np.array([61.3]), np.array([-47.2]))[0] == pytest.approx(1.0, abs=0.01)
    quiet = replace(small(hours=4), melt_m_per_h=0.0, avalanche_m=0.0, terrain_step_m=4.0, cell_m=10.0)
    stable = Station(quiet).stable
    assert Station(replace(quiet, deposits=(deposit,))).stable == stable


def test_melt_by_day_follows_the_sun_and_is_as_much_in_a_day():
    scenario = replace(Scenario().without_errors(), melt_m_per_h=0.01, melt_from_hour=8.0)
    steady, daily = (
        surface_changes(replace(scenario, melt_by_day=by_day), slope_valley(0.1, ice=1.0))[0].amount
        for by_day in (False, True)
    )
    assert daily(32.0) == pytest.approx(steady(32.0)) == pytest.approx(0.24)
    assert daily(18.0) == daily(30.0)  # not by night
    noon = daily(12.5) - daily(11.5)
    assert noon == pytest.approx(np.pi * 0.01, rel=0.01)  # a sine over half of the day


def test_an_edge_of_melt_climbs():
    scenario = replace(Scenario().without_errors(), hours=8, thaw_m=0.3, thaw_from_hour=2.0)
    valley = slope_valley(0.5, ice=1.0)
    height_m = valley.ground.node - valley.ground.node.min()
    changes = surface_changes(scenario, valley)
    for hours in (2.0, 4.5, 7.0):
        change_m = ground_at(valley, changes, hours).node - valley.ground.node
        edge_m = 30.0 * (hours - 2.0)
        assert change_m[height_m < edge_m - 30] == pytest.approx(-0.3)
        assert np.abs(change_m[height_m > edge_m + 30]).max() == 0


def test_months_bring_snow_with_drifts_or_take_ice_and_move_the_scanner():
    scenario = replace(
        small(hours=4), avalanche_m=0.0, melt_m_per_h=0.0, season_hour=2.0, season_deg=0.05, winter_m=2.0,
        summer_melt_m=3.0,
    )  # fmt: skip
    station = Station(scenario)
    winter, summer = station.changes
    ground = station.valley.ground
    down, across = np.gradient(ground.node, ground.step_m)
    gentle = np.hypot(down, across) < np.tan(np.radians(38))
    steep = np.hypot(down, across) > np.tan(np.radians(51))
    for change, size in ((winter, 2.0), (summer, 3.0)):
        assert [change.amount(station.scenario.hours_at(scan)) for scan in range(4)] == [0, 0, size, size]
    depth_m = 2.0 * winter.pattern.node
    assert depth_m[gentle].mean() == pytest.approx(2.0, rel=0.05)
    assert depth_m[gentle].std() == pytest.approx(1.0, rel=0.15)
    assert np.abs(depth_m[steep]).max() == 0
    assert summer.pattern.node.min() * 3.0 == pytest.approx(-3.0, abs=0.2)
    assert summer.pattern.node.max() == 0
    moved_rad = [axis.tilt(np.array([7199.0, 7201.0])) for axis in tilt_axes(scenario.without_errors())]
    assert np.ptp(moved_rad, axis=1).max() == 0
    quiet = replace(scenario.without_errors(), season_deg=0.05)
    moved_deg = np.degrees([np.diff(axis.tilt(np.array([7199.0, 7201.0])))[0] for axis in tilt_axes(quiet)])
    assert np.hypot(*moved_deg) == pytest.approx(0.05, abs=1e-9)
    assert pose_offset(quiet, 1).heading_rad == 0
    assert abs(np.degrees(pose_offset(quiet, 2).heading_rad)) == pytest.approx(0.05)


def test_rock_heaves_by_its_magnitude_over_hundreds_of_metres():
    scenario = replace(Scenario().without_errors(), heave_m=0.003, hours=48)
    changes = surface_changes(scenario, slope_valley(0.1))
    scans = np.array(
        [
            sum(change.amount(scan + 0.1) * change.pattern.node[::3, ::3] for change in changes)
            for scan in range(48)
        ]
    )
    assert scans.std() == pytest.approx(0.003, rel=0.12)
    daily = scans - np.roll(scans, 24, axis=0)  # takes the wave off, doubles the variance of the rest
    assert daily.std() == pytest.approx(0.003, rel=0.15)
    field = scans[5] - scans[5].mean()
    near = (field[:, 1:] * field[:, :-1]).mean() / field.var()  # 60 m apart
    far = (field[:, 10:] * field[:, :-10]).mean() / field.var()  # 600 m
    assert near > 0.6
    assert abs(far) < 0.4
    ice = surface_changes(scenario, slope_valley(0.1, ice=1.0))
    assert max(np.abs(change.pattern.node).max() for change in ice) == 0


def test_creep_lowers_a_plane_by_its_steeper_dip():
    """A displacement d that dips 15° more than a slope α lowers the plane by d · sin 15° / cos α."""
    scenario = replace(Scenario().without_errors(), creep_m=0.020, hours=10)
    (creep,) = surface_changes(scenario, slope_valley(0.5))
    assert creep.amount(10.0) == pytest.approx(0.020)
    inner = creep.pattern.node[20:-20, 20:-20]
    expected = -np.sin(np.radians(15)) / np.cos(np.arctan(0.5))
    assert inner.min() == pytest.approx(expected, rel=1e-6)
    assert 0.05 < (inner < 0.5 * expected).mean() < 0.6  # part of the ground
    assert 0.2 < (inner == 0).mean() < 0.9


@pytest.mark.integration
def test_truth_tells_the_heave_of_stable_ground():
    scenario = replace(small(hours=3), heave_m=0.003, creep_m=0.02, terrain_step_m=4.0, cell_m=10.0)
    truth = Station(scenario).truth()
    alone = Station(replace(scenario, heave_m=0.0, creep_m=0.0)).truth()
    np.testing.assert_allclose(truth.change, alone.change + truth.stable_heave, atol=1e-12)
    stable = truth.stable_polygons.to_numpy() == 1
    np.testing.assert_array_equal(stable, alone.stable_polygons.to_numpy() == 1)
    assert 0.001 < truth.stable_heave.to_numpy()[:, stable].std() < 0.006
    assert "stable_heave" not in alone
