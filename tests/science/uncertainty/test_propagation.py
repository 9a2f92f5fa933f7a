"""Shared parameters: Jacobian against moved points, propagation of covariance against dense algebra."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from station.quantities import Grid, SharedParameters, VarianceComponents
from station.science.adjustment import prior
from station.science.geometry import inclination
from station.science.geometry.air import EARTH_RADIUS_M
from station.science.geometry.cyclic_error import NO_CYCLIC_ERROR, CyclicError
from station.science.uncertainty import parameters, propagation
from station.science.uncertainty.jacobian import height_jacobian

EAST, NORTH = 0.3, -0.2  # gradient of the plane on which the cells lie
GRID = Grid(west_m=500.0, north_m=4000.0, cell_m=10.0, nx=200, ny=150)


def cells(count=200, seed=0):
    rng = np.random.default_rng(seed)
    return rng.uniform(500, 2500, count), rng.uniform(2500, 4000, count), rng.uniform(-700, 100, count)


def height_error(assumed_m, true_m):
    """Return the height of the assumed point above the plane through the true one [m]."""
    error_m = np.asarray(assumed_m) - np.asarray(true_m)
    return error_m[2] - EAST * error_m[0] - NORTH * error_m[1]


def moved(parameter, error, offset_m):
    """Return where a scanner with an unknown error in one parameter puts a point, from first principles."""
    offset_m = np.array(offset_m)
    range_m = np.linalg.norm(offset_m, axis=0)
    horizontal_m = np.hypot(offset_m[0], offset_m[1])
    if parameter in ("tilt_east", "tilt_north", "heading"):
        axis = {"tilt_east": (1, 0, 0), "tilt_north": (0, 1, 0), "heading": (0, 0, -1)}[parameter]
        return Rotation.from_rotvec(np.multiply(axis, -error)).as_matrix() @ offset_m
    if parameter.startswith("translation"):
        axis = ["translation_east", "translation_north", "translation_up"].index(parameter)
        return offset_m - error * np.eye(3)[:, [axis]]
    if parameter == "range_bias":
        return offset_m * (1 + error / range_m)
    if parameter == "range_scale":
        return offset_m * (1 + error * 1e-6)
    if parameter == "cross_tilt":
        sight = offset_m / horizontal_m * np.array([[1.0], [1.0], [0.0]])
        return Rotation.from_rotvec(-error * sight.T).apply(offset_m.T).T
    elevation = np.arctan2(offset_m[2], horizontal_m)
    elevation_error_rad = (
        error * horizontal_m / (2 * EARTH_RADIUS_M) if parameter.startswith("refraction") else -error
    )
    horizontal = offset_m[:2] / horizontal_m * (range_m * np.cos(elevation + elevation_error_rad))
    return np.vstack([horizontal, range_m * np.sin(elevation + elevation_error_rad)])


@pytest.mark.parametrize(
    ("parameter", "error"),
    [
        *((name, 1e-6 if kind == "rad" else 1e-3) for name, kind in parameters.GLOBAL),
        ("sight_tilt", 1e-6),
        ("cross_tilt", 1e-6),
    ],
)
def test_height_jacobian_equals_the_effect_on_moved_points(parameter, error):
    offset_m = cells()
    params = parameters.parameter_layout(GRID, (0.0, 0.0, 0.0))
    jacobian = height_jacobian(params, offset_m, np.full(200, EAST), np.full(200, NORTH))
    expected = height_error(moved(parameter, error, offset_m), offset_m) / error
    actual = dict(zip((name for name, _ in parameters.GLOBAL), jacobian.pose, strict=True))
    actual = (actual | {"sight_tilt": jacobian.sight_tilt, "cross_tilt": jacobian.cross_tilt})[parameter]
    assert actual == pytest.approx(
        expected, rel=2e-3, abs=1e-6 * abs(expected).max() + 1e-3 * (parameter == "range_scale")
    )


def test_cross_tilt_of_a_tilted_head():
    """Points rotated about the line of sight, without its component along the head's axis."""
    axis = np.array([0.05, -0.08, 1.0]) / np.linalg.norm([0.05, -0.08, 1.0])
    offset_m = np.array(cells())
    params = parameters.parameter_layout(GRID, (0.0, 0.0, 0.0), tuple(axis.tolist()))
    jacobian = height_jacobian(params, tuple(offset_m), np.full(200, EAST), np.full(200, NORTH))
    sight_direction = offset_m - axis[:, None] * (axis @ offset_m)
    moved_m = (
        Rotation.from_rotvec(-1e-6 * (sight_direction / np.linalg.norm(sight_direction, axis=0)).T)
        .apply(offset_m.T)
        .T
    )
    expected = height_error(moved_m, offset_m) / 1e-6
    assert jacobian.cross_tilt == pytest.approx(expected, rel=2e-3, abs=1e-6 * abs(expected).max())


