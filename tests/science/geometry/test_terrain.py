"""Gradients, normals and smoothing of a surface, and its height between the cell centres."""

import itertools
import math

import numpy as np
import pytest
from scipy import interpolate, ndimage

from station.quantities import Grid, Reference
from station.science.geometry import beam, terrain
from station.science.gridding import significance

GRID = Grid(0.0, 50.0, 1.0, 40, 50)


def plane(east, north):
    x_m, y_m = np.meshgrid(GRID.x_m, GRID.y_m)
    return 2000 + east * x_m + north * y_m


def test_normal_from_slope_and_aspect_equals_that_from_the_gradient():
    """Voordendag Eq. 14 against (-dz/dx, -dz/dy, 1), for a slope that falls towards the south-east."""
    slope, aspect = math.radians(30.0), math.radians(135.0)
    east, north = -math.tan(slope) * math.sin(aspect), -math.tan(slope) * math.cos(aspect)
    normal = terrain.normal(np.array(slope), np.array(aspect))
    gradient_form = np.array([-east, -north, 1.0])
    assert normal == pytest.approx(gradient_form / np.linalg.norm(gradient_form))
    assert beam.cos_incidence(np.array([0.0, 0.0, -1.0]), normal) == pytest.approx(math.cos(slope))


def test_smooth_gradient_of_a_plane_with_gaps():
    surface = plane(0.4, -0.1)
    surface[10:14, 20:23] = np.nan
    east, north = terrain.smooth_gradient(surface, 1.0)
    known = np.isfinite(east)
    assert known[11, 21]
    assert east[known] == pytest.approx(0.4, abs=1e-4)
    assert north[known] == pytest.approx(-0.1, abs=1e-4)


def test_smooth_equals_a_normalised_gaussian_filter_on_all_and_on_some_rows():
    rng = np.random.default_rng(3)
    values = rng.normal(size=(41, 33)).astype(np.float32)
    values[rng.uniform(size=values.shape) < 0.3] = np.nan
    values[20:35, 5:20] = np.nan
    actual = terrain.smooth(values, 1.5)
    known = np.isfinite(values)
    total, weight = (
        ndimage.gaussian_filter(v, 1.5, truncate=2.0, mode="constant")
        for v in (np.where(known, values, 0.0).astype(float), known.astype(float))
    )
    assert np.array_equal(np.isfinite(actual), weight > 1e-3)
    assert np.isnan(actual).any()
    near = weight > 1e-3
    assert actual[near] == pytest.approx((total[near] / weight[near]), abs=2e-5)
    for rows in (slice(4, 30), slice(3, 41, 5), slice(0, 41, 50)):
        assert np.array_equal(terrain.smooth(values, 1.5, rows), actual[rows], equal_nan=True)
        for part, whole in zip(
            terrain.smooth_gradient(values, 2.0, rows=rows), terrain.smooth_gradient(values, 2.0), strict=True
        ):
            assert np.array_equal(part, whole[rows], equal_nan=True)


@pytest.mark.parametrize("shape", [(1, 1), (2, 9), (40, 33)])
def test_gradient_at_cells_equals_smooth_gradient(shape):
    rng = np.random.default_rng(4)
    surface = rng.normal(size=shape).astype(np.float32)
    surface[rng.uniform(size=shape) < 0.5] = np.nan
    surface[20:, 15:] = np.nan
    row, column = np.nonzero(rng.uniform(size=shape) < 0.9)
    actual = terrain.gradient_at(surface, 2.0, row, column)
    for part, whole in zip(actual, terrain.smooth_gradient(surface, 2.0), strict=True):
        assert part == pytest.approx(whole[row, column], abs=1e-6, nan_ok=True)


