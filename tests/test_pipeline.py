"""One scan from shots to surface, against shots made here from first principles."""

import math
from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest

from station.pipeline import Pose, Told, gridder_for, level, measure, on_reference, outlook_on, survey
from station.quantities import Air, Grid, Habits, Quality, Reference, Scanner, Setup, Shots, Tilt
from station.science import budget, measuring, outlook
from station.science.air import air_correction
from station.science.grid import Stack
from station.science.inclination import LEVEL
from station.science.master import master
from station.science.pose import frame_by_origin, frame_in_local_map
from station.science.prior import covariance_without_adjustment, lines_of
from station.science.shared import basis

VZ6000 = Scanner("vz", 1.064, 0.12e-3, 0.0, 0.010, *np.radians((0.0005, 0.008, 10.0)), 6000.0)
GRID = Grid(west_m=1500.0, north_m=600.0, cell_m=4.0, nx=150, ny=300)
SCANNER = (0.0, 0.0, 3245.0)
SLOPE = (0.25, -0.1)


def height(x_m, y_m):
    """A slope that rises away from the scanner, 650 m below it at its near edge, with gentle waves."""
    return 2600 + SLOPE[0] * (x_m - 1500) + SLOPE[1] * y_m + 2 * np.sin(x_m / 60) * np.cos(y_m / 45)


def shots_at(x_m, y_m, seed=0, *, noise=True):
    """Echoes whose true beam is scattered within the divergence, and whose range is noisy."""
    rng = np.random.default_rng(seed)
    true = np.stack([x_m, y_m, height(x_m, y_m)]) - np.array(SCANNER)[:, None]
    range_m = np.linalg.norm(true, axis=0)
    if not noise:
        return Shots(true, None)
    along = true / range_m
    side = np.cross(along.T, [0, 0, 1]).T
    side /= np.linalg.norm(side, axis=0)
    upward = np.cross(side.T, along.T).T
    jitter = rng.normal(0, 0.12e-3 / 4, (2, len(x_m)))
    jitter[1] += rng.normal(0, math.radians(0.0008), len(x_m))
    recorded = along + jitter[0] * side + jitter[1] * upward
    recorded *= (range_m + rng.normal(0, 0.010, len(x_m))) / np.linalg.norm(recorded, axis=0)
    return Shots(recorded, None)


def raised(shots, rise_m):
    return Shots(shots.xyz_m + np.array([[0.0], [0.0], [1.0]]) * rise_m, None)


def spots(count, seed):
    rng = np.random.default_rng(seed)
    return rng.uniform(1490, 2110, count), rng.uniform(-610, 610, count)


def truth():
    x_m, y_m = np.meshgrid(GRID.x_m, GRID.y_m)
    return Reference.given(GRID, "truth", height(x_m, y_m))


NOWHERE = np.zeros(GRID.shape, bool)


def scanned(shots, reference, unknown=None, stable=NOWHERE, **settings):
    sop = np.eye(4)
    sop[:3, 3] = SCANNER
    setup = Setup(VZ6000, GRID, SCANNER, **settings)
    seen_from = reference and outlook_on(reference, setup, stable)
    gridder = gridder_for(setup, seen_from)
    survey(gridder, [shots], Pose(frame_in_local_map(sop), None), lambda: None)
    return Laid(measure(deepcopy(gridder), setup, unknown, seen_from)), gridder, setup, seen_from


class Laid:
    """The columns of a measurement as rasters."""

    def __init__(self, measured):
        self.measured = measured
        self.terms = dict(zip(measured.terms, measured.laid(*measured.terms), strict=True))

    def __getattr__(self, name):
        return self.measured.laid(name)[0]


def test_without_errors_the_surface_is_the_truth():
    measured, *_ = scanned(shots_at(*spots(200_000, 1), noise=False), truth())
    inner = measured.change_m[1:-1, 1:-1]
    assert np.abs(inner[np.isfinite(inner)]).max() < 0.01  # bilinear against waves of 2 m


def test_random_uncertainty_is_calibrated():
    """Standard deviation of error over stated sigma, over all cells and by number of points."""
    measured, *_ = scanned(shots_at(*spots(150_000, 2)), truth())
    z = measured.change_m / measured.random_uncertainty_m
    assert np.nanstd(z) == pytest.approx(1.0, abs=0.05)
    for points in (1, 3, 6):
        assert np.nanstd(z[measured.count == points]) == pytest.approx(1.0, abs=0.1)


def test_a_plain_mean_without_reference_knows_its_slope():
    measured, *_ = scanned(shots_at(*spots(150_000, 3)), None)
    several = measured.count >= 2
    x_m, y_m = np.meshgrid(GRID.x_m, GRID.y_m)
    z = (measured.elevation_m - height(x_m, y_m)) / measured.random_uncertainty_m
    assert np.isnan(measured.change_m).all()
    assert np.std(z[several & np.isfinite(z)]) == pytest.approx(1.0, abs=0.15)
    assert (measured.quality[several] & Quality.OUTSIDE_REFERENCE).all()


