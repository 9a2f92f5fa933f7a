"""Elevation and random uncertainty, which are computed: in series of old and new epochs alike."""

import shutil
from dataclasses import replace
from datetime import UTC, datetime
from xml.etree import ElementTree as ET

import h5py
import netCDF4
import numpy as np
import pytest
import xarray as xr
from scipy.interpolate import interp1d
from support.epochs import GRID, make_epoch

import station
from station.archive.derived import computed_rasters
from station.archive.epochs import write_epoch
from station.archive.netcdf_layout import Series
from station.archive.raster_io import rounded
from station.archive.reference_files import open_mean_elevation, write_reference
from station.archive.schema import BY_NAME, FILL
from station.archive.series.compaction import compact
from station.archive.series.index import list_epochs
from station.archive.series.virtual import build_series
from station.errors import StoreError
from station.products.area_tables import Span
from station.products.exports.formats import FORMATS
from station.products.exports.selection import select, split
from station.quantities import Reference
from station.queries.blocks import BlockQueries

OUTSIDE = np.s_[100:, :40]  # observed, but not known in the reference
TODAY = ("elevation_outside_reference", "elevation_change_systematic_uncertainty")
DAY_AFTER = datetime(2025, 11, 22, 12, tzinfo=UTC)


def surface():
    """Heights of a steep slope, exact in the file of the reference."""
    return np.rint((2800 + 0.7 * np.arange(GRID.nx) + 0.3 * np.arange(GRID.ny)[:, None]) * 1024) / 1024


def sloping_epoch(hour):
    """Return an epoch on the slope whose change and uncertainties differ from cell to cell."""
    rng = np.random.default_rng(hour)
    epoch = make_epoch(hour)
    measurement, shape = epoch.measurement, GRID.shape
    columns = {
        "change_m": np.rint(256 * rng.normal(hour / 10, 0.1, shape)) / 256,
        "systematic_uncertainty_m": np.rint(1024 * rng.uniform(0.001, 0.05, shape)) / 1024,
    }
    random_m = rng.uniform(0.01, 0.05, shape)
    columns["uncertainty_m"] = np.hypot(random_m, columns["systematic_uncertainty_m"])
    columns["elevation_m"] = surface() + columns["change_m"]
    columns["change_m"][OUTSIDE] = np.nan
    unseen = measurement.count == 0
    for name, raster in columns.items():
        values = raster.ravel().astype(np.float32)
        values[unseen] = np.nan
        (measurement.change_m if name == "change_m" else measurement.cells[name])[:] = values
    return replace(epoch, measurement=measurement), random_m


def make_older(path, epoch, random_m):
    """Turn an epoch file into one of the version that stored elevation and random uncertainty."""
    measurement = epoch.measurement
    (elevation_m,) = measurement.to_rasters("elevation_m")
    random_m = np.where(measurement.count.reshape(GRID.shape) > 0, random_m, np.nan).astype(np.float32)
    with h5py.File(path, "r+") as file:
        for name in TODAY:
            del file[name]
    with netCDF4.Dataset(path, "r+") as file:
        for name, values in (
            ("elevation", elevation_m), ("elevation_change_random_uncertainty", random_m)
        ):  # fmt: skip
            variable = file.createVariable(
                name, "f4", ("time", "y", "x"), fill_value=FILL, zlib=True, complevel=1, shuffle=True,
                chunksizes=(1, 128, 128),
            )  # fmt: skip
            variable[0] = rounded(BY_NAME[name], values)


@pytest.fixture(scope="module")
def mixed_store(tmp_path_factory):
    """A compacted day of an old, a new and an old epoch, and one of each in files of their own."""
    series = Series(tmp_path_factory.mktemp("mixed"), "hef", GRID, "EPSG:32632")
    elevation_m = surface()
    elevation_m[OUTSIDE] = np.nan
    write_reference(series, Reference.from_elevation(GRID, "1", elevation_m, np.isfinite(elevation_m)))
    for hour in (1, 2, 3, 25, 26):
        epoch, random_m = sloping_epoch(hour)
        written = write_epoch(series, epoch)
        if hour in (1, 3, 25):
            make_older(written.path, epoch, random_m)
    compact(series, DAY_AFTER, lambda: None)
    build_series(series)
    kinds = [epoch.path.relative_to(series.folder).parts[0] for epoch in list_epochs(series)]
    assert kinds == ["days"] * 3 + ["epochs"] * 2
    return series


@pytest.fixture
def mixed(mixed_store, tmp_path):
    folder = tmp_path / "mixed"
    shutil.copytree(mixed_store.folder, folder)
    return replace(mixed_store, folder=folder)


def expected_rasters():
    """Return elevation, random and systematic uncertainty (5, ny, nx) as they were before the files."""
    rasters = []
    for hour in (1, 2, 3, 25, 26):
        epoch, random_m = sloping_epoch(hour)
        elevation_m, systematic_m = epoch.measurement.to_rasters("elevation_m", "systematic_uncertainty_m")
        rasters.append((elevation_m, np.where(np.isfinite(systematic_m), random_m, np.nan), systematic_m))
    return map(np.stack, zip(*rasters, strict=True))


NAMES = (
    "elevation", "elevation_change_random_uncertainty", "elevation_change_systematic_uncertainty",
)  # fmt: skip


