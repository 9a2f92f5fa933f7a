"""Real scans processed by the commands, compared with an independent gridding."""

import json
import shutil
import subprocess
import sys

import laspy
import numpy as np
import pytest
import xarray as xr

import station

pytestmark = pytest.mark.integration

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
    return subprocess.run([sys.executable, "-m", "station", *map(str, arguments)],
                          capture_output=True, text=True, check=False, timeout=120)  # fmt: skip


def write_station(folder, source, stem, sop, **settings):
    (folder / "inbox").mkdir()
    scan = folder / "inbox" / f"{stem}.laz"
    shutil.copy(source, scan)
    np.savetxt(folder / "sop.dat", sop, fmt="%.16g")
    (folder / "site.toml").write_text(SITE.format(**settings))
    return folder / "site.toml", scan


def ground_of(las):
    """Return the last returns that are not classified as noise; no point of these scans is withheld."""
    last = np.asarray(las.return_number) == np.asarray(las.number_of_returns)
    return las[last & ~np.isin(np.asarray(las.classification), (7, 18))]


def surface_of(cell_index, height_m, thickness_m):
    """Return the points of the fullest run of adjacent layers of their cell, by plain loops."""
    layer = np.rint(height_m / thickness_m).astype(int)
    counts = {}
    for cell, number in zip(cell_index.tolist(), layer.tolist(), strict=True):
        counts.setdefault(cell, {0: 0}).setdefault(number, 0)
        counts[cell][number] += 1
    kept = {}
    for cell, layers in counts.items():
        runs = []
        for number in sorted(layers):
            if not runs or number > runs[-1][-1] + 1:
                runs.append([])
            runs[-1].append(number)
        kept[cell] = set(max(runs, key=lambda run: sum(layers[number] for number in run)))
    pairs = zip(cell_index.tolist(), layer.tolist(), strict=True)
    return np.array([number in kept[cell] for cell, number in pairs])


def grid_independently(xyz, settings, datum_m):
    """Mean elevation and point count of the surface per cell (ny, nx), from a two-dimensional histogram."""
    west, south, east, north, cell = (settings[key] for key in ("west", "south", "east", "north", "cell"))
    nx, ny = round((east - west) / cell), round((north - south) / cell)
    column = np.floor((xyz[0] - west) / cell).astype(int)
    row = np.floor((north - xyz[1]) / cell).astype(int)
    inside = (column >= 0) & (column < nx) & (row >= 0) & (row < ny)
    cell_index = row[inside] * nx + column[inside]
    kept = surface_of(cell_index, xyz[2][inside] - datum_m, max(2.0, 2 * cell))
    cell_index, inside = cell_index[kept], np.flatnonzero(inside)[kept]
    count = np.bincount(cell_index, minlength=nx * ny)
    total = np.bincount(cell_index, xyz[2][inside], minlength=nx * ny)
    with np.errstate(invalid="ignore"):
        return (total / count).reshape(ny, nx), count.reshape(ny, nx)


def assert_equals_independent_gridding(folder, xyz, settings, datum_m):
    mean, count = grid_independently(xyz, settings, datum_m)
    with station.open(folder / "data") as dataset:
        assert dataset.sizes["time"] == 1
        assert np.array_equal(dataset.point_count[0], count)
        assert np.array_equal(np.isnan(dataset.elevation[0]), count == 0)
        deviation = np.abs(dataset.elevation[0].values - mean)[count > 0]
        sigma_m = dataset.elevation_change_random_uncertainty[0].values[count > 0]
        assert np.isfinite(sigma_m).all()
        assert (deviation <= sigma_m / 8 * 1.05 + 0.6 / 1024).all()  # half a step, a quarter of sigma at most
        assert np.median(deviation / sigma_m) < 0.06
        assert (dataset.quality[0].values[count > 0] & 4).all()


