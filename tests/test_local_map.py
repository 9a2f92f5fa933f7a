"""A station without an SOP: its map is local, level by the inclination log, and all exports are valid."""

import json
import re
import subprocess
import sys

import laspy
import numpy as np
import pytest
import rasterio
from support import tiny_station

import station
from station.config import read_site
from station.errors import ConfigError
from station.operations.site_check import _folders, site_findings
from station.processing.pipeline import to_map
from station.processing.scans.epoch_inputs import load_scan_inputs
from station.processing.scans.open_scans import open_scan_for
from station.processing.scans.scan_files import scan_file
from station.readers.sop import read_matrix
from station.service.store_repair import require_same_map

BOUNDS = "bounds_m = { west = -5000.0, south = -5000.0, east = 5000.0, north = 5000.0 }"
SOP = '[[sop]]\nfrom = 2025-07-14T23:00:00Z\nfile = "sop.dat"\n'
REGISTRATION = """[registration]
suffix = ".dat"
into = "{into}"
use = "given"
sigma_m = 0.01
sigma_deg = 0.001
"""
TABLE = r"(?ms)^\[\[?{}\]?\].*?(?=^\[|\Z)"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tiny_station.build(tmp_path_factory.mktemp("local") / "station", hours=3)
    (folder / "inbox").rmdir()
    (folder / tiny_station.PENDING).rename(folder / "inbox")
    text = (folder / "site.toml").read_text()
    for name in ("sop", "map", "areas"):
        text = re.sub(TABLE.format(name), "", text)
    text = re.sub(r"bounds_m = .*", BOUNDS, text).replace("cell_m = 25.0", "cell_m = 50.0")
    text = text.replace('mode = "relative"', 'mode = "absolute"').replace("stable.geojson", "auto")
    (folder / "site.toml").write_text(text)
    return folder


@pytest.fixture(scope="module")
def processed(folder):
    subprocess.run(
        [sys.executable, "-m", "station", "process", folder / "site.toml", *folder.glob("inbox/*.laz")],
        check=True, capture_output=True, timeout=300,
    )  # fmt: skip
    return folder


def test_the_log_makes_the_map_level(folder):
    """The true SOP, which the station does not see, contains the tilt of the mount during the first scan."""
    site = read_site(folder / "site.toml")
    scan = folder / "inbox" / f"{tiny_station.scan_name(0)}.laz"
    true_rotation = read_matrix(folder / "sop.dat")[:3, :3]
    with open_scan_for(site, scan_file(site, scan)) as opened:
        inputs = load_scan_inputs(site, opened, save_tilt_offset=False)
        shots = next(iter(inputs.shots(opened, "none")))
        local_m = to_map(shots, inputs.pose)
    scanner_m = np.asarray(shots.xyz_m, dtype=float)
    true_height_m = (true_rotation @ scanner_m)[2]
    range_m = np.linalg.norm(scanner_m, axis=0)
    tilt_deg = np.degrees(np.abs(local_m[2] - true_height_m) / range_m)
    untouched_deg = np.degrees(np.abs(scanner_m[2] - true_height_m) / range_m)
    assert tilt_deg.max() < 0.05  # the errors of the sensor
    assert untouched_deg.max() > 0.5  # the tilt of the mount
    assert (inputs.geometry.position_m, inputs.provenance["sop_id"]) == ((0.0, 0.0, 0.0), "local")


@pytest.mark.integration
def test_check_says_where_the_map_is(folder):
    findings = {finding["what"]: finding for finding in site_findings(folder / "site.toml")}
    assert findings["map"]["level"] == "ok"
    assert "its origin at the scanner" in findings["map"]["message"]
    assert "sop" not in findings


