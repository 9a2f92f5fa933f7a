"""Exports, read by other programs: GeoTIFF, STAC and CSV."""

import csv
import io
import json
import shutil
import subprocess
import warnings
import xml.etree.ElementTree as ET

import numpy as np
import pytest
from PIL import Image

import station
from station.products.area_tables import Span
from station.products.export import TOPO4D, export


@pytest.mark.integration
def test_geotiff_is_a_valid_cog_and_read_by_gdal(site, tmp_path):
    from rio_cogeo.cogeo import cog_validate

    paths = export(site, "geotiff", None, tmp_path / "tif")
    assert [path.name for path in paths] == [
        "hef_20251121T050000Z_change.tif",
        "hef_20251121T050000Z_sigma.tif",
    ]
    for path in paths:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # from libraries that the validator uses
            is_valid, errors, notes = cog_validate(path, strict=True)
        assert is_valid, (errors, notes)
        style = ET.parse(path.with_suffix(".qml")).getroot()  # noqa: S314 - just written
        shader = style.find(".//colorrampshader")
        assert len(shader.findall("item")) == 33
        assert style.find(".//rasterrenderer").get("type") == "singlebandpseudocolor"
    values = [float(item.get("value")) for item in shader.findall("item")]
    assert values == sorted(values)
    gdalinfo = shutil.which("gdalinfo")
    if gdalinfo is None:
        pytest.skip("gdalinfo is not installed: georeference of the raster not checked")
    info = json.loads(subprocess.run([gdalinfo, "-json", paths[0]], capture_output=True, check=True).stdout)
    assert info["geoTransform"] == [632000.0, 10.0, 0.0, 5186000.0, 0.0, -10.0]
    assert info["metadata"]["IMAGE_STRUCTURE"]["LAYOUT"] == "COG"
    assert 'ID["EPSG",32632]' in info["coordinateSystem"]["wkt"]
    with station.open(site.station.data) as ds:
        row, column = np.argwhere(np.isfinite(ds.elevation_change[-1].values))[700]
        expected = float(ds.elevation_change[-1, row, column])
        location = [str(float(ds.x[column])), str(float(ds.y[row]))]
    command = [shutil.which("gdallocationinfo"), "-valonly", "-geoloc", paths[0], *location]
    value = subprocess.run(command, capture_output=True, check=True, text=True).stdout
    assert float(value) == pytest.approx(expected, abs=1e-6)


@pytest.mark.integration
def test_stac_catalogue_is_valid(site, tmp_path):
    """The core schemas come with pystac; the requirements of topo4d v1.0.0 on items are repeated here."""
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

    paths = export(site, "stac", Span.parse("2025-11-21T03:30", None), tmp_path / "stac")
    validator = RegisteredValidator.get_validator()
    set_validator(Offline())
    try:
        collection = pystac.Collection.from_file(str(paths[0]))
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
        set_validator(validator)
    assert [item.datetime.hour for item in items] == [4, 5]
    west, south, east, north = items[0].bbox  # corners of the grid computed with cs2cs of PROJ
    assert (west, east) == (pytest.approx(10.7298, abs=2e-3), pytest.approx(10.7378, abs=2e-3))
    assert 46.80 < south < north < 46.82


def test_csv_of_scans(site, tmp_path, small):
    scans, areas = export(site, "csv", None, tmp_path / "csv")
    rows = list(csv.DictReader(io.StringIO(scans.read_text())))
    assert [row["verdict"] for row in rows] == ["degraded", "good"] * 3
    assert rows[3]["scan"] == small.EVIL
    assert float(rows[2]["platform_roll"]) == pytest.approx(0.12)
    assert len(areas.read_text().splitlines()) == 13
