"""Rasters written and read past the netCDF library, against that library."""

import h5py
import netCDF4
import numpy as np
import pytest

from station.archive.layout import Series, define, lay_out
from station.archive.rasters import Raster, rounded, write_rasters
from station.archive.variables import BY_NAME, FILL
from station.errors import StoreError
from station.quantities import Grid

GRID = Grid(0.0, 300.0, 1.0, 210, 300)  # neither edge a whole number of chunks
NAMES = ("elevation", "elevation_change_uncertainty", "point_count", "quality")


def values():
    rng = np.random.default_rng(4)
    found = {
        "elevation": rng.normal(3000, 400, GRID.shape),
        "elevation_change_uncertainty": rng.uniform(0, 2, GRID.shape).astype(np.float32),
        "point_count": rng.integers(0, 40, GRID.shape, dtype=np.int32),
        "quality": rng.integers(0, 32, GRID.shape, dtype=np.uint8),
    }
    for name in NAMES[:2]:
        found[name][rng.uniform(size=GRID.shape) < 0.5] = np.nan
        found[name][:140, :130] = np.nan  # a chunk and more of nothing
    return found


def written(path, way):
    series = Series(path.parent, "a", GRID, None)
    with netCDF4.Dataset(path, "w") as file:
        lay_out(file, series, "a test", 1)
        file["time"][0], file["time_bnds"][0] = 1.0, (0.0, 2.0)
        made = {name: define(file, BY_NAME[name], series, 1) for name in NAMES}
        if way == "library":
            for name, raster in values().items():
                made[name][0] = np.ma.masked_invalid(raster)
    if way == "own":
        put(path, {BY_NAME[name]: raster for name, raster in values().items()})
    return path


def put(path, rasters):
    write_rasters(
        path, list(rasters), lambda rows: [rounded(row, raster[rows]) for row, raster in rasters.items()]
    )


def test_the_library_reads_what_it_would_have_written_itself(tmp_path):
    own, library = (written(tmp_path / f"{way}.nc", way) for way in ("own", "library"))
    with netCDF4.Dataset(own) as one, netCDF4.Dataset(library) as other:
        for file in (one, other):
            file.set_auto_mask(False)
        for name in NAMES:
            assert one[name].shape == (1, *GRID.shape)
            assert np.array_equal(one[name][:], other[name][:]), name
            assert one[name].filters() == other[name].filters()
        assert one["elevation"][0, 0, 0] == np.float32(FILL)


def as_they_are(raster):
    return raster


def test_rows_are_those_of_the_whole(tmp_path):
    series = Series(tmp_path, "a", GRID, None)
    path = tmp_path / "plane.nc"
    given = np.random.default_rng(1).normal(size=GRID.shape).astype(np.float32)
    given[:130] = np.nan
    row = BY_NAME["sigma_geometry"]
    plane = type(row)(row.name, ("y", "x"), "f4", "a plane")
    with netCDF4.Dataset(path, "w") as file:
        lay_out(file, series, "a test", None)
        define(file, plane, series, 1)
    put(path, {plane: given})
    raster = Raster(path, plane.name, lambda found: np.where(found == np.float32(FILL), np.nan, found))
    assert np.array_equal(np.asarray(raster), given, equal_nan=True)
    chosen = np.zeros(GRID.shape, bool)
    nothing, chosen[125:140, 7:150:3] = chosen.copy(), True
    rows = slice(0, 10), slice(120, 260), slice(290, 400), slice(5, 290, 3), slice(128, 128), slice(300, 300)
    boxes = (
        (slice(120, 130), slice(5, 140)),
        (slice(131, 300), slice(128, 210)),
        (slice(0, 300), slice(130, 131)),
    )
    for part in (*rows, *boxes, chosen, nothing):
        assert np.array_equal(raster[part], given[part], equal_nan=True)
    assert (raster.shape, raster.dtype, len(raster)) == (GRID.shape, np.float32, GRID.ny)


def test_of_a_box_no_chunk_beside_it_is_looked_at(tmp_path):
    path = written(tmp_path / "own.nc", "own")
    with h5py.File(path, "r") as file:
        beside = file["elevation"].id.get_chunk_info_by_coord((0, 128, 0))
    box = slice(128, 256), slice(128, 200)
    before = Raster(path, "elevation", index=0)[box]
    with path.open("r+b") as file:
        file.seek(beside.byte_offset)
        file.write(bytes(beside.size))
    raster = Raster(path, "elevation", index=0)
    assert np.array_equal(raster[box], before)
    with pytest.raises(StoreError, match="damaged"):
        raster[128:256]


def test_a_damaged_chunk_is_told(tmp_path):
    series = Series(tmp_path, "a", GRID, None)
    plane = type(BY_NAME["quality"])("whole", ("y", "x"), "f4", "a plane")
    damaged = tmp_path / "b.nc"
    with netCDF4.Dataset(damaged, "w") as file:
        lay_out(file, series, "a test", None)
        define(file, plane, series, 1)
    put(damaged, {plane: values()["elevation"]})
    raster = Raster(damaged, "whole", as_they_are)
    size = damaged.stat().st_size
    with damaged.open("r+b") as file:
        file.seek(size - 60_000)
        file.write(b"\xff" * 50_000)
    with pytest.raises(StoreError, match="damaged"):
        raster[:]
