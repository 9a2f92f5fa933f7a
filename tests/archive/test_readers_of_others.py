"""What other people's programs make of the files."""

import dataclasses
import json
import pickle
import shutil
import subprocess
import sys
from contextlib import contextmanager
from datetime import UTC, datetime

import numpy as np
import pytest
import xarray as xr

from station.archive import reference, store
from station.archive.aggregate import AreaChange
from station.archive.areas import update_areas
from station.archive.join import join_closed
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
        Reference.given(series.grid, "1", elevation),
    )
    return build_series(series)


def findings(report, *paths):
    """What the CF checker says against files."""
    checker = shutil.which("compliance-checker", path=f"{sys.prefix}/bin") or tool("compliance-checker")
    subprocess.run(
        [checker, "--test=cf:1.11", "--format=json_new", f"--output={report}", *paths],
        capture_output=True,
        check=False,
        timeout=120,
    )
    told = json.loads(report.read_text())
    assert set(told) == set(map(str, paths))
    return [
        (path, check["name"], check["msgs"])
        for path, of in told.items()
        for priority in ("high_priorities", "medium_priorities", "low_priorities")
        for check in of["cf:1.11"][priority]
        if check["msgs"]
    ]


def test_compliance_checker_finds_nothing(built, tmp_path):
    epoch = built.parent / "epochs/2025/11/21/hef_20251121T010000Z.nc"
    assert findings(tmp_path / "report.json", built, built.parent / "reference.nc", epoch) == []


def test_compliance_checker_finds_nothing_in_what_was_joined(built, series, tmp_path):
    join_closed(series, datetime(2026, 2, 1, tzinfo=UTC), lambda: None)
    build_series(series)
    month = built.parent / "months/2025/hef_202511_r1.nc"
    assert findings(tmp_path / "report.json", built, month) == []


def test_compliance_checker_finds_nothing_without_a_map(series, epoch, tmp_path):
    local = dataclasses.replace(series, crs=None, vertical_datum="")
    store.write_epoch(local, epoch(0))
    build_series(local)
    elevation = np.full(series.grid.shape, 2900.125)
    reference.write_reference(local, Reference.given(series.grid, "1", elevation))
    written = [series.folder / name for name in ("series.nc", "reference.nc")]
    for path in written:
        with xr.open_dataset(path) as told:
            assert "crs" not in told
    assert findings(tmp_path / "report.json", *written) == []


def test_other_programs_read_what_was_joined(built, series, tmp_path):
    join_closed(series, datetime(2026, 2, 1, tzinfo=UTC), lambda: None)
    build_series(series)
    for path in (built, built.parent / "months/2025/hef_202511_r1.nc"):
        assert "elevation_change" in run(tool("cdo"), "infon", path).stdout
        assert run(tool("ncdump"), "-v", "scan_id", path).stdout.count('"251121_0') == 4
        at = run(tool("gdallocationinfo"), "-valonly", "-b", "4", "-geoloc",
                 f"NETCDF:{path}:elevation_change", "632055", "5185955").stdout  # fmt: skip
        assert float(at) == pytest.approx(0.03, abs=1e-3)
        mean = tmp_path / "mean.nc"
        run(tool("ncra"), "-O", "-3", "-v", "elevation_change", path, mean)
        with xr.open_dataset(mean) as told:
            assert float(told.elevation_change[0, 5, 5]) == pytest.approx(0.015, abs=1e-3)


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


class Told:
    def area(self, cells, _row):
        return AreaChange(*((0.25, 0.125, 0.2, 0.2, 0.5) if cells.all() else (*[np.nan] * 4, 0.0)))


@pytest.fixture
def of_areas(series, epoch):
    for hour in range(4):
        store.write_epoch(series, epoch(hour))
    build_series(series)
    everywhere = np.ones(series.grid.shape, bool)
    areas = {"Süd": everywhere, "unseen": np.tri(*series.grid.shape, dtype=bool)}
    return update_areas(series, areas, Told(), lambda: None)


def test_compliance_checker_finds_nothing_in_areas(of_areas, tmp_path):
    assert findings(tmp_path / "report.json", of_areas) == []


def test_ncdump_of_areas(of_areas):
    told = run(tool("ncdump"), "-t", "-v", "time,area_name,mean_change", of_areas).stdout
    assert '"2025-11-21 00:07:30"' in told
    assert r'"S\303\274d"' in told  # ncdump's way with UTF-8
    assert "0.25, _" in told


def test_cdo_on_areas(of_areas):
    told = run(tool("cdo"), "-s", "output", "-timmean", "-selname,mean_change", of_areas).stdout
    assert [float(value) for value in told.split()] == pytest.approx([0.25, 9.96921e36])
    shown = run(tool("cdo"), "infon", of_areas)
    assert "volume_change" in shown.stdout
    warnings = [line for line in shown.stderr.splitlines() if "(char/string), skipped" not in line]
    assert "warning" not in "".join(warnings).lower()


def test_nco_averages_areas_over_time(of_areas, tmp_path):
    mean = tmp_path / "mean.nc"
    run(tool("ncra"), "-O", "-v", "mean_change", of_areas, mean)
    with xr.open_dataset(mean) as told:
        assert told.area_name.values.tolist() == ["Süd", "unseen"]
        assert told.mean_change.values[0, 0] == 0.25
        assert np.isnan(told.mean_change.values[0, 1])


@contextmanager
def replaced_again_and_again(series):
    """Build the series in another process, as in life: HDF5 is one lock within a process."""
    program = (
        "import sys, pickle; from station.archive.made import NOTE\n"
        "from station.archive.series import build_series\n"
        "series = pickle.loads(bytes.fromhex(sys.argv[1]))\n"
        "while True:\n"
        "    (series.folder / NOTE).unlink(missing_ok=True)\n"  # else there is nothing to do
        "    build_series(series)\n"
    )
    writer = subprocess.Popen([sys.executable, "-c", program, pickle.dumps(series).hex()])
    before = series.path.stat().st_ino
    try:
        while series.path.stat().st_ino == before:
            assert writer.poll() is None
        yield
        assert writer.poll() is None
    finally:
        writer.kill()
        writer.wait()


@pytest.mark.parametrize("engine", ["netcdf4", pytest.param("h5netcdf", marks=pytest.mark.slow)])
def test_xarray_while_the_series_is_replaced(built, series, engine):
    with replaced_again_and_again(series):
        for _ in range(6):
            with xr.open_dataset(built, engine=engine) as told:
                assert told.elevation_change[:, 5, 5].values == pytest.approx([0, 0.01, 0.02, 0.03], abs=1e-3)


def test_other_programs_while_the_series_is_replaced(built, series):
    ncdump, cdo, gdal = tool("ncdump"), tool("cdo"), tool("gdalinfo")
    with replaced_again_and_again(series):
        for _ in range(5):
            assert "elevation_change(time, y, x)" in run(ncdump, "-h", built).stdout
            assert "elevation_change" in run(cdo, "infon", built).stdout
            assert 'ID["EPSG",32632]' in run(gdal, f"NETCDF:{built}:elevation_change").stdout


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
