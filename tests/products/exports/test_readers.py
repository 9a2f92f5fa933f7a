"""Exported files as other programs read them; the expected numbers are those that the scans were made of."""

import dataclasses

import numpy as np
import pytest
import xarray as xr
from support.epochs import SURFACE_M, make_epoch, write_surface
from support.programs import (
    assert_gdal_knows_the_place,
    filled_metadata,
    findings,
    gdal_value,
    readers_python,
    recommendations,
    run,
    tool,
)

from station.archive import epochs
from station.archive.series.virtual import build_series
from station.products.area_tables import Span
from station.products.exports.formats import FORMATS
from station.products.exports.selection import select, split

pytestmark = pytest.mark.integration
VALUES = (0.0, 0.01, 0.02, 0.03)  # change of the four epochs [m], in the western half of 150 x 140 cells
CELLS = 75 * 140


@pytest.fixture(scope="module")
def exported(base_store, tmp_path_factory):
    for hour in range(len(VALUES)):
        epochs.write_epoch(base_store, make_epoch(hour))
    build_series(base_store)
    return write(base_store, tmp_path_factory.mktemp("exported") / "all.nc")


def write(series, out):
    selection = select(series, Span.parse(None, None))
    chosen = FORMATS["netcdf"]
    (path,) = chosen.write(
        selection, split(selection, out, chosen.suffix, None), lambda _: None, lambda _: None
    )
    return path


@pytest.mark.parametrize("engine", ["netcdf4", "h5netcdf"])
def test_xarray(exported, engine):
    with xr.open_dataset(exported, engine=engine) as ds:
        assert ds.elevation_change.count(("y", "x")).values.tolist() == [CELLS] * 4
        assert ds.elevation_change.mean(("y", "x")).values == pytest.approx(VALUES, abs=1e-6)


def test_nco_copies_and_averages_without_options(exported, tmp_path):
    run(tool("ncks"), "-O", "-v", "elevation_change", "-d", "time,2", exported, tmp_path / "one.nc")
    run(tool("ncks"), "-O", "-4", exported, tmp_path / "copy.nc")
    run(tool("ncra"), "-O", "-v", "elevation_change", exported, tmp_path / "mean.nc")
    for name, expected in (("one.nc", 0.02), ("mean.nc", 0.015)):
        with xr.open_dataset(tmp_path / name) as ds:
            assert float(ds.elevation_change[0, 5, 5]) == pytest.approx(expected, abs=1e-6)
            assert int(ds.elevation_change.count()) == CELLS
    with xr.open_dataset(tmp_path / "copy.nc") as copy, xr.open_dataset(exported) as ds:
        assert copy.drop_attrs().identical(ds.drop_attrs())


def test_cdo_averages(exported, tmp_path):
    run(tool("cdo"), "-s", "timmean", "-selname,elevation_change", exported, tmp_path / "mean.nc")
    with xr.open_dataset(tmp_path / "mean.nc") as ds:
        assert float(ds.elevation_change.mean()) == pytest.approx(0.015, abs=1e-6)
        assert int(ds.elevation_change.count()) == CELLS


def test_gdal_reads_value_place_and_projection(exported):
    assert_gdal_knows_the_place(exported)
    assert gdal_value(exported) == pytest.approx(0.03, abs=1e-6)


R = {
    "ncdf4": """
        file <- nc_open(path)
        change <- ncvar_get(file, "elevation_change")  # x, y, time
        cat(apply(change, 3, mean, na.rm = TRUE), sum(!is.na(change)))
    """,
    "terra": """
        change <- rast(path, subds = "elevation_change")
        stopifnot(as.vector(ext(change)) == c(632000, 633500, 5184600, 5186000))
        stopifnot(crs(change, describe = TRUE)$code == "32632")
        cat(global(change, "mean", na.rm = TRUE)[[1]], sum(global(change, "notNA")[[1]]))
    """,
    "stars": """
        change <- read_mdim(path, variable = "elevation_change")
        stopifnot(st_crs(change)$epsg == 32632, names(dim(change))[3] == "time")
        stopifnot(as.vector(st_bbox(change)) == c(632000, 5184600, 633500, 5186000))
        values <- change[[1]]  # x, y, time
        cat(apply(values, 3, mean, na.rm = TRUE), sum(!is.na(values)))
    """,
}


