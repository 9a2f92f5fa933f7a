"""Ground classes of cells: stable, hold-out, moving or unused."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from station.quantities import Bools, Floats, Floats32, Grid, Ints, Reals
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
MIN_SNOWY_NEIGHBOURS = 3  # of a cell that has a little snow too
# Largest depth of patchy snow that stays within these limits. An estimate: some 3 cm cover rock, and bright
# snow shows when it covers a fifth of a cell, dark snow when it covers two thirds.
UNSEEN_SNOW_M, UNSEEN_DARK_SNOW_M = 0.01, 0.02
# The same of deep snow, over its depth on other ground: cover times a tenth, which steep rock holds (ibid.).
UNSEEN_SNOW_SHARE, UNSEEN_DARK_SNOW_SHARE = 0.02, 0.067
# Logarithm of the change in brightness from which rock shows snow, on the mean of many cells and against
# steep rock, and the same in sigmas. On simulated stations it is within 0.008 of zero without snow, and 0.03
# to 0.09 under 6 mm, which begins to cover rock where it is deepest (equations.md, 6.22).
SNOWY_LOG_RATIO, SNOWY_SIGMAS = 0.02, 3.0
MAX_GAIN_CHANGE = 0.15  # of the receiver, usually 5 % from scan to scan; beyond, the ground has changed
MIN_GAIN_CELLS = 50
MAX_GROUND_INTENSITY = 0.5  # of the scale; snow of twice that would not be on it
# At 1064 nm ice and snow reflect 0.5 to 0.9 of the light, rock 0.2 to 0.3 (Deems et al., 2013; Warren, 1982).
ICE_RATIO = 1.5  # of the brightness of ice or snow to that of rock, and of dark snow the inverse
ICE_RANGE_M = 500.0  # rings within which brightness is compared: it may fall with the distance
MIN_COS = 0.05  # of the incidence; rough ground is not seen at less
MIN_ICE_SHARE = 0.2  # of moving ground; if less of it looks like ice, brightness does not tell ice from rock
UNCLEAR_RATIO = 1.2  # of a brightness to the limit of rock, within which it may be rock or not
MAX_UNCLEAR_SHARE = 0.2  # of moving ground at a range at which no stable ground is known
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


def holds_no_snow(elevation_m: Floats, grid: Grid) -> Bools:
    """Return True for cells (ny, nx) of a surface that are too steep to hold snow."""
    return np.asarray(grid.plane.tan_slope(*smooth_gradient(elevation_m, grid.cell_m)) > MIN_STABLE_SLOPE)


@dataclass(frozen=True)
class SnowTest:
    """Tells by brightness where snow has come or gone since the reference.

    `gain` is the common factor of all intensities, between `ratios` of intensity nothing has changed. The
    gain is NaN if intensity does not tell snow from rock.
    """

    gain: float
    ratios: tuple[float, float]

    def changed(self, intensity: Floats32, reference: Floats32, steep: Bools) -> Bools:
        """Return True for cells (n,) where snow came or went, or, unless they are `steep`, may have.

        Where either intensity is NaN, or the gain, only the slope tells.
        """
        ratio = self._ratio(intensity, reference)
        return self.shows(intensity, reference) | (np.isnan(ratio) & ~steep)

    def shows(self, intensity: Floats32, reference: Floats32) -> Bools:
        """Return True for cells (n,) where snow came or went: brighter or, at 1550 nm, darker by it."""
        ratio = self._ratio(intensity, reference)
        lowest, highest = self.ratios
        return np.asarray((ratio < lowest) | (ratio > highest))

    def _ratio(self, intensity: Floats32, reference: Floats32) -> Floats32:
        return _ratio(intensity, reference) / np.float32(self.gain)


def beside_snow(cell: Ints, shows: Bools, grid: Grid) -> Bools:
    """Return True for cells (n,) of a grid of whose eight neighbours at least three show snow.

    A little snow lies on them too, which raises them by centimetres and their brightness by less than the
    limits. Source: adjustment.md, 4.
    """
    width = grid.nx + 2  # with a margin around the grid
    row, column = grid.row_and_column(cell)
    padded = (row + 1) * width + column + 1
    snowy = padded[shows]
    neighbours = np.zeros((grid.ny + 2) * width, np.uint8)
    for step in (-width - 1, -width, -width + 1, -1, 1, width - 1, width, width + 1):
        neighbours[snowy + step] += 1
    return np.asarray(neighbours[padded] >= MIN_SNOWY_NEIGHBOURS)


def snow_test(
    intensity: Floats32, reference: Floats32, stable_reference: Floats32, wavelength_um: float
) -> SnowTest:
    """Return the test of a scan, from the intensity of stable cells (n,) that are too steep to hold snow.

    Their median ratio is the gain, unless it is too large for one: then they have changed themselves. Flatter
    cells would not do, because the gain must not absorb the snow that lies on most of them.

    Brightness that is above half of its scale without snow is not linear, but for example in decibels that
    the site file does not declare, or of white walls: snow is hardly brighter. If too few cells are steep,
    those of all stable ground tell, `stable_reference` (m,).

    The limits follow from the reflectance of snow by wavelength and grain size: Warren (1982), Deems et al.
    (2013).
    """
    is_snow_bright = wavelength_um < DARK_SNOW_UM
    ratios = BRIGHT_SNOW_RATIOS if is_snow_bright else DARK_SNOW_RATIOS
    ratio = _ratio(intensity, reference)
    known = np.isfinite(ratio)
    is_gain_known = np.count_nonzero(known) >= MIN_GAIN_CELLS
    bare = reference[known] if is_gain_known else stable_reference[np.isfinite(stable_reference)]
    if is_snow_bright and len(bare) and np.median(bare) > MAX_GROUND_INTENSITY:
        return SnowTest(np.nan, ratios)
    gain = float(np.median(ratio[known])) if is_gain_known else 1.0
    return SnowTest(gain if abs(gain - 1) <= MAX_GAIN_CHANGE else 1.0, ratios)


def snow_shows(
    intensity: Floats32, reference: Floats32, range_m: Reals, steep: Bools, wavelength_um: float
) -> bool | None:
    """Return True if rock has become brighter, at 1550 nm darker, against rock too `steep` to hold snow.

    False if it has not, None if there are too few cells of either kind, or without intensity.

    Snow that begins to cover the ground changes no cell (n,) by as much as `SnowTest` requires, but the mean
    of all. Cells are compared within rings, and with the range: haze darkens what is far away, exponentially.
    False alarms, such as rock that has dried, widen sigma. Source: equations.md, 6.22.
    """
    ratio = _ratio(intensity, reference)
    known = ratio > 0
    ring = (range_m[known] / ICE_RANGE_M).astype(np.int64)
    count = np.maximum(np.bincount(ring), 1)
    columns = np.stack([np.log(ratio[known]), ~steep[known], range_m[known] / ICE_RANGE_M])
    columns = columns - np.stack([np.bincount(ring, column) / count for column in columns])[:, ring]
    log_ratio, design = columns[0], columns[1:]
    normal = design @ design.T
    if normal[0, 0] < MIN_GAIN_CELLS:
        return None
    inverse = np.linalg.pinv(normal)
    estimate = inverse @ design @ log_ratio
    sigma = np.sqrt(inverse[0, 0] * np.mean((log_ratio - estimate @ design) ** 2))
    snowy = estimate[0] if wavelength_um < DARK_SNOW_UM else -estimate[0]
    return bool(snowy > max(SNOWY_LOG_RATIO, SNOWY_SIGMAS * sigma))


def unseen_snow(wavelength_um: float) -> tuple[float, float]:
    """Return the largest depth of snow on stable ground that its brightness does not show [m].

    The second value is the largest one of deep snow, over its depth on other ground.
    """
    if wavelength_um < DARK_SNOW_UM:
        return UNSEEN_SNOW_M, UNSEEN_SNOW_SHARE
    return UNSEEN_DARK_SNOW_M, UNSEEN_DARK_SNOW_SHARE


@dataclass(frozen=True)
class RockBrightness:
    """Median brightness of stable ground by ring of range (k,); NaN where it does not tell rock from ice.

    With `lambertian` it is that of perpendicular incidence, and brightness falls with the cosine.
    """

    by_ring: Floats
    lambertian: bool
    snow_is_dark: bool

    def resembles(self, intensity: Floats32, range_m: Reals, cos_incidence: Reals) -> Bools:
        """Return True for cells (n,) that are no brighter than rock, or no darker where snow is dark.

        Cells of unknown brightness do not.
        """
        ring = np.minimum((range_m / ICE_RANGE_M).astype(np.int64), len(self.by_ring) - 1)
        rock = self.by_ring[ring] * (np.maximum(cos_incidence, MIN_COS) if self.lambertian else 1.0)
        return np.asarray(intensity > rock / ICE_RATIO if self.snow_is_dark else intensity < rock * ICE_RATIO)


def rock_brightness(
    intensity: Floats32,
    range_m: Reals,
    cos_incidence: Reals,
    stable: Bools,
    moving: Bools,
    wavelength_um: float,
) -> RockBrightness:
    """Return the brightness of rock, from cells (n,) of stable ground.

    Their own brightness tells whether it falls with the cosine of the incidence, by Lambert's law, or is
    corrected for it. Rings with few of them have that of the nearest one with more. That of rock is unknown
    where too little of the moving ground looks otherwise: then it may all be ice under debris, or be brighter
    or darker because of its distance. Source: equations.md, 6.9.
    """
    ring = (range_m / ICE_RANGE_M).astype(np.int64)
    known = stable & (intensity > 0)
    log_cos, log_intensity = np.log(np.maximum(cos_incidence[known], MIN_COS)), np.log(intensity[known])
    count = np.maximum(np.bincount(ring[known]), 1)
    log_cos, log_intensity = (
        values - (np.bincount(ring[known], values) / count)[ring[known]]
        for values in (log_cos, log_intensity)
    )
    lambertian = bool(log_cos @ log_intensity > 0.5 * (log_cos @ log_cos))
    normal = intensity / np.maximum(cos_incidence, MIN_COS) if lambertian else intensity
    rings = int(ring.max(initial=0)) + 1
    measured = np.flatnonzero(np.bincount(ring[known], minlength=rings) >= MIN_GAIN_CELLS)
    if not len(measured):
        return RockBrightness(np.full(rings, np.nan), lambertian, wavelength_um >= DARK_SNOW_UM)
    medians = np.array([np.median(normal[known & (ring == index)]) for index in measured])
    nearest = np.abs(np.subtract.outer(np.arange(rings), measured)).argmin(axis=1)
    rock = RockBrightness(medians[nearest], lambertian, wavelength_um >= DARK_SNOW_UM)
    compared = moving & (intensity > 0)
    is_other = compared & ~rock.resembles(intensity, range_m, cos_incidence)
    darker, brighter = (
        rock.resembles(intensity * factor, range_m, cos_incidence)
        for factor in (1 / UNCLEAR_RATIO, UNCLEAR_RATIO)
    )
    count, others, unclear = (
        np.bincount(ring[cells], minlength=rings)
        for cells in (compared, is_other, compared & (darker != brighter))
    )
    is_distinct = (others >= MIN_ICE_SHARE * np.maximum(count, 1)) & (unclear <= MAX_UNCLEAR_SHARE * count)
    is_distinct[measured] = True
    if others[measured].sum() < MIN_ICE_SHARE * max(count[measured].sum(), 1):
        is_distinct[:] = False
    return replace(rock, by_ring=np.where(is_distinct, rock.by_ring, np.nan))


def _ratio(intensity: Floats32, reference: Floats32) -> Floats32:
    """Return intensities (n,) over those of the reference; NaN where either is unknown."""
    ratio = np.full(len(intensity), np.nan, np.float32)
    return np.divide(intensity, reference, out=ratio, where=reference > 0)


def noise_class(range_m: Reals, tan_slope: Reals) -> Ints:
    """Return the noise class (ny, nx), from 0: cells of similar random error, by range and slope."""
    slope = np.minimum((np.nan_to_num(tan_slope) / NOISE_CLASS_SLOPE).astype(np.int64), 7)
    return np.asarray((range_m / NOISE_CLASS_RANGE_M).astype(np.int64) * 8 + slope)
