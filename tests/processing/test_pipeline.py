"""Pipeline from shots to surface, for shots simulated from first principles."""

import math
from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest

from station.processing.pipeline import (
    AdjustmentInputs,
    Pose,
    adjust_to_reference,
    grid_scan,
    measure,
    new_gridder,
    reference_viewing_geometry,
    stacking_inputs,
    to_map,
)
from station.processing.scans import scan_residuals
from station.quantities import (
    Air,
    Grid,
    Quality,
    Reference,
    ScanGeometry,
    Scanner,
    Shots,
    TiltSeries,
    VarianceComponents,
)
from station.science.adjustment.ground_classes import SnowTest
from station.science.adjustment.ground_response import StableResponse
from station.science.adjustment.prior import line_times, log_only_covariance
from station.science.geometry.air import air_correction
from station.science.geometry.cyclic_error import NO_CYCLIC_ERROR
from station.science.geometry.pose import scanner_to_local_map, scanner_to_map_by_origin
from station.science.gridding import cells_outside, reference_cells
from station.science.gridding.reference_surface import build_surface, centre_reference
from station.science.gridding.scan_stack import ScanStack
from station.science.uncertainty import budget
from station.science.uncertainty.parameters import parameter_layout

VZ6000 = Scanner("vz", 1.064, 0.12e-3, 0.0, 0.010, *np.radians((0.0005, 0.008, 10.0)), 6000.0)
GRID = Grid(west_m=1500.0, north_m=600.0, cell_m=4.0, nx=150, ny=300)
POSITION_M = (0.0, 0.0, 3245.0)
GRADIENT = (0.25, -0.1)


def height(x_m, y_m):
    """Return heights of a wavy slope that rises away from the scanner, 650 m below it at the near edge."""
    return 2600 + GRADIENT[0] * (x_m - 1500) + GRADIENT[1] * y_m + 2 * np.sin(x_m / 60) * np.cos(y_m / 45)


def shots_at(x_m, y_m, seed=0, *, noise=True):
    """Return echoes with range noise, from beams scattered within the divergence."""
    rng = np.random.default_rng(seed)
    offset_m = np.stack([x_m, y_m, height(x_m, y_m)]) - np.array(POSITION_M)[:, None]
    range_m = np.linalg.norm(offset_m, axis=0)
    if not noise:
        return Shots(offset_m, None)
    direction = offset_m / range_m
    sideways = np.cross(direction.T, [0, 0, 1]).T
    sideways /= np.linalg.norm(sideways, axis=0)
    upward = np.cross(sideways.T, direction.T).T
    jitter = rng.normal(0, 0.12e-3 / 4, (2, len(x_m)))
    jitter[1] += rng.normal(0, math.radians(0.0008), len(x_m))
    recorded = direction + jitter[0] * sideways + jitter[1] * upward
    recorded *= (range_m + rng.normal(0, 0.010, len(x_m))) / np.linalg.norm(recorded, axis=0)
    return Shots(recorded, None)


def raised(shots, rise_m):
    return Shots(shots.xyz_m + np.array([[0.0], [0.0], [1.0]]) * rise_m, None)


def random_positions(count, seed):
    rng = np.random.default_rng(seed)
    return rng.uniform(1490, 2110, count), rng.uniform(-610, 610, count)


def truth():
    x_m, y_m = np.meshgrid(GRID.x_m, GRID.y_m)
    return Reference.from_elevation(GRID, "truth", height(x_m, y_m))


NO_CELLS = np.zeros(GRID.shape, bool)


def process_shots(shots, reference, posterior=None, stable=NO_CELLS, **settings):
    sop = np.eye(4)
    sop[:3, 3] = POSITION_M
    scan_geometry = ScanGeometry(VZ6000, GRID, POSITION_M, **settings)
    viewing = reference and reference_viewing_geometry(reference, scan_geometry, stable)
    gridder = new_gridder(scan_geometry, viewing)
    grid_scan(gridder, [shots], Pose(scanner_to_local_map(sop), None), lambda: None)
    return (
        Rasters(measure(deepcopy(gridder), scan_geometry, posterior, viewing)),
        gridder,
        scan_geometry,
        viewing,
    )


