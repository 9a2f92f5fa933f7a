"""Areas asked for afterwards, and the files for other programs, read by those programs."""

import csv
import io
import json
import shutil
import socket
import subprocess
import sys
import time
import warnings
import xml.etree.ElementTree as ET
from pathlib import Path
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import numpy as np
import pytest
from PIL import Image

import station
from station.errors import ConfigError, StationError
from station.products.areas import Span, area_lines, as_csv, as_text, epoch, moment
from station.products.export import TOPO4D, export
from station.products.plots import plot_curve, plot_film, plot_map

ALL = Span.of(None, None)


@pytest.fixture
def later(tmp_path, small):
    """Polygons given after the fact: one of the site's again, and one of its own."""
    boxes = [
        small.box("rises", 632050, 5185850, 632200, 5185950),
        small.box("new", 632000, 5185900, 632100, 5186000),
    ]
    (tmp_path / "later.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": boxes}))
    return tmp_path / "later.geojson"


def test_a_polygon_given_afterwards_says_what_areas_nc_does(site, later):
    kept = [line for line in area_lines(site, None, ALL, "reference") if line.area == "rises"]
    asked = [line for line in area_lines(site, later, ALL, "reference") if line.area == "rises"]
    assert len(kept) == len(asked) == 6
    for one, other in zip(kept, asked, strict=True):
        assert (one.start, one.size_m2) == (other.start, other.size_m2)
        assert one.figures == pytest.approx(other.figures, nan_ok=True)
        assert one.figures["coverage"] < 1  # it has voids


def test_areas_nc_of_other_polygons_is_not_believed(site, small):
    """The owner drew the area anew; the service has not come to it yet."""
    moved = [
        small.box("rises", 632300, 5185650, 632500, 5185800),
        small.box(small.EVIL, 632300, 5185650, 632500, 5185800),
    ]
    site.areas.file.write_text(json.dumps({"type": "FeatureCollection", "features": moved}))
    told = list(area_lines(site, None, ALL, "reference"))[-2:]
    assert told[0].verdict == "good"
    between = list(area_lines(site, None, ALL, "previous"))[-1]
    assert between.verdict == "degraded"  # the one before was
    assert told[0].figures == told[1].figures
    assert told[0].figures["mean_change"] == pytest.approx(-0.30, abs=0.01)


def test_any_two_epochs(site, later):
    """It rises by 5 cm an hour; σ by `station.variance` where nothing is interpolated."""
    hourly = [one for one in area_lines(site, later, ALL, "previous") if one.area == "rises"]
    assert len(hourly) == 5
    assert [one.figures["mean_change"] for one in hourly] == pytest.approx([0.05] * 5, abs=0.008)
    span = Span.of("2025-11-21T02:00", "2025-11-21T04:30")
    for against in ("251121_000000", "2025-11-21T00:07", "251121_000000.laz"):
        told = [one for one in area_lines(site, later, span, against) if one.area == "rises"]
        assert [one.start.hour for one in told] == [2, 3, 4]
        assert [one.figures["mean_change"] for one in told] == pytest.approx([0.10, 0.15, 0.20], abs=0.008)
    with station.open(site.station.data) as ds:
        seen = np.isfinite(ds.elevation_change[[0, 2]].values).all(axis=0)
    inside = np.zeros(seen.shape, bool)
    inside[5:15, 5:20] = True
    least_m2 = station.variance(site.station.data, inside * seen / inside.sum(), 2, 0)
    assert np.sqrt(least_m2) < told[0].figures["mean_change_uncertainty"] < 3 * np.sqrt(least_m2)


def test_csv_is_read_back_by_a_spreadsheet(site, small):
    rows = list(csv.DictReader(io.StringIO(as_csv(area_lines(site, None, ALL, "reference")))))
    assert len(rows) == 12
    assert rows[0]["time_utc"] == "2025-11-21T00:00:00Z"
    assert rows[1]["area"] == small.EVIL
    assert [row["verdict"] for row in rows[:3]] == ["degraded", "degraded", "good"]
    for row in rows:
        mean, sigma = float(row["mean_change_m"]), float(row["mean_change_sigma_m"])
        assert float(row["mean_change_low95_m"]) == pytest.approx(mean - 1.96 * sigma, rel=1e-4)
        assert float(row["volume_change_m3"]) == pytest.approx(mean * float(row["area_size_m2"]), rel=1e-4)
    assert "rises" in as_text(area_lines(site, None, ALL, "reference"))
    assert as_text([]) == "no epoch has a change there"


