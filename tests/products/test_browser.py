"""The page of a simulated station in Chromium."""

import importlib.util
import json
import re
import shutil
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import pytest

from station.archive.series.index import SeriesIndex, series_in
from station.operations.batch import process_scans
from station.products.page import PageContext, write_page
from station.products.web.stations_page import write_stations
from station.queries.aggregates import Aggregates
from station.simulation.station import simulate, small

pytestmark = pytest.mark.slow
EVIL = "<img src=x onerror=\"document.title='taken'\"><script>alert(1)</script>"
EXPECTED_EVERY_S = 3600.0


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A page written by the service; the names of station and area are markup."""
    from station.config import read_site

    folder = tmp_path_factory.mktemp("station")
    simulate(folder, small(hours=6))
    path = folder / "site.toml"
    text = re.sub(r'(?m)^name = "(?!%)[^"]*"', f"name = '''{EVIL}'''", path.read_text(), count=1)
    path.write_text(text)
    areas = folder / "areas.geojson"
    if areas.is_file():
        geojson = json.loads(areas.read_text())
        geojson["features"][0]["properties"]["name"] = EVIL
        areas.write_text(json.dumps(geojson))
    broken = folder / "inbox" / "250715_990000.laz"
    broken.write_bytes(b"LASF" + bytes(500))
    site = read_site(path)
    status = process_scans(site, sorted(site.scans.inbox.glob("*.laz")), lambda _: None)
    assert status == 3  # the broken one was set aside
    return site.station.data / "page"


@pytest.fixture
def tab(tmp_path):
    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    if chromium is None:
        pytest.skip("chromium is not installed: page not tested in a browser (apt-get install chromium)")
    spec = importlib.util.spec_from_file_location("browser", Path(__file__).with_name("browser.py"))
    browser = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(browser)
    tab = browser.Page(chromium, tmp_path / "profile")
    yield tab
    tab.close()


@pytest.fixture
def served(folder):
    """The address of the page on a plain web server."""
    server = subprocess.Popen(
        [sys.executable, "-u", "-m", "http.server", "0", "--bind", "127.0.0.1"],
        cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
    )  # fmt: skip
    port = re.search(r"port (\d+)", server.stdout.readline())[1]
    yield f"http://127.0.0.1:{port}/index.html"
    server.terminate()
    server.wait()
    server.stdout.close()


@pytest.fixture(params=["file", "server"])
def address(request, folder):
    """The address of the page: in its folder, or on a server."""
    if request.param == "server":
        return request.getfixturevalue("served")
    return folder.as_uri() + "/index.html"


def press(tab, name, code):
    for kind in ("keyDown", "keyUp"):
        tab.call("Input.dispatchKeyEvent", type=kind, key=name, code=name, windowsVirtualKeyCode=code)


def test_page_works_escapes_names_and_makes_no_foreign_request(tab, address):
    tab.open(address)
    maps = tab.run("STATION.maps.length")
    assert maps >= 5
    assert tab.run("document.getElementById('lamp').className") == "lamp fresh"

    # keys and buttons of the slider change the map, and its image loads
    source = "document.getElementById('map-image').getAttribute('src')"
    loaded = (
        "(() => { const i = document.getElementById('map-image'); return i.complete && i.naturalWidth; })()"
    )
    assert tab.await_(loaded) >= 800
    assert tab.run(source) == tab.run("STATION.maps.at(-1).file")
    tab.run("document.getElementById('slider').focus()")
    press(tab, "ArrowLeft", 37)
    assert tab.run(source) == tab.run("STATION.maps.at(-2).file")
    assert tab.await_(loaded) >= 800
    press(tab, "Home", 36)
    assert tab.run(source) == tab.run("STATION.maps[0].file")
    value_text = tab.run("document.getElementById('slider').getAttribute('aria-valuetext')")
    assert re.fullmatch(r"2025-07-15 \d\d:00 UTC", value_text)
    assert value_text[:16] in tab.run("document.getElementById('map-image').alt")
    assert tab.run("document.getElementById('map-caption').textContent").startswith(value_text)
    assert tab.run("document.getElementById('earlier').disabled")
    tab.run("document.getElementById('later').click()")
    assert tab.run(source) == tab.run("STATION.maps[1].file")
    assert tab.await_(loaded) >= 800

    # curves with 95 % bands: pixels in the half-transparent colour of the band
    areas = tab.run("document.querySelectorAll('#area-curves canvas').length")
    assert areas == tab.run("STATION.areas.length") >= 1
    assert tab.run("document.querySelectorAll('#health-curves canvas').length") >= 4
    band = """(() => { const c = document.querySelector('#area-curves canvas');
        const p = c.getContext('2d').getImageData(0, 0, c.width, c.height).data; let n = 0;
        for (let i = 3; i < p.length; i += 4) if (p[i] > 30 && p[i] < 90 && p[i - 1] > p[i - 3] + 60) n++;
        return n; })()"""
    assert tab.run(band) > 200

    # the same values as a table
    tab.run("document.querySelector('#area-curves details').open = true")
    rows = tab.await_("document.querySelectorAll('#area-curves tbody tr').length")
    assert rows == tab.run("STATION.area_time_s.length")
    newest = tab.run("document.querySelector('#area-curves tbody tr').textContent").replace("−", "-")
    assert f"{tab.run('STATION.areas[0].mean_m.at(-1)'):.3f}" in newest
    link = tab.run("document.querySelector('#area-curves details a[download]').href")
    head, *lines = unquote(link.partition(",")[2]).splitlines()
    assert head == "start_utc,value,± 95 %"
    start, mean, half = lines[-1].split(",")
    assert start == f"{datetime.fromtimestamp(tab.run('STATION.area_time_s.at(-1)'), UTC):%FT%T}.000Z"
    assert float(mean) == pytest.approx(tab.run("STATION.areas[0].mean_m.at(-1)"), abs=0.0006)
    assert float(half) == pytest.approx(1.96 * tab.run("STATION.areas[0].sigma_m.at(-1)"), rel=0.01)

    # hostile names are escaped everywhere
    assert tab.run("document.querySelector('h1').textContent") == EVIL
    assert EVIL in tab.run("document.title")
    assert tab.run("document.querySelectorAll('img[src=x]').length") == 0
    assert tab.run("[...document.scripts].every((s) => s.src)")
    assert "250715_990000" in tab.run("document.body.textContent")

    assert tab.errors() == []
    origin = address.rpartition("/")[0]
    assert all(url.startswith((origin, "about:")) for url in tab.requested_urls())


def test_status_light_ages_and_a_newer_page_is_offered(tab, folder):
    address = folder.as_uri() + "/index.html"
    tab.add_startup_script(
        "window.later_s = 0; const now = Date.now; Date.now = () => now() + 1000 * window.later_s;"
        " const every = setInterval; window.setInterval = (f, ms) => every(f, Math.min(ms, 200));"
    )
    tab.open(address)
    state = "document.getElementById('lamp').className"
    assert tab.run(state) == "lamp fresh"
    tab.run(f"later_s = {1.6 * EXPECTED_EVERY_S}")
    tab.await_(f"{state} === 'lamp late'")
    tab.run(f"later_s = {3.2 * EXPECTED_EVERY_S}")
    tab.await_(f"{state} === 'lamp stale'")
    assert "systemctl status" in tab.run("document.getElementById('lamp-text').textContent")
    assert tab.run("document.title").startswith("STALE")
    assert tab.run("document.getElementById('lamp').getAttribute('role')") == "status"
    tab.run("later_s = -4000")
    tab.await_(f"{state} === 'lamp late'")
    # while a user views an old map, a newer page does not replace it: a button appears
    tab.run(f"later_s = {EXPECTED_EVERY_S}; document.getElementById('earlier').click()")
    original = (folder / "written.js").read_text()
    try:
        (folder / "written.js").write_text("window.STATION_WRITTEN_S=99999999999;\n")
        tab.await_("!document.getElementById('reload').hidden")
    finally:
        (folder / "written.js").write_text(original)
    assert tab.errors() == []


def test_page_is_accessible_and_fits_a_phone(tab, folder):
    tab.set_size(360, 740, dark=True)
    tab.open(folder.as_uri() + "/index.html")
    assert tab.run("document.documentElement.scrollWidth") == 360  # only tables scroll sideways
    dark = tab.run("getComputedStyle(document.body).backgroundColor")
    tab.set_size(1280, 800)
    assert tab.run("getComputedStyle(document.body).backgroundColor") != dark
    # controls and images have names, tables have captions and headings
    tab.call("Accessibility.enable")
    tree = tab.call("Accessibility.getFullAXTree")["nodes"]
    roles = {"button", "slider", "link", "image", "img"}
    named = [node for node in tree if node.get("role", {}).get("value") in roles and not node.get("ignored")]
    assert len(named) > 8
    assert all(node["name"]["value"].strip() for node in named)
    assert tab.run("[...document.querySelectorAll('table')].every((t) => t.caption && t.tHead)")
    assert tab.run("[...document.querySelectorAll('h1,h2,h3')].length") > 5
    focused = set()
    for _ in range(24):
        press(tab, "Tab", 9)
        focused.add(tab.run("document.activeElement.id || document.activeElement.tagName"))
    assert {"slider", "earlier"} <= focused


def test_page_loads_on_a_slow_connection(tab, served):
    """128 kbit/s and 600 ms latency: time to the first paint and to the status light; total size."""
    rate = 128_000 / 8
    tab.call(
        "Network.emulateNetworkConditions",
        offline=False,
        latency=600,
        downloadThroughput=rate,
        uploadThroughput=rate,
    )
    tab.add_startup_script(
        "new MutationObserver(() => { const l = document.getElementById('lamp');"
        " if (l && l.classList.contains('fresh')) window.light_ms ??= performance.now(); })"
        ".observe(document, { subtree: true, childList: true, attributes: true });"
    )
    tab.open(served)
    first_paint_ms = tab.run("performance.getEntriesByName('first-contentful-paint')[0].startTime")
    size = tab.run(
        "performance.getEntriesByType('resource').reduce((n, r) => n + r.encodedBodySize, 0)"
        " + performance.getEntriesByType('navigation')[0].encodedBodySize"
    )
    assert first_paint_ms < 5000  # 2.9 s on a busy machine; what it needs at this rate is 3 s or less:
    before_s = tab.run(
        "(() => { const [page] = performance.getEntriesByType('navigation');"
        " const style = performance.getEntriesByName(new URL('page.css', location).href)[0];"
        " return 1.2 + (page.encodedBodySize + style.encodedBodySize) / 16000; })()"
    )
    assert 1.5 < before_s < 3
    assert tab.run("light_ms") < 10_000
    assert 50_000 < size < 300_000
    place = tab.run("STATION.outlines.areas[0].rings[0][0]")
    answer = f"stationCurves.reader(STATION.curves).place({json.dumps(place)})"
    tap_ms = tab.run(
        f"(async () => {{ const t = performance.now(), answer = await {answer};"
        " return answer && performance.now() - t; })()"
    )
    assert 600 < tap_ms < 3000  # tiles of a place, at the same time


def test_empty_page_raises_no_error(tab, tmp_path, folder):
    from dataclasses import replace

    empty = replace(series_in(folder.parent), folder=tmp_path / "empty")
    context = PageContext("New", "", 1.0, 3600.0, [], [], ["the disk is full"], {})
    write_page(empty, tmp_path / "page", context, 1200, None, lambda: None)
    tab.open((tmp_path / "page" / "index.html").as_uri())
    assert tab.run("document.getElementById('lamp').className") == "lamp stale"
    assert "the disk is full" in tab.run("document.body.textContent")
    assert tab.errors() == []


def test_areas_have_the_mean_and_sigma_of_the_store(tab, folder):
    series = series_in(folder.parent)
    grid, aggregates, index = series.grid, Aggregates(series), SeriesIndex(series)
    rows, columns = np.nonzero(np.isfinite(aggregates.reference().elevation_m))
    tab.open(folder.as_uri() + "/index.html")
    cells = round(tab.run("STATION.curves.block_m") / grid.cell_m)
    rng, ratios = np.random.default_rng(3), []
    for size in (1, 1, 3, 8, 8, 8, 1, 3, 8):  # blocks
        place = rng.integers(len(rows))
        top, left = (int(k[place]) // cells * cells for k in (rows, columns))
        side = size * cells
        west_m, north_m = (
            grid.west_m + (left + 0.001) * grid.cell_m,
            grid.north_m - (top + 0.001) * grid.cell_m,
        )
        side_m = (side - 0.002) * grid.cell_m
        corners = [[west_m + e * side_m, north_m - s * side_m] for e, s in ((0, 0), (1, 0), (1, 1), (0, 1))]
        answer = tab.run(f"stationCurves.reader(STATION.curves).area({json.dumps(corners)})")
        mask = np.zeros(grid.shape, bool)
        mask[top : top + side, left : left + side] = True
        for point in answer["curve"]:
            if point["change"] is None:
                continue
            epoch = index[int(np.argmin(np.abs(index.start_s - point["time_s"])))]
            ratios.append(point["sigma"] / aggregates.variance(mask, epoch) ** 0.5)
            stored_m = np.nanmean(aggregates.read_cells(epoch, mask).change_m)
            assert point["change"] == pytest.approx(stored_m, abs=0.0011)
    assert len(ratios) >= 4
    assert 0.9 < min(ratios) <= max(ratios) < 1.1
    assert tab.errors() == []


def test_the_change_between_two_scans_has_the_sigma_of_the_store(tab, folder):
    """Of places of 10 m and areas of 80 m that the last two scans observed, after a similar change."""
    series = series_in(folder.parent)
    grid, aggregates, index = series.grid, Aggregates(series), SeriesIndex(series)
    before, after = index[-2], index[-1]
    seen = np.isfinite(aggregates.reference().elevation_m)
    known = seen.copy()
    for epoch in (before, after):
        seen[known] &= np.isfinite(aggregates.read_cells(epoch, known).change_m)
    tab.open(folder.as_uri() + "/index.html")
    cells = round(tab.run("STATION.curves.block_m") / grid.cell_m)
    ratios, without = [], []
    for size, count in ((cells, 5), (8 * cells, 6)):
        edges = [np.arange(0, length, size) for length in grid.shape]
        total = np.add.reduceat(np.add.reduceat(seen.astype(int), edges[0], axis=0), edges[1], axis=1)
        whole = np.argwhere(total >= (1.0 if size == cells else 0.97) * size**2)
        assert len(whole) >= count
        for row, column in np.random.default_rng(5).choice(whole, count, replace=False):
            mask = np.zeros(grid.shape, bool)
            mask[row * size : (row + 1) * size, column * size : (column + 1) * size] = True
            east_m, north_m = (
                [float(k[mask.any(axis)].min() - half), float(k[mask.any(axis)].max() + half)]
                for k, axis, half in ((grid.x_m, 0, 0.49 * grid.cell_m), (grid.y_m, 1, 0.49 * grid.cell_m))
            )
            corners = [
                [e, n] for e, n in zip(east_m + east_m[::-1], np.repeat(north_m, 2).tolist(), strict=True)
            ]
            shown, ignored = tab.run(
                "(async () => { const reader = stationCurves.reader(STATION.curves),"
                f" {{ curve }} = await reader.area({json.dumps(corners)}), [from, to] = curve.slice(-2),"
                " correlation = (await reader.correlations())(to.time_s, from.time_s);"
                " return [correlation, 0].map((c) => stationCurves.between(to, from, c)); })()"
            )
            stored_m = aggregates.variance(mask & seen, after, before) ** 0.5
            ratios.append(shown["sigma"] / stored_m)
            without.append(ignored["sigma"] / stored_m)
            if size == cells:
                change_m = [aggregates.read_cells(epoch, mask).change_m.mean() for epoch in (after, before)]
                assert shown["change"] == pytest.approx(change_m[0] - change_m[1], abs=0.0011)
    assert 0.9 < min(ratios) <= max(ratios) < 1.1
    assert max(without) > 1.1
    assert tab.errors() == []


def test_a_link_leads_to_the_curve_of_a_place(tab, address, folder):
    series = series_in(folder.parent)
    grid = series.grid
    rows, columns = np.nonzero(np.isfinite(Aggregates(series).reference().elevation_m))
    place = len(rows) // 2
    tab.open(f"{address}#at={grid.x_m[columns[place]]},{grid.y_m[rows[place]]}")
    tab.await_("document.querySelectorAll('#asked canvas, #asked-values').length >= 1")
    assert "95 %" in tab.run("document.getElementById('asked').textContent")
    tab.run("document.getElementById('map-canvas').focus()")
    press(tab, "Escape", 27)
    assert tab.run("document.getElementById('asked').hidden")
    assert tab.run("location.hash") == ""
    assert tab.errors() == []


def test_page_of_several_stations_reads_their_pages(tab, folder, tmp_path):
    """From a folder: a row each, its state and newest map; a station without a page is named."""
    station_id = json.loads((folder / "summary.js").read_text().partition("[")[2].partition("]")[0])
    stations = [(station_id, EVIL, folder), ("gone", "Far away", tmp_path / "nothing")]
    write_stations(tmp_path / "all" / "index.html", stations, "en")
    tab.open((tmp_path / "all" / "index.html").as_uri())
    tab.await_("document.querySelectorAll('.lamp').length == 2")
    cells = tab.run(
        "[...document.querySelectorAll('tbody tr')].map(r => [...r.cells].map(c => c.textContent))"
    )
    assert cells[0][0] == EVIL
    assert cells[0][1].startswith("Up to date")
    assert re.match(r"2025-07-15 \d\d:00 UTC: (good|degraded)", cells[0][2])
    assert cells[1] == ["Far away", "no page found", "", "", ""]
    assert tab.await_(
        "(() => { const i = document.querySelector('img'); return i.complete && i.naturalWidth; })()"
    )
    assert tab.run("document.querySelector('a').href").endswith("page/index.html")
    assert tab.run("document.title") == "Stations"
