"""Ground classes of cells: hold-out blocks, brightness, slope and noise class."""

import numpy as np
import pytest
from scipy import ndimage

from station.quantities import Grid
from station.science.adjustment import ground_classes
from station.science.adjustment.patches import GroundClass

GRID = Grid(632_000.0, 5_186_000.0, 10.0, 400, 350)


def test_holdout_is_a_tenth_of_all_ground_in_blocks_of_50_m():
    holdout = ground_classes.is_holdout(GRID.x_m, GRID.y_m[:, None])
    assert holdout.mean() == pytest.approx(0.1, abs=0.01)
    blocks = holdout.reshape(70, 5, 80, 5)
    assert (blocks.all(axis=(1, 3)) == blocks.any(axis=(1, 3))).all()
    by_block = blocks[:, 0, :, 0]
    for strips in (
        by_block[:70].reshape(7, 10, 80).mean(axis=(1, 2)),
        by_block.reshape(70, 8, 10).mean((0, 2)),
    ):
        assert strips.min() > 0.05  # in every strip of 500 m
        assert strips.max() < 0.15


@pytest.mark.parametrize("cell_m", [10.0, 5.0, 2.5])
def test_holdout_does_not_depend_on_the_grid(cell_m):
    """Grids shifted by 730 m and 290 m, with different cell sizes."""
    moved = Grid(632_730.0, 5_185_710.0, cell_m, int(1000 / cell_m), int(1000 / cell_m))
    actual = ground_classes.is_holdout(moved.x_m, moved.y_m[:, None])
    column = np.floor((moved.x_m - GRID.west_m) / GRID.cell_m).astype(int)
    row = np.floor((GRID.north_m - moved.y_m) / GRID.cell_m).astype(int)
    assert np.array_equal(actual, ground_classes.is_holdout(GRID.x_m, GRID.y_m[:, None])[np.ix_(row, column)])
    assert 0.05 < actual.mean() < 0.15


@pytest.mark.parametrize(
    ("stable", "holdout", "slope_deg", "changed", "expected"),
    [
        (True, False, 60, False, GroundClass.STABLE),
        (True, False, 10, False, GroundClass.STABLE),
        (True, True, 60, False, GroundClass.HOLDOUT),
        (True, False, 60, True, GroundClass.UNUSED),  # snow on rock too steep for a smooth cover
        (True, False, 10, True, GroundClass.MOVING),
        (True, True, 10, True, GroundClass.MOVING),
        (False, True, 10, False, GroundClass.MOVING),
        (False, False, 36, False, GroundClass.MOVING),
        (False, False, 38, False, GroundClass.UNUSED),
        (False, True, 60, True, GroundClass.UNUSED),
    ],
)
def test_ground_class_of_a_cell(stable, holdout, slope_deg, changed, expected):
    smooth = np.tan(np.radians(slope_deg)) < ground_classes.MAX_MOVING_SLOPE
    cell = [np.array([value]) for value in (stable, holdout, smooth, changed)]
    assert ground_classes.classify(*cell).tolist() == [expected]


def test_slopes_above_40_degrees_hold_no_snow():
    x_m = np.arange(30) * 5.0
    for slope_deg, expected in ((39, False), (41, True)):
        plane = np.tan(np.radians(slope_deg)) * (0.6 * x_m[None, :] + 0.8 * x_m[:, None])
        assert (ground_classes.holds_no_snow(plane, Grid(0.0, 150.0, 5.0, 30, 30)) == expected).all()


FLAT, STEEP = np.zeros(1, bool), np.ones(1, bool)
NEAR_INFRARED_UM, SHORT_WAVE_UM = 1.064, 1.55


def changed(wavelength_um, now, then, *, gain=1.0, steep=FLAT):
    """Return whether ground of reflectance `then` counts as changed when it reflects `now`."""
    cells = np.full(100, 0.3, np.float32)
    test = ground_classes.snow_test(np.float32(gain) * cells, cells, cells, wavelength_um)
    pair = (np.array([gain * now], np.float32), np.array([then], np.float32))
    return test.changed(*pair, steep).tolist() == [True]