def test_bilinear_surface_is_exact_on_a_plane_up_to_its_edge():
    elevation_m = plane(0.5, 0.25)
    elevation_m[20:, 30:] = np.nan
    bilinear = terrain.bilinear_surface(Reference.from_elevation(GRID, "1", elevation_m))
    x_m, y_m = np.random.default_rng(0).uniform([[0.0], [0.01]], [[39.99], [50.0]], (2, 4000))
    known = bilinear.known[(50 - y_m).astype(int), x_m.astype(int)]
    height_m, east, north = bilinear.height_and_gradient(x_m[known], 50 - y_m[known])
    assert height_m == pytest.approx(2000 + 0.5 * x_m[known] + 0.25 * y_m[known], abs=1e-4)
    assert east == pytest.approx(0.5, abs=1e-3)
    assert north == pytest.approx(0.25, abs=1e-3)


def test_cell_means_of_a_window_are_those_of_the_whole_surface_that_shots_see():
    """Against the bilinear surface at 32 x 32 points in each cell, at gaps and at the border of the grid."""
    x_m, y_m = np.meshgrid(GRID.x_m, GRID.y_m)
    nodes = 2000 + 0.02 * (x_m - 20) ** 2 - 0.01 * (y_m - 20) ** 2
    nodes[20:, 10:20] = np.nan
    surface = terrain.bilinear_surface(Reference.from_elevation(GRID, "1", nodes))
    rows, columns = slice(15, GRID.ny), slice(0, 25)
    actual = terrain.known_cell_means(nodes, rows, columns)
    offset = (np.arange(32) + 0.5) / 32
    expected = np.full(actual.shape, np.nan)
    for row, column in np.argwhere(np.isfinite(nodes[rows, columns])):
        across, down = (grid.ravel() for grid in np.meshgrid(column + offset, row + rows.start + offset))
        expected[row, column] = surface.height(across, down).mean()
    np.testing.assert_allclose(actual, expected, atol=2e-4)


@pytest.mark.parametrize(("axis", "step_m"), [(0, (0.1, 0.0)), (1, (0.0, 0.1))])
def test_residuals_of_displaced_points_change_by_the_gradients_of_cells(axis, step_m):
    """Points all over cells of fractal relief with a gap, displaced by 0.1 m: by SciPy's interpolation.

    A gradient smoothed over 1.5 cells is too small for that.
    """
    rng, grid = np.random.default_rng(7), Grid(0.0, 400.0, 4.0, 90, 100)
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(grid.nx), np.fft.fftfreq(grid.ny)))
    spectrum = np.fft.fft2(rng.normal(size=grid.shape)) / np.maximum(frequency, 1 / 100) ** 1.8
    nodes = np.fft.ifft2(spectrum).real
    nodes *= 10.0 / nodes.std()
    nodes[40:50, 20:30] = np.nan
    surface = terrain.bilinear_surface(Reference.from_elevation(grid, "1", nodes))
    parts = [surface.cell_gradients(rows)[axis] for rows in (slice(0, 37), slice(37, 100))]
    extended = np.where(np.isfinite(nodes), nodes, surface.height_above_datum_m + surface.datum_m)
    height_m = interpolate.RegularGridInterpolator((-grid.y_m, grid.x_m), extended, bounds_error=False)
    x_m, y_m = np.meshgrid(grid.x_m, grid.y_m)
    change_m, offset_m = np.zeros(grid.shape), 4.0 * (np.arange(16) + 0.5) / 16 - 2.0
    for east_m, north_m in itertools.product(offset_m, offset_m):
        ahead, behind = (
            (-(y_m + north_m + side * step_m[1] / 2), x_m + east_m + side * step_m[0] / 2) for side in (1, -1)
        )
        change_m += height_m(ahead) - height_m(behind)
    inside = np.isfinite(nodes)
    inside[[0, -1]] = inside[:, [0, -1]] = False  # points of the others leave the grid
    expected = change_m[inside] / len(offset_m) ** 2 / 0.1
    np.testing.assert_allclose(np.concatenate(parts)[inside], expected, atol=0.01 * np.std(expected))
    smooth = terrain.smooth_gradient(nodes, grid.cell_m)[axis][inside]
    assert np.sum(smooth * expected) / np.sum(smooth**2) > 1.1


