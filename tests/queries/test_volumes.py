"""Volumes of a simulated station, and the covariance of its points."""

import json

import numpy as np
import pytest
import shapely
import xarray as xr

import station
from station.config import read_site
from station.operations.batch import process_scans
from station.science.geometry.beam import error_ellipse
from station.simulation.station import simulate, small

FIRST, LAST = 0, -1
pytestmark = pytest.mark.integration


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("volumes") / "station"
    simulate(folder, small(hours=3))
    site = read_site(folder / "site.toml")
    assert process_scans(site, sorted(site.scans.inbox.glob("*.laz")), lambda _: None) == 0
    return folder / "site.toml"


@pytest.fixture(scope="module")
def box(site):
    """Cells that the first and the last epoch observed, in every second row; and the axes of the grid."""
    with station.open(site) as ds:
        observed = np.isfinite(ds.elevation_change.isel(time=[FIRST, LAST]).values).all(axis=0)
        cells = np.zeros(observed.shape, bool)
        cells[::2] = observed[::2]
        return cells, ds.x.values, ds.y.values


@pytest.mark.parametrize("pair", [(LAST,), (LAST, FIRST)])
def test_volume_change_and_its_sigmas(site, box, pair):
    cells, x, _ = box
    volume = station.volume(site, cells, *pair)
    with station.open(site) as ds:
        change_m = [ds.elevation_change[i].values[cells].astype(float) for i in pair]
        sigma_m = [ds.elevation_change_uncertainty[i].values[cells].astype(float) for i in pair]
    area_m2 = (x[1] - x[0]) ** 2
    volume_m3 = area_m2 * (change_m[0] - (change_m[1] if len(pair) > 1 else 0)).sum()
    assert volume.volume_change == pytest.approx(volume_m3)
    variance = station.variance(site, np.where(cells, area_m2, 0.0), *pair)
    assert volume.volume_change_uncertainty == pytest.approx(variance**0.5)
    published_m6 = area_m2**2 * sum((sigma**2).sum() for sigma in sigma_m)
    assert volume.volume_change_uncertainty_hartzell2015 == pytest.approx(published_m6**0.5)
    if len(pair) == 1:  # in a difference, the leverage of the cells reduces the variance
        assert volume.volume_change_uncertainty > volume.volume_change_uncertainty_hartzell2015
    assert volume.volume_change_random_uncertainty < volume.volume_change_uncertainty_hartzell2015
    assert (volume.area_size, volume.coverage) == (cells.sum() * area_m2, 1.0)


@pytest.fixture(scope="module")
def unadjusted(site):
    """The same station without an adjustment, with poses from the inclination log."""
    text = site.read_text(encoding="utf-8")
    assert 'method = "joint"' in text
    assert 'data = "data"' in text
    path = site.with_name("log_only.toml")
    changed = text.replace('method = "joint"', 'method = "none"').replace(
        'data = "data"', 'data = "data_log"'
    )
    path.write_text(changed, encoding="utf-8")
    config = read_site(path)
    process_scans(config, sorted(config.scans.inbox.glob("*.laz"))[:2], lambda _: None)
    return path


@pytest.mark.parametrize("pair", [(LAST,), (LAST, FIRST)])
@pytest.mark.parametrize("station_fixture", ["site", "unadjusted"])
def test_the_share_of_a_cell_is_half_the_gradient_of_the_variance(station_fixture, box, pair, request):
    """The variance is a quadratic form of the weights; the shares of all cells add up to 1."""
    site = request.getfixturevalue(station_fixture)
    cells, *_ = box
    with station.open(site) as ds:
        cells = cells & np.isfinite(ds.elevation_change.isel(time=[FIRST, LAST]).values).all(axis=0)
    volume = station.volume(site, cells, *pair)
    assert float(volume.variance_share.sum()) == pytest.approx(1.0)
    assert float(volume.variance_share_hartzell2015.sum()) == pytest.approx(1.0)
    assert (np.isfinite(volume.variance_share.values) == cells).all()
    weights = cells.astype(float)
    total = station.variance(site, weights, *pair)
    for row, column in np.argwhere(cells)[::1500]:
        unit = np.zeros(cells.shape)
        unit[row, column] = 0.5
        gradient = station.variance(site, weights + unit, *pair) - station.variance(
            site, weights - unit, *pair
        )
        share = gradient / 2 / total
        assert volume.variance_share.values[row, column] == pytest.approx(share, rel=1e-5, abs=1e-9)


