"""`station calibrate` and `station sensitivity` on a small simulated station."""

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
from station.operations.batch import process_scans
from station.operations.reports.calibration_report import (
    _site_file_keys,
    calibration_report,
    format_report,
    write_tables,
)
from station.science.analysis.precision import AnglePrecision, RangeModel
from station.simulation.station import simulate, small

HOURS = 3


@pytest.fixture(scope="module")
def site_path(tmp_path_factory):
    """Return the site file of a station with a processed series."""
    folder = tmp_path_factory.mktemp("processed") / "station"
    simulate(folder, replace(small(hours=HOURS), avalanche_m=0.0))
    site = folder / "site.toml"
    assert process_scans(read_site(site), sorted((folder / "inbox").glob("*.laz")), lambda _: None) == 0
    return site


def run(*arguments):
    return CliRunner().invoke(cli.app, [str(argument) for argument in arguments])


@pytest.mark.integration
def test_calibrate_reports_sigma_precision_and_site_file_keys(site_path, tmp_path):
    result = run("calibrate", site_path, "--out", tmp_path / "out")
    assert result.exit_code == 0, result.output
    assert "Error over stated sigma" in result.output
    assert "[scanner]\n" in result.output
    with (tmp_path / "out" / "boxes.csv").open() as file:
        boxes = list(csv.DictReader(file))
    assert {"time", "roll_deg", "pitch_deg", "mean_change_m", "sigma_m"} <= set(boxes[0])
    assert len({row["time"] for row in boxes}) == HOURS
    with (tmp_path / "out" / "overall.csv").open() as file:
        cells = next(row for row in csv.DictReader(file) if (row["scale"], row["band"]) == ("cell", "all"))
    assert 0.6 < float(cells["z_robust"]) < 1.5
    keys = (tmp_path / "out" / "scanner.toml").read_text()
    assert keys.startswith("[scanner]\nangle_resolution_deg = ")  # the simulated angles have no noise
    edited = site_path.with_name("edited.toml")
    edited.write_text(site_path.read_text().replace("[scanner]\n", keys, 1))
    assert read_site(edited).scanner.angle_resolution_deg < 1e-3


@pytest.mark.integration
def test_calibrate_as_json(site_path):
    result = run("calibrate", site_path, "--json", "--epochs", 2)
    assert result.exit_code == 0, result.output
    report = json.loads(result.output)
    assert {"overall", "epochs", "variogram", "boxes", "precision"} <= set(report)
    elevation = report["precision"]["angles"]["elevation"]
    assert elevation["precision_rad"] < 0.1 * elevation["sampling_rad"]


@pytest.mark.integration
def test_calibrate_without_series_reports_the_scanner_only(site_path, tmp_path):
    for name in ("inbox", "sop.dat", "weather.dat", "site.toml", "areas.geojson", "stable.geojson"):
        source = site_path.parent / name
        if source.exists():
            (shutil.copytree if source.is_dir() else shutil.copy)(source, tmp_path / name)
    site = read_site(tmp_path / "site.toml")
    report = calibration_report(site, [], 10, lambda: None)
    assert set(report) == {"precision"}
    assert "Precision of the scanner, from " in format_report(report)
    assert "nothing is stored yet" in str(run("sensitivity", tmp_path / "site.toml").exception)
    newest = site.scans.inbox / "990101_000000.laz"
    newest.write_bytes(b"LASF" + bytes(500))
    assert "990101_000000.laz" in format_report(calibration_report(site, [], 10, lambda: None))
    assert "choose other scans" in format_report(calibration_report(site, [], 10, lambda: None))
    with pytest.raises(ScanError):
        calibration_report(site, [newest], 10, lambda: None)
    for scan in site.scans.inbox.glob("*.laz"):
        scan.unlink()
    with pytest.raises(StationError, match="nothing is stored yet"):
        calibration_report(site, [], 10, lambda: None)


@pytest.mark.integration
def test_sensitivity_reports_shares_and_writes_maps(site_path, tmp_path):
    result = run("sensitivity", site_path, "--maps", tmp_path / "maps.nc")
    assert result.exit_code == 0, result.output
    assert "mean of glacier" in result.output
    assert "sampling errors" in result.output
    assert "together" in next(line for line in result.output.splitlines() if "interactions: largest" in line)
    with xr.open_dataset(tmp_path / "maps.nc") as maps:
        total = sum(maps[name] for name in maps if name.startswith("share_")).values
    assert total[np.isfinite(total)] == pytest.approx(1.0, abs=5e-3)


@pytest.mark.integration
def test_sensitivity_of_a_given_epoch_as_json(site_path):
    report = json.loads(run("sensitivity", site_path, "--json", "--epoch", "2025-07-15T01:05").output)
    assert report["epoch"] == "simulated_20250715T010000Z.nc"
    assert [area["area"] for area in report["areas"]][:2] == ["everything", "glacier"]
    for area in report["areas"]:
        assert sum(area["covariance_share"].values()) == pytest.approx(1.0)
        interactions = area["interactions"]
        assert [len(index["inputs"]) for index in interactions] == [2, 2, 2, 3]
        # The model is nearly linear.
        assert all(abs(index["share"]) < 4 * index["error"] + 0.01 for index in interactions)
    missing = run("sensitivity", site_path, "--epoch", 99)
    assert missing.exit_code == 1
    assert str(missing.exception) == "no epoch 99: the series has 3"
    invalid = run("sensitivity", site_path, "--epoch", "yesterday")
    assert invalid.exit_code == 2
    assert "neither a time" in invalid.output


def test_site_file_keys_of_precise_estimates_only():
    angles = tuple(AnglePrecision(2e-5, 1e-5, 1e-5 * factor, 1e-4, 1000) for factor in (1.0, 2.0))
    precise = RangeModel(0.0, 0.0, 0.0123, 0.0123, 0.1, 1e-5, 50)
    assert _site_file_keys(precise, angles) == {"range_sigma_m": 0.012, "angle_resolution_deg": 0.004}
    assert _site_file_keys(replace(precise, typical_error=0.5), None) == {}


def test_tables_are_written_for_the_site_file(tmp_path):
    precision = {"planes": [{"by": "range", "planes": 5}], "site_file": {"range_sigma_m": 0.012}}
    report = {"overall": [], "boxes": [{"z": 1.5}], "precision": precision}
    assert [path.name for path in write_tables(report, tmp_path)] == [
        "boxes.csv",
        "planes.csv",
        "scanner.toml",
    ]
    assert (tmp_path / "planes.csv").read_text().splitlines() == ["by,planes", "range,5"]
    assert (tmp_path / "scanner.toml").read_text() == "[scanner]\nrange_sigma_m = 0.012\n"
