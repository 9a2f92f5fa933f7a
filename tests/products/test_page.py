"""The files of the page: complete, small, and any name in them is escaped."""

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
from support.series import open_with_processing

from station.archive import epochs
from station.archive.reference_files import write_reference
from station.archive.series import index
from station.archive.series.virtual import build_series
from station.processing.site_files import load_areas
from station.products import gallery, page
from station.products.epoch_table import AreaSeries, EpochTable, read_epoch_table
from station.products.gallery import MeasuredEpoch, Style, cached_base_map, retention_indices, update_gallery
from station.products.maps import MAX_BYTES
from station.products.overview import base_map
from station.products.web.page_areas import mask_unusable
from station.queries.site_products.product_queries import Product, update_products
from station.queries.site_products.profile_lines import sample_line
from station.sections.product import ProductSection

NOW_S = 1_763_710_000.0


@pytest.fixture
def context(small):
    return page.PageContext(
        name=small.EVIL,
        institution="Institute of <Tests>",
        written_s=NOW_S,
        expected_every_s=3600.0,
        waiting=[{"scan": f"{small.EVIL}.laz", "for": "its log", "next_try": None}],
        set_aside=[{"scan": "x.laz", "reason": f"is {small.EVIL}", "since": "2025-11-21T04:00:00Z"}],
        faults=[],
        durations_s={"251121_010000": 2.5},
    )


@pytest.fixture
def write(series, site, context):
    def write(context=context, limit_m=None):
        page.write_page(series, site.station.data / "page", context, 600, limit_m, lambda: None)
        return site.station.data / "page"

    return write


def page_data(folder, name="data.js"):
    body = re.fullmatch(r"window\.STATION\w*=(.*);\n", (folder / name).read_text(), re.DOTALL)
    return json.loads(body[1])


class Elements(HTMLParser):
    """The elements of a page with their attributes, and its text."""

    def __init__(self, text):
        super().__init__()
        self.elements, self.text = [], ""
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.elements.append((tag, dict(attributes)))

    def handle_data(self, text):
        self.text += text


def test_hostile_names_are_escaped(write, small):
    html = Elements((write() / "index.html").read_text())
    images = [attributes for tag, attributes in html.elements if tag == "img"]
    assert len(images) == 1
    assert all(attributes["src"].startswith("maps/hef_2025") for attributes in images)
    assert not any(
        name.startswith("on") or name == "style" for _, attributes in html.elements for name in attributes
    )
    scripts = [attributes["src"] for tag, attributes in html.elements if tag == "script"]
    assert scripts == ["data.js", "page.js"]
    # station, title, area, scan, reason of its verdict, a waiting scan, a scan set aside
    assert html.text.count(small.EVIL) >= 7
    assert "Institute of <Tests>" in html.text


def test_page_shows_the_stored_values(write, small):
    folder = write()
    data = page_data(folder)
    assert data["written_s"] == page_data(folder, "written.js") == NOW_S
    assert [image["time_s"] for image in data["maps"]] == [small.START_S + 3600 * hour for hour in range(6)]
    assert all((folder / image["file"]).is_file() for image in data["maps"])
    area = data["areas"][0]
    assert area["mean_m"] == pytest.approx([0.05 * (hour + 1) for hour in range(6)], abs=0.006)
    assert all(0 < sigma < 0.01 for sigma in area["sigma_m"])
    assert data["health"]["seconds"] == [None, 2.5, None, None, None, None]
    assert data["health"]["stable_z_std"] == [1.02] * 6
    html = Elements((folder / "index.html").read_text()).text
    assert re.search(r"\+0\.30\d ± 0\.00\d", html)  # newest value of the area
    assert "right" in html
    assert "1.02 σ" in html


def test_page_in_german(write, context):
    folder = write(replace(context, language="de", alarms=[{"text": "no scan", "since_s": NOW_S}]))
    html = (folder / "index.html").read_text()
    assert '<html lang="de">' in html
    assert "Geht es der Station gut?" in html
    assert "Alarm:</strong> no scan (seit 2025-11-21 07:26 UTC)" in html
    assert page_data(folder)["text"]["js_late"] == "Verspätet"


