"""Errors of a window with their correlations: against dense algebra, and as obsarray reads them."""

import numpy as np
import pytest
from support.epochs import random_epoch
from support.plane_store import GRID, dense_variance, make_epoch, make_reference, random_parameters
from support.programs import readers_python, run
from support.series import open_with_processing

import station
from station.archive import epochs
from station.archive.netcdf_layout import Series
from station.archive.reference_files import write_reference
from station.archive.series.virtual import build_series
from station.errors import StationError

FILTERED, ADJUSTED, ON_MAP = range(3)  # epochs of the store
ROWS, COLUMNS = slice(1, 15), slice(3, 24)  # with cells that no epoch observed
KNOWN = np.isfinite(make_reference().elevation_m)
READ = """
import sys, numpy as np, xarray as xr, obsarray
errors = xr.open_dataset(sys.argv[1])
change = errors.unc["elevation_change"]
covariance = np.nan_to_num(change.total_err_cov_matrix().values)
print(*sorted(change.keys()), np.ones(len(covariance)) @ covariance @ np.ones(len(covariance)))
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    series = Series(tmp_path_factory.mktemp("store"), "hef", GRID, "EPSG:32632")
    write_reference(series, make_reference())
    epochs.write_epoch(series, make_epoch(1, "none", random_parameters(1, 1.0)))
    epochs.write_epoch(series, make_epoch(3, "joint", random_parameters(3, 0.3)))
    epochs.write_epoch(series, make_epoch(6, "none", None))
    build_series(series)
    return series.folder


def structure(folder, index):
    with station.open(folder) as ds:
        return ds.isel(time=index, y=ROWS, x=COLUMNS).station.error_structure()


def covariance_m2(errors):
    random_m, systematic_m = (
        np.nan_to_num(errors[f"elevation_change_{part}_uncertainty"].values).ravel()
        for part in ("random", "systematic")
    )
    correlation = errors.error_correlation.values
    return np.diag(random_m**2) + correlation * np.outer(systematic_m, systematic_m)


@pytest.mark.parametrize("index", [FILTERED, ADJUSTED, ON_MAP])
def test_covariance_of_a_window_gives_the_variance_of_its_sums(folder, index):
    errors = structure(folder, index)
    covariance = covariance_m2(errors)
    with open_with_processing(folder) as ds:
        on_map_m = np.where(KNOWN, ds.elevation_change[index].values, np.nan)
        change_m = on_map_m[ROWS, COLUMNS]
        np.testing.assert_array_equal(errors.elevation_change, change_m)
        np.testing.assert_array_equal(errors.x, ds.x[COLUMNS])
        np.testing.assert_array_equal(errors.y, ds.y[ROWS])
        assert 100 < np.isfinite(change_m).sum() < change_m.size
        for seed in range(3):
            weights = np.zeros(GRID.shape)
            weights[ROWS, COLUMNS] = np.random.default_rng(seed).normal(size=change_m.shape)
            weights = np.where(np.isfinite(on_map_m), weights, 0.0)
            inside = weights[ROWS, COLUMNS].ravel()
            assert inside @ covariance @ inside == pytest.approx(
                station.variance(folder, weights, index), rel=1e-5
            )
            if index != ON_MAP:
                reference = random_parameters(7, 0.5) if index == FILTERED else None
                expected = dense_variance(ds, weights, index, reference=reference)
                assert inside @ covariance @ inside == pytest.approx(expected, rel=1e-4)


def test_a_window_of_one_epoch_is_asked_for(folder):
    with station.open(folder) as ds, pytest.raises(StationError, match="has 3 epochs: select one"):
        ds.station.error_structure()


def test_correlations_of_a_whole_map_are_refused(tmp_path):
    grid = GRID.__class__(GRID.west_m, GRID.north_m, GRID.cell_m, 70, 70)
    series = Series(tmp_path, "hef", grid, "EPSG:32632")
    epochs.write_epoch(series, random_epoch(1, grid, np.full(grid.shape, 0.05)))
    build_series(series)
    with station.open(tmp_path) as ds, pytest.raises(StationError, match=r"4,900 cells .* at most 4,096"):
        ds.isel(time=0).station.error_structure()


@pytest.mark.integration
def test_obsarray_reads_the_errors(folder, tmp_path):
    structure(folder, ADJUSTED).to_netcdf(tmp_path / "errors.nc")
    program = run(readers_python(), "-W", "ignore", "-c", READ, tmp_path / "errors.nc")
    *names, variance = program.stdout.split()
    assert names == [f"elevation_change_{part}_uncertainty" for part in ("random", "systematic")]
    weights = np.zeros(GRID.shape)
    weights[ROWS, COLUMNS] = 1.0
    assert float(variance) == pytest.approx(station.variance(folder, weights, ADJUSTED), rel=1e-5)
