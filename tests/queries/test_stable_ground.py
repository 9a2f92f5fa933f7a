"""Sigma validation, variance shares and box series of a store with errors drawn from known covariances."""

from dataclasses import replace
from datetime import UTC, datetime

import netCDF4
import numpy as np
import pytest
import xarray as xr

import station
from station.archive import epochs
from station.archive.netcdf_layout import Series
from station.archive.reference_files import write_reference
from station.archive.series.virtual import build_series
from station.errors import StoreError
from station.quantities import Grid, Measurement, Quality, Reference, SharedParameters, VarianceComponents
from station.queries.box_series import BOX_M, box_statistics
from station.queries.stable_ground import RECENT_EPOCHS, _overall, validate_sigma
from station.queries.variance_shares import compute_variance_shares
from station.science.adjustment import ground_classes
from station.science.analysis.sensitivity import INPUTS
from station.science.geometry import terrain
from station.science.uncertainty import jacobian, parameters

GRID = Grid(west_m=632_000.0, north_m=5_186_000.0, cell_m=10.0, nx=60, ny=50)
POSITION_M = (631_400.0, 5_185_100.0, 3_010.0)
START_S = 1_763_683_200.0  # 2025-11-21 00:00 UTC
PARAMS = parameters.parameter_layout(GRID, POSITION_M)
EPOCHS = 12
ELEVATION_M = 2800 + 0.25 * (GRID.x_m[None, :] - GRID.west_m) - 0.125 * (GRID.y_m[:, None] - GRID.north_m)
SIGMA_M = 0.03  # of each cell


def shared_parameters():
    """Return shared parameters of realistic size: as large in a mean as the random error of a cell."""
    scale = np.array([2e-5, 2e-5, 1e-5, 3e-3, 3e-3, 3e-3, 4e-3, 0.8, 0.02, 0.02])
    counts = PARAMS.sight_tilt_knots, PARAMS.refraction_knots, PARAMS.refraction_knots
    sigma = np.concatenate([scale, np.repeat([2e-5, 0.01, 2e-5], counts)])
    correlation = np.eye(len(sigma))
    correlation[0, 1] = correlation[1, 0] = 0.5
    line_tilt = np.zeros(len(sigma))
    line_tilt[10 : 10 + PARAMS.knot_intervals] = 1e-10
    covariance = correlation * np.outer(sigma, sigma)
    return SharedParameters(PARAMS.names, PARAMS.units, 0 * sigma, covariance, line_tilt)


def make_reference():
    zeros = np.zeros(GRID.shape, np.float32)
    reference = Reference.from_elevation(GRID, "1", ELEVATION_M)
    return replace(reference, scan_ids=("251121_000000",), intensity=zeros, components=VarianceComponents())


@pytest.fixture(scope="module")
def errors():
    """Errors (epochs, ny, nx) drawn from the stated covariance, and the sigma of each cell."""
    rng = np.random.default_rng(15)
    gradient = terrain.smooth_gradient(ELEVATION_M, GRID.cell_m)
    all_cells = np.ones(GRID.shape, bool)
    stable = np.tile(np.arange(GRID.nx) < GRID.nx - 3, GRID.ny)
    height_jacobian = jacobian.cell_jacobian(
        PARAMS, GRID, POSITION_M, ELEVATION_M, gradient, all_cells, stable
    )
    shared = shared_parameters()
    error_m = [
        height_jacobian.effect(draw) + SIGMA_M * rng.normal(size=len(height_jacobian))
        for draw in rng.multivariate_normal(shared.estimate, shared.covariance, EPOCHS)
    ]
    sigma_m = np.sqrt(height_jacobian.variance(shared) + SIGMA_M**2)
    return np.reshape(error_m, (EPOCHS, *GRID.shape)), sigma_m.reshape(GRID.shape)


def write_store(folder, errors, *, factor=1.0, adjustment="joint"):
    """Write a store whose errors are `factor` times as large as it states."""
    series = Series(folder, "hef", GRID, "EPSG:32632")
    write_reference(series, make_reference())
    error_m, sigma_m = errors
    stable = np.where(np.arange(GRID.nx) < GRID.nx - 3, int(Quality.STABLE_GROUND), 0)
    for hour in range(EPOCHS):
        change_m = (factor * error_m[hour]).astype(np.float32)
        change_m[: hour % 3, :] = np.nan
        observed = np.isfinite(change_m)
        random_m = np.where(observed, np.float32(SIGMA_M), np.float32(np.nan))
        measurement = Measurement.from_rasters(
            GRID,
            np.where(observed, stable, 0).astype(np.uint8),
            elevation_m=np.where(observed, ELEVATION_M, np.nan),
            change_m=change_m,
            uncertainty_m=np.where(observed, sigma_m, np.nan).astype(np.float32),
            systematic_uncertainty_m=np.sqrt(np.maximum(sigma_m**2 - random_m**2, 0)).astype(np.float32),
            spread_m=random_m,
            count=observed.astype(np.int32),
        )
        epochs.write_epoch(
            series,
            epochs.Epoch(
                start_s=START_S + 3600 * hour,
                end_s=START_S + 3600 * hour + 900,
                scan_id=f"251121_{hour:02d}0000",
                measurement=measurement,
                shared=shared_parameters(),
                verdict="good",
                verdict_reason="",
                scalars={
                    **dict(zip(("scanner_east", "scanner_north", "scanner_height"), POSITION_M, strict=True)),
                    "scanner_axis_east": 0.0, "scanner_axis_north": 0.0, "platform_roll": hour / 10,
                },
                provenance={"adjustment": adjustment, "reference_version": "1"},
            ),
        )  # fmt: skip
    build_series(series)
    return series


