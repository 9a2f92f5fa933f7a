"""Volumes and their gradients, and their sigma against simulated scans."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import Delaunay
from scipy.spatial.transform import Rotation

from station.quantities import Grid, Reference, Scanner
from station.science import points, registration, shared, terrain, volume
from station.simulation import terrain as simulated
from station.simulation.cast import cast

GRID = Grid(west_m=0.0, north_m=80.0, cell_m=5.0, nx=20, ny=16)


def level(grid, height_m):
    return terrain.ground(Reference.given(grid, "level", np.full(grid.shape, height_m)))


def over(grid, surface, count=3000, seed=0):
    """Points at random on a surface, on and around the grid."""
    rng = np.random.default_rng(seed)
    east = rng.uniform(grid.west_m - 9, grid.west_m + grid.nx * grid.cell_m + 9, count)
    north = rng.uniform(grid.north_m - grid.ny * grid.cell_m - 9, grid.north_m + 9, count)
    return np.stack([east, north, surface(east, north)], axis=-1)


def ring(grid):
    """A field with a hole."""
    cells = np.zeros(grid.shape, bool)
    cells[3:12, 4:15] = True
    cells[5:7, 8:10] = False
    return cells


def plane(east, north):
    return 12 + 0.3 * east - 0.2 * north


def rolling(east, north):
    return 2 + np.sin(east / 9) + np.cos(north / 7)


def test_a_plane_has_its_volume():
    """A mesh of it is exact to the last digit, edge and hole included; a raster feels where points lie."""
    cells, wanted = ring(GRID), plane(*np.meshgrid(GRID.x_m, GRID.y_m)) - 3
    wanted_m3 = 25 * wanted[ring(GRID)].sum()
    meshed = volume.mesh(over(GRID, plane), level(GRID, 3.0), cells)
    assert meshed.volume_m3 == pytest.approx(wanted_m3, rel=1e-12)
    assert meshed.area_m2 == pytest.approx(25 * cells.sum(), rel=1e-12)
    assert meshed.gradient_m2.sum(axis=0) == pytest.approx(meshed.area_m2 * np.array([-0.3, 0.2, 1.0]))
    # Over the plane itself nothing is left for either.
    under = terrain.ground(Reference.given(GRID, "plane", wanted + 3))
    for measure in (volume.mesh, volume.raster):
        assert measure(over(GRID, plane), under, cells).volume_m3 == pytest.approx(0.0, abs=1e-3)


def test_raster_by_hand():
    """H-11 to H-14 for three points in two cells of 25 m²."""
    put = np.array([[1.0, 79, 10.0], [2.0, 78, 10.4], [6.0, 77, 11.0], [61.0, 3, 99.0]])
    cells = np.zeros(GRID.shape, bool)
    cells[0, :3] = True
    told = volume.raster(put, level(GRID, 4.0), cells)
    assert told.volume_m3 == pytest.approx(25 * (6.2 + 7.0))
    assert told.area_m2 == 50.0
    sigma_m = np.array([0.02, 0.03, 0.04, 9.0])
    told_m6 = volume.independent_variance(told, np.eye(3) * sigma_m[:, None, None] ** 2)
    assert told_m6 == pytest.approx(25**2 * ((0.02**2 + 0.03**2) / 4 + 0.04**2))


@pytest.mark.parametrize("under_m", ["level", "rolling"])
@pytest.mark.parametrize("measure", [volume.mesh, volume.raster])
def test_p10_gradient_against_finite_differences(measure, under_m):
    under = level(GRID, 0.0)
    if under_m == "rolling":
        under = terrain.ground(
            Reference.given(GRID, "rolling", 0.9 * rolling(*np.meshgrid(GRID.x_m, GRID.y_m)))
        )
    put, cells = over(GRID, rolling, 1200), ring(GRID)
    told = measure(put, under, cells).gradient_m2
    used = np.flatnonzero(told[:, 2])
    assert len(used) > 250
    step_m = 1e-4
    for point in np.random.default_rng(3).choice(used, 12, replace=False):
        for axis in range(3):
            ends = []
            for sign in (1, -1):
                moved = put.copy()
                moved[point, axis] += sign * step_m
                ends.append(measure(moved, under, cells).volume_m3)
            if measure is volume.raster and axis < 2 and under_m == "level":
                assert ends[0] == ends[1]
            exact = 1e-9 if under_m == "level" else 2e-5  # a bilinear surface bends within the step
            assert told[point, axis] == pytest.approx((ends[0] - ends[1]) / (2 * step_m), abs=10 * exact)


def printed_gradient(one, two, three):
    """H-20 as printed, for the first vertex of a prism."""
    total = one[2] + two[2] + three[2]
    area = (one[0] * (two[1] - three[1]) + two[0] * (three[1] - one[1]) + three[0] * (one[1] - two[1])) / 2
    return np.array([(two[1] - three[1]) * total / 6, (three[0] - two[0]) * total / 6, area / 3])


def test_prisms_as_printed():
    """H-16 to H-21: about every point that triangles enclose, the paper's derivatives sum up to ours."""
    grid = Grid(0.0, 80.0, 80.0, 1, 1)
    put = over(GRID, rolling, 300)
    put = put[(put[:, 0] > 0) & (put[:, 0] < 80) & (put[:, 1] > 0) & (put[:, 1] < 80)]
    told = volume.mesh(put, level(grid, 0.0), np.ones((1, 1), bool))
    mesh = Delaunay(put[:, :2])
    printed, prisms_m3 = np.zeros_like(put), 0.0
    for triangle in mesh.simplices:
        one, two, three = put[triangle]
        if printed_gradient(one, two, three)[2] < 0:  # clockwise
            triangle[[1, 2]] = triangle[[2, 1]]
        for first, second, third in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            printed[triangle[first]] += printed_gradient(*put[triangle[[first, second, third]]])
        prisms_m3 += put[triangle, 2].sum() / 3 * printed_gradient(*put[triangle])[2] * 3
    inner = np.setdiff1d(np.arange(len(put)), mesh.convex_hull)
    assert len(inner) > 120
    assert told.volume_m3 == pytest.approx(prisms_m3, rel=1e-12)
    assert told.gradient_m2[inner] == pytest.approx(printed[inner], abs=1e-9)
    # At the edge the printed ones move the edge along, and so hang on the level that heights count from.
    edge = np.unique(mesh.convex_hull)
    assert np.abs(told.gradient_m2[edge, :2] - printed[edge, :2]).max() > 5
    higher = volume.mesh(put + np.array([0, 0, 3000.0]), level(grid, 3000.0), np.ones((1, 1), bool))
    assert higher.gradient_m2 == pytest.approx(told.gradient_m2, abs=1e-8)


