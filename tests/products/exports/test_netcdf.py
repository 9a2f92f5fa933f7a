"""Self-contained NetCDF files of the series: the same bits, resumable, clear about what is wrong."""

import dataclasses
import subprocess
import sys
from datetime import UTC, datetime

import netCDF4
import numpy as np
import pytest
from support.epochs import make_epoch, write_surface

import station
from station.archive import epochs
from station.archive.schema import FILL
from station.archive.series.compaction import compact
from station.archive.series.virtual import build_series
from station.errors import StationError, StoreError
from station.products.area_tables import Span
from station.products.exports.formats import FORMATS
from station.products.exports.selection import parse_box, pending, select, split

ALWAYS = Span.parse(None, None)
NETCDF = FORMATS["netcdf"]


@pytest.fixture(scope="module")
def filled(base_store):
    """A series of two days; the shared parameters change on the second."""
    for hour in (0, 1, 2, 25, 26):
        result = make_epoch(hour, terms=hour > 1)
        if hour > 24:
            shared = dataclasses.replace(result.shared, names=("range_bias", "tilt_north", "heading"))
            result = dataclasses.replace(result, shared=shared, verdict_reason="Schnee über Fels")
        epochs.write_epoch(base_store, result)
    compact(base_store, datetime(2025, 11, 22, 12, tzinfo=UTC), lambda: None)
    build_series(base_store)
    return base_store


def write(selection, out, every=None, advance=lambda _: None, verify=lambda _: None):
    parts = pending(selection, split(selection, out, ".nc", every), NETCDF.read_fingerprint)
    return list(NETCDF.write(selection, parts, verify, advance))


def raw(path):
    """Return the stored values of all variables of a file, and its global attributes."""
    with netCDF4.Dataset(path) as file:
        file.set_auto_maskandscale(False)
        file.set_auto_chartostring(False)
        attrs = {name: str(file.getncattr(name)) for name in file.ncattrs()}
        return {name: variable[...] for name, variable in file.variables.items()}, attrs


def computed(series):
    """Return the rasters that `station.open` computes, with fill values."""
    with station.open(series.folder) as ds:
        names = "elevation", "elevation_change_random_uncertainty"
        return {name: ds[name].fillna(np.float32(FILL)).to_numpy() for name in names}


@pytest.mark.parametrize("chunks", [None, "2,64,150", "5,7,11"])
def test_every_variable_has_the_bits_of_the_series(stored, tmp_path, chunks):
    (path,) = write(select(stored, ALWAYS, variables="all", chunks=chunks), tmp_path / "all.nc")
    (expected, series_attrs), (actual, attrs) = raw(stored.path), raw(path)
    expected |= raw(stored.processing_path)[0] | computed(stored)
    del expected["elevation_outside_reference"]
    assert set(actual) == set(expected)
    assert {"sigma_geometry", "shared_parameter_covariance", "change_errors"} < set(actual)
    for name, values in expected.items():
        assert actual[name].dtype == values.dtype
        assert actual[name].tobytes() == values.tobytes(), name
    changed = {name for name, text in series_attrs.items() if attrs.get(name) != text}
    assert changed <= {"title", "history", "date_created", "comment"}
    assert "virtual" not in attrs.get("comment", "")  # as that of the series says
    with netCDF4.Dataset(path) as file:
        assert all(file[name].filters()["zlib"] for name in ("elevation", "quality", "change_errors"))


def test_attributes_of_variables_are_those_of_the_series(stored, tmp_path):
    (path,) = write(select(stored, ALWAYS), tmp_path / "all.nc")
    with netCDF4.Dataset(stored.path) as series_file, netCDF4.Dataset(path) as file:
        names = series_file.variables.keys() - {"elevation_outside_reference"}
        assert set(file.variables) - names == {"elevation"}
        for name, variable in ((name, series_file[name]) for name in names):
            for attr in variable.ncattrs():
                assert np.array_equal(file[name].getncattr(attr), variable.getncattr(attr)), (name, attr)


def test_the_attributes_of_the_draft_on_uncertainty_are_an_option(stored, epoch, tmp_path):
    with netCDF4.Dataset(stored.path) as file:
        assert "uncertainty_variables" not in file["elevation_change"].ncattrs()
    drafted = dataclasses.replace(stored, cf_uncertainty=True)
    epochs.write_epoch(drafted, epoch(27))
    build_series(drafted)
    (all_path,) = write(select(drafted, ALWAYS), tmp_path / "all.nc")
    selected = select(drafted, ALWAYS, variables="elevation_change,elevation_change_systematic_uncertainty")
    (part_path,) = write(selected, tmp_path / "part.nc")
    both = "elevation_change_uncertainty elevation_change_systematic_uncertainty"
    for path, named in ((drafted.path, both), (all_path, both), (part_path, both.split()[1])):
        with netCDF4.Dataset(path) as file:
            assert file["elevation_change"].uncertainty_variables == named
            assert file["elevation_change_systematic_uncertainty"].coverage_interval == "standard_deviation"
            assert "uncertainty_variables" not in file["verdict"].ncattrs()


