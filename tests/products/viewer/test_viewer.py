"""The map of the page in Chromium and Firefox: what it says of a place is what the store says."""

import importlib.util
import io
import re
import shutil
import threading
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import station
from station.archive.areas import update_areas
from station.archive.derived import level_files
from station.archive.netcdf_layout import Series
from station.archive.reference_files import write_reference
from station.archive.series.index import SeriesIndex
from station.config import read_site
from station.products import page
from station.queries.aggregates import Aggregates
from station.readers.polygons import cells_inside, read_polygons

pytestmark = pytest.mark.integration
PLACE = 34, 20  # column and row, not in the middle of the map
LEVEL_SIGMA_M = 0.006, 0.008  # random and systematic
REFERENCE_M = 0.014  # random sigma of its cells


def browser(name, executables, profile):
    """A page of a browser; skipped if none of its executables is installed."""
    executable = next(filter(None, map(shutil.which, executables)), None)
    if executable is None:
        pytest.skip(f"map not tested in {executables[0]}: apt-get install {executables[0]}")
    spec = importlib.util.spec_from_file_location(name, Path(__file__).parents[1] / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.Page(executable, profile)


@pytest.fixture(scope="module")
def tab(tmp_path_factory):
    tab = browser("browser", ["chromium", "chromium-browser"], tmp_path_factory.mktemp("browser"))
    yield tab
    tab.close()


@pytest.fixture(scope="module")
def firefox(tmp_path_factory):
    window = browser("firefox", ["firefox-esr", "firefox"], tmp_path_factory.mktemp("firefox") / "profile")
    yield window
    window.close()


@pytest.fixture(scope="module")
def series(stored, small, tmp_path_factory):
    """The small archive, with the outlines of its areas and the levels of a day."""
    folder = tmp_path_factory.mktemp("viewer")
    shutil.copytree(stored, folder, dirs_exist_ok=True)
    site = read_site(folder / "site.toml")
    series = Series(site.station.data, "hef", site.grid_cells, "EPSG:32632", name="hef")
    reference = small.make_reference()
    variance_m2 = np.where(
        np.isfinite(reference.random_variance_m2), np.float32(REFERENCE_M**2), np.float32(np.nan)
    )
    write_reference(series, replace(reference, random_variance_m2=variance_m2))
    polygons = read_polygons(site.areas.file, site.map.crs)
    areas = {name: cells_inside(polygon, series.grid) for name, polygon in polygons.items()}
    update_areas(series, areas, Aggregates(series), lambda: None, polygons=polygons)
    start_s = float(SeriesIndex(series).start_s[0])
    day = level_files.LevelPeriod("20251121", "0" * 16, "1", start_s, start_s + 1e4, start_s + 5000, 6)
    level_files.write_levels(series, day, level_rows)
    return series


def level_rows(rows):
    """Levels that rise to the east, and the rate of a tenth of them a day."""
    ones = np.ones((rows.stop - rows.start, 60))
    random_m, systematic_m = LEVEL_SIGMA_M
    level_m = ones * level_at(np.arange(60))
    rasters = {"level": level_m, "rate": level_m / 10, "coverage": ones}
    for name, share in (("level", 1.0), ("rate", 0.1)):
        rasters[f"{name}_random_uncertainty"] = ones * random_m * share
        rasters[f"{name}_systematic_uncertainty"] = ones * systematic_m * share
    return level_files.encoded(rasters)


def level_at(column):
    return 0.02 * column


@pytest.fixture(scope="module")
def addresses(series, tmp_path_factory):
    """The page, in English and in German."""
    folders = {"en": series.folder / "page", "de": tmp_path_factory.mktemp("pages") / "de"}
    for language, folder in folders.items():
        if language == "de":
            shutil.copytree(folders["en"], folder)  # the same maps
        context = page.PageContext("x", "", 1.0, 3600.0, [], [], [], {}, language=language)
        page.write_page(series, folder, context, 600, None, lambda: None)
    return {language: (folder / "index.html").as_uri() for language, folder in folders.items()}


@pytest.fixture
def address(addresses, tab):
    tab.events.clear()
    tab.set_size(1200, 900)
    tab.open("about:blank")  # a new part after # alone would not load the page again
    return addresses["en"]


def value_under_the_pointer(tab, east_m, north_m):
    """Change and half of its 95 % interval that the map shows where the pointer is [m]."""
    tab.run("document.getElementById('map').scrollIntoView()")
    tab.run(f"document.querySelector('#map-tools input').value = '{east_m} {north_m}'")
    tab.run("document.querySelector('#map-tools form').requestSubmit()")
    return value_in_the_middle(tab)


def value_in_the_middle(tab):
    """Change and half of its 95 % interval that the map shows in its middle [m]."""
    box = tab.run("JSON.parse(JSON.stringify(document.getElementById('map-canvas').getBoundingClientRect()))")
    x, y = box["left"] + box["width"] / 2, box["top"] + box["height"] / 2
    tab.run("document.getElementById('map-hover').textContent = ''")
    tab.call("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)
    hover = "document.getElementById('map-hover').textContent"
    tab.await_(f"{hover}.includes(':')")
    text = tab.run(hover)
    return [float(n) for n in re.findall(r"[-\d.]+", text.split(": ")[1].replace("−", "-"))]


def test_values_under_the_pointer_are_those_of_the_store(tab, address, series, small):
    index, grid = SeriesIndex(series), series.grid
    column, row = PLACE
    east_m, north_m = grid.x_m[column], grid.y_m[row]
    mask = np.zeros(grid.shape, bool)
    mask[row, column] = True
    cells = [Aggregates(series).read_cells(index[k], mask) for k in range(len(index))]
    change_m = [float(part.change_m[0]) for part in cells]
    sigma_m = [
        float(small.make_epoch(k).measurement.to_rasters("uncertainty_m")[0][row, column])
        for k in range(len(index))
    ]
    tab.open(f"{address}#layer=significance")
    change, half = value_under_the_pointer(tab, east_m, north_m)
    assert change == pytest.approx(change_m[-1], abs=sigma_m[-1] / 8 + 0.0006)
    assert half == pytest.approx(1.96 * sigma_m[-1], rel=0.06)

    # since an earlier scan: the difference, without the error of the reference
    slider = "document.getElementById('since')"
    tab.run(f"{slider}.value = 1; {slider}.dispatchEvent(new Event('input'))")
    tab.await_("document.getElementById('map-key').textContent.includes('left out of σ')")
    change, half = value_under_the_pointer(tab, east_m + 0.1, north_m)
    expected_m, bound_m = change_m[-1] - change_m[1], np.hypot(sigma_m[-1], sigma_m[1])
    pair_m = (bound_m**2 - 2 * REFERENCE_M**2) ** 0.5
    assert pair_m < 0.9 * bound_m
    assert change == pytest.approx(expected_m, abs=pair_m / 4 + 0.0006)
    assert half == pytest.approx(1.96 * pair_m, rel=0.07)

    # the curve of the place says the same
    panel = tab.await_("document.querySelector('#asked-values dd')?.textContent")
    change, half = (float(n) for n in re.findall(r"[-\d.]+", panel.replace("−", "-"))[:2])
    assert change == pytest.approx(expected_m, abs=0.0021)
    stored_m = Aggregates(series).variance(mask, index[-1], index[1]) ** 0.5  # has no systematic part here
    assert half == pytest.approx(1.96 * stored_m, rel=0.03, abs=0.0006)
    assert "since=2025-11-21T01:00Z" in tab.run("location.hash")

    # swiped: the earlier scan on the left, the later one on the right, each since the reference
    set_control(tab, "show-swipe", "checked", "true")
    for border, scan in ((75, 1), (25, -1)):
        set_control(tab, "swipe", "value", border)
        change, half = value_under_the_pointer(tab, east_m, north_m)
        assert change == pytest.approx(change_m[scan], abs=sigma_m[scan] / 8 + 0.0006)
        assert half == pytest.approx(1.96 * sigma_m[scan], rel=0.06)
    assert tab.errors() == []


def set_control(tab, name, attribute, value):
    control = f"document.getElementById('{name}')"
    tab.run(f"{control}.{attribute} = {value}; {control}.dispatchEvent(new Event('input'))")


def test_level_and_rate_are_those_of_the_stored_day(tab, address, series):
    column, row = PLACE
    east_m, north_m = series.grid.x_m[column], series.grid.y_m[row]
    sigma_m = np.hypot(*LEVEL_SIGMA_M)
    for layer, unit in (("level", 1.0), ("rate", 0.1)):
        tab.open("about:blank")
        tab.open(f"{address}#layer={layer}")
        value, half = value_under_the_pointer(tab, east_m, north_m)
        assert value == pytest.approx(unit * level_at(column), abs=unit * sigma_m / 8 + 0.0006)
        assert half == pytest.approx(1.96 * unit * sigma_m, rel=0.06, abs=0.0006)
        tab.await_("document.getElementById('map-key').textContent.includes('2025-11-21 01:23 UTC')")
        assert ("m/d" in tab.run("document.getElementById('map-hover').textContent")) == (layer == "rate")
    # the curves of the place say the same
    half_m = 1.96 * np.hypot(*LEVEL_SIGMA_M)
    asked = tab.await_(
        "document.getElementById('asked-values')?.textContent.includes('m/d') &&"
        " document.getElementById('asked-values').textContent"
    )
    assert f"Level (2025-11-21 01:23){level_at(column):.3f} ± {half_m:.3f} m" in asked
    assert f"Rate (2025-11-21 01:23){level_at(column) / 10:.3f} ± {half_m / 10:.3f} m/d" in asked
    titles = tab.run("[...document.querySelectorAll('#asked-curves h3')].map((h) => h.textContent)")
    assert [title.partition(",")[0] for title in titles[1:]] == ["Level", "Rate of the level"]
    # the place stays in the middle when the map gets another size: with a late first frame, late styles
    tab.set_size(1000, 900)
    tab.await_("document.getElementById('map-canvas').width < 1000")
    assert value_in_the_middle(tab) == [value, half]
    assert tab.errors() == []


@pytest.mark.usefixtures("address")
def test_the_map_is_named_for_screen_readers_and_speaks_german(tab, addresses):
    tab.open(f"{addresses['de']}#layer=significance&since=2025-11-21T01:00Z")
    set_control(tab, "show-swipe", "checked", "true")
    tab.call("Accessibility.enable")
    tree = tab.call("Accessibility.getFullAXTree")["nodes"]
    named = {}
    for node in tree:
        if not node.get("ignored") and "name" in node:
            named.setdefault(node["role"]["value"], []).append(node["name"]["value"].strip())
    assert any(name.startswith("Karte der Höhenänderung") for name in named["application"])
    assert {"Zeit", "Seit"} <= set(named["slider"])
    assert any(name.startswith("Grenze zwischen den beiden Scans") for name in named["slider"])
    assert {"Ort", "Zweiter Ort", "Polygon"} <= set(named["button"])
    assert "Ebene" in named["combobox"]
    assert {"Höhenlinien", "Wischen"} <= set(named["checkbox"])
    assert all(name.strip() for role in ("button", "slider", "checkbox", "combobox") for name in named[role])
    assert tab.run("document.documentElement.lang") == "de"
    tab.await_("document.getElementById('map-key').textContent.includes('nicht beobachtet')")
    spoken = tab.run("document.getElementById('since').getAttribute('aria-valuetext')")
    assert spoken == "2025-11-21 01:00 UTC"  # not the number of the scan
    assert tab.errors() == []


def test_layers_contours_and_play(tab, address):
    tab.add_startup_script(
        "const every = setInterval; window.setInterval = (f, ms) => every(f, Math.min(ms, 50));"
    )
    tab.open(f"{address}#layer=sigma")  # a picture from a folder could not be read back from the canvas
    tab.await_("document.getElementById('map-key').textContent.includes('levation change')")
    colours = """(() => { const c = document.getElementById('map-canvas');
        const copy = new OffscreenCanvas(c.width, c.height).getContext('2d', { willReadFrequently: true });
        copy.drawImage(c, 0, 0);
        const p = copy.getImageData(0, 0, c.width, c.height).data, seen = new Set();
        for (let i = 0; i < p.length; i += 4 * 97) seen.add(p[i] << 16 | p[i + 1] << 8 | p[i + 2]);
        return seen.size; })()"""
    for layer in ("significance", "sigma", "coverage"):
        choice = "document.getElementById('layer')"
        tab.run(f"{choice}.value = '{layer}'; {choice}.dispatchEvent(new Event('change'))")
        tab.await_(f"{colours} > 8")
        assert f"layer={layer}" in tab.run("location.hash")
    tab.run("document.getElementById('show-contours').click()")
    tab.await_("document.getElementById('map-key').textContent.includes('contours every')")
    names = tab.run("STATION.outlines.areas.map((area) => area.name)")
    assert names[0] == "rises"
    assert tab.run("STATION.outlines.areas[0].rings[0].length") == 5
    tab.run("[...document.querySelectorAll('button')].find((b) => b.textContent === 'Play').click()")
    last = "STATION.maps.length - 1"
    tab.await_(f"Number(document.getElementById('slider').value) < {last}")
    tab.await_(f"Number(document.getElementById('slider').value) === {last}")
    tab.await_("[...document.querySelectorAll('button')].some((b) => b.textContent === 'Play')")
    assert tab.errors() == []


@pytest.fixture(scope="module")
def everywhere(series, addresses):
    """Addresses of the page: in its folder, on a plain web server, and on that of `station serve`."""

    class Handler(SimpleHTTPRequestHandler):
        def log_message(self, *_):
            pass

    with ExitStack() as stack:
        view = station.view(series.folder)
        stack.callback(view.close)
        handler = partial(Handler, directory=series.folder / "page")
        server = stack.enter_context(ThreadingHTTPServer(("127.0.0.1", 0), handler))
        threading.Thread(target=server.serve_forever, daemon=True).start()
        stack.callback(server.shutdown)
        static = f"http://127.0.0.1:{server.server_port}/index.html"
        yield {"folder": addresses["en"], "static server": static, "station serve": view.address}


@pytest.mark.parametrize("place", ["folder", "static server", "station serve"])
@pytest.mark.parametrize("name", ["tab", "firefox"])
def test_each_browser_shows_the_values_of_the_store_and_their_colours(
    request, everywhere, series, small, name, place
):
    window = request.getfixturevalue(name)
    window.set_size(1200, 1000)
    window.open("about:blank")
    window.open(f"{everywhere[place]}#layer=significance")
    window.await_("document.querySelector('#map-canvas[aria-busy=false]')?.id")
    window.run("document.getElementById('map').scrollIntoView()")
    picture = np.asarray(Image.open(io.BytesIO(window.screenshot("#map-canvas"))).convert("RGB")).astype(int)
    left, top, width, height = window.run(
        "(() => { const c = document.getElementById('map-canvas'), b = c.getBoundingClientRect();"
        " return [b.left, b.top, c.clientWidth, c.clientHeight]; })()"
    )
    grid = series.grid
    known = np.isfinite(Aggregates(series).reference().elevation_m)  # from the first row and column on
    rows, columns = (np.count_nonzero(known.any(axis)) for axis in (1, 0))
    scale = max(columns / width, rows / height)  # cells a pixel of the whole map

    def pixel(row, column):
        """Column and row of the middle of a cell in the picture, inside its border."""
        return [
            round(1 + size / 2 + (k + 0.5 - count / 2) / scale)
            for k, size, count in ((column, width, columns), (row, height, rows))
        ]

    def colours(part):
        """Colours (n, 3) of a part of the grid, without its border."""
        (left, top), (right, bottom) = pixel(*(k.start for k in part)), pixel(*(k.stop - 1 for k in part))
        return picture[top:bottom, left:right].reshape(-1, 3)

    for part, is_higher in ((small.RISE, True), (small.FALL, False)):
        red, _, blue = np.median(colours(part), axis=0)
        assert (blue - red > 60) if is_higher else (red - blue > 60)
    unobserved = colours(small.UNOBSERVED)
    assert np.ptp(unobserved.mean(axis=1)) > 40  # hatched
    assert np.ptp(unobserved, axis=1).max() < 30  # without the colour of any change

    column, row = PLACE
    x, y = pixel(row, column)
    window.tap(left + x, top + y)
    values = window.await_("document.querySelector('#asked-values dd')?.textContent")
    asked = window.run("document.querySelector('#asked h3').textContent").replace("\u202f", "")
    east_m, north_m = (int(number) for number in re.search(r"at (\d+) E, (\d+) N", asked).groups())
    assert (east_m, north_m) == pytest.approx((grid.x_m[column], grid.y_m[row]), abs=1.5)
    change, half = (float(n) for n in re.findall(r"[-\d.]+", values.replace("−", "-"))[:2])
    index, mask = SeriesIndex(series), np.zeros(grid.shape, bool)
    mask[row, column] = True
    aggregates = Aggregates(series)
    stored_m = float(aggregates.read_cells(index[-1], mask).change_m[0])
    assert change == pytest.approx(stored_m, abs=0.0011)
    assert half == pytest.approx(1.96 * aggregates.variance(mask, index[-1]) ** 0.5, rel=0.03, abs=0.0006)
    assert window.await_("document.querySelectorAll('#asked-curves canvas').length") >= 1
