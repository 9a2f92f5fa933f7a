"""Stations of other kinds than the valley: a snow slope before a Livox, a beach with tide."""

import tomllib
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from station.cli import app
from station.config import KINDS as SITES
from station.config import read_site, write_site
from station.simulation.instrument.motion import sop
from station.simulation.kinds import KINDS, beach, low_cost_snow, rockfall
from station.simulation.station import Station, simulate
from station.simulation.world.beach import MEAN_SEA_M, RUN_UP_M

M2_H = 12.4206  # period of the main lunar tide


@pytest.fixture(scope="module")
def sandy():
    return Station(replace(beach(hours=7), lines=120, shots_per_line=120, terrain_step_m=2.0))


@pytest.fixture(scope="module")
def snowy():
    return Station(replace(low_cost_snow(hours=1), lines=8, shots_per_line=1000, terrain_step_m=2.0))


@pytest.mark.parametrize("scan", [0, 3, 6])
def test_the_sea_gives_no_echo(sandy, scan):
    """Low water is at the start: the tide is a cosine of M2."""
    hours = scan + sandy.scenario.scan_s / 7200
    sea_m = MEAN_SEA_M + RUN_UP_M - 0.9 * np.cos(2 * np.pi * hours / M2_H)
    up_m = sandy.scan(scan).true_m[:, 2]
    assert up_m.min() == pytest.approx(sea_m, abs=0.1)
    assert up_m.min() > sea_m


def test_ground_that_the_sea_has_left_is_dark(sandy):
    """At 1550 nm wet sand reflects less than half of what dry sand does (Nolet et al., 2014)."""
    scan = sandy.scan(0)
    flat_m = np.hypot(scan.true_m[:, 0], scan.true_m[:, 1])
    sine = np.abs(scan.true_m[:, 2] - 3.0) / np.hypot(flat_m, scan.true_m[:, 2] - 3.0)  # of flat ground
    reflectance, up_m = scan.intensity / sine, scan.true_m[:, 2]
    wet, dry = up_m < MEAN_SEA_M - 0.4, (up_m > MEAN_SEA_M + 2.0) & (up_m < MEAN_SEA_M + 3.0)
    assert min(wet.sum(), dry.sum()) > 50
    assert np.median(reflectance[wet]) < 0.5 * np.median(reflectance[dry])


def test_faint_echoes_are_lost_beyond_the_reach_of_the_scanner(sandy):
    """The power of an echo falls with the square of the range: 1/4 of the reflectance at twice the range."""
    scan = sandy.scan(0)
    range_m = np.linalg.norm(scan.true_m - np.array([0.0, 0.0, 3.0]), axis=1)
    speckle = 1.6  # five standard deviations of it, and the gain
    assert (scan.intensity * speckle * (2000.0 / range_m) ** 2).min() > 0.6


def test_points_of_a_rosette_fill_the_field_of_view(snowy):
    """Two equal prisms: the distance from the middle is the cosine of half the angle between them."""
    scan = snowy.scan(1)
    azimuth_deg = np.degrees(np.arctan2(scan.y_m, scan.x_m))
    assert azimuth_deg.min() == pytest.approx(55, abs=3)
    assert azimuth_deg.max() == pytest.approx(125, abs=3)
    elapsed_s = scan.time_s - snowy.conditions(1).scanner_start_s
    share = snowy.conditions(1).start_share
    between = 2 * np.pi * ((7294 + 4664) / 60 * elapsed_s + share[0] - share[1])
    elevation_deg = np.degrees(np.arctan2(scan.z_m, np.hypot(scan.x_m, scan.y_m)))
    away = np.hypot((azimuth_deg - 90) / 35, (elevation_deg - 2) / 35)
    np.testing.assert_allclose(away, np.abs(np.cos(between / 2)), atol=1e-6)


def test_recorded_directions_have_the_error_of_the_scanner(snowy):
    """0.35° evenly distributed, and the beam: 3.5 mrad over four."""
    still = {"heading_deg": 0.0, "position_m": 0.0, "tilt_drift_deg": 0.0, "tilt_within_scan_deg": 0.0}
    scan = Station(replace(snowy.scenario, **still, sway_deg=0.0)).scan(0)
    true_m = scan.true_m - np.array(snowy.scenario.mount_position_m)
    error_rad = np.arctan2(scan.y_m, scan.x_m) - np.arctan2(true_m[:, 1], true_m[:, 0])
    cosine = np.cos(np.arctan2(scan.z_m, np.hypot(scan.x_m, scan.y_m)))
    expected = np.hypot(np.radians(0.35) / np.sqrt(12), 3.5e-3 / 4)
    assert np.std(error_rad * cosine) == pytest.approx(expected, rel=0.05)


