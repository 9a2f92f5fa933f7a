"""Cold air over ice against an independent integration of the ray, and its variation from scan to scan."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from station.simulation.instrument.ray_casting import cast_rays
from station.simulation.instrument.scan import bend_over_ice
from station.simulation.station import Scenario, Station, small
from station.simulation.world.cold_air import ColdAir, cold_air_of_scan
from station.simulation.world.terrain import NodeField

EARTH_M = 6.371e6
EYE_M = np.array([0.0, 0.0, 0.0])


def integrate_ray(cold_air, slope, coefficient, ice_m):
    """Return the horizontal length of a ray to the ice, from the curvature -k(z) / R_E at each height [m]."""

    def derivative(_, state):
        height_m = max(state[0] - ice_m, 0.0)
        k = coefficient + cold_air.whole_path + cold_air.at_ice * np.exp(-height_m / cold_air.height_m)
        return [state[1], -k / EARTH_M]

    def reached(_, state):
        return state[0] - ice_m

    reached.terminal = True
    ray = solve_ivp(
        derivative,
        (0, 6000),
        [0.0, slope],
        events=reached,
        rtol=1e-11,
        atol=1e-9,
        max_step=2.0,
        method="DOP853",
    )
    return float(ray.t_events[0][0])


@pytest.mark.parametrize(
    "cold_air",
    [ColdAir(0.0, 60.0, 25.0), ColdAir(0.0, 8.0, 4.0), ColdAir(0.1, 0.0, 3.0)],
    ids=["deep", "thin", "whole path"],
)
@pytest.mark.parametrize(("slope", "ice_m"), [(-0.25, -500.0), (-0.04, -100.0)])
@pytest.mark.integration
def test_rays_end_where_an_independent_integration_puts_them(cold_air, slope, ice_m):
    axis = np.arange(-3500.0, 3501.0, 50.0)
    ground = NodeField(-3500.0, -3500.0, 50.0, np.full((len(axis), len(axis)), ice_m))
    ice = ground.with_nodes(np.ones_like(ground.node))
    bearing, slopes = np.radians([10.0, 11.0]), np.full(2, slope)
    hits = cast_rays(ground, EYE_M, bearing, slopes, 3400.0, lambda bearing: np.full_like(bearing, 0.13))
    bent = bend_over_ice(cold_air, ground, ice, EYE_M, (bearing, slopes, np.full(2, 0.13)), hits)
    expected_m = integrate_ray(cold_air, slope, 0.13, ice_m)
    without_m = integrate_ray(ColdAir(0.0, 0.0, 1.0), slope, 0.13, ice_m)
    assert hits.along_m[0] == pytest.approx(without_m, abs=1e-3)
    drop_m = (bent.along_m[0] - without_m) * slope  # of the ray below the one without cold air
    assert drop_m == pytest.approx((expected_m - without_m) * slope, abs=2e-5, rel=0.01)


def test_rays_that_end_on_rock_are_not_bent():
    scenario = small().without_errors()
    station = Station(replace(scenario, lines=20))
    cold = Station(replace(scenario, lines=20, air=True, refraction_ice_sigma=1.0, ice_layer_k=50.0))
    conditions = replace(station.conditions(0), cold_air=ColdAir(1.0, 50.0, 5.0))
    cold._conditions[0] = conditions
    reference, bent = station.scan(0), cold.scan(0)
    ice = station.valley.ice.at(reference.true_m[:, 0], reference.true_m[:, 1])
    _, first, second = np.intersect1d(reference.time_s, bent.time_s, return_indices=True)
    assert len(first) > 0.99 * len(ice)
    shift_m = np.linalg.norm(bent.true_m[second] - reference.true_m[first], axis=1)
    assert shift_m[ice[first] < 0.001].max() == 0
    assert shift_m[ice[first] > 0.5].min() > 1e-4


def test_whole_path_refraction_has_its_magnitude_and_the_layer_its_day():
    scenario = replace(Scenario(), refraction_ice_sigma=0.1, ice_layer_k=5.0)
    scans = [cold_air_of_scan(scenario, scan) for scan in range(480)]
    whole_path = np.array([cold.whole_path for cold in scans])
    assert whole_path.std() == pytest.approx(0.1, rel=0.1)
    assert abs(np.corrcoef(whole_path[1:], whole_path[:-1])[0, 1]) < 0.15
    at_ice = np.array([cold.at_ice for cold in scans]).reshape(20, 24).mean(axis=0)
    assert at_ice.mean() == pytest.approx(5.0, rel=0.03)
    assert np.argmax(np.convolve(np.tile(at_ice, 2), np.ones(5), "valid")[:24]) + 2 == pytest.approx(4, abs=2)
    assert np.ptp(at_ice) == pytest.approx(5.0, rel=0.3)


def test_cold_air_is_off_by_default_and_without_air():
    assert cold_air_of_scan(Scenario(), 0) is None
    assert cold_air_of_scan(replace(Scenario(), air=False, refraction_ice_sigma=0.1), 0) is None