def test_an_area_is_given_as_a_polygon_or_a_mask(site, box):
    cells, x, y = box
    polygon = shapely.box(x[20] - 2.5, y[40] - 2.5, x[60] + 2.5, y[10] + 2.5)
    mask = np.zeros(cells.shape, bool)
    mask[10:41, 20:61] = True
    by_polygon, by_mask = (station.volume(site, area, LAST) for area in (polygon, mask))
    assert by_polygon.identical(by_mask)
    assert 0 < by_polygon.coverage < 1
    assert (np.isfinite(by_polygon.variance_share.values).sum() / mask.sum()) == by_polygon.coverage


def test_the_volume_of_an_area_equals_that_in_areas_nc(site):
    """Including its interpolated voids."""
    polygons = json.loads((site.parent / "areas.geojson").read_text(encoding="utf-8"))["features"]
    with xr.open_dataset(read_site(site).station.data / "areas.nc") as areas:
        for index, polygon in enumerate(polygons):
            volume = station.volume(site, shapely.geometry.shape(polygon["geometry"]), LAST)
            for name in ("volume_change", "volume_change_uncertainty"):
                assert volume[name] == pytest.approx(float(areas[name][LAST, index]), rel=1e-6)


def test_masks_on_another_grid_and_empty_areas_are_rejected(site):
    with pytest.raises(ValueError, match=r"the array has shape \(2, 2\), the grid"):
        station.volume(site, np.ones((2, 2)), LAST)
    with pytest.raises(ValueError, match="contains no cell of the grid"):
        station.volume(site, shapely.box(0, 0, 1, 1), LAST)


def test_the_covariance_of_points_along_the_beam_is_that_of_the_range(site, box):
    """Range noise of the shot and the shared range bias. Source: equations.md, 6.1."""
    cells, x, y = box
    row, column = np.argwhere(cells)[[5, 500, 1500]].T
    with station.open(site) as ds:
        height_m = ds.elevation[LAST].values[row, column]
        processing = ds.station.processing.isel(time=LAST).load()
    position_m = [float(processing[f"scanner_{name}"]) for name in ("east", "north", "height")]
    covariance = processing.shared_parameter_covariance.values
    names = [str(name) for name in processing.parameter_name.values]
    points_m = np.stack([x[column], y[row], height_m], axis=-1)
    actual = station.point_covariance(site, points_m, LAST)
    copied = station.point_covariance(site.parent / "data", points_m, LAST)  # the scanner is in the store
    assert copied.tobytes() == actual.tobytes()
    assert actual.shape == (3, 3, 3)
    assert np.linalg.eigvalsh(actual).min() > 0
    scanner = read_site(site).instrument
    offset_m = points_m - position_m
    beams = offset_m / np.linalg.norm(offset_m, axis=1, keepdims=True)
    along_m2 = np.einsum("ni,nij,nj->n", beams, actual, beams)
    bias = names.index("range_bias")
    expected_m2 = scanner.range_sigma_m**2 + covariance[bias, bias]
    assert (along_m2 > scanner.range_sigma_m**2).all()
    assert along_m2 == pytest.approx(expected_m2, rel=0.5)
    major_m, minor_m, _ = error_ellipse(actual)
    assert (major_m >= minor_m).all()
    assert station.point_covariance(site, points_m[0], LAST) == pytest.approx(actual[:1])