@pytest.mark.parametrize("library", R)
def test_r(exported, library):
    rscript = tool("Rscript")
    if library not in run(rscript, "-e", "cat(rownames(installed.packages()))").stdout.split():
        pytest.skip(f"{library} is not installed")
    program = f'library({library}); path <- "{exported}"; {R[library]}'
    *means, count = map(float, run(rscript, "-e", program).stdout.split())
    assert means == pytest.approx(VALUES, abs=1e-6)
    assert count == 4 * CELLS


def test_octave(exported):
    octave = tool("octave-cli")
    if "netcdf" not in run(octave, "--eval", "pkg list").stdout:
        pytest.skip("the netcdf package of Octave is not installed")
    program = (
        f'pkg load netcdf; c = ncread("{exported}", "elevation_change");'
        ' printf("%.9f ", mean(reshape(c(1:75, :, :), [], 4)), sum(! isnan(c(:))))'
    )
    *means, count = map(float, run(octave, "--eval", program).stdout.split())
    assert means == pytest.approx(VALUES, abs=1e-6)
    assert count == 4 * CELLS


PYTHON = {
    "cf-python": """
import cf
fields = cf.read(path, backend="netCDF4")  # pyfive, the default, stops at chunks without a value
change = fields.select_by_ncvar("elevation_change")[0]
means = [float(change[time].mean()) for time in range(4)]
mean = float(change.collapse("T: mean").mean())
""",
    "iris": """
import iris
change = iris.load_cube(path, iris.Constraint(cube_func=lambda cube: cube.var_name == "elevation_change"))
means = [float(change[time].data.mean()) for time in range(4)]
mean = float(change.collapsed("time", iris.analysis.MEAN).data.mean())
""",
    "virtualizarr": """
import xarray
from obspec_utils.registry import ObjectStoreRegistry
from obstore.store import LocalStore
from virtualizarr.parsers import HDFParser
store = HDFParser()(f"file://{path}", ObjectStoreRegistry({"file://": LocalStore()}))
change = xarray.open_zarr(store, consolidated=False, zarr_format=3, chunks=None).elevation_change
means = change.mean(("y", "x")).values.tolist()
mean = float(change.mean("time").mean())
""",
}


@pytest.mark.parametrize("library", PYTHON)
def test_other_python_libraries(exported, library):
    program = f"path = {str(exported)!r}\n{PYTHON[library]}\nprint(*means, mean)"
    *means, mean = map(float, run(readers_python(), "-W", "ignore", "-c", program).stdout.split())
    assert means == pytest.approx(VALUES, abs=1e-6)
    assert mean == pytest.approx(0.015, abs=1e-6)


def test_compliance_checker_finds_nothing(exported, tmp_path):
    assert findings(tmp_path / "report.json", exported) == []


def test_data_discovery_checker_recommends_nothing(series, epoch, tmp_path):
    epochs.write_epoch(series, epoch(0))
    build_series(series)
    write_surface(series)
    described = dataclasses.replace(series, metadata=filled_metadata())  # filled in afterwards
    path = write(described, tmp_path / "all.nc")
    assert recommendations(tmp_path / "report.json", path) == []
    with xr.open_dataset(path) as ds:
        assert ds.attrs["license"] == "CC-BY-4.0"
        assert ds.attrs["geospatial_bounds_vertical_crs"] == "EPSG:4979"
        lowest_m, highest_m = ds.height_extent.values  # the surface rises by a millionth of the northing
        assert highest_m == pytest.approx(SURFACE_M + series.grid.north_m / 1e6, abs=1e-2)
        assert lowest_m <= highest_m == ds.attrs["geospatial_vertical_max"]
        assert np.isnan(ds.elevation_change[0, 0, -1])
