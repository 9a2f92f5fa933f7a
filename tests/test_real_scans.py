"""Real scans through the command line, against an independent computation."""

import json
import shutil
import subprocess
import sys

import laspy
import numpy as np
import pytest
import xarray as xr

import station

SITE = """
[station]
id = "real"
data = "data"
[scans]
inbox = "inbox"
frame = "{frame}"
point_time = "{time}"
[scanner]
model = "riegl-vz-400i"
[[sop]]
from = 2000-01-01T00:00:00Z
file = "sop.dat"
[map]
{map}
[grid]
bounds_m = {{ west = {west}, south = {south}, east = {east}, north = {north} }}
cell_m = {cell}
"""


def run(*arguments):
    return subprocess.run([sys.executable, "-m", "station.cli", *map(str, arguments)],
                          capture_output=True, text=True, check=False, timeout=120)  # fmt: skip


def built(folder, source, stem, sop, **settings):
    (folder / "inbox").mkdir()
    scan = folder / "inbox" / f"{stem}.laz"
    shutil.copy(source, scan)
    np.savetxt(folder / "sop.dat", sop, fmt="%.16g")
    (folder / "site.toml").write_text(SITE.format(**settings))
    return folder / "site.toml", scan


def independent(xyz, settings):
    """Mean and count per cell by a two-dimensional histogram."""
    west, south, east, north, cell = (settings[key] for key in ("west", "south", "east", "north", "cell"))
    nx, ny = round((east - west) / cell), round((north - south) / cell)
    column = np.floor((xyz[0] - west) / cell).astype(int)
    row = np.floor((north - xyz[1]) / cell).astype(int)
    inside = (column >= 0) & (column < nx) & (row >= 0) & (row < ny)
    place = row[inside] * nx + column[inside]
    count = np.bincount(place, minlength=nx * ny)
    total = np.bincount(place, xyz[2][inside], minlength=nx * ny)
    with np.errstate(invalid="ignore"):
        return (total / count).reshape(ny, nx), count.reshape(ny, nx)


def agrees(folder, xyz, settings):
    mean, count = independent(xyz, settings)
    with station.open(folder / "data") as told:
        assert told.sizes["time"] == 1
        assert np.array_equal(told.point_count[0], count)
        assert np.array_equal(np.isnan(told.elevation[0]), count == 0)
        stored = (np.rint(mean * 1024) / 1024).astype(np.float32)
        off = np.abs(told.elevation[0].values - stored)[count > 0]
        assert off.max() < 1.5 / 1024
        assert np.mean(off > 0.1 / 1024) < 2e-3  # a mean on the border between two digits may fall either way
        assert np.isfinite(told.elevation_change_random_uncertainty[0].values[count > 0]).all()
        assert (told.quality[0].values[count > 0] & 4).all()


def test_terrestrial_scan_in_the_scanners_frame_without_time(shared_data, tmp_path):
    """VZ-400i in a forest, through a leaning, turned SOP into a local map."""
    from scipy.spatial.transform import Rotation

    sop = np.eye(4)
    sop[:3, :3] = Rotation.from_euler("xyz", [0.05, -0.02, 1.0]).as_matrix()
    sop[:3, 3] = (500.0, 800.0, 120.0)
    settings = {"west": 485.0, "south": 785.0, "east": 515.0, "north": 815.0, "cell": 0.25}
    site, scan = built(
        tmp_path, shared_data / "tls" / "vz400i_forest.laz", "200801_120000", sop,
        frame="scanner", time="none", map="", **settings,
    )  # fmt: skip
    done = run("process", site, scan)
    assert done.returncode == 0, done.stderr
    assert "200801_120000.laz: good" in done.stdout
    points = laspy.read(scan)
    agrees(tmp_path, sop[:3, :3] @ points.xyz.T + sop[:3, 3:], settings)


def test_airborne_scan_on_the_map(shared_data, tmp_path):
    """LAZ 1.4 with a compound CRS and adjusted standard GPS time; its name says nothing of when."""
    source = shared_data / "als" / "coromandel_points.laz"
    points = laspy.read(source)
    low = np.floor(points.xyz.min(axis=0))
    settings = {"west": low[0], "south": low[1], "east": low[0] + 400, "north": low[1] + 300, "cell": 2.0}
    site, scan = built(
        tmp_path, source, "coromandel_points", np.eye(4),
        frame="map", time="auto", map='crs = "EPSG:2193"', **settings,
    )  # fmt: skip
    done = run("process", site, scan)
    assert done.returncode == 0, done.stderr
    agrees(tmp_path, points.xyz.T, settings)
    with xr.open_dataset(tmp_path / "data" / "series.nc") as told:
        earliest = np.datetime64("1980-01-06") + np.timedelta64(round(points.gps_time.min() + 1e9 - 18), "s")
        assert abs((told.time_bnds.values[0, 0] - earliest) / np.timedelta64(1, "s")) < 5
        assert told.crs.attrs["crs_wkt"].find('ID["EPSG",2193]') > 0


@pytest.mark.parametrize(
    "name", ["garbage_nVariableLength.las", "simple-laszip-compressor-version-1.2r0.laz", "1.2-no-points.las"]
)
def test_hostile_files_are_set_aside_with_a_reason(shared_data, tmp_path, name):
    settings = {"west": 0.0, "south": 0.0, "east": 100.0, "north": 100.0, "cell": 1.0}
    site, scan = built(
        tmp_path, shared_data / "las_samples" / name, "200801_120000", np.eye(4),
        frame="map", time="none", map="", **settings,
    )  # fmt: skip
    if name.endswith(".las"):
        scan = scan.rename(scan.with_suffix(".las"))
    done = run("process", site, scan)
    assert done.returncode == 3
    assert f"{scan.name}: set aside: " in done.stdout
    reason = (tmp_path / "data" / "set_aside" / f"{scan.name}.txt").read_text()
    assert len(reason) > len(scan.name) + 20
    assert "Traceback" not in done.stderr


def test_check_measures_the_newest_scan_without_storing_it(shared_data, tmp_path):
    settings = {"west": -15.0, "south": -15.0, "east": 15.0, "north": 15.0, "cell": 0.5}
    site, _ = built(
        tmp_path, shared_data / "tls" / "vz400i_forest.laz", "200801_120000", np.eye(4),
        frame="scanner", time="none", map="", **settings,
    )  # fmt: skip
    done = run("check", site, "--json")
    findings = {finding["what"]: finding for finding in json.loads(done.stdout)}
    assert done.returncode == 0
    assert "points=1046843" in findings["scan"]["says"]
    assert not list((tmp_path / "data").rglob("*.nc")) if (tmp_path / "data").exists() else True
