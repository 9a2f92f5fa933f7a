"""What `station check` says of polygons before a station goes live."""

import json

import pytest

from station.config import read_site
from station.sections import FlagsSection, RetentionSection
from station.service import check
from station.simulation.station import simulate, tiny


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made = tmp_path_factory.mktemp("check") / "station"
    simulate(made, tiny(hours=1))
    return made


def said(folder):
    return {one["says"].split(":")[0]: one for one in check._polygons(read_site(folder / "site.toml"))}


def test_polygons_on_the_grid_are_counted(folder):
    found = said(folder)
    assert set(found) == {"stable ground", "area glacier", "area deposit", "area rock"}
    assert {one["level"] for one in found.values()} == {"ok"}
    assert found["stable ground"]["says"].endswith("cells of the grid")


def test_a_polygon_beside_the_grid_is_a_fault(folder):
    areas = folder / "areas.geojson"
    before = areas.read_text()
    told = json.loads(before)
    first = told["features"][0]
    first["geometry"]["coordinates"] = [[[x + 50_000, y] for x, y in first["geometry"]["coordinates"][0]]]
    areas.write_text(json.dumps(told))
    try:
        found = said(folder)
    finally:
        areas.write_text(before)
    assert found["area glacier"]["level"] == "fault"
    assert found["area rock"]["level"] == "ok"


def test_a_broken_file_is_a_fault_that_names_it(folder):
    areas = folder / "areas.geojson"
    before = areas.read_text()
    areas.write_text("{")
    try:
        (one,) = check._polygons(read_site(folder / "site.toml"))
    finally:
        areas.write_text(before)
    assert one["level"] == "fault"
    assert "areas.geojson" in one["says"]


def test_flags_are_counted_and_a_row_that_is_none_is_named(folder, tmp_path):
    site = read_site(folder / "site.toml")
    flags = tmp_path / "flags.csv"
    flagged = site.model_copy(update={"flags": FlagsSection(file=flags)})
    flags.write_text("from,to,reason\n2026-01-01,2026-01-02,rime\n")
    (one,) = check._flags(flagged)
    assert (one["level"], one["says"]) == ("ok", f"{flags}: 1 intervals")
    flags.write_text("from,to,reason\nyesterday,2026-01-02,rime\n")
    (one,) = check._flags(flagged)
    assert one["level"] == "fault"
    assert "line 2" in one["says"]


def test_an_inbox_that_lets_nothing_go_is_told(folder, monkeypatch):
    site = read_site(folder / "site.toml")
    moving = site.model_copy(update={"retention": RetentionSection(raw="delete")})
    monkeypatch.setattr(
        check.os, "access", lambda path, mode: mode != check.os.W_OK or path != site.scans.inbox
    )
    assert [one["what"] for one in check._folders(moving) if one["level"] == "warning"] == ["retention"]
    assert not [one for one in check._folders(site) if one["level"] == "warning"]
