"""Pose: rotations against scipy, the transformation to the map against pyproj."""

import math

import numpy as np
import pytest
from pyproj import Transformer
from scipy.spatial.transform import Rotation

from station.quantities import Air, TiltSeries
from station.science.geometry import pose
from station.science.geometry.air import air_correction

HEF = (46.7958, 10.7828, 3245.0)
RADIUS_M = 6000.0


def test_rotation_is_omega_then_phi_then_kappa():
    angles = (0.1, -0.2, 0.3)
    assert pose.rotation(*angles) == pytest.approx(Rotation.from_euler("xyz", angles).as_matrix())


def rotated_by_tilt(tilt, points, time_s):
    return pose.timed_rotation(tilt, np.eye(3)).rotate(points, time_s)


def test_tilt_rotates_roll_first():
    """With a tilt of 5° about both axes, the other order differs by 0.4°."""
    roll, pitch = math.radians(5.0), math.radians(5.0)
    tilt = TiltSeries(np.array([0.0, 10.0]), np.array([roll, roll]), np.array([pitch, pitch]))
    points = np.random.default_rng(1).normal(size=(3, 20))
    rotated = rotated_by_tilt(tilt, points, np.full(20, 5.0))
    assert rotated == pytest.approx(Rotation.from_euler("xy", [roll, pitch]).as_matrix() @ points)


def test_tilt_is_interpolated_per_shot():
    tilt = TiltSeries(np.array([0.0, 10.0]), np.array([0.0, 0.0]), np.array([0.0, 0.001]))
    x_m, _, z_m = rotated_by_tilt(
        tilt, np.array([[1000.0, 1000.0], [0.0, 0.0], [0.0, 0.0]]), np.array([2.5, 7.5])
    )
    assert z_m == pytest.approx([-0.25, -0.75], abs=1e-6)
    assert x_m == pytest.approx([1000.0, 1000.0], abs=1e-3)


def random_points(seed=0, count=20_000):
    """Return points (3, count) within 6 km, up to 1.5 km below and above."""
    return np.random.default_rng(seed).uniform(-1, 1, (3, count)) * [[RADIUS_M], [RADIUS_M], [1500.0]]


def geocentric_to_map(to_geocentric, local_m, crs):
    geocentric_m = (to_geocentric @ np.vstack([local_m, np.ones(local_m.shape[1])]))[:3]
    return np.array(Transformer.from_crs("EPSG:4978", crs, always_xy=True).transform(*geocentric_m))


@pytest.mark.parametrize("crs", ["EPSG:32632", "EPSG:31254", "EPSG:3035"])
def test_map_by_origin_equals_pyproj_within_a_millimetre(crs):
    sop = np.eye(4)
    sop[:3, :3] = pose.rotation(0.02, -0.01, 2.0)
    frame = pose.scanner_to_map_by_origin(sop, HEF, crs, RADIUS_M)
    scanner_m = random_points()
    actual_m = frame.to_map(frame.to_local[:3, :3] @ scanner_m)
    latitude, longitude, height_m = HEF
    origin_m = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True).transform(
        longitude, latitude, height_m
    )
    to_geocentric = np.eye(4)  # east, north, up from the spherical angles of the ellipsoid's normal
    to_geocentric[:3, :3] = Rotation.from_euler(
        "ZX", [90 + longitude, 90 - latitude], degrees=True
    ).as_matrix()
    to_geocentric[:3, 3] = origin_m
    assert np.abs(actual_m - geocentric_to_map(to_geocentric @ sop, scanner_m, crs)).max() < 1e-3


def test_map_includes_curvature_and_scale():
    """At 4.5 km a rigid map frame is wrong by 1.6 m in height and 2.9 m in distance (equations.md, 2.6)."""
    frame = pose.scanner_to_map_by_origin(np.eye(4), HEF, "EPSG:32632", RADIUS_M)
    east_m, north_m, height_m = frame.to_map(np.array([[0.0, 4500.0], [0.0, 0.0], [0.0, 0.0]]))
    assert height_m[1] - height_m[0] == pytest.approx(4500**2 / 2 / 6.388e6, abs=0.01)
    assert math.hypot(*np.diff([east_m, north_m])[:, 0]) - 4500 == pytest.approx(-2.9, abs=0.2)


def test_sop_in_map_coordinates_uses_grid_north():
    """A scanner given by its map position and by its geographic origin has the same transformation."""
    by_origin = pose.scanner_to_map_by_origin(np.eye(4), HEF, "EPSG:32632", RADIUS_M)
    away_m = np.array([[0.0, 100.0, 3000.0], [3000.0, 100.0, 0.0], [0.0, 50.0, -500.0]])
    expected_m = by_origin.to_map(away_m)
    north_m = by_origin.to_map(np.array([[0.0], [1.0], [0.0]]))
    convergence = math.atan2(*(north_m[:2, 0] - by_origin.position_m[:2]))
    sop = np.eye(4)
    sop[:3, :3] = Rotation.from_euler("z", -convergence).as_matrix()  # scanner's y is true north
    sop[:3, 3] = by_origin.position_m
    frame = pose.scanner_to_map_directly(sop, "EPSG:32632", RADIUS_M)
    assert np.abs(frame.to_map(frame.to_local[:3, :3] @ away_m) - expected_m).max() < 1e-3