def test_values_that_were_never_seen_take_no_space(stored, tmp_path):
    (path,) = write(select(stored, ALWAYS, chunks="1,70,75"), tmp_path / "all.nc")
    import h5py

    with h5py.File(path) as file:
        assert file["elevation"].id.get_num_chunks() == 5 * 2  # of four per epoch: the east was never seen


def test_a_box_and_some_variables(stored, tmp_path):
    box_m = parse_box("632105,5185495,632355,5185605", None, None)
    selection = select(stored, ALWAYS, box_m, "elevation_change,air_temperature", "2,4,8")
    (path,) = write(selection, tmp_path / "box.nc")
    (expected, _), (actual, attrs) = raw(stored.path), raw(path)
    assert set(actual) == {
        "time", "time_bnds", "x", "x_bnds", "y", "y_bnds", "crs", "elevation_change", "air_temperature",
        "scan_id", "verdict", "verdict_reason", "longitude_extent", "latitude_extent", "height_extent",
    }  # fmt: skip
    assert actual["x"].tolist() == [632115 + 10 * column for column in range(24)]
    assert actual["y"].tolist() == [5185595 - 10 * row for row in range(10)]
    window = expected["elevation_change"][:, 40:50, 11:35]
    assert actual["elevation_change"].tobytes() == np.ascontiguousarray(window).tobytes()
    with netCDF4.Dataset(path) as file:
        assert file["elevation_change"].chunking() == [2, 4, 8]
        assert "ancillary_variables" not in file["elevation_change"].ncattrs()
        assert file["crs"].GeoTransform == "632110.0 10.0 0 5185600.0 0 -10.0"
    assert 10.7 < float(attrs["geospatial_lon_min"]) < float(attrs["geospatial_lon_max"]) < 10.8


def test_coordinates_of_a_box_keep_their_bits(series, epoch, tmp_path):
    grid = dataclasses.replace(series.grid, west_m=632_000.1, cell_m=0.3)
    fine = dataclasses.replace(series, grid=grid)
    write_surface(fine)
    epochs.write_epoch(fine, epoch(0, grid=grid))
    build_series(fine)
    selection = select(fine, ALWAYS, (632_010.0, 5_185_970.0, 632_020.0, 5_185_990.0))
    (path,) = write(selection, tmp_path / "box.nc")
    (expected, _), (actual, _) = raw(fine.path), raw(path)
    for name in ("x", "x_bnds", "y", "y_bnds"):
        assert np.isin(actual[name], expected[name]).all()


def test_an_interrupted_export_continues(stored, epoch, tmp_path):
    def interrupt(_):
        if (out / "hef_20251121.nc").exists():
            raise KeyboardInterrupt

    out = tmp_path / "days"
    selection = select(stored, ALWAYS)
    with pytest.raises(KeyboardInterrupt):
        write(selection, out, "1D", interrupt)
    assert [path.name for path in out.iterdir()] == ["hef_20251121.nc"]
    (out / f".hef_20251122.nc.{2**22 + 1}.part").write_bytes(b"left by a killed process")
    first_inode = (out / "hef_20251121.nc").stat().st_ino
    assert [path.name for path in write(selection, out, "1D")] == ["hef_20251122.nc"]
    assert sorted(path.name for path in out.iterdir()) == ["hef_20251121.nc", "hef_20251122.nc"]
    assert (out / "hef_20251121.nc").stat().st_ino == first_inode
    assert write(selection, out, "1D") == []
    epochs.write_epoch(stored, epoch(25, value=0.5))  # new content of a scan: a revision
    build_series(stored)
    renewed = write(select(stored, ALWAYS), out, "1D")
    assert [path.name for path in renewed] == ["hef_20251122.nc"]
    assert raw(renewed[0])[0]["elevation_change"][0, 0, 0] == 0.5


def test_files_of_other_variables_are_written_again(stored, tmp_path):
    write(select(stored, ALWAYS), tmp_path / "all.nc")
    assert write(select(stored, ALWAYS, variables="quality"), tmp_path / "all.nc")
    assert "elevation" not in raw(tmp_path / "all.nc")[0]


