"""Rasters written and read by chunks, compared with the netCDF library."""

import time
from dataclasses import replace
from itertools import product

import h5py
import netCDF4
import numpy as np
import pytest

from station.archive.netcdf_layout import Series, create_file, create_variable
from station.archive.raster_io import LazyRaster, rounded, write_rasters
from station.archive.schema import BY_NAME, FILL, Variable
from station.errors import StoreError
from station.quantities import Grid

GRID = Grid(0.0, 300.0, 1.0, 210, 300)  # neither side is a multiple of the chunk size
NAMES = ("elevation", "elevation_change_uncertainty", "point_count", "quality")


def rasters():
    rng = np.random.default_rng(4)
    values = {
        "elevation": rng.normal(3000, 400, GRID.shape),
        "elevation_change_uncertainty": rng.uniform(0, 2, GRID.shape).astype(np.float32),
        "point_count": rng.integers(0, 40, GRID.shape, dtype=np.int32),
        "quality": rng.integers(0, 32, GRID.shape, dtype=np.uint8),
    }
    for name in NAMES[:2]:
        values[name][rng.uniform(size=GRID.shape) < 0.5] = np.nan
        values[name][:140, :130] = np.nan  # more than a whole chunk is empty
    return values


def write_file(path, *, by_netcdf4):
    series = Series(path.parent, "a", GRID, None)
    with netCDF4.Dataset(path, "w") as file:
        create_file(file, series, "a test", 1)
        file["time"][0], file["time_bnds"][0] = 1.0, (0.0, 2.0)
        variables = {name: create_variable(file, BY_NAME[name], series, 1) for name in NAMES}
        if by_netcdf4:
            for name, raster in rasters().items():
                variables[name][0] = np.ma.masked_invalid(raster)
    if not by_netcdf4:
        write_values(path, {BY_NAME[name]: raster for name, raster in rasters().items()})
    return path


def write_values(path, values):
    write_rasters(
        path, list(values), lambda rows: [rounded(spec, raster[rows]) for spec, raster in values.items()]
    )


def write_plane(path, values):
    """Write one raster without a time dimension."""
    series, spec = Series(path.parent, "a", GRID, None), Variable("plane", ("y", "x"), "f4", "a plane")
    with netCDF4.Dataset(path, "w") as file:
        create_file(file, series, "a test", None)
        create_variable(file, spec, series, 1)
    write_values(path, {spec: values})


def test_the_netcdf_library_reads_the_values_and_filters_it_would_have_written(tmp_path):
    paths = write_file(tmp_path / "own.nc", by_netcdf4=False), write_file(tmp_path / "b.nc", by_netcdf4=True)
    with netCDF4.Dataset(paths[0]) as actual, netCDF4.Dataset(paths[1]) as expected:
        for file in (actual, expected):
            file.set_auto_mask(False)
        for name in NAMES:
            assert actual[name].shape == (1, *GRID.shape)
            assert np.array_equal(actual[name][:], expected[name][:]), name
            assert actual[name].filters() == expected[name].filters()
        assert actual["elevation"][0, 0, 0] == np.float32(FILL)


def test_slices_boxes_and_masks_equal_those_of_the_whole_raster(tmp_path):
    path = tmp_path / "plane.nc"
    values = np.random.default_rng(1).normal(size=GRID.shape).astype(np.float32)
    values[:130] = np.nan
    write_plane(path, values)
    raster = LazyRaster(path, "plane", lambda stored: np.where(stored == np.float32(FILL), np.nan, stored))
    assert np.array_equal(np.asarray(raster), values, equal_nan=True)
    no_cell, some_cells = np.zeros((2, *GRID.shape), bool)
    some_cells[125:140, 7:150:3] = True
    rows = slice(0, 10), slice(120, 260), slice(290, 400), slice(5, 290, 3), slice(128, 128), slice(300, 300)
    boxes = (
        (slice(120, 130), slice(5, 140)),
        (slice(131, 300), slice(128, 210)),
        (slice(0, 300), slice(130, 131)),
    )
    for selection in (*rows, *boxes, some_cells, no_cell):
        assert np.array_equal(raster[selection], values[selection], equal_nan=True)
    assert (raster.shape, raster.dtype, len(raster)) == (GRID.shape, np.float32, GRID.ny)


def test_reading_a_box_does_not_touch_neighbouring_chunks(tmp_path):
    path = write_file(tmp_path / "own.nc", by_netcdf4=False)
    with h5py.File(path, "r") as file:
        neighbour = file["elevation"].id.get_chunk_info_by_coord((0, 128, 0))
    box = slice(128, 256), slice(128, 200)
    expected = LazyRaster(path, "elevation", index=0)[box]
    with path.open("r+b") as file:
        file.seek(neighbour.byte_offset)
        file.write(bytes(neighbour.size))
    raster = LazyRaster(path, "elevation", index=0)
    assert np.array_equal(raster[box], expected)
    with pytest.raises(StoreError, match="damaged"):
        raster[128:256]


@pytest.mark.integration
def test_the_last_epoch_of_a_long_file_is_read_as_fast_as_the_first(tmp_path):
    """The cost of looking up a chunk must not grow with the number of chunks before it."""
    series, spec, last = Series(tmp_path, "a", replace(GRID, nx=256), None), BY_NAME["elevation_change"], 5000
    path = tmp_path / "long.nc"
    with netCDF4.Dataset(path, "w") as file:
        create_file(file, series, "a test", 1)
        create_variable(file, spec, series, 1)
    values = np.random.default_rng(1).normal(size=series.grid.shape).astype(np.float32)
    write_values(path, {spec: values})
    with h5py.File(path, "r+") as file:
        variable = file[spec.name]
        variable.resize(last + 1, axis=0)
        for corner in product(range(0, 300, 128), (0, 128)):
            mask, chunk = variable.id.read_direct_chunk((0, *corner))
            for index in range(1, last + 1):
                variable.id.write_direct_chunk((index, *corner), chunk, mask)

    def cpu_s(index):
        durations_s = []
        for _ in range(7):
            started_s = time.process_time()
            raster = LazyRaster(path, spec.name, index=index)[:]
            durations_s.append(time.process_time() - started_s)
            assert np.allclose(raster, values, atol=0.001)
        return min(durations_s)

    assert cpu_s(last) < 3 * cpu_s(0)


def test_a_damaged_chunk_is_reported(tmp_path):
    path = tmp_path / "plane.nc"
    write_plane(path, rasters()["elevation"])
    raster = LazyRaster(path, "plane")
    with path.open("r+b") as file:
        file.seek(path.stat().st_size - 60_000)
        file.write(b"\xff" * 50_000)
    with pytest.raises(StoreError, match="damaged"):
        raster[:]
