"""`station check`: findings on polygons, flags and folders of a site."""

import json
import os
import re
import shutil
import time
from dataclasses import replace

import laspy
import pytest

from station.config import read_site
from station.inbox import listing
from station.operations import site_check
from station.operations import site_plausibility as plausibility
from station.processing.scanner_pose import map_position
from station.sections.results import FlagsSection, RetentionSection
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


@pytest.mark.parametrize(("facing_deg", "level", "message"), [
    (180.0, "ok", "200.3 m from the scanner; change is positive towards it"),
    (0.0, "fault", "the scanner is 200.3 m behind it: facing_deg is the azimuth from the face"),
])  # fmt: skip
def test_a_plane_faces_the_scanner(folder, facing_deg, level, message):
    """A face 200 m to the north of the mark, from which the scanner stands 0.3 m to the south."""
    site = read_site(folder / "site.toml")
    east_m, north_m, height_m = map_position(site)
    text = (folder / "site.toml").read_text()
    origin = f"[{east_m}, {north_m + 200.0}, {height_m}]"
    plane = f"[grid]\nplane = {{ origin_m = {origin}, facing_deg = {facing_deg} }}\n"
    bounds = "bounds_m = { west = -50.0, south = -50.0, east = 50.0, north = 50.0 }"
    (folder / "site.toml").write_text(re.sub(r"bounds_m = .*", bounds, text.replace("[grid]\n", plane)))
    (finding,) = [
        finding
        for finding in site_check._sop_poses(read_site(folder / "site.toml"))
        if finding["what"] == "grid"
    ]
    assert finding["level"] == level
    assert message in finding["message"]


def test_unreadable_polygon_file_is_a_fault(folder):
    (folder / "areas.geojson").write_text("{")
    (finding,) = site_check._polygons(read_site(folder / "site.toml"))
    assert finding["level"] == "fault"
    assert "areas.geojson" in finding["message"]


def warnings(findings):
    return [message for level, message in findings if level != "ok"]


def edited(folder, *changes, more=""):
    path = folder / "site.toml"
    text = path.read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path.write_text(text + more)
    return read_site(path)


def test_alarms_of_unknown_areas_and_without_their_library_are_faults(folder, monkeypatch):
    site = edited(folder, more='\n[alarms]\ntargets = ["mail"]\n[alarms.change]\nareas = ["tongue"]\n')
    monkeypatch.setattr(plausibility.importlib.util, "find_spec", lambda _: None)
    unknown, missing = warnings(plausibility.alarm_findings(site, {"glacier"}))
    assert unknown == "alarms.change.areas: no area 'tongue'; there are glacier"
    assert "tls-station[alarms]" in missing


def test_areas_on_stable_ground_are_reported(folder):
    shutil.copy(folder / "areas.geojson", folder / "stable.geojson")
    messages = [finding["message"] for finding in site_check._polygons(read_site(folder / "site.toml"))]
    assert "100% of the area glacier is declared stable: its change is adjusted away" in messages


def test_sop_in_millimetres_is_reported(folder):
    site = read_site(folder / "site.toml")
    origin_m = site_check.map_position(site)
    far_off_m = (origin_m[0] + 1700, origin_m[1], origin_m[2] + 2000)
    assert (
        "is its translation in metres?"
        in warnings(plausibility.position_findings(site, "sop.dat", far_off_m, origin_m))[0]
    )
    assert not warnings(plausibility.position_findings(site, "sop.dat", origin_m, origin_m))


@pytest.mark.parametrize(
    ("map_section", "scanner", "message"),
    [
        ({"vertical_datum": "EGM2008"}, {}, "write its name in EPSG, 'EGM2008 geoid'"),
        ({"vertical_datum": "Zugspitze 1900"}, {}, "no datum of EPSG"),
        ({"vertical_datum": "EGM2008 geoid"}, {}, None),
        ({}, {"beam_divergence_mrad": 0.00012}, "scanner.beam_divergence_mrad = 0.00012, but a riegl"),
    ],
)
def test_unusual_settings_are_reported(folder, map_section, scanner, message):
    site = read_site(folder / "site.toml")
    site = site.model_copy(
        update={
            "map": site.map.model_copy(update={"vertical_datum": "", **map_section}),
            "scanner": site.scanner.model_copy(update=scanner),
        }
    )
    found = warnings(plausibility.setting_findings(site))
    assert [message in text for text in found] == ([True] if message else [])


