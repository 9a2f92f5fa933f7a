"""Levels as files: the same bits live, late, interrupted and rebuilt, and only what changed is written."""

from dataclasses import replace

import netCDF4
import numpy as np
import pytest
import xarray as xr
from support.epochs import random_epoch
from support.programs import findings

import station
from station.archive.derived.level_files import LEVEL_NAMES, damaged_levels, level_files
from station.archive.epochs import write_epoch
from station.archive.netcdf_layout import Series
from station.archive.reference_files import write_reference
from station.archive.series.virtual import build_series
from station.errors import StationError
from station.products.area_tables import Span
from station.products.exports.levels import export_levels
from station.quantities import Grid, Reference
from station.queries.levels import update_levels

pytestmark = pytest.mark.integration
GRID = Grid(west_m=632_000.0, north_m=5_186_000.0, cell_m=10.0, nx=40, ny=30)
SIGMA_M = np.full(GRID.shape, 0.02)
REFERENCE_M = 0.01
HOURS = [24 * day + hour for day in range(6, 13) for hour in (3, 15)]  # 27 November to 3 December
EVERYWHERE = np.ones(GRID.shape, bool)


def new_store(folder):
    series = Series(folder, "hef", GRID, "EPSG:32632")
    surface = Reference.from_elevation(GRID, "1", np.full(GRID.shape, 2800.0))
    variance_m2 = np.full(GRID.shape, REFERENCE_M**2, np.float32)
    write_reference(series, replace(surface, random_variance_m2=variance_m2))
    return series


def add(series, hours):
    """Add epochs: a surface that sinks by 5 cm a day, but for what `random_epoch` lets it rise."""
    for hour in hours:
        epoch = random_epoch(hour, GRID, SIGMA_M, scatter_m=0.02, provenance={"reference_version": "1"})
        change_m = epoch.measurement.change_m - np.float32(hour / 10 + 0.05 * hour / 24)
        cells = epoch.measurement.cells.copy()
        random_m2 = cells["uncertainty_m"] ** 2 - cells["systematic_uncertainty_m"] ** 2
        cells["uncertainty_m"] = 1.02 * np.sqrt(random_m2)
        cells["systematic_uncertainty_m"] = np.sqrt((1.02**2 - 1) * random_m2)
        measurement = replace(epoch.measurement, change_m=change_m, cells=cells)
        write_epoch(series, replace(epoch, measurement=measurement))
    build_series(series)


def update(series):
    return update_levels(series, lambda: None)


def contents(series):
    """Return the stored values of all files by name and variable."""
    result = {}
    for path in level_files(series):
        with netCDF4.Dataset(path) as file:
            file.set_auto_mask(False)
            result |= {(path.name, name): file[name][...].tobytes() for name in file.variables}
    return result


@pytest.fixture(scope="module")
def rebuilt(tmp_path_factory):
    """A store whose levels were computed at once."""
    series = new_store(tmp_path_factory.mktemp("rebuilt"))
    add(series, HOURS)
    assert update(series) == 7
    return series


def test_a_file_for_each_day_and_month_that_is_over(rebuilt):
    names = {path.name.split("_")[1] for path in level_files(rebuilt)}
    assert names == {"20251127", "20251128", "20251129", "20251130", "202511", "20251201", "20251202"}
    assert update(rebuilt) == 0


def test_live_equals_rebuilt_bit_for_bit(rebuilt, tmp_path):
    series = new_store(tmp_path)
    for hour in HOURS:
        add(series, [hour])
        assert update(series) <= 2
    assert contents(series) == contents(rebuilt)


def test_late_epoch_changes_its_day_and_those_after_it_only(rebuilt, tmp_path):
    series, late = new_store(tmp_path), HOURS[5]
    add(series, [hour for hour in HOURS if hour != late])
    update(series)
    before = {path.name: path.stat().st_ino for path in level_files(series)}
    add(series, [late])
    assert update(series) == 5  # 29 and 30 November, 1 and 2 December, and the month
    assert contents(series) == contents(rebuilt)
    after = {path.name: path.stat().st_ino for path in level_files(series)}
    assert len(before.items() & after.items()) == 2


def test_late_epoch_of_yesterday_costs_no_earlier_day(tmp_path):
    series, late, read = new_store(tmp_path), HOURS[9], []
    add(series, [hour for hour in HOURS if hour != late])
    update(series)
    add(series, [late])
    update_levels(series, lambda: read.append(1))
    assert len(read) == 4  # epochs of 1 and 2 December


def test_lost_or_damaged_states_change_nothing(rebuilt, tmp_path):
    series = new_store(tmp_path)
    add(series, HOURS[:-5])
    update(series)
    for path in (series.folder / ".levels").glob("*.npz"):
        path.write_bytes(path.read_bytes()[:-3000] + bytes(3000))
    add(series, HOURS[-5:])
    update(series)
    assert contents(series) == contents(rebuilt)


