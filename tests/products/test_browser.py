"""The real page of a simulated station in a real browser."""

import importlib.util
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from station.archive.store import series_in
from station.products.page import Told, write_page
from station.service.once import process_scans
from station.simulation.station import simulate, tiny

pytestmark = pytest.mark.slow
EVIL = "<img src=x onerror=\"document.title='taken'\"><script>alert(1)</script>"
LOOKS_S = 3600.0


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A page as the service makes it, of a station and an area whose names are markup."""
    from station.config import read_site

    folder = tmp_path_factory.mktemp("station")
    simulate(folder, tiny(hours=6))
    path = folder / "site.toml"
    told = re.sub(r'(?m)^name = "(?!%)[^"]*"', f"name = '''{EVIL}'''", path.read_text(), count=1)
    path.write_text(told)
    areas = folder / "areas.geojson"
    if areas.is_file():
        told = json.loads(areas.read_text())
        told["features"][0]["properties"]["name"] = EVIL
        areas.write_text(json.dumps(told))
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
        pytest.skip("chromium is not installed: the page was seen by no browser (apt-get install chromium)")
    spec = importlib.util.spec_from_file_location("browser", Path(__file__).with_name("browser.py"))
    browser = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(browser)
    tab = browser.Page(chromium, tmp_path / "profile")
    yield tab
    tab.close()


@pytest.fixture
def served(folder):
    """The page's address at a plain web server."""
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
    """The same page from its folder and from a server."""
    if request.param == "server":
        return request.getfixturevalue("served")
    return folder.as_uri() + "/index.html"


def key(tab, name, code):
    for kind in ("keyDown", "keyUp"):
        tab.call("Input.dispatchKeyEvent", type=kind, key=name, code=name, windowsVirtualKeyCode=code)


def test_the_page_works_says_names_as_text_and_asks_nobody_else(tab, address):
    tab.open(address)
    maps = tab.run("STATION.maps.length")
    assert maps >= 5
    assert tab.run("document.getElementById('lamp').className") == "lamp fresh"

    # The slider moves the map: by key, by button; and the picture is another one, and there.
    source = "document.getElementById('map-image').getAttribute('src')"
    whole = (
        "(() => { const i = document.getElementById('map-image'); return i.complete && i.naturalWidth; })()"
    )
    assert tab.await_(whole) >= 800
    assert tab.run(source) == tab.run("STATION.maps.at(-1).file")
    tab.run("document.getElementById('slider').focus()")
    key(tab, "ArrowLeft", 37)
    assert tab.run(source) == tab.run("STATION.maps.at(-2).file")
    assert tab.await_(whole) >= 800
    key(tab, "Home", 36)
    assert tab.run(source) == tab.run("STATION.maps[0].file")
    told = tab.run("document.getElementById('slider').getAttribute('aria-valuetext')")
    assert re.fullmatch(r"2025-07-15 \d\d:00 UTC", told)
    assert told[:16] in tab.run("document.getElementById('map-image').alt")
    assert tab.run("document.getElementById('map-caption').textContent").startswith(told)
    assert tab.run("document.getElementById('earlier').disabled")
    tab.run("document.getElementById('later').click()")
    assert tab.run(source) == tab.run("STATION.maps[1].file")
    assert tab.await_(whole) >= 800

    # Curves with bands: pixels of the band's half transparent colour between the lines of 95 %.
    areas = tab.run("document.querySelectorAll('#area-curves canvas').length")
    assert areas == tab.run("STATION.areas.length") >= 1
    assert tab.run("document.querySelectorAll('#health-curves canvas').length") >= 4
    band = """(() => { const c = document.querySelector('#area-curves canvas');
        const p = c.getContext('2d').getImageData(0, 0, c.width, c.height).data; let n = 0;
        for (let i = 3; i < p.length; i += 4) if (p[i] > 30 && p[i] < 90 && p[i - 1] > p[i - 3] + 60) n++;
        return n; })()"""
    assert tab.run(band) > 200

    # The same numbers as a table.
    tab.run("document.querySelector('#area-curves details').open = true")
    rows = tab.await_("document.querySelectorAll('#area-curves tbody tr').length")
    assert rows == tab.run("STATION.area_time_s.length")
    newest = tab.run("document.querySelector('#area-curves tbody tr').textContent").replace("−", "-")
    assert f"{tab.run('STATION.areas[0].mean_m.at(-1)'):.3f}" in newest

    # A hostile name is text, everywhere.
    assert tab.run("document.querySelector('h1').textContent") == EVIL
    assert EVIL in tab.run("document.title")
    assert tab.run("document.querySelectorAll('img[src=x]').length") == 0
    assert tab.run("[...document.scripts].every((s) => s.src)")
    assert "250715_990000" in tab.run("document.body.textContent")

    assert tab.complaints() == []
    own = address.rpartition("/")[0]
    assert all(one.startswith((own, "about:")) for one in tab.asked())