def test_tilt_of_sop_and_log_are_compared(folder):
    """The SOP of another day, of which the mount has moved: the log knows."""
    (finding,) = site_check._inclination(read_site(folder / "site.toml"))
    assert finding["level"] == "ok", finding
    log = next((folder / "inbox").glob("*-incl.txt"))
    header, *rows = log.read_text().splitlines()
    fields = [row.split(",") for row in rows]
    log.write_text(
        "\n".join([header, *(f"{time},{float(roll) + 1.0},{pitch}" for time, roll, pitch in fields)])
    )
    (finding,) = site_check._inclination(read_site(folder / "site.toml"))
    assert finding["level"] == "warning"
    assert finding["message"].endswith("in sop.dat: another SOP, a moved mount, or a wrong log?")
    log.write_text("")
    assert list(site_check._inclination(read_site(folder / "site.toml"))) == []


def test_an_absolute_log_under_an_sop_that_contains_the_tilt_is_reported(folder):
    path = folder / "site.toml"
    path.write_text(path.read_text().replace('mode = "relative"', 'mode = "absolute"'))
    (finding,) = site_check._inclination(read_site(path))
    assert (finding["level"], finding["what"]) == ("warning", "inclination")
    assert 'inclination.mode = "absolute" applies it again' in finding["message"]
    (folder / "sop.dat").write_text("0 1 0 0\n-1 0 0 0\n0 0 1 0\n0 0 0 1\n")  # of an upright scanner
    assert list(site_check._inclination(read_site(path))) == []


def test_weather_log_of_another_time_zone_is_reported():
    (message,) = warnings(plausibility.weather_time_findings(time.time() + 7200))
    assert "2.0 h in the future" in message
    assert not warnings(plausibility.weather_time_findings(time.time() - 60))


@pytest.mark.skipif(os.geteuid() != 0, reason="tells root what another user may not do")
def test_rights_of_the_user_of_the_service_are_reported_to_root(folder):
    site = read_site(folder / "site.toml")
    (folder / "sop.dat").chmod(0o600)
    messages = warnings(plausibility.rights_findings(site, [folder / "sop.dat"], "nobody"))
    assert f"{folder / 'sop.dat'}: the user nobody may not read it" in messages
    assert any("may not write there" in message for message in messages)
    assert os.geteuid() == 0
    (message,) = warnings(plausibility.rights_findings(site, [], "nosuchuser"))
    assert "run as root" in message


def test_unreadable_inbox_is_a_fault(folder, monkeypatch):
    site = read_site(folder / "site.toml")
    monkeypatch.setattr(site_check.os, "access", lambda path, _: path != site.scans.inbox)
    monkeypatch.setattr(listing.os, "scandir", raise_permission_error)
    assert site_check._scans(site) == []
    assert [finding["what"] for finding in site_check._folders(site) if finding["level"] == "fault"] == [
        "inbox"
    ]


def raise_permission_error(_):
    raise PermissionError(13, "Permission denied")


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


@pytest.mark.integration
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


@pytest.mark.integration
def test_tilt_in_the_points_that_nobody_uses_is_reported(folder):
    path = folder / "site.toml"
    path.write_text(re.sub(r"(?ms)^\[inclination\].*?(?=^\[)", "", path.read_text()))
    site = read_site(path)
    assert list(site_check._unused_inclination(site)) == []
    scan = max(site.scans.inbox.glob("*.laz"))
    las = laspy.read(scan)
    las.add_extra_dims([laspy.ExtraBytesParams(name, "f4") for name in ("Roll", "Pitch")])
    las.Roll[:] = las.Pitch[:] = 0.5
    las.write(scan)
    (finding,) = site_check._unused_inclination(site)
    assert (finding["level"], finding["what"]) == ("warning", "inclination")
    assert "[inclination] wait_s = 0 would" in finding["message"]
