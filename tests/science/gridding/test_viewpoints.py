"""Sigma of scans from several positions: of their shots, and of their motion, against simulations."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from science.uncertainty import test_propagation as plane

from station.processing.pipeline import (
    Pose,
    add_blocks,
    grid_scan,
    measure,
    new_gridder,
    reference_viewing_geometry,
    stacking_inputs,
)
from station.quantities import Grid, Reference, ScanGeometry, Scanner, SharedParameters, Shots, Viewpoint
from station.science.gridding.viewpoints import PositionErrors, position_errors, seen_from_viewpoints
from station.science.uncertainty import parameters
from station.science.uncertainty.jacobian import height_jacobian

GRID = Grid(west_m=0.0, north_m=80.0, cell_m=1.0, nx=90, ny=80)
GRADIENT = 0.02, -0.03
JITTER_RAD = np.radians(0.0008)  # of lines, equations.md 6.4
PRECISE = Viewpoint(Scanner("a", 1.55, 0.3e-3, 0.0, 0.005, 0.0, 1e-4, 0.2, 900.0), (-60.0, 20.0, 40.0))
NOISY = Viewpoint(Scanner("b", 1.55, 3e-3, 0.0, 0.040, 0.0, 1e-4, 0.2, 900.0), (160.0, 90.0, 25.0))
ZONES = {"first": (0, 30), "both": (30, 60), "second": (60, 90)}


def ground(x_m, y_m):
    return 10.0 + GRADIENT[0] * x_m + GRADIENT[1] * y_m


def shots_from(viewpoint, number, random, west_m, east_m, count):
    """Return shots on the map with normal errors of range and of both angles, as the instrument has them."""
    x_m, y_m = random.uniform(west_m, east_m, count), random.uniform(0.0, 80.0, count)
    offset_m = np.stack([x_m, y_m, ground(x_m, y_m)]).T - viewpoint.position_m
    range_m = np.linalg.norm(offset_m, axis=1, keepdims=True)
    direction = offset_m / range_m
    sideways = np.cross(direction, [0.0, 0.0, 1.0])
    sideways /= np.linalg.norm(sideways, axis=1, keepdims=True)
    angle_rad = np.hypot(viewpoint.scanner.beam_divergence_rad / 4, JITTER_RAD)
    noise = random.normal(0, 1, (3, count, 1))
    direction = direction + angle_rad * (noise[0] * sideways + noise[1] * np.cross(sideways, direction))
    range_m = range_m + viewpoint.scanner.range_sigma_m * noise[2]
    return Shots((viewpoint.position_m + range_m * direction).T, None, None, number)


def scan(seed):
    """Return the shots of both: the first sees the western two thirds, the second the eastern ones."""
    random = np.random.default_rng(seed)
    first = shots_from(PRECISE, 0, random, 0.0, 60.0, 20_000)
    return [first, shots_from(NOISY, 1, random, 30.0, 90.0, 10_000)]


def truth():
    return Reference.from_elevation(GRID, "truth", ground(*np.meshgrid(GRID.x_m, GRID.y_m)))


@pytest.fixture(scope="module", params=["on a reference", "without one"])
def case(request):
    return SimpleNamespace(reference=truth() if request.param == "on a reference" else None, shots=scan(2))


def z_by_zone(case, viewpoints):
    """Return the standard deviation of error over random sigma, by the instruments that saw the cells."""
    geometry = ScanGeometry(PRECISE.scanner, GRID, PRECISE.position_m, viewpoints=viewpoints)
    viewing = case.reference and reference_viewing_geometry(
        case.reference, replace(geometry, viewpoints=()), np.zeros(GRID.shape, bool)
    )
    gridder = new_gridder(geometry, viewing)
    grid_scan(gridder, case.shots, Pose(None, None), lambda: None)
    viewing = viewing and seen_from_viewpoints(viewing, gridder, geometry)
    measured = measure(gridder, geometry, None, viewing)
    height_m, sigma_m = measured.to_rasters("elevation_m", "uncertainty_m")
    z = (height_m - ground(*np.meshgrid(GRID.x_m, GRID.y_m))) / sigma_m
    return {zone: np.nanstd(z[2:-2, first + 2 : end - 2]) for zone, (first, end) in ZONES.items()}


def test_sigma_is_that_of_the_instrument_that_saw_the_cell(case):
    for zone, z in z_by_zone(case, (PRECISE, NOISY)).items():
        assert z == pytest.approx(1.0, abs=0.06), zone


def test_sigma_of_one_instrument_for_both_is_wrong(case):
    one = replace(NOISY, scanner=PRECISE.scanner)
    assert z_by_zone(case, (PRECISE, one))["second"] > 3.0


def test_variance_of_a_cell_is_that_of_its_shots():
    """Weighted by their numbers: here three of the first and one of the second, in two cells."""
    geometry = ScanGeometry(PRECISE.scanner, GRID, PRECISE.position_m, viewpoints=(PRECISE, NOISY))
    viewing = reference_viewing_geometry(truth(), geometry, np.zeros(GRID.shape, bool))
    centre_m = np.array([[40.5, 41.5], [40.5, 40.5], [ground(40.5, 40.5), ground(41.5, 40.5)]])
    gridder = new_gridder(geometry, viewing)
    blocks = [Shots(np.repeat(centre_m, 3, axis=1), None), Shots(centre_m, None, None, 1)]
    grid_scan(gridder, blocks, Pose(None, None), lambda: None)
    seen, _ = stacking_inputs(gridder, seen_from_viewpoints(viewing, gridder, geometry), None)
    normal = np.array([-GRADIENT[0], -GRADIENT[1], 1.0])  # e @ normal is the height error of a shift e
    expected_m2 = 0.0
    for weight, viewpoint in ((0.75, PRECISE), (0.25, NOISY)):
        offset_m = centre_m[:, 0] - viewpoint.position_m
        range_m = np.linalg.norm(offset_m)
        along = (offset_m / range_m) @ normal
        angle_rad = np.hypot(viewpoint.scanner.beam_divergence_rad / 4, JITTER_RAD)
        across_m2 = (range_m * angle_rad) ** 2 * (normal @ normal - along**2)
        expected_m2 += weight * ((viewpoint.scanner.range_sigma_m * along) ** 2 + across_m2)
    assert seen[39, 40] == pytest.approx(expected_m2, rel=1e-4)
    assert np.count_nonzero(seen) == 2


@pytest.mark.parametrize("count", [2, 4])
def test_variance_is_that_of_positions_that_each_move_on_their_own(count):
    """Less what an adjustment finds of the motion; each motion moves points about its own position."""
    cells, random = 40, np.random.default_rng(count)
    usual = np.array([1e-4, 1e-4, 3e-5, 0.003, 0.003, 0.003, 0.004])
    baseline_m = np.vstack([np.zeros(3), random.uniform(-200.0, 200.0, (count - 1, 3))])
    offset_m = np.array(plane.cells(cells))
    shares = random.dirichlet(np.full(count, 0.5), cells).T
    shares[:, 0], adjusted = 1 / count, np.full(count, 1 / count)
    expected_m2 = np.zeros(cells)
    for position in range(count):
        seen_m = offset_m - baseline_m[position][:, None]
        for (name, _), sigma in zip(parameters.GLOBAL, usual, strict=False):
            error_m = plane.height_error(seen_m, plane.moved(name, sigma, seen_m))
            expected_m2 += ((shares[position] - adjusted[position]) * error_m) ** 2
    params = parameters.parameter_layout(plane.GRID, (0.0, 0.0, 0.0))
    slope = np.full(cells, plane.EAST), np.full(cells, plane.NORTH)
    jacobian = height_jacobian(params, tuple(offset_m), *slope)
    gridder = SimpleNamespace(viewpoint_shares=lambda cell_index: shares[:, cell_index], grid=plane.GRID)
    blocks = np.repeat(adjusted, 15 * 20).reshape(count, 15, 20)
    for local in ("mean", "own"):  # shares of the cells around: those of all, or those of each cell
        if local == "own":
            blocks[:, np.arange(cells) // 20, np.arange(cells) % 20] = shares
        each = np.tile(usual**2, (count, 1))
        errors = PositionErrors(gridder, each, each, baseline_m, adjusted, blocks).scaled(4.0)
        cell = np.arange(cells) // 20 * 2000 + np.arange(cells) % 20 * 10  # one in each block
        variances_m2 = errors.height_variances(np.arange(cells), cell, jacobian, tuple(offset_m))
        systematic_m2, random_m2 = variances_m2 if local == "own" else variances_m2[::-1]
        np.testing.assert_allclose(systematic_m2, 4.0 * expected_m2, rtol=2e-3, atol=1e-15)
        np.testing.assert_allclose(random_m2, 0.0, atol=1e-15)
    assert expected_m2[0] == 0.0
    assert np.sqrt(expected_m2[1:].min()) > 0.001


@pytest.mark.parametrize("count", [2, 4])
def test_residuals_show_how_much_positions_moved(count):
    """Whatever they have in common: the adjustment took that. Without residuals the usual motion is left."""
    random, usual = np.random.default_rng(count), np.array([1e-4, 1e-4, 3e-5, 0.003, 0.003, 0.003, 0.004])
    motion = random.normal(size=(count, 7)) * usual
    shares = random.dirichlet(np.full(count, 0.5), 4000).T - 1 / count
    effects = random.normal(size=(7, 4000)) * ([[300.0]] * 3 + [[1.0]] * 4)
    design = np.concatenate([share * effects for share in shares])
    noise_m = random.normal(0, 0.005, 4000)
    noise_m[::100] += 1.0  # outliers
    baseline_m = np.zeros((count, 3))
    each = np.tile(usual**2, (count, 1))
    errors = PositionErrors(None, each, each, baseline_m, shares[:, 0], shares[:, :1, None])
    apart = (motion - motion.mean(axis=0)) ** 2 * count / (count - 1)
    for moved, expected in ((1.0, apart), (0.0, np.zeros((count, 7)))):
        residual_m = moved * motion.ravel() @ design + noise_m
        found = errors.variance_by([(design, residual_m, np.full(4000, 0.005**2))])
        np.testing.assert_allclose(np.sqrt(found / usual**2), np.sqrt(expected / usual**2), atol=0.3)
    np.testing.assert_allclose(errors.variance_by([]), each)


def test_sigma_of_a_cell_is_that_of_the_positions_that_saw_it():
    """Ground that one of two saw has half the variance of their motion, and ground that both saw has none.

    Where every second cell is of the one, the error is random. The epoch has the mean of the systematic part.
    """
    geometry = ScanGeometry(PRECISE.scanner, GRID, PRECISE.position_m, viewpoints=(PRECISE, PRECISE))
    viewing = reference_viewing_geometry(truth(), geometry, np.ones(GRID.shape, bool))
    gridder = new_gridder(geometry, viewing)
    x_m, y_m = (axis.ravel() for axis in np.meshgrid(GRID.x_m, GRID.y_m))
    centre_m = np.stack([x_m, y_m, ground(x_m, y_m)])
    mixed, second = (x_m > 30) & (x_m < 60), (x_m > 60) | ((x_m < 60) & (x_m > 30) & (y_m % 2 > 1))
    for number, chosen in enumerate((~second | (mixed & (y_m > 40)), second | (mixed & (y_m > 40)))):
        shots = Shots(np.repeat(centre_m[:, chosen], 50, axis=1), None, None, number)
        add_blocks(gridder, [shots], Pose(None, None), lambda: None)
    gridder.finish()
    variance, names = np.zeros(10), [name for name, _ in parameters.GLOBAL]
    up = names.index("translation_up")
    variance[up] = 0.2**2
    assert position_errors(gridder, replace(geometry, viewpoints=()), viewing, variance) is None
    errors = position_errors(gridder, geometry, viewing, variance)
    empty = np.zeros(len(viewing.params.names))
    known = SharedParameters(viewing.params.names, viewing.params.units, empty, np.diag(empty), empty)
    stored = errors.added_to(known, viewing).covariance
    assert stored[up, up] == pytest.approx(0.2**2 / 3, rel=1e-6)
    measured = measure(gridder, geometry, known, viewing, position_errors=errors)
    total_m, systematic_m = measured.to_rasters("uncertainty_m", "systematic_uncertainty_m")
    random_m = np.sqrt(total_m**2 - systematic_m**2)
    for zone, rows, systematic, random in (
        ("first", np.s_[:], 0.1414, 0.0),
        ("second", np.s_[:], 0.1414, 0.0),
        ("both", np.s_[:40], 0.0, 0.0),
        ("both", np.s_[40:], 0.0, 0.1414),
    ):
        first, end = ZONES[zone]
        np.testing.assert_allclose(systematic_m[rows, first:end], systematic, rtol=0.02, atol=1e-6)
        np.testing.assert_allclose(random_m[rows, first:end], random, rtol=0.02, atol=0.01)
