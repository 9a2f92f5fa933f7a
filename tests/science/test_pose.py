"""Rotations against scipy, the way to the map against pyproj."""

import math

import numpy as np
import pytest
from pyproj import Transformer
from scipy.spatial.transform import Rotation

from station.quantities import Air, Tilt
from station.science import pose
from station.science.air import air_correction

HEF = (46.7958, 10.7828, 3245.0)
REACH_M = 6000.0


def test_rotation_is_omega_then_phi_then_kappa():
    angles = (0.1, -0.2, 0.3)
    assert pose.rotation(*angles) == pytest.approx(Rotation.from_euler("xyz", angles).as_matrix())


def upright(tilt, points, time_s):
    return pose.turning(tilt, np.eye(3)).turned(points, time_s)


def test_lean_turns_roll_first():
    """A mount that leans 5° in both axes would show the other order as 0.4°."""
    roll, pitch = math.radians(5.0), math.radians(5.0)
    tilt = Tilt(np.array([0.0, 10.0]), np.array([roll, roll]), np.array([pitch, pitch]))
    points = np.random.default_rng(1).normal(size=(3, 20))
    leaning = upright(tilt, points, np.full(20, 5.0))
    assert leaning == pytest.approx(Rotation.from_euler("xy", [roll, pitch]).as_matrix() @ points)


def test_lean_is_interpolated_per_shot():
    tilt = Tilt(np.array([0.0, 10.0]), np.array([0.0, 0.0]), np.array([0.0, 0.001]))
    x_m, _, z_m = upright(tilt, np.array([[1000.0, 1000.0], [0.0, 0.0], [0.0, 0.0]]), np.array([2.5, 7.5]))
    assert z_m == pytest.approx([-0.25, -0.75], abs=1e-6)
    assert x_m == pytest.approx([1000.0, 1000.0], abs=1e-3)


def everywhere(seed=0, count=20_000):
    """Points within 6 km, up to 1.5 km below and above."""
    return np.random.default_rng(seed).uniform(-1, 1, (3, count)) * [[REACH_M], [REACH_M], [1500.0]]


def by_pyproj(to_geocentric, local_m, crs):
    geocentric_m = (to_geocentric @ np.vstack([local_m, np.ones(local_m.shape[1])]))[:3]
    return np.array(Transformer.from_crs("EPSG:4978", crs, always_xy=True).transform(*geocentric_m))


@pytest.mark.parametrize("crs", ["EPSG:32632", "EPSG:31254", "EPSG:3035"])
def test_map_from_origin_within_a_millimetre(crs):
    sop = np.eye(4)
    sop[:3, :3] = pose.rotation(0.02, -0.01, 2.0)
    frame = pose.frame_by_origin(sop, HEF, crs, REACH_M)
    scanner_m = everywhere()
    told_m = frame.to_map(frame.to_local[:3, :3] @ scanner_m)
    latitude, longitude, height_m = HEF
    origin_m = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True).transform(
        longitude, latitude, height_m
    )
    upright = np.eye(4)  # east, north, up from the spherical angles of the ellipsoid's normal
    upright[:3, :3] = Rotation.from_euler("ZX", [90 + longitude, 90 - latitude], degrees=True).as_matrix()
    upright[:3, 3] = origin_m
    assert np.abs(told_m - by_pyproj(upright @ sop, scanner_m, crs)).max() < 1e-3


def test_curvature_and_scale_are_not_optional():
    """At 4.5 km a rigid map frame is wrong by 1.6 m in height and 2.9 m in distance (EQUATIONS 2.6)."""
    frame = pose.frame_by_origin(np.eye(4), HEF, "EPSG:32632", REACH_M)
    east_m, north_m, height_m = frame.to_map(np.array([[0.0, 4500.0], [0.0, 0.0], [0.0, 0.0]]))
    assert height_m[1] - height_m[0] == pytest.approx(4500**2 / 2 / 6.388e6, abs=0.01)
    assert math.hypot(*np.diff([east_m, north_m])[:, 0]) - 4500 == pytest.approx(-2.9, abs=0.2)


def test_sop_straight_to_the_map_knows_grid_north():
    """The same scanner told by its map position and by its origin stands and looks the same."""
    by_origin = pose.frame_by_origin(np.eye(4), HEF, "EPSG:32632", REACH_M)
    away_m = np.array([[0.0, 100.0, 3000.0], [3000.0, 100.0, 0.0], [0.0, 50.0, -500.0]])
    wanted_m = by_origin.to_map(away_m)
    north_m = by_origin.to_map(np.array([[0.0], [1.0], [0.0]]))
    convergence = math.atan2(*(north_m[:2, 0] - by_origin.position_m[:2]))
    sop = np.eye(4)
    sop[:3, :3] = Rotation.from_euler("z", -convergence).as_matrix()  # scanner's y is true north
    sop[:3, 3] = by_origin.position_m
    frame = pose.frame_on_map(sop, "EPSG:32632", REACH_M)
    assert np.abs(frame.to_map(frame.to_local[:3, :3] @ away_m) - wanted_m).max() < 1e-3


