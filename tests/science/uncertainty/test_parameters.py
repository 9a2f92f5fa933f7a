"""Head azimuth for any direction of the head's axis."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from station.science.uncertainty.parameters import ParameterLayout, parameter_layout
from tests.science.uncertainty.test_propagation import GRID

TILTED = (math.sin(0.6) * 0.6, math.sin(0.6) * 0.8, math.cos(0.6))


@pytest.mark.parametrize(
    ("axis", "azimuth_zero"),
    [
        ((0.0, 0.0, 1.0), (0, 1, 0)),
        ((0.0, 0.0, -1.0), (0, 1, 0)),
        ((1.0, 0.0, 0.0), (0, 1, 0)),
        ((-1.0, 0.0, 0.0), (0, 1, 0)),
        ((0.0, 1.0, 0.0), (0, 0, -1)),  # a wall laid flat by the SOP
        ((0.0, -1.0, 0.0), (0, 0, 1)),
        (TILTED, None),
    ],
)
def test_head_azimuth_turns_clockwise_about_any_axis(axis, azimuth_zero):
    """Directions turned clockwise about the axis by SciPy have knots in steps of one degree."""
    params = ParameterLayout(0.0, 360, full_circle=True, axis=axis)
    directions = params.sight_directions
    assert np.linalg.norm(directions, axis=0) == pytest.approx(1.0)
    assert axis @ directions == pytest.approx(0.0, abs=1e-12)
    zero = directions[:, 0]
    if azimuth_zero is not None:
        back = Rotation.from_rotvec(np.radians(0.1) * np.array(axis))  # the first line group is at 0.1°
        assert back.apply(zero) == pytest.approx(azimuth_zero, abs=1e-12)
    turns = Rotation.from_rotvec(-np.radians(0.2 * np.arange(1800))[:, None] * np.array(axis))
    assert np.allclose(directions.T, turns.apply(zero), rtol=0, atol=1e-9)
    along = 0.4 * np.array(axis)[:, None]  # elevation above the plane of rotation does not change the azimuth
    position = params.knot_position(tuple(700 * (directions + along)))
    assert position == pytest.approx(0.2 * np.arange(1800) + 0.1, abs=1e-6)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_azimuth_zero_is_the_same_on_both_sides_of_45_degrees(sign):
    zeros = []
    for tilt_deg in (44.999, 45.001):
        axis = (0.0, sign * math.sin(math.radians(tilt_deg)), math.cos(math.radians(tilt_deg)))
        zeros.append(ParameterLayout(0.0, 360, full_circle=True, axis=axis).sight_directions[:, 0])
    assert zeros[0] == pytest.approx(zeros[1], abs=1e-4)


def test_layout_of_a_head_that_points_north_is_a_full_circle():
    params = parameter_layout(GRID, (0.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    assert params.full_circle
    assert len(set(params.names)) == len(params.names) == 10 + 360 + 72 + 72
