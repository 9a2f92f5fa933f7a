"""`station product`: tables of products, their newest values, and the comparison with observations."""

import csv
import io
import json

import numpy as np
import pytest
from typer.testing import CliRunner

from station.cli import app
from station.config import read_site
from station.errors import StationError
from station.operations.site_check import site_findings

SITE_MORE = """
[[product]]
name = "Snow depth"
kind = "snow_depth"
areas = ["rises"]
surface = { from = 2025-11-21T00:00:00Z, to = 2025-11-21T00:59:00Z }
observations = "gauge.csv"

[[product]]
name = "stake 1"
kind = "point"
at = [632125, 5185905]

[[product]]
name = "line"
kind = "profile"
line = [[632100, 5185905], [632300, 5185905]]
"""


FAR = '[[product]]\nname = "far"\nkind = "point"\nat = [0, 0]\n'


@pytest.fixture
def run(site):
    """Return a function that runs `station product` and returns its output; the site has three products."""
    with site.path.open("a") as file:
        file.write(SITE_MORE)
    (site.path.parent / "gauge.csv").write_text("time_utc,snow_depth_m\n2025-11-21T02:07:30,0.08\n")

    def run(*arguments):
        result = CliRunner().invoke(app, ["product", str(site.path), *arguments], catch_exceptions=False)
        assert result.exit_code == 0
        return result

    return run


def test_the_newest_values_are_those_of_the_last_usable_scan(run, small):
    """The box rises by 5 cm an hour since the first scan."""
    rows = json.loads(run("--json").stdout)
    (depth,) = [row for row in rows if row["quantity"] == "snow_depth"]
    assert (depth["product"], depth["place"], depth["unit"]) == ("Snow depth", "rises", "m")
    assert depth["value"] == pytest.approx(0.25, abs=0.01)
    assert depth["sigma"] < 0.01
    assert depth["start_s"] == small.START_S + 5 * 3600
    text = run().stdout
    assert "Snow depth  rises    snow_depth" in text
    assert "stake 1     stake 1  elevation" in text


def test_a_product_over_time_as_csv_and_text(run):
    rows = list(csv.DictReader(io.StringIO(run("snow depth", "--csv", "-").stdout)))
    assert len(rows) == 6
    assert rows[2]["time_utc"] == "2025-11-21T02:07:30.000Z"
    assert float(rows[2]["snow_depth_m"]) == pytest.approx(0.10, abs=0.01)
    sigma_m, random_m, systematic_m = (
        float(rows[2][f"snow_depth{part}_m"]) for part in ("_sigma", "_random_sigma", "_systematic_sigma")
    )
    assert sigma_m == pytest.approx(np.hypot(random_m, systematic_m), rel=1e-4)
    assert rows[2]["new_snow_24h_m"] == ""
    result = run("snow depth", "--from", "2025-11-21T02:00", "--to", "2025-11-21T03:30")
    assert [line[:16] for line in result.stdout.splitlines()[1:3]] == ["2025-11-21 02:00", "2025-11-21 03:00"]
    assert "snow_depth less observations: n = 1, bias +0.0" in result.stdout
    assert "z " in result.stdout


@pytest.mark.integration
def test_the_csv_export_has_a_file_of_each_product(run, site, tmp_path):
    expected = run("snow depth", "--csv", "-").stdout
    CliRunner().invoke(app, ["export", str(site.path), "csv", str(tmp_path / "csv")], catch_exceptions=False)
    assert {path.name for path in (tmp_path / "csv").glob("*.csv")} == {
        "scans.csv", "areas.csv", "product_line.csv", "product_snow_depth.csv", "product_stake_1.csv"
    }  # fmt: skip
    assert (tmp_path / "csv/product_snow_depth.csv").read_text() == expected


def test_a_profile_is_printed_for_the_newest_scan(run):
    lines = run("line").stdout.splitlines()
    assert len(lines) == 22
    assert lines[1].startswith("2025-11-21 05:00  0.00")


@pytest.mark.usefixtures("run")
def test_a_name_that_is_none_is_answered_with_those_there_are(site):
    with pytest.raises(StationError, match=r"no product 'depth'.*products: line, snow_depth, stake_1"):
        CliRunner().invoke(app, ["product", str(site.path), "depth"], catch_exceptions=False)


def test_a_product_that_cannot_be_computed_is_named_and_keeps_no_other_back(run, site):
    site.path.write_text(site.path.read_text().replace('areas = ["rises"]', 'areas = ["nowhere"]'))
    result = run()
    assert "product Snow depth: no area nowhere in areas.file, which has rises" in result.stderr
    assert "stake 1" in result.stdout
    assert read_site(site.path).product[0].areas == ("nowhere",)


def test_a_product_whose_surface_is_not_measured_yet_says_so(run, site):
    site.path.write_text(site.path.read_text().replace("2025-11-21T00:59:00Z", "2026-09-01T00:00:00Z"))
    expected = "product Snow depth: its surface is that of 2025-11-21 00:00 to 2026-09-01 00:00 UTC, which"
    assert expected in run().stderr


@pytest.mark.integration
def test_check_says_what_keeps_products_and_their_alarms_from_working(site):
    (site.path.parent / "gauge.csv").write_text("time,depth\n")
    more = SITE_MORE + FAR + '[[alarms.product]]\nproduct = "line"\nquantity = "hn24"\nabove = 1\n'
    site.path.write_text(site.path.read_text() + more)
    findings = site_findings(site.path)
    faults = [finding["message"] for finding in findings if finding["level"] == "fault"]
    for expected in (
        "product far: no cell of the grid in far: are the coordinates those of the map?",
        "alarms.product: line has no hn24; it has elevation, elevation_change",
        "gauge.csv: must begin with a line such as time_utc,snow_depth_m",
    ):
        assert any(expected in fault for fault in faults)
    assert any(finding["message"] == "stake 1: 1 cells of the grid" for finding in findings)