def test_damaged_file_is_found_and_computed_again(rebuilt, tmp_path):
    series = new_store(tmp_path)
    add(series, HOURS)
    update(series)
    path = level_files(series)[4]
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    assert damaged_levels(series) == [path]
    path.unlink()
    assert update(series) == 1
    assert contents(series) == contents(rebuilt)
    assert damaged_levels(series) == []


def test_levels_are_the_same_from_files_and_from_epochs(rebuilt, tmp_path):
    plain = new_store(tmp_path)
    add(plain, HOURS)
    area = np.zeros(GRID.shape, bool)
    area[5:20, 3:30] = True
    stored, computed = station.levels(rebuilt.folder, area), station.levels(plain.folder, area)
    assert stored.sizes == {"time": 7, "y": 15, "x": 27}
    for name in LEVEL_NAMES:
        assert stored[name].values.tobytes() == computed[name].values.tobytes(), name


def test_rate_of_a_month_is_the_mean_since_its_begin_within_its_uncertainty(rebuilt):
    month = station.levels(rebuilt.folder, EVERYWHERE, every="1M").isel(time=0)
    error_m_d = (month.rate + 0.05).values
    assert abs(np.nanmean(error_m_d)) < 4e-3
    sigma_m_d = np.hypot(month.rate_random_uncertainty, month.rate_systematic_uncertainty).values
    assert 0.4 < np.nanstd(error_m_d / sigma_m_d) < 1.25
    assert float(month.coverage.mean()) == pytest.approx(0.8, abs=0.01)


def test_files_are_what_cf_wants(rebuilt):
    day_path, month_path = (
        next(rebuilt.folder.glob(f"levels/*/hef_{name}_*.nc")) for name in ("20251127", "202511")
    )
    with netCDF4.Dataset(month_path) as month, netCDF4.Dataset(day_path) as day:
        assert day["level"].ancillary_variables.split()[0] == "level_random_uncertainty"
        assert day["level"].grid_mapping == "crs"
        assert float(day["epoch_count"][0]) == 2
        assert float(month["epoch_count"][0]) == 8
        assert "steps included" in month["rate"].comment
        assert "without steps" in day["rate"].comment


def test_export_as_geotiff(rebuilt, tmp_path):
    rasterio = pytest.importorskip("rasterio")
    paths = export_levels(rebuilt, None, tmp_path, "geotiff")
    assert {path.name for path in paths} == {f"hef_20251202_{name}.tif" for name in LEVEL_NAMES}
    newest = station.levels(rebuilt.folder, EVERYWHERE).isel(time=-2)
    with rasterio.open(tmp_path / "hef_20251202_rate.tif") as raster:
        assert raster.units == ("m d-1",)
        assert np.array_equal(raster.read(1), newest.rate.values, equal_nan=True)
    months = export_levels(rebuilt, Span.parse("2025-11-01", "2025-11-02"), tmp_path, "geotiff")
    assert {path.name for path in months} == {f"hef_202511_{name}.tif" for name in LEVEL_NAMES}
    with pytest.raises(StationError, match="no day of levels"):
        export_levels(rebuilt, Span.parse("2024-11-01", "2024-11-02"), tmp_path, "geotiff")


def test_export_as_netcdf_has_all_days_with_the_stored_values(rebuilt, tmp_path):
    paths = export_levels(rebuilt, Span.parse("2025-11-01", "2025-12-03"), tmp_path, "netcdf")
    assert [path.name for path in paths] == ["hef_levels_20251127-20251202.nc", "hef_levels_202511.nc"]
    expected = station.levels(rebuilt.folder, EVERYWHERE).isel(time=slice(-1))
    with xr.open_dataset(paths[0]) as days, xr.open_dataset(paths[1]) as months:
        assert np.array_equal(days.time, expected.time)
        for name in LEVEL_NAMES:
            assert np.array_equal(days[name], expected[name], equal_nan=True), name
        assert days.epoch_count.values.tolist() == [2] * 6
        assert days.time_bnds.values[0, 0] == np.datetime64("2025-11-27T03:00")
        assert (days.attrs["time_coverage_start"], months.sizes["time"]) == ("2025-11-27T03:00:00Z", 1)
        assert "mean since" in months.rate.comment


@pytest.mark.integration
def test_compliance_checker_accepts_levels(rebuilt, tmp_path):
    exported = export_levels(rebuilt, Span.parse("2025-11-01", "2025-12-03"), tmp_path, "netcdf")
    stored = [next(rebuilt.folder.glob(f"levels/*/hef_{name}_*.nc")) for name in ("20251202", "202511")]
    assert findings(tmp_path / "report.json", *stored, *exported) == []
