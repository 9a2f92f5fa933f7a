"""The files of the store as other programs read them: CF checker, ncdump, CDO, NCO, GDAL, xarray."""

import dataclasses
import pickle
import subprocess
import sys
from contextlib import contextmanager
from datetime import UTC, datetime

import numpy as np
import pytest
import shapely
import xarray as xr
from support.epochs import START_S
from support.programs import (
    assert_gdal_knows_the_place,
    filled_metadata,
    findings,
    gdal_value,
    recommendations,
    run,
    tool,
)

from station.archive import epochs, reference_files
from station.archive.areas import AreaChange, update_areas
from station.archive.derived.boxes import Entries
from station.archive.derived.product_files import ProductFile, update_product
from station.archive.series.compaction import compact
from station.archive.series.virtual import build_series
from station.products.exports.product_maps import export_maps
from station.quantities import Reference
from station.queries.blocks import BlockQueries, update_boxes
from station.queries.site_products.product_queries import Product
from station.sections.product import ProductSection

pytestmark = pytest.mark.integration


@pytest.fixture
def built(series, epoch):
    for hour in range(4):
        epochs.write_epoch(series, epoch(hour, terms=True))
    elevation = np.full(series.grid.shape, 2900.125)
    reference_files.write_reference(
        series,
        Reference.from_elevation(series.grid, "1", elevation),
    )
    return build_series(series)


def test_compliance_checker_accepts_epoch_series_and_reference(built, tmp_path):
    epoch = built.parent / "epochs/2025/11/21/hef_20251121T010000Z.nc"
    beside = (built.parent / name for name in ("processing.nc", "reference.nc"))
    assert findings(tmp_path / "report.json", built, *beside, epoch) == []


def test_compliance_checker_accepts_compacted_files(built, series, tmp_path):
    compact(series, datetime(2026, 2, 1, tzinfo=UTC), lambda: None)
    build_series(series)
    month = built.parent / "months/2025/hef_202511_r1.nc"
    assert findings(tmp_path / "report.json", built, month) == []


def test_compliance_checker_accepts_files_without_a_map_projection(series, epoch, tmp_path):
    local = dataclasses.replace(series, crs=None, vertical_datum="")
    epochs.write_epoch(local, epoch(0))
    build_series(local)
    elevation = np.full(series.grid.shape, 2900.125)
    reference_files.write_reference(local, Reference.from_elevation(series.grid, "1", elevation))
    paths = [series.folder / name for name in ("series.nc", "reference.nc")]
    for path in paths:
        with xr.open_dataset(path) as ds:
            assert "crs" not in ds
    assert findings(tmp_path / "report.json", *paths) == []


def test_other_programs_read_compacted_files(built, series, tmp_path):
    compact(series, datetime(2026, 2, 1, tzinfo=UTC), lambda: None)
    build_series(series)
    for path in (built, built.parent / "months/2025/hef_202511_r1.nc"):
        assert "elevation_change" in run(tool("cdo"), "infon", path).stdout
        assert run(tool("ncdump"), "-v", "scan_id", path).stdout.count('"251121_0') == 4
        assert gdal_value(path) == pytest.approx(0.03, abs=1e-3)
        mean = tmp_path / "mean.nc"
        run(tool("ncra"), "-O", "-3", "-v", "elevation_change", path, mean)
        with xr.open_dataset(mean) as ds:
            assert float(ds.elevation_change[0, 5, 5]) == pytest.approx(0.015, abs=1e-3)


def test_ncdump_prints_header_and_values(built):
    assert "elevation_change(time, y, x)" in run(tool("ncdump"), "-h", built).stdout
    assert "0.03" in run(tool("ncdump"), "-v", "elevation_change", built).stdout


def test_cdo_reads_values_and_grid_without_a_warning(built):
    shown = run(tool("cdo"), "infon", built)
    assert "elevation_change" in shown.stdout
    warnings = [line for line in shown.stderr.splitlines() if "(char/string), skipped" not in line]
    assert "warning" not in "".join(warnings).lower()
    grid = run(tool("cdo"), "griddes", built).stdout
    assert "+proj=utm +zone=32" in grid


@pytest.mark.parametrize("chunking", ["-3", "--cnk_plc=xst"])
def test_nco_averages_over_time(built, tmp_path, chunking):
    """NCO 5.1.4 invents chunk sizes for virtual variables unless the chunking of the output is given."""
    mean = tmp_path / "mean.nc"
    run(tool("ncra"), "-O", chunking, "-v", "elevation_change", built, mean)
    with xr.open_dataset(mean) as ds:
        assert float(ds.elevation_change[0, 5, 5]) == pytest.approx(0.015, abs=1e-3)
        assert np.isnan(ds.elevation_change[0, 5, -1])


def test_gdal_reads_position_orientation_and_projection(built):
    assert_gdal_knows_the_place(built)
    assert gdal_value(built) == pytest.approx(0.03, abs=1e-3)


class ConstantAggregator:
    def area(self, cells, _epoch):
        return AreaChange(*((0.25, 0.125, 0.2, 0.2, 0.5) if cells.all() else (*[np.nan] * 4, 0.0)))