def test_a_master_from_scans_finds_the_truth_and_its_own_error():
    scans = [shots_at(*spots(100_000, seed), seed=seed) for seed in range(4, 10)]
    made, x_m, y_m = None, *np.meshgrid(GRID.x_m, GRID.y_m)
    for _ in range(3):
        stack = Stack(GRID)
        for shots in scans:
            _, gridder, setup, seen_from = scanned(shots, made)
            stack.add(gridder, made and on_reference(gridder, seen_from, None))
        made = master(stack, made, [None], setup.position_m, "1", ("a",), Habits())
    error = made.elevation_m - height(x_m, y_m)
    assert np.nanmedian(error) == pytest.approx(0.0, abs=1e-3)
    assert 1.4826 * np.nanmedian(np.abs(error)) < 0.03
    measured, *_ = scanned(shots_at(*spots(100_000, 30), seed=30), made)
    z = measured.change_m / measured.random_uncertainty_m
    assert np.nanstd(z) == pytest.approx(1.0, abs=0.1)


def test_roughness_within_cells_is_found():
    """Boulders of 0.2 m: the master knows, and every later scan is the less sure."""
    rng = np.random.default_rng(99)
    made = truth()
    stack = Stack(GRID)
    for seed in range(3):
        shots = shots_at(*spots(300_000, seed), seed=seed)
        rough = raised(shots, rng.normal(0, 0.2, len(shots)))
        _, gridder, _, seen_from = scanned(rough, made)
        stack.add(gridder, on_reference(gridder, seen_from, None))
    several = stack.count > 10
    assert np.sqrt(stack.roughness()[several].mean()) == pytest.approx(0.2, rel=0.05)


def test_shared_errors_go_into_the_cell_and_its_terms():
    of = basis(GRID, SCANNER)
    lines = lines_of(of, np.eye(3), None)
    unknown = covariance_without_adjustment(of, lines, None, LEVEL, Habits(), weather_known=True)
    measured, *_ = scanned(shots_at(*spots(50_000, 4)), truth(), unknown, store_terms=True)
    total = np.sqrt(sum(np.square(measured.terms[name]) for name in budget.TERMS))
    assert all(np.nanmedian(measured.terms[name]) > 0 for name in budget.TERMS if name != "sigma_raster")
    seen = np.isfinite(measured.uncertainty_m)
    assert measured.uncertainty_m[seen] == pytest.approx(total[seen], rel=1e-3)
    assert (measured.uncertainty_m > measured.random_uncertainty_m)[seen].all()
    # the published budgets take a lean of 0.008° for each point's own, and for no other cell's
    lean_m = 1800 * math.radians(0.008) / np.sqrt(measured.count[seen].mean())
    for name in ("sigma_hartzell2015", "sigma_voordendag2023"):
        assert np.median(measured.terms[name][seen]) == pytest.approx(lean_m, rel=0.35)


def test_published_budget_on_request():
    """Voordendag et al. (2023), Eq. 1, 2 and 3 at a cell, from the same shots."""
    measured, *_ = scanned(
        shots_at(*spots(50_000, 5)),
        truth(),
        published_budget=True,
        store_terms=True,
        registration_sigma_m=0.02,
    )
    terms = measured.terms
    of_points = ("sigma_instrument", "sigma_atmosphere", "sigma_geometry")
    point = np.sqrt(sum(np.square(terms[name]) for name in of_points))
    wanted = point / np.sqrt(measured.count, where=measured.count > 0, out=None) + 0.02
    seen = np.isfinite(measured.uncertainty_m)
    assert measured.uncertainty_m[seen] == pytest.approx(wanted[seen], rel=0.05)
    assert (terms["sigma_raster"] + terms["sigma_registration"])[seen] == pytest.approx(
        wanted[seen], rel=1e-5
    )
    assert (terms["sigma_registration"][seen] == np.float32(0.02)).all()
    x_m, y_m = np.meshgrid(GRID.x_m, GRID.y_m)
    range_m = np.sqrt(x_m**2 + y_m**2 + (height(x_m, y_m) - 3245) ** 2)
    assert terms["sigma_instrument"][seen] == pytest.approx(
        range_m[seen] * math.sin(math.radians(0.008)), rel=1e-3
    )


