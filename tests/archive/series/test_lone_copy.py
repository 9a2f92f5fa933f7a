"""A `series.nc` without the files that it reads from: every reader must see that something is missing."""

import dataclasses
import json
import shutil
import subprocess

import netCDF4
import numpy as np
import pytest
import xarray as xr
from support.epochs import GRID, make_epoch, write_surface
from support.programs import readers_python
from support.series import copied

import station
from station.archive.epochs import write_epoch
from station.archive.netcdf_layout import Series
from station.archive.series.virtual import build_series
from station.errors import StoreError

ENGINES = ("netcdf4", pytest.param("h5netcdf", marks=pytest.mark.integration))
NO_TIME_S = 9.96921e36
NO_CHANGE_M = 1e30


@pytest.fixture(scope="module")
def base_store(tmp_path_factory):
    series = Series(tmp_path_factory.mktemp("base"), "hef", GRID, "EPSG:32632")
    write_surface(series)
    for hour in range(4):
        write_epoch(series, make_epoch(hour))
    build_series(series)
    return series


@pytest.fixture
def series(base_store, tmp_path):
    return copied(base_store, tmp_path / "store")


@pytest.fixture
def stored(series):
    return series.path


@pytest.fixture
def lone(stored, tmp_path_factory):
    return shutil.copy(stored, tmp_path_factory.mktemp("mail") / "series.nc")


def run(*command):
    if shutil.which(command[0]) is None:
        pytest.skip(f"{command[0]} is not installed")
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)


@pytest.mark.parametrize("engine", ENGINES)
def test_a_complete_store_has_as_many_valid_cells_as_were_written(stored, engine):
    with xr.open_dataset(stored, engine=engine) as ds:
        assert ds.valid_count.values.tolist() == [140 * 75] * 4  # the western half of the grid
        assert (ds.elevation_change.count(("y", "x")) == ds.valid_count).all()
        middle = ds.time_bnds[:, 0] + (ds.time_bnds[:, 1] - ds.time_bnds[:, 0]) / 2
        assert (ds.time == middle).all()
        assert "copy the whole folder" in ds.comment


@pytest.mark.parametrize("engine", ENGINES)
def test_xarray_refuses_a_lone_copy(lone, engine):
    with pytest.raises(ValueError, match="unable to decode time"):
        xr.open_dataset(lone, engine=engine)
    with pytest.raises(StoreError, match="4 of its source files are missing"):
        station.open(lone)


@pytest.mark.parametrize("engine", ENGINES)
def test_a_lone_copy_of_how_scans_were_processed_is_refused_too(stored, engine, tmp_path_factory):
    alone = shutil.copy(stored.with_name("processing.nc"), tmp_path_factory.mktemp("mail"))
    with pytest.raises(ValueError, match="unable to decode time"):
        xr.open_dataset(alone, engine=engine)
    with xr.open_dataset(alone, engine=engine, decode_times=False) as ds:
        assert "The results are in series.nc" in ds.comment


def test_an_epoch_without_its_file_shows_itself(stored, series):
    (lost,) = series.folder.glob("epochs/*/*/*/*T020000Z.nc")
    lost.unlink()
    with pytest.raises(OverflowError, match="time values outside range"):
        xr.open_dataset(stored)
    with pytest.raises(StoreError, match=rf"1 of its source files are missing.*{lost.name}"):
        station.open(series.folder)
    with xr.open_dataset(stored, decode_times=False) as ds:
        assert (ds.time == NO_TIME_S).values.tolist() == [False, False, True, False]
        is_complete = ds.elevation_change.count(("y", "x")) == ds.valid_count
        assert is_complete.values.tolist() == [True, True, False, True]
        assert (ds.elevation_change[2] == np.float32(NO_CHANGE_M)).all()
        assert (ds.point_count[2] == -1).all()
        assert float(ds.elevation_change.mean()) > NO_CHANGE_M / 10  # no mean hides it


