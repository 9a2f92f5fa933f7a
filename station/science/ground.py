"""Which ground is what: stable, moving smoothly, or better left alone."""

from __future__ import annotations

import numpy as np

from station.quantities import Bools, Floats, Floats32, Ints
from station.science.patches import Kind
from station.science.terrain import smooth_gradient

BLOCK_M = 50.0  # of stable ground, withheld together
WITHHELD_EVERY = 10
MOVING_STEEPEST = np.tan(np.radians(37.0))  # steeper ground holds snow here and not there
STABLE_FLATTEST = np.tan(np.radians(40.0))  # of ground found stable: steep enough not to hold snow
BRIGHTER = 1.25  # rock under 1 cm of snow or more; it reflects 1064 nm two to four times as well
DARKER = 0.5  # rock that snow has left; wet rock alone is not as dark
CLASS_RANGE_M = 500.0
CLASS_SLOPE = 0.25


def withheld(x_m: Floats, y_m: Floats) -> Bools:
    """Tell which places on the map are kept out of every fit if they are stable: a tenth, in blocks of 50 m.

    The same places always, wherever the grid begins.
    """
    east = np.floor(x_m / BLOCK_M).astype(np.int64) * 73_856_093
    north = np.floor(y_m / BLOCK_M).astype(np.int64) * 19_349_663
    mixed = east ^ north
    return np.asarray((mixed ^ (mixed >> 13)) % WITHHELD_EVERY == 0)


def kinds(stable: Bools, kept_out: Bools, smooth: Bools, unlike: Bools) -> Ints:
    """Kind of cells (n,): `stable` by polygon or by its past, `unlike` those that look otherwise now.

    `smooth` are those less steep than `MOVING_STEEPEST`.
    """
    may_move = np.where(smooth, Kind.MOVING, Kind.UNUSED)
    known = np.where(kept_out, Kind.WITHHELD, Kind.STABLE)
    return np.where(stable & ~unlike, known, may_move)


def steep(elevation_m: Floats, cell_m: float) -> Bools:
    """Tell which cells (ny, nx) of a surface are too steep to hold snow."""
    east, north = smooth_gradient(elevation_m, cell_m)
    return np.asarray(np.hypot(east, north) > STABLE_FLATTEST)


def looks_unlike(intensity: Floats32, reference: Floats32) -> Bools:
    """Tell which cells (n,) are much brighter or darker than in the reference: snow came or went.

    False where either is unknown.
    """
    return np.asarray((intensity > BRIGHTER * reference) | (intensity < DARKER * reference))


def classes(range_m: Floats, tan_slope: Floats) -> Ints:
    """Class (ny, nx) of cells whose random errors are alike, by range and slope; counts from nought."""
    slope = np.minimum((np.nan_to_num(tan_slope) / CLASS_SLOPE).astype(np.int64), 7)
    return (range_m / CLASS_RANGE_M).astype(np.int64) * 8 + slope