def test_a_foreign_file_is_not_replaced(stored, tmp_path):
    (tmp_path / "mine.nc").write_text("results")
    with pytest.raises(StationError, match=r"mine\.nc: exists and is no export"):
        write(select(stored, ALWAYS), tmp_path / "mine.nc")
    with pytest.raises(StationError, match=r"series\.nc: exists and is no export"):
        write(select(stored, ALWAYS), stored.path)


def test_a_damaged_source_leaves_no_file(stored, tmp_path):
    def verify(path):
        if path.parent.name != "11":
            raise StoreError(f"{path}: damaged")

    with pytest.raises(StoreError, match="damaged"):
        write(select(stored, ALWAYS), tmp_path / "out" / "all.nc", verify=verify)
    assert not list((tmp_path / "out").glob("*"))


def test_wrong_selections_say_what_there_is(stored, tmp_path):
    with pytest.raises(StationError, match="extends from 2025-11-21T00:00 to 2025-11-22T02:00 UTC"):
        select(stored, Span.parse("2026-01-01", None))
    with pytest.raises(StationError, match="no cell of the grid, 632000,5184600,633500,5186000"):
        select(stored, ALWAYS, (0.0, 0.0, 1.0, 1.0))
    with pytest.raises(
        StationError, match="'sigma_raster': not a variable of the series: choose all or from eleva"
    ):
        select(stored, ALWAYS, variables="quality,sigma_raster")
    for chunks in ("1,2", "0,1,1", "a,b,c", "1,1.5,2"):
        with pytest.raises(StationError, match="not a chunk"):
            select(stored, ALWAYS, chunks=chunks)
    with pytest.raises(StationError, match="not a box"):
        parse_box("5,0,1,9", None, None)
    with pytest.raises(StationError, match="nor an area: the site has none"):
        parse_box("glacier", None, None)
    with pytest.raises(StationError, match=r"ends in \.nc, or --every"):
        split(select(stored, ALWAYS), tmp_path / "out", ".nc", None)
    with pytest.raises(StationError, match="is a file, but --every needs a folder"):
        split(select(stored, ALWAYS), stored.path, ".nc", "1D")


def test_an_area_of_the_site_is_its_box(tmp_path):
    from station.readers.polygons import read_polygons

    areas = tmp_path / "areas.geojson"
    areas.write_text(
        '{"type": "Feature", "properties": {"name": "ice"}, "geometry": {"type": "Polygon", "coordinates":'
        " [[[632100, 5185000], [632500, 5185100], [632300, 5185900], [632100, 5185000]]]}}"
    )
    assert parse_box("ice", areas, "EPSG:32632") == (632100, 5185000, 632500, 5185900)
    assert list(read_polygons(areas, "EPSG:32632")) == ["ice"]
    with pytest.raises(StationError, match="nor one of the areas ice"):
        parse_box("rock", areas, "EPSG:32632")


PEAK = """
import pickle, resource, sys
from pathlib import Path
from station.products.area_tables import Span
from station.products.exports.formats import FORMATS
from station.products.exports.selection import select, split
series, out, kind, chunks = pickle.loads(bytes.fromhex(sys.argv[1]))
selection, chosen = select(series, Span.parse(None, None), chunks=chunks), FORMATS[kind]
parts = split(selection, out, chosen.suffix, None)
for path in chosen.write(selection, parts, lambda _: None, lambda _: None):
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
"""


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "chunks"), [("netcdf", None), ("netcdf", "24,64,64"), ("zarr", None)])
def test_memory_does_not_grow_with_the_series(series, epoch, tmp_path, kind, chunks):
    """Sixty epochs more, 420 MB of rasters, cost no more memory than their scalars."""
    import pickle

    def peak_mb(hours):
        arguments = pickle.dumps((series, tmp_path / f"{hours}{FORMATS[kind].suffix}", kind, chunks)).hex()
        command = [sys.executable, "-c", PEAK, arguments]
        return float(subprocess.run(command, capture_output=True, check=True, text=True).stdout)

    grid = dataclasses.replace(series.grid, nx=500, ny=500)
    series = dataclasses.replace(series, grid=grid)
    write_surface(series)
    for hour in range(12):
        epochs.write_epoch(series, epoch(hour, grid=grid))
    build_series(series)
    few_mb = peak_mb(12)
    for hour in range(12, 72):
        epochs.write_epoch(series, epoch(hour, grid=grid))
    build_series(series)
    assert peak_mb(72) < few_mb + 60
