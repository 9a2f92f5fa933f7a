"""Stated against observed, shares and boxes of a store whose errors are drawn from known covariances."""

from dataclasses import replace
from datetime import UTC, datetime

import netCDF4
import numpy as np
import pytest
import xarray as xr

import station
from station.archive import store
from station.archive.attribution import attribute
from station.archive.boxes import box_statistics
from station.archive.layout import Series
from station.archive.observed import RECENT, _overall, observe
from station.archive.reference import write_reference
from station.archive.series import build_series
from station.errors import StoreError
from station.quantities import Grid, Habits, Measurement, Quality, Reference, Shared
from station.science import ground, shared, terrain
from station.science.sensitivity import INPUTS

GRID = Grid(west_m=632_000.0, north_m=5_186_000.0, cell_m=10.0, nx=60, ny=50)
POSITION_M = (631_400.0, 5_185_100.0, 3_010.0)
START_S = 1_763_683_200.0  # 2025-11-21 00:00 UTC
OF = shared.basis(GRID, POSITION_M)
EPOCHS = 12
ELEVATION_M = 2800 + 0.25 * (GRID.x_m[None, :] - GRID.west_m) - 0.125 * (GRID.y_m[:, None] - GRID.north_m)
SIGMA_M = 0.03  # of each cell


def unknown():
    """What scans share, of lifelike size: as large in a mean as what a cell has of its own."""
    scale = np.array([2e-5, 2e-5, 1e-5, 3e-3, 3e-3, 3e-3, 4e-3, 0.8, 0.02])
    counts = OF.lean_count, OF.refraction_count, OF.refraction_count
    sigma = np.concatenate([scale, np.repeat([2e-5, 0.01, 2e-5], counts)])
    near = np.eye(len(sigma))
    near[0, 1] = near[1, 0] = 0.5
    noise = np.zeros(len(sigma))
    noise[9 : 9 + OF.intervals] = 1e-10
    return Shared(OF.names, OF.units, 0 * sigma, near * np.outer(sigma, sigma), noise)


def reference():
    flat = np.zeros(GRID.shape, np.float32)
    given = Reference.given(GRID, "1", ELEVATION_M)
    return replace(given, scan_ids=("251121_000000",), intensity=flat, habits=Habits())


@pytest.fixture(scope="module")
def drawn():
    """Errors (epochs, ny, nx) as unsure as stated, and the sigma of each cell."""
    rng = np.random.default_rng(11)
    every = np.ones(GRID.shape, bool)
    gradient = terrain.smooth_gradient(ELEVATION_M, GRID.cell_m)
    felt = shared.cell_sensitivities(OF, GRID, POSITION_M, ELEVATION_M, gradient, every)
    told = unknown()
    draws = rng.multivariate_normal(told.estimate, told.covariance, EPOCHS)
    lean, refraction = felt.lean_knot(), felt.refraction_knot()
    error_m = []
    for draw in draws:
        common = draw[:9] @ felt.globals_
        for effect, (before, after, share), knots in (
            (felt.lean, lean, draw[9 : 9 + OF.lean_count]),
            (felt.refraction, refraction, draw[9 + OF.lean_count : -OF.refraction_count]),
            (felt.across, refraction, draw[-OF.refraction_count :]),
        ):
            common = common + effect * (knots[before] * (1 - share) + knots[after] * share)
        error_m.append(common + SIGMA_M * rng.normal(size=len(felt)))
    sigma_m = np.sqrt(felt.variance(told) + SIGMA_M**2)
    return np.reshape(error_m, (EPOCHS, *GRID.shape)), sigma_m.reshape(GRID.shape)


def filled(folder, drawn, *, times=1.0, adjustment="joint"):
    """A store whose errors are so many times what it states."""
    series = Series(folder, "hef", GRID, "EPSG:32632")
    write_reference(series, reference())
    error_m, sigma_m = drawn
    stable = np.where(np.arange(GRID.nx) < GRID.nx - 3, int(Quality.STABLE_GROUND), 0)
    for hour in range(EPOCHS):
        change_m = (times * error_m[hour]).astype(np.float32)
        change_m[: hour % 3, :] = np.nan
        seen = np.isfinite(change_m)
        flat = np.where(seen, np.float32(SIGMA_M), np.float32(np.nan))
        quality = np.where(seen, stable, 0).astype(np.uint8)
        uncertainty_m = np.where(seen, sigma_m, np.nan).astype(np.float32)
        measured = Measurement.of(
            GRID,
            quality,
            elevation_m=np.where(seen, ELEVATION_M, np.nan),
            change_m=change_m,
            uncertainty_m=uncertainty_m,
            random_uncertainty_m=flat,
            spread_m=flat,
            count=seen.astype(np.int32),
        )
        store.write_epoch(
            series,
            store.Epoch(
                start_s=START_S + 3600 * hour,
                end_s=START_S + 3600 * hour + 900,
                scan_id=f"251121_{hour:02d}0000",
                measurement=measured,
                shared=unknown(),
                verdict="good",
                verdict_reason="",
                numbers={
                    **dict(zip(("scanner_east", "scanner_north", "scanner_height"), POSITION_M, strict=True)),
                    "scanner_axis_east": 0.0, "scanner_axis_north": 0.0, "platform_roll": hour / 10,
                },
                provenance={"adjustment": adjustment, "reference_version": "1"},
            ),
        )  # fmt: skip
    build_series(series)
    return series


