"""`station calibrate` and `station sensitivity` as a user types them, on a small simulated station."""

import csv
import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from typer.testing import CliRunner

from station import cli
from station.config import read_site
from station.errors import ScanError, StationError
from station.service.calibrate import calibrate, describe
from station.service.once import process_scans
from station.simulation.station import simulate, tiny

HOURS = 3


@pytest.fixture(scope="module")
def lived(tmp_path_factory):
    """A station with a processed series."""
    folder = tmp_path_factory.mktemp("lived") / "station"
    simulate(folder, replace(tiny(hours=HOURS), avalanche_m=0.0))
    site = folder / "site.toml"
    assert process_scans(read_site(site), sorted((folder / "inbox").glob("*.laz")), lambda _: None) == 0
    return site


def run(*arguments):
    return CliRunner().invoke(cli.app, [str(one) for one in arguments])


def test_calibrate_tells_sigma_precision_and_keys(lived, tmp_path):
    done = run("calibrate", lived, "--out", tmp_path / "out")
    assert done.exit_code == 0, done.output
    assert "Error over stated sigma" in done.output
    assert "[scanner]\n" in done.output
    with (tmp_path / "out" / "boxes.csv").open() as file:
        boxes = list(csv.DictReader(file))
    assert {"time", "roll_deg", "pitch_deg", "mean_change_m", "sigma_m"} <= set(boxes[0])
    assert len({row["time"] for row in boxes}) == HOURS
    with (tmp_path / "out" / "overall.csv").open() as file:
        cells = next(row for row in csv.DictReader(file) if (row["scale"], row["band"]) == ("cell", "all"))
    assert 0.6 < float(cells["z_robust"]) < 1.5
    keys = (tmp_path / "out" / "scanner.toml").read_text()
    assert keys.startswith(
        "[scanner]\nangle_resolution_deg = "
    )  # this station reads its angles without noise
    again = lived.with_name("again.toml")
    again.write_text(lived.read_text().replace("[scanner]\n", keys, 1))
    assert read_site(again).scanner.angle_resolution_deg < 1e-3


def test_calibrate_as_json_is_json(lived):
    done = run("calibrate", lived, "--json", "--epochs", 2)
    assert done.exit_code == 0, done.output
    told = json.loads(done.output)
    assert {"overall", "epochs", "variogram", "boxes", "precision"} <= set(told)
    elevation = told["precision"]["angles"]["elevation"]
    assert elevation["precision_rad"] < 0.1 * elevation["sampling_rad"]


def test_calibrate_before_any_scan_was_processed_measures_the_scanner_alone(lived, tmp_path):
    for name in ("inbox", "sop.dat", "weather.dat", "site.toml", "areas.geojson", "stable.geojson"):
        source = lived.parent / name
        if source.exists():
            (shutil.copytree if source.is_dir() else shutil.copy)(source, tmp_path / name)
    site = read_site(tmp_path / "site.toml")
    told = calibrate(site, [], 10, lambda: None)
    assert set(told) == {"precision"}
    assert "Precision of the scanner, from " in describe(told)
    assert "nothing is stored yet" in str(run("sensitivity", tmp_path / "site.toml").exception)
    newest = site.scans.inbox / "990101_000000.laz"
    newest.write_bytes(b"LASF" + bytes(500))
    assert "990101_000000.laz" in describe(calibrate(site, [], 10, lambda: None))
    assert "name other scans" in describe(calibrate(site, [], 10, lambda: None))
    with pytest.raises(ScanError):
        calibrate(site, [newest], 10, lambda: None)
    for scan in site.scans.inbox.glob("*.laz"):
        scan.unlink()
    with pytest.raises(StationError, match="nothing is stored yet"):
        calibrate(site, [], 10, lambda: None)


def test_sensitivity_tells_shares_and_maps_them(lived, tmp_path):
    done = run("sensitivity", lived, "--maps", tmp_path / "maps.nc")
    assert done.exit_code == 0, done.output
    assert "mean of glacier" in done.output
    assert "sampling errors" in done.output
    assert "together" in next(line for line in done.output.splitlines() if "by interaction" in line)
    with xr.open_dataset(tmp_path / "maps.nc") as maps:
        total = sum(maps[name] for name in maps if name.startswith("share_")).values
    assert total[np.isfinite(total)] == pytest.approx(1.0, abs=5e-3)


def test_sensitivity_of_another_epoch_as_json(lived):
    told = json.loads(run("sensitivity", lived, "--json", "--epoch", "2025-07-15T01:05").output)
    assert told["epoch"] == "simulated_20250715T010000Z.nc"
    assert [area["area"] for area in told["areas"]][:2] == ["everything", "glacier"]
    for area in told["areas"]:
        assert sum(area["part"].values()) == pytest.approx(1.0)
        assert [len(one["inputs"]) for one in area["interactions"]] == [2, 2, 2, 3]
        assert all(
            abs(one["share"]) < 4 * one["error"] + 0.01 for one in area["interactions"]
        )  # as good as linear
    beyond = run("sensitivity", lived, "--epoch", 99)
    assert beyond.exit_code == 2
    assert "no epoch at place 99" in beyond.output
    wrong = run("sensitivity", lived, "--epoch", "yesterday")
    assert wrong.exit_code == 2
    assert "neither a time" in wrong.output
