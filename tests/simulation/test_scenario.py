"""Named scenarios, and the polygons of a simulated station."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pyproj
import pytest
import xarray as xr
from typer.testing import CliRunner

from station.cli import app
from station.errors import ConfigError
from station.simulation.scenario import NAMES
from station.simulation.station import Scenario, Station, demo, full_resolution, named, simulate, small

FROM_THE_START = {
    "quiet", "drift", "wind", "poor", "rough", "rough-poor", "airborne", "airborne-heavy", "ice-refraction",
    "disturbed", "breathing",
}  # fmt: skip
MARK = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:32632", always_xy=True)


def polygons(path):
    """Return the corners of each polygon of a GeoJSON file by name."""
    collection = json.loads(path.read_text())
    assert collection["type"] == "FeatureCollection"
    assert collection["crs"]["properties"]["name"] == "urn:ogc:def:crs:EPSG::32632"
    return {
        feature["properties"]["name"]: np.array(feature["geometry"]["coordinates"][0])
        for feature in collection["features"]
    }


def within(ring, x, y):
    """Return a mask of the points inside a convex counter-clockwise ring."""
    sides = pairwise(ring)
    return np.all([(b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0]) > 0 for a, b in sides], axis=0)


@pytest.fixture(scope="module", params=["good", "poor"])
def simulated(request, tmp_path_factory):
    """Yield folder, truth and scenario of a small station with every surface change."""
    folder = tmp_path_factory.mktemp("simulated") / request.param
    scenario = replace(
        small(hours=2),
        stable_ground=request.param,
        avalanche_hour=1.0,
        snowfall_m=0.5,
        snow_hours=(0.0, 1.0),
        lines=20,
        terrain_step_m=4.0,
    )
    simulate(folder, scenario)
    with xr.open_dataset(folder / "truth.nc") as truth:
        yield folder, truth.load(), scenario


@pytest.mark.integration
def test_stable_polygons_contain_only_rock_that_never_changes(simulated):
    folder, truth, scenario = simulated
    mesh = np.meshgrid(truth.x, truth.y)
    rings = polygons(folder / "stable.geojson")
    inside = np.any([within(ring, *mesh) for ring in rings.values()], axis=0)
    np.testing.assert_array_equal(inside, truth.stable_polygons.to_numpy() == 1)
    assert truth.ice.to_numpy()[inside].max() < 0.01
    without_snow = Station(replace(scenario, snowfall_m=0.0))
    change_m = without_snow.surface.change_m(without_snow.changes, 1.1)
    assert np.abs(change_m[inside]).max() == 0
    assert np.abs(change_m).max() > 1
    for name, ring in rings.items():
        np.testing.assert_array_equal(ring[0], ring[-1])
        size_m = np.ptp(ring, axis=0)
        assert (size_m % scenario.cell_m == 0).all(), name
    if scenario.stable_ground == "good":
        assert 0.3 < inside.mean() < 0.8
        assert (truth.change.to_numpy()[1][inside] > 0.1).mean() > 0.3  # snow falls on stable ground too
        assert len(rings) < 150


@pytest.mark.integration
@pytest.mark.parametrize("simulated", ["poor"], indirect=True)
def test_poor_stable_ground_is_a_far_ridge_and_a_hut_without_snow(simulated):
    folder, truth, _ = simulated
    rings = polygons(folder / "stable.geojson")
    hut = rings.pop("hut")
    centre = hut[:-1].mean(axis=0)
    x0, y0 = truth.x.to_numpy(), truth.y.to_numpy()
    scanner = np.array(MARK.transform(10.7828, 46.7958))
    offset_m = centre - scanner
    assert np.linalg.norm(offset_m) == pytest.approx(0.9 * 200, abs=20)
    hut_cells = np.ix_(
        np.abs(y0 - centre[1]) < np.ptp(hut[:, 1]) / 2, np.abs(x0 - centre[0]) < np.ptp(hut[:, 0]) / 2
    )
    assert truth.change.to_numpy()[1][hut_cells].size >= 4
    assert np.abs(truth.change.to_numpy()[1][hut_cells]).max() == 0
    corners = np.concatenate(list(rings.values())) - scanner
    assert np.linalg.norm(corners, axis=1).min() > 2200 * 0.2 - 5
    bearing = np.degrees(np.arctan2(corners[:, 1], corners[:, 0]))
    assert np.ptp(bearing) < 15
    assert abs(bearing.mean() - np.degrees(np.arctan2(offset_m[1], offset_m[0]))) > 30


@pytest.mark.integration
def test_areas_are_glacier_avalanche_deposit_and_rock(simulated):
    folder, truth, _ = simulated
    mesh = np.meshgrid(truth.x, truth.y)
    rings = polygons(folder / "areas.geojson")
    inside = {name: within(ring, *mesh) for name, ring in rings.items()}
    assert list(inside) == ["glacier", "deposit", "rock"]
    ice, change_m = truth.ice.to_numpy(), truth.change.to_numpy()[1]
    assert ice[inside["glacier"]].min() > 0.95
    assert inside["glacier"].sum() * 25 == pytest.approx(2 * np.sqrt(2) * (280 * 0.2) ** 2, rel=0.05)
    assert ice[inside["rock"]].max() < 0.01
    assert inside["rock"].sum() * 25 == pytest.approx((200 * 0.2) ** 2, rel=0.1)
    assert change_m[inside["deposit"]].max() == change_m.max()
    highest = change_m > 1.4  # at most one metre of this is snow
    assert highest.any()
    assert inside["deposit"][highest].all()


@pytest.mark.integration
def test_intensity_of_snow_equals_that_of_ice_and_thin_snow_shows_rock():
    scenario = replace(small(hours=2).without_errors(), snow_hours=(0.5, 1.0))
    by_snowfall = {}
    for snowfall_m in (0.0, 0.004, 0.3):
        station = Station(replace(scenario, snowfall_m=snowfall_m))
        scan = station.scan(1)
        _, east, north = station.ground(1).with_slope(scan.true_m[:, 0], scan.true_m[:, 1])
        ray = scan.true_m - np.array(scenario.mount_position_m)
        cosine = (ray[:, 0] * east + ray[:, 1] * north - ray[:, 2]) / np.linalg.norm(ray, axis=1)
        reflectance = scan.intensity * np.sqrt(1 + east**2 + north**2) / cosine
        slope_deg = np.degrees(np.arctan(np.hypot(east, north)))
        ice = station.valley.ice.at(scan.true_m[:, 0], scan.true_m[:, 1])
        kinds = ((ice < 0.01) & (slope_deg < 35), (ice < 0.01) & (slope_deg > 56), ice > 0.99)
        by_snowfall[snowfall_m] = [reflectance[kind] for kind in kinds]
    for gentle, steep, ice in by_snowfall.values():
        assert np.median(steep) == pytest.approx(0.25, abs=0.005)
        assert np.median(ice) == pytest.approx(0.60, abs=0.005)
        assert len(gentle) > 1000
    assert np.median(by_snowfall[0.0][0]) == pytest.approx(0.25, abs=0.005)
    assert np.median(by_snowfall[0.004][0]) < 0.26  # a dusting does not cover rock
    assert np.median(by_snowfall[0.3][0]) == pytest.approx(0.60, abs=0.005)


@pytest.mark.integration
def test_intensity_has_speckle_and_a_gain_per_scan():
    noiseless = Station(replace(small(hours=20), range_noise_m=0.0))
    noisy = Station(small(hours=20))
    ratios = [noisy.scan(scan).intensity / noiseless.scan(scan).intensity for scan in (0, 1)]
    for scan, ratio in enumerate(ratios):
        gain = noisy.conditions(scan).gain
        assert ratio.mean() == pytest.approx(gain, abs=0.003)
        assert ratio.std() / gain == pytest.approx(0.08, rel=0.03)
    gains = np.array([noisy.conditions(scan).gain for scan in range(20)])
    assert 0.95 < gains.min() < 0.97
    assert 1.03 < gains.max() < 1.05


@pytest.mark.parametrize("name", NAMES)
def test_special_conditions_begin_after_the_reference_scans(name):
    for hours in (1, 3, 24):
        scenario = named(name, hours=hours, seed=3)
        assert (scenario.seed, scenario.hours) == (3, hours)
        assert scenario.reference_scans == max(1, min(8, hours // 3))
        begins = [
            begin
            for size, begin in (
                (scenario.snowfall_m, scenario.snow_hours[0]),
                (scenario.melt_m_per_h, scenario.melt_from_hour),
                (scenario.avalanche_m, scenario.avalanche_hour),
                (scenario.fog_visibility_m, scenario.fog_hours[0]),
                (scenario.moved_hour, scenario.moved_hour),
                (scenario.settling_m_per_h, scenario.settling_from_hour),
                (scenario.winter_m or scenario.summer_melt_m, scenario.season_hour),
                (scenario.log_fault, scenario.log_fault_hour),
            )
            if size and hours > 1
        ]
        assert all(begin >= scenario.reference_scans for begin in begins)
        assert len(begins) == (name not in FROM_THE_START and hours > 1)


@pytest.mark.integration
def test_melt_and_avalanche_have_their_magnitude():
    melt, avalanche = (Station(named(name)) for name in ("melt", "avalanche"))
    assert melt.ground(7).node.tolist() == melt.valley.ground.node.tolist()
    lowered = melt.ground(20).node - melt.ground(10).node
    assert lowered.min() == pytest.approx(-0.05, abs=3e-3)  # the lowest ice is its thin edge
    deposit = avalanche.ground(16).node - avalanche.ground(15).node
    assert deposit.max() == pytest.approx(2.0, abs=0.05)
    rows, columns = np.nonzero(deposit > 0.02)
    spans_m = [np.ptp(columns) * 5, np.ptp(rows) * 5]
    assert all(15 <= span_m <= 35 for span_m in spans_m)
    assert np.abs(avalanche.ground(15).node - avalanche.valley.ground.node).max() == 0


@pytest.mark.parametrize("name", ["settling", "melt-height"])
def test_ice_lowers_by_five_centimetres_after_the_reference(name):
    """At 3 km from the scanner, or at the end of the tongue, until the end of the series."""
    scenario = replace(named(name, hours=20), terrain_step_m=20.0)
    station = Station(scenario)
    (change,) = station.changes
    assert (change.amount(6.0), change.amount(20.0)) == (0.0, pytest.approx(0.05))
    ice = station.valley.ice.node > 0.99
    assert ice.sum() > 1000
    lowered_m = -0.05 * change.pattern.node[ice]
    ground = station.valley.ground
    row, column = np.nonzero(ice)
    east_m, north_m = ground.west_m + 20.0 * column, ground.south_m + 20.0 * row
    if name == "settling":
        np.testing.assert_allclose(lowered_m, 0.05 * np.hypot(east_m, north_m) / 3000, rtol=0.011)
    else:
        slope, _ = np.polyfit(ground.node[ice][lowered_m > 1e-4], lowered_m[lowered_m > 1e-4], 1)
        assert slope == pytest.approx(-0.05 / 450, rel=0.02)
        assert lowered_m.max() == pytest.approx(0.05, rel=0.1)


def test_snow_that_falls_unseen_is_the_same_snow():
    """Only the record of the brightness and the scanner differ."""
    fields = ("snowfall_m", "snow_hours", "seed", "hours", "stable_ground", "line_jitter_deg")
    for name, brightness in (
        ("snow-db", "decibel"),
        ("snow-1550", "reflectance"),
        ("snow-no-brightness", "none"),
    ):
        scenario = named(name, hours=12, seed=5)
        assert scenario.brightness == brightness
        for field in fields:
            assert getattr(scenario, field) == getattr(named("snowfall", hours=12, seed=5), field)


@pytest.mark.integration
def test_full_resolution_keeps_the_condition_on_the_whole_valley():
    full, base = full_resolution(named("wind", hours=5, seed=2)), named("wind", hours=5, seed=2)
    assert (full.cell_m, full.extent_m, full.azimuth_deg) == (
        Scenario().cell_m, Scenario().extent_m, Scenario().azimuth_deg,
    )  # fmt: skip
    assert full.wind_sway_deg == base.wind_sway_deg == 0.002
    sample = Station(replace(full, lines=100, shots_per_line=100, terrain_step_m=8.0)).scan(0)
    assert len(sample.x_m) / 1e4 * full.lines * full.shots_per_line > 1.4e6


def test_unknown_scenario_raises_config_error(tmp_path):
    with pytest.raises(ConfigError, match="choose from quiet, drift"):
        named("snow")
    result = CliRunner().invoke(app, ["simulate", str(tmp_path / "s"), "--scenario", "snow"])
    assert result.exit_code == 2
    assert "avalanche" in result.output
    assert not (tmp_path / "s").exists()


def test_command_simulates_the_named_scenario(tmp_path, monkeypatch):
    scenarios = []
    monkeypatch.setattr("station.simulation.station.simulate", lambda _, scenario: scenarios.append(scenario))
    run = CliRunner().invoke
    for options in ([], ["--scenario", "fog", "--seed", "4", "--hours", "12"]):
        assert run(app, ["simulate", str(tmp_path), *options]).exit_code == 0
    assert scenarios == [demo(), named("fog", hours=12, seed=4)]


def test_cli_imports_no_numpy():
    code = "import sys, station.cli; sys.exit('numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.integration
def test_same_seed_gives_the_same_files(tmp_path):
    scenario = replace(
        small(hours=2), wind_sway_deg=0.002, tilt_jerk_deg=0.002, mirror_wobble_deg=0.001,
        refraction_patch_sigma=0.05, fog_visibility_m=500.0, fog_hours=(1.0, 2.0), moved_hour=1.0,
        moved_deg=0.1, moved_m=0.01, snowfall_m=0.2, snow_hours=(0.0, 1.0), stable_ground="poor", lines=40,
        terrain_step_m=4.0,
    )  # fmt: skip
    first, second = tmp_path / "first", tmp_path / "second"
    simulate(first, scenario)
    simulate(second, scenario)
    names = [path.relative_to(first) for path in sorted(first.rglob("*")) if path.is_file()]
    assert len(names) == 10
    for name in names:
        if name.name != "truth.nc":
            assert (second / name).read_bytes() == (first / name).read_bytes()
    with xr.open_dataset(first / "truth.nc") as truth, xr.open_dataset(second / "truth.nc") as repeated:
        assert truth.identical(repeated)
