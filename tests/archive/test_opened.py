"""The series as one dataset, against the library's own way through the virtual file."""

import dataclasses
import time
from datetime import UTC, datetime

import h5py
import netCDF4
import numpy as np
import pytest
import xarray as xr

import station
from station.archive.join import join_closed
from station.archive.layout import Series, define, lay_out
from station.archive.rasters import Raster, write_rasters
from station.archive.series import build_series
from station.archive.store import write_epoch
from station.archive.tiles import column
from station.archive.variables import BY_NAME
from station.errors import StoreError

RASTERS = ("elevation", "elevation_change", "point_count", "quality", "sigma_geometry")
EVERY = slice(None)


@pytest.fixture
def stored(series, epoch):
    """Epochs in a joined day and by themselves; their eastern half is never seen, one has no terms."""
    for hour in (1, 2, 3, 5, 30, 31):
        made = epoch(hour, terms=hour != 30)
        cells, number = made.measurement.cells, made.measurement.number
        made.measurement.change_m[number[:60, 10:20]] = np.nan
        cells["elevation_m"] = np.nan  # a variable without any chunk
        write_epoch(series, made)
    join_closed(series, datetime(2025, 11, 22, 12, tzinfo=UTC), lambda: None)
    build_series(series)
    return series


@pytest.mark.parametrize(
    "where",
    [
        (EVERY, EVERY, EVERY),
        (3, EVERY, EVERY),
        (EVERY, slice(120, 135), slice(5, 140)),
        (slice(1, 5, 2), slice(None, None, 7), slice(None, None, -3)),
        ([5, 0, 4], [139, 2, 130, 3], [149, 0, 1]),
        ([0, -1], 7, [10, 9]),
        (2, 3, 4),
        (slice(0, 0), EVERY, EVERY),
    ],
)
def test_what_is_read_is_what_the_library_reads(stored, where):
    with station.open(stored.folder) as own, xr.open_dataset(stored.path, decode_timedelta=False) as plain:
        assert own.sizes["time"] == 6
        for name in RASTERS:
            given = dict(zip(("time", "y", "x"), where, strict=True))
            xr.testing.assert_identical(own[name].isel(given).load(), plain[name].isel(given).load())
        assert np.isnan(own.elevation).all()
        assert np.isnan(own.sigma_geometry[4]).all()


def test_points_are_read_too(stored):
    """Each of its own row and column, which xarray makes of rows and columns."""
    places = {"y": xr.DataArray([3, 130, 70], dims="place"), "x": xr.DataArray([60, 15, 12], dims="place")}
    with station.open(stored.folder) as own, xr.open_dataset(stored.path) as plain:
        assert np.array_equal(
            own.elevation_change.isel(places), plain.elevation_change.isel(places), equal_nan=True
        )


def test_all_else_is_as_the_library_opens_it(stored):
    with station.open(stored.folder) as own, xr.open_dataset(stored.path, decode_timedelta=False) as plain:
        assert own.sizes == plain.sizes
        assert own.attrs == plain.attrs
        assert list(own.variables) == list(plain.variables)
        for name, one in plain.variables.items():
            assert own[name].dtype == one.dtype
            assert own[name].encoding == one.encoding


def test_a_damaged_file_is_told(stored):
    (path,) = stored.folder.glob("days/**/*.nc")
    with h5py.File(path) as file:
        where = file["elevation_change"].id.get_chunk_info_by_coord((3, 0, 0))
    with path.open("r+b") as file:
        file.seek(where.byte_offset + 20)
        file.write(b"\xff" * (where.size - 40))
    with station.open(stored.folder) as own:
        assert np.isfinite(own.elevation_change[2]).any()
        with pytest.raises(StoreError, match=f"{path.name}: damaged"):
            own.elevation_change[:, 5, 5].load()


def test_a_column_is_what_the_library_reads(stored, tmp_path):
    with h5py.File(stored.path) as file:
        light = [one for one in file.values() if one.shape and one.chunks and one.shape[0] == 6]
        assert {"epoch_file", "time", "verdict", "point_total"} <= {one.name[1:] for one in light}
        for one in light:
            assert column(one).dtype == one.dtype
            assert np.array_equal(column(one), one[:])
    with h5py.File(tmp_path / "odd.h5", "w") as file:
        given = np.random.default_rng(1).integers(0, 99, (23, 5)).astype("i2")
        packed = {"compression": "gzip", "shuffle": True, "dtype": "i2", "maxshape": (None, 5)}
        for name, chunks in (("whole", (4, 5)), ("cut", (4, 3))):
            made = file.create_dataset(name, (23, 5), chunks=chunks, **packed)
            assert np.array_equal(column(made), np.zeros((23, 5)))  # nothing is written yet
            made[:] = given
            assert np.array_equal(column(made), given)
            assert np.array_equal(column(made, 8), given[8:])
            assert np.array_equal(column(made, 3), given[3:])


def test_an_epoch_among_many_is_read_as_quickly_as_the_first(tmp_path, series):
    """The library takes as long to say where a chunk lies as there are chunks before it."""
    long = Series(tmp_path, "a", dataclasses.replace(series.grid, nx=256), None)
    row, last = BY_NAME["elevation_change"], 5000
    path = tmp_path / "long.nc"
    with netCDF4.Dataset(path, "w") as file:
        lay_out(file, long, "a test", 1)
        define(file, row, long, 1)
    given = np.random.default_rng(1).normal(size=long.grid.shape).astype(np.float32)
    write_rasters(path, [row], lambda rows: [given[rows]])
    with h5py.File(path, "r+") as file:
        variable = file[row.name]
        variable.resize(last + 1, axis=0)
        corners = [(top, left) for top in (0, 128) for left in (0, 128)]
        for corner in corners:
            mask, chunk = variable.id.read_direct_chunk((0, *corner))
            for at in range(1, last + 1):
                variable.id.write_direct_chunk((at, *corner), chunk, mask)

    def cost_s(index):
        taken = []
        for _ in range(7):
            began_s = time.process_time()
            values = Raster(path, row.name, index=index)[:]
            taken.append(time.process_time() - began_s)
            assert np.allclose(values, given, atol=0.001)
        return min(taken)

    assert cost_s(last) < 3 * cost_s(0)
