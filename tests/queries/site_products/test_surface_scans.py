"""A mean of scans as the surface of a product, against plain means and dense matrix algebra."""

from dataclasses import replace

import numpy as np
import pytest
from support.plane_store import (
    GRID,
    dense_jacobian,
    independent_m2,
    line_variance,
    make_epoch,
    make_reference,
    random_parameters,
    reference_random_m2,
)
from support.series import open_with_processing

import station
from station.archive import epochs
from station.archive.netcdf_layout import Series
from station.archive.reference_files import write_reference
from station.archive.series.virtual import build_series
from station.quantities import ChangeErrors
from station.queries.site_products.product_queries import Product, update_products
from station.sections.product import ProductSection

HOURS = (1, 3, 4, 30)  # the first three are the surface
SPAN = {"from": "2025-11-21T00:00:00Z", "to": "2025-11-21T06:00:00Z"}
BASE, LAST = (0, 1, 2), 3
PATTERN = np.random.default_rng(8).normal(size=288)


def epoch_with_common_errors(hour, mode):
    """Return an epoch whose errors contain a mode that all epochs have in common."""
    shared = random_parameters(hour, 0.3)
    modes = np.zeros((len(mode), 32))
    modes[:, hour % 32] = mode
    covariance = shared.covariance + np.outer(mode, mode)
    shared = replace(shared, covariance=covariance, change_errors=ChangeErrors(modes, PATTERN))
    return make_epoch(hour, "joint", shared)


@pytest.fixture(scope="module")
def mode():
    sigma = np.sqrt(np.diag(random_parameters(20, 0.3).covariance))
    return sigma * np.random.default_rng(21).normal(size=len(sigma))


@pytest.fixture(scope="module")
def series(tmp_path_factory, mode):
    series = Series(tmp_path_factory.mktemp("surface"), "hef", GRID, "EPSG:32632")
    write_reference(series, make_reference())
    for hour in HOURS:
        epochs.write_epoch(series, epoch_with_common_errors(hour, mode))
    build_series(series)
    return series


@pytest.fixture(scope="module")
def stored(series):
    with open_with_processing(series.folder) as ds:
        return ds.load()


@pytest.fixture(scope="module")
def seen(stored):
    """Cells (t, ny, nx) that each epoch observed, in a box off the void of the reference."""
    box = np.zeros(GRID.shape, bool)
    box[5:20, 10:30] = True
    return box & np.isfinite(stored.elevation_change.values)


def product(series, places, kind="snow_depth", **settings):
    section = ProductSection.model_validate({"name": "test", "kind": kind, "surface": SPAN, **settings})
    update_products(series, [Product(section, places)], [section.key], lambda: None)
    return station.product(series.folder, "test")


def dense_sigmas(series, stored, weights, last, base, mode):
    """Return the random and the total variance of a sum of d_last - mean d_base, from equations.md, 6.19."""
    reference_m2 = reference_random_m2(series)
    count = len(base)
    random = np.nansum(weights**2 * independent_m2(stored, last, reference_m2))
    for index in base:
        random += np.nansum((weights / count) ** 2 * independent_m2(stored, index, reference_m2))
    gradient = weights.ravel() @ dense_jacobian(stored, last)[0]
    covariances = stored.shared_parameter_covariance.values.astype(float)
    hours = np.array(HOURS)[list(base)]
    lasting = np.exp(-np.abs(np.subtract.outer(hours, hours)) / 6).mean()
    common = np.outer(mode, mode)
    mean = common + lasting * (covariances[list(base)].mean(axis=0) - common)
    line = line_variance(stored, weights, last)
    line += np.mean([line_variance(stored, weights, index) for index in base]) / count
    systematic = gradient @ (covariances[last] + mean - 2 * common) @ gradient
    return random, random + systematic + line


def assert_sigmas(values, name, random, total):
    parts = [float(values[f"{name}_{part}"]) ** 2 for part in ("random_uncertainty", "uncertainty")]
    assert parts == [pytest.approx(random, rel=1e-3), pytest.approx(total, rel=2e-3)]


def test_a_surface_is_the_mean_of_the_scans_of_its_time(series, stored, seen, mode):
    box = seen.all(axis=0)
    depth = product(series, {"bowl": box}).sel(place="bowl").isel(time=LAST)
    change_m = stored.elevation_change.values.astype(float)[:, box].mean(axis=1)
    assert float(depth.snow_depth) == pytest.approx(change_m[LAST] - change_m[list(BASE)].mean())
    random, total = dense_sigmas(series, stored, box / box.sum(), LAST, BASE, mode)
    assert_sigmas(depth, "snow_depth", random, total)


def test_a_scan_of_the_surface_counts_from_the_others_by_their_share(series, stored, seen, mode):
    """d - (d + e + f) / 3 is two thirds of d - (e + f) / 2."""
    box = seen.all(axis=0)
    depth = product(series, {"bowl": box}).sel(place="bowl").isel(time=1)
    change_m = stored.elevation_change.values.astype(float)[:, box].mean(axis=1)
    assert float(depth.snow_depth) == pytest.approx(change_m[1] - change_m[list(BASE)].mean(), abs=1e-6)
    random, total = dense_sigmas(series, stored, 2 / 3 * box / box.sum(), 1, (0, 2), mode)
    assert_sigmas(depth, "snow_depth", random, total)


@pytest.mark.parametrize("base", [(0, 2), (1,)])
def test_a_cell_is_the_mean_of_the_scans_that_observed_it(series, stored, seen, mode, base):
    missing = [index for index in BASE if index not in base]
    cell = np.argwhere(seen[[*base, LAST]].all(axis=0) & ~seen[missing].any(axis=0))[0]
    place = np.zeros(GRID.shape, bool)
    place[tuple(cell)] = True
    wide = {"bowl": seen.any(axis=0), "cell": place}  # most cells of the surface are in all of its scans
    depth = product(series, wide).sel(place="cell").isel(time=LAST)
    change_m = stored.elevation_change.values.astype(float)[:, *cell]
    assert float(depth.snow_depth) == pytest.approx(change_m[LAST] - change_m[list(base)].mean(), abs=1e-6)
    random, total = dense_sigmas(series, stored, 1.0 * place, LAST, base, mode)
    parts = [float(depth[f"snow_depth_{part}"]) ** 2 for part in ("random_uncertainty", "uncertainty")]
    assert parts[0] == pytest.approx(random, rel=1e-3)
    # The covariance is the mean of all scans of the surface, not of those that observed the cell.
    assert parts[1] == pytest.approx(total, rel=0.1)


def test_gain_and_loss_above_a_mean_close(series, seen):
    budget = product(series, {"slope": seen.any(axis=0)}, "volume_budget").isel(place=0)
    closure = (budget.deposition + budget.erosion - budget.net_change).values
    assert np.abs(closure).max() < 1e-6
    assert np.isfinite(budget.net_change_uncertainty.values).all()
