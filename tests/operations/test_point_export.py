"""Exported clouds lie where the station measured: their own gridding gives the stored change."""

import os
import subprocess
import sys

import laspy
import netCDF4
import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator
from support import tiny_station
from support.programs import readers_python, run, tool

import station
from station.config import read_site
from station.errors import StationError
from station.operations.point_export import export_points
from station.products.area_tables import Span

pytestmark = pytest.mark.integration
M3C2 = """
import sys
import numpy as np
import py4dgeo
first, second, places, radius_m, out = sys.argv[1:]
places = np.loadtxt(places, ndmin=2)
up = np.tile([[0.0, 0.0, 1.0]], (len(places), 1))
clouds = py4dgeo.read_from_las(first), py4dgeo.read_from_las(second)
m3c2 = py4dgeo.M3C2(epochs=clouds, corepoints=places, corepoint_normals=up,
                    cyl_radius=float(radius_m), max_distance=50.0)
np.savetxt(out, m3c2.run()[0])
"""


@pytest.fixture(scope="module")
def processed(tmp_path_factory):
    folder = tiny_station.build(tmp_path_factory.mktemp("clouds") / "station", method="joint", hours=3)
    (folder / "inbox").rmdir()
    (folder / tiny_station.PENDING).rename(folder / "inbox")
    scans = sorted((folder / "inbox").glob("*.laz"))
    subprocess.run(
        [sys.executable, "-m", "station", "process", folder / "site.toml", *scans],
        check=True, capture_output=True, timeout=300,
    )  # fmt: skip
    return folder


def test_clouds_give_the_stored_change(processed, tmp_path):
    site = read_site(processed / "site.toml")
    grid, epochs = site.grid_cells, station.open(processed / "data")
    with netCDF4.Dataset(processed / "data" / "reference.nc") as file:
        surface_m = np.ma.filled(file["reference_elevation"][:].astype(float), np.nan)
        mean_residual_m = np.ma.filled(file["reference_mean_residual"][:].astype(float), np.nan)
    reference = RegularGridInterpolator((grid.y_m[::-1], grid.x_m), surface_m[::-1], bounds_error=False)
    paths = list(export_points(site, Span.parse(None, None), tmp_path))
    assert len(paths) == 3
    for index, path in enumerate(paths):
        cloud, epoch = laspy.read(path), epochs.isel(time=index)
        x_m, y_m, z_m = (np.asarray(axis) for axis in (cloud.x, cloud.y, cloud.z))
        column = ((x_m - grid.west_m) / grid.cell_m).astype(int)
        row = ((grid.north_m - y_m) / grid.cell_m).astype(int)
        residual_m = z_m - reference((y_m, x_m))
        known = np.isfinite(residual_m)
        cell = (row * grid.nx + column)[known]
        count = np.bincount(cell, minlength=grid.nx * grid.ny).reshape(grid.shape)
        total_m = np.bincount(cell, residual_m[known], grid.nx * grid.ny).reshape(grid.shape)
        change_m = total_m / np.maximum(count, 1) - mean_residual_m
        stored_m = epoch["elevation_change"].to_numpy()
        whole = (count > 0) & (count == epoch["point_count"].to_numpy()) & np.isfinite(stored_m)
        assert whole.sum() > 0.5 * np.isfinite(stored_m).sum()
        error_m = np.abs(change_m - stored_m)[whole]
        half_step_m = (
            epoch["elevation_change_random_uncertainty"].to_numpy()[whole] / 8
        )  # of stored values, at most
        assert np.percentile(error_m - 1.05 * half_step_m, 95) < 0.0005
        np.testing.assert_array_equal(cloud["elevation_change"], stored_m[row, column])
        np.testing.assert_array_equal(cloud["quality"], epoch["quality"].to_numpy()[row, column])
        assert cloud.header.parse_crs().to_epsg() == 32632
        assert np.ptp(cloud.gps_time) > 30


def test_an_octree_has_the_points_of_the_cloud(processed, tmp_path):
    site = read_site(processed / "site.toml")
    (plain,) = export_points(site, None, tmp_path)
    (path,) = export_points(site, None, tmp_path, file_format="copc")
    assert path.name == plain.name.replace(".laz", ".copc.laz")
    assert not list(tmp_path.glob(".*"))
    expected = laspy.read(plain)
    with laspy.CopcReader.open(str(path)) as reader:
        assert reader.header.parse_crs().to_epsg() == 32632
        (described,) = reader.header.vlrs.get("ExtraBytesVlr")
        assert [(field.min, field.max) for field in described.extra_bytes_structs] == [(None, None)] * 3
        points = reader.query()
    fields = ("gps_time", "X", "Y", "Z", "intensity", "elevation_change", "quality")
    rows = [np.stack([np.asarray(cloud[name], float) for name in fields]) for cloud in (expected, points)]
    ordered = [row[:, np.lexsort(row[::-1])] for row in rows]
    np.testing.assert_array_equal(*ordered)