def test_snow_lies_on_the_slope_but_not_on_the_rock(snowy):
    station = Station(replace(snowy.scenario, hours=4, terrain_step_m=2.0))
    snow_m = station.ground(23).node - station.valley.ground.node
    steepness = np.hypot(*np.gradient(station.valley.ground.node, 2.0))
    assert np.abs(snow_m[steepness > np.tan(np.radians(52))]).max() == 0
    assert np.mean(snow_m[(steepness < np.tan(np.radians(39))) & (station.valley.ice.node == 1)]) > 0.2


def test_beams_meet_the_rock_face():
    """A face to 205°: a point on it, by hand; and without errors, recorded points are where beams meet it."""
    scenario = replace(rockfall(hours=2), lines=40, shots_per_line=40, terrain_step_m=1.0).without_errors()
    station = Station(scenario)
    scan, ground = station.scan(0), station.valley.ground
    along = np.array([np.cos(np.radians(25)), -np.sin(np.radians(25)), 0.0])
    out = np.array([-np.sin(np.radians(25)), -np.cos(np.radians(25)), 0.0])
    offset_m = scan.true_m - np.array([120.0, 270.0, 40.0])
    np.testing.assert_allclose(offset_m @ out, ground.at(offset_m @ along, offset_m[:, 2]), atol=2e-5)
    recorded_m = np.stack((scan.x_m, scan.y_m, scan.z_m))
    placed_m = (sop(scenario) @ np.vstack([recorded_m, np.ones(len(scan.x_m))]))[:3]
    np.testing.assert_allclose(placed_m.T, scan.true_m, atol=1e-6)
    assert len(scan.x_m) > 1000
    assert np.linalg.norm(recorded_m, axis=0).min() > 280


def test_a_block_leaves_a_scar_and_debris():
    station = Station(replace(rockfall(hours=4), terrain_step_m=1.0))
    before, after = (station.ground(scan).node for scan in (0, 3))
    assert (after - before).min() == pytest.approx(-1.0, abs=0.05)
    assert (after - before).max() == pytest.approx(0.25, abs=0.02)
    assert np.mean(after != before) < 0.03


@pytest.mark.parametrize("kind", KINDS)
def test_site_file_of_a_simulated_station_is_that_of_its_kind(kind, tmp_path):
    scenario = replace(KINDS[kind](1, 1), lines=2, shots_per_line=2, terrain_step_m=4.0, cell_m=5.0)
    simulate(tmp_path / "simulated", scenario)
    written = tomllib.loads(write_site(tmp_path / "shipped", kind).read_text(encoding="utf-8"))
    simulated = tomllib.loads((tmp_path / "simulated" / "site.toml").read_text(encoding="utf-8"))
    for table, keys in {
        "station": ("data",),
        "scans": ("inbox", "settle_s"),
        "grid": ("bounds_m", "cell_m"),
        "reference": ("scans",),
        "map": ("pop",),
    }.items():
        for key in keys:
            written[table].pop(key, None), simulated[table].pop(key, None)
    assert {key: value for key, value in simulated.items() if key != "sop"} == {
        key: value for key, value in written.items() if key != "sop"
    }
    site = read_site(tmp_path / "simulated" / "site.toml")
    scans = sorted(site.scans.inbox.glob("*.laz"))
    assert [path.stem[-6:] for path in scans] == [
        f"00{int(number * scenario.interval_s / 60):02d}00" for number in range(scenario.scans)
    ]


def test_scenarios_are_of_the_glacier_only(tmp_path):
    result = CliRunner().invoke(
        app, ["simulate", str(tmp_path / "s"), "--like", "beach", "--scenario", "wind"]
    )
    assert result.exit_code == 2
    assert "scenarios are those of hef" in result.output
    result = CliRunner().invoke(app, ["simulate", str(tmp_path / "s"), "--like", "volcano"])
    assert result.exit_code == 2
    assert "choose from hef, mammoth, low-cost-snow, beach, rockfall" in result.output
    assert not (tmp_path / "s").exists()
    assert set(KINDS) < set(SITES)
