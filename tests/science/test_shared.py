"""Shared errors: their effect against moved points, their covariance against simulation."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from station.quantities import Grid, Habits, Shared
from station.science import inclination, prior, shared
from station.science.air import EARTH_RADIUS_M

EAST, NORTH = 0.3, -0.2  # gradient of the plane the cells lie on
GRID = Grid(west_m=500.0, north_m=4000.0, cell_m=10.0, nx=200, ny=150)


def cells(count=200, seed=0):
    rng = np.random.default_rng(seed)
    return rng.uniform(500, 2500, count), rng.uniform(2500, 4000, count), rng.uniform(-700, 100, count)


def height_error(assumed_m, true_m):
    """How much too high the assumed point lies, seen on the plane through the true one."""
    error_m = np.asarray(assumed_m) - np.asarray(true_m)
    return error_m[2] - EAST * error_m[0] - NORTH * error_m[1]


def moved(parameter, unit, place_m):
    """Where a scanner that does not know of the error believes a point to be, from first principles."""
    place_m = np.array(place_m)
    range_m = np.linalg.norm(place_m, axis=0)
    horizontal_m = np.hypot(place_m[0], place_m[1])
    if parameter in ("tilt_east", "tilt_north", "heading"):
        axis = {"tilt_east": (1, 0, 0), "tilt_north": (0, 1, 0), "heading": (0, 0, -1)}[parameter]
        return Rotation.from_rotvec(np.multiply(axis, -unit)).as_matrix() @ place_m
    if parameter.startswith("translation"):
        axis = ["translation_east", "translation_north", "translation_up"].index(parameter)
        return place_m - unit * np.eye(3)[:, [axis]]
    if parameter == "range_bias":
        return place_m * (1 + unit / range_m)
    if parameter == "range_scale":
        return place_m * (1 + unit * 1e-6)
    if parameter == "across":
        sight = place_m / horizontal_m * np.array([[1.0], [1.0], [0.0]])
        return Rotation.from_rotvec(-unit * sight.T).apply(place_m.T).T
    elevation = np.arctan2(place_m[2], horizontal_m)
    turn = unit * horizontal_m / (2 * EARTH_RADIUS_M) if parameter == "refraction" else -unit
    outward = place_m[:2] / horizontal_m * (range_m * np.cos(elevation + turn))
    return np.vstack([outward, range_m * np.sin(elevation + turn)])


@pytest.mark.parametrize(
    ("parameter", "unit"),
    [
        *((name, 1e-6 if kind == "rad" else 1e-3) for name, kind in shared.GLOBAL),
        ("lean", 1e-6),
        ("across", 1e-6),
    ],
)
def test_sensitivities_against_moved_points(parameter, unit):
    place_m = cells()
    of = shared.basis(GRID, (0.0, 0.0, 0.0))
    felt = shared.sensitivities(of, place_m, np.full(200, EAST), np.full(200, NORTH))
    wanted = height_error(moved(parameter, unit, place_m), place_m) / unit
    told = dict(zip((name for name, _ in shared.GLOBAL), felt.globals_, strict=True))
    told = (told | {"lean": felt.lean, "across": felt.across})[parameter]
    assert told == pytest.approx(
        wanted, rel=2e-3, abs=1e-6 * abs(wanted).max() + 1e-3 * (parameter == "range_scale")
    )


def test_a_turn_about_where_a_leaning_head_looks():
    """As points move that are turned about the way to them, less what of it lies along the head's axis."""
    axis = np.array([0.05, -0.08, 1.0]) / np.linalg.norm([0.05, -0.08, 1.0])
    place_m = np.array(cells())
    of = shared.basis(GRID, (0.0, 0.0, 0.0), tuple(axis.tolist()))
    felt = shared.sensitivities(of, tuple(place_m), np.full(200, EAST), np.full(200, NORTH))
    sight = place_m - axis[:, None] * (axis @ place_m)
    moved_m = Rotation.from_rotvec(-1e-6 * (sight / np.linalg.norm(sight, axis=0)).T).apply(place_m.T).T
    wanted = height_error(moved_m, place_m) / 1e-6
    assert felt.across == pytest.approx(wanted, rel=2e-3, abs=1e-6 * abs(wanted).max())


def dense(felt):
    """The whole matrix J, by asking for the effect on each cell alone."""
    return np.array([felt.total(row) for row in np.eye(len(felt))])


def hats(of, line):
    """What each knot gives to a group of lines, five of which lie evenly between two knots."""
    weights = np.zeros(of.lean_count)
    before, within = divmod(line, 5)
    weights[before] += 0.9 - 0.2 * within
    weights[(before + 1) % of.lean_count] += 0.1 + 0.2 * within
    return weights