def test_laszip_and_cloudcompare_read_the_points_that_were_written(processed, tmp_path):
    """LASzip is what PDAL and CloudCompare decode LAZ with; Debian's CloudCompare has no LAS, but PLY."""
    pytest.importorskip("laszip")
    plyfile, program = pytest.importorskip("plyfile"), tool("CloudCompare")
    (path,) = export_points(read_site(processed / "site.toml"), None, tmp_path)
    expected = laspy.read(path, laz_backend=laspy.LazBackend.Lazrs)
    actual = laspy.read(path, laz_backend=laspy.LazBackend.Laszip)
    assert len(actual.points) > 1000
    for name in expected.point_format.dimension_names:
        np.testing.assert_array_equal(actual[name], expected[name], name)
    columns = [*np.asarray(actual.xyz).T, np.asarray(actual["elevation_change"])]
    records = np.rec.fromarrays(columns, names=["x", "y", "z", "scalar_elevation_change"])
    plyfile.PlyData([plyfile.PlyElement.describe(np.asarray(records), "vertex")]).write(
        str(tmp_path / "a.ply")
    )
    subprocess.run(
        [program, "-SILENT", "-NO_TIMESTAMP", "-AUTO_SAVE", "OFF", "-C_EXPORT_FMT", "ASC", "-PREC", "4",
         "-O", "-GLOBAL_SHIFT", "AUTO", tmp_path / "a.ply", "-SAVE_CLOUDS", "FILE", tmp_path / "a.asc"],
        check=True, capture_output=True, timeout=120, env={**os.environ, "QT_QPA_PLATFORM": "offscreen"},
    )  # fmt: skip
    opened = np.loadtxt(tmp_path / "a.asc")
    np.testing.assert_allclose(opened[:, :3], actual.xyz, rtol=0, atol=0.001)  # CloudCompare has floats
    np.testing.assert_allclose(opened[:, 3], columns[3], rtol=0, atol=0.0001, equal_nan=True)


def test_m3c2_of_py4dgeo_finds_the_stored_change(processed, tmp_path, monkeypatch):
    """Vertical M3C2 in a cylinder as wide as a cell, between clouds of two hours: within the stored sigma."""
    monkeypatch.chdir(tmp_path)  # where py4dgeo writes its log
    site = read_site(processed / "site.toml")
    grid, epochs = site.grid_cells, station.open(processed / "data")
    first, *_, second = export_points(site, Span.parse(None, None), tmp_path)
    change_m = (epochs["elevation"].isel(time=-1) - epochs["elevation"].isel(time=0)).to_numpy()
    enough = (epochs["point_count"].isel(time=[0, -1]) >= 5).all("time").to_numpy() & np.isfinite(change_m)
    row, column = np.nonzero(enough)
    height_m = epochs["elevation"].isel(time=0).to_numpy()[enough]
    np.savetxt(tmp_path / "places", np.column_stack([grid.x_m[column], grid.y_m[row], height_m]))
    arguments = first, second, tmp_path / "places", grid.cell_m / 2, tmp_path / "distances"
    run(readers_python(), "-c", M3C2, *map(str, arguments))
    distance_m = np.loadtxt(tmp_path / "distances")
    found = np.isfinite(distance_m)
    assert found.sum() > 20
    sigma_m = np.hypot(
        *epochs["elevation_change_random_uncertainty"].isel(time=[0, -1]).to_numpy()[:, enough]
    )
    z = (distance_m - change_m[enough])[found] / sigma_m[found]
    assert abs(np.median(z)) < 0.4
    assert 0.2 < 1.4826 * np.median(np.abs(z)) < 1.5


def test_a_span_without_epochs_and_a_missing_scan_are_reported(processed, tmp_path):
    site = read_site(processed / "site.toml")
    with pytest.raises(StationError, match="no epoch in this span"):
        list(export_points(site, Span.parse("2030-01-01", None), tmp_path))
    scan = processed / "inbox" / f"{tiny_station.scan_name(2)}.laz"
    scan.rename(processed / "hidden")
    try:
        with pytest.raises(StationError, match="250715_020000 is neither in the inbox nor archived"):
            list(export_points(site, None, tmp_path))
    finally:
        (processed / "hidden").rename(scan)
