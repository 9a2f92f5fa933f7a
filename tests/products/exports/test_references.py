"""References and descriptions of the series, read by fsspec, zarr and xarray."""

import dataclasses
import json
from datetime import UTC, datetime
from xml.etree import ElementTree as ET

import fsspec
import numpy as np
import pytest
import xarray as xr
import zarr
from support.epochs import make_epoch

from station.archive import epochs
from station.archive.series.compaction import compact
from station.archive.series.virtual import build_series
from station.errors import StationError
from station.products.area_tables import Span
from station.products.exports.formats import FORMATS
from station.products.exports.selection import pending, select, split

ALWAYS = Span.parse(None, None)
NCML = "{http://www.unidata.ucar.edu/namespaces/netcdf/ncml-2.2}"


@pytest.fixture(scope="module")
def filled(base_store):
    """A series of a compacted day, and of single epochs."""
    for hour in (0, 1, 2, 25, 26):
        epochs.write_epoch(
            base_store, dataclasses.replace(make_epoch(hour), verdict_reason="Schnee über Fels")
        )
    compact(base_store, datetime(2025, 11, 22, 12, tzinfo=UTC), lambda: None)
    build_series(base_store)
    return base_store


def write(kind, selection, out, every=None):
    chosen = FORMATS[kind]
    parts = pending(selection, split(selection, out, chosen.suffix, every), chosen.read_fingerprint)
    return list(chosen.write(selection, parts, lambda _: None, lambda _: None))


def referring(series, span=ALWAYS, **options):
    return dataclasses.replace(select(series, span, **options), url=series.folder.as_uri())


def open_references(path):
    files = fsspec.filesystem(
        "reference", fo=str(path), asynchronous=True, remote_protocol="file",
        remote_options={"asynchronous": True},
    )  # fmt: skip
    store = zarr.storage.FsspecStore(files, read_only=True)
    return xr.open_zarr(store, zarr_format=2, consolidated=False, chunks=None, decode_timedelta=False)


def test_references_read_like_the_series(stored, tmp_path):
    (path,) = write("references", referring(stored), tmp_path / "all.json")
    with xr.open_dataset(stored.path, decode_timedelta=False) as expected:
        actual = open_references(path)
        assert set(actual) == set(expected)
        for name in actual.variables:
            assert actual[name].dtype.kind == expected[name].dtype.kind or expected[name].dtype == object
            np.testing.assert_array_equal(actual[name].values, expected[name].values)
        assert actual.elevation_change.attrs["grid_mapping"] == "crs"
        assert np.isnan(actual.elevation_change[0, 0, -1])


@pytest.mark.integration
def test_references_are_renewed_when_a_chunk_moves(stored, tmp_path):
    out = tmp_path / "days"
    assert len(write("references", referring(stored), out, "1D")) == 2
    assert write("references", referring(stored), out, "1D") == []
    compact(stored, datetime(2025, 11, 23, 12, tzinfo=UTC), lambda: None)
    build_series(stored)
    assert [path.name for path in write("references", referring(stored), out, "1D")] == ["hef_20251122.json"]
    refs = json.loads((out / "hef_20251122.json").read_text())["refs"]
    urls = {ref[0] for ref in refs.values() if isinstance(ref, list)}
    assert urls == {f"{stored.folder.as_uri()}/days/2025/11/hef_20251122_r1.nc"}
    elsewhere = dataclasses.replace(referring(stored), url="s3://bucket/hef")
    assert len(write("references", elsewhere, out, "1D")) == 2


def test_references_are_to_the_whole_grid(stored, tmp_path):
    cropped = select(stored, ALWAYS, (632_000.0, 5_185_500.0, 632_500.0, 5_186_000.0))
    for kind, name in (("references", "box.json"), ("ncml", "box.ncml")):
        with pytest.raises(StationError, match="leave --area out"):
            write(kind, cropped, tmp_path / name)


def test_ncml_joins_the_files_of_the_series(stored, tmp_path):
    (path,) = write("ncml", select(stored, ALWAYS), tmp_path / "served" / "series.ncml")
    joined = ET.parse(path).getroot().find(f"{NCML}aggregation")  # noqa: S314 - just written
    assert joined.attrib == {"dimName": "time", "type": "joinExisting"}
    files = [xr.open_dataset((path.parent / part.get("location")).resolve()) for part in joined]
    assert (
        [file.sizes["time"] for file in files] == [int(part.get("ncoords")) for part in joined] == [3, 1, 1]
    )
    with xr.open_dataset(stored.path) as series_file:
        joined_files = xr.concat([file.elevation_change for file in files], "time")
        np.testing.assert_array_equal(joined_files, series_file.elevation_change)
    assert write("ncml", select(stored, ALWAYS), path) == [path]  # always up to date


def test_ncml_does_not_join_a_part_of_a_file(stored, epoch, tmp_path):
    epochs.write_epoch(stored, epoch(1, value=0.5))
    build_series(stored)
    with pytest.raises(StationError, match="only a part of its epochs is valid"):
        write("ncml", select(stored, ALWAYS), tmp_path / "series.ncml")


def test_erddap_describes_the_exported_files(stored, tmp_path):
    served = tmp_path / "served"
    exported = write("netcdf", select(stored, ALWAYS), served, "1M")
    (path,) = write("erddap", select(stored, ALWAYS), served / "hef.xml")
    root = ET.parse(path).getroot()  # noqa: S314 - just written
    assert root.find("fileDir").text == f"{served}/"
    import re

    assert re.fullmatch(root.find("fileNameRegex").text, exported[0].name)
    atts = {att.get("name"): att.text for att in root.find("addAttributes")}
    assert {"cdm_data_type", "infoUrl", "institution", "license", "sourceUrl", "summary", "title"} <= set(
        atts
    )
    assert atts["license"] == "CC-BY-4.0"
    assert [axis.find("sourceName").text for axis in root.iter("axisVariable")] == ["time", "y", "x"]
    numpy_types = {"float": "f4", "int": "i4", "short": "i2"}
    with xr.open_dataset(exported[0], decode_cf=False) as ds:
        for variable in root.iter("dataVariable"):
            raster = ds[variable.find("sourceName").text]
            assert raster.dims == ("time", "y", "x")
            assert raster.dtype == numpy_types[variable.find("dataType").text]


@pytest.mark.parametrize(
    ("kind", "name", "text"),
    [
        ("erddap", "datasets.xml", "<erddapDatasets></erddapDatasets>"),
        ("ncml", "other.ncml", "<catalog></catalog>"),
        ("references", "other.json", '{"refs": {}}'),
    ],
)
def test_a_foreign_file_is_not_replaced(stored, tmp_path, kind, name, text):
    (tmp_path / name).write_text(text)
    with pytest.raises(StationError, match="exists and is no export"):
        write(kind, select(stored, ALWAYS), tmp_path / name)
    assert (tmp_path / name).read_text() == text