@pytest.fixture(scope="module")
def series(tmp_path_factory, drawn):
    return filled(tmp_path_factory.mktemp("store"), drawn)


def overall(found):
    return {(row["scale"], row["band"]): row for row in found.overall}


def test_errors_as_large_as_stated_fit_at_every_scale(series):
    found = observe(series, 100, lambda: None)
    told = overall(found)
    cells = told["cell", "all"]
    assert cells["epochs"] == EPOCHS - 1  # the reference's own scan is left out
    kept = ground.withheld(GRID.x_m[None, :], GRID.y_m[:, None])[:, : GRID.nx - 3]
    unseen = sum(kept[: hour % 3].sum() for hour in range(1, EPOCHS))
    assert cells["count"] == kept.sum() * (EPOCHS - 1) - unseen
    assert cells["z_std"] == pytest.approx(1.0, abs=0.06)
    assert cells["inside_95"] == pytest.approx(0.95, abs=0.02)
    assert told["100 m", "all"]["z_std"] == pytest.approx(1.0, abs=0.2)
    assert 0.5 < told["all", "all"]["factor"] < 1.6
    assert not any(row["advised"] for row in found.overall)
    ratio = [row["observed_m2"] / row["stated_m2"] for row in found.variogram]
    assert ratio == pytest.approx(np.ones(8), abs=0.4)
    assert np.mean(ratio) == pytest.approx(1.0, abs=0.15)
    assert found.variogram[-1]["stated_m2"] > SIGMA_M**2


def test_errors_of_twice_the_stated_size_are_found_at_every_scale(tmp_path, drawn):
    told = overall(found := observe(filled(tmp_path, drawn, times=2.0), 100, lambda: None))
    for scale in ("cell", "100 m", "all"):
        assert told[scale, "all"]["advised"]
        assert told[scale, "all"]["factor"] == pytest.approx(2.0, rel=0.1 if scale != "all" else 0.4)
    assert told["cell", "all"]["inside_95"] < 0.75
    ratio = [row["observed_m2"] / row["stated_m2"] for row in found.variogram]
    assert np.mean(ratio) == pytest.approx(4.0, rel=0.15)


def test_z_of_all_withheld_ground_is_its_mean_over_the_sigma_of_station_variance(series):
    row = next(
        one
        for one in observe(series, 3, lambda: None).epochs
        if (one["scale"], one["band"]) == ("all", "all")
    )
    with station.open(series.folder) as ds:
        index = [str(one) for one in ds.scan_id.values].index(row["scan_id"])
        chosen = ds.quality[index].values.astype(int) & Quality.STABLE_GROUND > 0
        chosen &= ground.withheld(GRID.x_m[None, :], GRID.y_m[:, None])
        mean_m = ds.elevation_change[index].values[chosen].mean()
    sigma_m = station.variance(series.folder, chosen / chosen.sum(), index) ** 0.5
    assert row["z"] == pytest.approx([mean_m / sigma_m], rel=1e-4)


def test_the_factor_is_that_of_the_newest_epochs():
    """Sigma was right for 60 epochs, and is half of what it should be for 50."""
    rng = np.random.default_rng(12)
    epochs = [
        {"scale": "cell", "band": "all", "z": (1 if number < 60 else 2) * rng.normal(size=100)}
        for number in range(60 + RECENT)
    ]
    (told,) = _overall(epochs)
    assert told["factor"] == pytest.approx(2.0, rel=0.05)
    assert told["advised"]
    assert told["z_std"] == pytest.approx(np.sqrt((60 + 4 * RECENT) / (60 + RECENT)), rel=0.03)


def test_few_epochs_are_spread_over_the_series(series):
    ids = {row["scan_id"] for row in observe(series, 4, lambda: None).epochs}
    assert ids == {"251121_030000", "251121_070000", "251121_110000"}


