"""Mobile lidar: the equation of a point, a test case of known variance shares for `sensitivity`."""

from __future__ import annotations

import math

import numpy as np

from station.quantities import Floats
from station.science.geometry.pose import rotation

VARIABLES = (
    "x", "y", "z", "latitude", "longitude",  # of the inertial system (INS) [m, rad]
    "roll", "pitch", "heading",  # of the vehicle [rad]
    "lever_x", "lever_y", "lever_z",  # from INS to laser [m]
    "boresight_x", "boresight_y", "boresight_z",  # of the laser against the INS [rad]
    "horizontal_angle", "vertical_angle", "range", "zero_error",  # of the laser [rad, m]
)  # fmt: skip

# Leslar et al. (2014), Table 1, which omits the inertial system. 0.007 m in height follows from the paper's
# "about 12 %" of the variance near the vehicle (equations.md, 8.9); attitude is taken as known.
INS_M = 0.007
EXPECTED: dict[str, float] = {
    "x": INS_M, "y": INS_M, "z": INS_M,
    "lever_x": 0.02, "lever_y": 0.02, "lever_z": 0.02,
    "boresight_x": math.radians(0.02), "boresight_y": math.radians(0.02), "boresight_z": math.radians(0.02),
    "horizontal_angle": math.radians(0.0055), "vertical_angle": math.radians(0.0055),
    "range": 0.008, "zero_error": 0.01,
}  # fmt: skip
IDEAL: dict[str, float] = EXPECTED | {
    "lever_x": 0.004, "lever_y": 0.004, "lever_z": 0.004,
    **dict.fromkeys(("boresight_x", "boresight_y", "boresight_z"), math.radians(0.001)),
    "range": 0.003, "zero_error": 0.005,
}  # fmt: skip


def geocentric_point(variables: Floats) -> Floats:
    """Geocentric coordinates (3, draws) of a laser point [m] from 18 variables (18, draws) as in VARIABLES.

    The vehicle's axes are forward, left, up; heading counts from east. The laser's horizontal angle counts
    from forward to the left.
    Source: Leslar et al. (2014), Eq. 1-3.
    """
    return np.stack([_point(column) for column in variables.T], axis=1)


def _point(variables: Floats) -> Floats:
    to_earth = _east_north_up(variables[3], variables[4]) @ rotation(*variables[5:8])
    horizontal, vertical, range_m = variables[14], variables[15], variables[16] + variables[17]
    flat_m = range_m * math.cos(vertical)
    beam_m = np.array(
        [flat_m * math.cos(horizontal), flat_m * math.sin(horizontal), range_m * math.sin(vertical)]
    )
    return np.asarray(variables[:3] + to_earth @ (variables[8:11] + rotation(*variables[11:14]) @ beam_m))


def _east_north_up(latitude_rad: float, longitude_rad: float) -> Floats:
    """Directions of east, north and up as the columns of a matrix (3, 3)."""
    sin_b, cos_b = math.sin(latitude_rad), math.cos(latitude_rad)
    sin_l, cos_l = math.sin(longitude_rad), math.cos(longitude_rad)
    return np.array(
        [[-sin_l, -sin_b * cos_l, cos_b * cos_l], [cos_l, -sin_b * sin_l, cos_b * sin_l], [0.0, cos_b, sin_b]]
    )


def side_shot(range_m: float, elevation_rad: float = 0.0) -> Floats:
    """Variables (18,) of a level vehicle on the equator, heading east, and a point to its left.

    Coordinates are relative to the vehicle: relative to the Earth's centre, differences would lose digits.
    """
    values = dict.fromkeys(VARIABLES, 0.0)
    values |= {"horizontal_angle": math.pi / 2, "vertical_angle": elevation_rad, "range": range_m}
    return np.array([values[name] for name in VARIABLES])


def sigmas(stated: dict[str, float]) -> Floats:
    """Sigma of each variable (18,); zero for variables not in `stated`."""
    return np.array([stated.get(name, 0.0) for name in VARIABLES])


def height(variables: Floats) -> Floats:
    """Height of points (draws,) seen from a vehicle on the equator at longitude 0 [m]."""
    return np.asarray(geocentric_point(variables)[0])