def test_terrestrial_scan_in_scanner_frame_without_time(shared_data, tmp_path):
    """VZ-400i in a forest, with a tilted and rotated SOP, in a local map frame."""
    from scipy.spatial.transform import Rotation

    sop = np.eye(4)
    sop[:3, :3] = Rotation.from_euler("xyz", [0.05, -0.02, 1.0]).as_matrix()
    sop[:3, 3] = (500.0, 800.0, 120.0)
    settings = {"west": 485.0, "south": 785.0, "east": 515.0, "north": 815.0, "cell": 0.25}
    site, scan = write_station(
        tmp_path, shared_data / "tls" / "vz400i_forest.laz", "200801_120000", sop,
        frame="scanner", time="none", map="", **settings,
    )  # fmt: skip
    result = run("process", site, scan)
    assert result.returncode == 0, result.stderr
    assert "200801_120000.laz: good" in result.stdout
    assert "(no brightness: snow on stable ground cannot be recognised)" in result.stdout
    points = ground_of(laspy.read(scan))
    assert_equals_independent_gridding(tmp_path, sop[:3, :3] @ points.xyz.T + sop[:3, 3:], settings, 120.0)


def test_airborne_scan_in_map_frame(shared_data, tmp_path):
    """LAZ 1.4 with a compound CRS and adjusted standard GPS time; no time in the name."""
    source = shared_data / "als" / "coromandel_points.laz"
    points = ground_of(laspy.read(source))
    low = np.floor(points.xyz.min(axis=0))
    settings = {"west": low[0], "south": low[1], "east": low[0] + 400, "north": low[1] + 300, "cell": 2.0}
    site, scan = write_station(
        tmp_path, source, "coromandel_points", np.eye(4),
        frame="map", time="auto", map='crs = "EPSG:2193"', **settings,
    )  # fmt: skip
    result = run("process", site, scan)
    assert result.returncode == 0, result.stderr
    assert_equals_independent_gridding(tmp_path, points.xyz.T, settings, 0.0)
    with xr.open_dataset(tmp_path / "data" / "series.nc") as dataset:
        earliest = np.datetime64("1980-01-06") + np.timedelta64(round(points.gps_time.min() + 1e9 - 18), "s")
        assert abs((dataset.time_bnds.values[0, 0] - earliest) / np.timedelta64(1, "s")) < 5
        assert dataset.crs.attrs["crs_wkt"].find('ID["EPSG",2193]') > 0


@pytest.mark.parametrize(
    "name", ["garbage_nVariableLength.las", "simple-laszip-compressor-version-1.2r0.laz", "1.2-no-points.las"]
)
def test_hostile_files_are_set_aside_with_a_reason(shared_data, tmp_path, name):
    settings = {"west": 0.0, "south": 0.0, "east": 100.0, "north": 100.0, "cell": 1.0}
    site, scan = write_station(
        tmp_path, shared_data / "las_samples" / name, "200801_120000", np.eye(4),
        frame="map", time="none", map="", **settings,
    )  # fmt: skip
    if name.endswith(".las"):
        scan = scan.rename(scan.with_suffix(".las"))
    result = run("process", site, scan)
    assert result.returncode == 3
    assert f"{scan.name}: set aside: " in result.stdout
    reason = (tmp_path / "data" / "set_aside" / f"{scan.name}.txt").read_text()
    assert len(reason) > len(scan.name) + 20
    assert "Traceback" not in result.stderr


def test_check_processes_the_newest_scan_without_storing_it(shared_data, tmp_path):
    settings = {"west": -15.0, "south": -15.0, "east": 15.0, "north": 15.0, "cell": 0.5}
    site, _ = write_station(
        tmp_path, shared_data / "tls" / "vz400i_forest.laz", "200801_120000", np.eye(4),
        frame="scanner", time="none", map="", **settings,
    )  # fmt: skip
    result = run("check", site, "--json")
    findings = {finding["what"]: finding for finding in json.loads(result.stdout)}
    assert result.returncode == 0
    assert "points=1046843" in findings["scan"]["message"]
    assert not list((tmp_path / "data").rglob("*.nc")) if (tmp_path / "data").exists() else True