class Rasters:
    """Columns of a measurement as rasters."""

    def __init__(self, measured):
        self.measured = measured
        self.terms = dict(zip(measured.terms, measured.to_rasters(*measured.terms), strict=True))

    def __getattr__(self, name):
        return self.measured.to_rasters(name)[0]

    @property
    def random_uncertainty_m(self):
        return np.sqrt(self.uncertainty_m**2 - self.systematic_uncertainty_m**2)


def test_surface_of_shots_without_errors_is_the_truth():
    measured, *_ = process_shots(shots_at(*random_positions(200_000, 1), noise=False), truth())
    inner = measured.change_m[1:-1, 1:-1]
    assert np.abs(inner[np.isfinite(inner)]).max() < 0.01  # bilinear against waves of 2 m


def test_random_uncertainty_is_calibrated():
    """Standard deviation of error over stated sigma, over all cells and by number of points."""
    measured, *_ = process_shots(shots_at(*random_positions(150_000, 2)), truth())
    z = measured.change_m / measured.random_uncertainty_m
    assert np.nanstd(z) == pytest.approx(1.0, abs=0.05)
    for points in (1, 3, 6):
        assert np.nanstd(z[measured.count == points]) == pytest.approx(1.0, abs=0.1)


def test_random_uncertainty_without_reference_includes_slope_sampling():
    measured, *_ = process_shots(shots_at(*random_positions(150_000, 3)), None)
    several = measured.count >= 2
    x_m, y_m = np.meshgrid(GRID.x_m, GRID.y_m)
    z = (measured.elevation_m - height(x_m, y_m)) / measured.random_uncertainty_m
    assert np.isnan(measured.change_m).all()
    assert np.std(z[several & np.isfinite(z)]) == pytest.approx(1.0, abs=0.15)
    assert (measured.quality[several] & Quality.OUTSIDE_REFERENCE).all()


@pytest.mark.integration
def test_reference_from_scans_equals_the_truth_within_its_uncertainty():
    scans = [shots_at(*random_positions(100_000, seed), seed=seed) for seed in range(4, 10)]
    reference, x_m, y_m = None, *np.meshgrid(GRID.x_m, GRID.y_m)
    for centred in (False, False, True):
        stack = ScanStack(GRID)
        for shots in scans:
            _, gridder, scan_geometry, viewing = process_shots(shots, reference)
            roughness_m2 = None if reference is None else reference.roughness_m2
            stack.add(gridder, reference and stacking_inputs(gridder, viewing, None), roughness_m2)
        position_m, components = scan_geometry.position_m, VarianceComponents()
        if centred:
            reference = centre_reference(reference, stack, position_m, components)
        else:
            reference = build_surface(
                stack, reference, None, position_m, "1", ("a",), np.array([0.0, 7200.0]), components
            )
    assert reference.time_s == 3600.0
    measured = [process_shots(shots, reference)[0] for shots in scans]
    mean_m = np.nanmean([scan.change_m for scan in measured], axis=0)
    sigma_m = np.nanmax([scan.random_uncertainty_m for scan in measured], axis=0)
    assert np.nanmax(np.abs(mean_m) / sigma_m) <= 0.13  # changes are rounded to a quarter of sigma
    error = reference.elevation_m + reference.mean_residual_m - height(x_m, y_m)
    assert np.nanmedian(error) == pytest.approx(0.0, abs=1e-3)
    assert 1.4826 * np.nanmedian(np.abs(error)) < 0.03
    measured, *_ = process_shots(shots_at(*random_positions(100_000, 30), seed=30), reference)
    z = measured.change_m / measured.random_uncertainty_m
    assert np.nanstd(z) == pytest.approx(1.0, abs=0.1)