@pytest.mark.parametrize("gain", [1.0, 0.87, 1.14])
@pytest.mark.parametrize(
    ("wavelength_um", "now", "then", "expected"),
    [
        (NEAR_INFRARED_UM, 0.85, 0.35, True),  # fresh snow on rock
        (NEAR_INFRARED_UM, 0.60, 0.40, True),  # coarse wet snow on bright rock
        (NEAR_INFRARED_UM, 0.20, 0.60, True),  # snow has melted
        (NEAR_INFRARED_UM, 0.18, 0.30, False),  # wet rock
        (NEAR_INFRARED_UM, 0.33, 0.30, False),
        (SHORT_WAVE_UM, 0.15, 0.35, True),  # fresh, fine snow on rock
        (SHORT_WAVE_UM, 0.03, 0.35, True),  # old snow
        (SHORT_WAVE_UM, 0.10, 0.20, True),  # fine snow on dark rock
        (SHORT_WAVE_UM, 0.35, 0.10, True),  # snow has melted
        (SHORT_WAVE_UM, 0.21, 0.35, False),  # wet rock
        (SHORT_WAVE_UM, 0.35, 0.21, False),  # the rock of the reference was wet
        (SHORT_WAVE_UM, 0.38, 0.30, False),
    ],
)
def test_snow_is_bright_at_1064_nm_and_dark_at_1550_nm(wavelength_um, now, then, expected, gain):
    assert changed(wavelength_um, now, then, gain=gain) == expected
    assert changed(wavelength_um, now, then, gain=gain, steep=STEEP) == expected


@pytest.mark.parametrize(
    ("wavelength_um", "rock", "snow"), [(NEAR_INFRARED_UM, 0.25, 0.60), (SHORT_WAVE_UM, 0.30, 0.10)]
)
def test_snow_shows_at_the_depth_up_to_which_it_may_be_unseen(wavelength_um, rock, snow):
    """Patches of it cover rock by a share that grows with the depth, up to all of it at 3 cm."""
    depths_m = np.linspace(0.0, 0.03, 301)
    shows = [changed(wavelength_um, rock + (snow - rock) * depth / 0.03, rock) for depth in depths_m]
    seen_m = depths_m[np.argmax(shows)]
    assert 0.95 * seen_m < ground_classes.unseen_snow(wavelength_um)[0] < 2 * seen_m


ROCK_AND_SNOW = {NEAR_INFRARED_UM: (0.25, 0.6), SHORT_WAVE_UM: (0.3, 0.1)}


def shown(
    wavelength_um, *, cover=0.0, gain=1.0, extinction_per_m=(0.0, 0.0), wetness=1.0, steep_cells=400, seed=0
):
    """Return whether snow shows on 5000 cells of rock, steeper the farther away they are.

    Snow covers a share of all but the steep ones, in drifts. The air absorbs light on the way, there and
    back, by the first of two coefficients in the reference, by the second in the scan (Beer and Lambert).
    """
    rng = np.random.default_rng(seed)
    rock, snow = ROCK_AND_SNOW[wavelength_um]
    range_m = rng.uniform(300, 3000, 5000)
    steep = np.zeros(5000, bool)
    steep[rng.choice(5000, steep_cells, replace=False, p=range_m / range_m.sum())] = True
    drifts = cover * rng.exponential(1.0, 5000) * ~steep
    then = rng.uniform(0.7, 1.3, 5000) * rock
    now = gain * then * (wetness + drifts.clip(0, 1) * (snow / rock - wetness))
    then, now = (
        (values * np.exp(-2 * coefficient * range_m) * rng.normal(1, 0.05, 5000)).astype(np.float32)
        for values, coefficient in zip((then, now), extinction_per_m, strict=True)
    )
    return ground_classes.snow_shows(now, then, range_m, steep, wavelength_um)


@pytest.mark.parametrize("wavelength_um", [NEAR_INFRARED_UM, SHORT_WAVE_UM])
@pytest.mark.parametrize("seed", range(5))
def test_snow_that_no_cell_shows_is_seen_on_all_of_them(wavelength_um, seed):
    rock, snow = ROCK_AND_SNOW[wavelength_um]
    assert not changed(wavelength_um, rock + 0.06 * (snow - rock), rock)
    haze = (0.5e-4, 2e-4)  # visibility of 80 and 20 km
    assert shown(wavelength_um, cover=0.06, gain=0.9, extinction_per_m=haze, seed=seed)