@pytest.mark.parametrize("has_links", [True, False])
def test_page_offers_the_areas_as_stored(write, series, monkeypatch, has_links):
    if not has_links:
        monkeypatch.setattr(os, "link", lambda *_: (_ for _ in ()).throw(OSError("no hard links here")))
    stored, folder = series.folder / "areas.nc", write()
    html = Elements((folder / "index.html").read_text())
    offered = [attributes["href"] for _, attributes in html.elements if "download" in attributes]
    assert offered == ["areas.nc"]
    assert (folder / "areas.nc").read_bytes() == stored.read_bytes()
    newer = stored.with_name("newer")
    newer.write_bytes(b"of the next scan")
    newer.replace(stored)  # as the store does it
    page._offer(stored, folder / "areas.nc")
    assert (folder / "areas.nc").read_bytes() == b"of the next scan"
    stored.unlink()
    page._offer(stored, folder / "areas.nc")
    assert not list(folder.glob("*areas.nc*"))


def test_unusable_epochs_are_gaps_in_the_curves(write, series, small):
    unusable = replace(small.make_epoch(6), verdict="unusable", verdict_reason="fallen over")
    epochs.write_epoch(series, unusable)
    build_series(series)
    folder = write()
    assert len(page_data(folder)["health"]["time_s"]) == 7
    masked = mask_unusable(
        AreaSeries("a", 1.0, *2 * [read_epoch_table(series).start_s], {"mean_change": np.ones(7)}),
        read_epoch_table(series),
    )
    assert np.isnan(masked.columns["mean_change"]).tolist() == [False] * 6 + [True]
    html = (folder / "index.html").read_text()
    assert html.count('class="unusable"') == 4  # the tile, the timeline, the reasons, the table of scans
    assert "unusable: fallen over" in html


def test_page_without_any_scan(tmp_path, context, series):
    empty = replace(series, folder=tmp_path / "empty")
    page.write_page(empty, tmp_path / "page", context, 600, None, lambda: None)
    assert "No scan is stored yet" in (tmp_path / "page" / "index.html").read_text()
    assert page_data(tmp_path / "page")["maps"] == []


@pytest.mark.integration
def test_only_changed_files_are_replaced_and_no_temporary_file_remains(write, context):
    folder = write()
    before = {path: path.stat().st_ino for path in folder.rglob("*") if path.is_file()}
    again = write(replace(context, written_s=NOW_S + 60))
    changed = {path.name for path, inode in before.items() if path.stat().st_ino != inode}
    assert changed == {"index.html", "data.js", "written.js", "summary.js"}
    assert {path for path in again.rglob("*") if path.is_file()} == before.keys()


@pytest.mark.integration
def test_new_colour_limit_redraws_maps_and_deletes_old_ones_after_a_grace_period(write):
    folder = write()
    first = set((folder / "maps").iterdir())
    assert page_data(folder)["maps"][0]["file"].split("/")[1] in {path.name for path in first}
    write(limit_m=2.0)
    assert first < set((folder / "maps").iterdir())  # an open page may still refer to the old ones
    for path in first:
        os.utime(path, (time.time() - 4000,) * 2)
    write(limit_m=2.0)
    remaining = set((folder / "maps").iterdir())
    assert not first & remaining
    assert len(remaining) == 6
    assert "±2 m" in (folder / "index.html").read_text()


def test_colour_limit_is_fixed_by_the_first_epoch(write, series, small):
    folder = write()
    limit_m = json.loads((folder / "limit.json").read_text())["change_limit_m"]
    with np.errstate(invalid="ignore"):
        sigma_m = small.make_epoch(0).measurement.cells["uncertainty_m"]
    assert 10 * np.nanmedian(sigma_m) <= limit_m <= 25 * np.nanmedian(sigma_m)
    epochs.revisions(series, index.list_epochs(series)[0].start)[0].path.unlink()
    assert gallery._fixed_limit(series, folder, None) == limit_m  # without reading the first epoch again