@pytest.mark.integration
def test_roughness_within_cells_is_estimated():
    """Boulders of 0.2 m, estimated from three scans."""
    rng = np.random.default_rng(99)
    reference = truth()
    stack = ScanStack(GRID)
    for seed in range(3):
        shots = shots_at(*random_positions(300_000, seed), seed=seed)
        rough = raised(shots, rng.normal(0, 0.2, len(shots)))
        _, gridder, _, viewing = process_shots(rough, reference)
        stack.add(gridder, stacking_inputs(gridder, viewing, None))
    several = stack.count > 10
    assert np.sqrt(stack.roughness()[several].mean()) == pytest.approx(0.2, rel=0.05)


def test_shared_errors_are_part_of_sigma_and_of_the_budget_terms():
    params = parameter_layout(GRID, POSITION_M)
    lines = line_times(params, np.eye(3), None)
    posterior = log_only_covariance(
        params, lines, None, NO_CYCLIC_ERROR, VarianceComponents(), weather_known=True
    )
    measured, *_ = process_shots(shots_at(*random_positions(50_000, 4)), truth(), posterior, store_terms=True)
    total = np.sqrt(sum(np.square(measured.terms[name]) for name in budget.TERMS))
    assert all(np.nanmedian(measured.terms[name]) > 0 for name in budget.TERMS if name != "sigma_raster")
    observed = np.isfinite(measured.uncertainty_m)
    assert np.allclose(measured.uncertainty_m[observed], total[observed], rtol=0.016)  # two digits
    assert (measured.uncertainty_m > measured.random_uncertainty_m)[observed].all()
    # The published budgets take a tilt error of 0.008° as independent between points.
    tilt_m = 1800 * math.radians(0.008) / np.sqrt(measured.count[observed].mean())
    for name in ("sigma_hartzell2015", "sigma_voordendag2023"):
        assert np.median(measured.terms[name][observed]) == pytest.approx(tilt_m, rel=0.35)


def test_published_budget_if_configured():
    """Voordendag et al. (2023), Eq. 1, 2 and 3 at a cell, from the same shots."""
    measured, *_ = process_shots(
        shots_at(*random_positions(50_000, 5)),
        truth(),
        published_budget=True,
        store_terms=True,
        registration_sigma_m=0.02,
    )
    terms = measured.terms
    point_terms = ("sigma_instrument", "sigma_atmosphere", "sigma_geometry")
    point_m = np.sqrt(sum(np.square(terms[name]) for name in point_terms))
    expected = point_m / np.sqrt(np.maximum(measured.count, 1)) + 0.02
    observed = np.isfinite(measured.uncertainty_m)
    assert np.allclose(measured.uncertainty_m[observed], expected[observed], rtol=0.05)
    total = terms["sigma_raster"] + terms["sigma_registration"]
    assert np.allclose(total[observed], expected[observed], rtol=1e-5, atol=0)
    assert (terms["sigma_registration"][observed] == np.float32(0.02)).all()
    x_m, y_m = np.meshgrid(GRID.x_m, GRID.y_m)
    range_m = np.sqrt(x_m**2 + y_m**2 + (height(x_m, y_m) - 3245) ** 2)
    instrument = range_m * math.sin(math.radians(0.008))
    assert np.allclose(terms["sigma_instrument"][observed], instrument[observed], rtol=1e-3)


