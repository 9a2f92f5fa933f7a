"""Echoes from the air: their share, ranges and brightness, and clouds close by."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from station.simulation.instrument.airborne import NEAREST_M, Cloud, airborne_range_m, cloud_of_scan
from station.simulation.station import Scenario, Station, small

WAY_M = np.full(400_000, 2000.0)
NO_ANGLE = np.zeros(len(WAY_M))


def ranges(**settings):
    scenario = replace(Scenario().without_errors(), **settings)
    range_m = airborne_range_m(scenario, None, NO_ANGLE, NO_ANGLE, WAY_M, np.random.default_rng(1))
    return range_m[np.isfinite(range_m)]


@pytest.mark.parametrize("share", [0.001, 0.01, 0.2])
def test_share_of_shots(share):
    expected = share * len(WAY_M)
    assert len(ranges(airborne_share=share)) == pytest.approx(expected, abs=4 * np.sqrt(expected))


def test_near_echoes_thin_out_with_range_and_the_others_do_not():
    """A density of 1/r has equal shares in each factor of range; an even one in each metre."""
    near, along = (ranges(airborne_share=0.2, airborne=mode) for mode in ("near", "along"))
    edges_m = np.geomspace(NEAREST_M, 2000.0, 6)
    np.testing.assert_allclose(np.histogram(near, edges_m)[0] / len(near), 0.2, rtol=0.03)
    assert np.median(near) == pytest.approx(np.sqrt(NEAREST_M * 2000.0), rel=0.03)
    edges_m = np.linspace(NEAREST_M, 2000.0, 6)
    np.testing.assert_allclose(np.histogram(along, edges_m)[0] / len(along), 0.2, rtol=0.03)


def test_cloud_stops_its_share_of_the_shots_that_pass_through_it():
    cloud = Cloud(1.0, 0.0, 0.1, 0.05, 80.0, 10.0, 0.7)
    rng = np.random.default_rng(2)
    azimuth_rad, elevation_rad = rng.uniform(0.8, 1.2, 100_000), rng.uniform(-0.1, 0.1, 100_000)
    way_m = np.where(rng.random(100_000) < 0.5, 1500.0, 60.0)  # ground in front of the cloud hides it
    range_m = airborne_range_m(
        Scenario().without_errors(), cloud, azimuth_rad, elevation_rad, way_m, np.random.default_rng(3)
    )
    inside = ((azimuth_rad - 1.0) / 0.1) ** 2 + (elevation_rad / 0.05) ** 2 < 1
    struck = np.isfinite(range_m)
    assert not struck[~inside | (way_m < 80)].any()
    assert struck[inside & (way_m > 80)].mean() == pytest.approx(0.7, abs=0.02)
    assert 80 < np.nanmin(range_m) < 80.1
    assert 89.9 < np.nanmax(range_m) < 90


def test_some_scans_have_a_cloud():
    scenario = replace(Scenario(), airborne_clouds=0.3)
    clouds = [cloud_of_scan(scenario, scan) for scan in range(600)]
    assert np.mean([cloud is not None for cloud in clouds]) == pytest.approx(0.3, abs=0.06)
    assert all(20 <= cloud.range_m <= 150 for cloud in clouds if cloud)


def test_airborne_echoes_replace_those_of_the_ground_on_the_same_ray():
    scenario = replace(small(hours=1), lines=150)
    clear, snowy = (
        Station(replace(scenario, airborne_share=share, airborne="along")).scan(0) for share in (0, 0.05)
    )
    assert not clear.airborne.any()
    shots = scenario.lines * scenario.shots_per_line
    assert snowy.airborne.sum() == pytest.approx(0.05 * shots, rel=0.08)
    assert (np.diff(snowy.time_s) > 0).all()  # the only return of their shots
    _, before, after = np.intersect1d(clear.time_s, snowy.time_s, return_indices=True)
    struck = snowy.airborne[after]
    eye = np.array(scenario.mount_position_m)
    ways = [clear.true_m[before][struck] - eye, snowy.true_m[after][struck] - eye]
    range_m = [np.linalg.norm(way, axis=1) for way in ways]
    cosine = (ways[0] * ways[1]).sum(axis=1) / (range_m[0] * range_m[1])
    far = range_m[1] > 100  # the scanner itself is displaced by millimetres
    assert np.degrees(np.arccos(np.clip(cosine[far], -1, 1))).max() < 0.01
    assert (range_m[1] < range_m[0]).all()
    assert (range_m[1] / range_m[0]).mean() == pytest.approx(0.5, abs=0.05)
    np.testing.assert_array_equal(clear.x_m[before][~struck], snowy.x_m[after][~struck])
    measured_m = np.sqrt(snowy.x_m**2 + snowy.y_m**2 + snowy.z_m**2)
    true_m = np.linalg.norm(snowy.true_m - eye, axis=1)
    near = snowy.airborne & (true_m < 500)  # the air changes longer ranges by centimetres
    assert np.std((measured_m - true_m)[near]) == pytest.approx(0.010, rel=0.15)
    brightness = snowy.intensity[snowy.airborne]
    assert np.median(brightness) == pytest.approx(0.15 * 0.6, rel=0.15)  # 15 % of the beam, snow of 60 %
    assert np.percentile(brightness, 95) > 2.5 * np.median(brightness)
