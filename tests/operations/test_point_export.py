"""Exported clouds lie where the station measured: their own gridding gives the stored change."""

import subprocess
import sys

import laspy
import netCDF4
import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator
from support import tiny_station

import station
from station.config import read_site
from station.errors import StationError
from station.operations.point_export import export_points
from station.products.area_tables import Span

pytestmark = pytest.mark.integration


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
        points = reader.query()
    fields = ("gps_time", "X", "Y", "Z", "intensity", "elevation_change", "quality")
    rows = [np.stack([np.asarray(cloud[name], float) for name in fields]) for cloud in (expected, points)]
    ordered = [row[:, np.lexsort(row[::-1])] for row in rows]
    np.testing.assert_array_equal(*ordered)


def test_a_span_without_epochs_and_a_missing_scan_are_told(processed, tmp_path):
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