def test_epochs_by_scan_and_time_and_what_is_neither(site, series, small):
    assert epoch(series, "251121_040000").start.hour == 4
    assert epoch(series, small.EVIL).start.hour == 3
    assert epoch(series, "2025-11-21T01:20").start.hour == 1
    assert epoch(series, "2025-11-21T02:20+01:00").start.hour == 1
    assert epoch(series, "last").start.hour == 5
    with pytest.raises(StationError, match="neither a stored scan"):
        epoch(series, "yesterday")
    with pytest.raises(StationError, match="is no time"):
        moment("31.12.2025")
    span = Span.of("2025-11-21", "2025-11-21")
    assert len(list(area_lines(site, None, span, "reference"))) == 12
    assert not list(area_lines(site, None, Span.of("2025-11-22", None), "reference"))


def test_no_areas_at_all(site):
    with pytest.raises(ConfigError, match="name a GeoJSON"):
        next(area_lines(site.model_copy(update={"areas": None}), None, ALL, "reference"))


def test_a_cog_that_its_validator_and_gdal_accept(site, tmp_path):
    from rio_cogeo.cogeo import cog_validate

    made = export(site, "geotiff", None, tmp_path / "tif")
    assert [path.name for path in made] == [
        "hef_20251121T050000Z_change.tif",
        "hef_20251121T050000Z_sigma.tif",
    ]
    for path in made:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of libraries it uses
            good, errors, doubts = cog_validate(path, strict=True)
        assert good, (errors, doubts)
        style = ET.parse(path.with_suffix(".qml")).getroot()  # noqa: S314 - just written
        shader = style.find(".//colorrampshader")
        assert len(shader.findall("item")) == 33
        assert style.find(".//rasterrenderer").get("type") == "singlebandpseudocolor"
    values = [float(item.get("value")) for item in shader.findall("item")]
    assert values == sorted(values)
    gdalinfo = shutil.which("gdalinfo")
    if gdalinfo is None:
        pytest.skip("gdalinfo is not installed: the place of the raster was not looked at")
    told = json.loads(subprocess.run([gdalinfo, "-json", made[0]], capture_output=True, check=True).stdout)
    assert told["geoTransform"] == [632000.0, 10.0, 0.0, 5186000.0, 0.0, -10.0]
    assert told["metadata"]["IMAGE_STRUCTURE"]["LAYOUT"] == "COG"
    assert 'ID["EPSG",32632]' in told["coordinateSystem"]["wkt"]
    with station.open(site.station.data) as ds:
        row, column = np.argwhere(np.isfinite(ds.elevation_change[-1].values))[700]
        wanted = float(ds.elevation_change[-1, row, column])
        place = [str(float(ds.x[column])), str(float(ds.y[row]))]
    tool = [shutil.which("gdallocationinfo"), "-valonly", "-geoloc", made[0], *place]
    at = subprocess.run(tool, capture_output=True, check=True, text=True).stdout
    assert float(at) == pytest.approx(wanted, abs=1e-6)


def test_stac_is_valid_and_tells_of_the_time_series(site, tmp_path):
    """Core schemas come with pystac; what topo4d v1.0.0 demands of an item is said here in short."""
    import pystac
    from pystac.validation import JsonSchemaSTACValidator, RegisteredValidator, set_validator

    class Offline(JsonSchemaSTACValidator):
        def _get_schema(self, uri):
            if uri != TOPO4D:
                return super()._get_schema(uri)
            number, text = {"type": "number"}, {"type": "string"}
            return {
                "$schema": "http://json-schema.org/draft-07/schema#",
                "$id": TOPO4D,
                "if": {"properties": {"type": {"const": "Feature"}}},
                "then": {
                    "properties": {
                        "properties": {
                            "required": ["datetime", "topo4d:native_crs", "topo4d:data_type"],
                            "properties": {
                                "topo4d:native_crs": text, "topo4d:data_type": text, "topo4d:tz": text,
                                "topo4d:sensor": text, "topo4d:acquisition_mode": text,
                                "topo4d:duration": number, "topo4d:spatial_resolution": number,
                                "topo4d:point_count": {"type": "integer"},
                                "topo4d:productmeta": {"type": "object"},
                            },
                            "propertyNames": {"not": {"pattern": "^topo4d:(product_info|unknown)"}},
                        }
                    }
                },
            }  # fmt: skip

    made = export(site, "stac", Span.of("2025-11-21T03:30", None), tmp_path / "stac")
    before = RegisteredValidator.get_validator()
    set_validator(Offline())
    try:
        collection = pystac.Collection.from_file(str(made[0]))
        collection.validate()
        items = list(collection.get_items())
        for item in items:
            item.validate()
            assert {asset.media_type for asset in item.assets.values()} == {
                "image/tiff; application=geotiff; profile=cloud-optimized"
            }
            for asset in item.assets.values():
                with Image.open(asset.get_absolute_href()) as raster:
                    assert raster.size == (60, 45)
        broken = items[0].clone()
        del broken.properties["topo4d:data_type"]
        with pytest.raises(pystac.STACValidationError):
            broken.validate()
    finally:
        set_validator(before)
    assert [item.datetime.hour for item in items] == [4, 5]
    west, south, east, north = items[0].bbox  # of the grid's corners by another way: cs2cs of PROJ
    assert (west, east) == (pytest.approx(10.7298, abs=2e-3), pytest.approx(10.7378, abs=2e-3))
    assert 46.80 < south < north < 46.82