def test_a_variable_that_older_epochs_lack_is_missing_there(stored, series):
    older = dataclasses.replace(make_epoch(5), verdict_reason="older")
    path = write_epoch(series, older).path
    with netCDF4.Dataset(path, "a") as file:
        file.renameVariable("elevation_spread", "spread_of_old")
    build_series(series)
    with xr.open_dataset(stored) as ds:
        assert ds.elevation_spread.count(("y", "x")).values.tolist() == [140 * 75] * 4 + [0]
        assert float(ds.elevation_spread.max()) < 1
        assert float(ds.elevation_change[-1].max()) == pytest.approx(0.05)


def test_a_reader_learns_that_files_were_deleted(series, stored):
    with station.open(stored) as ds:
        assert np.isfinite(ds.elevation_change[0]).any()
        (lost,) = series.folder.glob("epochs/*/*/*/*T020000Z.nc")
        lost.unlink()
        with pytest.raises(StoreError, match=rf"{lost.name}: deleted since .* open the series again"):
            ds.elevation_change[0].load()


@pytest.mark.integration
def test_other_programs_show_that_a_lone_copy_has_no_times(lone, tmp_path):
    assert f"{NO_TIME_S:g}" in run("ncdump", "-v", "time", str(lone)).stdout
    a_date = "2025-11-21 01:00:00", "2025-11-21 03:00:00"
    selected = run("ncks", "-O", "-3", "-d", f"time,{','.join(a_date)}", str(lone), str(tmp_path / "part.nc"))
    assert selected.returncode != 0
    assert "does not fall within valid coordinate range" in selected.stdout + selected.stderr
    bands = json.loads(run("gdalinfo", "-json", f"NETCDF:{lone}:elevation_change").stdout)["bands"]
    times_s = [float(band["metadata"][""]["NETCDF_DIM_time"]) for band in bands]
    assert times_s == pytest.approx([NO_TIME_S] * 4)
    (dates,) = run("cdo", "-s", "showdate", "-selname,elevation_change", str(lone)).stdout.splitlines()
    assert "2025" not in dates
    for averaged in (
        ("ncra", "-O", "-3", "-v", "elevation_change", str(lone), str(tmp_path / "mean.nc")),
        ("cdo", "-s", "timmean", "-selname,elevation_change", str(lone), str(tmp_path / "mean.nc")),
    ):
        assert run(*averaged).returncode == 0
        with xr.open_dataset(tmp_path / "mean.nc", decode_times=False) as ds:
            assert (ds.elevation_change == np.float32(NO_CHANGE_M)).all()


REFUSALS = """
import warnings
from kerchunk.hdf import SingleHdf5ToZarr
from obspec_utils.registry import ObjectStoreRegistry
from obstore.store import LocalStore
from virtualizarr.parsers import HDFParser
registry = ObjectStoreRegistry({"file://": LocalStore()})
for path in paths:
    try:
        HDFParser()(f"file://{path}", registry)
    except ValueError as error:
        print(error)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        names = {name.split("/")[0] for name in SingleHdf5ToZarr(path).translate()["refs"]}
    refused = sum("2 dimension scales" in str(warning.message) for warning in caught)
    print(refused, len(names & {"elevation_change", "shared_parameter_covariance"}))
"""


@pytest.mark.integration
def test_readers_that_follow_no_virtual_file_refuse_it(stored):
    """VirtualiZarr stops, kerchunk warns and leaves the variables out: both would find no values."""
    paths = [str(stored), str(stored.with_name("processing.nc"))]
    lines = run(str(readers_python()), "-c", f"paths = {paths!r}\n{REFUSALS}").stdout.splitlines()
    for error in lines[::2]:
        assert "has 2 dimension scales attached to dimension #0" in error
    assert lines[1::2] == ["7 0", "2 0"]  # rasters; covariance of the parameters and of change