@pytest.fixture(scope="module")
def series(tmp_path_factory, errors):
    return write_store(tmp_path_factory.mktemp("store"), errors)


def by_scale(validation):
    return {(row["scale"], row["band"]): row for row in validation.overall}


@pytest.mark.integration
def test_errors_as_large_as_stated_are_confirmed_at_every_scale(series):
    validation = validate_sigma(series, 100, lambda: None)
    scales = by_scale(validation)
    cells = scales["cell", "all"]
    assert cells["epochs"] == EPOCHS - 1  # without the scan that is part of the reference
    holdout = ground_classes.is_holdout(GRID.x_m[None, :], GRID.y_m[:, None])[:, : GRID.nx - 3]
    unobserved = sum(holdout[: hour % 3].sum() for hour in range(1, EPOCHS))
    assert cells["count"] == holdout.sum() * (EPOCHS - 1) - unobserved
    assert cells["z_std"] == pytest.approx(1.0, abs=0.06)
    assert cells["inside_95"] == pytest.approx(0.95, abs=0.02)
    assert scales["100 m", "all"]["z_std"] == pytest.approx(1.0, abs=0.2)
    assert 0.5 < scales["all", "all"]["factor"] < 1.6
    assert not any(row["advised"] for row in validation.overall)
    ratio = [row["observed_m2"] / row["stated_m2"] for row in validation.variogram]
    assert ratio == pytest.approx(np.ones(8), abs=0.4)
    assert np.mean(ratio) == pytest.approx(1.0, abs=0.15)
    assert validation.variogram[-1]["stated_m2"] > SIGMA_M**2


@pytest.mark.integration
def test_errors_of_twice_the_stated_size_are_detected_at_every_scale(tmp_path, errors):
    validation = validate_sigma(write_store(tmp_path, errors, factor=2.0), 100, lambda: None)
    scales = by_scale(validation)
    for scale in ("cell", "100 m", "all"):
        assert scales[scale, "all"]["advised"]
        assert scales[scale, "all"]["factor"] == pytest.approx(2.0, rel=0.1 if scale != "all" else 0.4)
    assert scales["cell", "all"]["inside_95"] < 0.75
    ratio = [row["observed_m2"] / row["stated_m2"] for row in validation.variogram]
    assert np.mean(ratio) == pytest.approx(4.0, rel=0.15)


def test_z_of_the_whole_holdout_ground_is_its_mean_divided_by_its_sigma(series):
    row = next(
        row
        for row in validate_sigma(series, 3, lambda: None).epochs
        if (row["scale"], row["band"]) == ("all", "all")
    )
    with station.open(series.folder) as ds:
        index = ds.scan_id.values.tolist().index(row["scan_id"])
        holdout = ds.quality[index].values.astype(int) & Quality.STABLE_GROUND > 0
        holdout &= ground_classes.is_holdout(GRID.x_m[None, :], GRID.y_m[:, None])
        mean_m = ds.elevation_change[index].values[holdout].mean()
    sigma_m = station.variance(series.folder, holdout / holdout.sum(), index) ** 0.5
    assert row["z"] == pytest.approx([mean_m / sigma_m], rel=1e-4)


def test_the_factor_of_sigma_is_that_of_the_newest_epochs():
    """The stated sigma was right for 60 epochs, and is half of the true one for 50."""
    rng = np.random.default_rng(15)
    epochs = [
        {"scale": "cell", "band": "all", "z": (1 if number < 60 else 2) * rng.normal(size=100)}
        for number in range(60 + RECENT_EPOCHS)
    ]
    (row,) = _overall(epochs)
    assert row["factor"] == pytest.approx(2.0, rel=0.05)
    assert row["advised"]
    assert row["z_std"] == pytest.approx(np.sqrt((60 + 4 * RECENT_EPOCHS) / (60 + RECENT_EPOCHS)), rel=0.03)


def test_a_sample_of_epochs_is_spread_over_the_series(series):
    ids = {row["scan_id"] for row in validate_sigma(series, 4, lambda: None).epochs}
    assert ids == {"251121_030000", "251121_070000", "251121_110000"}


