"""The reference made better by more scans: stable ground only, and never what has changed."""

import numpy as np

from station.quantities import Grid, Habits, Reference
from station.science.grid import Gridder, Stack
from station.science.master import improved

GRID = Grid(west_m=1000.0, north_m=2000.0, cell_m=10.0, nx=60, ny=50)
POSITION = (0.0, 0.0, 3000.0)
NOISE_M = 0.05
SHOT_M2 = np.full(GRID.shape, NOISE_M**2, np.float32)


def base():
    """A steep slope in the west, a flat in the east, wrong by 3 cm here and there."""
    x, y = np.meshgrid(np.arange(GRID.nx), np.arange(GRID.ny))
    height = np.where(x < 30, 12.0 * (30 - x), 0.0)
    wrong = 0.03 * np.sin(x / 4) * np.cos(y / 5)
    made = Reference.given(GRID, "1", height + wrong)
    made.random_variance_m2[:] = 0.03**2
    return made, height


def scans(made, height, seed=1, count=24, rise=0.0):
    rng = np.random.default_rng(seed)
    stack = Stack(GRID)
    cell = np.repeat(np.arange(GRID.nx * GRID.ny), 4)
    for _ in range(count):
        gridder = Gridder(GRID, None, POSITION[2])
        residual = (height - made.elevation_m + rise).ravel()[cell]
        noise = rng.normal(0, NOISE_M, len(cell))
        gridder.add(gridder.numbered(cell % GRID.nx, cell // GRID.nx), residual + noise, None)
        stack.add(gridder, (SHOT_M2, np.zeros_like(SHOT_M2)), np.zeros_like(SHOT_M2))
    return stack


def test_stable_ground_gets_better_and_the_rest_stays():
    made, height = base()
    better = improved(made, scans(made, height), POSITION, "2", Habits(tilt_rad=1e-5))
    assert (better.version, better.habits.tilt_rad) == ("2", 1e-5)
    inner = np.zeros(GRID.shape, bool)
    inner[5:-5, 5:25] = True
    assert better.stable[inner].mean() > 0.9
    assert not better.stable[:, 34:].any()  # flat ground may hold snow
    before, after = (np.abs(one.elevation_m - height)[inner & better.stable].mean() for one in (made, better))
    assert after < before / 2
    assert np.array_equal(better.elevation_m[:, 34:], made.elevation_m[:, 34:])
    assert np.median(better.random_variance_m2[inner & better.stable]) < 0.01**2


def test_steep_ground_that_has_changed_is_not_stable():
    made, height = base()
    rise = np.zeros(GRID.shape)
    rise[20:30, 10:20] = 0.5
    better = improved(made, scans(made, height, rise=rise), POSITION, "2", Habits())
    assert not better.stable[20:30, 10:20].any()
    assert np.array_equal(better.elevation_m[20:30, 10:20], made.elevation_m[20:30, 10:20])


def test_cells_that_vary_more_than_modelled_are_told_so():
    made, _ = base()
    rng = np.random.default_rng(3)
    stack = Stack(GRID)
    cell = np.arange(GRID.nx * GRID.ny)
    restless = np.zeros(GRID.shape, bool)
    restless[:, 40:50] = True
    sigma = np.where(restless, 0.15, NOISE_M).ravel()
    for _ in range(40):
        gridder = Gridder(GRID, None, POSITION[2])
        gridder.add(gridder.numbered(cell % GRID.nx, cell // GRID.nx), rng.normal(0, sigma), None)
        stack.add(gridder, (SHOT_M2, np.zeros_like(SHOT_M2)), np.zeros_like(SHOT_M2))
    factor = improved(made, stack, POSITION, "2", Habits()).variance_factor
    assert 6 < np.median(factor[restless]) < 10  # nine, steps beyond six sigma cut
    assert 0.8 < np.median(factor[~restless]) < 1.5


def test_the_usual_view_is_the_share_of_scans_that_saw_a_cell():
    made, _ = base()
    stack = Stack(GRID)
    cell = np.arange(GRID.nx * GRID.ny)
    for scan in range(8):
        gridder = Gridder(GRID, None, POSITION[2])
        seen = cell[: len(cell) // 2] if scan < 6 else cell
        gridder.add(gridder.numbered(seen % GRID.nx, seen // GRID.nx), np.zeros(len(seen)), None)
        stack.add(gridder)
    better = improved(made, stack, POSITION, "2", Habits())
    assert np.unique(better.seen[:25]).tolist() == [1.0]
    assert np.unique(better.seen[25:]).tolist() == [0.25]