def test_cell_means_of_a_curved_surface_and_nodes_from_them():
    """A paraboloid of radius 1 km on 10 m cells: means differ from nodes by 12.5 mm per direction."""
    rng = np.random.default_rng(2)
    grid = Grid(0.0, 300.0, 10.0, 30, 30)
    nodes = np.broadcast_to(grid.x_m, grid.shape) ** 2 / 2000
    surface = terrain.BilinearSurface(grid, 0.0, nodes.astype(np.float32), np.ones(grid.shape, np.int32))
    column, row = rng.uniform(14, 15, (2, 200_000))
    assert terrain.cell_means(nodes)[14, 14] == pytest.approx(
        surface.height_and_gradient(column, row)[0].mean(), abs=1e-3
    )
    assert terrain.cell_means(nodes)[14, 14] - nodes[14, 14] == pytest.approx(0.0125, abs=1e-6)
    means = nodes + 1.0
    assert terrain.cell_means(terrain.nodes_from_means(means))[3:-3, 3:-3] == pytest.approx(
        means[3:-3, 3:-3], abs=1e-9
    )
    means[10, 10] = np.nan
    assert np.array_equal(np.isnan(terrain.nodes_from_means(means)), np.isnan(means))


def test_significance_at_the_95_percent_level():
    sigma = np.full(100_000, 0.1, np.float32)
    noise = np.random.default_rng(1).normal(0, 0.1, 100_000).astype(np.float32)
    assert significance.significant(noise, sigma).mean() == pytest.approx(0.05, abs=0.003)
    assert not significance.significant(np.array([np.nan], np.float32), sigma[:1])[0]


def test_fitted_planes_keep_a_plane_and_average_noise_where_cells_are_missing():
    rng = np.random.default_rng(7)
    x, y = np.meshgrid(np.arange(200.0), np.arange(180.0))
    plane = 1000 + 0.7 * x - 0.3 * y
    sparse = np.where(rng.random(plane.shape) < 0.3, plane, np.nan)
    assert terrain.fit_planes(sparse)[20:-20, 20:-20] == pytest.approx(
        sparse[20:-20, 20:-20], abs=0.05, nan_ok=True
    )
    noise = rng.normal(0, 1.0, plane.shape)
    fitted = terrain.fit_planes(sparse + noise)
    assert np.array_equal(np.isnan(fitted), np.isnan(sparse))
    assert np.nanstd((fitted - plane)[20:-20, 20:-20]) < 0.3  # of 1.0 without the fit


def test_fitted_planes_leave_cells_with_all_neighbours():
    rough = np.random.default_rng(8).normal(0, 1.0, (40, 50))
    rough[20, 25] = np.nan
    fitted = terrain.fit_planes(rough, keep_dense=True)
    dense = np.ones(rough.shape, bool)
    dense[[0, -1]], dense[:, [0, -1]], dense[19:22, 24:27] = False, False, False
    assert np.array_equal(fitted[dense], rough[dense])
    assert (fitted != rough)[~dense].all()


def test_fitted_plane_equals_a_weighted_least_squares_fit():
    rng = np.random.default_rng(9)
    heights = np.where(rng.random((41, 41)) < 0.05, rng.normal(0, 1.0, (41, 41)), np.nan)
    heights[20, 20] = 0.5
    sigma, half = 6.0, 12
    offset = np.arange(-half, half + 1)
    window = heights[20 - half : 20 + half + 1, 20 - half : 20 + half + 1]
    row, column = np.nonzero(np.isfinite(window))
    x, y = offset[column], offset[row]
    root_weight = np.exp(-(x**2 + y**2) / (4 * sigma**2))
    design = np.stack([np.ones(len(x)), x, y], axis=1) * root_weight[:, None]
    expected = np.linalg.lstsq(design, window[row, column] * root_weight, rcond=None)[0][0]
    assert terrain.fit_planes(heights)[20, 20] == pytest.approx(expected, abs=0.01)
