"""What the scanner looks at: every known cell once, in the head's order, and as geometry has it."""

import math

import numpy as np
import pytest

from station.quantities import Grid, Habits, Reference, Scanner, Shared
from station.science import outlook, prior, shared
from station.science.inclination import LEVEL
from station.science.outlook import Trait, look

VZ6000 = Scanner("vz", 1.064, 0.12e-3, 0.0, 0.010, *np.radians((0.0005, 0.008, 10.0)), 6000.0)
GRID = Grid(west_m=1500.0, north_m=600.0, cell_m=4.0, nx=150, ny=300)
HERE = (0.0, 0.0, 3245.0)
SLOPE = (0.25, -0.1)
KNOWN = np.random.default_rng(1).uniform(size=GRID.shape) < 0.6
KNOWN[120:180, 40:80] = True
STABLE = np.zeros(GRID.shape, bool)
STABLE[:100] = True


def plane():
    x_m, y_m = np.meshgrid(GRID.x_m, GRID.y_m)
    height_m = 2600 + SLOPE[0] * (x_m - 1500) + SLOPE[1] * y_m
    return Reference.given(GRID, "plane", np.where(KNOWN, height_m, np.nan))


def all_of(sectors):
    _, parts = zip(*sectors, strict=True)
    return {name: np.concatenate([getattr(one, name) for one in parts]) for name in vars(parts[0])}


def test_every_known_cell_comes_once_and_in_the_order_of_the_head():
    seen_from = look(plane(), STABLE, VZ6000, HERE)
    cells = all_of(seen_from.sectors())
    assert np.array_equal(np.sort(cells["cell"]), np.flatnonzero(KNOWN))
    assert np.array_equal(seen_from.number.ravel()[cells["cell"]], np.arange(len(cells["cell"])))
    assert (seen_from.number[~KNOWN] == -1).all()
    for first, part in seen_from.sectors():
        assert np.array_equal(seen_from.cells["cell"][first : first + len(part)], part.cell)
    knot = cells["passed"].astype(int)
    assert (np.diff(knot) >= 0).all()
    row, column = np.divmod(cells["cell"], GRID.nx)
    azimuth_deg = np.degrees(np.arctan2(GRID.x_m[column], GRID.y_m[row]))  # clockwise from north
    assert np.ptp(azimuth_deg[knot == 40]) < math.degrees(shared.LEAN_KNOT_RAD)
    assert (azimuth_deg[knot == 40].min() > azimuth_deg[knot == 39].max()).all()


def test_cells_are_seen_as_geometry_has_it():
    """On a plane: its gradients, its heights, and the variance of a shot by the sine and cosine rules."""
    cells = all_of((seen_from := look(plane(), STABLE, VZ6000, HERE)).sectors())
    amidst = np.isin(cells["cell"], np.flatnonzero(KNOWN).reshape(-1)) & (cells["cell"] // GRID.nx > 125)
    amidst &= (cells["cell"] // GRID.nx < 175) & (np.abs(cells["cell"] % GRID.nx - 60) < 15)
    assert cells["east_gradient"][amidst] == pytest.approx(SLOPE[0], abs=1e-4)
    assert cells["north_gradient"][amidst] == pytest.approx(SLOPE[1], abs=1e-4)
    row, column = np.divmod(cells["cell"][amidst], GRID.nx)
    x_m, y_m = GRID.x_m[column], GRID.y_m[row]
    height_m = 2600 + SLOPE[0] * (x_m - 1500) + SLOPE[1] * y_m
    assert seen_from.datum_m + cells["height_m"][amidst] == pytest.approx(height_m, abs=1e-3)
    ray = np.stack([x_m, y_m, height_m - HERE[2]])
    range_m = np.linalg.norm(ray, axis=0)
    normal = np.array([-SLOPE[0], -SLOPE[1], 1.0])
    upright = 1 / np.linalg.norm(normal)
    cos = np.abs(normal @ ray) * upright / range_m
    angle_rad = math.sqrt((0.12e-3 / 4) ** 2 + math.radians(0.0005) ** 2 / 12 + math.radians(0.0008) ** 2)
    wanted_m2 = (0.010 * cos / upright) ** 2 + (range_m * angle_rad / upright) ** 2 * (1 - cos**2)
    assert cells["scatter_m2"][amidst] == pytest.approx(wanted_m2, rel=0.02)
    stable = seen_from.having(Trait.STABLE)
    stable_cells = seen_from.cells["cell"][stable]
    assert np.array_equal(np.sort(stable_cells), np.flatnonzero(KNOWN & STABLE))


@pytest.mark.parametrize("moving_most", [3000, 9000])
def test_of_very_many_cells_an_adjustment_looks_at_a_part(monkeypatch, moving_most):
    everything = all_of(look(plane(), STABLE, VZ6000, HERE).sectors(looked_at=True))
    assert len(everything["cell"]) == np.count_nonzero(KNOWN)
    monkeypatch.setattr(outlook, "STABLE_MOST", 3000)
    monkeypatch.setattr(outlook, "MOVING_MOST", moving_most)
    part = all_of(look(plane(), STABLE, VZ6000, HERE).sectors(looked_at=True))
    chosen = np.zeros(GRID.shape, bool)
    chosen.reshape(-1)[part["cell"]] = True
    assert 1500 < np.count_nonzero(chosen & STABLE) <= 3000
    assert moving_most / 4 < np.count_nonzero(chosen & ~STABLE) <= moving_most
    rows = (chosen & STABLE).any(axis=1)
    assert np.array_equal(chosen[rows] & STABLE[rows], KNOWN[rows] & STABLE[rows])  # whole rows


def test_single_precision_is_enough_for_what_cells_share():
    """Sigma and effect in single precision against J C Jᵀ written out in double."""
    seen_from = look(plane(), STABLE, VZ6000, HERE)
    of = seen_from.of
    lines = prior.lines_of(of, np.eye(3), None)
    unknown = prior.covariance_without_adjustment(of, lines, None, LEVEL, Habits(), weather_known=True)
    flat = np.eye(len(unknown.names)) * np.diag(unknown.covariance)
    for covariance in (unknown.covariance, flat):
        told = Shared(unknown.names, unknown.units, unknown.estimate, covariance, unknown.noise_variance)
        for _, sector in list(seen_from.sectors())[::10]:
            single = seen_from.felt(sector)
            assert single.lean.dtype == np.float32
            view = seen_from.view(sector)
            double = shared.sensitivities(of, view.offset_m, view.east_gradient, view.north_gradient)
            assert np.sqrt(single.variance(told)) == pytest.approx(np.sqrt(double.variance(told)), rel=1e-3)


def test_without_a_place_sectors_are_parts_of_the_grid(monkeypatch):
    ((_, only),) = look(plane(), STABLE, VZ6000, None).sectors()
    assert np.array_equal(only.cell, np.flatnonzero(KNOWN))
    assert only.scatter_m2 == pytest.approx(0.010**2)
    monkeypatch.setattr(outlook, "TOGETHER", 1000)
    parts = [part for _, part in look(plane(), STABLE, VZ6000, None).sectors()]
    assert max(map(len, parts)) == 1000
    assert np.array_equal(np.concatenate([part.cell for part in parts]), only.cell)
