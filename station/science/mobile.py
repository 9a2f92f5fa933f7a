"""A lidar on a vehicle: the equation of its points, a test case of known shares for `sensitivity`."""

from __future__ import annotations

import math

import numpy as np

from station.quantities import Floats
from station.science.pose import rotation

VARIABLES = (
    "x", "y", "z", "latitude", "longitude",  # of the inertial system (INS) [m, rad]
    "roll", "pitch", "heading",  # of the vehicle [rad]
    "lever_x", "lever_y", "lever_z",  # from INS to laser [m]
    "boresight_x", "boresight_y", "boresight_z",  # of the laser against the INS [rad]
    "horizontal_angle", "vertical_angle", "range", "zero_error",  # of the laser [rad, m]
)  # fmt: skip

# Leslar et al. (2014), Table 1; the inertial system's are not given there. 0.007 m in height is what the
# paper's "about 12 %" beside the lever arm implies (EQUATIONS, section 8); attitude is taken as known.
INS_M = 0.007
EXPECTED: dict[str, float] = {
    "x": INS_M, "y": INS_M, "z": INS_M,
    "lever_x": 0.02, "lever_y": 0.02, "lever_z": 0.02,
    "boresight_x": math.radians(0.02), "boresight_y": math.radians(0.02), "boresight_z": math.radians(0.02),
    "horizontal_angle": math.radians(0.0055), "vertical_angle": math.radians(0.0055),
    "range": 0.008, "zero_error": 0.01,
}  # fmt: skip


def geocentric_point(variables: Floats) -> Floats:
    """Geocentric coordinates (3, draws) of a laser point [m], of 18 variables (18, draws) as in VARIABLES.

    The vehicle's axes are forward, left, up; heading counts from east. The laser's horizontal angle counts
    from forward to the left.
    Source: Leslar et al. (2014), Eq. 1-3.
    """
    return np.stack([_point(column) for column in variables.T], axis=1)


def _point(of: Floats) -> Floats:
    level = _east_north_up(of[3], of[4]) @ rotation(*of[5:8])
    horizontal, vertical, range_m = of[14], of[15], of[16] + of[17]
    flat_m = range_m * math.cos(vertical)
    beam_m = np.array(
        [flat_m * math.cos(horizontal), flat_m * math.sin(horizontal), range_m * math.sin(vertical)]
    )
    return np.asarray(of[:3] + level @ (of[8:11] + rotation(*of[11:14]) @ beam_m))


def _east_north_up(latitude_rad: float, longitude_rad: float) -> Floats:
    """Directions of east, north and up as the columns of a matrix (3, 3)."""
    sin_b, cos_b = math.sin(latitude_rad), math.cos(latitude_rad)
    sin_l, cos_l = math.sin(longitude_rad), math.cos(longitude_rad)
    return np.array(
        [[-sin_l, -sin_b * cos_l, cos_b * cos_l], [cos_l, -sin_b * sin_l, cos_b * sin_l], [0.0, cos_b, sin_b]]
    )


def abeam(range_m: float) -> Floats:
    """Variables (18,) of a level vehicle on the equator, heading east, and a point level to its left.

    Coordinates count from the vehicle: from the Earth's centre, differences would lose digits.
    """
    at = dict.fromkeys(VARIABLES, 0.0) | {"horizontal_angle": math.pi / 2, "range": range_m}
    return np.array([at[name] for name in VARIABLES])


def sigmas(given: dict[str, float]) -> Floats:
    """Sigma of each variable (18,); nought where none is given."""
    return np.array([given.get(name, 0.0) for name in VARIABLES])


def height(variables: Floats) -> Floats:
    """Height (draws,) of points seen from a vehicle on the equator at longitude nought [m]."""
    return np.asarray(geocentric_point(variables)[0])