def test_local_map_equals_matrix_algebra():
    sop = np.eye(4)
    sop[:3, :3] = pose.rotation(0.6, 0.0, 1.0)
    sop[:3, 3] = (10.0, 20.0, 30.0)
    frame = pose.scanner_to_local_map(sop)
    points = np.random.default_rng(3).normal(size=(3, 50))
    actual = frame.to_map(frame.to_local[:3, :3] @ points)
    assert actual == pytest.approx(sop[:3, :3] @ points + sop[:3, 3:])


@pytest.mark.parametrize("season", ["2019-2020", "2020-2021", "2021-2022", "2023-2024"])
def test_real_mammoth_matrices_equal_pyproj(shared_data, season):
    """Tilt of 33.8°, POP to geocentric, then EPSG:26911: pyproj and plain matrix algebra agree to 1 mm."""
    sop, pop = (np.loadtxt(shared_data / "mammoth" / f"{season}-{kind}.dat") for kind in ("SOP", "POP"))
    frame = pose.scanner_to_map_by_pop(sop, pop, "EPSG:26911", RADIUS_M)
    scanner_m = random_points(seed=5)
    actual_m = frame.to_map(frame.to_local[:3, :3] @ scanner_m)
    assert np.abs(actual_m - geocentric_to_map(pop @ sop, scanner_m, "EPSG:26911")).max() < 1e-3
    tilt_deg = math.degrees(math.acos(frame.to_local[2, 2]))
    assert 29.0 < tilt_deg < 35.0


@pytest.mark.parametrize("crs", ["EPSG:32632", "EPSG:31254"])
def test_local_axes_are_those_of_the_map(crs):
    """Azimuths in the local frame are map azimuths; true north is 1.3° from grid north in UTM 32."""
    sop = np.eye(4)
    sop[:3, :3] = pose.rotation(0.03, -0.02, 1.0)
    frame = pose.scanner_to_map_by_origin(sop, HEF, crs, RADIUS_M)
    beams = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-0.6, 0.8, 0.0]]).T
    local_m = 500.0 * frame.to_local[:3, :3] @ beams
    east_m, north_m, _ = (a - b for a, b in zip(frame.to_map(local_m), frame.position_m, strict=True))
    assert np.arctan2(local_m[0], local_m[1]) == pytest.approx(np.arctan2(east_m, north_m), abs=2e-5)


def test_large_tilt_steps_are_interpolated_as_angles():
    """Half a degree between knots, at 5 km: equals the rotation by the interpolated angle."""
    tilt = TiltSeries(np.array([0.0, 1.0, 2.0]), np.radians([0.0, 0.5, -30.0]), np.radians([0.2, -0.3, 5.0]))
    time_s = np.linspace(0, 2, 301)
    far_m = np.array([4000.0, -3000.0, 800.0])
    rotated_m = rotated_by_tilt(tilt, np.repeat(far_m[:, None], 301, axis=1), time_s).T
    for at_s, point_m in zip(time_s, rotated_m, strict=True):
        roll, pitch = (np.interp(at_s, tilt.time_s, angle) for angle in (tilt.roll_rad, tilt.pitch_rad))
        expected_m = pose.rotation_y(pitch) @ pose.rotation_x(roll) @ far_m
        assert np.abs(point_m - expected_m).max() < 1e-6


def test_tilt_is_constant_outside_its_log_and_independent_of_shot_order():
    """Equals the rotation by the tilt at the time of the shot, then by the SOP, whatever the block."""
    rng = np.random.default_rng(2)
    tilt = TiltSeries(np.array([10.0, 12.0, 15.0]), rng.normal(0, 1e-3, 3), rng.normal(0, 1e-3, 3))
    sop, points, time_s = pose.rotation(0.1, -0.2, 2.0), random_points(count=500), rng.uniform(5, 20, 500)
    timed_rotation = pose.timed_rotation(tilt, sop)
    actual_m = timed_rotation.rotate(points, time_s)
    for shot in range(500):
        roll, pitch = (
            np.interp(time_s[shot], tilt.time_s, angle) for angle in (tilt.roll_rad, tilt.pitch_rad)
        )
        expected_m = sop @ pose.rotation_y(pitch) @ pose.rotation_x(roll) @ points[:, shot]
        assert np.abs(actual_m[:, shot] - expected_m).max() < 1e-6
        single = slice(shot, shot + 1)
        assert np.array_equal(actual_m[:, single], timed_rotation.rotate(points[:, single], time_s[single]))


@pytest.mark.parametrize("crs", [None, "EPSG:32632"])
@pytest.mark.parametrize("assumed", [Air(-25.0, 640.0, 90.0), None])
def test_air_correction_within_the_map_polynomial_equals_that_of_each_point(crs, assumed):
    """Points move by up to 1 m; the fitted polynomial is exact to 0.1 mm."""
    air = air_correction(Air(15.0, 1013.25, 0.0), assumed, 1.064)
    sop = np.eye(4)
    frame = pose.scanner_to_map_by_origin(sop, HEF, crs, RADIUS_M) if crs else pose.scanner_to_local_map(sop)
    local_m = random_points()
    actual_m = frame.with_correction(air.apply, RADIUS_M).to_map(local_m)
    assert np.abs(actual_m - frame.to_map(air.apply(local_m))).max() < 1e-4
    assert np.abs(actual_m - frame.to_map(local_m)).max() > 0.5