def test_blocks_and_order_change_nothing():
    """Through lean, air, map and grid: any split of the shots gives the same to the last bit."""
    rng = np.random.default_rng(7)
    shots = shots_at(*spots(30_000, 7), seed=7)
    time_s = np.linspace(0, 900, len(shots))
    tilt = Tilt(np.arange(0.0, 901.0), *np.radians(rng.normal(0, 0.01, (2, 901))))
    air = air_correction(Air(5.0, 690.0, 60.0), Air(-2.0, 684.0, 28.0), 1.064)
    sop = np.eye(4)
    frame = frame_by_origin(sop, (46.7958, 10.7828, 3245.0), "EPSG:32632", 6000.0)
    grid = Grid(round(frame.position_m[0]) + 1500, round(frame.position_m[1]) + 600, 4.0, 150, 300)
    setup = Setup(VZ6000, grid, frame.position_m)
    made = []
    for order, splits in (
        (np.arange(len(shots)), [10_000, 20_000]),
        (rng.permutation(len(shots)), sorted(rng.integers(0, len(shots), 7))),
    ):
        gridder = gridder_for(setup, None)
        columns = [np.split(one[..., order], splits, axis=-1) for one in (shots.xyz_m, time_s)]
        blocks = [Shots(*block) for block in zip(*columns, strict=True)]
        survey(gridder, blocks, Pose(frame.after(air.corrected, 6000.0), tilt), lambda: None)
        made.append(Laid(measure(gridder, setup, None, None)))
    assert (made[0].count > 0).mean() > 0.3
    for name in ("elevation_m", "count", "spread_m"):
        one, other = (getattr(measured, name) for measured in made)
        assert np.array_equal(one, other, equal_nan=True), name
    assert np.array_equal(made[0].uncertainty_m, made[1].uncertainty_m, equal_nan=True)


@pytest.mark.parametrize("rows", [7, 149, 297, 299])
def test_bands_change_nothing(rows, monkeypatch):
    """Cells beyond a reference that knows every other block: their slopes need rows of the bands beside."""
    known = truth()
    row, column = np.indices(GRID.shape)
    surface_m = np.where((row // 20 + column // 20) % 2, np.nan, known.elevation_m)
    shots = shots_at(*spots(60_000, 3), seed=3)
    made = []
    for height in (measuring.BAND_ROWS, rows):
        monkeypatch.setattr(measuring, "BAND_ROWS", height)
        made.append(scanned(shots, Reference.given(GRID, "some", surface_m))[0])
    beyond = (made[0].quality & Quality.OUTSIDE_REFERENCE) > 0
    assert beyond.mean() > 0.2
    for name in ("elevation_m", "change_m", "uncertainty_m", "quality"):
        one, other = (getattr(measured, name) for measured in made)
        assert np.array_equal(one, other, equal_nan=True), name


def test_a_real_change_is_found_and_flagged():
    x_m, y_m = spots(150_000, 6)
    shots = shots_at(x_m, y_m, seed=6)
    square = (x_m > 1700) & (x_m < 1800) & (np.abs(y_m) < 50)
    measured, *_ = scanned(raised(shots, np.where(square, 0.5, 0.0)), truth())
    inside = measured.change_m[140:160, 55:70]
    assert np.nanmean(inside) == pytest.approx(0.5, abs=0.02)
    flagged = (measured.quality & Quality.CHANGE_SIGNIFICANT) > 0
    assert flagged[140:160, 55:70].mean() > 0.9
    assert flagged[:60][np.isfinite(measured.change_m[:60])].mean() == pytest.approx(0.05, abs=0.02)


def test_a_part_of_much_stable_ground_says_nearly_what_all_of_it_says(monkeypatch):
    """Shots 30 mm too high, seen by every, every second, third and thirteenth row of rock."""
    shots = shots_at(*spots(150_000, 7))
    sunk = raised(shots, 0.030)
    of = basis(GRID, SCANNER)
    told = Told(of, lines_of(of, np.eye(3), None), np.zeros((3, of.line_count)), None, weather_known=True)
    known = replace(truth(), habits=Habits(translation_m=0.1))
    stable = np.ones(GRID.shape, bool)
    found = {}
    for step in (1, 2, 3, 13):
        monkeypatch.setattr(outlook, "STABLE_MOST", stable.size // step + 1)
        _, gridder, setup, seen_from = scanned(sunk, known, stable=stable)
        seen = gridder.rasters().count > 0
        found[step] = level(gridder, setup, told, seen_from)
        _, correction_m = on_reference(gridder, seen_from, (told, found[step]))
        assert np.median(correction_m[seen]) == pytest.approx(0.030, abs=0.003)
        sigma_m = np.sqrt(np.diag(found[step].covariance))
        apart = np.abs(found[step].estimate - found[1].estimate) / sigma_m
        assert np.sqrt(np.mean(apart**2)) < 1.0
    sigma = [np.sqrt(np.median(np.diag(found[step].covariance)[9 : 9 + of.line_count])) for step in found]
    assert sigma == sorted(sigma)
    assert sigma[-1] < 2 * sigma[0]
