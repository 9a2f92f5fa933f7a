"""Ground classes of cells: stable, hold-out, moving or unused."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from station.quantities import Bools, Floats, Floats32, Ints
from station.science.adjustment.patches import GroundClass
from station.science.geometry.terrain import smooth_gradient

HOLDOUT_BLOCK_M = 50.0  # edge of a hold-out block
HOLDOUT_EVERY = 10
MAX_MOVING_SLOPE = np.tan(np.radians(37.0))  # tan; steeper ground holds snow in patches only
MIN_STABLE_SLOPE = np.tan(np.radians(40.0))  # tan; of ground detected as stable: too steep to hold snow
# tan; steeper rock holds little snow: above 60° a tenth of that on a rock face (Sommer et al., 2015)
MIN_BARE_SLOPE = np.tan(np.radians(50.0))
DARK_SNOW_UM = 1.4  # wavelength from which snow is darker than rock: water and ice absorb (Warren, 1982)
# Limits of the intensity over that of the reference. At 1064 nm snow is two to four times as bright as rock;
# below: rock after its snow has melted, above: rock under at least 1 cm of snow. At 1550 nm snow reflects 2
# to 20 % and rock 20 to 50 %. Rock that is wet now, 0.6 times as bright at worst, stays within.
BRIGHT_SNOW_RATIOS = (0.5, 1.25)
DARK_SNOW_RATIOS = (0.55, 1 / 0.55)
MAX_GAIN_CHANGE = 0.15  # of the receiver, usually 5 % from scan to scan; beyond, the ground has changed
MIN_GAIN_CELLS = 50
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

    `stable` is set by polygon or by the cell's history, `changed` where snow came or went since the
    reference (see `SnowTest`), `smooth` where the slope is below `MAX_MOVING_SLOPE`.
    """
    changeable = np.where(smooth, GroundClass.MOVING, GroundClass.UNUSED)
    stable_class = np.where(holdout, GroundClass.HOLDOUT, GroundClass.STABLE)
    return np.where(stable & ~changed, stable_class, changeable)


def holds_no_snow(elevation_m: Floats, cell_m: float) -> Bools:
    """Return True for cells (ny, nx) of a surface that are too steep to hold snow."""
    east, north = smooth_gradient(elevation_m, cell_m)
    return np.asarray(np.hypot(east, north) > MIN_STABLE_SLOPE)


@dataclass(frozen=True)
class SnowTest:
    """Tells by brightness where snow has come or gone since the reference.

    `gain` is the common factor of all intensities, between `ratios` of intensity nothing has changed.
    """

    gain: float
    ratios: tuple[float, float]

    def changed(self, intensity: Floats32, reference: Floats32, steep: Bools) -> Bools:
        """Return True for cells (n,) where snow came or went, or, unless they are `steep`, may have.

        Snow at 1064 nm makes a cell brighter, at 1550 nm darker. Where either intensity is NaN, only the
        slope tells.
        """
        ratio = _ratio(intensity, reference) / np.float32(self.gain)
        lowest, highest = self.ratios
        return np.where(np.isfinite(ratio), (ratio < lowest) | (ratio > highest), ~steep)


def snow_test(intensity: Floats32, reference: Floats32, wavelength_um: float) -> SnowTest:
    """Return the test of a scan, from the intensity of stable cells (n,) that are too steep to hold snow.

    Their median ratio is the gain, unless it is too large for one: then they have changed themselves. Flatter
    cells would not do, because the gain must not absorb the snow that lies on most of them.

    The limits follow from the reflectance of snow by wavelength and grain size: Warren (1982), Deems et al.
    (2013).
    """
    ratios = BRIGHT_SNOW_RATIOS if wavelength_um < DARK_SNOW_UM else DARK_SNOW_RATIOS
    ratio = _ratio(intensity, reference)
    ratio = ratio[np.isfinite(ratio)]
    gain = float(np.median(ratio)) if len(ratio) >= MIN_GAIN_CELLS else 1.0
    return SnowTest(gain if abs(gain - 1) <= MAX_GAIN_CHANGE else 1.0, ratios)


def _ratio(intensity: Floats32, reference: Floats32) -> Floats32:
    """Return intensities (n,) over those of the reference; NaN where either is unknown."""
    ratio = np.full(len(intensity), np.nan, np.float32)
    return np.divide(intensity, reference, out=ratio, where=reference > 0)


def noise_class(range_m: Floats, tan_slope: Floats) -> Ints:
    """Return the noise class (ny, nx), from 0: cells of similar random error, by range and slope."""
    slope = np.minimum((np.nan_to_num(tan_slope) / NOISE_CLASS_SLOPE).astype(np.int64), 7)
    return (range_m / NOISE_CLASS_RANGE_M).astype(np.int64) * 8 + slope