def test_an_empty_store_gives_empty_tables(tmp_path):
    empty = Series(tmp_path, "hef", GRID, "EPSG:32632")
    assert validate_sigma(empty, 9, lambda: None).overall == []
    assert box_statistics(empty, 9, lambda: None) == []


@pytest.mark.integration
def test_boxes_have_the_mean_and_sigma_of_areas(series):
    table = box_statistics(series, 100, lambda: None)
    assert len(table) == EPOCHS * 20
    with station.open(series.folder) as ds:
        change_m = ds.elevation_change.values
    for row in (table[0], table[7], table[-3]):
        hour = int(row["time"][11:13])
        inside = abs(GRID.x_m[None, :] - row["east_m"]) < BOX_M / 2
        inside = inside & (abs(GRID.y_m[:, None] - row["north_m"]) < BOX_M / 2)
        assert inside.sum() == 100
        observed = inside & np.isfinite(change_m[hour])
        sigma_m = station.variance(series.folder, observed / observed.sum(), hour) ** 0.5
        assert (row["mean_change_m"], row["sigma_m"]) == pytest.approx(
            (change_m[hour][observed].mean(), sigma_m), rel=1e-5
        )
        assert row["coverage"] == pytest.approx(observed.sum() / 100)
        assert row["scatter_m"] == pytest.approx(SIGMA_M, rel=0.5)
        assert row["roll_deg"] == pytest.approx(hour / 10)
        distance_m = np.hypot(row["east_m"] - POSITION_M[0], row["north_m"] - POSITION_M[1])
        assert row["range_m"] == pytest.approx(distance_m, rel=0.05)
    ranges_m = [row["range_m"] for row in table[:20]]
    assert (np.diff(ranges_m) > -20).all()  # sorted by horizontal distance, not by range


@pytest.mark.integration
def test_variance_shares_of_an_epoch(series, tmp_path):
    variance_shares = compute_variance_shares(series, -1)
    inside = np.zeros(GRID.shape, bool)
    inside[10:30, 10:30] = True
    result = variance_shares.area_shares("middle", inside)
    variance_m2 = station.variance(series.folder, inside / inside.sum(), -1)
    assert result["sigma_m"] == pytest.approx(variance_m2**0.5, rel=1e-6)
    assert sum(result["covariance_share"].values()) == pytest.approx(1.0)
    assert result["covariance_share"]["random"] == pytest.approx(SIGMA_M**2 / 400 / variance_m2, rel=0.01)
    simulated = result["simulated"]
    for order in ("first", "total"):
        for name in INPUTS:
            difference = abs(simulated[order][name] - simulated["linear"][name])
            assert difference < 4.5 * simulated[f"{order}_error"][name] + 0.01, (order, name)
    assert variance_shares.area_shares("no cells", ~np.isfinite(ELEVATION_M)) is None
    by_range = variance_shares.by_range()
    assert [sum(row["covariance_share"].values()) for row in by_range] == pytest.approx(
        [1.0] * len(by_range), abs=1e-4
    )
    variance_shares.write(tmp_path / "maps" / "shares.nc")
    with xr.open_dataset(tmp_path / "maps" / "shares.nc") as maps:
        total = sum(maps[f"share_{name}"] for name in INPUTS)
        observed = np.isfinite(total.values)
        assert np.array_equal(observed, variance_shares.cells)
        assert total.values[observed] == pytest.approx(np.ones(observed.sum()), abs=5e-3)
        assert maps.share_tilt.dims == ("y", "x")
        assert maps.share_tilt.attrs["grid_mapping"] == "crs"


@pytest.mark.integration
def test_the_shares_of_an_unadjusted_epoch_include_the_errors_of_its_reference(tmp_path, errors):
    unadjusted = write_store(tmp_path, errors, adjustment="none")
    write_reference(unadjusted, replace(make_reference(), shared=shared_parameters()))
    all_cells = np.ones(GRID.shape, bool)
    result = compute_variance_shares(unadjusted, 5).area_shares("all", all_cells, simulate=False)
    with netCDF4.Dataset(unadjusted.folder / "series.nc") as file:
        weights = np.isfinite(np.ma.filled(file["elevation_change"][5], np.nan))
    assert result["sigma_m"] ** 2 == pytest.approx(
        station.variance(unadjusted.folder, weights / weights.sum(), 5), rel=1e-6
    )


@pytest.mark.integration
def test_an_epoch_without_a_reference_has_no_shares(tmp_path, errors):
    store = write_store(tmp_path, errors)
    path = epochs.revisions(store, datetime.fromtimestamp(START_S, UTC))[0].path
    with netCDF4.Dataset(path, "r+") as file:
        file["reference_version"][0] = np.zeros(64, "S1")
    with pytest.raises(StoreError, match="no reference yet"):
        compute_variance_shares(store, 0)
