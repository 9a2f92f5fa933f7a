"""Attributes by which files are found and cited: extent, time coverage, and what the site file says."""

from dataclasses import replace

import netCDF4
import numpy as np
import pytest
from pydantic import ValidationError
from pyproj import Transformer
from support.epochs import write_surface

import station
from station.archive import epochs
from station.archive.discovery import extent, time_coverage
from station.archive.series.virtual import build_series
from station.quantities import Grid
from station.sections.results import MetadataSection

GRID = Grid(west_m=632000.0, north_m=5186000.0, cell_m=10.0, nx=150, ny=140)


def test_extent_contains_every_cell_and_hardly_more():
    to_degrees = Transformer.from_crs("EPSG:32632", "EPSG:4326", always_xy=True)
    lon, lat = to_degrees.transform(*[axis.ravel() for axis in _edges(GRID)])
    attrs = extent(GRID, "EPSG:32632")
    assert attrs["geospatial_lon_min"] == pytest.approx(lon.min(), abs=2e-6)
    assert attrs["geospatial_lon_max"] == pytest.approx(lon.max(), abs=2e-6)
    assert attrs["geospatial_lat_min"] == pytest.approx(lat.min(), abs=2e-6)
    assert attrs["geospatial_lat_max"] == pytest.approx(lat.max(), abs=2e-6)
    assert attrs["geospatial_bounds"].startswith(f"POLYGON (({lat[0]:.6f} {lon[0]:.6f}, ")
    assert extent(GRID, None) == {}


def _edges(grid):
    x_m = grid.west_m + grid.cell_m * np.arange(grid.nx + 1)
    y_m = grid.north_m - grid.cell_m * np.arange(grid.ny, -1, -1)
    return np.meshgrid(x_m, y_m)


def test_time_coverage_is_from_the_first_start_to_the_last_end():
    assert time_coverage(1_763_683_200.0, 1_763_683_200.0 + 2 * 86_400 + 5445) == {
        "time_coverage_start": "2025-11-21T00:00:00Z",
        "time_coverage_end": "2025-11-23T01:30:45Z",
        "time_coverage_duration": "P2DT1H30M45S",
    }


@pytest.mark.integration
def test_series_that_grows_covers_the_time_of_all_its_epochs(series, epoch):
    for hour in (1, 2, 5):
        epochs.write_epoch(series, epoch(hour))
        with netCDF4.Dataset(build_series(series)) as file:
            assert file.time_coverage_start == "2025-11-21T01:00:00Z"
            assert file.time_coverage_end == f"2025-11-21T{hour:02d}:15:00Z"


def test_metadata_of_the_site_file_is_in_every_file(series, epoch):
    metadata = MetadataSection(
        summary="A glacier.",
        keywords=("ice", "laser"),
        creator_orcid="0000-0002-1825-0097",
        doi="10.5281/z.1",
    )
    named = replace(series, metadata=tuple(metadata.attributes.items()))
    epochs.write_epoch(named, epoch(0))
    for path in (build_series(named), next(series.folder.rglob("epochs/**/*.nc"))):
        with netCDF4.Dataset(path) as file:
            assert (file.summary, file.keywords, file.id) == ("A glacier.", "ice, laser", "10.5281/z.1")
            assert file.creator_url == "https://orcid.org/0000-0002-1825-0097"
            assert file.metadata_link == "https://doi.org/10.5281/z.1"


@pytest.mark.parametrize(
    "wrong", [{"creator_orcid": "https://orcid.org/0000-0002-1825-0097"}, {"doi": "zenodo.1"}]
)
def test_malformed_identifiers_are_refused(wrong):
    with pytest.raises(ValidationError):
        MetadataSection(**wrong)


@pytest.mark.parametrize(
    ("vertical_datum", "crs", "name"),
    [
        ("", "EPSG:32632", "height_above_reference_ellipsoid"),
        ("EGM2008 geoid", "EPSG:32632", "surface_altitude"),
        ("", "EPSG:25832+7837", "surface_altitude"),
        ("", None, "surface_altitude"),
    ],
)
def test_heights_are_above_the_ellipsoid_unless_a_geoid_is_named(series, epoch, vertical_datum, crs, name):
    other = replace(series, vertical_datum=vertical_datum, crs=crs)
    epochs.write_epoch(other, epoch(0))
    with netCDF4.Dataset(build_series(other)) as file:
        assert file["elevation_outside_reference"].standard_name == name
        assert set(file["elevation_change"].ancillary_variables.split()) <= file.variables.keys()
    with station.open(other.folder) as ds:
        assert ds.elevation.standard_name == name


@pytest.mark.parametrize(
    ("crs", "datum", "expected"),
    [
        ("EPSG:32632", "", "EPSG:4979"),
        ("EPSG:32632", "EGM2008 geoid", "EGM2008 geoid"),
        ("EPSG:25832+5783", "", "EPSG:5783"),  # DHHN92 height
        (None, "", None),
    ],
)
def test_vertical_crs_is_the_ellipsoid_unless_another_is_named(series, crs, datum, expected):
    described = replace(series, crs=crs, vertical_datum=datum)
    assert described.vertical_crs == expected
    assert described.has_ellipsoidal_heights == (expected == "EPSG:4979")


def test_a_file_before_the_first_reference_has_no_height_extent(series, epoch):
    paths = [epochs.write_epoch(series, epoch(0)).path]
    write_surface(series)
    paths.append(epochs.write_epoch(series, epoch(1)).path)
    found = []
    for path in paths:
        with netCDF4.Dataset(path) as file:
            found.append("height_extent" in file.variables)
    assert found == [False, True]
