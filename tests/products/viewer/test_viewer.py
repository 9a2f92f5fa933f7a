"""The map of the page in Chromium: what it says of a place is what the store says."""

import importlib.util
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from station.archive.areas import update_areas
from station.archive.series.index import SeriesIndex
from station.products import page
from station.queries.aggregates import Aggregates
from station.readers.polygons import cells_inside, read_polygons

pytestmark = pytest.mark.integration
PLACE = 30, 20  # column and row


@pytest.fixture
def tab(tmp_path):
    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    if chromium is None:
        pytest.skip("chromium is not installed: map not tested in a browser (apt-get install chromium)")
    spec = importlib.util.spec_from_file_location("browser", Path(__file__).parents[1] / "browser.py")
    browser = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(browser)
    tab = browser.Page(chromium, tmp_path / "profile")
    yield tab
    tab.close()


@pytest.fixture
def address(series, site):
    """The page of the small archive, with the outlines of its areas."""
    polygons = read_polygons(site.areas.file, site.map.crs)
    areas = {name: cells_inside(polygon, series.grid) for name, polygon in polygons.items()}
    update_areas(series, areas, Aggregates(series), lambda: None, polygons=polygons)
    context = page.PageContext("x", "", 1.0, 3600.0, [], [], [], {})
    page.write_page(series, site.station.data / "page", context, 600, None, lambda: None)
    return (site.station.data / "page" / "index.html").as_uri()


def value_under_the_pointer(tab, east_m, north_m):
    """Change and half of its 95 % interval that the map shows where the pointer is [m]."""
    tab.run("document.getElementById('map').scrollIntoView()")
    tab.run(f"document.querySelector('#map-tools input').value = '{east_m} {north_m}'")
    tab.run("document.querySelector('#map-tools form').requestSubmit()")
    box = tab.run("JSON.parse(JSON.stringify(document.getElementById('map-canvas').getBoundingClientRect()))")
    x, y = box["left"] + box["width"] / 2, box["top"] + box["height"] / 2
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

    # since an earlier scan: the difference, and at most the sum of the variances
    slider = "document.getElementById('since')"
    tab.run(f"{slider}.value = 1; {slider}.dispatchEvent(new Event('input'))")
    assert "upper bound" in tab.run("document.getElementById('map-key').textContent")
    tab.run("document.getElementById('map-hover').textContent = ''")
    change, half = value_under_the_pointer(tab, east_m + 0.1, north_m)
    expected_m, bound_m = change_m[-1] - change_m[1], np.hypot(sigma_m[-1], sigma_m[1])
    assert change == pytest.approx(expected_m, abs=bound_m / 4 + 0.0006)
    assert half == pytest.approx(1.96 * bound_m, rel=0.06)
    assert "since=2025-11-21T01:00Z" in tab.run("location.hash")
    assert tab.errors() == []


def test_layers_contours_and_play(tab, address):
    tab.add_startup_script(
        "const every = setInterval; window.setInterval = (f, ms) => every(f, Math.min(ms, 50));"
    )
    tab.open(f"{address}#layer=sigma")  # a picture from a folder could not be read back from the canvas
    assert "levation change" in tab.run("document.getElementById('map-key').textContent")
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