@pytest.mark.integration
def test_newest_maps_are_made_first_and_few_per_call(series, site, monkeypatch):
    monkeypatch.setattr(gallery, "MAX_MADE", 2)
    rows = index.SeriesIndex(series)
    measured = [MeasuredEpoch(rows, index, row.start, "1", "") for index, row in enumerate(rows)]
    folder, style = site.station.data / "page", Style("x", 400, 0.5)
    counts = [len(update_gallery(series, folder, measured, style, lambda: None).change) for _ in range(4)]
    assert counts == [2, 4, 6, 6]
    hours = [
        image.start.hour for image in update_gallery(series, folder, measured, style, lambda: None).change
    ]
    assert hours == list(range(6))
    whole = sorted((folder / "maps").iterdir())
    for path, damage in zip(whole[:3], (b"", b"RIFF\0\0\0\0WEBP", whole[2].read_bytes()[:-10]), strict=True):
        path.write_bytes(damage)
    for _ in range(2):  # damaged older maps are drawn again, as missing ones are
        update_gallery(series, folder, measured, style, lambda: None)
    sizes = [Image.open(path).convert("RGB").size for path in whole]
    assert len(set(sizes)) == 1


def test_cached_terrain_is_reused_and_a_damaged_cache_is_rebuilt(series, tmp_path):
    fresh = base_map(series, "1", 40)
    for damage in (None, None, b"", b"PK\x03\x04nonsense"):
        if damage is not None:
            (tmp_path / ".terrain_1_40.npz").write_bytes(damage)
        cached = cached_base_map(series, tmp_path, "1", 40)
        assert (cached.rows, cached.columns, cached.factor, cached.grid) == (
            fresh.rows, fresh.columns, fresh.factor, fresh.grid,
        )  # fmt: skip
        assert cached.hillshade == pytest.approx(fresh.hillshade, abs=1 / 250, nan_ok=True)


def test_retention_thins_maps_by_age():
    newest = datetime(2026, 11, 21, 5, tzinfo=UTC)
    starts = [newest - timedelta(hours=hour) for hour in range(24 * 400)][::-1]
    kept = [starts[index] for index in retention_indices(np.array([start.timestamp() for start in starts]))]
    assert kept[-1] == newest
    hourly = [start for start in kept if newest - start <= timedelta(days=2)]
    assert len(hourly) == 49
    daily = [start for start in kept if timedelta(days=2) < newest - start <= timedelta(days=60)]
    assert len({start.date() for start in daily}) == len(daily) == 59
    assert all(start.hour == 23 for start in daily[:-1])
    monthly = [start for start in kept if newest - start > timedelta(days=60)]
    assert len({(start.year, start.month) for start in monthly}) == len(monthly) == 12
    assert len(kept) < 130


def test_retention_never_brings_back_a_deleted_map():
    """Only the map of a new scan is drawn; to draw an older one, a compacted month would have to be read."""
    start_s = datetime(2026, 8, 3, tzinfo=UTC).timestamp() + 3600.0 * np.arange(24 * 110)
    retained = set(retention_indices(start_s[: 24 * 70]))
    for count in range(24 * 70 + 1, len(start_s) + 1):
        updated = set(retention_indices(start_s[:count]))
        assert updated - retained == {count - 1}
        retained = updated


