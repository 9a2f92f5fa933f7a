"""Events as tables, on the page, and as alarms."""

import csv
import io
import json
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest
import shapely

from station.archive.derived.event_table import EVENT_COLUMNS, Event, outline, read_events, write_events
from station.archive.netcdf_layout import Series
from station.config import read_site
from station.errors import StoreError
from station.monitoring.alarm_rules import evaluate_rules
from station.products.event_tables import as_csv, as_text, write_geoparquet
from station.products.page import PageContext, write_page
from station.quantities import Grid

GRID = Grid(west_m=632_000.0, north_m=5_186_000.0, cell_m=10.0, nx=30, ny=20)
SLIDE = Event(
    "20250715T150000Z-1", "paired", "active", "2025-07-15T14:07:28Z", "2025-07-15T15:07:28Z",
    "2025-07-15T16:07:28Z", "2025-07-15T15:07:28Z", 632_105.0, 5_185_905.0, 900.0, 1234.5, 100.0, 1.37, 21.0,
    "1", "20250715T150000Z-2", 34.5, 120.0,
)  # fmt: skip
SNOW = replace(SLIDE, id="20250716T020000Z-1", kind="snowfall", state="closed", partner="", balance_m3=None)


def store(folder):
    blocks = np.zeros(GRID.shape, bool)
    blocks[8:11, 9:12] = True
    shape = outline(blocks, GRID)
    assert shape.area == 900
    assert shape.equals(shapely.box(632_090, 5_185_890, 632_120, 5_185_920))
    write_events(Series(folder, "hef", GRID, "EPSG:32632"), [(SLIDE, shape), (SNOW, shape)])


def test_a_table_is_read_as_written(tmp_path):
    assert read_events(tmp_path) == []
    store(tmp_path)
    assert read_events(tmp_path) == [SLIDE, SNOW]
    (tmp_path / "events.geojson").write_text('{"features": [{}]}')
    with pytest.raises(StoreError, match="damaged"):
        read_events(tmp_path)


def test_csv_has_all_columns_and_text_has_intervals():
    first, second = csv.DictReader(io.StringIO(as_csv([SLIDE, SNOW])))
    assert tuple(first) == EVENT_COLUMNS
    assert (float(first["volume_m3"]), first["partner"], second["balance_m3"]) == (1234.5, SLIDE.partner, "")
    header, line, _ = as_text([SLIDE, SNOW], on_map=True).splitlines()
    assert header.split()[:2] == ["begin,", "UTC"]
    assert "+1234" in line
    assert "±196" in line  # 1.96 times 100
    assert as_text([], on_map=True) == "no events"
    for on_map, axes in ((True, "east, m  north, m"), (False, "along, m  up, m")):
        assert axes.split() == as_text([SLIDE], on_map=on_map).splitlines()[0].split()[6:10]


def test_geoparquet_has_outlines_times_and_the_coordinate_system(tmp_path):
    """Against the specification, version 1.1.0; geopandas 1.1 reads the file with the same content."""
    parquet = pytest.importorskip("pyarrow.parquet")
    store(tmp_path)
    series = Series(tmp_path, "hef", GRID, "EPSG:32632")
    write_geoparquet(series, [SLIDE, SNOW], tmp_path / "events.parquet")
    table = parquet.read_table(tmp_path / "events.parquet")
    geo = json.loads(table.schema.metadata[b"geo"])
    column = geo["columns"][geo["primary_column"]]
    assert (geo["version"], column["encoding"], column["geometry_types"]) == ("1.1.0", "WKB", ["Polygon"])
    assert column["crs"]["id"] == {"authority": "EPSG", "code": 32632}
    assert column["bbox"] == [632_090, 5_185_890, 632_120, 5_185_920]
    first, second = table.to_pylist()
    assert shapely.from_wkb(first["geometry"]).area == 900
    assert first["begin"] == datetime(2025, 7, 15, 15, 7, 28, tzinfo=UTC)
    assert (first["volume_m3"], second["partner"], second["balance_m3"]) == (1234.5, None, None)
    write_geoparquet(series, [], tmp_path / "none.parquet")
    assert parquet.read_table(tmp_path / "none.parquet").num_rows == 0


def test_the_page_lists_events(tmp_path):
    store(tmp_path)
    series = Series(tmp_path, "hef", GRID, "EPSG:32632")
    context = PageContext("Hef", "", 1.75e9, 3600.0, [], [], [], {})
    write_page(series, tmp_path / "page", context, 400, None, lambda: None)
    page = (tmp_path / "page" / "index.html").read_text(encoding="utf-8")
    assert page.index("snowfall") < page.index("paired")  # the newest first
    assert "± 196" in page
    assert (tmp_path / "page" / "events.geojson").read_bytes() == (tmp_path / "events.geojson").read_bytes()
    write_page(series, tmp_path / "page", replace(context, language="de"), 400, None, lambda: None)
    page = (tmp_path / "page" / "index.html").read_text(encoding="utf-8")
    assert page.index("Schneefall") < page.index("Paar")
    assert "<td>aktiv</td>" in page


def test_an_active_event_raises_an_alarm_and_a_closed_one_if_it_is_new(write_site):
    rules = "[alarms]\nno_scan_h = 0\nstalled_h = 0\ndisk_gb = 0\nmoved = false\n[alarms.events]\n"

    def alarms(assessed, more=""):
        site = read_site(write_site(more=rules + more))
        site.station.data.mkdir(parents=True, exist_ok=True)
        store(site.station.data)
        found = evaluate_rules(site, since_utc_s=0, assessed_until_utc_s=assessed, now_s=1.8e9)
        return [alarm.key for alarm in found if "event" in alarm.key]

    before = datetime(2025, 7, 15, 16, tzinfo=UTC).timestamp()
    assert alarms(None) == ["event 20250715T150000Z-1"]
    assert alarms(before + 3600) == ["event 20250715T150000Z-1"]
    assert alarms(before, 'kinds = ["snowfall"]') == ["event 20250716T020000Z-1"]
    assert alarms(before + 3600, 'kinds = ["snowfall"]') == []
    assert alarms(before, "least_m3 = 2000") == []