@pytest.mark.parametrize("wavelength_um", [NEAR_INFRARED_UM, SHORT_WAVE_UM])
@pytest.mark.parametrize(
    "condition",
    [
        {},
        {"gain": 1.14},
        {"extinction_per_m": (0.5e-4, 4e-4)},
        {"extinction_per_m": (4e-4, 0.5e-4)},
        {"wetness": 0.7},  # rock, steep or not
    ],
)
def test_neither_gain_nor_haze_nor_rain_looks_like_snow(wavelength_um, condition):
    assert {shown(wavelength_um, seed=seed, **condition) for seed in range(20)} == {False}


def test_brightness_cannot_tell_snow_with_little_steep_rock_or_none():
    assert shown(NEAR_INFRARED_UM, cover=0.5, steep_cells=30) is None
    dark = np.zeros(1000, np.float32)
    steep = np.arange(1000) % 2 == 0
    assert ground_classes.snow_shows(dark, dark, np.full(1000, 500.0), steep, NEAR_INFRARED_UM) is None


@pytest.mark.parametrize("wavelength_um", [NEAR_INFRARED_UM, SHORT_WAVE_UM])
@pytest.mark.parametrize("pair", [(np.nan, 0.3), (0.3, np.nan), (np.nan, np.nan), (0.3, 0.0)])
def test_without_brightness_only_steep_ground_is_known_to_be_unchanged(wavelength_um, pair):
    assert changed(wavelength_um, *pair)
    assert not changed(wavelength_um, *pair, steep=STEEP)


@pytest.mark.parametrize(
    ("snow_share", "common", "expected"),
    [(0.0, 1.1, 1.1), (0.4, 1.1, 1.1), (0.0, 0.9, 0.9), (0.9, 1.0, 1.0), (0.0, 1.2, 1.0), (0.0, 0.8, 1.0)],
)
def test_gain_is_the_common_factor_of_the_receiver_but_not_of_snow(snow_share, common, expected):
    rng = np.random.default_rng(2)
    then = rng.uniform(0.2, 0.4, 2000).astype(np.float32)
    snow = rng.random(2000) < snow_share
    now = then * common * rng.normal(1, 0.02, 2000) * np.where(snow, 2.5, 1.0)
    then[::7] = np.nan
    test = ground_classes.snow_test(now.astype(np.float32), then, then, NEAR_INFRARED_UM)
    assert test.gain == pytest.approx(expected, abs=0.03)


def test_a_few_cells_tell_no_gain():
    few = np.full(49, 0.3, np.float32)
    assert ground_classes.snow_test(few * np.float32(1.1), few, few, NEAR_INFRARED_UM).gain == 1.0


def test_a_cell_beside_three_snowy_ones_has_a_little_snow_too():
    """Compared with a convolution, at the edges of the grid and beside cells that are not stable as well."""
    rng = np.random.default_rng(6)
    grid = Grid(0.0, 300.0, 5.0, 80, 60)
    stable, snowy = rng.random((2, *grid.shape)) < np.array([0.8, 0.3])[:, None, None]
    around = ndimage.convolve((stable & snowy).astype(int), np.ones((3, 3), int), mode="constant")
    expected = around - (stable & snowy) >= 3
    cell = np.flatnonzero(stable)
    actual = ground_classes.beside_snow(cell, snowy.flat[cell], grid)
    assert np.array_equal(actual, expected.flat[cell])
    assert 0.1 < actual.mean() < 0.5
    assert not ground_classes.beside_snow(cell, np.zeros(len(cell), bool), grid).any()


def decibel_field(reflectance):
    """Return reflectances as `intensity` of -25 to 5 dB, read as if it were linear."""
    return ((10 * np.log10(reflectance) + 25) / 30).astype(np.float32)


@pytest.mark.parametrize("is_steep", [True, False])
@pytest.mark.parametrize("snow_share", [0.0, 0.5, 1.0])
def test_decibels_that_nobody_declared_do_not_tell_snow_from_rock(snow_share, is_steep):
    rng = np.random.default_rng(4)
    rock, snow = rng.uniform(0.15, 0.35, 2000), rng.random(2000) < snow_share
    pair = np.where(snow, 0.85, rock), rock
    known = slice(None) if is_steep else slice(0)

    def tested(now, then):
        return ground_classes.snow_test(now[known], then[known], then, NEAR_INFRARED_UM)

    now, then = map(decibel_field, pair)
    assert tested(now, then).changed(now, then, np.zeros(2000, bool)).all()
    assert not tested(now, then).changed(now, then, np.ones(2000, bool)).any()
    now, then = (values.astype(np.float32) for values in pair)
    assert (tested(now, then).changed(now, then, np.zeros(2000, bool)) == snow).all()


