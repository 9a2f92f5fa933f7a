"""Gridder: streaming cell statistics against plain loops."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from station.quantities import Grid, Reference
from station.science.geometry.terrain import bilinear_surface
from station.science.gridding.gridder import Gridder, slope_sampling_variance

GRID = Grid(west_m=100.0, north_m=250.0, cell_m=2.5, nx=8, ny=6)


def scatter(seed=0, count=500):
    rng = np.random.default_rng(seed)
    x_m, y_m = rng.uniform(98, 122, count), rng.uniform(233, 252, count)
    return x_m, y_m, rng.normal(3000, 0.5, count)


def gridded(points, surface=None, splits=(), intensity=None):
    gridder = Gridder(GRID, surface, 3000.0)
    parts = [np.split(axis, splits) for axis in points]
    intensities = [None] * len(parts[0]) if intensity is None else np.split(intensity, splits)
    for x_m, y_m, z_m, block_intensity in zip(*parts, intensities, strict=True):
        inside, column, row = gridder.locate(x_m, y_m)
        heights_m = z_m[inside] - gridder.datum_m
        gridder.add(
            gridder.cell_indices(column, row),
            heights_m,
            None if block_intensity is None else block_intensity[inside],
        )
    return gridder


def test_count_mean_and_standard_deviation_equal_plain_loops():
    x_m, y_m, z_m = scatter()
    sums = gridded((x_m, y_m, z_m)).rasters()
    for row in range(GRID.ny):
        for column in range(GRID.nx):
            north, west = GRID.north_m - row * GRID.cell_m, GRID.west_m + column * GRID.cell_m
            inside = (x_m >= west) & (x_m < west + 2.5) & (y_m <= north) & (y_m > north - 2.5)
            heights = z_m[inside]
            assert sums.count[row, column] == len(heights)
            assert sums.mean_residual()[row, column] + 3000 == pytest.approx(heights.mean(), abs=1e-6)
            if len(heights) > 1:
                assert sums.standard_deviation()[row, column] == pytest.approx(heights.std(ddof=1), abs=1e-4)


def test_mean_intensity_equals_plain_loops():
    x_m, y_m, z_m = scatter(seed=2)
    values = np.random.default_rng(3).integers(1, 65536, len(x_m)) / 65535
    actual = gridded((x_m, y_m, z_m), intensity=values).rasters().intensity()
    assert np.isnan(gridded((x_m, y_m, z_m)).rasters().intensity()).all()
    for row, column in np.ndindex(GRID.shape):
        north, west = GRID.north_m - row * GRID.cell_m, GRID.west_m + column * GRID.cell_m
        inside = (x_m >= west) & (x_m < west + 2.5) & (y_m <= north) & (y_m > north - 2.5)
        assert actual[row, column] == pytest.approx(values[inside].mean(), rel=1e-6)


@pytest.mark.parametrize(("count", "mean"), [(65_537, 1.0), (65_538, np.nan)])
def test_mean_intensity_up_to_the_capacity_of_its_sum(count, mean):
    points = np.full(count, 101.0), np.full(count, 249.0), np.full(count, 3000.0)
    sums = gridded(points, intensity=np.ones(count)).rasters()
    assert sums.count[0, 0] == count
    assert sums.intensity()[0, 0] == pytest.approx(mean, nan_ok=True)


def test_rasters_hold_the_cells_of_the_reference_only():
    elevation_m = np.where(np.arange(GRID.nx) < 4, 3000.0, np.nan) * np.ones((GRID.ny, 1))
    surface = bilinear_surface(Reference.from_elevation(GRID, "1", elevation_m))
    gridder = gridded(scatter(seed=4), surface, intensity=np.full(500, 0.5))
    sums = gridder.rasters()
    assert (sums.count[:, :4] > 0).all()
    assert not sums.count[:, 4:].any()
    assert len(gridder.new_cells()) == GRID.ny * (GRID.nx - 4)
    assert sums.intensity()[:, :4] == pytest.approx(0.5, rel=1e-4)
    assert np.isnan(sums.intensity()[:, 4:]).all()


@settings(max_examples=50, deadline=None)
@given(st.permutations(range(60)), st.lists(st.integers(0, 60), max_size=5))
def test_sums_are_independent_of_order_and_blocks_to_the_last_bit(order, splits):
    points, values = np.array(scatter(seed=1, count=60)), np.linspace(0.1, 0.9, 60)
    plain = gridded(points, intensity=values).rasters()
    mixed = gridded(points[:, order], splits=sorted(splits), intensity=values[order]).rasters()
    assert np.array_equal(plain.mean_residual(), mixed.mean_residual(), equal_nan=True)
    assert np.array_equal(plain.standard_deviation(), mixed.standard_deviation(), equal_nan=True)
    assert np.array_equal(plain.intensity(), mixed.intensity(), equal_nan=True)


def test_points_on_edges_belong_to_the_cell_east_and_south():
    gridder = gridded((np.array([100.0, 102.5, 120.0]), np.array([250.0, 247.5, 240.0]), np.full(3, 3000.0)))
    assert np.argwhere(gridder.rasters().count).tolist() == [[0, 0], [1, 1]]


def test_residuals_to_a_sloping_reference_have_no_sampling_error():
    """A plain mean of n points on a slope scatters by c tan s / sqrt(12 n): equations.md, 4.10."""
    rng = np.random.default_rng(5)
    grid = Grid(0.0, 200.0, 1.0, 200, 200)
    slope = math.tan(math.radians(25))
    x_m, y_m = rng.uniform(0, 200, (2, 60_000))
    z_m = slope * x_m
    truth = slope * np.broadcast_to(grid.x_m, grid.shape)
    without_reference = Gridder(grid, None, 0.0)
    surface = bilinear_surface(Reference.from_elevation(grid, "1", truth))
    with_reference = Gridder(grid, surface, 0.0)
    for gridder in (without_reference, with_reference):
        _, column, row = gridder.locate(x_m, y_m)
        datum_m = 0.0 if gridder is without_reference else surface.height_and_gradient(column, row)[0]
        gridder.add(gridder.cell_indices(column, row), z_m - datum_m, None)
    count = without_reference.rasters().count
    two_points = count == 2
    scatter_m = (without_reference.rasters().mean_residual() - truth)[two_points].std()
    assert scatter_m == pytest.approx(
        math.sqrt(slope_sampling_variance(1.0, np.array(slope), np.array(2))), rel=0.05
    )
    interior = two_points[:, 1:-1]
    assert np.abs(with_reference.rasters().mean_residual()[:, 1:-1][interior]).max() < 1e-3
