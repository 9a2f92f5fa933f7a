"""Update of a reference from more scans: stable ground improves, changed ground stays."""

from dataclasses import replace

import numpy as np
import pytest

from station.quantities import Grid, Reference, SharedParameters, VarianceComponents
from station.science.geometry.terrain import bilinear_surface
from station.science.gridding.gridder import Gridder
from station.science.gridding.reference_surface import (
    errors_of_sop_scan,
    errors_on_map,
    mean_of_scans,
    update_reference,
)
from station.science.gridding.scan_stack import ScanStack
from station.science.uncertainty.parameters import ParameterLayout

GRID = Grid(west_m=1000.0, north_m=2000.0, cell_m=10.0, nx=60, ny=50)
POSITION = (0.0, 0.0, 3000.0)
NOISE_M = 0.05
SHOT_M2 = np.full(GRID.shape, NOISE_M**2, np.float32)


def reference_and_truth():
    """Return a reference with errors of up to 3 cm, steep in the west and flat in the east; and the truth."""
    x, y = np.meshgrid(np.arange(GRID.nx), np.arange(GRID.ny))
    height_m = np.where(x < 30, 12.0 * (30 - x), 0.0)
    error_m = 0.03 * np.sin(x / 4) * np.cos(y / 5)
    reference = Reference.from_elevation(GRID, "1", height_m + error_m)
    reference.random_variance_m2[:] = 0.03**2
    return reference, height_m