@pytest.fixture
def areas_file(series, epoch):
    for hour in range(4):
        epochs.write_epoch(series, epoch(hour))
    build_series(series)
    everywhere = np.ones(series.grid.shape, bool)
    areas = {"Süd": everywhere, "unobserved": np.tri(*series.grid.shape, dtype=bool)}
    return update_areas(series, areas, ConstantAggregator(), lambda: None)


def test_compliance_checker_accepts_areas(areas_file, tmp_path):
    assert findings(tmp_path / "report.json", areas_file) == []


def test_compliance_checker_accepts_products_of_places_and_along_lines(series, tmp_path):
    paths = []
    for kind, dim in (("snow_depth", "place"), ("point", "place"), ("profile", "distance")):
        x_m = 632_100.0 + 10.0 * np.arange(2)
        places = {"names": ("Süd", "gauge")} if dim == "place" else {"distance_m": x_m - x_m[0]}
        product = ProductFile(kind, kind, kind, "recipe", dim, x_m, x_m + 4_553_000, **places)
        row = {spec.name: np.array([0.5, np.nan]) for spec in product.variables}
        entries = Entries(START_S + np.zeros(1), START_S + np.full(1, 900), *[np.array([b"1"])] * 2)
        compute = {0: row}.__getitem__
        paths.append(update_product(series, product, entries, np.zeros(1, int), compute, lambda: None))
    assert findings(tmp_path / "report.json", *paths) == []


@pytest.mark.usefixtures("built")
def test_compliance_checker_accepts_maps_of_products(series, tmp_path):
    melt = ProductSection.model_validate({"name": "melt", "kind": "melt", "density_kg_m3": 870.0})
    places = {"everywhere": np.ones(series.grid.shape, bool)}
    paths = export_maps(series, Product(melt, places), None, tmp_path, "netcdf")
    assert findings(tmp_path / "report.json", *paths) == []


def test_compliance_checker_accepts_outlines_of_areas(areas_file, series, tmp_path):
    """Version 6.1 wants the dimension of the nodes in the data, and polygons of one ring (against CF 7.5)."""
    part = shapely.box(632_100, 5_185_000, 632_300, 5_185_400) - shapely.box(
        632_150, 5_185_100, 632_200, 5_185_200
    )
    outlines = {"Süd": part | shapely.box(632_400, 5_185_000, 632_500, 5_185_100), "unobserved": part}
    everywhere = np.ones(series.grid.shape, bool)
    masks = {"Süd": everywhere, "unobserved": np.tri(*series.grid.shape, dtype=bool)}
    update_areas(series, masks, ConstantAggregator(), lambda: None, outlines)
    found = {
        message for *_, messages in findings(tmp_path / "report.json", areas_file) for message in messages
    }
    wrong = "does not include geometry dimension", "must have the same single dimension as interior ring"
    assert {message for message in found if not any(text in message for text in wrong)} == set()
    shown = run(tool("cdo"), "infon", areas_file).stderr
    assert "warning" not in "".join(line for line in shown.splitlines() if "skipped" not in line).lower()


def test_ncdump_prints_times_names_and_missing_values_of_areas(areas_file):
    text = run(tool("ncdump"), "-t", "-v", "time,area_name,mean_change", areas_file).stdout
    assert '"2025-11-21 00:07:30"' in text
    assert r'"S\303\274d"' in text  # ncdump prints UTF-8 in octal
    assert "0.25, _" in text


def test_cdo_averages_areas_over_time_without_a_warning(areas_file):
    output = run(tool("cdo"), "-s", "output", "-timmean", "-selname,mean_change", areas_file).stdout
    assert [float(value) for value in output.split()] == pytest.approx([0.25, 9.96921e36])
    shown = run(tool("cdo"), "infon", areas_file)
    assert "volume_change" in shown.stdout
    warnings = [line for line in shown.stderr.splitlines() if "(char/string), skipped" not in line]
    assert "warning" not in "".join(warnings).lower()


def test_nco_averages_areas_over_time(areas_file, tmp_path):
    mean = tmp_path / "mean.nc"
    run(tool("ncra"), "-O", "-v", "mean_change", areas_file, mean)
    with xr.open_dataset(mean) as ds:
        assert ds.area_name.values.tolist() == ["Süd", "unobserved"]
        assert ds.mean_change.values[0, 0] == 0.25
        assert np.isnan(ds.mean_change.values[0, 1])


@contextmanager
def continuously_rebuilt(series):
    """Rebuild the series in another process, as the service does: within a process, HDF5 has one lock."""
    program = (
        "import sys, pickle; from station.archive.series.manifest import MANIFEST\n"
        "from station.archive.series.virtual import build_series\n"
        "series = pickle.loads(bytes.fromhex(sys.argv[1]))\n"
        "while True:\n"
        "    (series.folder / MANIFEST).unlink(missing_ok=True)\n"  # else there is nothing to do
        "    build_series(series)\n"
    )
    writer = subprocess.Popen([sys.executable, "-c", program, pickle.dumps(series).hex()])
    first_inode = series.path.stat().st_ino
    try:
        while series.path.stat().st_ino == first_inode:
            assert writer.poll() is None
        yield
        assert writer.poll() is None
    finally:
        writer.kill()
        writer.wait()


