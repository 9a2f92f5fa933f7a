"""Variances of boxes, areas, volumes and differences, from what the store holds, against dense algebra."""

from dataclasses import replace
from datetime import UTC, datetime
from functools import cache

import numpy as np
import pytest
import xarray as xr

import station
from station.archive import store
from station.archive.aggregate import Aggregates, common_of
from station.archive.join import join_closed
from station.archive.layout import Series
from station.archive.reference import write_reference
from station.archive.series import build_series
from station.errors import StoreError
from station.quantities import ChangeErrors, Grid, Habits, Measurement, Reference, Shared
from station.science import ground, prior, shared
from station.science.adjustment import adjust
from station.science.patches import Patches
from station.science.voids import area_weights, void_variance

GRID = Grid(west_m=632_000.0, north_m=5_186_000.0, cell_m=10.0, nx=40, ny=30)
START_S = 1_763_683_200.0  # 2025-11-21 00:00 UTC
SCANNER = {
    "scanner_east": 631_200.0,
    "scanner_north": 5_184_900.0,
    "scanner_height": 3_010.0,
    "scanner_axis_east": 0.04,
    "scanner_axis_north": -0.02,
}
POSITION_M = tuple(list(SCANNER.values())[:3])
AXIS = (0.04, -0.02, np.sqrt(1 - 0.04**2 - 0.02**2))
EAST, NORTH = 0.25, -0.125  # slope of the reference, kept to the last digit by the store
BESIDE = shared.basis(GRID, POSITION_M, AXIS)


def drawn(seed, size):
    """Shared parameters with a full covariance of lifelike size."""
    rng = np.random.default_rng(seed)
    scale = np.array([1e-4, 1e-4, 3e-5, 3e-3, 3e-3, 3e-3, 4e-3, 0.8, 0.05])
    counts = BESIDE.lean_count, BESIDE.refraction_count, BESIDE.refraction_count
    sigma = np.concatenate([scale, np.repeat([3e-5, 0.02, 3e-5], counts)])
    root = sigma[:, None] * rng.normal(size=(len(sigma), 3 * len(sigma))) / np.sqrt(3 * len(sigma))
    noise = np.zeros(len(sigma))
    noise[9 : 9 + BESIDE.intervals] = rng.uniform(1e-10, 1e-9, BESIDE.intervals)
    estimate = sigma * rng.normal(size=len(sigma))
    return Shared(BESIDE.names, BESIDE.units, estimate, size**2 * root @ root.T, size**2 * noise)


def epoch(hour, adjustment, unknown, *, empty=False):
    rng = np.random.default_rng(hour)
    seen = (rng.uniform(size=GRID.shape) < 0.8) & (not empty)
    change_m = np.where(seen, rng.normal(hour / 10, 0.1, GRID.shape), np.nan).astype(np.float32)
    sigma_m = np.where(seen, rng.uniform(0.01, 0.1, GRID.shape), np.nan).astype(np.float32)
    elevation_m = np.where(seen, 2900.0, np.nan)
    measured = Measurement.of(
        GRID,
        seen.astype(np.uint8),
        elevation_m=elevation_m,
        change_m=change_m,
        uncertainty_m=2 * sigma_m,
        random_uncertainty_m=sigma_m,
        spread_m=sigma_m,
        count=seen.astype(np.int32),
    )
    return store.Epoch(
        start_s=START_S + 3600 * hour,
        end_s=START_S + 3600 * hour + 900,
        scan_id=f"251121_{hour:02d}0000",
        measurement=measured,
        shared=unknown,
        verdict="good",
        verdict_reason="",
        numbers=SCANNER if unknown else {},
        provenance={"adjustment": adjustment, "reference_version": "1"},
    )


def reference():
    elevation_m = 2800 + EAST * (GRID.x_m[None, :] - GRID.west_m) + NORTH * (GRID.y_m[:, None] - GRID.north_m)
    elevation_m[:3, 5:9] = np.nan
    rng = np.random.default_rng(99)
    random_m2 = np.where(np.isfinite(elevation_m), rng.uniform(0.01, 0.03, GRID.shape) ** 2, np.nan)
    flat = np.zeros(GRID.shape, np.float32)
    return Reference(
        grid=GRID,
        version="1",
        elevation_m=elevation_m,
        random_variance_m2=random_m2.astype(np.float32),
        roughness_m2=flat,
        shared=drawn(7, 0.5),
        scan_ids=("a", "b"),
        intensity=flat,
        variance_factor=flat + 1,
        stable=flat > 0,
        habits=Habits(),
        seen=flat + 1,
    )


