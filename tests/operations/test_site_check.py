"""`station check`: findings on polygons, flags and folders of a site."""

import json
import shutil
from dataclasses import replace

import laspy
import pytest

from station.config import read_site
from station.operations import site_check
from station.sections import FlagsSection, RetentionSection
from station.simulation.station import simulate, small


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    folder = tmp_path_factory.mktemp("check") / "station"
    simulate(folder, replace(small(hours=1), lines=20, terrain_step_m=4.0))
    return folder


@pytest.fixture
def folder(simulated, tmp_path):
    return shutil.copytree(simulated, tmp_path / "station")


def polygon_findings(folder):
    findings = site_check._polygons(read_site(folder / "site.toml"))
    return {finding["message"].split(":")[0]: finding for finding in findings}


def test_cells_of_polygons_are_counted(folder):
    findings = polygon_findings(folder)
    assert set(findings) == {"stable ground", "area glacier", "area deposit", "area rock"}
    assert {finding["level"] for finding in findings.values()} == {"ok"}
    assert findings["stable ground"]["message"].endswith("cells of the grid")


def test_polygon_off_the_grid_is_a_fault(folder):
    areas = folder / "areas.geojson"
    collection = json.loads(areas.read_text())
    first = collection["features"][0]
    first["geometry"]["coordinates"] = [[[x + 50_000, y] for x, y in first["geometry"]["coordinates"][0]]]
    areas.write_text(json.dumps(collection))
    findings = polygon_findings(folder)
    assert findings["area glacier"]["level"] == "fault"
    assert findings["area rock"]["level"] == "ok"


def test_unreadable_polygon_file_is_a_fault(folder):
    (folder / "areas.geojson").write_text("{")
    (finding,) = site_check._polygons(read_site(folder / "site.toml"))
    assert finding["level"] == "fault"
    assert "areas.geojson" in finding["message"]


def test_flags_are_counted_and_an_invalid_row_is_a_fault(folder, tmp_path):
    site = read_site(folder / "site.toml")
    flags = tmp_path / "flags.csv"
    flagged = site.model_copy(update={"flags": FlagsSection(file=flags)})
    flags.write_text("from,to,reason\n2026-01-01,2026-01-02,rime\n")
    (finding,) = site_check._flags(flagged)
    assert (finding["level"], finding["message"]) == ("ok", f"{flags}: 1 intervals")
    flags.write_text("from,to,reason\nyesterday,2026-01-02,rime\n")
    (finding,) = site_check._flags(flagged)
    assert finding["level"] == "fault"
    assert "line 2" in finding["message"]


def test_read_only_inbox_is_a_warning_if_retention_deletes_scans(folder, monkeypatch):
    site = read_site(folder / "site.toml")
    deleting = site.model_copy(update={"retention": RetentionSection(raw="delete")})
    monkeypatch.setattr(
        site_check.os, "access", lambda path, mode: mode != site_check.os.W_OK or path != site.scans.inbox
    )
    assert folder_warnings(deleting) == ["retention"]
    assert folder_warnings(site) == []


def folder_warnings(site):
    return [finding["what"] for finding in site_check._folders(site) if finding["level"] == "warning"]


def test_scan_without_brightness_is_a_warning_that_says_what_it_costs(folder):
    site = read_site(folder / "site.toml")
    assert [finding["what"] for finding in site_check._newest_scan(site)] == ["scan"]
    scan = max(site.scans.inbox.glob("*.laz"))
    las = laspy.read(scan)
    las.intensity[:] = 0
    las.write(scan)
    verdict, finding = site_check._newest_scan(site)
    assert "no brightness" in verdict["message"]
    assert (finding["level"], finding["what"]) == ("warning", "brightness")
    assert "recognised by slope only" in finding["message"]
    assert "scans.intensity" in finding["message"]
