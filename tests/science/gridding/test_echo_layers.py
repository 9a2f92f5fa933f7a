"""Echoes of the air above the surface of cells: what is kept, whatever the order of the echoes."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from station.quantities import Grid, Reference
from station.science.geometry.terrain import bilinear_surface
from station.science.gridding import echo_layers
from station.science.gridding.echo_layers import thickness_code
from station.science.gridding.gridder import Gridder

CELL_M = 4.0
GRID = Grid(west_m=0.0, north_m=20.0, cell_m=CELL_M, nx=6, ny=5)
FLAT = bilinear_surface(Reference.from_elevation(GRID, "1", np.full(GRID.shape, 3000.0)))
CELLS = GRID.nx * GRID.ny


def gridded(cell, residual_m, *, surface=FLAT, thickness=None, splits=(), intensity=None, grid=GRID):
    """Return the sums (ny, nx) of echoes in flattened cells, and the gridder."""
    thickness = np.ones(grid.nx * grid.ny, np.uint8) if thickness is None else thickness
    gridder = Gridder(grid, surface, 3000.0, thickness if surface else np.empty(0, np.uint8))
    row, column = np.divmod(np.asarray(cell), grid.nx)
    columns = [column + 0.5, row + 0.5, np.asarray(residual_m, float)]
    columns.append(np.full(len(column), 0.5) if intensity is None else np.asarray(intensity))
    for x, y, height_m, bright in zip(*(np.split(values, splits) for values in columns), strict=True):
        gridder.add(gridder.cell_indices(x, y), height_m, bright)
    gridder.finish()
    return gridder.rasters(), gridder


def expected_surface(heights_m, thickness_m, *, known):
    """Return the heights of the surface of one cell, by plain loops."""
    layers = {0: []}  # the layer around the reference connects those above and below it
    for height_m in heights_m:
        layers.setdefault(int(np.rint(height_m / thickness_m)), []).append(height_m)
    runs = []
    for layer in sorted(layers):
        if not runs or layer > runs[-1][-1] + 1:
            runs.append([])
        runs[-1].append(layer)
    weights = []
    for run in runs:
        usual, cloud = min(map(abs, run)) <= 1, len(run) > 4
        weights.append(sum(len(layers[layer]) for layer in run))
        weights[-1] *= (10 if usual else 0 if cloud else 1) if known else 1
    return [height_m for layer in runs[weights.index(max(weights))] for height_m in layers[layer]]


def echoes(seed, count=400):
    """Return cells and residuals of ground, some of it changed, with every third echo from the air."""
    rng = np.random.default_rng(seed)
    cell = rng.integers(0, CELLS, count)
    residual_m = np.where(cell % 4 == 0, -7.0, 0.3) + 0.1 * rng.standard_normal(count)
    airborne = rng.random(count) < 1 / 3
    return cell, np.where(airborne, rng.exponential(12.0, count), residual_m)


@pytest.mark.parametrize("surface", [FLAT, None])
def test_surface_of_each_cell_equals_plain_loops(surface):
    cell, residual_m = echoes(seed=1)
    sums, gridder = gridded(cell, residual_m, surface=surface)
    thickness_m = 2.0 if surface else 8.0
    kept = 0
    for number in range(CELLS):
        heights_m = expected_surface(residual_m[cell == number], thickness_m, known=surface is not None)
        kept += len(heights_m)
        assert sums.count.flat[number] == len(heights_m)
        assert sums.mean_residual().flat[number] == pytest.approx(np.mean(heights_m), abs=1e-6)
        spread_m = np.std(heights_m, ddof=1) if len(heights_m) > 1 else np.nan
        assert sums.standard_deviation().flat[number] == pytest.approx(spread_m, abs=1e-3, nan_ok=True)
    assert gridder.rejected == len(cell) - kept
    assert gridder.rejected_echo_share == pytest.approx(1 - kept / len(cell))


@settings(max_examples=60, deadline=None)
@given(st.permutations(range(120)), st.lists(st.integers(0, 120), max_size=5), st.booleans())
def test_surface_is_independent_of_order_and_blocks_to_the_last_bit(order, splits, known):
    cell, residual_m = echoes(seed=2, count=120)
    values, surface = np.linspace(0.1, 0.9, 120), FLAT if known else None
    cell %= 7
    plain, _ = gridded(cell, residual_m, surface=surface, intensity=values)
    mixed, _ = gridded(
        cell[order], residual_m[order], surface=surface, splits=sorted(splits), intensity=values[order]
    )
    assert np.array_equal(plain.count, mixed.count)
    assert np.array_equal(plain.moments, mixed.moments)
    assert np.array_equal(plain.intensity_sum, mixed.intensity_sum)


@pytest.mark.parametrize("air_at", [0, 2, 4])
def test_echo_of_the_air_is_dropped_wherever_it_comes(air_at):
    residual_m = np.insert(np.full(4, 0.2), air_at, 40.0)
    intensity = np.insert(np.full(4, 0.3), air_at, 1.0)
    for splits in ((), (1,)):
        sums, gridder = gridded(np.full(5, 7), residual_m, splits=splits, intensity=intensity)
        assert sums.count.flat[7] == 4
        assert sums.mean_residual().flat[7] == pytest.approx(0.2, abs=1e-6)
        assert sums.intensity().flat[7] == pytest.approx(0.3, rel=1e-4)
        assert gridder.rejected == 1


@pytest.mark.parametrize(
    ("counts", "surface", "kept_m"),
    [
        ((5, 3), None, 0.0),
        ((3, 5), None, 30.0),
        ((4, 4), None, 0.0),  # the lower of equal ones: below the crown of a tree
        ((1, 10), FLAT, 0.0),  # a cloud before the ground
        ((1, 11), FLAT, 30.0),
    ],
)
def test_fullest_of_two_surfaces_is_kept_unless_the_other_is_usual(counts, surface, kept_m):
    residual_m = np.repeat([0.0, 30.0], counts)
    sums, _ = gridded(np.full(len(residual_m), 8), residual_m, surface=surface)
    assert sums.mean_residual().flat[8] == pytest.approx(kept_m, abs=1e-6)


def test_lone_echo_far_from_the_reference_empties_its_cell_but_real_change_stays():
    cell = np.arange(CELLS)
    residual_m = np.zeros(CELLS)
    residual_m[8] = 25.0
    sums, gridder = gridded(cell, residual_m)
    assert sums.count.flat[8] == 0
    assert gridder.rejected == 1
    slide = np.isin(cell, [7, 8, 13, 14])
    sums, gridder = gridded(cell, np.where(slide, 25.0 + cell, 0.0))
    assert sums.mean_residual().reshape(-1)[slide] == pytest.approx((25.0 + cell)[slide], abs=1e-6)
    assert gridder.rejected == 0
    sums, gridder = gridded(np.append(cell, [8, 8]), np.append(residual_m, [25.1, 24.9]))
    assert sums.mean_residual().flat[8] == pytest.approx(25.0, abs=1e-6)  # a boulder, not an echo
    assert gridder.rejected == 0


def test_lone_echo_of_a_change_that_other_cells_share_stays():
    """Snow of 2 to 4 m: a cell with one echo and empty cells around it is as deep as others."""
    cell, depth_m = np.arange(CELLS), np.linspace(2.0, 4.0, CELLS)
    row, column = np.divmod(cell, GRID.nx)
    lone = (row == 1) & (column == 1)
    around = (abs(row - 1) <= 1) & (abs(column - 1) <= 1) & ~lone
    cells = np.concatenate([cell[lone], np.repeat(cell[~lone & ~around], 3)])
    lone_m = 3.5
    residual_m = np.concatenate([[lone_m], np.repeat(depth_m[~lone & ~around], 3)])
    sums, gridder = gridded(cells, residual_m)
    assert sums.mean_residual().reshape(-1)[lone] == pytest.approx(lone_m, abs=1e-6)
    assert gridder.rejected == 0
    residual_m[0] = 25.0
    sums, gridder = gridded(cells, residual_m)
    assert gridder.rejected == 1


@pytest.mark.parametrize("surface", [FLAT, None])
@pytest.mark.parametrize(("above", "below"), [(400, 0), (400, 100), (120, 100)])
def test_echoes_of_the_air_are_above_the_surface_beyond_as_many_below_and_chance(surface, above, below):
    rng = np.random.default_rng(5)
    far_m = rng.uniform(20, 80, above + below) * np.repeat([1, -1], [above, below])
    residual_m = np.concatenate([np.zeros(1000 * CELLS), far_m])
    cell = np.concatenate([np.tile(np.arange(CELLS), 1000), rng.integers(CELLS, size=len(far_m))])
    _, gridder = gridded(cell, residual_m, surface=surface)
    assert gridder.rejected_echo_share == (above + below) / len(cell)
    excess = above - below - 2 * np.sqrt(above + below)  # two standard deviations of a Poisson difference
    assert gridder.airborne_echo_share == pytest.approx(max(excess, 0) / len(cell))


def test_cloud_without_ground_below_it_empties_its_cell():
    rng = np.random.default_rng(3)
    cell, heights_m = np.full(200, 8), rng.uniform(10, 30, 200)
    sums, gridder = gridded(np.append(np.arange(CELLS), cell), np.append(np.zeros(CELLS), heights_m))
    assert sums.mean_residual().flat[8] == pytest.approx(0.0)  # one echo of the ground against 200
    sums, gridder = gridded(cell, heights_m)
    assert sums.count.flat[8] == 0
    assert gridder.rejected_echo_share == 1


def test_rough_ground_and_cliffs_lose_no_echo():
    rng = np.random.default_rng(4)
    cell, scatter_m = np.repeat(np.arange(CELLS), 3), 3 * rng.standard_normal(3 * CELLS)
    assert gridded(cell, scatter_m)[1].rejected > 0  # as on smooth ground
    rough = thickness_code(np.full(CELLS, 9.0, np.float32), CELL_M)
    assert gridded(cell, scatter_m, thickness=rough)[1].rejected == 0
    cliff_m = math.tan(math.radians(55)) * rng.uniform(0, CELL_M, 3 * CELLS)
    assert gridded(cell, cliff_m, surface=None)[1].rejected == 0


def test_usual_layers_reach_five_sigma_and_are_at_least_two_metres_thick():
    sigma_m = np.array([0.0, 0.57, 0.58, 1.2, 3.0, np.nan])
    code = thickness_code((sigma_m**2).astype(np.float32), 10.0)
    assert code.tolist() == [1, 1, 2, 3, 4, 1]
    assert thickness_code(np.zeros(1, np.float32), 10.0, is_roughness_known=False).tolist() == [3]
    assert thickness_code(np.full(1, 1e4, np.float32), 10.0).tolist() == [5]  # 20 m, rounded up to 32 m
    assert (2.0 * 2.0 ** (code[1:5] - 1) * 1.5 >= 5 * sigma_m[1:5]).all()


def test_table_is_bounded_and_what_it_has_no_room_for_is_rejected(monkeypatch):
    """Its 80 layers are full of echoes from the air again and again; those of the ground stay."""
    monkeypatch.setattr(echo_layers, "MAX_STORED_LAYERS", 80)
    monkeypatch.setattr(echo_layers, "PENDING_POINTS", 40)
    rng = np.random.default_rng(5)
    air = rng.integers(0, CELLS, 3000), rng.uniform(5, 60_000, 3000)
    ground = np.repeat(np.arange(CELLS), 9), np.zeros(9 * CELLS)
    cell, residual_m = (
        np.concatenate([part[:500], whole, part[500:]]) for part, whole in zip(air, ground, strict=True)
    )
    sums, gridder = gridded(cell, residual_m, splits=range(50, len(cell), 50))
    assert gridder.rejected == 3000
    assert (sums.count == 9).all()
    assert (sums.moments == 0).all()