def dense(jacobian):
    """Return the whole matrix J (n, p), one cell after another."""
    return np.array([jacobian.aggregate(row) for row in np.eye(len(jacobian))])


def knot_weights(params, line):
    """Return the weights of all knots for a line group; five groups lie evenly between two knots."""
    weights = np.zeros(params.sight_tilt_knots)
    lower, group = divmod(line, 5)
    weights[lower] += 0.9 - 0.2 * group
    weights[(lower + 1) % params.sight_tilt_knots] += 0.1 + 0.2 * group
    return weights


def random_shared_parameters(params, seed=1):
    rng = np.random.default_rng(seed)
    size = len(params.names)
    root = rng.normal(size=(size, size)) * 1e-4
    line_variance = np.zeros(size)
    line_variance[10 : 10 + params.knot_intervals] = rng.uniform(0, 1e-7, params.knot_intervals)
    return SharedParameters(params.names, params.units, np.zeros(size), root @ root.T, line_variance)


@pytest.mark.parametrize("position_m", [(0.0, 0.0, 0.0), (1500.0, 3000.0, 0.0)], ids=["sector", "all round"])
def test_variance_equals_the_diagonal_of_jcjt(position_m):
    params = parameters.parameter_layout(GRID, position_m)
    assert params.full_circle == (position_m[0] > 0)
    offset_m = tuple(axis - origin for axis, origin in zip(cells(), position_m, strict=True))
    jacobian = height_jacobian(params, offset_m, np.full(200, EAST), np.full(200, NORTH))
    shared = random_shared_parameters(params)
    design = dense(jacobian)
    line_design = np.zeros((200, params.line_groups))
    line_design[np.arange(200), jacobian.line] = jacobian.sight_tilt
    line_rad2 = np.repeat(
        shared.line_tilt_variance[10 : 10 + params.knot_intervals], parameters.LINE_GROUPS_PER_KNOT
    )
    knots = np.array([knot_weights(params, line) for line in range(params.line_groups)])
    line_design -= line_design @ knots @ np.linalg.solve(knots.T @ knots, knots.T)
    covariance = design @ shared.covariance @ design.T + (line_design * line_rad2) @ line_design.T
    assert jacobian.variance(shared) == pytest.approx(np.diag(covariance))
    weights = np.random.default_rng(2).uniform(size=200)
    expected = weights @ (np.eye(200) * 0.01 + covariance) @ weights
    actual = propagation.aggregate_variance(weights, np.full(200, 0.01), jacobian, shared)
    assert actual == pytest.approx(expected)


@pytest.mark.parametrize("position_m", [(0.0, 0.0, 0.0), (1500.0, 3000.0, 0.0)], ids=["sector", "all round"])
def test_sparse_jacobian_effect_and_sums_equal_dense_algebra(position_m):
    params = parameters.parameter_layout(GRID, position_m)
    offset_m = tuple(axis - origin for axis, origin in zip(cells(), position_m, strict=True))
    jacobian = height_jacobian(params, offset_m, np.full(200, EAST), np.full(200, NORTH))
    design = dense(jacobian)
    assert np.allclose(jacobian.to_sparse().toarray(), design, rtol=1e-12, atol=1e-12)
    state, weights = np.random.default_rng(3).normal(size=len(params.names)), np.linspace(-1, 1, 200)
    assert jacobian.effect(state) == pytest.approx(design @ state, rel=1e-9)
    line_design = jacobian.line_tilt_to_sparse().toarray()
    assert np.array_equal(line_design[np.arange(200), jacobian.line], jacobian.sight_tilt)
    assert np.count_nonzero(line_design) == 200
    assert jacobian.aggregate_by_line(weights) == pytest.approx(weights @ line_design)


