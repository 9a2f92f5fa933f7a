"""`ds.station`, and arrays as users have them: flipped, transposed, cut out, with NaN."""

import shutil
from dataclasses import replace
from datetime import UTC, datetime

import netCDF4
import numpy as np
import pytest
import shapely
import xarray as xr
from support.epochs import GRID, make_epoch

import station
from station.archive.areas import update_areas
from station.archive.epochs import write_epoch
from station.archive.netcdf_layout import Series
from station.archive.reference_files import write_reference
from station.archive.series.index import series_in
from station.archive.series.virtual import build_series
from station.errors import StationError, StoreError
from station.quantities import Reference
from station.queries.aggregates import Aggregates
from station.queries.grid_arrays import to_mask

SQUARE = shapely.box(632_100.0, 5_185_500.0, 632_200.0, 5_185_700.0)  # 10 × 20 cells
RANDOM_M = 0.05  # of each cell


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    series = Series(tmp_path_factory.mktemp("store"), "hef", GRID, "EPSG:32632")
    write_reference(series, Reference.from_elevation(GRID, "1", np.full(GRID.shape, 2800.0)))
    for hour in (0, 1, 2, 5):
        epoch = make_epoch(hour)
        write_epoch(series, replace(epoch, provenance=epoch.provenance | {"reference_version": "1"}))
    build_series(series)
    outlines = {"square": SQUARE}
    masks = {name: to_mask(outline, series) for name, outline in outlines.items()}
    update_areas(series, masks, Aggregates(series), lambda: None, outlines)
    return series.folder


@pytest.fixture
def ds(folder):
    with station.open(folder) as ds:
        yield ds


def test_the_series_has_the_results_and_the_accessor_how_they_were_computed(ds):
    assert set(ds.data_vars) == {
        "elevation", "elevation_change", "elevation_change_uncertainty",
        "elevation_change_systematic_uncertainty", "elevation_change_random_uncertainty",
        "elevation_spread", "point_count", "quality", "scan_id",
        "verdict", "verdict_reason", "coverage", "valid_count", "stable_nmad", "air_temperature",
        "reference_version", "epoch_file",
    }  # fmt: skip
    assert set(ds.dims) == {"time", "y", "x", "bnds"}
    processing = ds.isel(time=[3, 1]).station.processing
    assert processing.change_errors[:, 0, 0].values == pytest.approx([5e-6, 1e-6])
    assert processing.sop_id.values.tolist() == ["sop-1"] * 2
    assert (processing.time == ds.time[[3, 1]]).all()


@pytest.mark.usefixtures("ds")  # station.open registers the accessor
@pytest.mark.parametrize("variables", [None, "all"])
def test_an_export_says_where_its_variances_are(folder, tmp_path, variables):
    from station.products.area_tables import Span
    from station.products.exports.formats import FORMATS
    from station.products.exports.selection import select, split

    selection = select(series_in(folder), Span.parse(None, None), variables=variables)
    parts = split(selection, tmp_path / "all.nc", ".nc", None)
    (path,) = FORMATS["netcdf"].write(selection, parts, lambda _: None, lambda _: None)
    with xr.open_dataset(path) as exported:
        with pytest.raises(StationError, match=r"all\.nc: has no reference .* station\.variance\(folder"):
            exported.station.variance(np.ones(GRID.shape, bool))
        cells = np.ones(GRID.shape, bool)
        expected = station.variance(folder, cells, 1)
        assert station.variance(folder, cells, exported.time[1]) == expected


def test_a_copy_with_the_newest_reference_only_answers_queries(folder, tmp_path):
    copied = shutil.copytree(folder, tmp_path / "copy")
    (copied / "reference_1.nc").unlink()
    cells = np.ones(GRID.shape, bool)
    assert station.variance(copied, cells, 1) == station.variance(folder, cells, 1)
    assert station.open(copied).station.variance(cells)[1] == station.variance(folder, cells, 1)
    with netCDF4.Dataset(copied / "reference.nc", "r+") as file:
        file.reference_version = "2"  # the copy of another version is no substitute
    with pytest.raises(StoreError, match="no reference 1"):
        station.variance(copied, cells, 1)


@pytest.fixture
def weights(ds):
    """Weights that are symmetric in neither direction."""
    rng = np.random.default_rng(3)
    return xr.zeros_like(ds.elevation_change[0]) + rng.uniform(size=GRID.shape)