def test_too_few_points_for_a_triangle():
    cells = np.ones(GRID.shape, bool)
    with pytest.raises(ValueError, match="span no triangle"):
        volume.mesh(np.array([[1.0, 1.0, 1.0], [2.0, 2.0, 1.0]]), level(GRID, 0.0), cells)


# Simulated scans: a terrain, rays that leave as the scanner truly stands, points where it believes they are.

EYE_M = np.array([0.42, -0.31, 1.63])
FIELD = Grid(west_m=-120.0, north_m=230.0, cell_m=5.0, nx=18, ny=16)
SCANNER = Scanner("sim", 1.55, 0.0, 0.0, 0.02, 0.0, 0.0, 0.0, 6000.0)
BASIS = shared.basis(FIELD, tuple(EYE_M))
SNOW_M = 2.0


def unknown(*, on):
    """Lifelike errors of a registration, ranges and air; those of the registration hang together."""
    root = np.random.default_rng(2).normal(size=(6, 9)) * np.array([[6e-5] * 3 + [0.01] * 3]).T / 3
    told = registration.shared_by(BASIS, root @ root.T)
    told.covariance[6, 6], told.covariance[7, 7], told.covariance[8, 8] = 0.006**2, 20.0**2, 3.0**2
    return replace(told, covariance=told.covariance * on)


