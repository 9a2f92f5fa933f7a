"""Volumes of a simulated station, and the covariance of its points."""

import json

import numpy as np
import pytest
import shapely
import xarray as xr

import station
from station.config import read_site
from station.errors import StoreError
from station.science.beam import error_ellipse
from station.service.once import process_scans
from station.simulation.station import simulate, tiny

FIRST, LAST = 0, -1


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("volumes") / "station"
    simulate(folder, tiny(hours=3))
    told = read_site(folder / "site.toml")
    assert process_scans(told, sorted(told.scans.inbox.glob("*.laz")), lambda _: None) == 0
    return folder / "site.toml"


@pytest.fixture(scope="module")
def box(site):
    """Half the cells that the first and the last epoch have seen, and as many that neither has."""
    with station.open(site) as ds:
        seen = np.isfinite(ds.elevation_change[FIRST].values) & np.isfinite(ds.elevation_change[LAST].values)
        cells = np.zeros(seen.shape, bool)
        cells[::2] = seen[::2]
        return cells, ds.x.values, ds.y.values


@pytest.mark.parametrize("pair", [(LAST,), (LAST, FIRST)])
def test_volume_and_its_sigmas(site, box, pair):
    cells, x, _ = box
    told = station.volume(site, cells, *pair)
    with station.open(site) as ds:
        change_m = [ds.elevation_change[i].values[cells].astype(float) for i in pair]
        sigma_m = [ds.elevation_change_uncertainty[i].values[cells].astype(float) for i in pair]
    area_m2 = (x[1] - x[0]) ** 2
    volume_m3 = area_m2 * (change_m[0] - (change_m[1] if len(pair) > 1 else 0)).sum()
    assert told.volume_change == pytest.approx(volume_m3)
    variance = station.variance(site, np.where(cells, area_m2, 0.0), *pair)
    assert told.volume_change_uncertainty == pytest.approx(variance**0.5)
    published_m6 = area_m2**2 * sum((one**2).sum() for one in sigma_m)
    assert told.volume_change_uncertainty_hartzell2015 == pytest.approx(published_m6**0.5)
    if len(pair) == 1:  # of a difference goes off what held both scans
        assert told.volume_change_uncertainty > told.volume_change_uncertainty_hartzell2015
    assert told.volume_change_random_uncertainty < told.volume_change_uncertainty_hartzell2015
    assert (told.area_size, told.coverage) == (cells.sum() * area_m2, 1.0)


@pytest.fixture(scope="module")
def unadjusted(site):
    """The same station by its log alone."""
    text = site.read_text(encoding="utf-8")
    assert 'method = "joint"' in text
    assert 'data = "data"' in text
    beside = site.with_name("log_alone.toml")
    changed = text.replace('method = "joint"', 'method = "none"').replace(
        'data = "data"', 'data = "data_log"'
    )
    beside.write_text(changed, encoding="utf-8")
    told = read_site(beside)
    process_scans(told, sorted(told.scans.inbox.glob("*.laz"))[:2], lambda _: None)
    return beside


@pytest.mark.parametrize("pair", [(LAST,), (LAST, FIRST)])
@pytest.mark.parametrize("which", ["site", "unadjusted"])
def test_shares_are_of_the_whole_variance(which, box, pair, request):
    """The share of a cell: half of what the variance grows by with its weight, a quadratic form."""
    site = request.getfixturevalue(which)
    cells, *_ = box
    with station.open(site) as ds:
        cells = cells & np.isfinite(ds.elevation_change.isel(time=[FIRST, LAST]).values).all(axis=0)
    told = station.volume(site, cells, *pair)
    assert float(told.variance_share.sum()) == pytest.approx(1.0)
    assert float(told.variance_share_hartzell2015.sum()) == pytest.approx(1.0)
    assert (np.isfinite(told.variance_share.values) == cells).all()
    weights = cells.astype(float)
    whole = station.variance(site, weights, *pair)
    for row, column in np.argwhere(cells)[::1500]:
        unit = np.zeros(cells.shape)
        unit[row, column] = 0.5
        half = (
            station.variance(site, weights + unit, *pair) - station.variance(site, weights - unit, *pair)
        ) / 2
        assert told.variance_share.values[row, column] == pytest.approx(half / whole, rel=1e-5, abs=1e-9)


def test_an_area_is_a_polygon_or_cells(site, box):
    cells, x, y = box
    around = shapely.box(x[20] - 2.5, y[40] - 2.5, x[60] + 2.5, y[10] + 2.5)
    same = np.zeros(cells.shape, bool)
    same[10:41, 20:61] = True
    told, wanted = (station.volume(site, area, LAST) for area in (around, same))
    assert told.identical(wanted)
    assert 0 < told.coverage < 1
    assert (np.isfinite(told.variance_share.values).sum() / same.sum()) == told.coverage


def test_the_volume_is_that_of_the_areas(site):
    """Voids and all: one number for one area."""
    polygons = json.loads((site.parent / "areas.geojson").read_text(encoding="utf-8"))["features"]
    with xr.open_dataset(read_site(site).station.data / "areas.nc") as areas:
        for index, one in enumerate(polygons):
            told = station.volume(site, shapely.geometry.shape(one["geometry"]), LAST)
            for name in ("volume_change", "volume_change_uncertainty"):
                assert told[name] == pytest.approx(float(areas[name][LAST, index]), rel=1e-6)


def test_no_area(site):
    with pytest.raises(ValueError, match=r"an area of \(2, 2\) cells on a grid"):
        station.volume(site, np.ones((2, 2)), LAST)
    with pytest.raises(StoreError, match="none of the 0 cells has a change"):
        station.volume(site, shapely.box(0, 0, 1, 1), LAST)


def test_points_of_an_epoch(site, box):
    """Seen across a slope a point is as unsure as a height there: the shared part of EQUATIONS 6.1."""
    cells, x, y = box
    row, column = np.argwhere(cells)[[5, 500, 1500]].T
    with station.open(site) as ds:
        height_m = ds.elevation[LAST].values[row, column]
        place = [float(ds[f"scanner_{name}"][LAST]) for name in ("east", "north", "height")]
        covariance = ds.shared_parameter_covariance[LAST].values
        names = [str(name) for name in ds.parameter_name.values]
    put = np.stack([x[column], y[row], height_m], axis=-1)
    told = station.point_covariance(site, put, LAST)
    assert told.shape == (3, 3, 3)
    assert np.linalg.eigvalsh(told).min() > 0
    scanner = read_site(site).instrument
    beams = (put - place) / np.linalg.norm(put - place, axis=1, keepdims=True)
    along_m2 = np.einsum("ni,nij,nj->n", beams, told, beams)
    bias = names.index("range_bias")
    known_m2 = scanner.range_sigma_m**2 + covariance[bias, bias]
    assert (along_m2 > scanner.range_sigma_m**2).all()
    assert along_m2 == pytest.approx(known_m2, rel=0.5)
    major_m, minor_m, _ = error_ellipse(told)
    assert (major_m >= minor_m).all()
    assert station.point_covariance(site, put[0], LAST) == pytest.approx(told[:1])
