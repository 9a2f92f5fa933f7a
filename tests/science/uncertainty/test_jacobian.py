"""The Jacobian of heights above a plane, against that on the map and against rotated points."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from station.grid_plane import MAP_PLANE, GridPlane
from station.quantities import VERTICAL_AXIS
from station.science.uncertainty.jacobian import height_jacobian
from station.science.uncertainty.parameters import ParameterLayout

TILTED = (0.1, -0.2, float(np.sqrt(1 - 0.05)))


def layout(plane, axis=VERTICAL_AXIS):
    return ParameterLayout(0.0, 360, full_circle=True, axis=axis, plane=plane)


@settings(max_examples=20, deadline=None)
@given(st.floats(0.0, 360.0), st.floats(0.0, 100.0), st.integers(0, 1000))
def test_effects_on_the_same_ground_agree_in_two_planes(facing_deg, dip_deg, seed):
    """A point that moves by d leaves ground with the normal n by n·d/n_z upward, and by n·d/n_w along w."""
    rng = np.random.default_rng(seed)
    plane = GridPlane((0.0, 0.0, 0.0), facing_deg, dip_deg)
    offset_m, gradient = rng.uniform(-300, 300, (3, 50)), rng.uniform(-0.5, 0.5, (2, 50))
    u, v, w = plane.axes @ np.stack([-gradient[0], -gradient[1], np.ones(50)])
    seen = w > 0.2  # the side that the plane shows
    on_map = height_jacobian(layout(MAP_PLANE, TILTED), tuple(offset_m[:, seen]), *gradient[:, seen])
    on_plane = height_jacobian(
        layout(plane, TILTED), tuple(plane.axes @ offset_m[:, seen]), (-u / w)[seen], (-v / w)[seen]
    )
    for name in ("pose", "sight_tilt", "refraction", "cross_tilt"):
        expected = getattr(on_map, name) / w[seen]
        scale = np.abs(expected).max(initial=1e-9)
        np.testing.assert_allclose(getattr(on_plane, name), expected, atol=1e-9 * scale, rtol=1e-7)
    np.testing.assert_allclose(on_plane.knot_position, on_map.knot_position, atol=1e-9)
    np.testing.assert_allclose(on_plane.gradient, np.stack([-u / w, -v / w])[:, seen], atol=1e-9)
    np.testing.assert_allclose(on_plane.tan_slope, np.hypot(*gradient[:, seen]), rtol=1e-7)


def test_face_in_the_north_moves_as_its_points_do():
    """Points 50 m above the scanner, seen by one that is turned in fact, against points turned by scipy."""
    plane = GridPlane((0.0, 300.0, 0.0), 180.0, 90.0)
    place_m = np.array([40.0, 300.0, 50.0])
    jacobian = height_jacobian(
        layout(plane), tuple(axis[None] for axis in plane.axes @ place_m), np.zeros(1), np.zeros(1)
    )
    small = 1e-6
    turned_m = [Rotation.from_rotvec(small * axis).apply(place_m) for axis in np.eye(3)]
    # Actual minus assumed: the surface that is computed lies where the points were not turned to.
    east, north, up = ((plane.axes @ (place_m - moved_m))[2] / small for moved_m in turned_m)
    np.testing.assert_allclose(jacobian.pose[:3, 0], [east, north, -up], rtol=1e-4, atol=1e-3)
    assert jacobian.pose[0, 0] == pytest.approx(-50.0)
    np.testing.assert_allclose(jacobian.pose[3:6, 0], [0.0, 1.0, 0.0], atol=1e-12)
    range_m = np.linalg.norm(place_m)
    assert jacobian.pose[6, 0] == pytest.approx(-300.0 / range_m)
    assert jacobian.pose[7, 0] == pytest.approx(-300.0e-6)
