"""Simulated shots against independent geometry: height errors, beam, point density, shadows, ray casting."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from station.quantities import Air
from station.simulation.instrument.motion import PoseOffset
from station.simulation.instrument.ray_casting import cast_rays
from station.simulation.instrument.scan import simulate_scan
from station.simulation.randomness import RandomFourierSeries, random_fourier
from station.simulation.station import Scenario, Station, small
from station.simulation.world.air import AirOfScan
from station.simulation.world.terrain import NodeField

EARTH_M = 6.371e6
FLAT = RandomFourierSeries(np.zeros(0), np.zeros(0), 0.0)


def plane(east_slope=0.0, north_slope=0.0, up_m=-500.0, step_m=50.0):
    axis = np.arange(-6000.0, 6001.0, step_m)
    node = up_m + east_slope * axis[None, :] + north_slope * axis[:, None]
    return NodeField(-6000.0, -6000.0, step_m, node)


def level_scanner(**settings):
    """Return the scenario of a scanner at the origin, upright, x to the east, without errors."""
    scenario = replace(
        Scenario().without_errors(),
        mount_roll_deg=0,
        mount_pitch_deg=0,
        mount_heading_deg=0,
        mount_position_m=(0.0, 0.0, 0.0),
        azimuth_deg=(20.0, 160.0),
        elevation_deg=(-14.0, -7.0),
        lines=120,
        shots_per_line=60,
    )
    return replace(scenario, **settings)


def shoot(scenario, ground, **changed):
    conditions = replace(Station(scenario).conditions(0), **changed)
    return simulate_scan(scenario, ground, ground.with_nodes(np.zeros_like(ground.node)), conditions)


TILT = np.radians(0.0079)


def height_error(case, x, y, z, gx, gy):
    """Return the height error. Source: equations.md, 6.1."""
    flat, slant = np.hypot(x, y), np.sqrt(x**2 + y**2 + z**2)
    line_of_sight = flat + z * (gx * x + gy * y) / flat
    return {
        "tilt about east": -(y + gy * z) * TILT,
        "tilt about north": (x + gx * z) * TILT,
        "heading": (gx * y - gy * x) * TILT,
        "position": 0.3 * gx - 0.2 * gy - 0.1,
        "range bias": 0.2 * (z - gx * x - gy * y) / slant,
        "jitter": -line_of_sight * TILT,
        "refraction": 0.13 * flat * line_of_sight / (2 * EARTH_M),
    }[case]


@pytest.mark.parametrize(
    "case",
    ["tilt about east", "tilt about north", "heading", "position", "range bias", "jitter", "refraction"],
)
def test_systematic_errors_shift_a_sloping_plane_by_the_analytic_height_error(case):
    """Source: equations.md, 6.1, the height error of true minus assumed parameters."""
    slope = (0.10, 0.06)
    scenario = level_scanner()
    changed = {
        "tilt about east": {"tilt_rad": np.array([[TILT, TILT], [0.0, 0.0]])},
        "tilt about north": {"tilt_rad": np.array([[0.0, 0.0], [TILT, TILT]])},
        "heading": {"pose_offset": PoseOffset(TILT, np.zeros(3))},
        "position": {"pose_offset": PoseOffset(0.0, np.array([0.3, -0.2, 0.1]))},
        "range bias": {"range_bias_m": 0.2},
        "jitter": {"jitter_rad": np.full(scenario.lines, TILT)},
        "refraction": {"air": AirOfScan(Air(-2, 684, 28), 0.0, 0.0, 0.13, FLAT)},
    }[case]
    changed = {"tilt_time_s": np.array([0.0, 900.0]), "tilt_rad": np.zeros((2, 2)), **changed}
    scan = shoot(scenario, plane(*slope), **changed)
    x, y, z = scan.x_m, scan.y_m, scan.z_m
    tolerance = 0.012 if case == "refraction" else 0.002  # the air also slows the pulse, by millimetres
    lifted = z - (-500 + slope[0] * x + slope[1] * y)
    assert len(x) > 5000
    np.testing.assert_allclose(lifted, height_error(case, x, y, z, *slope), atol=tolerance, rtol=0.01)


def test_published_tilts_displace_a_point_by_the_published_distance():
    """equations.md, 9 (P11): 0.0079° and 0.0104° at 3421 m are 0.47 and 0.62 m."""
    for tilt_deg, shift_m in ((0.0079, 0.47), (0.0104, 0.62)):
        tilt_rad = np.radians([[tilt_deg, tilt_deg], [0.0, 0.0]])
        scenario = level_scanner(azimuth_deg=(89.9, 90.1), elevation_deg=(-8.6, -8.2))
        scan = shoot(scenario, plane(), tilt_time_s=np.array([0.0, 900.0]), tilt_rad=tilt_rad)
        points_m = np.stack((scan.x_m, scan.y_m, scan.z_m), axis=1)
        nearest = np.abs(np.linalg.norm(points_m, axis=1) - 3421).argmin()
        assert abs(np.linalg.norm(points_m[nearest]) - 3421) < 10
        assert np.linalg.norm(points_m[nearest] - scan.true_m[nearest]) == pytest.approx(shift_m, abs=0.005)


def test_beam_width_scatters_the_heights_of_a_facing_slope():
    """equations.md, 5.17: R γ/4 · sin θ / cos slope is 0.103 m at 3421 m, 65°, 25°."""
    incidence, slope = np.radians(65), np.radians(25)
    below = np.degrees(np.pi / 2 - incidence - slope)  # depression of the beam: zero
    range_m = 3421.0
    up_m = -range_m * np.tan(slope)
    scenario = level_scanner(
        beam_divergence_mrad=0.12, azimuth_deg=(89.99, 90.01), elevation_deg=(-below - 0.02, -below + 0.02)
    )
    scan = shoot(scenario, plane(0.0, np.tan(slope), up_m))
    lifted = scan.z_m - (up_m + np.tan(slope) * scan.y_m)
    assert lifted.std() == pytest.approx(0.103, rel=0.03)
    assert abs(lifted.mean()) < 0.005


def test_range_noise_and_echo_loss_have_their_magnitudes():
    scenario = level_scanner(range_noise_m=0.010, echo_loss=0.1)
    scan = shoot(scenario, plane())
    measured = np.sqrt(scan.x_m**2 + scan.y_m**2 + scan.z_m**2)
    assert (measured - np.linalg.norm(scan.true_m, axis=1)).std() == pytest.approx(0.010, rel=0.03)
    assert len(measured) == pytest.approx(0.9 * scenario.lines * scenario.shots_per_line, rel=0.02)


@pytest.mark.parametrize(("range_m", "slope_deg"), [(800.0, 10.0), (2000.0, 5.0), (4000.0, 12.0)])
def test_point_density_is_that_of_the_angular_grid(range_m, slope_deg):
    """equations.md, 5.18 (P12): cos θ / (cos slope · (R · 0.01°)²) points per square metre.

    The published formula neglects that lines are closer by the cosine of the elevation.
    """
    slope = np.radians(slope_deg)
    down = np.degrees(np.arcsin(500 / range_m))
    ground = plane(0.0, np.tan(slope), -500.0 - range_m * np.cos(np.radians(down)) * np.tan(slope))
    scenario = level_scanner(
        azimuth_deg=(89.0, 91.0), elevation_deg=(-down - 0.2, -down + 0.2), lines=200, shots_per_line=40
    )
    scan = shoot(scenario, ground)
    incidence = np.pi / 2 - np.radians(down) - slope
    expected = np.cos(incidence) / np.cos(slope) / (range_m * np.radians(0.01)) ** 2
    expected /= np.cos(np.radians(down))
    y = scan.true_m[:, 1]
    middle = y.mean()
    inside = np.abs(y - middle) < 0.35 * np.ptp(y)
    width = 2 * middle * np.tan(np.radians(1.0))
    density = inside.sum() / (0.7 * np.ptp(y) * width)
    assert density == pytest.approx(expected, rel=0.06)


def test_ridge_casts_a_shadow():
    ground = plane(step_m=10.0)
    north = np.arange(-6000.0, 6001.0, 10.0)
    ground.node[:] += np.clip(200 - np.abs(north - 1500) / 2, 0, None)[:, None]  # 200 m high, crest at 1500 m
    scenario = level_scanner(azimuth_deg=(80, 100), elevation_deg=(-30, -5), lines=100, shots_per_line=400)
    scan = shoot(scenario, ground)
    bearing = np.arctan2(scan.true_m[:, 1], scan.true_m[:, 0])
    crest = 1500 / np.sin(bearing)
    shadow_end = crest * 500 / 300  # where the ray over the crest, 300 m below the eye, meets the plane
    along = np.hypot(scan.true_m[:, 0], scan.true_m[:, 1])
    assert not ((along > crest + 10) & (along < 0.98 * shadow_end)).any()
    assert (along > shadow_end).sum() > 1000
    assert (along < crest).sum() > 1000


@pytest.mark.integration
def test_cast_rays_agree_with_small_steps_along_the_rays():
    station = Station(small())
    ground = station.valley.ground
    eye = np.array(station.scenario.mount_position_m)
    rng = np.random.default_rng(4)
    bearing = rng.uniform(np.radians(25), np.radians(165), 1500)
    slope = np.tan(rng.uniform(np.radians(-29), np.radians(8), 1500))
    hits = cast_rays(ground, eye, bearing, slope, 1100.0, np.zeros_like)
    along = np.arange(15.0, 1100.0, 0.1)
    expected_m = np.full(1500, np.nan)
    for ray in range(1500):
        up = ground.at(eye[0] + along * np.cos(bearing[ray]), eye[1] + along * np.sin(bearing[ray]))
        below = np.flatnonzero(up >= eye[2] + along * slope[ray])
        expected_m[ray] = (
            along[below[0]] if len(below) and below[0] > 0 else np.nan
        )  # except the rock at the scanner
    both = np.isfinite(expected_m) & np.isfinite(hits.along_m)
    assert (np.isfinite(expected_m) == np.isfinite(hits.along_m)).mean() > 0.99
    assert (np.abs(expected_m - hits.along_m)[both] < 0.2).mean() > 0.99


def test_random_fourier_series_has_its_sigma_and_is_smooth():
    series = [random_fourier(np.random.default_rng(seed), 2.0, 10.0, 100.0) for seed in range(200)]
    times = np.arange(0, 3000.0, 50.0)
    assert np.std([function(times) for function in series]) == pytest.approx(2.0, rel=0.03)
    close = series[0](np.array([100.0, 100.01]))
    assert abs(close[1] - close[0]) < 2.0 * 6 * 2 * np.pi / 10 * 0.01