NONE, JOINT, ALONE, EMPTY = range(4)  # epochs of the store


@pytest.fixture
def filled(tmp_path):
    series = Series(tmp_path, "hef", GRID, "EPSG:32632")
    write_reference(series, reference())
    store.write_epoch(series, epoch(1, "none", drawn(1, 1.0)))
    store.write_epoch(series, epoch(3, "joint", drawn(3, 0.3)))
    store.write_epoch(series, epoch(6, "none", None))
    store.write_epoch(series, epoch(9, "none", drawn(9, 1.0), empty=True))
    build_series(series)
    return series


def azimuth_deg(ds, index):
    """Azimuth of the head at each cell (ny, nx) and the cell's place from the scanner, from the store."""
    place = [float(ds[name][index]) for name in ("scanner_east", "scanner_north", "scanner_height")]
    x, y = np.meshgrid(ds.x.values - place[0], ds.y.values - place[1])
    z = 2800 + EAST * (ds.x.values - 632_000) + NORTH * (ds.y.values[:, None] - 5_186_000) - place[2]
    axis = np.array([float(ds[f"scanner_axis_{name}"][index]) for name in ("east", "north")])
    up = np.array([*axis, np.sqrt(1 - axis @ axis)])
    north = np.array([0, 1, 0]) - up[1] * up
    north /= np.linalg.norm(north)
    east = np.cross(north, up)
    along = [d[0] * x + d[1] * y + d[2] * z for d in (east, north)]
    azimuth = np.arctan2(*along)
    outward = [np.sin(azimuth) * e + np.cos(azimuth) * n for e, n in zip(east, north, strict=True)]
    return np.degrees(azimuth), (x, y, z), outward


