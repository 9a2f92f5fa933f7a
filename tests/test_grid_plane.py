"""The plane of a grid, against geometry by hand and by another library."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from station.grid_plane import GridPlane
from station.quantities import Grid
from station.science.uncertainty.parameters import parameter_layout

SLOPE = GridPlane((1000.0, 2000.0, 500.0), facing_deg=135.0, dip_deg=60.0)
angles = st.floats(0.0, 360.0), st.floats(0.0, 180.0)


def test_points_on_a_slope_of_60_degrees():
    """Down the slope, 10 m of distance are 17.32 m of height and 20 m of length."""
    down = np.array([1000.0 + 10 / np.sqrt(2), 2000.0 - 10 / np.sqrt(2), 500.0 - 17.320508])
    along = np.array(
        [1000.0 + 3.0, 2000.0 + 3.0, 500.0]
    )  # to the north-east, on the right of who looks at it
    above = np.array([1000.0, 2000.0, 502.0])
    np.testing.assert_allclose(SLOPE.from_map(down), [0.0, -20.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(SLOPE.from_map(along), [np.sqrt(18), 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(SLOPE.from_map(above), [0.0, np.sqrt(3), 1.0], atol=1e-9)


@given(*angles)
def test_axes_are_those_of_a_level_plane_turned_and_tipped(facing_deg, dip_deg):
    """Tipped about its horizontal axis u, then turned clockwise from south to the azimuth that it faces."""
    turned = Rotation.from_euler("xz", [dip_deg, 180.0 - facing_deg], degrees=True).as_matrix()
    np.testing.assert_allclose(GridPlane((0.0, 0.0, 0.0), facing_deg, dip_deg).axes, turned.T, atol=1e-12)


@given(*angles)
def test_the_way_back_cancels(facing_deg, dip_deg):
    plane = GridPlane((631000.0, 5184000.0, 2900.0), facing_deg, dip_deg)
    points_m = np.random.default_rng(1).uniform(-500, 500, (3, 20)) + np.array(plane.origin_m)[:, None]
    np.testing.assert_allclose(plane.to_map(plane.from_map(points_m)), points_m, atol=1e-8)
    vector = tuple(points_m)
    np.testing.assert_allclose(plane.in_map_axes(plane.in_grid_axes(vector)), vector, rtol=1e-12, atol=1e-6)


def test_without_a_plane_the_grid_is_on_the_map():
    points_m = np.arange(6.0).reshape(3, 2)
    assert GridPlane().is_map
    assert GridPlane().from_map(points_m) is points_m
    np.testing.assert_allclose(
        GridPlane((1.0, 2.0, 3.0)).from_map(points_m), points_m - [[1.0], [2.0], [3.0]], atol=1e-12
    )


@pytest.mark.parametrize(("dip_deg", "expected"), [(0.0, 0.0), (45.0, 1.0), (60.0, np.sqrt(3))])
def test_slope_of_the_plane_itself(dip_deg, expected):
    plane = GridPlane((0.0, 0.0, 1.0), 250.0, dip_deg)
    assert plane.tan_slope(np.zeros(1), np.zeros(1)) == pytest.approx([expected], abs=1e-12)


def test_a_wall_and_an_overhang_are_steeper_than_any_slope_and_a_ledge_is_level():
    wall, overhang = (GridPlane((0.0, 0.0, 0.0), 250.0, dip_deg) for dip_deg in (90.0, 120.0))
    assert wall.tan_slope(np.zeros(1), np.zeros(1)) > 1e5
    assert overhang.tan_slope(np.zeros(1), np.zeros(1)) > 1e5
    steps_out = np.array([-100.0])  # of the face, per metre upward
    assert wall.tan_slope(np.zeros(1), steps_out) == pytest.approx([0.01])


def test_azimuths_of_a_face_seen_from_its_foot():
    """A face of 200 m, 300 m to the north: ±18.4°, in steps of 5°."""
    grid = Grid(-100.0, 150.0, 1.0, 200, 150, GridPlane((0.0, 300.0, 0.0), 180.0, 90.0))
    params = parameter_layout(grid, grid.plane.place_from_map((0.0, 0.0, 0.0)))
    assert (np.degrees(params.start_rad), params.knot_intervals, params.full_circle) == (-20.0, 40, False)
    offset_m = np.array([-100.0, 0.0, 100.0]), np.zeros(3), np.full(3, -300.0)
    azimuth_deg = np.degrees(params.start_rad) + params.knot_position(offset_m)
    np.testing.assert_allclose(azimuth_deg, [-18.4349, 0.0, 18.4349], atol=1e-3)


def test_a_slope_around_the_scanner_is_seen_all_round():
    grid = Grid(-100.0, 100.0, 1.0, 200, 200, GridPlane((0.0, 0.0, 0.0), 180.0, 20.0))
    assert parameter_layout(grid, (10.0, -20.0, 2.0)).full_circle
