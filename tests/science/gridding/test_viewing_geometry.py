"""Viewing geometry: all known cells in the order of the head's azimuth, gradients and shot variance."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from station.quantities import Grid, Reference, Scanner, SharedParameters, VarianceComponents
from station.science.adjustment import prior
from station.science.geometry.cyclic_error import NO_CYCLIC_ERROR
from station.science.gridding import reference_cells, viewing_geometry
from station.science.gridding.reference_cells import CellClass
from station.science.gridding.viewing_geometry import compute_viewing_geometry
from station.science.uncertainty import parameters
from station.science.uncertainty.jacobian import height_jacobian

VZ6000 = Scanner("vz", 1.064, 0.12e-3, 0.0, 0.010, *np.radians((0.0005, 0.008, 10.0)), 6000.0)
GRID = Grid(west_m=1500.0, north_m=600.0, cell_m=4.0, nx=150, ny=300)
POSITION_M = (0.0, 0.0, 3245.0)
GRADIENT = (0.25, -0.1)
KNOWN = np.random.default_rng(1).uniform(size=GRID.shape) < 0.6
KNOWN[120:180, 40:80] = True
STABLE = np.zeros(GRID.shape, bool)
STABLE[:100] = True


def plane():
    x_m, y_m = np.meshgrid(GRID.x_m, GRID.y_m)
    height_m = 2600 + GRADIENT[0] * (x_m - 1500) + GRADIENT[1] * y_m
    return Reference.from_elevation(GRID, "plane", np.where(KNOWN, height_m, np.nan))


def all_cells(sectors):
    _, parts = zip(*sectors, strict=True)
    return {name: np.concatenate([getattr(sector, name) for sector in parts]) for name in vars(parts[0])}


def test_every_known_cell_occurs_once_in_the_order_of_the_head_azimuth():
    viewing = compute_viewing_geometry(plane(), STABLE, VZ6000, POSITION_M)
    cells = all_cells(viewing.sectors())
    assert np.array_equal(np.sort(cells["cell"]), np.flatnonzero(KNOWN))
    assert np.array_equal(viewing.cell_index.ravel()[cells["cell"]], np.arange(len(cells["cell"])))
    assert (viewing.cell_index[~KNOWN] == -1).all()
    for first, part in viewing.sectors():
        assert np.array_equal(viewing.cells["cell"][first : first + len(part)], part.cell)
    knot = cells["knot_position"].astype(int)
    assert (np.diff(knot) >= 0).all()
    row, column = np.divmod(cells["cell"], GRID.nx)
    azimuth_deg = np.degrees(np.arctan2(GRID.x_m[column], GRID.y_m[row]))  # clockwise from north
    assert np.ptp(azimuth_deg[knot == 40]) < math.degrees(parameters.TILT_KNOT_RAD)
    assert (azimuth_deg[knot == 40].min() > azimuth_deg[knot == 39].max()).all()


def test_gradients_heights_and_shot_variance_of_a_plane():
    """Gradients and heights of a plane; variance of a shot by R σ sin α / cos γ and σ cos α / cos γ."""
    cells = all_cells((viewing := compute_viewing_geometry(plane(), STABLE, VZ6000, POSITION_M)).sectors())
    interior = np.isin(cells["cell"], np.flatnonzero(KNOWN).reshape(-1)) & (cells["cell"] // GRID.nx > 125)
    interior &= (cells["cell"] // GRID.nx < 175) & (np.abs(cells["cell"] % GRID.nx - 60) < 15)
    assert cells["east_gradient"][interior] == pytest.approx(GRADIENT[0], abs=1e-4)
    assert cells["north_gradient"][interior] == pytest.approx(GRADIENT[1], abs=1e-4)
    row, column = np.divmod(cells["cell"][interior], GRID.nx)
    x_m, y_m = GRID.x_m[column], GRID.y_m[row]
    height_m = 2600 + GRADIENT[0] * (x_m - 1500) + GRADIENT[1] * y_m
    assert viewing.datum_m + cells["height_m"][interior] == pytest.approx(height_m, abs=1e-3)
    ray = np.stack([x_m, y_m, height_m - POSITION_M[2]])
    range_m = np.linalg.norm(ray, axis=0)
    normal = np.array([-GRADIENT[0], -GRADIENT[1], 1.0])
    cos_slope = 1 / np.linalg.norm(normal)
    cos_incidence = np.abs(normal @ ray) * cos_slope / range_m
    angle_rad = math.sqrt((0.12e-3 / 4) ** 2 + math.radians(0.0005) ** 2 / 12 + math.radians(0.0008) ** 2)
    expected_m2 = (0.010 * cos_incidence / cos_slope) ** 2 + (range_m * angle_rad / cos_slope) ** 2 * (
        1 - cos_incidence**2
    )
    assert cells["point_variance_m2"][interior] == pytest.approx(expected_m2, rel=0.02)
    stable = viewing.select(CellClass.STABLE)
    stable_cells = viewing.cells["cell"][stable]
    assert np.array_equal(np.sort(stable_cells), np.flatnonzero(KNOWN & STABLE))


@pytest.mark.parametrize(("slope_deg", "steep"), [(49, False), (51, True), (80, True)])
def test_ground_above_50_degrees_is_steep(slope_deg, steep):
    rise = math.tan(math.radians(slope_deg)) * (0.6 * GRID.x_m[None, :] + 0.8 * GRID.y_m[:, None])
    reference = Reference.from_elevation(GRID, "plane", rise)
    viewing = compute_viewing_geometry(reference, STABLE, VZ6000, POSITION_M)
    assert len(viewing.select(CellClass.STEEP)) == (GRID.nx * GRID.ny if steep else 0)


def test_bare_ground_is_off_the_stable_ground_and_as_dark_as_it():
    ice = np.add.outer(np.arange(GRID.ny) // 20, np.arange(GRID.nx) // 20) % 3 == 0
    intensity = np.where(ice & ~STABLE, 0.6, 0.25).astype(np.float32)
    viewing = compute_viewing_geometry(replace(plane(), intensity=intensity), STABLE, VZ6000, POSITION_M)
    bare = viewing.cells["cell"][viewing.select(CellClass.BARE)]
    assert np.array_equal(np.sort(bare), np.flatnonzero(KNOWN & ~ice & ~STABLE))
    moving_column = np.concatenate([viewing.jacobian(sector).pose[9] for _, sector in viewing.sectors()])
    at_ice = np.flatnonzero(moving_column)
    assert np.array_equal(np.sort(viewing.cells["cell"][at_ice]), np.flatnonzero(KNOWN & ice & ~STABLE))


@pytest.mark.parametrize("max_moving", [3000, 9000])
def test_adjustment_uses_a_sample_of_very_many_cells(monkeypatch, max_moving):
    all_arrays = all_cells(
        compute_viewing_geometry(plane(), STABLE, VZ6000, POSITION_M).sectors(sampled=True)
    )
    assert len(all_arrays["cell"]) == np.count_nonzero(KNOWN)  # few are enclosed: even those at gaps
    monkeypatch.setattr(reference_cells, "MAX_STABLE_CELLS", 3000)
    monkeypatch.setattr(reference_cells, "MAX_MOVING_CELLS", max_moving)
    sample = all_cells(compute_viewing_geometry(plane(), STABLE, VZ6000, POSITION_M).sectors(sampled=True))
    chosen = np.zeros(GRID.shape, bool)
    chosen.reshape(-1)[sample["cell"]] = True
    assert 1500 < np.count_nonzero(chosen & STABLE) <= 3000
    assert max_moving / 4 < np.count_nonzero(chosen & ~STABLE) <= max_moving
    rows = (chosen & STABLE).any(axis=1)
    assert np.array_equal(chosen[rows] & STABLE[rows], KNOWN[rows] & STABLE[rows])  # whole rows


def test_adjustment_uses_enclosed_and_even_cells(monkeypatch):
    rough_m = np.where(np.arange(GRID.nx) < 75, 0.02, 3.0)
    reference = replace(plane(), roughness_m2=np.broadcast_to(rough_m.astype(np.float32) ** 2, GRID.shape))
    monkeypatch.setattr(reference_cells, "MIN_ENCLOSED_SHARE", 0.0)
    used = all_cells(compute_viewing_geometry(reference, STABLE, VZ6000, POSITION_M).sectors(sampled=True))
    enclosed = ndimage.binary_erosion(KNOWN, np.ones((3, 3)), border_value=1)
    expected = enclosed & (np.arange(GRID.nx) < 75)
    assert np.array_equal(np.sort(used["cell"]), np.flatnonzero(expected))


def test_single_precision_suffices_for_the_jacobian():
    """Systematic sigma in single precision against double precision."""
    viewing = compute_viewing_geometry(plane(), STABLE, VZ6000, POSITION_M)
    params = viewing.params
    lines = prior.line_times(params, np.eye(3), None)
    posterior = prior.log_only_covariance(
        params, lines, None, NO_CYCLIC_ERROR, VarianceComponents(), weather_known=True
    )
    diagonal = np.eye(len(posterior.names)) * np.diag(posterior.covariance)
    for covariance in (posterior.covariance, diagonal):
        shared = SharedParameters(
            posterior.names, posterior.units, posterior.estimate, covariance, posterior.line_tilt_variance
        )
        for _, sector in list(viewing.sectors())[::10]:
            single = viewing.jacobian(sector)
            assert single.sight_tilt.dtype == np.float32
            observation = viewing.observation(sector)
            double = height_jacobian(
                params,
                observation.offset_m,
                observation.east_gradient,
                observation.north_gradient,
                rock=sector.in_class(CellClass.STABLE),
            )
            assert np.sqrt(single.variance(shared)) == pytest.approx(
                np.sqrt(double.variance(shared)), rel=1e-3
            )


def test_without_a_scanner_position_sectors_are_blocks_of_the_grid(monkeypatch):
    ((_, only),) = compute_viewing_geometry(plane(), STABLE, VZ6000, None).sectors()
    assert np.array_equal(only.cell, np.flatnonzero(KNOWN))
    assert only.point_variance_m2 == pytest.approx(0.010**2)
    monkeypatch.setattr(viewing_geometry, "BLOCK_CELLS", 1000)
    parts = [part for _, part in compute_viewing_geometry(plane(), STABLE, VZ6000, None).sectors()]
    assert max(map(len, parts)) == 1000
    assert np.array_equal(np.concatenate([part.cell for part in parts]), only.cell)


def test_sampling_ratio_is_the_error_of_a_tilt_on_ground_of_another_slope_than_the_surface():
    """Two rays on planes: their heights above the surface, over the shift across the line of sight."""
    surface_slope, slope_error, cell_m, distance_m, drop_m = 0.1, 0.03, 2.0, 800.0, -300.0
    depression = np.arctan2(-drop_m, distance_m)

    def hit(slope, angle):
        """Return distance and height of a ray on a plane through the point at `distance_m`, `drop_m`."""
        distance = (drop_m - slope * distance_m) / (-np.tan(angle) - slope)
        return distance, drop_m + slope * (distance - distance_m)

    tilt = 1e-5
    effects = []
    for slope in (surface_slope, surface_slope + slope_error):
        distance, height = hit(slope, depression + tilt)  # the true ray
        range_m = np.hypot(distance, height)
        computed = range_m * np.array([np.cos(depression), -np.sin(depression)])  # the tilt is not known
        effects.append(computed[1] - (drop_m + surface_slope * (computed[0] - distance_m)))
    roughness_m = cell_m * slope_error / np.sqrt(12)
    sin_grazing = np.sin(depression + np.arctan(surface_slope))
    expected = reference_cells.sampling_ratio(np.array([roughness_m]), cell_m, np.array([sin_grazing]))[0]
    shift_m = tilt * np.hypot(distance_m, drop_m)
    assert abs(effects[1] - effects[0]) / shift_m == pytest.approx(expected, rel=0.1)