def test_a_store_without_stable_ground_says_nothing(tmp_path):
    empty = Series(tmp_path, "hef", GRID, "EPSG:32632")
    assert observe(empty, 9, lambda: None).overall == []
    assert box_statistics(empty, 9, lambda: None) == []


def test_boxes_have_the_mean_and_sigma_of_areas(series):
    told = box_statistics(series, 100, lambda: None)
    assert len(told) == EPOCHS * 20
    with station.open(series.folder) as ds:
        change_m = ds.elevation_change.values
    for row in (told[0], told[7], told[-3]):
        hour = int(row["time"][11:13])
        size = 100.0
        inside = (abs(GRID.x_m[None, :] - row["east_m"]) < size / 2) & (
            abs(GRID.y_m[:, None] - row["north_m"]) < size / 2
        )
        assert inside.sum() == 100
        seen = inside & np.isfinite(change_m[hour])
        sigma_m = station.variance(series.folder, seen / seen.sum(), hour) ** 0.5
        assert (row["mean_change_m"], row["sigma_m"]) == pytest.approx(
            (change_m[hour][seen].mean(), sigma_m), rel=1e-5
        )
        assert row["seen"] == pytest.approx(seen.sum() / 100)
        assert row["scatter_m"] == pytest.approx(SIGMA_M, rel=0.5)
        assert row["roll_deg"] == pytest.approx(hour / 10)
        away_m = np.hypot(row["east_m"] - POSITION_M[0], row["north_m"] - POSITION_M[1])
        assert row["range_m"] == pytest.approx(away_m, rel=0.05)
    assert (np.diff([row["range_m"] for row in told[:20]]) > -20).all()  # along the ground they are in order


def test_shares_of_an_epoch(series, tmp_path):
    found = attribute(series, -1)
    inside = np.zeros(GRID.shape, bool)
    inside[10:30, 10:30] = True
    told = found.of_area("middle", inside)
    variance_m2 = station.variance(series.folder, inside / inside.sum(), -1)
    assert told["sigma_m"] == pytest.approx(variance_m2**0.5, rel=1e-6)
    assert sum(told["part"].values()) == pytest.approx(1.0)
    assert told["part"]["random"] == pytest.approx(SIGMA_M**2 / 400 / variance_m2, rel=0.01)
    simulated = told["simulated"]
    for order in ("first", "total"):
        for name in INPUTS:
            off = abs(simulated[order][name] - simulated["linear"][name])
            assert off < 4.5 * simulated[f"{order}_error"][name] + 0.01, (order, name)
    assert found.of_area("elsewhere", ~np.isfinite(ELEVATION_M)) is None
    by_range = found.by_range()
    assert [sum(row["part"].values()) for row in by_range] == pytest.approx([1.0] * len(by_range), abs=1e-4)
    found.write(tmp_path / "maps" / "shares.nc")
    with xr.open_dataset(tmp_path / "maps" / "shares.nc") as maps:
        total = sum(maps[f"share_{name}"] for name in INPUTS)
        seen = np.isfinite(total.values)
        assert np.array_equal(seen, found.cells)
        assert total.values[seen] == pytest.approx(np.ones(seen.sum()), abs=5e-3)
        assert maps.share_tilt.dims == ("y", "x")
        assert maps.share_tilt.attrs["grid_mapping"] == "crs"


def test_an_epoch_that_was_not_adjusted_is_as_unsure_as_its_reference_too(tmp_path, drawn):
    alone = filled(tmp_path, drawn, adjustment="none")
    known = replace(reference(), shared=unknown(), version="2")
    write_reference(alone, replace(known, version="1"))
    told = attribute(alone, 5).of_area("all", np.ones(GRID.shape, bool), simulate=False)
    with netCDF4.Dataset(alone.folder / "series.nc") as file:
        weights = np.isfinite(np.ma.filled(file["elevation_change"][5], np.nan))
    assert told["sigma_m"] ** 2 == pytest.approx(
        station.variance(alone.folder, weights / weights.sum(), 5), rel=1e-6
    )


def test_an_epoch_without_a_reference_has_no_shares(tmp_path, drawn):
    lone = filled(tmp_path, drawn)
    path = store.revisions(lone, datetime.fromtimestamp(START_S, UTC))[0].path
    with netCDF4.Dataset(path, "r+") as file:
        file["reference_version"][0] = np.zeros(64, "S1")
    with pytest.raises(StoreError, match="no reference yet"):
        attribute(lone, 0)