def test_noise_classes_start_at_zero_and_group_similar_range_and_slope():
    range_m = np.array([[0.0, 499.0, 501.0, 3999.0]])
    slope = np.array([[0.0, 0.26, np.nan, 9.0]])
    actual = ground_classes.noise_class(range_m, slope)
    assert actual.min() == 0
    assert len(np.unique(actual)) == 4
    assert np.array_equal(actual, ground_classes.noise_class(range_m + 0.5, np.nan_to_num(slope) + 0.1))
    many = ground_classes.noise_class(*np.meshgrid(np.linspace(0, 4000, 200), np.linspace(0, 4, 100)))
    assert many.min() == 0
    assert many.max() < 9 * 8


@pytest.mark.parametrize("lambertian", [True, False])
@pytest.mark.parametrize(("wavelength_um", "ice", "rock"), [(1.064, 0.6, 0.25), (1.55, 0.1, 0.35)])
def test_rock_is_as_bright_as_stable_ground_at_its_range(wavelength_um, ice, rock, lambertian):
    """Raw intensity falls with the square of the range, points scatter by 12 %; a third is of no use.

    Rock faces the scanner, ice is seen at grazing incidence.
    """
    rng = np.random.default_rng(3)
    range_m, is_ice = rng.uniform(500, 4000, 30_000), rng.uniform(size=30_000) < 0.4
    cos_incidence = np.where(is_ice, rng.uniform(0.06, 0.4, 30_000), rng.uniform(0.3, 1.0, 30_000))
    stable = ~is_ice & (rng.uniform(size=30_000) < 0.5)
    intensity = np.where(is_ice, ice, rock) * (500 / range_m) ** 2 * np.exp(0.12 * rng.normal(size=30_000))
    intensity *= cos_incidence if lambertian else 1
    intensity = np.where(rng.uniform(size=30_000) < 0.3, np.nan, intensity).astype(np.float32)
    known, cells = np.isfinite(intensity), (intensity, range_m, cos_incidence)
    like_rock = ground_classes.rock_brightness(*cells, stable, ~stable, wavelength_um).resembles(*cells)
    assert not like_rock[~known].any()
    assert like_rock[known & ~is_ice].mean() > 0.95
    assert like_rock[known & is_ice].mean() < 0.05


@pytest.mark.parametrize("ice_share", [0.0, 0.1])
def test_brightness_tells_no_rock_where_little_looks_like_ice(ice_share):
    intensity = np.where(np.arange(1000) < 1000 * ice_share, 0.6, 0.25).astype(np.float32)
    stable = np.arange(1000) >= 800
    cells = intensity, np.full(1000, 900.0), np.full(1000, 0.5)
    brightness = ground_classes.rock_brightness(*cells, stable, ~stable, NEAR_INFRARED_UM)
    assert not brightness.resembles(*cells).any()


@pytest.mark.parametrize(
    ("exponent", "known_m", "nearest_m"),
    [(0, 3500, 500), (0, 1200, 500), (2, 3500, 500), (2, 1900, 500), (2, 1750, 1500)],
)
def test_rock_is_recognised_where_no_stable_ground_is_as_far(exponent, known_m, nearest_m):
    """Ice and rock at all ranges, stable rock at one of them; raw brightness falls with the range squared.

    Where it is corrected for the range, rock is recognised everywhere. Else only where it is as bright as the
    rock that is known; ice is nowhere taken for rock.
    """
    rng = np.random.default_rng(5)
    range_m, is_ice = nearest_m + rng.uniform(0, 4000, 40_000), rng.uniform(size=40_000) < 0.6
    stable = ~is_ice & (np.abs(range_m - known_m) < 250)
    intensity = (
        np.where(is_ice, 0.6, 0.25) * (1000 / range_m) ** exponent * np.exp(0.12 * rng.normal(size=40_000))
    )
    cells = intensity.astype(np.float32), range_m, np.full(40_000, 0.4)
    rock = ground_classes.rock_brightness(*cells, stable, ~stable, NEAR_INFRARED_UM).resembles(*cells)
    assert rock[is_ice].mean() < 0.05
    assert rock[~is_ice & (np.abs(range_m - known_m) < 250)].mean() > 0.9
    if not exponent:
        assert rock[~is_ice].mean() > 0.95