@pytest.mark.parametrize("engine", ["netcdf4", pytest.param("h5netcdf", marks=pytest.mark.slow)])
def test_xarray_while_the_series_is_replaced(built, series, engine):
    with continuously_rebuilt(series):
        for _ in range(6):
            with xr.open_dataset(built, engine=engine) as ds:
                assert ds.elevation_change[:, 5, 5].values == pytest.approx([0, 0.01, 0.02, 0.03], abs=1e-3)


def test_other_programs_while_the_series_is_replaced(built, series):
    ncdump, cdo, gdal = tool("ncdump"), tool("cdo"), tool("gdalinfo")
    with continuously_rebuilt(series):
        for _ in range(5):
            assert "elevation_change(time, y, x)" in run(ncdump, "-h", built).stdout
            assert "elevation_change" in run(cdo, "infon", built).stdout
            assert 'ID["EPSG",32632]' in run(gdal, f"NETCDF:{built}:elevation_change").stdout


def test_nco_averages_over_epochs(built, tmp_path):
    mean = tmp_path / "mean.nc"
    run(tool("ncra"), "-O", *sorted(built.parent.glob("epochs/*/*/*/*.nc")), mean)
    with xr.open_dataset(mean) as ds:
        assert float(ds.elevation_change[0, 5, 5]) == pytest.approx(0.015, abs=1e-3)


@pytest.mark.filterwarnings("ignore::PendingDeprecationWarning")  # rioxarray's own use of affine
def test_rioxarray_reads_the_projection(built):
    rioxarray = pytest.importorskip("rioxarray")
    with rioxarray.open_rasterio(f"netcdf:{built}:elevation_change") as ds:
        assert ds.rio.crs.to_epsg() == 32632
        assert ds.rio.transform().e == -10.0


@pytest.fixture
def box_files(series, epoch):
    """`boxes.nc` and `daily.nc` of two epochs of a day, and one of the next."""
    series = dataclasses.replace(series, metadata=filled_metadata())
    surface = np.full(series.grid.shape, 2800.0)
    reference_files.write_reference(series, Reference.from_elevation(series.grid, "1", surface))
    for hour in (1, 2, 30):
        epochs.write_epoch(series, epoch(hour))
    build_series(series)
    update_boxes(series, BlockQueries(series), lambda: None)
    return [series.folder / name for name in ("boxes.nc", "daily.nc")]


def test_compliance_checker_accepts_boxes(box_files, tmp_path):
    assert findings(tmp_path / "report.json", *box_files) == []


def test_data_discovery_checker_recommends_nothing(box_files, series, tmp_path):
    """For all kinds of files; it compares the middle of a day in `daily.nc` with the ends of the coverage."""
    described = dataclasses.replace(series, metadata=filled_metadata())
    areas = update_areas(
        described, {"all": np.ones(series.grid.shape, bool)}, ConstantAggregator(), lambda: None
    )
    epoch_path = next((series.folder / "epochs").rglob("*.nc"))
    surface = Reference.from_elevation(series.grid, "2", np.full(series.grid.shape, 2900.0))
    scans = tuple(
        {
            "scan_id": f'"{hour}"',
            "start_s": str(START_S + 3600 * hour),
            "end_s": str(START_S + 3600 * hour + 900),
        }
        for hour in range(2)
    )
    provenance = reference_files.ReferenceProvenance("2", scan_provenance=scans)
    reference_files.write_reference(described, surface, provenance)
    reference = reference_files.version_path(series, "2")
    with xr.open_dataset(reference) as ds:
        assert ds.scan_time.dt.minute.to_numpy().tolist() == [7, 7]  # of scans of 15 minutes
    paths = *box_files, areas, reference, series.path, series.processing_path, epoch_path
    ((name, check, messages),) = recommendations(tmp_path / "report.json", *paths)
    assert (name, check) == ("daily.nc", "time_coverage_extents_match")
    assert all("T12:00:00+00:00 (time" in message for message in messages)


def test_other_programs_read_boxes(box_files, tmp_path):
    """The change is the hour in centimetres, σ of a cell 0.05 m; boxes have 10 × 10 cells."""
    boxes, daily = box_files
    run(tool("ncks"), "-O", "-d", "time,1", "-v", "elevation_change", boxes, tmp_path / "one.nc")
    with xr.open_dataset(tmp_path / "one.nc") as ds:
        assert float(ds.elevation_change[0, 3, 3]) == pytest.approx(0.02, abs=1e-4)
    value = gdal_value(boxes, "elevation_change_uncertainty", band=1)
    assert value == pytest.approx(0.05 / 10, rel=1e-2)
    mean = run(
        tool("cdo"), "-s", "outputf,%.4f,1", "-selindexbox,1,1,1,1", "-selname,elevation_change", daily
    )
    assert float(mean.stdout) == pytest.approx(0.015, abs=1e-4)
