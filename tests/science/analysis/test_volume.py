"""Volumes by raster and mesh: values, gradients, and sigmas compared with simulated scans."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import Delaunay
from scipy.spatial.transform import Rotation

from station.quantities import Grid, Reference, Scanner
from station.science.analysis import volume
from station.science.geometry import terrain
from station.science.uncertainty import parameters, point_covariance, propagation
from station.science.uncertainty.jacobian import height_jacobian
from station.simulation.instrument.ray_casting import cast_rays
from station.simulation.world import terrain as simulated

GRID = Grid(west_m=0.0, north_m=80.0, cell_m=5.0, nx=20, ny=16)


def level(grid, height_m):
    return terrain.bilinear_surface(Reference.from_elevation(grid, "level", np.full(grid.shape, height_m)))


def points_on(grid, surface, count=3000, seed=0):
    """Random points (n, 3) on a surface, on the grid and around it."""
    rng = np.random.default_rng(seed)
    east = rng.uniform(grid.west_m - 9, grid.west_m + grid.nx * grid.cell_m + 9, count)
    north = rng.uniform(grid.north_m - grid.ny * grid.cell_m - 9, grid.north_m + 9, count)
    return np.stack([east, north, surface(east, north)], axis=-1)


def field_with_hole(grid):
    """Cells of a field with a hole."""
    cells = np.zeros(grid.shape, bool)
    cells[3:12, 4:15] = True
    cells[5:7, 8:10] = False
    return cells


def plane(east, north):
    return 12 + 0.3 * east - 0.2 * north


def rolling(east, north):
    return 2 + np.sin(east / 9) + np.cos(north / 7)


def test_volume_of_a_plane():
    """A mesh is exact up to rounding, with edge and hole; a raster depends on the positions of the points."""
    cells, height_m = field_with_hole(GRID), plane(*np.meshgrid(GRID.x_m, GRID.y_m)) - 3
    expected_m3 = 25 * height_m[cells].sum()
    meshed = volume.mesh_volume(points_on(GRID, plane), level(GRID, 3.0), cells)
    assert meshed.volume_m3 == pytest.approx(expected_m3, rel=1e-12)
    assert meshed.area_m2 == pytest.approx(25 * cells.sum(), rel=1e-12)
    assert meshed.gradient_m2.sum(axis=0) == pytest.approx(meshed.area_m2 * np.array([-0.3, 0.2, 1.0]))
    # Over the plane itself both volumes are zero.
    reference = terrain.bilinear_surface(Reference.from_elevation(GRID, "plane", height_m + 3))
    for measure in (volume.mesh_volume, volume.raster_volume):
        assert measure(points_on(GRID, plane), reference, cells).volume_m3 == pytest.approx(0.0, abs=1e-3)


def test_raster_volume_of_three_points():
    """Hartzell et al. (2015), Eq. 11-14, for three points in two cells of 25 m²."""
    points_m = np.array([[1.0, 79, 10.0], [2.0, 78, 10.4], [6.0, 77, 11.0], [61.0, 3, 99.0]])
    cells = np.zeros(GRID.shape, bool)
    cells[0, :3] = True
    measured = volume.raster_volume(points_m, level(GRID, 4.0), cells)
    assert measured.volume_m3 == pytest.approx(25 * (6.2 + 7.0))
    assert measured.area_m2 == 50.0
    sigma_m = np.array([0.02, 0.03, 0.04, 9.0])
    variance_m6 = volume.independent_variance(measured, np.eye(3) * sigma_m[:, None, None] ** 2)
    assert variance_m6 == pytest.approx(25**2 * ((0.02**2 + 0.03**2) / 4 + 0.04**2))


@pytest.mark.parametrize("reference_shape", ["level", "rolling"])
@pytest.mark.parametrize("measure", [volume.mesh_volume, volume.raster_volume])
def test_gradient_matches_finite_differences(measure, reference_shape):
    reference = level(GRID, 0.0)
    if reference_shape == "rolling":
        reference = terrain.bilinear_surface(
            Reference.from_elevation(GRID, "rolling", 0.9 * rolling(*np.meshgrid(GRID.x_m, GRID.y_m)))
        )
    points_m, cells = points_on(GRID, rolling, 1200), field_with_hole(GRID)
    gradient_m2 = measure(points_m, reference, cells).gradient_m2
    used = np.flatnonzero(gradient_m2[:, 2])
    assert len(used) > 250
    step_m = 1e-4
    for point in np.random.default_rng(3).choice(used, 12, replace=False):
        for axis in range(3):
            ends = []
            for sign in (1, -1):
                moved = points_m.copy()
                moved[point, axis] += sign * step_m
                ends.append(measure(moved, reference, cells).volume_m3)
            if measure is volume.raster_volume and axis < 2 and reference_shape == "level":
                assert ends[0] == ends[1]
            tolerance = (
                1e-8 if reference_shape == "level" else 2e-4
            )  # a bilinear surface is not linear within the step
            assert gradient_m2[point, axis] == pytest.approx(
                (ends[0] - ends[1]) / (2 * step_m), abs=tolerance
            )


def paper_gradient(a, b, c):
    """Hartzell et al. (2015), Eq. 20, as printed, for the first vertex of a prism."""
    total = a[2] + b[2] + c[2]
    area = (a[0] * (b[1] - c[1]) + b[0] * (c[1] - a[1]) + c[0] * (a[1] - b[1])) / 2
    return np.array([(b[1] - c[1]) * total / 6, (c[0] - b[0]) * total / 6, area / 3])


def test_mesh_gradient_equals_the_paper_inside_the_mesh():
    """Hartzell et al. (2015), Eq. 16-21: for points enclosed by triangles, the summed derivatives agree."""
    grid = Grid(0.0, 80.0, 80.0, 1, 1)
    points_m = points_on(GRID, rolling, 300)
    points_m = points_m[
        (points_m[:, 0] > 0) & (points_m[:, 0] < 80) & (points_m[:, 1] > 0) & (points_m[:, 1] < 80)
    ]
    measured = volume.mesh_volume(points_m, level(grid, 0.0), np.ones((1, 1), bool))
    mesh = Delaunay(points_m[:, :2])
    printed, prisms_m3 = np.zeros_like(points_m), 0.0
    for triangle in mesh.simplices:
        if paper_gradient(*points_m[triangle])[2] < 0:  # clockwise
            triangle[[1, 2]] = triangle[[2, 1]]
        for first, second, third in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            printed[triangle[first]] += paper_gradient(*points_m[triangle[[first, second, third]]])
        prisms_m3 += points_m[triangle, 2].sum() / 3 * paper_gradient(*points_m[triangle])[2] * 3
    inner = np.setdiff1d(np.arange(len(points_m)), mesh.convex_hull)
    assert len(inner) > 120
    assert measured.volume_m3 == pytest.approx(prisms_m3, rel=1e-12)
    assert measured.gradient_m2[inner] == pytest.approx(printed[inner], abs=1e-9)
    # At the edge the printed derivatives move the edge, so they depend on the datum of the heights.
    edge = np.unique(mesh.convex_hull)
    assert np.abs(measured.gradient_m2[edge, :2] - printed[edge, :2]).max() > 5
    higher = volume.mesh_volume(
        points_m + np.array([0, 0, 3000.0]), level(grid, 3000.0), np.ones((1, 1), bool)
    )
    assert higher.gradient_m2 == pytest.approx(measured.gradient_m2, abs=1e-8)


def test_too_few_points_for_a_triangle():
    cells = np.ones(GRID.shape, bool)
    with pytest.raises(ValueError, match="span no triangle"):
        volume.mesh_volume(np.array([[1.0, 1.0, 1.0], [2.0, 2.0, 1.0]]), level(GRID, 0.0), cells)


# Simulated scans: rays from the true pose of the scanner, points computed with its assumed pose.

SCANNER_M = np.array([0.42, -0.31, 1.63])
FIELD = Grid(west_m=-120.0, north_m=230.0, cell_m=5.0, nx=18, ny=16)
SCANNER = Scanner("sim", 1.55, 0.0, 0.0, 0.02, 0.0, 0.0, 0.0, 6000.0)
PARAMS = parameters.parameter_layout(FIELD, tuple(SCANNER_M))
SNOW_M = 2.0


def shared_parameters(*, registration_errors):
    """Realistic errors of registration, range and air; those of the registration are correlated."""
    root = np.random.default_rng(2).normal(size=(6, 9)) * np.array([[6e-5] * 3 + [0.01] * 3]).T / 3
    shared = propagation.to_shared_parameters(PARAMS, root @ root.T)
    shared.covariance[6, 6], shared.covariance[7, 7], shared.covariance[8, 8] = 0.006**2, 20.0**2, 3.0**2
    return replace(shared, covariance=shared.covariance * registration_errors)


def ray_directions(ground):
    """Bearings and elevations towards the field and its surroundings, on a regular raster."""
    east, north = np.meshgrid([-135.0, -90, -30], [140.0, 190, 245])
    bearing = np.arctan2(north, east)
    climb = (ground.at(east, north) - SCANNER_M[2]) / np.hypot(east, north)
    bearing, elevation = np.meshgrid(
        np.linspace(bearing.min(), bearing.max(), 56),
        np.arctan(np.linspace(climb.min() - 0.05, climb.max() + 0.05, 60)),
    )
    return bearing.ravel(), elevation.ravel()


def simulate_scan(ground, errors, rng):
    """Points as measured, with errors of the nine globals; `rng` None omits random errors."""
    bearing, elevation = ray_directions(ground)
    aim, noise_m = np.zeros((2, len(bearing))), np.zeros(len(bearing))
    if rng is not None:
        aim = point_covariance.sigma_angle(SCANNER) * rng.standard_normal((2, len(bearing)))
        noise_m = SCANNER.range_sigma_m * rng.standard_normal(len(bearing))

    def direction(bearing, elevation):
        flat = np.cos(elevation)
        return np.stack([flat * np.cos(bearing), flat * np.sin(bearing), np.sin(elevation)], axis=-1)

    rotation = Rotation.from_rotvec([errors[0], errors[1], -errors[2]])
    true = rotation.apply(direction(bearing + aim[0], elevation + aim[1]))
    true_position_m = SCANNER_M + errors[3:6]
    hits = cast_rays(
        ground,
        true_position_m,
        np.arctan2(true[:, 1], true[:, 0]),
        true[:, 2] / np.hypot(true[:, 0], true[:, 1]),
        600.0,
        lambda bearing_rad: np.full_like(bearing_rad, errors[8]),
    )
    range_m = np.hypot(hits.along_m, hits.up_m - true_position_m[2])
    measured_m = range_m * (1 + errors[7] * 1e-6) + errors[6] + noise_m
    points_m = SCANNER_M + measured_m[:, None] * direction(bearing, elevation)
    return points_m[np.isfinite(points_m[:, 2])]


@pytest.fixture(scope="module")
def scene():
    ground = simulated.build_valley(1, 0.2, 2.0, 0.03, 40.0).ground
    below_m = ground.at(*np.meshgrid(FIELD.x_m, FIELD.y_m)) - SNOW_M
    return ground, terrain.bilinear_surface(Reference.from_elevation(FIELD, "below", below_m))


def stated_sigmas(points_m, reference, cells, registration_errors):
    """Yield the method and its sigmas [m³] with all errors and with independent point errors only."""
    covariance_m2 = point_covariance.shot_covariance(points_m - SCANNER_M, np.array([0.0, 0.0, 1.0]), SCANNER)
    for measure in (volume.raster_volume, volume.mesh_volume):
        measured = measure(points_m, reference, cells)
        full_m6 = volume.variance(
            measured,
            covariance_m2,
            points_m - SCANNER_M,
            PARAMS,
            shared_parameters(registration_errors=registration_errors),
        )
        yield measure, math.sqrt(full_m6), math.sqrt(volume.independent_variance(measured, covariance_m2))


@pytest.mark.integration
@pytest.mark.parametrize("registration_errors", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_sigma_matches_simulated_scans(scene, registration_errors):
    ground, reference = scene
    cells = np.zeros(FIELD.shape, bool)
    cells[2:-2, 2:-2] = True
    cells[6:8, 9:11] = False
    values, vectors = np.linalg.eigh(
        shared_parameters(registration_errors=registration_errors).covariance[:9, :9]
    )
    root = vectors * np.sqrt(np.maximum(values, 0))
    rng = np.random.default_rng(11)
    drawn = []
    for _ in range(300):
        points_m = simulate_scan(ground, root @ rng.standard_normal(9), rng)
        drawn.append(
            [
                measure(points_m, reference, cells).volume_m3
                for measure in (volume.raster_volume, volume.mesh_volume)
            ]
        )
    observed_m3 = np.std(drawn, axis=0, ddof=1)
    sigmas = list(
        stated_sigmas(simulate_scan(ground, np.zeros(9), None), reference, cells, registration_errors)
    )
    for (measure, full_m3, independent_m3), std_m3 in zip(sigmas, observed_m3, strict=True):
        assert 0.9 < std_m3 / full_m3 < 1.1, measure.__name__
        if registration_errors:  # independent point errors explain only a small part
            assert std_m3 > 30 * independent_m3


def test_contributions_sum_to_the_variance():
    """A contribution is half the derivative of the variance by the weight of its point, times that weight."""
    offset_m = points_on(FIELD, lambda east, north: -40 + 0.1 * east - 0.3 * north, 60).T - SCANNER_M[:, None]
    jacobian = height_jacobian(PARAMS, tuple(offset_m), np.full(60, 0.1), np.full(60, -0.3))
    rng = np.random.default_rng(4)
    weights, random_m2 = rng.uniform(-0.2, 1, 60), rng.uniform(1e-4, 1e-3, 60)
    shared = shared_parameters(registration_errors=True)
    tilt_slice = slice(10, 10 + PARAMS.sight_tilt_knots)
    shared.covariance[tilt_slice, tilt_slice] += 1e-9 * (1 + np.eye(PARAMS.sight_tilt_knots))
    shared.line_tilt_variance[10 : 10 + PARAMS.knot_intervals] = rng.uniform(
        1e-9, 3e-9, PARAMS.knot_intervals
    )
    contributions = weights**2 * random_m2 + volume.shared_contributions(weights, jacobian, shared)

    def total(weights):
        return propagation.aggregate_variance(weights, random_m2, jacobian, shared)

    assert contributions.sum() == pytest.approx(total(weights))
    for point in range(0, 60, 7):
        unit = np.eye(60)[point]
        half = weights[point] * (total(weights + unit) - total(weights - unit)) / 4
        assert contributions[point] == pytest.approx(half, rel=1e-6)


def test_point_density_reduces_independent_errors_only(scene):
    """Hartzell et al. (2015), Fig. 8: sigma falls with the root of the density unless errors are shared."""
    ground, reference = scene
    cells = np.zeros(FIELD.shape, bool)
    cells[4:-4, 4:-4] = True
    points_m = simulate_scan(ground, np.zeros(9), None)
    covariance_m2 = point_covariance.shot_covariance(points_m - SCANNER_M, np.array([0.0, 0.0, 1.0]), SCANNER)

    def with_independent_errors(kept_m, index):
        measured = volume.mesh_volume(kept_m, reference, cells)
        return measured, volume.independent_variance(measured, covariance_m2[index])

    def with_shared_errors(kept_m, index):
        measured = volume.mesh_volume(kept_m, reference, cells)
        return measured, volume.variance(
            measured,
            covariance_m2[index],
            kept_m - SCANNER_M,
            PARAMS,
            shared_parameters(registration_errors=True),
        )

    density, sigma_m3 = volume.density_dependence(points_m, (1, 4, 16), with_independent_errors).T
    assert density / density[0] == pytest.approx([1, 1 / 4, 1 / 16], rel=0.25)
    assert sigma_m3 * np.sqrt(density) == pytest.approx(sigma_m3[0] * np.sqrt(density[0]), rel=0.2)
    _, total_m3 = volume.density_dependence(points_m, (1, 4, 16), with_shared_errors).T
    assert total_m3 == pytest.approx(total_m3[0], rel=0.06)  # a mesh of few points ends before the edge
    assert total_m3[0] > 30 * sigma_m3[0]