@pytest.mark.integration
def test_products_of_a_local_map_are_valid(processed, tmp_path):
    for kind in ("geotiff", "stac", "csv", "points", "netcdf", "ncml", "erddap"):
        out = tmp_path / kind / {"netcdf": "a.nc", "ncml": "a.ncml", "erddap": "a.xml"}.get(kind, "")
        (tmp_path / kind).mkdir()
        subprocess.run(
            [sys.executable, "-m", "station", "export", processed / "site.toml", kind, out],
            check=True, capture_output=True, timeout=300,
        )  # fmt: skip
    with rasterio.open(next((tmp_path / "geotiff").glob("*_change.tif"))) as raster:
        assert raster.crs is None
        assert tuple(raster.bounds) == (-5000.0, -5000.0, 5000.0, 5000.0)
    item = json.loads(next((tmp_path / "stac").glob("*/*/*.json")).read_text())
    assert (item["geometry"], item["properties"]["proj:code"]) == (None, None)
    assert "bbox" not in item  # STAC 1.0: prohibited without a geometry
    cloud = laspy.read(next((tmp_path / "points").glob("*.laz")))
    assert cloud.header.parse_crs() is None
    ds = station.open(processed / "data")
    assert "crs" not in ds.variables
    assert "grid_mapping" not in ds.elevation.attrs


@pytest.mark.integration
def test_a_later_sop_needs_a_new_folder(processed):
    path = processed / "with_sop.toml"
    path.write_text((processed / "site.toml").read_text() + SOP)
    require_same_map(read_site(processed / "site.toml"))
    with pytest.raises(
        ConfigError, match=r"is of a map without an .* new folder and process the scans again"
    ):
        require_same_map(read_site(path))
    faults = [finding["message"] for finding in _folders(read_site(path)) if finding["level"] == "fault"]
    assert len(faults) == 1
    assert "give station.data a new folder" in faults[0]  # `station check` tells it as well


@pytest.mark.integration
def test_matrices_place_scans_on_the_map_that_is_the_frame_of_the_first(folder, tmp_path):
    """Turned scans with their matrices are measured as those that were not turned, to 0.25 mm of a point."""
    angle_rad = np.radians(3.0)
    turn = np.eye(4)
    turn[:2, :2] = [[np.cos(angle_rad), -np.sin(angle_rad)], [np.sin(angle_rad), np.cos(angle_rad)]]
    turn[:3, 3] = 0.5, -0.25, 0.125
    text = re.sub(TABLE.format("inclination"), "", (folder / "site.toml").read_text())
    section = REGISTRATION.format(into="scanner")
    series = []
    for name, more, matrix in (("still", "", np.eye(4)), ("turned", section, turn)):
        inbox = tmp_path / name / "inbox"
        inbox.mkdir(parents=True)
        (inbox.parent / "site.toml").write_text(f"{text}\n{more}")
        back = np.linalg.inv(matrix)
        for scan in sorted((folder / "inbox").glob("*.laz"))[:2]:
            points = laspy.read(scan)
            points.x, points.y, points.z = (
                back[:3, :3] @ np.stack([points.x, points.y, points.z]) + back[:3, 3:]
            )
            points.write(inbox / scan.name)
            if more:
                np.savetxt(inbox / f"{scan.stem}.dat", matrix, fmt="%.12f")
        command = [
            sys.executable,
            "-m",
            "station",
            "process",
            inbox.parent / "site.toml",
            *inbox.glob("*.laz"),
        ]
        subprocess.run(command, check=True, capture_output=True, timeout=300)
        series.append(station.open(inbox.parent / "data"))
    still, turned = series
    same = (still["point_count"] == turned["point_count"]).to_numpy()
    assert same.mean() > 0.99
    difference_m = (turned["elevation"] - still["elevation"]).to_numpy()[same]
    assert np.isfinite(difference_m).any()
    assert np.nanmax(np.abs(difference_m)) < 0.005


def test_what_a_registration_without_an_sop_needs(folder):
    text = (folder / "site.toml").read_text()

    def read(into, mode):
        path = folder / "registered.toml"
        path.write_text(f"{text.replace('absolute', mode)}\n{REGISTRATION.format(into=into)}")
        return read_site(path)

    assert read("scanner", "relative").registration.into == "scanner"
    with pytest.raises(ConfigError, match=r"one of the matrices will do"):
        read("project", "relative")
    with pytest.raises(
        ConfigError, match=r'the frame of the registration: set inclination\.mode = "relative"'
    ):
        read("scanner", "absolute")