def matrix(ds, index):
    """Effect (cells, p) of the parameters on heights by their names in the store, from EQUATIONS 6.1.

    And the lean's effect with the group of lines (cells, groups), for what each has of its own.
    """
    azimuth, (x, y, z), outward = azimuth_deg(ds, index)
    away = np.hypot(x, y)
    rise = away + z * (EAST * x + NORTH * y) / away
    along = z - EAST * x - NORTH * y
    bend = away * rise / (2 * 6_371_000.0)
    effects = {
        "tilt_east": -(y + NORTH * z),
        "tilt_north": x + EAST * z,
        "heading": EAST * y - NORTH * x,
        "translation_east": EAST + 0 * x,
        "translation_north": NORTH + 0 * x,
        "translation_up": -1 + 0 * x,
        "range_bias": along / np.hypot(away, z),
        "range_scale": along * 1e-6,
        "refraction": bend,
    }
    names = [str(name) for name in ds.parameter_name.values]
    turns = effects["tilt_east"], effects["tilt_north"], -effects["heading"]
    across = sum(turn * part for turn, part in zip(turns, outward, strict=True))
    leans = [name for name in names if name.startswith("lean_") and "across" not in name]
    first = min(float(name[5:]) for name in leans)
    for name in names[len(effects) :]:
        kind, at = name.rsplit("_", 1)
        kinds = {"lean": (1.0, -rise), "refraction": (5.0, bend), "lean_across": (5.0, across)}
        wide, effect = kinds[kind]
        effects[name] = effect * np.maximum(1 - np.abs(azimuth - float(at)) / wide, 0)
    group = np.floor((azimuth - first) / 0.2).astype(int).ravel()
    lines = np.arange(5 * (len(leans) - 1))
    own = np.where(group[:, None] == lines, -rise.ravel()[:, None], 0.0)
    knots = np.maximum(1 - np.abs((lines[:, None] + 0.5) / 5 - np.arange(len(lines) // 5 + 1)), 0)
    own -= (
        own @ knots @ np.linalg.lstsq(knots, np.eye(len(lines)), rcond=None)[0]
    )  # what knots hold is theirs
    return np.stack([effects[name].ravel() for name in names], axis=-1), own


def wanted(ds, weights, index, *, random_m2=None, common=None):
    """Variance Σ a² σ² + aᵀ (J C Jᵀ + J_δ D J_δᵀ) a of one epoch, dense; D by degrees of azimuth."""
    a = weights.ravel()
    design, own = matrix(ds, index)
    covariance = ds.shared_parameter_covariance[index].values.astype(float)
    noise = ds.shared_parameter_noise_variance[index].values
    if random_m2 is None:
        random_m2 = ds.elevation_change_random_uncertainty[index].values.astype(float) ** 2
    if common is not None:
        covariance, noise = covariance + common.covariance, noise + common.noise_variance
    of_lines = noise[9 + np.arange(own.shape[1]) // 5]
    shared_m2 = design @ covariance @ design.T + (own * of_lines) @ own.T
    return np.nansum(a**2 * random_m2.ravel()) + a @ shared_m2 @ a


def boxes(ds, *indices):
    """Weights of a cell, a box, a volume and a contrast, on what all the epochs have seen."""
    known = np.isfinite(reference().elevation_m)
    seen = np.logical_and.reduce([np.isfinite(ds.elevation_change[i].values) for i in indices]) & known
    rng = np.random.default_rng(4)
    made = [np.zeros(GRID.shape) for _ in range(4)]
    made[0][tuple(np.argwhere(seen)[70])] = 1
    made[1][5:15, 5:15] = 0.01
    made[2][:] = 100
    made[3][:] = rng.normal(size=GRID.shape)
    return [(weights, np.where(seen, weights, 0.0)) for weights in made]


def test_an_epoch_of_the_log_alone_has_its_own_covariance_and_the_references(filled):
    found = Aggregates(filled)
    with station.open(filled.folder) as ds:
        for weights, counted in boxes(ds, NONE):
            told = found.variance(weights, found.row(NONE))
            assert told == pytest.approx(wanted(ds, counted, NONE, common=drawn(7, 0.5)), rel=1e-4)
            assert told > 1.01 * wanted(ds, counted, NONE)
            assert station.variance(filled.folder, weights, NONE) == told


def test_an_epoch_of_before_the_lean_across_is_read_as_if_there_were_none(filled):
    whole = drawn(13, 0.3)
    older = np.array(["across" not in name for name in whole.names])
    names, units = (tuple(np.array(told)[older]) for told in (whole.names, whole.units))
    short = Shared(
        names,
        units,
        whole.estimate[older],
        whole.covariance[np.ix_(older, older)],
        whole.noise_variance[older],
    )
    none = replace(whole, covariance=np.where(np.outer(older, older), whole.covariance, 0.0))
    for hour, unknown in ((12, short), (13, none)):
        store.write_epoch(filled, replace(epoch(12, "joint", unknown), start_s=START_S + 3600 * hour))
    found = Aggregates(filled)
    weights = np.full(GRID.shape, 1.0)
    told = found.variance(weights, found.row(-2))
    assert told == pytest.approx(found.variance(weights, found.row(-1)), rel=1e-6)


def test_an_adjusted_epoch_has_that_of_the_reference_in_its_own(filled):
    found = Aggregates(filled)
    with station.open(filled.folder) as ds:
        for weights, counted in boxes(ds, JOINT):
            told = found.variance(weights, found.row(JOINT))
            assert told == pytest.approx(wanted(ds, counted, JOINT), rel=1e-4)
            assert station.variance(filled.folder, weights, JOINT) == told


def test_a_difference_has_both_and_nothing_of_the_reference(filled):
    found = Aggregates(filled)
    with station.open(filled.folder) as ds, xr.open_dataset(filled.folder / "reference.nc") as master:
        before_m2 = master.reference_random_uncertainty.values.astype(float) ** 2
        for weights, counted in boxes(ds, NONE, JOINT):
            total = 0.0
            for index in (NONE, JOINT):
                own_m2 = ds.elevation_change_random_uncertainty[index].values.astype(float) ** 2
                total += wanted(ds, counted, index, random_m2=np.maximum(own_m2 - before_m2, 0))
            told = found.variance(weights, found.row(NONE), found.row(JOINT))
            assert told == pytest.approx(total, rel=1e-4)
            assert told == pytest.approx(found.variance(weights, found.row(JOINT), found.row(NONE)))
            assert station.variance(filled.folder, weights, NONE, JOINT) == told


def test_noise_that_is_in_the_estimate_too_goes_off_a_difference(filled):
    """Σ a² σ² + aᵀ Σ (a - 2 s a), dense, with a share s by kind of cell; against the reference as before."""
    slack_m2 = {"adjustment_slack_moving": 4e-4, "adjustment_slack_stable": 1e-4}
    rng = np.random.default_rng(5)
    for hour in (12, 13):
        told = epoch(hour, "joint", drawn(hour, 0.02))
        rock = np.where(rng.uniform(size=GRID.shape) < 0.4, 8, 0).astype(np.uint8).ravel()
        measured = replace(
            told.measurement, quality=np.where(told.measurement.quality, rock, 0).astype(np.uint8)
        )
        store.write_epoch(filled, replace(told, measurement=measured, numbers=SCANNER | slack_m2))
    build_series(filled)
    found = Aggregates(filled)
    kept_out = ground.withheld(*np.meshgrid(GRID.x_m, GRID.y_m))
    assert 0 < kept_out.sum() < kept_out.size
    with station.open(filled.folder) as ds, xr.open_dataset(filled.folder / "reference.nc") as master:
        before_m2 = master.reference_random_uncertainty.values.astype(float) ** 2
        for weights, counted in boxes(ds, -2, -1):
            total, apart = 0.0, 0.0
            for index in (-2, -1):
                sigma_m = ds.elevation_change_random_uncertainty[index].values.astype(float)
                own_m2 = np.maximum(sigma_m**2 - before_m2, 0)
                stable = (ds.quality[index].values.astype(int) & 8) > 0
                slack = np.where(stable, 1e-4, 4e-4)
                held = np.where(stable & kept_out, 0.0, own_m2 / (own_m2 + before_m2 + slack))
                random = np.nansum(counted**2 * own_m2)
                held = np.where(counted != 0, counted * held, 0.0)
                both, alone, rest = (
                    wanted(ds, of, index, random_m2=0 * own_m2) for of in (counted + held, counted, held)
                )
                told_m2 = random + alone - (both - alone - rest)
                assert told_m2 > np.nansum(counted * (counted - held) * own_m2)  # else that is what is told
                total, apart = total + told_m2, apart + random + alone
            told = found.variance(weights, found.row(-2), found.row(-1))
            assert told == pytest.approx(total, rel=1e-4)
            assert abs(told - apart) > 1e-3 * apart
            alone = found.variance(counted, found.row(-1))
            assert alone == pytest.approx(wanted(ds, counted, -1), rel=1e-4)
            volume = station.volume(filled.folder, weights > 0, -1, -2)
            assert float(volume.variance_share.sum()) == pytest.approx(1)


def after_change(size, pattern, hour, *, version="1", adjustment="joint"):
    """An epoch with one mode of errors by change, of a size, in a column of its own: modes have no order."""
    told = drawn(20, 0.3)
    mode = np.sqrt(np.diag(told.covariance)) * np.random.default_rng(21).normal(size=len(told.names)) * size
    modes = np.zeros((len(mode), 32))
    modes[:, hour % 32] = mode
    whole = told.covariance + np.outer(mode, mode)
    known = replace(told, covariance=whole, change=ChangeErrors(modes, pattern))
    made = epoch(hour, adjustment, known)
    return replace(made, provenance=made.provenance | {"reference_version": version})


PATTERN = np.where(np.arange(288) % 5 == 0, np.random.default_rng(8).normal(size=288), 0.0)


@pytest.mark.parametrize(("times", "alike"), [(1.0, 1.0), (0.5, 0.8), (-1.0, -1.0)])
def test_what_like_change_makes_wrong_in_two_epochs_is_not_in_their_difference(filled, times, alike):
    """By (s - t)² of errors s and t of one mode, as far as what was found of the change is alike."""
    shape = np.where(PATTERN != 0, PATTERN - PATTERN[PATTERN != 0].mean(), 0.0)
    sizes = {12: 3.0, 13: -2.0}  # a mode has no sign
    for (hour, size), pattern in zip(sizes.items(), (shape, times * shape), strict=True):
        store.write_epoch(filled, after_change(size, pattern, hour))
    build_series(filled)
    found, weights, shares = Aggregates(filled), np.zeros(GRID.shape), []
    with station.open(filled.folder) as ds, xr.open_dataset(filled.folder / "reference.nc") as master:
        before_m2 = master.reference_random_uncertainty.values.astype(float) ** 2
        for weights, counted in boxes(ds, -2, -1):
            total, effects = 0.0, []
            for index, hour in ((-2, 12), (-1, 13)):
                own_m2 = ds.elevation_change_random_uncertainty[index].values.astype(float) ** 2
                total += wanted(ds, counted, index, random_m2=np.maximum(own_m2 - before_m2, 0))
                felt = np.nan_to_num(counted).ravel() @ matrix(ds, index)[0]
                effects.append(felt @ ds.change_errors[index].values.astype(float)[:, hour % 32])
            told = found.variance(weights, found.row(-2), found.row(-1))
            less = 2 * alike * abs(effects[0] * effects[1])
            assert told == pytest.approx(total - less, rel=1e-3)
            assert told == pytest.approx(found.variance(weights, found.row(-1), found.row(-2)))
            shares.append(abs(less) / total)
    assert max(shares) > 0.2
    volume = station.volume(filled.folder, weights > 0, -1, -2)
    assert float(volume.variance_share.sum()) == pytest.approx(1)
    pair = found.variance(weights, found.row(-2), found.row(-1))
    join_closed(filled, datetime(2025, 12, 31, tzinfo=UTC), lambda: None)
    build_series(filled)
    joined = Aggregates(filled)
    assert joined.variance(weights, joined.row(-2), joined.row(-1)) == pytest.approx(pair)


@pytest.mark.parametrize("change", [{"version": "2"}, {"adjustment": "none"}])
def test_epochs_against_other_surfaces_have_no_change_in_common(filled, change):
    write_reference(filled, replace(reference(), version="2"))
    for hour, told in ((12, {}), (13, {}), (14, change)):
        store.write_epoch(filled, after_change(3.0, PATTERN, hour, **told))
    found = Aggregates(filled)
    one, like, other = (found.read(found.row(at), np.ones(GRID.shape, bool)) for at in (-3, -2, -1))
    assert common_of([one, like]) is not None
    assert common_of([one, other]) is None
    assert common_of([one]) is None


def test_a_difference_is_never_surer_than_its_cells(filled):
    """Whatever modes say: here they are far more than the covariance that they should be a part of."""
    for hour in (12, 13):
        told = after_change(3.0, PATTERN, hour)
        change = ChangeErrors(50 * told.shared.change.modes, PATTERN)
        store.write_epoch(filled, replace(told, shared=replace(told.shared, change=change)))
    build_series(filled)
    found = Aggregates(filled)
    with station.open(filled.folder) as ds, xr.open_dataset(filled.folder / "reference.nc") as master:
        before_m2 = master.reference_random_uncertainty.values.astype(float) ** 2
        for weights, counted in boxes(ds, -2, -1):
            own_m2 = ds.elevation_change_random_uncertainty[-2:].values.astype(float) ** 2 - before_m2
            least_m2 = np.nansum(counted**2 * np.maximum(own_m2, 0))
            assert found.variance(weights, found.row(-2), found.row(-1)) == pytest.approx(least_m2, rel=1e-4)


def test_an_epoch_without_shared_parameters_is_random_alone(filled):
    found = Aggregates(filled)
    with station.open(filled.folder) as ds:
        random_m2 = ds.elevation_change_random_uncertainty[ALONE].values.astype(float) ** 2
        for weights, counted in boxes(ds, ALONE):
            told = found.variance(weights, found.row(ALONE))
            assert told == pytest.approx(np.nansum(counted**2 * random_m2), rel=1e-5)


def test_an_epoch_after_the_scanner_was_moved_has_a_variance_too(filled):
    moved = SCANNER | {"scanner_east": 632_200.0, "scanner_north": 5_185_000.0}
    of = shared.basis(GRID, tuple(list(moved.values())[:3]), AXIS)
    assert of.names != BESIDE.names
    size = len(of.names)
    unknown = Shared(of.names, of.units, np.zeros(size), 1e-10 * np.eye(size), np.zeros(size))
    store.write_epoch(filled, replace(epoch(12, "none", unknown), numbers=moved))
    build_series(filled)
    found = Aggregates(filled)
    assert found.variance(np.full(GRID.shape, 1e-3), found.row(-1)) > 0


def test_cells_without_a_change_count_nothing(filled):
    found = Aggregates(filled)
    row = found.row(NONE)
    with station.open(filled.folder) as ds:
        unseen = np.isnan(ds.elevation_change[NONE].values) | np.isnan(reference().elevation_m)
    assert unseen.sum() > 200
    weights = np.full(GRID.shape, 1e-3)
    heavy = np.where(unseen, 1e3, weights)
    assert found.variance(heavy, row) == found.variance(weights, row)
    assert found.variance(unseen.astype(float), row) == 0.0
    assert found.variance(np.zeros(GRID.shape), row) == 0.0
    assert found.variance(weights, found.row(EMPTY)) == 0.0


def test_epochs_in_a_joined_file_say_the_same(filled):
    weights = np.full(GRID.shape, 1e-3)
    alone = Aggregates(filled)
    before = [alone.variance(weights, alone.row(i)) for i in range(4)]
    pair = alone.variance(weights, alone.row(NONE), alone.row(JOINT))
    later = epoch(12, "none", drawn(1, 1.0))
    # The epoch without parameters differs from the others, which join only among themselves.
    store.revisions(filled, alone.row(ALONE).start)[0].path.unlink()
    store.write_epoch(filled, later)
    assert len(join_closed(filled, datetime(2025, 11, 23, tzinfo=UTC), lambda: None)) == 1
    build_series(filled)
    found = Aggregates(filled)
    rows = [found.row(i) for i in range(4)]
    assert {row.path.parts[-4] for row in rows} == {"days"}
    assert [row.index for row in rows] == [0, 1, 2, 3]
    assert [found.variance(weights, rows[i]) for i in (0, 1, 2)] == [before[i] for i in (NONE, JOINT, EMPTY)]
    assert found.variance(weights, rows[0], rows[1]) == pair
    assert found.area(weights > 0, rows[1]) == alone.area(weights > 0, alone.row(JOINT))


def test_epochs_are_found_by_place_and_by_time(filled):
    found = Aggregates(filled)
    hours = [1, 3, 6, 9]
    assert [found.row(i).time_s for i in range(4)] == [START_S + 3600 * hour + 450 for hour in hours]
    assert found.row(-1) == found.row(3) == found.row(np.int64(3))
    for when, index in (
        ("2025-11-21T01:07:30", 0),
        ("2025-11-21T02:20", 1),
        (np.datetime64("2025-11-21T05:00:00.000"), 2),
        ("1999-01-01", 0),
        ("2050-01-01", 3),
    ):
        assert found.row(when) == found.row(index)
    weights = np.ones(GRID.shape)
    assert station.variance(filled.folder, weights, "2025-11-21T03:00") == station.variance(
        filled.folder, weights, JOINT
    )
    with pytest.raises(IndexError):
        found.row(4)


def area_and_weights(ds, *indices):
    """An area with voids; its seen cells, their weights in its mean, and the reaches of the voids."""
    area = np.zeros(GRID.shape, bool)
    area[10:20, 10:30] = True
    seen = np.logical_and.reduce([np.isfinite(ds.elevation_change[i].values) for i in indices])
    assert (area & ~seen).sum() > 20
    return area, area & seen, *area_weights(area, seen)


def test_an_area_with_voids(filled):
    found = Aggregates(filled)
    with station.open(filled.folder) as ds:
        for index in (NONE, JOINT, ALONE):
            area, seen, weights, reach = area_and_weights(ds, index)
            change_m = np.where(seen, ds.elevation_change[index].values, np.nan).astype(float)
            random_m2 = ds.elevation_change_random_uncertainty[index].values.astype(float) ** 2
            told = found.area(area, found.row(index))
            assert told.coverage == seen.sum() / area.sum()
            assert told.mean_m == pytest.approx(np.nansum(weights * change_m), rel=1e-6)
            beyond_m2 = void_variance(area, reach, change_m, random_m2)
            assert beyond_m2 > 0
            wanted_m2 = found.variance(weights, found.row(index)) + beyond_m2
            assert told.mean_sigma_m**2 == pytest.approx(wanted_m2, rel=1e-5)
            assert told.median_m == pytest.approx(np.nanmedian(change_m))
            same = seen / seen.sum()
            more_m2 = (np.pi / 2 - 1) * np.nansum(same**2 * random_m2)  # the random part, of a median
            wanted_m2 = found.variance(same, found.row(index)) + more_m2
            assert told.median_sigma_m**2 == pytest.approx(wanted_m2, rel=1e-5)
    for lacking in (found.area(area, found.row(EMPTY)), found.area(area & ~area, found.row(NONE))):
        assert np.isnan(
            [lacking.mean_m, lacking.mean_sigma_m, lacking.median_m, lacking.median_sigma_m]
        ).all()
        assert lacking.coverage == 0.0


def test_an_area_from_one_epoch_to_another(filled):
    found = Aggregates(filled)
    with station.open(filled.folder) as ds:
        area, seen, weights, _ = area_and_weights(ds, JOINT, NONE)
        change_m = (ds.elevation_change[JOINT] - ds.elevation_change[NONE]).values.astype(float)
    there, back = (found.area(area, found.row(a), found.row(b)) for a, b in ((JOINT, NONE), (NONE, JOINT)))
    assert there.mean_m == pytest.approx(np.nansum(weights * change_m), rel=1e-6) == -back.mean_m
    assert there.median_m == pytest.approx(np.median(change_m[seen])) == -back.median_m
    assert there.mean_sigma_m == pytest.approx(back.mean_sigma_m)
    assert there.mean_sigma_m**2 > found.variance(weights, found.row(JOINT), found.row(NONE))
    assert there.coverage == seen.sum() / area.sum()


def test_what_is_not_there_yet_is_said(tmp_path):
    series = Series(tmp_path, "hef", GRID, "EPSG:32632")
    with pytest.raises(StoreError, match="nothing is stored"):
        Aggregates(series).row(0)
    store.write_epoch(series, epoch(1, "none", drawn(1, 1.0)))
    build_series(series)
    found = Aggregates(series)
    with pytest.raises(StoreError, match="no reference"):
        found.variance(np.ones(GRID.shape), found.row(0))


SECTOR = shared.Basis(np.radians(20.0), 40, closed=False)
LINES, STRETCHES = np.meshgrid(np.arange(200), np.arange(8, 32))  # 640 to 2,560 m away
FAR = STRETCHES >= 27


def places(azimuth_deg, away_m):
    """What cells of a wavy glacier feel."""
    turn = np.radians(azimuth_deg)
    x, y = away_m * np.sin(turn), away_m * np.cos(turn)
    slopes = 0.2 * np.sin(x / 300), 0.1 + 0.2 * np.cos(y / 400)
    return shared.sensitivities(SECTOR, (x, y, 100 * np.sin(x / 500) - 300), *slopes)


def by_line(felt, weights):
    """Effect of the state by line (9 + lines + refraction knots) on a weighted sum."""
    whole = felt.total(weights)
    return np.concatenate([whole[:9], felt.by_line(weights), whole[9 + SECTOR.lean_count :]])


@cache
def known(scene):
    """Covariance by line before a scan, and after it was adjusted to some ground, at rest, of 3 mm."""
    habits, lines = Habits(), prior.lines_of(SECTOR, np.eye(3), None)
    before = prior.beforehand(SECTOR, lines, habits, weather_known=True)
    rng = np.random.default_rng(8)
    seen, stable = {
        "nothing": (FAR & ~FAR, FAR),
        "a ring of rock": (FAR, FAR),
        "a far ridge": (FAR & (LINES < 50), FAR),
        "a far ridge and a glacier": (~FAR | (LINES < 50), FAR),
        "rock here and there": (rng.uniform(size=FAR.shape) < 0.3, rng.uniform(size=FAR.shape) < 0.4),
    }[scene]
    line, stretch, kind = LINES[seen], STRETCHES[seen], stable[seen].astype(np.int64)
    felt = places(20 + 0.2 * (line + 0.5), 80 * (stretch + 0.5))
    count = len(line)
    told = Patches(felt, stretch, kind, rng.normal(0, 0.003, count), np.full(count, 9e-6), np.ones(count))
    return adjust(told, np.zeros((3, SECTOR.line_count)), before, None)


def products(size_m, count=40):
    """What cells, boxes or an area anywhere on the glacier feel."""
    rng = np.random.default_rng(11)
    azimuth, away_m = rng.uniform(23, 57, count), rng.uniform(800, 2900, count)
    if size_m == "area":
        return [places(rng.uniform(22, 58, 8000), rng.uniform(800, 2900, 8000))]
    side = np.arange(1.25, size_m, 2.5) - size_m / 2
    made = []
    for turn, away in zip(np.radians(azimuth), away_m, strict=True):
        x, y = (axis.ravel() for axis in np.meshgrid(away * np.sin(turn) + side, away * np.cos(turn) + side))
        made.append(places(np.degrees(np.arctan2(x, y)), np.hypot(x, y)))
    return made


def sigmas(scene, size_m):
    """Sigma of means, root mean square, from what is stored and from the whole covariance by line."""
    found = known(scene)
    kept = found.shared()
    stored_m2, whole_m2 = [], []
    for felt in products(size_m):
        weights = np.full(len(felt), 1 / len(felt))
        effect = by_line(felt, weights)
        stored_m2.append(shared.aggregate_variance(weights, np.zeros(len(felt)), felt, kept))
        whole_m2.append(effect @ found.covariance @ effect)
    return np.sqrt(np.mean(stored_m2)), np.sqrt(np.mean(whole_m2))


SIZES_M = [2.5, 10, 100, "area"]


@pytest.mark.parametrize("size_m", SIZES_M)
@pytest.mark.parametrize("scene", ["nothing", "a ring of rock", "a far ridge", "a far ridge and a glacier"])
def test_a_covariance_by_knots_loses_less_than_five_percent_of_a_sigma(scene, size_m):
    stored_m, whole_m = sigmas(scene, size_m)
    assert stored_m == pytest.approx(whole_m, rel=0.05)


def test_also_of_cells_where_rock_stands_here_and_there():
    stored_m, whole_m = sigmas("rock here and there", 2.5)
    assert stored_m == pytest.approx(whole_m, rel=0.05)


@pytest.mark.parametrize("size_m", [10, 100, "area"])
def test_also_of_boxes_where_rock_stands_here_and_there(size_m):
    stored_m, whole_m = sigmas("rock here and there", size_m)
    assert stored_m == pytest.approx(whole_m, rel=0.05)


def test_coarsened_cells_are_means_of_their_points(filled):
    """Against a plain loop; a shared part of the variance does not shrink with the points."""
    cells = 7
    told = station.coarsened(filled.folder, JOINT, cells)
    with station.open(filled.folder) as ds:
        change, sigma, random, count = (
            ds[name][JOINT].values.astype(float)
            for name in (
                "elevation_change",
                "elevation_change_uncertainty",
                "elevation_change_random_uncertainty",
                "point_count",
            )
        )
        assert told.x.values[0] == pytest.approx(ds.x.values[:cells].mean())
        assert told.y.values[1] == pytest.approx(ds.y.values[cells : 2 * cells].mean())
    assert told.elevation_change.shape == tuple(size // cells for size in change.shape)
    looked_at = 0
    for row, column in np.ndindex(told.elevation_change.shape):
        block = np.s_[row * cells : (row + 1) * cells, column * cells : (column + 1) * cells]
        seen = np.isfinite(change[block])
        if not seen.any():
            assert np.isnan(told.elevation_change[row, column])
            continue
        n = count[block][seen]
        wanted = np.sum(n * change[block][seen]) / n.sum()
        own = np.sum((n * random[block][seen]) ** 2) / n.sum() ** 2
        common = np.sum(n * (sigma[block][seen] ** 2 - random[block][seen] ** 2)) / n.sum()
        assert told.elevation_change[row, column] == pytest.approx(wanted, rel=1e-5)
        assert told.elevation_change_uncertainty[row, column] == pytest.approx(
            np.sqrt(own + common), rel=1e-5
        )
        looked_at += 1
    assert looked_at > 5
    with pytest.raises(ValueError, match="do not fit"):
        station.coarsened(filled.folder, JOINT, 10_000)


def test_weights_on_another_grid_are_refused(filled):
    """One cell, or columns for rows, would else read as a sum of nothing that is perfectly sure."""
    for weights in (np.ones((1, 1)), np.ones(GRID.shape).T, np.ones(GRID.nx * GRID.ny)):
        with pytest.raises(ValueError, match="rows and columns, the grid has"):
            station.variance(filled.folder, weights, JOINT)