@pytest.mark.integration
def test_result_is_independent_of_blocks_and_order_to_the_last_bit():
    """Through tilt, air, map projection and grid, for any split of the shots."""
    rng = np.random.default_rng(7)
    shots = shots_at(*random_positions(30_000, 7), seed=7)
    time_s = np.linspace(0, 900, len(shots))
    tilt = TiltSeries(np.arange(0.0, 901.0), *np.radians(rng.normal(0, 0.01, (2, 901))))
    air = air_correction(Air(5.0, 690.0, 60.0), Air(-2.0, 684.0, 28.0), 1.064)
    sop = np.eye(4)
    frame = scanner_to_map_by_origin(sop, (46.7958, 10.7828, 3245.0), "EPSG:32632", 6000.0)
    grid = Grid(round(frame.position_m[0]) + 1500, round(frame.position_m[1]) + 600, 4.0, 150, 300)
    scan_geometry = ScanGeometry(VZ6000, grid, frame.position_m)
    results = []
    for order, splits in (
        (np.arange(len(shots)), [10_000, 20_000]),
        (rng.permutation(len(shots)), sorted(rng.integers(0, len(shots), 7))),
    ):
        gridder = new_gridder(scan_geometry, None)
        columns = [np.split(values[..., order], splits, axis=-1) for values in (shots.xyz_m, time_s)]
        blocks = [Shots(*block) for block in zip(*columns, strict=True)]
        grid_scan(gridder, blocks, Pose(frame.with_correction(air.apply, 6000.0), tilt), lambda: None)
        results.append(Rasters(measure(gridder, scan_geometry, None, None)))
    assert (results[0].count > 0).mean() > 0.3
    for name in ("elevation_m", "count", "spread_m"):
        first, second = (getattr(measured, name) for measured in results)
        assert np.array_equal(first, second, equal_nan=True), name
    assert np.array_equal(results[0].uncertainty_m, results[1].uncertainty_m, equal_nan=True)


