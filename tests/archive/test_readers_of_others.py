"""What other people's programs make of the files."""

import json
import pickle
import shutil
import subprocess
import sys

import numpy as np
import pytest
import xarray as xr

from station.archive import reference, store
from station.archive.series import build_series
from station.quantities import Reference


def tool(name):
    path = shutil.which(name)
    if path is None:
        pytest.skip(f"{name} is not installed")
    return path


def run(*command):
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=120)


@pytest.fixture
def built(series, epoch):
    for hour in range(4):
        store.write_epoch(series, epoch(hour, terms=True))
    elevation = np.full(series.grid.shape, 2900.125)
    reference.write_reference(
        series,
        Reference(series.grid, "1", elevation, *[np.zeros_like(elevation, np.float32)] * 2, None, ("a",)),
    )
    return build_series(series)


@pytest.mark.parametrize("which", ["series.nc", "reference.nc", "epochs/2025/11/21/hef_20251121T010000Z.nc"])
def test_compliance_checker_finds_nothing(built, which, tmp_path):
    report = tmp_path / "report.json"
    checker = shutil.which("compliance-checker", path=f"{sys.prefix}/bin") or tool("compliance-checker")
    subprocess.run(
        [checker, "--test=cf:1.11", "--format=json", f"--output={report}", built.parent / which],
        capture_output=True,
        check=False,
        timeout=120,
    )
    told = json.loads(report.read_text())["cf:1.11"]
    found = [
        (check["name"], check["msgs"])
        for priority in ("high_priorities", "medium_priorities", "low_priorities")
        for check in told[priority]
        if check["msgs"]
    ]
    assert found == []


def test_ncdump(built):
    assert "elevation_change(time, y, x)" in run(tool("ncdump"), "-h", built).stdout
    assert "0.03" in run(tool("ncdump"), "-v", "elevation_change", built).stdout


def test_cdo(built):
    told = run(tool("cdo"), "infon", built)
    assert "elevation_change" in told.stdout
    warnings = [line for line in told.stderr.splitlines() if "(char/string), skipped" not in line]
    assert "warning" not in "".join(warnings).lower()
    grid = run(tool("cdo"), "griddes", built).stdout
    assert "+proj=utm +zone=32" in grid


@pytest.mark.parametrize("chunking", ["-3", "--cnk_plc=xst"])
def test_nco_averages_over_time(built, tmp_path, chunking):
    """NCO 5.1.4 makes up chunk sizes for virtual variables unless told about the output's."""
    mean = tmp_path / "mean.nc"
    run(tool("ncra"), "-O", chunking, "-v", "elevation_change", built, mean)
    with xr.open_dataset(mean) as told:
        assert float(told.elevation_change[0, 5, 5]) == pytest.approx(0.015, abs=1e-3)
        assert np.isnan(told.elevation_change[0, 5, -1])


def test_gdal_knows_place_and_direction(built):
    told = json.loads(run(tool("gdalinfo"), "-json", f"NETCDF:{built}:elevation_change").stdout)
    assert told["geoTransform"] == [632000.0, 10.0, 0.0, 5186000.0, 0.0, -10.0]
    assert 'ID["EPSG",32632]' in told["coordinateSystem"]["wkt"]
    assert len(told["bands"]) == 4
    at = run(tool("gdallocationinfo"), "-valonly", "-b", "4", "-geoloc", f"NETCDF:{built}:elevation_change",
             "632055", "5185955").stdout  # fmt: skip
    assert float(at) == pytest.approx(0.03, abs=1e-3)


@pytest.mark.parametrize("engine", ["netcdf4", "h5netcdf"])
def test_xarray_while_the_series_is_replaced(built, series, engine):
    # Another process, as in life: HDF5 is one lock within a process.
    program = (
        "import sys, pickle, time; from station.archive.series import build_series\n"
        "series = pickle.loads(bytes.fromhex(sys.argv[1]))\n"
        "end = time.monotonic() + 4\n"
        "while time.monotonic() < end: build_series(series)\n"
    )
    writer = subprocess.Popen([sys.executable, "-c", program, pickle.dumps(series).hex()])
    try:
        reads = 0
        while writer.poll() is None:
            with xr.open_dataset(built, engine=engine) as told:
                assert told.elevation_change[:, 5, 5].values == pytest.approx([0, 0.01, 0.02, 0.03], abs=1e-3)
                reads += 1
    finally:
        writer.kill()
        writer.wait()
    assert writer.returncode == 0
    assert reads > 3


def test_nco_averages_over_epochs(built, tmp_path):
    mean = tmp_path / "mean.nc"
    run(tool("ncra"), "-O", *sorted(built.parent.glob("epochs/*/*/*/*.nc")), mean)
    with xr.open_dataset(mean) as told:
        assert float(told.elevation_change[0, 5, 5]) == pytest.approx(0.015, abs=1e-3)


@pytest.mark.filterwarnings("ignore::PendingDeprecationWarning")  # rioxarray's own use of affine
def test_rioxarray(built):
    rioxarray = pytest.importorskip("rioxarray")
    with rioxarray.open_rasterio(f"netcdf:{built}:elevation_change") as told:
        assert told.rio.crs.to_epsg() == 32632
        assert told.rio.transform().e == -10.0