def test_weights_are_aligned_by_their_coordinates(folder, weights):
    expected = station.variance(folder, weights.values, 1)
    part = weights[20:50, 10:30]
    alone = np.zeros(GRID.shape)
    alone[20:50, 10:30] = part
    for other in (weights[::-1], weights[:, ::-1], weights.T, weights.T[::-1, ::-1]):
        assert station.variance(folder, other, 1) == expected
    assert station.variance(folder, part[::-1].T, 1) == station.variance(folder, alone, 1)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda weights: weights.where(weights.x > 632_050), "700 weights are NaN"),
        (lambda weights: weights.assign_coords(x=weights.x + 3), "x of the array are not cell centres"),
        (lambda weights: weights.assign_coords(y=weights.y + 10 * GRID.ny), "y of the array are not"),
        (lambda weights: weights.values.T, r"shape \(150, 140\), the grid \(140, 150\)"),
        (lambda weights: weights.expand_dims("area"), "dimensions"),
    ],
)
def test_weights_that_do_not_fit_are_refused(folder, weights, change, message):
    with pytest.raises(ValueError, match=message):
        station.variance(folder, change(weights), 1)


def test_a_mask_stands_for_the_mean_of_the_cells_with_a_change(folder, ds):
    mask = (ds.x > 632_700) & (ds.y > 5_185_900)  # 10 rows; columns 70 to 149, of which 5 are observed
    assert station.variance(folder, mask, 0) == pytest.approx(RANDOM_M**2 / 50)
    assert np.isnan(station.variance(folder, (ds.x > 633_400) & (ds.y > 0), 0))


def test_epochs_are_given_as_users_have_them(folder, ds, weights):
    expected = station.variance(folder, weights, 1)
    middle = datetime(2025, 11, 21, 1, 7, 30, tzinfo=UTC)
    for epoch in (
        ds.time[1],
        ds.time.values[1],
        np.int64(1),
        middle,
        "2025-11-21T01:10Z",
        "2025-11-21T02:07+01:00",
    ):
        assert station.variance(folder, weights, epoch) == expected
    for epoch, error in (
        ("2031-01-01", StationError),
        (4, StationError),
        ("soon", ValueError),
        (ds.time, ValueError),
    ):
        with pytest.raises(error):
            station.variance(folder, weights, epoch)


def test_variance_and_volume_of_each_epoch_of_a_selection(folder, ds, weights):
    part = ds.isel(time=[1, 3])
    variances = part.station.variance(weights)
    assert variances.dims == ("time",)
    assert variances.values.tolist() == [station.variance(folder, weights, index) for index in (1, 3)]
    assert part.isel(time=0).station.variance(weights).item() == variances.values[0]
    volume = part.station.volume("square")
    assert volume.volume_change.values == pytest.approx([0.01 * 20_000, 0.05 * 20_000], abs=20)
    assert volume.volume_change_uncertainty.values == pytest.approx(20_000 * RANDOM_M / np.sqrt(200))
    by_outline = station.volume(folder, SQUARE, 3)
    assert (
        volume.volume_change[1]
        == by_outline.volume_change
        == station.volume(folder, "square", 3).volume_change
    )


def test_change_between_two_epochs_and_at_a_point(ds):
    between = ds.station.between(0, "2025-11-21T05:00")
    assert between.elevation_change[50, 20] == pytest.approx(0.05, abs=1e-3)
    assert between.elevation_change_uncertainty[50, 20] == pytest.approx(np.sqrt(2) * RANDOM_M, rel=2e-3)
    assert np.isnan(between.elevation_change[50, 100])
    point = ds.station.at(632_204.9, 5_185_495.1)
    assert (float(point.x), float(point.y)) == (632_205.0, 5_185_495.0)
    assert point.elevation_change.values == pytest.approx([0, 0.01, 0.02, 0.05], abs=1e-3)
    assert point.elevation_change_uncertainty.values == pytest.approx([2 * RANDOM_M] * 4, rel=1e-2)
    with pytest.raises(StationError, match="outside"):
        ds.station.at(631_999.0, 5_185_495.0)


def test_unknown_names_and_datasets_are_reported(folder, ds):
    with pytest.raises(StationError, match=r"no area 'glacier' .* areas: square"):
        station.volume(folder, "glacier", 0)
    with pytest.raises(ValueError, match="no cell of the grid"):
        station.volume(folder, shapely.box(0, 0, 1, 1), 0)
    with pytest.raises(StationError, match="does not know its store"):
        xr.Dataset({"time": ds.time}).station.at(0, 0)