@pytest.mark.parametrize("rows", [7, 149, 297, 299])
def test_result_is_independent_of_the_height_of_bands(rows, monkeypatch):
    """Cells outside a reference with gaps: their gradients need rows of the adjacent bands."""
    complete = truth()
    row, column = np.indices(GRID.shape)
    surface_m = np.where((row // 20 + column // 20) % 2, np.nan, complete.elevation_m)
    shots = shots_at(*random_positions(60_000, 3), seed=3)
    results = []
    for band_rows in (cells_outside.BAND_ROWS, rows):
        monkeypatch.setattr(cells_outside, "BAND_ROWS", band_rows)
        results.append(process_shots(shots, Reference.from_elevation(GRID, "some", surface_m))[0])
    outside = (results[0].quality & Quality.OUTSIDE_REFERENCE) > 0
    assert outside.mean() > 0.2
    for name in ("elevation_m", "change_m", "uncertainty_m", "quality"):
        first, second = (getattr(measured, name) for measured in results)
        assert np.array_equal(first, second, equal_nan=True), name


def test_change_is_measured_and_flagged_as_significant():
    x_m, y_m = random_positions(150_000, 6)
    shots = shots_at(x_m, y_m, seed=6)
    square = (x_m > 1700) & (x_m < 1800) & (np.abs(y_m) < 50)
    measured, *_ = process_shots(raised(shots, np.where(square, 0.5, 0.0)), truth())
    inside = measured.change_m[140:160, 55:70]
    assert np.nanmean(inside) == pytest.approx(0.5, abs=0.02)
    flagged = (measured.quality & Quality.CHANGE_SIGNIFICANT) > 0
    assert flagged[140:160, 55:70].mean() > 0.9
    assert flagged[:60][np.isfinite(measured.change_m[:60])].mean() == pytest.approx(0.05, abs=0.02)


def adjustment_inputs():
    """Return the inputs of an adjustment without tilt and log."""
    params = parameter_layout(GRID, POSITION_M)
    lines, no_tilt_rad = line_times(params, np.eye(3), None), np.zeros((3, params.line_groups))
    return AdjustmentInputs(params, lines, no_tilt_rad, None, 0.0, Air(2.0, 700.0, 50.0))


@pytest.mark.integration
def test_adjustment_to_a_sample_of_stable_ground_agrees_with_all_of_it(monkeypatch):
    """Shots 30 mm too high, adjusted to every, every second, third and thirteenth row of stable ground."""
    shots = shots_at(*random_positions(150_000, 7))
    raised_shots = raised(shots, 0.030)
    inputs = adjustment_inputs()
    params = inputs.params
    reference = replace(truth(), components=VarianceComponents(translation_m=0.1))
    stable = np.ones(GRID.shape, bool)
    # Without brightness most of it would count as moving, whose mean change is free.
    monkeypatch.setattr(SnowTest, "changed", lambda _, intensity, *__: np.zeros(len(intensity), bool))
    adjustments = {}
    for step in (1, 2, 3, 13):
        monkeypatch.setattr(reference_cells, "MAX_STABLE_CELLS", stable.size // step + 1)
        _, gridder, scan_geometry, viewing = process_shots(raised_shots, reference, stable=stable)
        observed = gridder.rasters().count > 0
        adjustments[step] = adjust_to_reference(gridder, scan_geometry, inputs, viewing)
        _, correction_m = stacking_inputs(gridder, viewing, adjustments[step])
        assert np.median(correction_m[observed]) == pytest.approx(0.030, abs=0.003)
        sigma_m = np.sqrt(np.diag(adjustments[step].state.covariance))
        difference = np.abs(adjustments[step].state.estimate - adjustments[1].state.estimate) / sigma_m
        assert np.sqrt(np.mean(difference**2)) < 1.0
    sigma = [
        np.sqrt(np.median(np.diag(adjustments[step].state.covariance)[10 : 10 + params.line_groups]))
        for step in adjustments
    ]
    assert sigma == sorted(sigma)
    assert sigma[-1] < 2 * sigma[0]


def test_how_rock_responds_to_a_motion_is_no_residual_of_the_state(monkeypatch):
    """Rock that rises by 2 % less than a tilt of 0.01° makes of it, some 7 mm; moving ground as modelled."""
    stable = np.zeros(GRID.shape, bool)
    stable[:150] = True
    monkeypatch.setattr(SnowTest, "changed", lambda _, intensity, *__: np.zeros(len(intensity), bool))
    shots = shots_at(*random_positions(60_000, 7))
    _, gridder, scan_geometry, viewing = process_shots(shots, truth(), stable=stable)
    inputs = adjustment_inputs()
    params = inputs.params
    adjustment = adjust_to_reference(gridder, scan_geometry, inputs, viewing)
    motion = np.zeros(len(params.names))
    motion[1] = math.radians(0.01)  # about north: ground in the east rises
    response = StableResponse(np.full(params.line_groups, -0.02), motion)
    residuals = []
    monkeypatch.setattr(scan_residuals, "estimate_variance_factors", residuals.append)
    for stable_response in (None, response):
        adjusted = replace(adjustment, state=replace(adjustment.state, stable_response=stable_response))
        scan_residuals.variance_factors(gridder, viewing, adjusted, adjusted.state.shared)
    added_m = residuals[1].residual_m - residuals[0].residual_m
    rock, east_m = residuals[0].stable, residuals[0].x_m
    assert 0.3 < rock.mean() < 0.7
    assert not added_m[~rock].any()
    # The slope of a quarter and 600 m of depth add up to a tenth.
    assert added_m[rock] == pytest.approx(0.02 * math.radians(0.01) * east_m[rock], rel=0.2)


def test_a_rotated_pose_turns_points_about_east_north_and_up():
    pose = Pose(scanner_to_local_map(np.eye(4)), None)
    points_m = np.array([[1000.0, 0.0, 0.0], [0.0, 1000.0, 0.0]]).T
    turned_m = to_map(Shots(points_m, None, None), pose.rotated(np.array([0.0, 0.0, 0.001])))
    np.testing.assert_allclose(turned_m.T, [[1000.0, 1.0, 0.0], [-1.0, 1000.0, 0.0]], atol=1e-3)
    tilted_m = to_map(Shots(points_m, None, None), pose.rotated(np.array([0.001, 0.002, 0.0])))
    np.testing.assert_allclose(tilted_m.T, [[1000.0, 0.0, -2.0], [0.0, 1000.0, 1.0]], atol=3e-3)