def test_knots_cover_the_sector_of_the_grid():
    params = parameters.parameter_layout(GRID, (0.0, 0.0, 0.0))
    corners = [math.atan2(e, n) for e in (500, 2500) for n in (2500, 4000)]
    assert params.refraction_azimuth_rad[0] <= min(corners)
    assert params.refraction_azimuth_rad[-1] >= max(corners)
    assert params.line_azimuth_rad[0] < params.refraction_azimuth_rad[1]
    assert (
        len(params.names) == len(params.units) == 10 + params.sight_tilt_knots + 2 * params.refraction_knots
    )


def test_scan_line_of_a_tilted_head_has_one_head_azimuth():
    """With the axis 5° from the vertical, a scan line crosses several degrees of map azimuth."""
    rotation = Rotation.from_euler("xy", [5, 5], degrees=True).as_matrix()
    params = parameters.parameter_layout(GRID, (0.0, 0.0, 0.0), tuple(rotation[:, 2]))
    elevation = np.radians(np.linspace(-30, 20, 11))
    line = np.stack([0.6 * np.cos(elevation), 0.8 * np.cos(elevation), np.sin(elevation)])
    position = params.knot_position(tuple(1000 * rotation @ line))
    assert position == pytest.approx(position[0], abs=1e-6)
    assert np.ptp(np.degrees(np.arctan2(*(rotation @ line)[:2]))) > 2


def test_shared_errors_do_not_average_out_in_an_area_mean():
    """Division by √n understates sigma 2-3 times for 100 m boxes, 40 times for a glacier: equations.md, 6."""
    params = parameters.parameter_layout(GRID, (0.0, 0.0, 0.0))
    offset_m = cells(4000)
    jacobian = height_jacobian(params, offset_m, np.full(4000, EAST), np.full(4000, NORTH))
    lines = prior.line_times(params, np.eye(3), None)
    posterior = prior.log_only_covariance(
        params, lines, None, NO_CYCLIC_ERROR, VarianceComponents(), weather_known=True
    )
    weights = np.full(4000, 1 / 4000)
    mean_m2 = propagation.aggregate_variance(weights, np.full(4000, 0.01), jacobian, posterior)
    cell_m2 = 0.01 + jacobian.variance(posterior).mean()
    assert math.sqrt(mean_m2) > 10 * math.sqrt(cell_m2 / 4000)


def test_log_only_covariance_is_symmetric_and_smaller_with_a_log():
    params = parameters.parameter_layout(GRID, (0.0, 0.0, 0.0))
    time_s = np.arange(0.0, 920.0)
    noise = np.radians(np.random.default_rng(3).normal(0, 0.008, (2, 920)))
    log = inclination.InclinationLog(time_s, *noise)
    record = inclination.relative_tilt(log, None, NO_CYCLIC_ERROR, math.radians(0.008))
    cyclic_error = CyclicError((0, 7e-4, 0), (0, 0, 7e-4))
    lines = prior.line_times(params, np.eye(3), None)
    with_log, without = (
        prior.log_only_covariance(
            params, lines, inclination_record, cyclic_error, VarianceComponents(), weather_known=True
        )
        for inclination_record in (record, None)
    )
    for posterior in (with_log, without):
        assert np.linalg.eigvalsh(posterior.covariance).min() > -1e-18
        assert posterior.covariance == pytest.approx(posterior.covariance.T)
    assert with_log.covariance[0, 0] < without.covariance[0, 0]


def test_stated_uncertainty_of_the_pose_replaces_its_covariance():
    params = parameters.parameter_layout(GRID, (0.0, 0.0, 0.0))
    shared = random_shared_parameters(params)
    stated = propagation.with_pose_uncertainty(shared, 1e-5, 0.02)
    names = list(shared.names)
    for name, sigma in (("tilt_east", 1e-5), ("heading", 1e-5), ("translation_up", 0.02)):
        row = names.index(name)
        assert stated.covariance[row, row] == pytest.approx(sigma**2)
        assert np.count_nonzero(stated.covariance[row]) == np.count_nonzero(stated.covariance[:, row]) == 1
    rest = slice(names.index("range_bias"), None)
    np.testing.assert_array_equal(stated.covariance[rest, rest], shared.covariance[rest, rest])
