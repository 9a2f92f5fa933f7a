"""Ground classes of cells: hold-out blocks, brightness, slope and noise class."""

import numpy as np
import pytest

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
        assert (ground_classes.holds_no_snow(plane, 5.0) == expected).all()


def test_brightness_changes_with_snow_but_not_with_wetness_or_missing_intensity():
    rng = np.random.default_rng(1)
    now, then = rng.uniform(0.05, 1, (2, 500)).astype(np.float32)
    actual = ground_classes.brightness_changed(now, then)
    assert np.array_equal(actual, (now / then > 1.25) | (now / then < 0.5))
    assert 50 < actual.sum() < 450
    rock = np.full(3, 0.25, np.float32)
    actual = ground_classes.brightness_changed(
        np.array([0.25 * 2.4, 0.25 * 0.65, 0.25 * 1.08], np.float32), rock
    )
    assert actual.tolist() == [True, False, False]  # snow, wet rock, a different gain
    nan = np.full(500, np.nan, np.float32)
    assert not ground_classes.brightness_changed(now, nan).any()
    assert not ground_classes.brightness_changed(nan, then).any()
    assert not ground_classes.brightness_changed(nan, nan).any()


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
