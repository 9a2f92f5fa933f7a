"""Which ground is stable, withheld, moving or unused."""

import numpy as np
import pytest

from station.quantities import Grid
from station.science import ground
from station.science.patches import Kind

GRID = Grid(632_000.0, 5_186_000.0, 10.0, 400, 350)


def test_a_tenth_is_withheld_everywhere_in_blocks_of_fifty_metres():
    kept_out = ground.withheld(GRID.x_m, GRID.y_m[:, None])
    assert kept_out.mean() == pytest.approx(0.1, abs=0.01)
    blocks = kept_out.reshape(70, 5, 80, 5)
    assert (blocks.all(axis=(1, 3)) == blocks.any(axis=(1, 3))).all()
    of_blocks = blocks[:, 0, :, 0]
    for strips in (
        of_blocks[:70].reshape(7, 10, 80).mean(axis=(1, 2)),
        of_blocks.reshape(70, 8, 10).mean((0, 2)),
    ):
        assert strips.min() > 0.05  # also of every strip of half a kilometre
        assert strips.max() < 0.15


@pytest.mark.parametrize("cell_m", [10.0, 5.0, 2.5])
def test_the_same_ground_is_withheld_wherever_the_grid_begins(cell_m):
    """Of a grid moved by 730 m and 290 m, and of one with other cells."""
    moved = Grid(632_730.0, 5_185_710.0, cell_m, int(1000 / cell_m), int(1000 / cell_m))
    told = ground.withheld(moved.x_m, moved.y_m[:, None])
    column = np.floor((moved.x_m - GRID.west_m) / GRID.cell_m).astype(int)
    row = np.floor((GRID.north_m - moved.y_m) / GRID.cell_m).astype(int)
    assert np.array_equal(told, ground.withheld(GRID.x_m, GRID.y_m[:, None])[np.ix_(row, column)])
    assert 0.05 < told.mean() < 0.15


@pytest.mark.parametrize(
    ("stable", "kept_out", "slope_deg", "unlike", "wanted"),
    [
        (True, False, 60, False, Kind.STABLE),
        (True, False, 10, False, Kind.STABLE),
        (True, True, 60, False, Kind.WITHHELD),
        (True, False, 60, True, Kind.UNUSED),  # rock under snow, too steep for a smooth cover
        (True, False, 10, True, Kind.MOVING),
        (True, True, 10, True, Kind.MOVING),
        (False, True, 10, False, Kind.MOVING),
        (False, False, 36, False, Kind.MOVING),
        (False, False, 38, False, Kind.UNUSED),
        (False, True, 60, True, Kind.UNUSED),
    ],
)
def test_kind_of_a_cell(stable, kept_out, slope_deg, unlike, wanted):
    smooth = np.tan(np.radians(slope_deg)) < ground.MOVING_STEEPEST
    one = [np.array([value]) for value in (stable, kept_out, smooth, unlike)]
    assert ground.kinds(*one).tolist() == [wanted]


def test_a_plane_is_steep_beyond_forty_degrees():
    x_m = np.arange(30) * 5.0
    for slope_deg, wanted in ((39, False), (41, True)):
        plane = np.tan(np.radians(slope_deg)) * (0.6 * x_m[None, :] + 0.8 * x_m[:, None])
        assert (ground.steep(plane, 5.0) == wanted).all()


def test_cells_look_unlike_under_snow_or_without_it_but_not_wet_nor_where_unknown():
    rng = np.random.default_rng(1)
    now, then = rng.uniform(0.05, 1, (2, 500)).astype(np.float32)
    told = ground.looks_unlike(now, then)
    assert np.array_equal(told, (now / then > 1.25) | (now / then < 0.5))
    assert 50 < told.sum() < 450
    rock = np.full(3, 0.25, np.float32)
    told = ground.looks_unlike(np.array([0.25 * 2.4, 0.25 * 0.65, 0.25 * 1.08], np.float32), rock)
    assert told.tolist() == [True, False, False]  # snow, wet rock, another gain
    nan = np.full(500, np.nan, np.float32)
    assert not ground.looks_unlike(now, nan).any()
    assert not ground.looks_unlike(nan, then).any()
    assert not ground.looks_unlike(nan, nan).any()


def test_classes_count_from_nought_and_hold_what_is_alike():
    range_m = np.array([[0.0, 499.0, 501.0, 3999.0]])
    slope = np.array([[0.0, 0.26, np.nan, 9.0]])
    told = ground.classes(range_m, slope)
    assert told.min() == 0
    assert len(np.unique(told)) == 4
    assert np.array_equal(told, ground.classes(range_m + 0.5, np.nan_to_num(slope) + 0.1))
    many = ground.classes(*np.meshgrid(np.linspace(0, 4000, 200), np.linspace(0, 4, 100)))
    assert many.min() == 0
    assert many.max() < 9 * 8
