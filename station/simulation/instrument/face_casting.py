"""Ray casting onto a rock face, which is a field of distances out of a plane: where a beam meets it."""

from __future__ import annotations

import numpy as np

from station.quantities import Floats
from station.simulation.instrument.ray_casting import HIT_TOLERANCE_M, MAX_ITERATIONS, RayHits
from station.simulation.world.air import EARTH_M, bending_m
from station.simulation.world.rock_face import axes, to_face
from station.simulation.world.terrain import NodeField

LEAST_APPROACH = 0.05  # metres towards the face for each metre of a beam; less is along it


def cast_onto_face(ground: NodeField, eye_m: Floats, direction: Floats, coefficient: Floats) -> RayHits:
    """Trace rays of the given unit directions (3, n) to the face, to a hundredth of a millimetre.

    Rays bend by their coefficients of refraction (n,). East, north and up of the hits, and the slopes, are
    along, up and out of the face. No part of it must hide another. Newton's method from its plane.
    """
    turn = axes()
    flat = np.hypot(direction[0], direction[1])
    down = -turn[:, 2:]  # of refraction
    approach = turn @ direction
    with np.errstate(divide="ignore"):
        range_m = np.where(approach[2] < -LEAST_APPROACH, -to_face(eye_m[:, None])[2] / approach[2], np.nan)
    for _ in range(MAX_ITERATIONS):
        bent_m = bending_m(coefficient, range_m * flat)
        place_m = to_face(eye_m[:, None] + range_m * direction) + down * bent_m
        out_m, slope_along, slope_up = ground.with_slope(place_m[0], place_m[1])
        above_m = place_m[2] - out_m
        velocity = approach + down * (coefficient * range_m * flat**2 / EARTH_M)
        closing = velocity[2] - slope_along * velocity[0] - slope_up * velocity[1]
        if np.nan_to_num(np.abs(above_m)).max(initial=0.0) < HIT_TOLERANCE_M:
            break
        range_m = range_m - above_m / np.where(closing < 0, closing, np.nan)
    hit = (np.abs(above_m) < HIT_TOLERANCE_M) & (closing < 0)
    columns = np.stack((range_m * flat, *place_m[:2], out_m, slope_along, slope_up))
    return RayHits(*np.where(hit, columns, np.nan))