def test_local_map_is_plain_matrix_algebra():
    sop = np.eye(4)
    sop[:3, :3] = pose.rotation(0.6, 0.0, 1.0)
    sop[:3, 3] = (10.0, 20.0, 30.0)
    frame = pose.frame_in_local_map(sop)
    points = np.random.default_rng(3).normal(size=(3, 50))
    told = frame.to_map(frame.to_local[:3, :3] @ points)
    assert told == pytest.approx(sop[:3, :3] @ points + sop[:3, 3:])


@pytest.mark.parametrize("season", ["2019-2020", "2020-2021", "2021-2022", "2023-2024"])
def test_real_mammoth_matrices(shared_data, season):
    """33.8° lean, POP to geocentric, then EPSG:26911: pyproj and plain matrix algebra agree to 1 mm."""
    sop, pop = (np.loadtxt(shared_data / "mammoth" / f"{season}-{kind}.dat") for kind in ("SOP", "POP"))
    frame = pose.frame_by_pop(sop, pop, "EPSG:26911", REACH_M)
    scanner_m = everywhere(seed=5)
    told_m = frame.to_map(frame.to_local[:3, :3] @ scanner_m)
    assert np.abs(told_m - by_pyproj(pop @ sop, scanner_m, "EPSG:26911")).max() < 1e-3
    lean_deg = math.degrees(math.acos(frame.to_local[2, 2]))
    assert 29.0 < lean_deg < 35.0


@pytest.mark.parametrize("crs", ["EPSG:32632", "EPSG:31254"])
def test_axes_are_those_of_the_map(crs):
    """Where a beam points on the map; true north is 1.3° from grid north in UTM 32, nought in none."""
    sop = np.eye(4)
    sop[:3, :3] = pose.rotation(0.03, -0.02, 1.0)
    frame = pose.frame_by_origin(sop, HEF, crs, REACH_M)
    beams = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-0.6, 0.8, 0.0]]).T
    local_m = 500.0 * frame.to_local[:3, :3] @ beams
    east_m, north_m, _ = (a - b for a, b in zip(frame.to_map(local_m), frame.position_m, strict=True))
    assert np.arctan2(local_m[0], local_m[1]) == pytest.approx(np.arctan2(east_m, north_m), abs=2e-5)


def test_a_lean_that_jumps_between_its_knots_turns_as_its_angle_does():
    """Half a degree from one knot to the next, far away: as the rotation at the angle in between."""
    tilt = Tilt(np.array([0.0, 1.0, 2.0]), np.radians([0.0, 0.5, -30.0]), np.radians([0.2, -0.3, 5.0]))
    time_s = np.linspace(0, 2, 301)
    far_m = np.array([4000.0, -3000.0, 800.0])
    leant = upright(tilt, np.repeat(far_m[:, None], 301, axis=1), time_s).T
    for at_s, found_m in zip(time_s, leant, strict=True):
        roll, pitch = (np.interp(at_s, tilt.time_s, angle) for angle in (tilt.roll_rad, tilt.pitch_rad))
        assert found_m == pytest.approx(pose.rotation_y(pitch) @ pose.rotation_x(roll) @ far_m, abs=1e-6)


def test_the_lean_stays_as_it_is_before_and_after_its_log_and_shots_may_come_in_any_order():
    """As the rotation at the angle of its moment, then by the SOP; of each shot whatever is beside it."""
    rng = np.random.default_rng(2)
    tilt = Tilt(np.array([10.0, 12.0, 15.0]), rng.normal(0, 1e-3, 3), rng.normal(0, 1e-3, 3))
    sop, points, time_s = pose.rotation(0.1, -0.2, 2.0), everywhere(count=500), rng.uniform(5, 20, 500)
    turning = pose.turning(tilt, sop)
    told_m = turning.turned(points, time_s)
    for at in range(500):
        roll, pitch = (np.interp(time_s[at], tilt.time_s, angle) for angle in (tilt.roll_rad, tilt.pitch_rad))
        wanted_m = sop @ pose.rotation_y(pitch) @ pose.rotation_x(roll) @ points[:, at]
        assert told_m[:, at] == pytest.approx(wanted_m, abs=1e-6)
        alone = slice(at, at + 1)
        assert np.array_equal(told_m[:, alone], turning.turned(points[:, alone], time_s[alone]))


@pytest.mark.parametrize("crs", [None, "EPSG:32632"])
@pytest.mark.parametrize("assumed", [Air(-25.0, 640.0, 90.0), None])
def test_the_air_on_the_way_to_the_map_is_that_of_each_point(crs, assumed):
    """Made part of the way, it leads each point where it leads it alone, though it moves them by 1 m."""
    air = air_correction(Air(15.0, 1013.25, 0.0), assumed, 1.064)
    sop = np.eye(4)
    frame = pose.frame_by_origin(sop, HEF, crs, REACH_M) if crs else pose.frame_in_local_map(sop)
    local_m = everywhere()
    through_air_m = frame.after(air.corrected, REACH_M).to_map(local_m)
    assert np.abs(through_air_m - frame.to_map(air.corrected(local_m))).max() < 1e-4
    assert np.abs(through_air_m - frame.to_map(local_m)).max() > 0.5
