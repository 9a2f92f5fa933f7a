"""Ground classes of cells: stable, hold-out, moving or unused."""

from __future__ import annotations

import numpy as np

from station.quantities import Bools, Floats, Floats32, Ints
from station.science.adjustment.patches import GroundClass
from station.science.geometry.terrain import smooth_gradient

HOLDOUT_BLOCK_M = 50.0  # edge of a hold-out block
HOLDOUT_EVERY = 10
MAX_MOVING_SLOPE = np.tan(np.radians(37.0))  # tan; steeper ground holds snow in patches only
MIN_STABLE_SLOPE = np.tan(np.radians(40.0))  # tan; of ground detected as stable: too steep to hold snow
MAX_INTENSITY_RATIO = (
    1.25  # above: rock under at least 1 cm of snow, which reflects 1064 nm two to four times as well
)
MIN_INTENSITY_RATIO = 0.5  # below: rock after its snow has melted; wet rock alone is not as dark
NOISE_CLASS_RANGE_M = 500.0
NOISE_CLASS_SLOPE = 0.25


def is_holdout(x_m: Floats, y_m: Floats) -> Bools:
    """Return True for map positions (n,) that belong to the hold-out: a tenth, in blocks of 50 m.

    Stable cells of the hold-out are excluded from every fit. The blocks depend on the map position only, not
    on the origin of the grid.
    """
    east = np.floor(x_m / HOLDOUT_BLOCK_M).astype(np.int64) * 73_856_093
    north = np.floor(y_m / HOLDOUT_BLOCK_M).astype(np.int64) * 19_349_663
    mixed = east ^ north
    return np.asarray((mixed ^ (mixed >> 13)) % HOLDOUT_EVERY == 0)


def classify(stable: Bools, holdout: Bools, smooth: Bools, changed: Bools) -> Ints:
    """Return the ground class of cells (n,).

    `stable` is set by polygon or by the cell's history, `changed` where the brightness differs from the
    reference, `smooth` where the slope is below `MAX_MOVING_SLOPE`.
    """
    changeable = np.where(smooth, GroundClass.MOVING, GroundClass.UNUSED)
    stable_class = np.where(holdout, GroundClass.HOLDOUT, GroundClass.STABLE)
    return np.where(stable & ~changed, stable_class, changeable)


def holds_no_snow(elevation_m: Floats, cell_m: float) -> Bools:
    """Return True for cells (ny, nx) of a surface that are too steep to hold snow."""
    east, north = smooth_gradient(elevation_m, cell_m)
    return np.asarray(np.hypot(east, north) > MIN_STABLE_SLOPE)


def brightness_changed(intensity: Floats32, reference: Floats32) -> Bools:
    """Return True for cells (n,) much brighter or darker than in the reference: snow has come or gone.

    False where either intensity is NaN.
    """
    return np.asarray(
        (intensity > MAX_INTENSITY_RATIO * reference) | (intensity < MIN_INTENSITY_RATIO * reference)
    )


def noise_class(range_m: Floats, tan_slope: Floats) -> Ints:
    """Return the noise class (ny, nx), from 0: cells of similar random error, by range and slope."""
    slope = np.minimum((np.nan_to_num(tan_slope) / NOISE_CLASS_SLOPE).astype(np.int64), 7)
    return (range_m / NOISE_CLASS_RANGE_M).astype(np.int64) * 8 + slope
