"""A mean of scans as the surface of a product, against plain means and dense matrix algebra."""

import numpy as np
import pytest
from support.plane_store import GRID, independent_m2, reference_random_m2, shared_variance
from support.surface_store import BASE, LAST, SPAN, common_mode, mean_errors

import station
from station.queries.site_products.product_queries import Product, update_products
from station.sections.product import ProductSection


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


def dense_sigmas(series, stored, weights, last, base):
    """Return the random and the total variance of a sum of d_last - mean d_base, from equations.md, 6.19."""
    reference_m2 = reference_random_m2(series)
    count = len(base)
    random = np.nansum(weights**2 * independent_m2(stored, last, reference_m2))
    for index in base:
        random += np.nansum((weights / count) ** 2 * independent_m2(stored, index, reference_m2))
    covariances = stored.shared_parameter_covariance.values.astype(float)
    lines = stored.shared_parameter_line_tilt_variance.values
    mean, line = mean_errors(stored, base, last)
    covariance = covariances[last] + mean - 2 * np.outer(common_mode(), common_mode())
    return random, random + shared_variance(stored, weights, last, covariance, lines[last] + line)


def assert_sigmas(values, name, random, total):
    parts = [float(values[f"{name}_{part}"]) ** 2 for part in ("random_uncertainty", "uncertainty")]
    assert parts == [pytest.approx(random, rel=1e-3), pytest.approx(total, rel=2e-3)]


def test_a_surface_is_the_mean_of_the_scans_of_its_time(series, stored, seen):
    box = seen.all(axis=0)
    depth = product(series, {"bowl": box}).sel(place="bowl").isel(time=LAST)
    change_m = stored.elevation_change.values.astype(float)[:, box].mean(axis=1)
    assert float(depth.snow_depth) == pytest.approx(change_m[LAST] - change_m[list(BASE)].mean())
    random, total = dense_sigmas(series, stored, box / box.sum(), LAST, BASE)
    assert_sigmas(depth, "snow_depth", random, total)


def test_a_scan_of_the_surface_counts_from_the_others_by_their_share(series, stored, seen):
    """d - (d + e + f) / 3 is two thirds of d - (e + f) / 2."""
    box = seen.all(axis=0)
    depth = product(series, {"bowl": box}).sel(place="bowl").isel(time=1)
    change_m = stored.elevation_change.values.astype(float)[:, box].mean(axis=1)
    assert float(depth.snow_depth) == pytest.approx(change_m[1] - change_m[list(BASE)].mean(), abs=1e-6)
    random, total = dense_sigmas(series, stored, 2 / 3 * box / box.sum(), 1, (0, 2))
    assert_sigmas(depth, "snow_depth", random, total)


@pytest.mark.parametrize("base", [(0, 2), (1,)])
def test_a_cell_is_the_mean_of_the_scans_that_observed_it(series, stored, seen, base):
    missing = [index for index in BASE if index not in base]
    cell = np.argwhere(seen[[*base, LAST]].all(axis=0) & ~seen[missing].any(axis=0))[0]
    place = np.zeros(GRID.shape, bool)
    place[tuple(cell)] = True
    wide = {"bowl": seen.any(axis=0), "cell": place}  # most cells of the surface are in all of its scans
    depth = product(series, wide).sel(place="cell").isel(time=LAST)
    change_m = stored.elevation_change.values.astype(float)[:, *cell]
    assert float(depth.snow_depth) == pytest.approx(change_m[LAST] - change_m[list(base)].mean(), abs=1e-6)
    random, total = dense_sigmas(series, stored, 1.0 * place, LAST, base)
    parts = [float(depth[f"snow_depth_{part}"]) ** 2 for part in ("random_uncertainty", "uncertainty")]
    assert parts[0] == pytest.approx(random, rel=1e-3)
    # The covariance is the mean of all scans of the surface, not of those that observed the cell.
    assert parts[1] == pytest.approx(total, rel=0.1)


def test_gain_and_loss_above_a_mean_close(series, seen):
    budget = product(series, {"slope": seen.any(axis=0)}, "volume_budget").isel(place=0)
    closure = (budget.deposition + budget.erosion - budget.net_change).values
    assert np.abs(closure).max() < 1e-6
    assert np.isfinite(budget.net_change_uncertainty.values).all()
