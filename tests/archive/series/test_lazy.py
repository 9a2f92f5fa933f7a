"""`station.open`: the series as one lazy dataset, equal to what the epochs contain."""

import shutil
from dataclasses import replace
from datetime import UTC, datetime

import h5py
import netCDF4
import numpy as np
import pytest
import rasterio
import rioxarray  # noqa: F401 - ds.rio
import xarray as xr
from support.epochs import GRID, make_epoch, write_surface

import station
from station.archive.chunk_codec import read_column
from station.archive.epochs import write_epoch
from station.archive.netcdf_layout import Series
from station.archive.series.compaction import compact
from station.archive.series.index import list_epochs
from station.archive.series.virtual import build_series
from station.errors import StoreError

HOURS = (1, 2, 3, 5, 30, 31)  # the first four become a compacted day
WITHOUT_TERMS = 30  # an epoch that lacks the sigma terms
RASTERS = ("elevation_change", "elevation_change_uncertainty", "point_count", "quality", "sigma_geometry")


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    """Epochs in a compacted day and in their own files; the eastern half of the grid is never observed."""
    series = Series(tmp_path_factory.mktemp("store"), "hef", GRID, "EPSG:32632")
    write_surface(series)
    for hour in HOURS:
        result = make_epoch(hour, terms=hour != WITHOUT_TERMS)
        result.measurement.cells["spread_m"] = np.nan  # a variable without any chunk
        write_epoch(series, result)
    compact(series, datetime(2025, 11, 22, 12, tzinfo=UTC), lambda: None)
    build_series(series)
    return series


@pytest.fixture
def copied(stored, tmp_path):
    """A copy of the store that a test may change."""
    return replace(stored, folder=shutil.copytree(stored.folder, tmp_path / "copy"))


def test_rasters_equal_those_of_the_epochs(stored):
    with station.open(stored.folder) as ds:
        assert ds.sizes["time"] == len(HOURS)
        assert not any(ds[name]._in_memory for name in RASTERS)
        for index, hour in enumerate(HOURS):
            measurement = make_epoch(hour).measurement
            for name, column in (
                ("elevation_change", "change_m"),
                ("elevation_change_uncertainty", "uncertainty_m"),
            ):
                expected = measurement.to_rasters(column)[0]
                assert np.allclose(ds[name][index], expected, atol=1e-3, equal_nan=True)
            assert np.array_equal(ds.point_count[index], measurement.to_rasters("count")[0])
        assert np.isnan(ds.elevation_spread).all()
        assert np.isnan(ds.sigma_geometry[HOURS.index(WITHOUT_TERMS)]).all()
        assert np.isfinite(ds.sigma_geometry[0, :, :75]).all()


@pytest.mark.parametrize(
    "selection",
    [
        {"y": slice(120, 135), "x": slice(5, 140)},
        {"time": slice(1, 5, 2), "y": slice(None, None, 7), "x": slice(None, None, -3)},
        {"time": [5, 0, 4], "y": [139, 2, 130, 3], "x": [149, 0, 1]},
        {"time": 2, "y": 3, "x": 4},
        {"time": slice(0, 0)},
        {"y": xr.DataArray([3, 130, 70], dims="point"), "x": xr.DataArray([60, 15, 12], dims="point")},
    ],
)
def test_lazy_selections_equal_those_of_the_loaded_series(stored, selection):
    with station.open(stored.folder) as lazy, station.open(stored.folder) as loaded:
        xr.testing.assert_identical(
            lazy.elevation_change.isel(selection).load(), loaded.elevation_change.load().isel(selection)
        )


def test_times_and_texts_are_decoded(stored):
    with station.open(stored.folder) as ds:
        assert ds.time.values[0] == np.datetime64("2025-11-21T01:07:30")
        assert ds.scan_id.values.tolist() == [f"251121_{hour % 24:02d}0000" for hour in HOURS]
        assert ds.epoch_file.values[-1] == "hef_20251122T070000Z.nc"
        offset_s = ds.station.processing.log_offset
        assert offset_s.dtype == np.float64  # seconds are not decoded as time differences


@pytest.mark.integration
def test_an_open_series_stays_readable_while_the_service_writes(copied):
    with station.open(copied.folder) as ds:
        write_epoch(copied, make_epoch(40))
        build_series(copied)
        compact(copied, datetime(2025, 11, 24, tzinfo=UTC), lambda: None)
        build_series(copied)
        change_m = ds.elevation_change[:, 139, 5].values
        assert change_m == pytest.approx(np.array(HOURS) / 100, abs=1e-3)
    with station.open(copied.folder) as ds:
        assert ds.sizes["time"] == len(HOURS) + 1