def test_the_lamp_goes_out_when_the_clock_passes_and_a_newer_page_is_found(tab, folder):
    address = folder.as_uri() + "/index.html"
    tab.before_all(
        "window.later_s = 0; const now = Date.now; Date.now = () => now() + 1000 * window.later_s;"
        " const every = setInterval; window.setInterval = (f, ms) => every(f, Math.min(ms, 200));"
    )
    tab.open(address)
    state = "document.getElementById('lamp').className"
    assert tab.run(state) == "lamp fresh"
    tab.run(f"later_s = {1.6 * LOOKS_S}")
    tab.await_(f"{state} === 'lamp late'")
    tab.run(f"later_s = {3.2 * LOOKS_S}")
    tab.await_(f"{state} === 'lamp stale'")
    assert "systemctl status" in tab.run("document.getElementById('lamp-text').textContent")
    assert tab.run("document.title").startswith("STALE")
    assert tab.run("document.getElementById('lamp').getAttribute('role')") == "status"
    tab.run("later_s = -4000")
    tab.await_(f"{state} === 'lamp late'")
    # Someone looks at an old map while the service writes a newer page: nothing moves, a button shows up.
    tab.run(f"later_s = {LOOKS_S}; document.getElementById('earlier').click()")
    newer = (folder / "written.js").read_text()
    try:
        (folder / "written.js").write_text("window.STATION_WRITTEN_S=99999999999;\n")
        tab.await_("!document.getElementById('reload').hidden")
    finally:
        (folder / "written.js").write_text(newer)
    assert tab.complaints() == []


def test_readable_on_a_phone_by_keys_and_without_colours(tab, folder):
    tab.size(360, 740, dark=True)
    tab.open(folder.as_uri() + "/index.html")
    assert tab.run("document.documentElement.scrollWidth") == 360  # nothing to pan but the tables
    dark = tab.run("getComputedStyle(document.body).backgroundColor")
    tab.size(1280, 800)
    assert tab.run("getComputedStyle(document.body).backgroundColor") != dark
    # Whatever can be worked has a name; images say what they show; each table its caption and heads.
    tab.call("Accessibility.enable")
    tree = tab.call("Accessibility.getFullAXTree")["nodes"]
    roles = {"button", "slider", "link", "image", "img"}
    worked = [node for node in tree if node.get("role", {}).get("value") in roles and not node.get("ignored")]
    assert len(worked) > 8
    assert all(node["name"]["value"].strip() for node in worked)
    assert tab.run("[...document.querySelectorAll('table')].every((t) => t.caption && t.tHead)")
    assert tab.run("[...document.querySelectorAll('h1,h2,h3')].length") > 5
    seen = set()
    for _ in range(12):
        key(tab, "Tab", 9)
        seen.add(tab.run("document.activeElement.id || document.activeElement.tagName"))
    assert {"slider", "earlier"} <= seen


def test_something_is_seen_within_five_seconds_on_a_thin_line(tab, served):
    """128 kbit/s and 600 ms to the server: first words, then the lamp; and the whole weight."""
    rate = 128_000 / 8
    tab.call(
        "Network.emulateNetworkConditions",
        offline=False,
        latency=600,
        downloadThroughput=rate,
        uploadThroughput=rate,
    )
    tab.before_all(
        "new MutationObserver(() => { const l = document.getElementById('lamp');"
        " if (l && l.classList.contains('fresh')) window.lit_ms ??= performance.now(); })"
        ".observe(document, { subtree: true, childList: true, attributes: true });"
    )
    tab.open(served)
    first = tab.run("performance.getEntriesByName('first-contentful-paint')[0].startTime")
    weight = tab.run(
        "performance.getEntriesByType('resource').reduce((n, r) => n + r.encodedBodySize, 0)"
        " + performance.getEntriesByType('navigation')[0].encodedBodySize"
    )
    assert first < 5000
    assert tab.run("lit_ms") < 10_000
    assert 50_000 < weight < 300_000


def test_an_empty_page_has_no_complaint(tab, tmp_path, folder):
    from dataclasses import replace

    empty = replace(series_in(folder.parent), folder=tmp_path / "empty")
    told = Told("New", "", 1.0, 3600.0, [], [], ["the disk is full"], {})
    write_page(empty, tmp_path / "page", told, 1200, None, lambda: None)
    tab.open((tmp_path / "page" / "index.html").as_uri())
    assert tab.run("document.getElementById('lamp').className") == "lamp stale"
    assert "the disk is full" in tab.run("document.body.textContent")
    assert tab.complaints() == []
