"""Files that older versions wrote are read as if they were of today."""

from dataclasses import replace

import netCDF4
import numpy as np
import pytest
from support.shared_parameters import random_shared

import station
from station.archive import epochs, reference_files
from station.archive.schema import VARIABLES
from station.archive.series import virtual
from station.archive.series.epoch_reader import read_source
from station.archive.series.index import series_in
from station.archive.series.virtual import build_series
from station.errors import StoreError
from station.products.epoch_table import read_epoch_table
from station.quantities import Reference, VarianceComponents
from station.sections.inputs import ScannerSection


def with_older_name(path):
    """Write the older name of the refraction over ice into a file of the store."""
    with netCDF4.Dataset(path, "r+") as file:
        file.set_auto_chartostring(False)
        names = [str(name) for name in netCDF4.chartostring(file["parameter_name"][:], "utf-8")]
        older = np.array([name.replace("refraction_ice", "refraction_moving") for name in names], "S64")
        assert b"refraction_moving" in older
        file["parameter_name"][:] = older.view("S1").reshape(len(older), 64)
        if "component_refraction_ice" in file.ncattrs():
            file.renameAttribute("component_refraction_ice", "component_refraction_moving")


def test_the_refraction_over_ice_keeps_its_column_under_its_older_name(series, epoch):
    shared = random_shared(3, series.grid)
    estimate = np.arange(len(shared.names), dtype=float)
    for hour in (3, 5):
        epochs.write_epoch(series, replace(epoch(hour), shared=replace(shared, estimate=estimate)))
    with_older_name(epochs.epoch_files(series)[0].path)
    build_series(series)
    source = read_source(series.processing_path, 0, 0, 2)
    assert list(source.parameters) == list(shared.names)
    assert source.scalars["shared_parameter"].tolist() == [estimate.tolist()] * 2


@pytest.mark.integration
def test_a_series_that_contained_everything_is_read_until_the_next_scan(series, epoch, monkeypatch):
    def only_series(series):
        text = "This file is virtual."
        return (virtual._VirtualFile(series.path, "Elevation change", text, VARIABLES),)

    with monkeypatch.context() as older:
        older.setattr(virtual, "_virtual_files", only_series)
        older.setattr(virtual, "write_manifest", lambda *_: None)
        for hour in (3, 5):
            epochs.write_epoch(series, epoch(hour))
            build_series(series)
    assert not series.processing_path.exists()
    table = read_epoch_table(series)
    assert table.scalars["platform_roll"].tolist() == [0.12, 0.12]
    with station.open(series.folder) as ds:
        covariance = ds.station.processing.shared_parameter_covariance.load()
    build_series(series)
    with station.open(series.folder) as ds:
        assert "shared_parameter_covariance" not in ds
        assert ds.station.processing.shared_parameter_covariance.load().identical(covariance)
    assert read_epoch_table(series).scalars["platform_roll"].tolist() == [0.12, 0.12]


def test_a_store_that_does_not_name_its_scanner_asks_for_the_site_file(series, epoch):
    epochs.write_epoch(series, epoch(3))
    build_series(series)
    with pytest.raises(StoreError, match="give the site file instead of the folder"):
        station.point_covariance(series.folder, [[632_100.0, 5_185_500.0, 2800.0]], 0)
    scanner = replace(ScannerSection().instrument, range_sigma_m=0.1 + 0.2)
    build_series(replace(series, scanner=scanner, name="a changed header, so that the file is written again"))
    assert series_in(series.folder).scanner == scanner


def test_a_reference_of_an_older_version_keeps_its_refraction_over_ice(series):
    elevation_m = np.full(series.grid.shape, 2900.0)
    reference = replace(
        Reference.from_elevation(series.grid, "1", elevation_m, elevation_m > 0),
        shared=random_shared(3, series.grid),
        components=VarianceComponents(refraction_ice=0.017),
    )
    reference_files.write_reference(series, reference)
    with_older_name(reference_files.reference_path(series, "1"))
    read = reference_files.read_reference(series, "1")
    assert read.components.refraction_ice == pytest.approx(0.017)
    assert read.shared.names == reference.shared.names
    assert read.sop_scan_count is None  # older versions do not say it
    assert reference_files.read_variance_components(series) == read.components
