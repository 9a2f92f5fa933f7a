"""Exports, read by other programs: GeoTIFF, STAC and CSV."""

import csv
import io
import json
import shutil
import subprocess
import warnings
import xml.etree.ElementTree as ET
from dataclasses import replace

import netCDF4
import numpy as np
import pytest
import rasterio
from PIL import Image
from support.programs import readers_python, run

import station
from station.archive.reference_files import ReferenceProvenance, open_reference, write_reference
from station.archive.series.index import series_in
from station.products.area_tables import Span
from station.products.export import export
from station.products.exports.transformations import read_transformation
from station.products.stac import PROJECTION, TOPO4D


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
    """The core schemas come with pystac; the requirements of the extensions on items are repeated here."""
    import pystac
    from pystac.validation import JsonSchemaSTACValidator, RegisteredValidator, set_validator

    number, text, matrix = {"type": "number"}, {"type": "string"}, {"type": "array"}
    requirements = {
        TOPO4D: {
            "required": ["datetime", "topo4d:data_type"],
            "properties": {
                "topo4d:data_type": text, "topo4d:tz": text, "topo4d:acquisition_mode": text,
                "topo4d:duration": number, "topo4d:spatial_resolution": number,
                "topo4d:positional_accuracy": number,
                "topo4d:trafometa": {
                    "type": "object", "required": ["reference_epoch"],
                    "properties": {
                        "reference_epoch": {"type": "object"}, "registration_error": number,
                        "transformation": matrix,
                    },
                },
                "topo4d:productmeta": {"type": "object", "properties": {"product_name": text}},
            },
            "propertyNames": {"not": {"pattern": "^topo4d:(native_crs|sensor|point_count)"}},
        },
        PROJECTION: {
            "required": ["proj:code"],
            "properties": {
                "proj:code": {"pattern": "^[A-Z]+:[0-9]+$"},
                "proj:shape": {"minItems": 2, "maxItems": 2, "items": {"type": "integer"}},
                "proj:transform": {"items": number},
                "proj:bbox": {"minItems": 4, "maxItems": 4, "items": number},
            },
            "propertyNames": {"not": {"pattern": "^proj:epsg"}},
        },
    }  # fmt: skip

    class Offline(JsonSchemaSTACValidator):
        def _get_schema(self, uri):
            if uri not in requirements:
                return super()._get_schema(uri)
            return {
                "$schema": "http://json-schema.org/draft-07/schema#",
                "$id": uri,
                "if": {"properties": {"type": {"const": "Feature"}}},
                "then": {"properties": {"properties": requirements[uri]}},
            }

    (path,) = export(site, "stac", Span.parse("2025-11-21T03:30", None), tmp_path / "stac")
    validator = RegisteredValidator.get_validator()
    set_validator(Offline())
    try:
        catalog = pystac.Catalog.from_file(str(path))
        catalog.validate()
        (collection,) = catalog.get_children()
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
    bounds = [(item.common_metadata.start_datetime, item.common_metadata.end_datetime) for item in items]
    assert [start.hour for start, _ in bounds] == [4, 5]
    assert [item.datetime for item in items] == [start + (end - start) / 2 for start, end in bounds]
    assert collection.extent.temporal.intervals[0] == [bounds[0][0], bounds[1][1]]
    with rasterio.open(items[0].assets["change"].get_absolute_href()) as raster:
        assert [*raster.transform][:6] == items[0].properties["proj:transform"]
        assert [*raster.shape] == items[0].properties["proj:shape"]
        assert [*raster.bounds] == items[0].properties["proj:bbox"]
        assert f"EPSG:{raster.crs.to_epsg()}" == items[0].properties["proj:code"]
    reference_href = items[0].properties["topo4d:trafometa"]["reference_epoch"]["href"]
    assert (path.parent / collection.id / items[0].id / reference_href).is_file()
    west, south, east, north = items[0].bbox  # corners of the grid computed with cs2cs of PROJ
    assert (west, east) == (pytest.approx(10.7298, abs=2e-3), pytest.approx(10.7378, abs=2e-3))
    assert 46.80 < south < north < 46.82


OPEN_CATALOGUE = """
import json, numpy, odc.stac, pystac_client
items = pystac_client.Client.open(path).get_items(recursive=True)
ds = odc.stac.load(items)
change = ds.change.values
print(json.dumps({
    "shape": change.shape, "times": ds.time.astype("datetime64[s]").astype(str).values.tolist(),
    "epsg": ds.odc.crs.epsg, "x": ds.x.values[:2].tolist(), "y": ds.y.values[:2].tolist(),
    "sums": numpy.nansum(change.astype("f8"), axis=(1, 2)).tolist(),
    "counts": numpy.isfinite(change).sum(axis=(1, 2)).tolist(),
}))
"""


