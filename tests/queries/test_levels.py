"""Levels and rates of a store: against the truth of its epochs, and the same in any area."""

from dataclasses import replace

import numpy as np
import pytest
from support.epochs import random_epoch

import station
from station.archive.epochs import write_epoch
from station.archive.netcdf_layout import Series
from station.archive.reference_files import write_reference
from station.archive.series.virtual import build_series
from station.errors import StoreError
from station.quantities import Grid, Measurement, Reference

GRID = Grid(west_m=632_000.0, north_m=5_186_000.0, cell_m=10.0, nx=60, ny=140)
SIGMA_M, REFERENCE_M, RATE_M_D, HOURS = 0.05, 0.01, 0.05, 30
UNSEEN_SINCE_H = 24  # of the northern 20 rows


def true_level(hour):
    return RATE_M_D * hour / 24


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    series = Series(tmp_path_factory.mktemp("store"), "hef", GRID, "EPSG:32632")
    surface = Reference.from_elevation(GRID, "1", np.full(GRID.shape, 2800.0))
    write_reference(
        series, replace(surface, random_variance_m2=np.full(GRID.shape, REFERENCE_M**2, np.float32))
    )
    for hour in range(HOURS):
        write_epoch(series, scan(hour))
    build_series(series)
    return series


def scan(hour):
    """Four of five cells, with independent errors; none of the northern rows after a while."""
    rng = np.random.default_rng(100 + hour)
    observed = rng.uniform(size=GRID.shape) < 0.8
    observed[:20] &= hour < UNSEEN_SINCE_H
    change_m = true_level(hour) + SIGMA_M * rng.standard_normal(GRID.shape)
    sigma_m = np.where(observed, np.hypot(SIGMA_M, REFERENCE_M), np.nan).astype(np.float32)
    measurement = Measurement.from_rasters(
        GRID,
        observed.astype(np.uint8),
        elevation_m=np.where(observed, 2800.0, np.nan),
        change_m=np.where(observed, change_m, np.nan).astype(np.float32),
        uncertainty_m=1.01 * sigma_m,
        systematic_uncertainty_m=np.sqrt(np.float32(1.01**2 - 1)) * sigma_m,
        spread_m=sigma_m,
        count=observed.astype(np.int32),
    )
    epoch = random_epoch(hour, GRID, SIGMA_M, provenance={"reference_version": "1", "adjustment": "joint"})
    return replace(epoch, measurement=measurement)


@pytest.fixture(scope="module")
def levels(store):
    return station.levels(store.folder, np.ones(GRID.shape, bool))


def test_one_entry_a_day_with_levels_within_their_uncertainty(levels):
    assert levels.sizes == {"time": 2, "y": GRID.ny, "x": GRID.nx}
    last = levels.isel(time=-1)
    sigma_m = np.hypot(last.level_random_uncertainty, last.level_systematic_uncertainty)
    error_m = (last.level - true_level(HOURS - 1)).values
    assert 0.6 < np.std(error_m / sigma_m.values) < 1.1  # the surface moves less than moving ground may
    assert np.std(error_m[20:]) < 0.6 * SIGMA_M
    assert float(last.rate.mean()) == pytest.approx(RATE_M_D, abs=0.015)
    assert float(last.level_random_uncertainty.min()) > REFERENCE_M


def test_gaps_are_filled_marked_and_less_certain(levels):
    last = levels.isel(time=-1)
    gap, seen = last.isel(y=slice(0, 20)), last.isel(y=slice(20, None))
    assert np.all(gap.coverage == 0)
    assert float(seen.coverage.mean()) == pytest.approx(0.8, abs=0.01)  # each epoch saw four of five
    sigmas_m = [
        float(np.hypot(part.level_random_uncertainty, part.level_systematic_uncertainty).mean())
        for part in (gap, seen)
    ]
    assert sigmas_m[0] > 1.2 * sigmas_m[1]


def test_cell_has_the_same_level_in_any_area(store, levels):
    area = np.zeros(GRID.shape, bool)
    area[30:70, 10:40] = True
    part = station.levels(store.folder, area)
    assert part.sizes == {"time": 2, "y": 40, "x": 30}
    for name in ("level", "rate"):
        whole = levels[name].sel(x=part.x, y=part.y)
        assert np.array_equal(part[name], whole, equal_nan=True)


def test_store_without_usable_epoch_is_an_error(tmp_path):
    series = Series(tmp_path, "hef", GRID, "EPSG:32632")
    write_reference(series, Reference.from_elevation(GRID, "1", np.full(GRID.shape, 2800.0)))
    write_epoch(series, replace(scan(0), verdict="unusable"))
    build_series(series)
    with pytest.raises(StoreError, match="no usable epoch"):
        station.levels(tmp_path, np.ones(GRID.shape, bool))
