"""A simulated station as a whole: its points lie on its truth, its files are what a station reads."""

from __future__ import annotations

from dataclasses import fields, replace

import laspy
import numpy as np
import pyproj
import pytest
import xarray as xr

from station.config import read_site
from station.errors import ConfigError, StoreError
from station.simulation import truth
from station.simulation.motion import sop
from station.simulation.scenario import ERRORS
from station.simulation.station import Scenario, Station, demo, simulate, tiny

LATITUDE, LONGITUDE, HEIGHT = 46.7958, 10.7828, 3245.0


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Give a small station with everything switched on."""
    folder = tmp_path_factory.mktemp("simulated") / "station"
    simulate(folder, tiny())
    return folder


def to_map(enu):
    """Turn east-north-up into EPSG:32632 and ellipsoidal height by plain matrices and pyproj."""
    lat, lon = np.radians(LATITUDE), np.radians(LONGITUDE)
    east = np.array([-np.sin(lon), np.cos(lon), 0])
    north = np.array([-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)])
    up = np.cross(east, north)
    ecef = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978")
    mark = np.array(ecef.transform(LATITUDE, LONGITUDE, HEIGHT))
    there = mark + enu @ np.stack((east, north, up))
    latitude, longitude, height = ecef.transform(*there.T, direction="INVERSE")
    easting, northing = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:32632").transform(latitude, longitude)
    return easting, northing, height


@pytest.mark.parametrize("scenario", [tiny(), demo()], ids=["tiny", "demo"])
def test_without_errors_points_lie_on_the_truth_to_a_millimetre(scenario):
    station = Station(replace(scenario.without_errors(), lines=60, shots_per_line=100))
    got = station.scan(0)
    matrix = sop(station.scenario)
    points = np.stack((got.x_m, got.y_m, got.z_m), axis=1) @ matrix[:3, :3].T + matrix[:3, 3]
    easting, northing, height = to_map(points)
    grid = truth.grid_of(station.scenario)
    inside = (np.abs(easting - grid.x_m.mean()) < np.ptp(grid.x_m) / 2) & (
        np.abs(northing - grid.y_m.mean()) < np.ptp(grid.y_m) / 2
    )
    chosen = np.random.default_rng(1).permutation(np.flatnonzero(inside))[:150]
    e, n = np.argsort(easting[chosen]), np.argsort(northing[chosen])
    mesh = truth.heights(station.ground(0), truth.plumb_lines(grid), northing[chosen][n], easting[chosen][e])
    true = mesh[np.argsort(n), np.argsort(e)]
    assert len(chosen) == 150
    assert np.abs(height[chosen] - true).max() < 1e-3


def test_true_elevation_is_the_mean_over_the_cell_and_follows_the_ground():
    station = Station(replace(tiny(), snowfall_m=0.4, snow_hours=(0.0, 2.0)))
    surface, grid = station.surface, station.surface.grid
    lines = truth.plumb_lines(grid)
    share = (np.arange(40) + 0.5) / 40 - 0.5
    rng = np.random.default_rng(2)
    off = []
    for row, column in zip(rng.integers(grid.ny, size=25), rng.integers(grid.nx, size=25), strict=True):
        northing, easting = grid.y_m[row] + share * 5, grid.x_m[column] + share * 5
        for scan in (0, 2):
            mean = truth.heights(station.ground(scan), lines, northing, easting).mean()
            told = surface.elevation_m[row, column]
            told += surface.change_m(station.happening, station.scenario.hours_at(scan))[row, column]
            off.append(told - mean)
    assert np.abs(off).max() < 5e-3  # on a sharp crest
    assert np.median(np.abs(off)) < 3e-4


def test_the_surface_changes_where_and_when_it_is_told(folder):
    with xr.open_dataset(folder / "truth.nc") as told:
        stable = told.stable.to_numpy() == 1
        assert 0.3 < stable.mean() < 0.9
        assert np.abs(told.change.to_numpy()[:, stable]).max() == 0
        change = told.change.to_numpy()
        assert change[2].max() == pytest.approx(1.5, abs=0.1)  # the deposit of hour 2
        assert change[1].max() < 1e-3
        assert change[2].min() < -0.5  # the slab that broke off
        melted = change[1] - change[0]
        assert melted.min() == pytest.approx(-0.02, abs=0.002)  # an hour at the tongue's end
        np.testing.assert_allclose(told.elevation - told.unchanged_elevation, change, atol=2e-4)


def test_snow_lies_where_it_is_not_steep():
    station = Station(replace(tiny().without_errors(), snowfall_m=0.5, snow_hours=(0.0, 1.0)))
    grew = station.ground(2).node - station.ground(0).node * 1.0
    down, across = np.gradient(station.place.ground.node, 2.0)
    slope = np.degrees(np.arctan(np.hypot(across, down)))
    assert np.abs(grew[slope > 50]).max() == 0
    gentle = station.ground(2).node[slope < 40] - station.place.ground.node[slope < 40]
    assert gentle.mean() == pytest.approx(0.5, rel=0.1)
    assert gentle.std() > 0.05  # patchy


def test_scan_looks_like_hintereisferner():
    station = Station(demo())
    got = station.scan(0)
    points = got.true_m
    inside = np.linalg.norm(points, axis=1)
    assert 130_000 < len(inside) < 200_000
    ground = station.place.ground
    ice = station.place.ice.at(points[:, 0], points[:, 1]) > 0.5
    assert inside[ice].min() < 1000
    assert np.percentile(inside[ice], 99.9) > 3000
    _, east, north = ground.with_slope(points[:, 0], points[:, 1])
    ray = points - np.array(station.scenario.mount_position_m)
    ray /= np.linalg.norm(ray, axis=1)[:, None]
    normal = np.stack((-east, -north, np.ones_like(east)), axis=1)
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    incidence = np.degrees(np.arccos(-(ray * normal).sum(axis=1)))
    assert incidence.max() < 85.01
    assert np.percentile(incidence, 95) > 75
    # between a scanner on the ridge and the tongue there is half a kilometre of height
    assert -700 < points[ice, 2].min() < -450


def test_files_are_what_a_station_reads(folder):
    site = read_site(folder / "site.toml")
    assert site.grid_cells == truth.grid_of(tiny())
    assert site.reference.scans == 1
    scans = sorted(path.name for path in site.scans.inbox.iterdir())
    assert scans[:2] == ["250715_000000-incl.txt", "250715_000000.laz"]
    assert len(scans) == 6
    las = laspy.read(site.scans.inbox / "250715_010000.laz")
    assert las.header.version == "1.4"
    assert las.header.point_format.id == 6
    assert 15_000 < las.header.point_count < 36_000
    time = np.asarray(las.gps_time)
    assert 30 <= time[0] < 130  # the scanner's own seconds
    assert (np.diff(time) > 0).all()
    assert np.ptp(time) == pytest.approx(300, abs=10)
    text = (site.scans.inbox / "250715_010000-incl.txt").read_text().splitlines()
    assert text[0] == "Time,Roll,Pitch"
    assert all(len(value.split(".")[1]) == 3 for value in text[1].split(",")[1:])
    weather = (folder / "weather.dat").read_bytes()
    assert weather.startswith(b'"TOA5"')
    assert weather.count(b"\r\n") == weather.count(b"\n") > 240
    matrix = np.loadtxt(folder / "sop.dat")
    np.testing.assert_allclose(matrix, sop(tiny()), atol=1e-15)


def test_truth_tells_every_error_of_every_scan(folder):
    station = Station(tiny())
    with xr.open_dataset(folder / "truth.nc") as told:
        assert list(told.scan_id.to_numpy()) == ["250715_000000", "250715_010000", "250715_020000"]
        assert str(told.time.to_numpy()[1])[:16] == "2025-07-15T01:02"
        assert abs(float(told.relative_roll[0].mean())) < 2e-5
        now = station.conditions(2)
        assert float(told.range_bias[2]) == now.range_bias_m
        assert float(told.temperature[2]) == now.air.at_scanner.temperature_c
        in_the_middle = np.degrees(station.lean[1].lean(np.array([2 * 3600 + 150.0])))
        assert float(told.relative_pitch[2, 150]) == pytest.approx(in_the_middle[0])
        assert told.refraction.dims == ("time", "bearing")


def test_same_seed_same_station_other_seed_other_station(tmp_path, folder):
    simulate(tmp_path / "again", tiny())
    simulate(tmp_path / "other", tiny(seed=2))
    for path in sorted((folder / "inbox").iterdir()):
        assert (tmp_path / "again" / "inbox" / path.name).read_bytes() == path.read_bytes()
        assert (tmp_path / "other" / "inbox" / path.name).read_bytes() != path.read_bytes()


def test_a_longer_series_begins_like_a_shorter_one():
    short, long = Station(tiny(hours=2)).scan(1), Station(tiny(hours=9)).scan(1)
    np.testing.assert_array_equal(short.x_m, long.x_m)


def test_every_error_can_be_switched_off(tmp_path):
    quiet = Scenario().without_errors()
    assert {one.name for one in fields(Scenario)} >= set(ERRORS)
    assert not any(getattr(quiet, name) for name in ERRORS)
    simulate(tmp_path / "quiet", tiny(hours=1).without_errors())
    site = read_site(tmp_path / "quiet" / "site.toml")
    assert site.weather is None  # nobody corrects what is not there
    assert not (tmp_path / "quiet" / "weather.dat").exists()


def test_wrong_wishes_are_refused(tmp_path, folder):
    with pytest.raises(ConfigError, match="already holds a station"):
        simulate(folder, tiny())
    with pytest.raises(ConfigError, match="at least 1 hour"):
        tiny(hours=0)
    with pytest.raises(ConfigError, match="scan_s"):
        replace(tiny(), scan_s=3600.0)
    with pytest.raises(ConfigError, match="time zone"):
        replace(tiny(), start=tiny().start.replace(tzinfo=None))
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreError, match="cannot be written"):
        simulate(tmp_path / "file" / "below", tiny())
