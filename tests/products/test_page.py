"""The page's files: whole, small, and names in them no more than text."""

import json
import os
import re
import time
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from html.parser import HTMLParser

import numpy as np
import pytest
from PIL import Image

from station.archive import store
from station.archive.reference import write_reference
from station.archive.series import build_series
from station.products import gallery, page
from station.products.gallery import Measured, Style, hang, kept_base, thinned
from station.products.look import base_of
from station.products.maps import MOST_BYTES
from station.products.record import AreaRecord, Record, read_record

NOW_S = 1_763_710_000.0


@pytest.fixture
def told(small):
    return page.Told(
        name=small.EVIL,
        institution="Institute of <Tests>",
        written_s=NOW_S,
        expected_every_s=3600.0,
        waiting=[{"scan": f"{small.EVIL}.laz", "for": "its log", "next_try": None}],
        set_aside=[{"scan": "x.laz", "reason": f"is {small.EVIL}", "since": "2025-11-21T04:00:00Z"}],
        faults=[],
        seconds={"251121_010000": 2.5},
    )


@pytest.fixture
def write(series, site, told):
    def write(told=told, limit_m=None):
        page.write_page(series, site.station.data / "page", told, 600, limit_m, lambda: None)
        return site.station.data / "page"

    return write


def data_of(folder, name="data.js"):
    body = re.fullmatch(r"window\.STATION\w*=(.*);\n", (folder / name).read_text(), re.DOTALL)
    return json.loads(body[1])


class Elements(HTMLParser):
    """All elements and their attributes, and the text."""

    def __init__(self, text):
        super().__init__()
        self.found, self.text = [], ""
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.found.append((tag, dict(attributes)))

    def handle_data(self, text):
        self.text += text


def test_hostile_names_are_text(write, small):
    html = Elements((write() / "index.html").read_text())
    images = [attributes for tag, attributes in html.found if tag == "img"]
    assert len(images) == 3
    assert all(attributes["src"].startswith("maps/hef_2025") for attributes in images)
    assert not any(name.startswith("on") or name == "style" for _, one in html.found for name in one)
    scripts = [attributes["src"] for tag, attributes in html.found if tag == "script"]
    assert scripts == ["data.js", "page.js", "uplot.js"]
    # Station, title, area, scan, its verdict's reason, what waits, what is set aside.
    assert html.text.count(small.EVIL) >= 7
    assert "Institute of <Tests>" in html.text


def test_what_the_page_says_is_what_is_stored(write, small):
    folder = write()
    data = data_of(folder)
    assert data["written_s"] == data_of(folder, "written.js") == NOW_S
    assert [one["time_s"] for one in data["maps"]] == [small.START_S + 3600 * hour for hour in range(6)]
    assert all((folder / one["file"]).is_file() for one in data["maps"])
    rises = data["areas"][0]
    assert rises["mean_m"] == pytest.approx([0.05 * (hour + 1) for hour in range(6)], abs=0.006)
    assert all(0 < sigma < 0.01 for sigma in rises["sigma_m"])
    assert data["health"]["seconds"] == [None, 2.5, None, None, None, None]
    assert data["health"]["stable_z_std"] == [1.02] * 6
    html = Elements((folder / "index.html").read_text()).text
    assert re.search(r"\+0\.30\d ± 0\.00\d", html)  # the newest of the area
    assert "honest" in html
    assert "1.02 σ" in html


def test_what_is_unusable_is_a_gap_in_curves(write, series, small):
    one = replace(small.make_epoch(6), verdict="unusable", verdict_reason="fallen over")
    store.write_epoch(series, one)
    build_series(series)
    folder = write()
    before = data_of(folder)
    assert len(before["health"]["time_s"]) == 7
    short = page._without_unusable(
        AreaRecord("a", 1.0, read_record(series).start_s, {"mean_change": np.ones(7)}), read_record(series)
    )
    assert np.isnan(short.columns["mean_change"]).tolist() == [False] * 6 + [True]
    html = (folder / "index.html").read_text()
    assert html.count('class="unusable"') == 2  # the tile and the table
    assert "unusable: fallen over" in html


def test_before_the_first_scan_there_is_a_page_too(tmp_path, told, series):
    empty = replace(series, folder=tmp_path / "empty")
    page.write_page(empty, tmp_path / "page", told, 600, None, lambda: None)
    assert "No scan is stored yet" in (tmp_path / "page" / "index.html").read_text()
    assert data_of(tmp_path / "page")["maps"] == []


def test_nothing_half_written_is_left_and_what_is_the_same_stays(write, told):
    folder = write()
    before = {path: path.stat().st_ino for path in folder.rglob("*") if path.is_file()}
    again = write(replace(told, written_s=NOW_S + 60))
    changed = {path.name for path, inode in before.items() if path.stat().st_ino != inode}
    assert changed == {"index.html", "data.js", "written.js"}
    assert {path for path in again.rglob("*") if path.is_file()} == before.keys()


def test_a_new_limit_draws_anew_and_takes_down_after_a_grace(write):
    folder = write()
    first = set((folder / "maps").iterdir())
    assert data_of(folder)["maps"][0]["file"].split("/")[1] in {path.name for path in first}
    write(limit_m=2.0)
    assert first < set((folder / "maps").iterdir())  # an open page may still name the old ones
    for path in first:
        os.utime(path, (time.time() - 4000,) * 2)
    write(limit_m=2.0)
    left = set((folder / "maps").iterdir())
    assert not first & left
    assert len(left) == 6 + 2  # the newest has its sigma and points
    assert "±2 m" in (folder / "index.html").read_text()


