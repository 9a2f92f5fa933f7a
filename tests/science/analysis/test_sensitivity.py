"""Sensitivity analysis, compared with numbers from the literature, dense algebra and simulation."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from station.papers import mobile_lidar
from station.quantities import Grid, Reference, SharedParameters
from station.science.analysis.pose_errors import PoseErrorModel
from station.science.analysis.sensitivity import (
    GROUPS,
    INPUTS,
    block_diagonal,
    cell_shares,
    first_order_variance,
    group_mask,
    independent_normal,
    interactions,
    scaled_gradient,
    sobol,
    sum_shares,
)
from station.science.geometry import terrain
from station.science.uncertainty.jacobian import height_jacobian
from station.science.uncertainty.parameters import parameter_layout
from station.science.uncertainty.propagation import aggregate_variance

GRID = Grid(west_m=600.0, north_m=1600.0, cell_m=10.0, nx=40, ny=30)
POSITION_M = (0.0, 0.0, 3000.0)
PARAMS = parameter_layout(GRID, POSITION_M)


def single_inputs(count):
    return [np.arange(count) == index for index in range(count)]


def test_shares_of_a_linear_model_by_propagation_and_by_simulation():
    """3 x + 4 y + 12 z with sigmas 1, 2, 0.5: variance 9 + 64 + 36."""
    point, sigma = np.zeros(3), np.array([1.0, 2.0, 0.5])
    variances = np.array([9.0, 64.0, 36.0])

    def model(inputs):
        return np.array([3.0, 4.0, 12.0]) @ inputs

    variance, shares = first_order_variance(model, point, sigma)
    assert variance == pytest.approx(109.0)
    assert shares == pytest.approx(variances / 109)
    indices = sobol(model, independent_normal(sigma, point), single_inputs(3), 512)
    for index, error in ((indices.first, indices.first_error), (indices.total, indices.total_error)):
        assert (np.abs(index - variances / 109) < 4 * error).all()
        assert (error < 0.03).all()


def test_sobol_indices_of_the_ishigami_function():
    """Ishigami and Homma (1990): first 0.3139, 0.4424, 0; total 0.5576, 0.4424, 0.2437. Not additive."""

    def model(x):
        return np.sin(x[0]) + 7 * np.sin(x[1]) ** 2 + 0.1 * x[2] ** 4 * np.sin(x[0])

    indices = sobol(model, lambda n, random: random.uniform(-np.pi, np.pi, (3, n)), single_inputs(3), 2048)
    assert indices.first == pytest.approx([0.3139, 0.4424, 0.0], abs=0.04)
    assert indices.total == pytest.approx([0.5576, 0.4424, 0.2437], abs=0.04)
    assert (np.abs(indices.first - [0.3139, 0.4424, 0.0]) < 4.5 * indices.first_error).all()


def test_interaction_indices_of_the_g_function():
    """Sobol (1993), a = 0: a combination of n variables has the share 3⁻ⁿ / ((4/3)³ - 1)."""

    def model(x):
        return np.prod(np.abs(4 * x - 2), axis=0)

    indices = interactions(model, lambda n, random: random.uniform(0, 1, (3, n)), single_inputs(3), 4096)
    assert sorted(map(len, indices)) == [1, 1, 1, 2, 2, 2, 3]
    for combination, (index, error) in indices.items():
        assert abs(index - 27 / 3 ** len(combination) / 37) < 4.5 * error
        assert error < 0.02
    total = sobol(model, lambda n, random: random.uniform(0, 1, (3, n)), single_inputs(3), 4096).total
    assert sum(index for group, (index, _) in indices.items() if 0 in group) == pytest.approx(
        total[0], abs=0.05
    )


def test_third_order_index_excludes_all_lower_orders():
    """x y z with sigma equal to the mean: all indices are 1/7; the printed formula gives 4/7 for the triple.

    The closed index of x and y is also computed by brute force, as the variance of conditional means.
    """

    def model(x):
        return np.prod(x, axis=0)

    draw = independent_normal(np.ones(3), np.ones(3))
    indices = interactions(model, draw, single_inputs(3), 4096)
    for index, error in indices.values():
        assert abs(index - 1 / 7) < 4.5 * error
    triple, error = indices[0, 1, 2]
    assert error < 0.06
    assert abs(triple - 4 / 7) > 5 * error
    rng = np.random.default_rng(3)
    pair, other = draw(2000, rng)[:2, :, None], draw(2000, rng)[2]
    means = (pair[0] * pair[1] * other).mean(axis=1)
    closed = means.var() / 7  # of x and y: 3/7
    assert indices[0,][0] + indices[1,][0] + indices[0, 1][0] == pytest.approx(closed, abs=0.12)


def test_an_additive_model_has_no_interactions():
    draw = independent_normal(np.array([1.0, 2.0, 0.5]), np.zeros(3))
    indices = interactions(lambda x: np.array([3.0, 4.0, 12.0]) @ x, draw, single_inputs(3), 512)
    for combination, (index, error) in indices.items():
        if len(combination) > 1:
            assert abs(index) < 4.5 * error + 1e-12


def test_mobile_lidar_point_matches_independent_rotations():
    rng = np.random.default_rng(5)
    x = rng.uniform(-0.5, 0.5, 18)
    x[8:11], x[16:] = (0.3, -0.2, 1.1), (40.0, 0.02)
    body = Rotation.from_euler("xyz", x[5:8])  # fixed axes, roll first
    to_laser = Rotation.from_euler("xyz", x[11:14])
    cosine = math.cos(x[15])
    beam = 40.02 * np.array([cosine * math.cos(x[14]), cosine * math.sin(x[14]), math.sin(x[15])])
    local_m = body.apply(x[8:11] + to_laser.apply(beam))
    # From east-north-up to geocentric axes: longitude about z, then colatitude about y.
    to_geocentric = Rotation.from_euler("ZYZ", [x[4], math.pi / 2 - x[3], math.pi / 2])
    assert mobile_lidar.geocentric_point(x[:, None])[:, 0] == pytest.approx(
        x[:3] + to_geocentric.apply(local_m)
    )


@pytest.mark.integration
def test_mobile_lidar_shares_by_propagation_and_by_simulation():
    """Leslar et al. (2014), Table 1: eighteen variables, thirteen of them uncertain."""
    point, sigma = mobile_lidar.side_shot(100.0), mobile_lidar.sigmas(mobile_lidar.EXPECTED)
    uncertain = [mobile_lidar.VARIABLES.index(name) for name in mobile_lidar.EXPECTED]
    _, shares = first_order_variance(mobile_lidar.height, point, sigma)
    groups = [np.arange(18) == index for index in uncertain]
    indices = sobol(mobile_lidar.height, independent_normal(sigma, point), groups)
    for index, error in ((indices.first, indices.first_error), (indices.total, indices.total_error)):
        assert (np.abs(index - shares[uncertain]) < 4 * error + 1e-3).all()
    covariance = np.stack(
        [
            scaled_gradient(lambda v, axis=axis: mobile_lidar.geocentric_point(v)[axis], point, sigma)
            for axis in range(3)
        ]
    )
    assert np.trace(covariance @ covariance.T) == pytest.approx(
        0.02**2 * 3 + 0.007**2 * 3 + 0.008**2 + 0.01**2
        + 100**2 * 2 * (math.radians(0.0055) ** 2 + math.radians(0.02) ** 2),
        rel=1e-6,
    )  # fmt: skip


def random_parameters(seed, *, correlated):
    """Random shared parameters, correlated across groups as after an adjustment, or not."""
    rng = np.random.default_rng(seed)
    scale = np.array([1e-4, 1e-4, 3e-4, 3e-2, 3e-2, 3e-2, 4e-2, 8.0, 0.5, 0.3])
    counts = PARAMS.sight_tilt_knots, PARAMS.refraction_knots, PARAMS.refraction_knots
    sigma = np.concatenate([scale, np.repeat([5e-5, 0.2, 5e-5], counts)])
    root = sigma[:, None] * rng.normal(size=(len(sigma), 2 * len(sigma))) / np.sqrt(2 * len(sigma))
    noise = np.zeros(len(sigma))
    noise[10 : 10 + PARAMS.knot_intervals] = 1e-9
    shared = SharedParameters(PARAMS.names, PARAMS.units, 0 * sigma, root @ root.T, noise)
    return shared if correlated else block_diagonal(shared)


def random_jacobian(rng, count=60):
    x, y = rng.uniform(600, 1000, count), rng.uniform(1300, 1600, count)
    return height_jacobian(
        PARAMS, (x, y, rng.uniform(-500, 0, count)), rng.normal(0, 0.3, count), rng.normal(0, 0.3, count)
    )


def dense_jacobian(jacobian):
    """Dense J (n, p), row by row."""
    return np.stack([jacobian.aggregate(cell) for cell in np.eye(len(jacobian))])


def test_shares_of_cells_match_dense_algebra():
    rng = np.random.default_rng(2)
    jacobian, shared = random_jacobian(rng), random_parameters(1, correlated=True)
    random_m2 = rng.uniform(0.01, 0.1, len(jacobian)) ** 2
    shares = cell_shares(jacobian, random_m2, shared)
    assert sum(shares.values()) == pytest.approx(np.ones(len(jacobian)), abs=1e-5)
    effect, covariance = dense_jacobian(jacobian), shared.covariance
    knots_only = replace(shared, line_tilt_variance=0 * shared.line_tilt_variance)
    independent_m2 = random_m2 + jacobian.variance(shared) - jacobian.variance(knots_only)
    total = np.einsum("ni,ij,nj->n", effect, covariance, effect) + independent_m2
    for group in ("tilt", "refraction", "range"):
        mask = group_mask(shared.names, group)
        expected = np.einsum("ni,ij,nj->n", effect[:, mask], covariance[mask], effect) / total
        assert shares[group] == pytest.approx(expected, rel=1e-4, abs=1e-5)
    assert any((values < -1e-3).any() for values in shares.values())  # correlated inputs offset each other


def test_shares_of_a_mean_match_simulation():
    """First share: explained by a regression on the group. Total: left by one on all other inputs."""
    rng = np.random.default_rng(3)
    jacobian, shared = random_jacobian(rng), random_parameters(4, correlated=True)
    weights, random_m2 = np.full(len(jacobian), 1 / len(jacobian)), np.full(len(jacobian), 0.5**2)
    variance_m2, shares = sum_shares(weights, random_m2, jacobian, shared)
    assert variance_m2 == pytest.approx(aggregate_variance(weights, random_m2, jacobian, shared))
    assert sum(share.covariance_share for share in shares.values()) == pytest.approx(1.0)
    draws = rng.multivariate_normal(0 * shared.estimate, shared.covariance, 20_000)
    # The independent errors of lines and cells are drawn as one variable.
    independent_m2 = variance_m2 - jacobian.aggregate(weights) @ shared.covariance @ jacobian.aggregate(
        weights
    )
    y = draws @ jacobian.aggregate(weights) + rng.normal(0, math.sqrt(independent_m2), 20_000)

    def residual_share(columns):
        fit, *_ = np.linalg.lstsq(columns, y, rcond=None)
        return np.var(y - columns @ fit) / np.var(y)

    for group in ("tilt", "translation", "refraction"):
        mask = group_mask(shared.names, group)
        assert shares[group].first == pytest.approx(1 - residual_share(draws[:, mask]), abs=0.02)
        assert shares[group].total == pytest.approx(
            residual_share(draws[:, ~mask]) - independent_m2 / variance_m2, abs=0.02
        )


def test_all_shares_of_independent_inputs_are_equal():
    rng = np.random.default_rng(6)
    jacobian, shared = random_jacobian(rng), random_parameters(4, correlated=False)
    weights = rng.uniform(0, 1, len(jacobian))
    _, shares = sum_shares(weights, np.full(len(jacobian), 0.1), jacobian, shared)
    for name, share in shares.items():
        assert share.first == pytest.approx(share.covariance_share, abs=1e-9), name
        assert share.total == pytest.approx(share.covariance_share, abs=1e-9), name
    assert set(shares) == set(INPUTS) == {*GROUPS, "random"}


@pytest.fixture(scope="module")
def pose_model():
    """Weighted sum of cells on waves of 0.5 m, where the effect of a shift is not linear."""
    x, y = np.meshgrid(GRID.x_m, GRID.y_m)
    elevation_m = 2600 + 0.3 * x - 0.1 * y + 0.5 * np.sin(x / 40) * np.cos(y / 50)
    ground = terrain.bilinear_surface(Reference.from_elevation(GRID, "1", elevation_m))
    rng = np.random.default_rng(8)
    row, column = rng.integers(3, 27, 40), rng.integers(3, 37, 40)
    height_m, east, north = ground.height_and_gradient(column + 0.5, row + 0.5)
    points = GRID.x_m[column], GRID.y_m[row], height_m
    offset_m = tuple(axis - origin for axis, origin in zip(points, POSITION_M, strict=True))
    jacobian = height_jacobian(PARAMS, offset_m, east, north)
    weights = rng.uniform(0, 1, 40)
    return PoseErrorModel(
        ground,
        POSITION_M,
        points,
        weights,
        jacobian,
        random_parameters(9, correlated=False),
        np.full(40, 0.02**2),
    )


def test_small_pose_errors_match_the_jacobian(pose_model):
    """The slope differs on either side of a cell's centre; their mean is the slope in J."""
    count = len(PARAMS.names)
    for parameter in (0, 1, 2, 5, 6, 7, 8, 9, 10 + 3, 10 + PARAMS.sight_tilt_knots + 1, count - 2):
        step = 1e-3 * math.sqrt(pose_model.shared.covariance[parameter, parameter])
        inputs = np.zeros((count + 2, 2))
        inputs[parameter] = step, -step
        ends = pose_model(inputs)
        expected = pose_model.jacobian.aggregate(pose_model.weights)[parameter]
        scale = abs(pose_model.jacobian.pose[:, 0]).max() if parameter < 10 else abs(expected)
        assert (ends[0] - ends[1]) / (2 * step) == pytest.approx(expected, rel=0.05, abs=1e-2 * scale)


def test_simulated_shares_match_those_of_the_covariance(pose_model):
    indices = sobol(pose_model, pose_model.draw, pose_model.groups(), 128)
    _, shares = sum_shares(pose_model.weights, pose_model.random_m2, pose_model.jacobian, pose_model.shared)
    expected = np.array([share.covariance_share for share in shares.values()])
    assert expected.max() < 0.9
    for index, error in ((indices.first, indices.first_error), (indices.total, indices.total_error)):
        assert (np.abs(index - expected) < 4 * error + 0.01).all(), (index, expected, error)