@pytest.mark.integration
def test_odc_stac_and_pystac_client_open_the_catalogue_without_hints(site, tmp_path):
    (path,) = export(site, "stac", Span.parse("2025-11-21T03:30", None), tmp_path / "stac")
    program = f"path = {str(path)!r}\n{OPEN_CATALOGUE}"
    actual = json.loads(run(readers_python(), "-W", "ignore", "-c", program).stdout)
    with station.open(site.station.data) as ds:
        change = ds.elevation_change[-2:]
        assert actual["shape"] == [2, 45, 60]
        assert actual["times"] == ds.time[-2:].values.astype("datetime64[s]").astype(str).tolist()
        assert actual["sums"] == pytest.approx(change.astype("f8").sum(("y", "x")).values, rel=1e-9)
        assert actual["counts"] == change.count(("y", "x")).values.tolist()
    assert (actual["epsg"], actual["x"], actual["y"]) == (32632, [632005, 632015], [5185995, 5185985])


def test_csv_of_scans(site, tmp_path, small):
    scans, areas = export(site, "csv", None, tmp_path / "csv")
    rows = list(csv.DictReader(io.StringIO(scans.read_text())))
    assert [row["verdict"] for row in rows] == ["degraded", "good"] * 3
    assert rows[3]["scan"] == small.EVIL
    assert float(rows[2]["platform_roll"]) == pytest.approx(0.12)
    assert [row["in_reference"] for row in rows] == [""] * 6  # it was given as a surface
    series = series_in(site.station.data)
    reference = open_reference(series)
    provenance = tuple(
        {
            "scan_id": json.dumps(rows[index]["scan"]),
            "start_s": f"{3600 * index}",
            "end_s": f"{3600 * index + 900}",
        }
        for index in (1, 5)
    )
    write_reference(
        series, replace(reference, version="2"), ReferenceProvenance("2", scan_provenance=provenance)
    )
    with netCDF4.Dataset(series.folder / "reference.nc") as file:
        assert file.time_coverage_start == "1970-01-01T01:00:00Z"
        assert file.time_coverage_end == "1970-01-01T05:15:00Z"
    scans, _ = export(site, "csv", None, tmp_path / "csv")
    rows = list(csv.DictReader(io.StringIO(scans.read_text())))
    assert [row["in_reference"] for row in rows] == ["", "2", "", "", "", "2"]
    assert len(areas.read_text().splitlines()) == 13


def test_transformation_of_an_epoch_has_the_signs_of_the_adjustment(tmp_path):
    """Points on a plane, turned and shifted by it, rise by minus the effect J x of the estimate."""
    import h5py

    from station.archive.netcdf_layout import Series
    from station.science.uncertainty.jacobian import height_jacobian
    from station.science.uncertainty.parameters import ParameterLayout

    estimate = {
        "tilt_east": 3e-6, "tilt_north": -5e-6, "heading": 8e-6, "translation_east": 0.02,
        "translation_north": -0.01, "translation_up": 0.03,
    }  # fmt: skip
    scanner_m, gradient = np.array([632_000.0, 5_186_000.0, 2900.0]), np.array([0.2, -0.3])
    scale = np.array([1e-6, 1e-6, 1e-6, 1e-3, 1e-3, 1e-3])
    root = np.random.default_rng(2).normal(size=(6, 6)) * scale[:, None]
    covariance = root @ root.T  # correlated: a sign that is wrong changes the variance of points
    series = Series(tmp_path, "hef", None, None)
    with h5py.File(series.path, "w") as file:
        names = np.array([name.encode() for name in estimate], "S64")
        file["parameter_name"] = names.view("S1").reshape(len(names), 64)
        file["shared_parameter"] = [list(estimate.values())]
        file["shared_parameter_covariance"] = covariance[None]
        for axis, value_m in zip(("east", "north", "height"), scanner_m, strict=True):
            file[f"scanner_{axis}"] = [value_m]
    offset_m = np.random.default_rng(1).uniform(-2000, 2000, (50, 3))
    found = read_transformation(series, 0)
    moved = np.c_[scanner_m + offset_m, np.ones(50)] @ found.matrix.T
    motion_m = moved[:, :3] - scanner_m - offset_m
    rise_m = motion_m[:, 2] - motion_m[:, :2] @ gradient
    layout = ParameterLayout(0.0, 360, full_circle=True)
    jacobian = height_jacobian(layout, tuple(offset_m.T), *(np.full(50, slope) for slope in gradient))
    expected_m = -np.array([*estimate.values()]) @ jacobian.pose[:6]
    np.testing.assert_allclose(rise_m, expected_m, atol=2e-6)
    assert np.ptp(expected_m) > 0.01
    normal = np.array([*-gradient, 1.0])  # a small rotation w moves a point by w x P
    by_pose = np.c_[np.cross(offset_m, normal), np.tile(normal, (50, 1))]
    np.testing.assert_allclose(
        np.einsum("ni,ij,nj->n", by_pose, found.covariance, by_pose),
        np.einsum("in,ij,jn->n", jacobian.pose[:6], covariance, jacobian.pose[:6]),
        rtol=1e-4,
    )