def test_the_limit_is_fixed_once(write, series, small):
    folder = write()
    kept = json.loads((folder / "limit.json").read_text())["change_limit_m"]
    with np.errstate(invalid="ignore"):
        sigma_m = small.make_epoch(0).measurement.cells["uncertainty_m"]
    assert 10 * np.nanmedian(sigma_m) <= kept <= 25 * np.nanmedian(sigma_m)
    store.revisions(series, store.rows(series)[0].start)[0].path.unlink()
    assert gallery._limit(series, folder, None) == kept  # the first epoch is asked no more


def test_the_newest_come_first_and_few_at_a_time(series, site, monkeypatch):
    monkeypatch.setattr(gallery, "MOST_DRAWN", 2)
    rows = store.Named(series)
    found = [Measured(rows, at, row.start, "1", "") for at, row in enumerate(rows)]
    folder, style = site.station.data / "page", Style("x", 400, 0.5)
    seen = [len(hang(series, folder, found, style, lambda: None).change) for _ in range(4)]
    assert seen == [2, 4, 6, 6]
    hours = [one.start.hour for one in hang(series, folder, found, style, lambda: None).change]
    assert hours == list(range(6))


def test_a_kept_terrain_is_the_same_and_a_damaged_one_made_anew(series, tmp_path):
    fresh = base_of(series, "1", 40)
    for damage in (None, None, b"", b"PK\x03\x04nonsense"):
        if damage is not None:
            (tmp_path / ".terrain_1_40.npz").write_bytes(damage)
        kept = kept_base(series, tmp_path, "1", 40)
        assert (kept.rows, kept.columns, kept.factor, kept.grid) == (
            fresh.rows, fresh.columns, fresh.factor, fresh.grid,
        )  # fmt: skip
        assert kept.shade == pytest.approx(fresh.shade, abs=1 / 250, nan_ok=True)


def test_thinned_by_age():
    newest = datetime(2026, 11, 21, 5, tzinfo=UTC)
    starts = [newest - timedelta(hours=hour) for hour in range(24 * 400)][::-1]
    kept = [starts[index] for index in thinned(np.array([one.timestamp() for one in starts]))]
    assert kept[-1] == newest
    hourly = [one for one in kept if newest - one <= timedelta(days=2)]
    assert len(hourly) == 49
    daily = [one for one in kept if timedelta(days=2) < newest - one <= timedelta(days=60)]
    assert len({one.date() for one in daily}) == len(daily) == 59
    assert all(one.hour == 23 for one in daily[:-1])
    monthly = [one for one in kept if newest - one > timedelta(days=60)]
    assert len({(one.year, one.month) for one in monthly}) == len(monthly) == 12
    assert len(kept) < 130


def test_a_new_scan_is_the_only_one_to_be_drawn():
    """Nothing is kept that was not: a map of an older epoch would be read from its joined month."""
    start_s = datetime(2026, 8, 3, tzinfo=UTC).timestamp() + 3600.0 * np.arange(24 * 110)
    before = set(thinned(start_s[: 24 * 70]))
    for count in range(24 * 70 + 1, len(start_s) + 1):
        now = set(thinned(start_s[:count]))
        assert now - before == {count - 1}
        before = now


def test_years_of_scans_stay_under_the_weight(write, told, monkeypatch):
    """All that a browser loads at first, with the heaviest map there may be, after a year of hourly scans."""
    count, rng = 8760, np.random.default_rng(1)
    start_s = NOW_S - 3600.0 * np.arange(count)[::-1]
    columns = {
        name: rng.normal(size=count)
        for quantity in ("mean_change", "volume_change")
        for name in (quantity, f"{quantity}_uncertainty", "coverage")
    }
    names = [f"area {'with a rather long name ' * 2}{n}" for n in range(12)]
    monkeypatch.setattr(page, "read_areas", lambda _: [AreaRecord(n, 1e6, start_s, columns) for n in names])

    def long(series):
        short = read_record(series)
        return Record(
            start_s,
            ["degraded"] * count,
            {name: rng.normal(size=count) for name in short.numbers},
            {name: [f"251121_{n:06d} {name} {'why ' * 20}" for n in range(count)] for name in short.words}
            | {"reference_version": [""] * count},
        )

    folder = write()
    newest = data_of(folder)["maps"][-1]["file"]
    with Image.open(folder / newest) as picture:
        assert picture.width == 600
    monkeypatch.setattr(page, "read_record", long)
    one = {"reason": "because " * 20, "since": "2025", "for": "its log", "next_try": None}
    many = [{"scan": f"25112_{n}.laz", **one} for n in range(500)]
    write(replace(told, waiting=many, set_aside=many))
    weight = sum((folder / name).stat().st_size for name in (
        "index.html", "page.css", "page.js", "uplot.js", "data.js", "icon.svg"))  # fmt: skip
    assert weight + MOST_BYTES < 300_000
    assert len(data_of(folder)["health"]["time_s"]) <= page.POINTS
    assert data_of(folder)["health"]["time_s"][-1] == round(start_s[-1])
    assert "4 more in" in (folder / "index.html").read_text()


def test_an_epoch_of_another_version_of_the_reference(write, series, site, small):
    write_reference(series, small.make_reference(version="2"))
    one = small.make_epoch(8, reference="2")
    store.write_epoch(series, one)
    build_series(series)
    folder = write()
    assert (folder / ".terrain_2_600.npz").is_file()
    assert data_of(folder)["maps"][-1]["time_s"] == small.START_S + 8 * 3600
    assert site.station.data.is_dir()