def rays(ground):
    """Directions towards the field and its surroundings, evenly spaced as a scanner's."""
    east, north = np.meshgrid([-135.0, -90, -30], [140.0, 190, 245])
    bearing = np.arctan2(north, east)
    climb = (ground.at(east, north) - EYE_M[2]) / np.hypot(east, north)
    bearing, elevation = np.meshgrid(
        np.linspace(bearing.min(), bearing.max(), 56),
        np.arctan(np.linspace(climb.min() - 0.05, climb.max() + 0.05, 60)),
    )
    return bearing.ravel(), elevation.ravel()


def shoot(ground, errors, rng):
    """Where the scanner believes the points to be; `errors` are the nine globals, rng None for none."""
    bearing, elevation = rays(ground)
    aim, noise_m = np.zeros((2, len(bearing))), np.zeros(len(bearing))
    if rng is not None:
        aim = points.sigma_angle(SCANNER) * rng.standard_normal((2, len(bearing)))
        noise_m = SCANNER.range_sigma_m * rng.standard_normal(len(bearing))

    def direction(bearing, elevation):
        flat = np.cos(elevation)
        return np.stack([flat * np.cos(bearing), flat * np.sin(bearing), np.sin(elevation)], axis=-1)

    turn = Rotation.from_rotvec([errors[0], errors[1], -errors[2]])
    true = turn.apply(direction(bearing + aim[0], elevation + aim[1]))
    eye_m = EYE_M + errors[3:6]
    hits = cast(
        ground,
        eye_m,
        np.arctan2(true[:, 1], true[:, 0]),
        true[:, 2] / np.hypot(true[:, 0], true[:, 1]),
        600.0,
        lambda bearing_rad: np.full_like(bearing_rad, errors[8]),
    )
    range_m = np.hypot(hits.along_m, hits.up_m - eye_m[2])
    measured_m = range_m * (1 + errors[7] * 1e-6) + errors[6] + noise_m
    told = EYE_M + measured_m[:, None] * direction(bearing, elevation)
    return told[np.isfinite(told[:, 2])]


@pytest.fixture(scope="module")
def scene():
    ground = simulated.valley(1, 0.2, 2.0, 0.03, 40.0).ground
    below_m = ground.at(*np.meshgrid(FIELD.x_m, FIELD.y_m)) - SNOW_M
    return ground, terrain.ground(Reference.given(FIELD, "below", below_m))


def stated(put, under, cells, on):
    own_m2 = points.shot_covariance(put - EYE_M, np.array([0.0, 0.0, 1.0]), SCANNER)
    for measure in (volume.raster, volume.mesh):
        told = measure(put, under, cells)
        full_m6 = volume.variance(told, own_m2, put - EYE_M, BASIS, unknown(on=on))
        yield measure, math.sqrt(full_m6), math.sqrt(volume.independent_variance(told, own_m2))


