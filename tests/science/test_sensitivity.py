"""Shares of a variance against numbers from the literature, dense algebra and simulation."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from station.quantities import Grid, Reference, Shared
from station.science import mobile, shared, terrain
from station.science.moved import Moved
from station.science.sensitivity import (
    GROUPS,
    INPUTS,
    apart,
    cell_shares,
    derivatives,
    independent,
    interactions,
    members,
    propagated,
    sobol,
    sum_shares,
)

GRID = Grid(west_m=600.0, north_m=1600.0, cell_m=10.0, nx=40, ny=30)
POSITION_M = (0.0, 0.0, 3000.0)
OF = shared.basis(GRID, POSITION_M)


def each(count):
    return [np.arange(count) == one for one in range(count)]


def test_shares_of_a_sum_by_propagation_and_by_simulation():
    """3 x + 4 y + 12 z with sigmas 1, 2, 0.5: variance 9 + 64 + 36."""
    at, sigma = np.zeros(3), np.array([1.0, 2.0, 0.5])
    parts = np.array([9.0, 64.0, 36.0])

    def model(inputs):
        return np.array([3.0, 4.0, 12.0]) @ inputs

    variance, told = propagated(model, at, sigma)
    assert variance == pytest.approx(109.0)
    assert told == pytest.approx(parts / 109)
    found = sobol(model, independent(sigma, at), each(3), 512)
    for index, error in ((found.first, found.first_error), (found.total, found.total_error)):
        assert (np.abs(index - parts / 109) < 4 * error).all()
        assert (error < 0.03).all()


def test_indices_of_the_ishigami_function():
    """Ishigami and Homma (1990): first 0.3139, 0.4424, 0; total 0.5576, 0.4424, 0.2437. Not additive."""

    def model(x):
        return np.sin(x[0]) + 7 * np.sin(x[1]) ** 2 + 0.1 * x[2] ** 4 * np.sin(x[0])

    found = sobol(model, lambda n, random: random.uniform(-np.pi, np.pi, (3, n)), each(3), 2048)
    assert found.first == pytest.approx([0.3139, 0.4424, 0.0], abs=0.04)
    assert found.total == pytest.approx([0.5576, 0.4424, 0.2437], abs=0.04)
    assert (np.abs(found.first - [0.3139, 0.4424, 0.0]) < 4.5 * found.first_error).all()


def test_interactions_of_the_g_function():
    """Sobol (1993), all a nought: of each combination of n variables a share of 3⁻ⁿ over (4/3)³ - 1."""

    def model(x):
        return np.prod(np.abs(4 * x - 2), axis=0)

    found = interactions(model, lambda n, random: random.uniform(0, 1, (3, n)), each(3), 4096)
    assert sorted(map(len, found)) == [1, 1, 1, 2, 2, 2, 3]
    for of, (told, error) in found.items():
        assert abs(told - 27 / 3 ** len(of) / 37) < 4.5 * error
        assert error < 0.02
    total = sobol(model, lambda n, random: random.uniform(0, 1, (3, n)), each(3), 4096).total
    assert sum(told for of, (told, _) in found.items() if 0 in of) == pytest.approx(total[0], abs=0.05)


def test_an_index_of_third_order_lacks_all_lower_ones():
    """x y z, each as unsure as large: a seventh each; the printed formula leaves the pairs in, four sevenths.

    And by brute force: the variance of means over one group's draws while the others stay.
    """

    def model(x):
        return np.prod(x, axis=0)

    draw = independent(np.ones(3), np.ones(3))
    found = interactions(model, draw, each(3), 4096)
    for told, error in found.values():
        assert abs(told - 1 / 7) < 4.5 * error
    triple, error = found[0, 1, 2]
    assert error < 0.06
    assert abs(triple - 4 / 7) > 5 * error
    rng = np.random.default_rng(3)
    pair, other = draw(2000, rng)[:2, :, None], draw(2000, rng)[2]
    means = (pair[0] * pair[1] * other).mean(axis=1)
    closed = means.var() / 7  # of x and y together: three sevenths
    assert found[0,][0] + found[1,][0] + found[0, 1][0] == pytest.approx(closed, abs=0.12)


def test_groups_of_an_additive_model_do_not_interact():
    draw = independent(np.array([1.0, 2.0, 0.5]), np.zeros(3))
    found = interactions(lambda x: np.array([3.0, 4.0, 12.0]) @ x, draw, each(3), 512)
    for of, (told, error) in found.items():
        if len(of) > 1:
            assert abs(told) < 4.5 * error + 1e-12


def test_mobile_lidar_against_independent_rotations():
    rng = np.random.default_rng(5)
    x = rng.uniform(-0.5, 0.5, 18)
    x[8:11], x[16:] = (0.3, -0.2, 1.1), (40.0, 0.02)
    body = Rotation.from_euler("xyz", x[5:8])  # about fixed axes: roll first
    to_laser = Rotation.from_euler("xyz", x[11:14])
    cosine = math.cos(x[15])
    beam = 40.02 * np.array([cosine * math.cos(x[14]), cosine * math.sin(x[14]), math.sin(x[15])])
    level = body.apply(x[8:11] + to_laser.apply(beam))
    # east-north-up to geocentric: up along z turned by longitude about z and colatitude about y
    upright = Rotation.from_euler("ZYZ", [x[4], math.pi / 2 - x[3], math.pi / 2])
    assert mobile.geocentric_point(x[:, None])[:, 0] == pytest.approx(x[:3] + upright.apply(level))


def test_mobile_lidar_by_propagation_and_by_simulation():
    """Leslar et al. (2014), Table 1: eighteen variables, of which thirteen are unsure."""
    at, sigma = mobile.abeam(100.0), mobile.sigmas(mobile.EXPECTED)
    unsure = [mobile.VARIABLES.index(name) for name in mobile.EXPECTED]
    _, shares = propagated(mobile.height, at, sigma)
    groups = [np.arange(18) == one for one in unsure]
    found = sobol(mobile.height, independent(sigma, at), groups)
    for index, error in ((found.first, found.first_error), (found.total, found.total_error)):
        assert (np.abs(index - shares[unsure]) < 4 * error + 1e-3).all()
    covariance = np.stack(
        [derivatives(lambda v, axis=axis: mobile.geocentric_point(v)[axis], at, sigma) for axis in range(3)]
    )
    assert np.trace(covariance @ covariance.T) == pytest.approx(
        0.02**2 * 3 + 0.007**2 * 3 + 0.008**2 + 0.01**2
        + 100**2 * 2 * (math.radians(0.0055) ** 2 + math.radians(0.02) ** 2),
        rel=1e-6,
    )  # fmt: skip


def drawn(seed, *, tied):
    """Shared parameters; `tied` across groups as an adjustment ties them."""
    rng = np.random.default_rng(seed)
    scale = np.array([1e-4, 1e-4, 3e-4, 3e-2, 3e-2, 3e-2, 4e-2, 8.0, 0.5])
    counts = OF.lean_count, OF.refraction_count, OF.refraction_count
    sigma = np.concatenate([scale, np.repeat([5e-5, 0.2, 5e-5], counts)])
    root = sigma[:, None] * rng.normal(size=(len(sigma), 2 * len(sigma))) / np.sqrt(2 * len(sigma))
    noise = np.zeros(len(sigma))
    noise[9 : 9 + OF.intervals] = 1e-9
    unknown = Shared(OF.names, OF.units, 0 * sigma, root @ root.T, noise)
    return unknown if tied else apart(unknown)


def felt_by(rng, count=60):
    x, y = rng.uniform(600, 1000, count), rng.uniform(1300, 1600, count)
    return shared.sensitivities(
        OF, (x, y, rng.uniform(-500, 0, count)), rng.normal(0, 0.3, count), rng.normal(0, 0.3, count)
    )


def dense(felt):
    """The whole of J (n, p), a parameter at a time."""
    return np.stack([felt.total(one) for one in np.eye(len(felt))])


def test_shares_of_cells_against_dense_algebra():
    rng = np.random.default_rng(2)
    felt, unknown = felt_by(rng), drawn(1, tied=True)
    random_m2 = rng.uniform(0.01, 0.1, len(felt)) ** 2
    told = cell_shares(felt, random_m2, unknown)
    assert sum(told.values()) == pytest.approx(np.ones(len(felt)), abs=1e-5)
    effect, covariance = dense(felt), unknown.covariance
    knots = replace(unknown, noise_variance=0 * unknown.noise_variance)
    own_m2 = random_m2 + felt.variance(unknown) - felt.variance(knots)
    total = np.einsum("ni,ij,nj->n", effect, covariance, effect) + own_m2
    for group in ("tilt", "refraction", "range"):
        of = members(unknown.names, group)
        wanted = np.einsum("ni,ij,nj->n", effect[:, of], covariance[of], effect) / total
        assert told[group] == pytest.approx(wanted, rel=1e-4, abs=1e-5)
    assert any((values < -1e-3).any() for values in told.values())  # tied inputs offset each other


def test_shares_of_a_mean_against_simulation():
    """First: what a regression on the group explains. Total: what one on all others leaves."""
    rng = np.random.default_rng(3)
    felt, unknown = felt_by(rng), drawn(4, tied=True)
    weights, random_m2 = np.full(len(felt), 1 / len(felt)), np.full(len(felt), 0.5**2)
    variance_m2, told = sum_shares(weights, random_m2, felt, unknown)
    assert variance_m2 == pytest.approx(shared.aggregate_variance(weights, random_m2, felt, unknown))
    assert sum(share.part for share in told.values()) == pytest.approx(1.0)
    draws = rng.multivariate_normal(0 * unknown.estimate, unknown.covariance, 20_000)
    # What lines and cells have of their own is drawn from their known sum.
    rest_m2 = variance_m2 - felt.total(weights) @ unknown.covariance @ felt.total(weights)
    y = draws @ felt.total(weights) + rng.normal(0, math.sqrt(rest_m2), 20_000)

    def left(columns):
        fit, *_ = np.linalg.lstsq(columns, y, rcond=None)
        return np.var(y - columns @ fit) / np.var(y)

    for group in ("tilt", "translation", "refraction"):
        of = members(unknown.names, group)
        assert told[group].first == pytest.approx(1 - left(draws[:, of]), abs=0.02)
        assert told[group].total == pytest.approx(left(draws[:, ~of]) - rest_m2 / variance_m2, abs=0.02)


def test_independent_inputs_have_one_share():
    rng = np.random.default_rng(6)
    felt, unknown = felt_by(rng), drawn(4, tied=False)
    weights = rng.uniform(0, 1, len(felt))
    _, told = sum_shares(weights, np.full(len(felt), 0.1), felt, unknown)
    for name, share in told.items():
        assert share.first == pytest.approx(share.part, abs=1e-9), name
        assert share.total == pytest.approx(share.part, abs=1e-9), name
    assert set(told) == set(INPUTS) == {*GROUPS, "random"}


@pytest.fixture(scope="module")
def moved():
    """The mean of cells on waves of 0.5 m that a shift does not follow to first order."""
    x, y = np.meshgrid(GRID.x_m, GRID.y_m)
    elevation_m = 2600 + 0.3 * x - 0.1 * y + 0.5 * np.sin(x / 40) * np.cos(y / 50)
    ground = terrain.ground(Reference.given(GRID, "1", elevation_m))
    rng = np.random.default_rng(8)
    row, column = rng.integers(3, 27, 40), rng.integers(3, 37, 40)
    height_m, east, north = ground.under(column + 0.5, row + 0.5)
    points = GRID.x_m[column], GRID.y_m[row], height_m
    offset_m = tuple(axis - at for axis, at in zip(points, POSITION_M, strict=True))
    felt = shared.sensitivities(OF, offset_m, east, north)
    weights = rng.uniform(0, 1, 40)
    return Moved(ground, POSITION_M, points, weights, felt, drawn(9, tied=False), np.full(40, 0.02**2))


def test_a_small_move_is_what_the_sensitivities_say(moved):
    """Inward from a cell's centre the ground's slope is another on either side; their mean is that of J."""
    count = len(OF.names)
    for at in (0, 1, 2, 5, 6, 7, 8, 9 + 3, 9 + OF.lean_count + 1, count - 2):
        step = 1e-3 * math.sqrt(moved.unknown.covariance[at, at])
        inputs = np.zeros((count + 2, 2))
        inputs[at] = step, -step
        ends = moved(inputs)
        wanted = moved.felt.total(moved.weights)[at]
        scale = abs(moved.felt.globals_[:, 0]).max() if at < 9 else abs(wanted)
        assert (ends[0] - ends[1]) / (2 * step) == pytest.approx(wanted, rel=0.05, abs=1e-2 * scale)


def test_simulated_shares_agree_with_those_of_the_covariance(moved):
    found = sobol(moved, moved.draw, moved.groups(), 128)
    _, told = sum_shares(moved.weights, moved.random_m2, moved.felt, moved.unknown)
    wanted = np.array([share.part for share in told.values()])
    assert wanted.max() < 0.9
    for index, error in ((found.first, found.first_error), (found.total, found.total_error)):
        assert (np.abs(index - wanted) < 4 * error + 0.01).all(), (index, wanted, error)