def test_old_and_new_epochs_of_a_series_read_alike(mixed):
    with station.open(mixed.folder) as ds:
        for name, expected in zip(NAMES, expected_rasters(), strict=True):
            np.testing.assert_allclose(ds[name], expected, rtol=3e-4, err_msg=name)
            assert np.isfinite(ds[name][:, 120, 20]).all()  # outside the reference
            part = {"time": [4, 0], "y": [119, 3, 70], "x": slice(10, 60, 7)}
            np.testing.assert_array_equal(ds[name].isel(part), ds[name].load().isel(part))
        assert "elevation_outside_reference" not in ds


def test_an_export_of_old_and_new_epochs_has_the_values_of_the_series(mixed, tmp_path):
    selection = select(mixed, Span.parse(None, None), variables=",".join(NAMES))
    parts = split(selection, tmp_path / "all.nc", ".nc", None)
    (path,) = FORMATS["netcdf"].write(selection, parts, lambda _: None, lambda _: None)
    with station.open(mixed.folder) as ds, netCDF4.Dataset(path) as file:
        for name in NAMES:
            assert np.array_equal(np.ma.filled(file[name][:], np.nan), ds[name], equal_nan=True)


def test_the_reference_is_read_once_for_all_epochs_of_an_export(mixed, tmp_path, monkeypatch):
    windows = []

    def recorded(*version):
        read = open_mean_elevation(*version)
        return lambda *window: windows.append(window) or read(*window)

    monkeypatch.setattr(computed_rasters, "open_mean_elevation", recorded)
    selection = select(mixed, Span.parse(None, None), variables="elevation")
    parts = split(selection, tmp_path / "all.nc", ".nc", None)
    list(FORMATS["netcdf"].write(selection, parts, lambda _: None, lambda _: None))
    assert len(windows) == 1


def test_the_mean_elevation_of_the_reference_is_that_of_its_stored_surface(tmp_path):
    """Change counts from the surface as stored, to 1/1024 m: averaged here over 64 x 64 points of a cell."""
    series = Series(tmp_path, "hef", GRID, "EPSG:32632")
    random = np.random.default_rng(5)
    residual_m = random.normal(0, 0.01, GRID.shape).astype(np.float32)
    reference = Reference.from_elevation(GRID, "1", 2800 + random.normal(0, 0.3, GRID.shape))
    write_reference(series, replace(reference, mean_residual_m=residual_m))
    with xr.open_dataset(series.folder / "reference.nc") as ds:
        nodes, residual, mean = (
            ds[f"reference_{name}"].values.astype(np.float64)
            for name in ("elevation", "mean_residual", "mean_elevation")
        )
    for axis, size in enumerate(GRID.shape):
        fine = (np.arange(size * 64) + 0.5) / 64 - 0.5  # in cells, from the first centre
        line = interp1d(np.arange(size), nodes, axis=axis, bounds_error=False, fill_value="extrapolate")(fine)
        shape = (*nodes.shape[:axis], size, 64, *nodes.shape[axis + 1 :])
        nodes = line.reshape(shape).mean(axis=axis + 1)
    # Steps of float32 at 2,800 m are 0.24 mm, those of rounding 0.06 mm; unrounded nodes differ by 0.5 mm.
    np.testing.assert_allclose(mean - residual, nodes, rtol=0, atol=1.6e-4)


def test_boxes_of_an_old_and_of_a_new_epoch_of_the_same_values_are_equal(mixed):
    epoch, _ = sloping_epoch(1)  # in an old file in the series
    old = BlockQueries(mixed).boxes(list_epochs(mixed)[0])
    later = replace(epoch, start_s=epoch.start_s + 40 * 3600, end_s=epoch.end_s + 40 * 3600)
    write_epoch(mixed, later)
    build_series(mixed)
    new = BlockQueries(mixed).boxes(list_epochs(mixed)[-1])
    for name, values in old.items():
        np.testing.assert_allclose(new[name], values, rtol=1e-5, err_msg=name)
    weights = np.zeros(GRID.shape)
    weights[20:30, 10:30] = 1 / 200
    variances = [station.variance(mixed.folder, weights, epoch) for epoch in (0, -1)]
    assert variances[0] == pytest.approx(variances[1], rel=1e-5)


def test_the_elevation_without_its_reference_is_refused(mixed):
    for path in mixed.folder.glob("reference*.nc"):
        path.unlink()
    with station.open(mixed.folder) as ds:
        assert np.isfinite(ds.elevation_change_random_uncertainty[1, 20, 20])
        assert np.isfinite(ds.elevation[0, 20, 20])  # an old file has it
        with pytest.raises(StoreError, match=r"reference_1\.nc is missing"):
            ds.elevation[1, 20, 20].load()


def test_ncml_leaves_out_what_some_files_lack(mixed, tmp_path):
    """netCDF-Java 5.3 reads as zero what a file of a joined dataset lacks: tried on these files."""
    selection = select(mixed, Span.parse(None, None))
    parts = split(selection, tmp_path / "series.ncml", ".ncml", None)
    (path,) = FORMATS["ncml"].write(selection, parts, lambda _: None, lambda _: None)
    root = ET.parse(path).getroot()  # noqa: S314 - just written
    removed = {child.get("name") for child in root if child.tag.endswith("remove")}
    assert removed == {*NAMES, "elevation_outside_reference", "shared_parameter_redundancy"}