def stacked_scans(reference, height_m, seed=1, count=24, rise_m=0.0):
    rng = np.random.default_rng(seed)
    stack = ScanStack(GRID)
    cell = np.repeat(np.arange(GRID.nx * GRID.ny), 4)
    for _ in range(count):
        gridder = Gridder(GRID, None, POSITION[2])
        residual = (height_m - reference.elevation_m + rise_m).ravel()[cell]
        noise = rng.normal(0, NOISE_M, len(cell))
        gridder.add(gridder.cell_indices(cell % GRID.nx, cell // GRID.nx), residual + noise, None)
        stack.add(gridder, (SHOT_M2, np.zeros_like(SHOT_M2)), np.zeros_like(SHOT_M2))
    return stack


def test_stable_ground_improves_and_the_rest_stays():
    reference, height_m = reference_and_truth()
    updated = update_reference(
        reference, stacked_scans(reference, height_m), POSITION, "2", VarianceComponents(tilt_rad=1e-5)
    )
    assert (updated.version, updated.components.tilt_rad) == ("2", 1e-5)
    interior = np.zeros(GRID.shape, bool)
    interior[5:-5, 5:25] = True
    assert updated.stable[interior].mean() > 0.9
    assert not updated.stable[:, 34:].any()  # flat ground may hold snow
    error_before_m, error_after_m = (
        np.abs(surface.elevation_m + surface.mean_residual_m - height_m)[interior & updated.stable].mean()
        for surface in (reference, updated)
    )
    assert error_after_m < error_before_m / 2
    assert np.array_equal(updated.elevation_m, reference.elevation_m)
    assert np.array_equal(updated.mean_residual_m[:, 34:], reference.mean_residual_m[:, 34:])
    assert np.median(updated.random_variance_m2[interior & updated.stable]) < 0.01**2


def test_steep_ground_that_changed_is_not_stable():
    reference, height_m = reference_and_truth()
    rise_m = np.zeros(GRID.shape)
    rise_m[20:30, 10:20] = 0.5
    updated = update_reference(
        reference, stacked_scans(reference, height_m, rise_m=rise_m), POSITION, "2", VarianceComponents()
    )
    assert not updated.stable[20:30, 10:20].any()
    assert np.array_equal(updated.mean_residual_m[20:30, 10:20], reference.mean_residual_m[20:30, 10:20])


def test_variance_factor_of_cells_that_vary_more_than_modelled():
    reference, _ = reference_and_truth()
    rng = np.random.default_rng(3)
    stack = ScanStack(GRID)
    cell = np.arange(GRID.nx * GRID.ny)
    varying = np.zeros(GRID.shape, bool)
    varying[:, 40:50] = True
    sigma = np.where(varying, 0.15, NOISE_M).ravel()
    for _ in range(40):
        gridder = Gridder(GRID, None, POSITION[2])
        gridder.add(gridder.cell_indices(cell % GRID.nx, cell // GRID.nx), rng.normal(0, sigma), None)
        stack.add(gridder, (SHOT_M2, np.zeros_like(SHOT_M2)), np.zeros_like(SHOT_M2))
    factor = update_reference(reference, stack, POSITION, "2", VarianceComponents()).variance_factor
    assert 6.5 < np.median(factor[varying]) < 9  # nine, drawn towards the class that they share with others
    assert np.median(factor[~varying]) == pytest.approx(1, rel=0.15)


def test_echoes_of_the_air_outside_the_surface_do_not_scatter_cells_beside_it():
    """Each scan has some elsewhere. Their heights count from the datum, hundreds of metres off the ground."""
    rng = np.random.default_rng(4)
    beyond = np.zeros(GRID.shape, bool)
    beyond[:, ::7] = True
    surface = bilinear_surface(Reference.from_elevation(GRID, "1", np.where(beyond, np.nan, POSITION[2])))
    ground, air = np.flatnonzero(~beyond), np.flatnonzero(beyond)
    stack = ScanStack(GRID)
    for _ in range(40):
        gridder = Gridder(GRID, surface, POSITION[2])
        airborne = rng.choice(air, len(air) // 20, replace=False)
        cell = np.concatenate([ground, airborne])
        above_m = rng.normal(0, NOISE_M, len(cell))
        above_m[len(ground) :] += rng.uniform(-600, -100, len(airborne))
        gridder.add(gridder.cell_indices(cell % GRID.nx, cell // GRID.nx), above_m, None)
        gridder.finish()
        stack.add(gridder, (SHOT_M2, np.zeros_like(SHOT_M2)), np.zeros_like(SHOT_M2))
    factor = stack.variance_factor(np.zeros(GRID.shape, np.int32))
    assert np.median(factor[~beyond]) == pytest.approx(1, rel=0.05)
    assert factor[~beyond].max() < 2
    assert np.isnan(stack.scan_mean()[beyond]).all()
    assert not stack.visibility()[beyond].any()


def test_a_cell_alone_has_no_scatter():
    stack = ScanStack(GRID)
    for above_m in (-1.0, 1.0, 0.5):
        gridder = Gridder(GRID, None, POSITION[2])
        gridder.add(gridder.cell_indices(np.array([4]), np.array([5])), np.array([above_m]), None)
        stack.add(gridder, (SHOT_M2, np.zeros_like(SHOT_M2)), np.zeros_like(SHOT_M2))
    assert stack.variance_factor(np.zeros(GRID.shape, np.int32))[5, 4] == 1
    assert stack.scan_mean_variance()[5, 4] == pytest.approx(NOISE_M**2 / 3)


def test_visibility_is_the_share_of_scans_that_observed_a_cell():
    reference, _ = reference_and_truth()
    stack = ScanStack(GRID)
    cell = np.arange(GRID.nx * GRID.ny)
    for scan in range(8):
        gridder = Gridder(GRID, None, POSITION[2])
        observed = cell[: len(cell) // 2] if scan < 6 else cell
        gridder.add(
            gridder.cell_indices(observed % GRID.nx, observed // GRID.nx), np.zeros(len(observed)), None
        )
        stack.add(gridder)
    updated = update_reference(reference, stack, POSITION, "2", VarianceComponents())
    assert np.unique(updated.visibility[:25]).tolist() == [1.0]
    assert np.unique(updated.visibility[25:]).tolist() == [0.25]


def test_point_count_is_the_mean_of_the_scans_that_observed_a_cell():
    reference, _ = reference_and_truth()
    stack = ScanStack(GRID)
    for shots in (0, 1, 3, 0, 3):
        gridder = Gridder(GRID, None, POSITION[2])
        gridder.add(gridder.cell_indices(np.full(shots, 4), np.full(shots, 5)), np.zeros(shots), None)
        stack.add(gridder)
    updated = update_reference(reference, stack, POSITION, "2", VarianceComponents())
    assert updated.point_count[5, 4] == np.float16(7 / 3)
    assert np.isnan(updated.point_count[5, 5])


def test_refraction_of_consecutive_scans_is_correlated():
    """Eight hourly scans count as little more than one for refraction, as eight for all else."""
    names = ("tilt_east", "refraction", "refraction_030.0")
    shared = SharedParameters(names, ("rad", "1", "1"), np.zeros(3), np.diag([4.0, 1.0, 9.0]), np.zeros(3))
    hourly, daily = (mean_of_scans([shared] * 8, step_s * np.arange(8)) for step_s in (3600.0, 86_400.0))
    separation_h = np.abs(np.subtract.outer(range(8), range(8)))
    effective = 64 / np.exp(-separation_h / 6).sum()
    assert 1.3 < effective < 1.8
    assert np.diag(hourly.covariance) == pytest.approx([4 / 8, 1 / effective, 9 / effective])
    assert np.diag(daily.covariance) == pytest.approx(np.array([4, 1, 9]) / 8, rel=0.05)


@pytest.mark.parametrize("sop_scan_count", [0, 1])
def test_scans_share_the_errors_of_the_scan_that_the_sop_is_from(sop_scan_count):
    """20,000 references of eight scans, whose log is off by its own bias less that of the scan of the SOP."""
    rng, count = np.random.default_rng(5), 8
    bias = rng.normal(0.0, 1.0, (20_000, count + 1 - sop_scan_count))
    errors = bias[:, bias.shape[1] - count :] - bias[:, :1]
    params = ParameterLayout(0.0, 5, full_circle=False)
    zeros = np.zeros(len(params.names))
    shared = SharedParameters(params.names, params.units, zeros, np.eye(len(zeros)) / count, zeros)
    reference = replace(
        Reference.from_elevation(GRID, "1", np.zeros(GRID.shape)),
        shared=shared, scan_ids=tuple("abcdefgh"), sop_scan_count=sop_scan_count,
    )  # fmt: skip
    variance = dict(zip(params.names, np.diag(errors_on_map(reference, params).covariance), strict=True))
    for name in ("tilt_east", "tilt_north", "sight_tilt_003.0"):
        assert variance[name] == pytest.approx(errors.mean(axis=1).var(), rel=0.03)
    for name in ("heading", "translation_up"):
        assert variance[name] == pytest.approx(errors.mean(axis=1).var() / errors[:, -1].var(), rel=0.03)
    for name in ("range_bias", "range_scale", "refraction", "refraction_ice", "cross_tilt_005.0"):
        assert variance[name] == 1 / count
    assert errors_on_map(replace(reference, sop_scan_count=None), params) is shared
    assert errors_on_map(reference, ParameterLayout(0.0, 10, full_circle=False)) is shared


def test_a_scan_that_is_not_adjusted_has_the_error_of_the_scan_that_the_sop_is_from():
    """20,000 scans, whose log is off by its own bias less that of the scan of the SOP."""
    rng, params = np.random.default_rng(6), ParameterLayout(0.0, 5, full_circle=False)
    bias = rng.normal(0.0, 2.0, (20_000, 2))
    zeros = np.zeros(len(params.names))
    shared = SharedParameters(params.names, params.units, zeros, 4.0 * np.eye(len(zeros)), zeros + 1.0)
    reference = replace(Reference.from_elevation(GRID, "1", np.zeros(GRID.shape)), sop_scan_count=1)
    total = shared + errors_of_sop_scan(shared, reference, params)
    variance = dict(zip(params.names, np.diag(total.covariance), strict=True))
    assert variance["tilt_north"] == pytest.approx(np.diff(bias).var(), rel=0.03)
    assert variance["heading"] == variance["range_bias"] == 4.0
    assert (total.line_tilt_variance == 1.0).all()
    unknown = errors_of_sop_scan(shared, replace(reference, sop_scan_count=None), params)
    assert not unknown.covariance.any()