def random_unknown(of, seed=1):
    rng = np.random.default_rng(seed)
    size = len(of.names)
    root = rng.normal(size=(size, size)) * 1e-4
    noise = np.zeros(size)
    noise[9 : 9 + of.intervals] = rng.uniform(0, 1e-7, of.intervals)
    return Shared(of.names, of.units, np.zeros(size), root @ root.T, noise)


@pytest.mark.parametrize("position_m", [(0.0, 0.0, 0.0), (1500.0, 3000.0, 0.0)], ids=["sector", "all round"])
def test_variance_is_the_diagonal_of_jcjt(position_m):
    of = shared.basis(GRID, position_m)
    assert of.closed == (position_m[0] > 0)
    place_m = tuple(axis - origin for axis, origin in zip(cells(), position_m, strict=True))
    felt = shared.sensitivities(of, place_m, np.full(200, EAST), np.full(200, NORTH))
    unknown = random_unknown(of)
    matrix = dense(felt)
    line = np.zeros((200, of.line_count))
    line[np.arange(200), felt.line] = felt.lean
    own = np.repeat(unknown.noise_variance[9 : 9 + of.intervals], shared.LINES_A_KNOT)
    knots = np.array([hats(of, place) for place in range(of.line_count)])
    line = line - line @ knots @ np.linalg.lstsq(knots, np.eye(of.line_count), rcond=None)[0]
    whole = matrix @ unknown.covariance @ matrix.T + (line * own) @ line.T
    assert felt.variance(unknown) == pytest.approx(np.diag(whole))
    weights = np.random.default_rng(2).uniform(size=200)
    wanted = weights @ (np.eye(200) * 0.01 + whole) @ weights
    told = shared.aggregate_variance(weights, np.full(200, 0.01), felt, unknown)
    assert told == pytest.approx(wanted)


def test_knots_cover_the_sector():
    of = shared.basis(GRID, (0.0, 0.0, 0.0))
    corners = [math.atan2(e, n) for e in (500, 2500) for n in (2500, 4000)]
    assert of.refraction_azimuth_rad[0] <= min(corners)
    assert of.refraction_azimuth_rad[-1] >= max(corners)
    assert of.line_azimuth_rad[0] < of.refraction_azimuth_rad[1]
    assert len(of.names) == len(of.units) == 9 + of.lean_count + 2 * of.refraction_count


def test_a_line_of_a_leaning_head_has_one_azimuth():
    """Turned about an axis 5° from the plumb line, the head's plane crosses many azimuths of the map."""
    turn = Rotation.from_euler("xy", [5, 5], degrees=True).as_matrix()
    of = shared.basis(GRID, (0.0, 0.0, 0.0), tuple(turn[:, 2]))
    elevation = np.radians(np.linspace(-30, 20, 11))
    line = np.stack([0.6 * np.cos(elevation), 0.8 * np.cos(elevation), np.sin(elevation)])
    passed = of.knots_before(tuple(1000 * turn @ line))
    assert passed == pytest.approx(passed[0], abs=1e-6)
    assert np.ptp(np.degrees(np.arctan2(*(turn @ line)[:2]))) > 2


def test_an_area_mean_does_not_average_its_shared_errors_away():
    """Voordendag's √n makes 100 m boxes 2-3 times and a glacier 40 times too sure (EQUATIONS 6)."""
    of = shared.basis(GRID, (0.0, 0.0, 0.0))
    place_m = cells(4000)
    felt = shared.sensitivities(of, place_m, np.full(4000, EAST), np.full(4000, NORTH))
    lines = prior.lines_of(of, np.eye(3), None)
    unknown = prior.covariance_without_adjustment(
        of, lines, None, inclination.LEVEL, Habits(), weather_known=True
    )
    weights = np.full(4000, 1 / 4000)
    mean_m2 = shared.aggregate_variance(weights, np.full(4000, 0.01), felt, unknown)
    alone_m2 = 0.01 + felt.variance(unknown).mean()
    assert math.sqrt(mean_m2) > 10 * math.sqrt(alone_m2 / 4000)


def test_what_the_log_cannot_know_is_a_covariance():
    of = shared.basis(GRID, (0.0, 0.0, 0.0))
    time_s = np.arange(0.0, 920.0)
    noise = np.radians(np.random.default_rng(3).normal(0, 0.008, (2, 920)))
    log = inclination.InclinationLog(time_s, *noise)
    lean = inclination.relative_lean(log, None, inclination.LEVEL, math.radians(0.008))
    zero = inclination.Cycle((0, 7e-4, 0), (0, 0, 7e-4))
    lines = prior.lines_of(of, np.eye(3), None)
    with_log, without = (
        prior.covariance_without_adjustment(of, lines, told, zero, Habits(), weather_known=True)
        for told in (lean, None)
    )
    for unknown in (with_log, without):
        assert np.linalg.eigvalsh(unknown.covariance).min() > -1e-18
        assert unknown.covariance == pytest.approx(unknown.covariance.T)
    assert with_log.covariance[0, 0] < without.covariance[0, 0]