@pytest.mark.integration
def test_page_size_is_limited_after_a_year_of_hourly_scans(write, context, monkeypatch):
    """Everything that a browser loads first, with the largest map possible, is less than 300 kB."""
    count, rng = 8760, np.random.default_rng(1)
    start_s = NOW_S - 3600.0 * np.arange(count)[::-1]
    columns = {
        name: rng.normal(size=count)
        for quantity in ("mean_change", "volume_change")
        for name in (quantity, f"{quantity}_uncertainty", "coverage")
    }
    names = [f"area {'with a rather long name ' * 2}{n}" for n in range(12)]
    monkeypatch.setattr(
        page,
        "usable_area_series",
        lambda *_: [AreaSeries(n, 1e6, start_s, start_s + 900, columns) for n in names],
    )

    def year_of_epochs(series):
        table = read_epoch_table(series)
        return EpochTable(
            start_s,
            start_s + 900,
            ["degraded"] * count,
            {name: rng.normal(size=count) for name in table.scalars},
            {name: [f"251121_{n:06d} {name} {'why ' * 20}" for n in range(count)] for name in table.texts}
            | {"reference_version": [""] * count},
        )

    folder = write()
    newest = page_data(folder)["maps"][-1]["file"]
    with Image.open(folder / newest) as picture:
        assert picture.width == 600
    monkeypatch.setattr(page, "read_epoch_table", year_of_epochs)
    entry = {"reason": "because " * 20, "since": "2025", "for": "its log", "next_try": None}
    many = [{"scan": f"25112_{n}.laz", **entry} for n in range(500)]
    write(replace(context, waiting=many, set_aside=many))
    size = sum((folder / name).stat().st_size for name in (
        "index.html", "page.css", "page.js", "uplot.js", "data.js", "icon.svg"))  # fmt: skip
    assert size + MAX_BYTES < 300_000
    assert len(page_data(folder)["health"]["time_s"]) <= page.MAX_CURVE_POINTS
    assert page_data(folder)["health"]["time_s"][-1] == round(start_s[-1])
    assert "4 more in" in (folder / "index.html").read_text()


@pytest.mark.integration
def test_maps_use_the_reference_version_of_their_epoch(write, series, site, small):
    write_reference(series, small.make_reference(version="2"))
    epochs.write_epoch(series, small.make_epoch(8, reference="2"))
    build_series(series)
    folder = write()
    assert (folder / ".terrain_2_600.npz").is_file()
    assert page_data(folder)["maps"][-1]["time_s"] == small.START_S + 8 * 3600
    assert site.station.data.is_dir()


def test_products_have_values_and_curves(write, context, site, series, small):
    """The box rises by 5 cm an hour, of half the density of water; the last scan may not be used."""
    settings = {"name": "deposit", "kind": "surface_mass_balance", "density_kg_m3": 500}
    product = Product(ProductSection.model_validate(settings), load_areas(site))
    epochs.write_epoch(series, replace(small.make_epoch(6), verdict="unusable"))
    build_series(series)
    update_products(series, [product], ["deposit"], lambda: None)
    folder = write(replace(context, language="de"))
    curve, evil = page_data(folder)["products"]
    assert (curve["product"], curve["place"], evil["place"]) == ("deposit", "rises", small.EVIL)
    assert curve["time_s"] == [small.START_S + 3600 * hour for hour in range(6)]
    assert curve["values"] == pytest.approx([0.025 * (hour + 1) for hour in range(6)], abs=0.003)
    html = Elements((folder / "index.html").read_text()).text
    assert re.search(r"Massenbilanz, Wasseräquivalent\s*2025-11-21 05:00\s*0\.15\d ± 0\.00\d m", html)


def test_profiles_are_drawn_along_their_line(write, context, series, small):
    """Across the box that rises by 5 cm an hour; the last scan may not be used."""
    x_m, y_m = small.GRID.x_m, small.GRID.y_m
    line_m = [(float(x_m[2]), float(y_m[20])), (float(x_m[-3]), float(y_m[20]))]
    section = ProductSection.model_validate({"name": "across", "kind": "profile", "line": line_m})
    line = sample_line(section.line, small.GRID)
    epochs.write_epoch(series, replace(small.make_epoch(6), verdict="unusable"))
    build_series(series)
    update_products(
        series, [Product(section, {"across": line.cells}, {"across": line})], ["across"], lambda: None
    )
    folder = write(replace(context, language="de"))
    height, change = page_data(folder)["profiles"]
    assert [height["quantity"], change["quantity"]] == ["Höhe", "Änderung seit der Referenz"]
    assert (change["title"], change["time_s"]) == ("across", small.START_S + 5 * 3600)
    assert change["distance_m"] == pytest.approx(line.distance_m, abs=0.01)
    known = [k for k, value in enumerate(change["values"]) if value is not None]
    with open_with_processing(series.folder) as ds:
        expected = ds.elevation_change.values[5, 20, 2:-2]
    assert [change["values"][k] for k in known] == pytest.approx([expected[k] for k in known], abs=2e-3)
    assert all(change["sigma"][k] > 0 for k in known)
    assert 'id="product-curves"' in (folder / "index.html").read_text()
