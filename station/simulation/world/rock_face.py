"""A vertical rock face 300 m from a scanner, from which blocks fall.

The ground is given over the face itself: its nodes lie along it (to the right of who looks at it) and up it,
its values are distances out of it, towards the scanner. East-north-up at the mark is the map.
"""

from __future__ import annotations

import numpy as np

from station.grid_plane import GridPlane
from station.quantities import Floats
from station.simulation.randomness import rng_for
from station.simulation.scenario import Scenario
from station.simulation.world.terrain import NodeField, Valley, bumps

ORIGIN_M = (120.0, 270.0, 40.0)  # of the face, from the mark
FACING_DEG = 205.0  # azimuth, clockwise from north
LEFT_M, RIGHT_M, BOTTOM_M, TOP_M = -130.0, 130.0, -75.0, 85.0
BULGES_M, BULGE_WAVES_M = 1.5, (30.0, 120.0)
# Blocks that fall, and the debris below them: along, up, half width, half height [m], depth for a unit change
FALLS_M = (
    (-35.0, 15.0, 5.0, 4.0, -1.0),
    (40.0, -5.0, 3.0, 4.0, -0.6),
    (-35.0, -48.0, 14.0, 7.0, 0.25),
)
AREAS_M = {  # along, up, half diagonals: of rectangles
    "scar": (-35.0, 15.0, 10.0, 10.0),
    "foot": (-35.0, -46.0, 28.0, 14.0),
    "face": (0.0, 10.0, 140.0, 70.0),
}


def plane() -> GridPlane:
    """Return the plane of the face, as a site file states it."""
    return GridPlane(ORIGIN_M, FACING_DEG, 90.0)


def axes() -> Floats:
    """Return the directions along, up and out of the face in east-north-up (3, 3).

    They are those of a face to the south, east, up and south, turned clockwise.
    """
    turn_rad = np.radians(FACING_DEG - 180.0)
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    return np.array([(c, -s, 0.0), (0.0, 0.0, 1.0), (-s, -c, 0.0)])


def build_rock_face(scenario: Scenario) -> Valley:
    """Build the face, of bulges and roughness so gentle that no part hides another; there is no ice."""
    step_m = scenario.terrain_step_m
    shape = round((TOP_M - BOTTOM_M) / step_m) + 1, round((RIGHT_M - LEFT_M) / step_m) + 1
    waves_m = BULGE_WAVES_M, (scenario.roughness_length_m, 4 * scenario.roughness_length_m)
    bulges, fine = (
        bumps(rng_for(scenario.seed, 63, number), shape, step_m, short_m, long_m, 1.0)
        for number, (short_m, long_m) in enumerate(waves_m)
    )
    ground = NodeField(LEFT_M, BOTTOM_M, step_m, BULGES_M * bulges + scenario.roughness_m * fine)
    return Valley(ground, ground.with_nodes(np.zeros(shape)), scenario.size)


def falls(valley: Valley) -> NodeField:
    """Return the pattern of scars and debris, for a largest depth of one metre."""
    ground = valley.ground
    up, along = (
        first_m + ground.step_m * np.arange(count, dtype=np.float64)
        for first_m, count in zip((ground.south_m, ground.west_m), ground.node.shape, strict=True)
    )
    pattern = np.zeros(ground.node.shape)
    for along_m, up_m, half_width_m, half_height_m, depth in FALLS_M:
        away = np.hypot((along[None, :] - along_m) / half_width_m, (up[:, None] - up_m) / half_height_m)
        inward = np.clip(2 * (1 - away), 0, 1)
        pattern += depth * inward**2 * (3 - 2 * inward)
    return ground.with_nodes(pattern)


def to_face(east_north_up_m: Floats) -> Floats:
    """Return points of east-north-up (3, n) along, up and out of the face [m]."""
    return np.asarray(axes() @ (east_north_up_m - np.array(ORIGIN_M)[:, None]))


def from_face(along_up_out_m: Floats) -> Floats:
    """Return points along, up and out of the face (3, n) in east-north-up [m]."""
    return np.asarray(axes().T @ along_up_out_m + np.array(ORIGIN_M)[:, None])