@pytest.mark.parametrize("on", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_sigma_against_simulated_scans(scene, on):
    ground, under = scene
    cells = np.zeros(FIELD.shape, bool)
    cells[2:-2, 2:-2] = True
    cells[6:8, 9:11] = False
    values, vectors = np.linalg.eigh(unknown(on=on).covariance[:9, :9])
    root = vectors * np.sqrt(np.maximum(values, 0))
    rng = np.random.default_rng(11)
    drawn = []
    for _ in range(300):
        put = shoot(ground, root @ rng.standard_normal(9), rng)
        drawn.append([measure(put, under, cells).volume_m3 for measure in (volume.raster, volume.mesh)])
    seen = np.std(drawn, axis=0, ddof=1)
    told = list(stated(shoot(ground, np.zeros(9), None), under, cells, on))
    for (measure, full_m3, alone_m3), seen_m3 in zip(told, seen, strict=True):
        assert 0.9 < seen_m3 / full_m3 < 1.1, measure.__name__
        if on:  # errors taken as each point's own, whatever they are, say next to nothing of it
            assert seen_m3 > 30 * alone_m3


def test_contributions_sum_up():
    """Each is half of what the variance, a quadratic form, grows by with the weight of its point."""
    offset_m = over(FIELD, lambda east, north: -40 + 0.1 * east - 0.3 * north, 60).T - EYE_M[:, None]
    felt = shared.sensitivities(BASIS, tuple(offset_m), np.full(60, 0.1), np.full(60, -0.3))
    rng = np.random.default_rng(4)
    weights, random_m2 = rng.uniform(-0.2, 1, 60), rng.uniform(1e-4, 1e-3, 60)
    told = unknown(on=True)
    lean = slice(9, 9 + BASIS.lean_count)
    told.covariance[lean, lean] += 1e-9 * (1 + np.eye(BASIS.lean_count))
    told.noise_variance[9 : 9 + BASIS.intervals] = rng.uniform(1e-9, 3e-9, BASIS.intervals)
    each = weights**2 * random_m2 + volume.shared_contributions(weights, felt, told)

    def total(weights):
        return shared.aggregate_variance(weights, random_m2, felt, told)

    assert each.sum() == pytest.approx(total(weights))
    for point in range(0, 60, 7):
        unit = np.eye(60)[point]
        half = weights[point] * (total(weights + unit) - total(weights - unit)) / 4
        assert each[point] == pytest.approx(half, rel=1e-6)


def test_more_points_help_only_against_what_is_random(scene):
    """H Fig. 8: as published sigma falls with the root of the density; with what points share it does not."""
    ground, under = scene
    cells = np.zeros(FIELD.shape, bool)
    cells[4:-4, 4:-4] = True
    put = shoot(ground, np.zeros(9), None)
    own_m2 = points.shot_covariance(put - EYE_M, np.array([0.0, 0.0, 1.0]), SCANNER)

    def published(left, at):
        told = volume.mesh(left, under, cells)
        return told, volume.independent_variance(told, own_m2[at])

    def everything(left, at):
        told = volume.mesh(left, under, cells)
        return told, volume.variance(told, own_m2[at], left - EYE_M, BASIS, unknown(on=True))

    density, sigma_m3 = volume.against_density(put, (1, 4, 16), published).T
    assert density / density[0] == pytest.approx([1, 1 / 4, 1 / 16], rel=0.25)
    assert sigma_m3 * np.sqrt(density) == pytest.approx(sigma_m3[0] * np.sqrt(density[0]), rel=0.2)
    _, whole_m3 = volume.against_density(put, (1, 4, 16), everything).T
    assert whole_m3 == pytest.approx(whole_m3[0], rel=0.06)  # the mesh of few points ends short of the edge
    assert whole_m3[0] > 30 * sigma_m3[0]


def test_montezuma():
    """H's 4.7 m³ (0.004 %) for 140 000 m² within 600 m, against what such a registration leaves in common.

    Twelve points, half of them on planes, known to 2-3 cm as H says; an order of magnitude, not a figure.
    """
    rng = np.random.default_rng(1)
    azimuth, distance = rng.uniform(-1.2, 1.2, 12), rng.uniform(100, 600, 12)
    offset = np.stack([distance * np.cos(azimuth), distance * np.sin(azimuth), rng.uniform(0, 150, 12)], -1)
    normal = np.where(np.arange(12)[:, None] < 6, 0.0, rng.normal(size=(12, 3)))
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    noisy = offset + 0.03 * rng.normal(size=(12, 3))
    found = registration.solve(
        registration.Features(("f",) * 12, noisy, offset, normal, np.full(12, 0.03)), np.eye(4)
    )
    turn, shift = np.split(np.sqrt(np.diag(found.covariance)), 2)
    assert (np.degrees(turn) < 0.006).all()  # H: 0.003-0.006° and 1-3 cm
    assert (shift > 0.005).all()
    assert (shift < 0.03).all()
    grid = Grid(100.0, 175.0, 5.0, 80, 70)  # 140 000 m²
    basis = shared.basis(grid, (0.0, 0.0, 0.0))
    east, north = (axis.ravel() for axis in np.meshgrid(grid.x_m, grid.y_m))
    felt = shared.sensitivities(basis, (east, north, 0.2 * east), np.full(5600, 0.2), np.zeros(5600))
    told = registration.shared_by(basis, found.covariance)
    one_m3 = math.sqrt(shared.aggregate_variance(np.full(5600, 25.0), np.zeros(5600), felt, told))
    net_m3 = math.sqrt(volume.net_variance(one_m3**2, one_m3**2))
    assert 500 < net_m3 < 3000
    assert net_m3 > 100 * 4.743