@pytest.mark.filterwarnings("ignore::PendingDeprecationWarning")  # of rioxarray, about affine
def test_rasters_carry_the_coordinate_system_of_the_map(stored, tmp_path):
    with station.open(stored.path) as ds:
        assert ds.elevation_change.rio.crs.to_epsg() == 32632
        ds.elevation_change[0].rio.to_raster(tmp_path / "change.tif")
    with rasterio.open(tmp_path / "change.tif") as tif:
        assert (tif.crs.to_epsg(), tif.bounds.top) == (32632, GRID.north_m)


@pytest.mark.parametrize(
    ("chunks", "expected"),
    [({}, (6, 140, 150)), ({"time": 2, "x": 128}, (2, 140, 128)), ("auto", (6, 140, 150))],
)
def test_chunks_of_dask(stored, chunks, expected):
    with station.open(stored.folder, chunks) as ds, station.open(stored.folder) as plain:
        assert tuple(sizes[0] for sizes in ds.elevation_change.chunks) == expected
        assert ds.scan_id.chunks is None
        xr.testing.assert_identical(
            ds.elevation_change.mean("time").load(), plain.elevation_change.mean("time")
        )


def test_a_file_that_is_no_series_is_refused(stored):
    with pytest.raises(StoreError, match=r"reference\.nc: no site file, data folder or series\.nc"):
        station.open(stored.folder / "reference.nc")


@pytest.mark.integration
def test_threads_of_dask_read_the_reference_one_at_a_time(stored):
    """The library netCDF4 is not safe in threads: two that open a file at once end the process."""
    with station.open(stored.folder) as plain:
        expected = plain.elevation.load()
    for _ in range(4):
        with station.open(stored.folder, {"time": 1}) as ds:
            actual = ds.elevation.compute(scheduler="threads", num_workers=8)
        xr.testing.assert_identical(actual, expected)


@pytest.mark.parametrize("chunks", [None, {}])
def test_a_part_of_the_series_is_written_compressed_and_without_a_warning(stored, tmp_path, chunks):
    """pytest turns warnings into errors."""
    with station.open(stored.folder, chunks) as ds:
        part = ds.isel(time=slice(1, 4), x=slice(10, 60))
        part.to_netcdf(tmp_path / "part.nc")
        assert "virtual" not in part.attrs.get("comment", "")
        with xr.open_dataset(tmp_path / "part.nc", decode_timedelta=False) as written:
            xr.testing.assert_equal(written.set_coords(["crs", "time_bnds", "x_bnds", "y_bnds"]), part)
    with netCDF4.Dataset(tmp_path / "part.nc") as file:
        assert file["elevation_change"].filters()["zlib"]
        assert "_FillValue" not in file["time"].ncattrs()
        assert file["elevation_change"].chunking() != "contiguous"


def test_a_damaged_chunk_raises_an_error(copied):
    damaged = list_epochs(copied)[3]
    with h5py.File(damaged.path) as file:
        chunk = file["elevation_change"].id.get_chunk_info_by_coord((damaged.index, 0, 0))
    with damaged.path.open("r+b") as file:
        file.seek(chunk.byte_offset + 20)
        file.write(b"\xff" * (chunk.size - 40))
    with station.open(copied.folder) as ds:
        assert np.isfinite(ds.elevation_change[2]).any()
        with pytest.raises(StoreError, match=damaged.path.name):
            ds.elevation_change[:, 5, 5].load()


def test_read_column_equals_h5py(stored, tmp_path):
    with h5py.File(stored.processing_path) as file:
        columns = [dataset for dataset in file.values() if dataset.chunks and len(dataset) == len(HOURS)]
        assert {"epoch_file", "time_bnds", "verdict", "point_total"} <= {
            column.name[1:] for column in columns
        }
        for column in columns:
            assert read_column(column).dtype == column.dtype
            assert np.array_equal(read_column(column), column[:])
    values = np.random.default_rng(1).integers(0, 99, (23, 5)).astype("i2")
    with h5py.File(tmp_path / "columns.h5", "w") as file:
        for name, chunks in (("whole rows", (4, 5)), ("split rows", (4, 3))):
            column = file.create_dataset(
                name, (23, 5), "i2", chunks=chunks, compression="gzip", shuffle=True, maxshape=(None, 5)
            )
            assert np.array_equal(read_column(column), np.zeros((23, 5)))  # nothing is written yet
            column[:] = values
            assert np.array_equal(read_column(column), values)
            assert np.array_equal(read_column(column, 8), values[8:])  # the start of a chunk
            assert np.array_equal(read_column(column, 3), values[3:])