def test_scans_as_csv(site, tmp_path, small):
    scans, areas = export(site, "csv", None, tmp_path / "csv")
    rows = list(csv.DictReader(io.StringIO(scans.read_text())))
    assert [row["verdict"] for row in rows] == ["degraded", "good"] * 3
    assert rows[3]["scan"] == small.EVIL
    assert float(rows[2]["platform_roll"]) == pytest.approx(0.12)
    assert len(areas.read_text().splitlines()) == 13


def test_pictures_on_request(site, tmp_path, small):
    for shown in ("change", "sigma", "points"):
        made = plot_map(site, "last", "reference", shown, tmp_path / f"{shown}.png", 500, None)
        with Image.open(made) as picture:
            assert picture.width == 500
    plot_map(site, "251121_040000", "previous", "change", tmp_path / "pair.webp", 500, 0.5)
    with pytest.raises(StationError, match="before it"):
        plot_map(site, "251121_000000", "previous", "change", tmp_path / "first.png", 500, 0.5)
    with pytest.raises(StationError, match="must end in"):
        plot_map(site, "last", "reference", "change", tmp_path / "map.tiff", 500, None)
    for suffix in ("webp", "gif"):
        made = plot_film(site, Span.of("2025-11-21T01:00", None), tmp_path / f"film.{suffix}", 400, None)
        with Image.open(made) as film:
            assert film.n_frames == 5
    with pytest.raises(StationError, match="no epoch"):
        plot_film(site, Span.of("2030-01-01", None), tmp_path / "film.webp", 400, None)
    made = plot_curve(area_lines(site, None, ALL, "reference"), small.EVIL, "x", tmp_path / "curve.svg")
    drawn = made.read_text()
    assert "onerror" not in drawn.replace("&lt;img src=x onerror=alert(1)&gt;", "")
    with pytest.raises(StationError, match="no area 'gone' with a change; there are: rises"):
        plot_curve(area_lines(site, None, ALL, "reference"), "gone", "x", tmp_path / "curve.png")


@pytest.fixture
def served(site, tmp_path):
    """`station serve` as its users have it, and the address it told."""
    page = site.station.data / "page"
    page.mkdir()
    (page / "index.html").write_text("<!doctype html><title>x</title>")
    (page / ".hidden").write_text("secret")
    (page / "out").symlink_to(tmp_path / "site.toml")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [sys.executable, "-m", "station.cli", "serve", site.path, "--port", str(port)]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    yield process, f"http://127.0.0.1:{port}/"
    process.terminate()
    process.wait(timeout=20)
    process.stderr.close()


def ask(address, **how):
    until = time.monotonic() + 30
    while True:
        try:
            with urlopen(Request(address, **how), timeout=10) as answer:  # noqa: S310 - its own server
                return answer.status, dict(answer.headers)
        except HTTPError as error:
            error.close()
            return error.code, {}
        except OSError:
            assert time.monotonic() < until
            time.sleep(0.1)


def test_served_to_this_machine_only_and_read_only(served):
    process, address = served
    status, headers = ask(address)
    assert status == 200
    assert "default-src 'none'" in headers["content-security-policy"]
    assert headers["x-content-type-options"] == "nosniff"
    assert "server" not in {name.lower() for name in headers}
    for method in ("POST", "PUT", "DELETE"):
        assert ask(address, method=method)[0] == 405
    for path in (".hidden", "out", "../site.toml", "%2e%2e/site.toml", "nothing"):
        assert ask(address + path)[0] == 404
    assert ask(address, headers={"Host": "evil.example"})[0] == 400  # a foreign name that leads here
    with Path("/proc/net/tcp").open() as table:
        port = f"{int(address.rstrip('/').rpartition(':')[2]):04X}"
        listening = [line.split()[1] for line in table if line.split()[3] == "0A"]
    assert [one for one in listening if one.endswith(port)] == [f"0100007F:{port}"]
    assert process.poll() is None


def test_nothing_to_serve_yet(site):
    command = [sys.executable, "-m", "station.cli", "serve", site.path]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 1
    assert "no page yet" in done.stderr
