"""A simulated station as a whole: its points lie on the true surface, and a station can read its files."""

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
from station.simulation.instrument.motion import sop
from station.simulation.scenario import ERRORS, Mark
from station.simulation.station import Scenario, Station, demo, simulate, small

LATITUDE, LONGITUDE, HEIGHT = 46.7958, 10.7828, 3245.0


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return the folder of a small station with every error."""
    folder = tmp_path_factory.mktemp("simulated") / "station"
    simulate(folder, small())
    return folder


def to_map(enu):
    """Return EPSG:32632 and ellipsoidal height of east-north-up, by plain matrices and pyproj."""
    lat, lon = np.radians(LATITUDE), np.radians(LONGITUDE)
    east = np.array([-np.sin(lon), np.cos(lon), 0])
    north = np.array([-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)])
    up = np.cross(east, north)
    ecef = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978")
    mark = np.array(ecef.transform(LATITUDE, LONGITUDE, HEIGHT))
    geocentric_m = mark + enu @ np.stack((east, north, up))
    latitude, longitude, height = ecef.transform(*geocentric_m.T, direction="INVERSE")
    easting, northing = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:32632").transform(latitude, longitude)
    return easting, northing, height


@pytest.mark.parametrize(
    "scenario", [small(), pytest.param(demo(), marks=pytest.mark.integration)], ids=["small", "demo"]
)
def test_points_without_errors_lie_on_the_true_surface_within_a_millimetre(scenario):
    station = Station(replace(scenario.without_errors(), lines=60, shots_per_line=100))
    scan = station.scan(0)
    matrix = sop(station.scenario)
    points = np.stack((scan.x_m, scan.y_m, scan.z_m), axis=1) @ matrix[:3, :3].T + matrix[:3, 3]
    easting, northing, height = to_map(points)
    grid = truth.grid_of(station.scenario)
    inside = (np.abs(easting - grid.x_m.mean()) < np.ptp(grid.x_m) / 2) & (
        np.abs(northing - grid.y_m.mean()) < np.ptp(grid.y_m) / 2
    )
    chosen = np.random.default_rng(1).permutation(np.flatnonzero(inside))[:150]
    e, n = np.argsort(easting[chosen]), np.argsort(northing[chosen])
    mesh = truth.surface_heights(
        station.ground(0), truth.fit_verticals(grid, Mark()), northing[chosen][n], easting[chosen][e]
    )
    true_m = mesh[np.argsort(n), np.argsort(e)]
    assert len(chosen) == 150
    assert np.abs(height[chosen] - true_m).max() < 1e-3


@pytest.mark.integration
def test_true_elevation_is_the_cell_mean_of_the_changed_ground():
    station = Station(replace(small(), snowfall_m=0.4, snow_hours=(0.0, 2.0)))
    surface, grid = station.surface, station.surface.grid
    verticals = truth.fit_verticals(grid, Mark())
    share = (np.arange(40) + 0.5) / 40 - 0.5
    rng = np.random.default_rng(2)
    errors_m = []
    for row, column in zip(rng.integers(grid.ny, size=25), rng.integers(grid.nx, size=25), strict=True):
        northing, easting = grid.y_m[row] + share * 5, grid.x_m[column] + share * 5
        for scan in (0, 2):
            mean = truth.surface_heights(station.ground(scan), verticals, northing, easting).mean()
            elevation_m = surface.elevation_m[row, column]
            elevation_m += surface.change_m(station.changes, station.scenario.hours_at(scan))[row, column]
            errors_m.append(elevation_m - mean)
    assert np.abs(errors_m).max() < 5e-3  # on a sharp crest
    assert np.median(np.abs(errors_m)) < 3e-4


@pytest.mark.integration
def test_surface_changes_at_the_time_and_place_of_the_scenario(folder):
    with xr.open_dataset(folder / "truth.nc") as dataset:
        stable = dataset.stable.to_numpy() == 1
        assert 0.3 < stable.mean() < 0.9
        assert np.abs(dataset.change.to_numpy()[:, stable]).max() == 0
        change = dataset.change.to_numpy()
        assert change[2].max() == pytest.approx(1.5, abs=0.1)  # the deposit of hour 2
        assert change[1].max() < 1e-3
        assert change[2].min() < -0.5  # the slab that was released
        melted = change[1] - change[0]
        assert melted.min() == pytest.approx(-0.02, abs=0.002)  # one hour at the end of the tongue
        np.testing.assert_allclose(dataset.elevation - dataset.unchanged_elevation, change, atol=2e-4)


def test_snow_lies_on_moderate_slopes_only():
    station = Station(replace(small().without_errors(), snowfall_m=0.5, snow_hours=(0.0, 1.0)))
    gain_m = station.ground(2).node - station.ground(0).node
    down, across = np.gradient(station.valley.ground.node, 2.0)
    slope = np.degrees(np.arctan(np.hypot(across, down)))
    assert np.abs(gain_m[slope > 50]).max() == 0
    gentle = station.ground(2).node[slope < 40] - station.valley.ground.node[slope < 40]
    assert gentle.mean() == pytest.approx(0.5, rel=0.1)
    assert gentle.std() > 0.05  # patchy


@pytest.mark.integration
def test_scan_resembles_one_of_hintereisferner():
    station = Station(demo())
    scan = station.scan(0)
    points = scan.true_m
    range_m = np.linalg.norm(points, axis=1)
    assert 130_000 < len(range_m) < 200_000
    ground = station.valley.ground
    ice = station.valley.ice.at(points[:, 0], points[:, 1]) > 0.5
    assert range_m[ice].min() < 1000
    assert np.percentile(range_m[ice], 99.9) > 3000
    _, east, north = ground.with_slope(points[:, 0], points[:, 1])
    ray = points - np.array(station.scenario.mount_position_m)
    ray /= np.linalg.norm(ray, axis=1)[:, None]
    normal = np.stack((-east, -north, np.ones_like(east)), axis=1)
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    incidence = np.degrees(np.arccos(-(ray * normal).sum(axis=1)))
    assert incidence.max() < 85.01
    assert np.percentile(incidence, 95) > 75
    # the scanner is on a ridge, half a kilometre above the tongue
    assert -700 < points[ice, 2].min() < -450


def test_files_have_the_formats_of_the_instruments(folder):
    site = read_site(folder / "site.toml")
    assert site.grid_cells == truth.grid_of(small())
    assert site.reference.scans == 1
    scans = sorted(path.name for path in site.scans.inbox.iterdir())
    assert scans[:2] == ["250715_000000-incl.txt", "250715_000000.laz"]
    assert len(scans) == 6
    las = laspy.read(site.scans.inbox / "250715_010000.laz")
    assert las.header.version == "1.4"
    assert las.header.point_format.id == 6
    assert 15_000 < las.header.point_count < 36_000
    time = np.asarray(las.gps_time)
    assert 30 <= time[0] < 130  # seconds of the scanner's clock
    assert (np.diff(time) > 0).all()
    assert np.ptp(time) == pytest.approx(300, abs=10)
    text = (site.scans.inbox / "250715_010000-incl.txt").read_text().splitlines()
    assert text[0] == "Time,Roll,Pitch"
    assert all(len(value.split(".")[1]) == 3 for value in text[1].split(",")[1:])
    weather = (folder / "weather.dat").read_bytes()
    assert weather.startswith(b'"TOA5"')
    assert weather.count(b"\r\n") == weather.count(b"\n") > 240
    matrix = np.loadtxt(folder / "sop.dat")
    np.testing.assert_allclose(matrix, sop(small()), atol=1e-15)


def test_truth_contains_every_error_of_every_scan(folder):
    station = Station(small())
    with xr.open_dataset(folder / "truth.nc") as dataset:
        assert list(dataset.scan_id.to_numpy()) == ["250715_000000", "250715_010000", "250715_020000"]
        assert str(dataset.time.to_numpy()[1])[:16] == "2025-07-15T01:02"
        assert abs(float(dataset.relative_roll[0].mean())) < 2e-5
        conditions = station.conditions(2)
        assert float(dataset.range_bias[2]) == conditions.range_bias_m
        assert float(dataset.temperature[2]) == conditions.air.at_scanner.temperature_c
        middle_deg = np.degrees(station.tilt[1].tilt(np.array([2 * 3600 + 150.0])))
        assert float(dataset.relative_pitch[2, 150]) == pytest.approx(middle_deg[0])
        assert dataset.refraction.dims == ("time", "bearing")


@pytest.mark.integration
def test_scans_depend_on_the_seed_alone(tmp_path, folder):
    simulate(tmp_path / "same", small())
    simulate(tmp_path / "other", small(seed=2))
    for path in sorted((folder / "inbox").iterdir()):
        assert (tmp_path / "same" / "inbox" / path.name).read_bytes() == path.read_bytes()
        assert (tmp_path / "other" / "inbox" / path.name).read_bytes() != path.read_bytes()


def test_scan_does_not_depend_on_the_length_of_the_series():
    short, long = (Station(replace(small(hours=hours), lines=40)).scan(1) for hours in (2, 9))
    np.testing.assert_array_equal(short.x_m, long.x_m)


def test_every_error_can_be_switched_off(tmp_path):
    quiet = Scenario().without_errors()
    assert {field.name for field in fields(Scenario)} >= set(ERRORS)
    assert not any(getattr(quiet, name) for name in ERRORS)
    scenario = replace(small(hours=1).without_errors(), lines=10, terrain_step_m=4.0)
    simulate(tmp_path / "quiet", scenario)
    site = read_site(tmp_path / "quiet" / "site.toml")
    assert site.weather is None  # without air there is nothing to correct
    assert not (tmp_path / "quiet" / "weather.dat").exists()


def test_invalid_scenarios_and_folders_raise_errors(tmp_path, folder):
    with pytest.raises(ConfigError, match="already holds a station"):
        simulate(folder, small())
    with pytest.raises(ConfigError, match="at least 1 hour"):
        small(hours=0)
    with pytest.raises(ConfigError, match="scan_s"):
        replace(small(), scan_s=3600.0)
    with pytest.raises(ConfigError, match="time zone"):
        replace(small(), start=small().start.replace(tzinfo=None))
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreError, match="cannot be written"):
        simulate(tmp_path / "file" / "below", small())
