"""How far a contour moved, against crossings sample by sample and dense matrix algebra."""

import numpy as np
import pytest
from support.crossings import crossing
from support.plane_store import (
    EAST,
    GRID,
    dense_jacobian,
    independent_m2,
    random_parameters,
    reference_random_m2,
    shared_variance,
)
from support.surface_store import BASE, LAST, SPAN, common_mode, mean_errors

import station
from station.queries.site_products.product_queries import Product, update_products
from station.queries.site_products.profile_lines import sample_line
from station.sections.product import ProductSection

ROW, FIRST, END = 12, 4, 35  # cells of the line; it climbs by a quarter
ENDS = [(GRID.x_m[FIRST], GRID.y_m[ROW]), (GRID.x_m[END - 1], GRID.y_m[ROW])]
LINE_M = 10.0 * np.arange(END - FIRST)
START_M = 2800 + EAST * (GRID.x_m[FIRST] - GRID.west_m) - 0.125 * (GRID.y_m[ROW] - GRID.north_m)
PLANE_M = START_M + EAST * LINE_M
LEVEL_M = float(PLANE_M[23] + 1.25)  # all scans of the surface know the ground around it


def movement(series, index, surface=None, raster_m=None):
    settings = {"surface": surface} if surface else {}
    section = ProductSection.model_validate(
        {"name": "test", "kind": "contour", "line": ENDS, "height_m": LEVEL_M, **settings}
    )
    line = sample_line(section.line, GRID)
    rasters, files = ({}, ()) if raster_m is None else ({"surface": raster_m}, (surface,))
    product = Product(section, {"test": line.cells}, {"test": line}, rasters, files)
    update_products(series, [product], [section.key], lambda: None)
    return station.product(series.folder, "test").isel(time=index, place=0)


def on_grid(weights):
    raster = np.zeros(GRID.shape)
    raster[ROW, FIRST:END] = weights
    return raster


def assert_movement(product, here, there, noise_m2, systematic_m2):
    """Assert value and sigmas; relief is what both places have not in common."""
    assert float(product.distance_change) == pytest.approx(here[0] - there[0], abs=2e-3)  # heights are f4
    moved = here[2] - there[2]
    random_m2 = noise_m2 + (here[3] + there[3]) / 2 * moved @ moved
    assert float(product.distance_change_random_uncertainty) ** 2 == pytest.approx(random_m2, rel=3e-3)
    total_m2 = float(product.distance_change_uncertainty) ** 2
    assert total_m2 == pytest.approx(random_m2 + systematic_m2, rel=3e-3)


def profile_m(stored, index):
    return PLANE_M + stored.elevation_change.values[index, ROW, FIRST:END].astype(float)


def shared_m2(stored, index, weights, covariance, line_tilt):
    return shared_variance(stored, on_grid(weights), index, covariance, line_tilt)


def epoch_m2(stored, index, weights):
    covariance = stored.shared_parameter_covariance.values[index].astype(float)
    lines = stored.shared_parameter_line_tilt_variance.values[index]
    return shared_m2(stored, index, weights, covariance, lines)


def reference_m2(stored, weights):
    errors = random_parameters(7, 0.5)
    return shared_m2(stored, LAST, weights, errors.covariance, errors.line_tilt_variance)


def noise_m2(series, stored, index, weights):
    return np.nansum(on_grid(weights) ** 2 * independent_m2(stored, index, reference_random_m2(series)))


def along_line(raster):
    return raster[ROW, FIRST:END]


def crossing_in(series, stored, index):
    """Return the crossing in a scan."""
    own_m2 = along_line(independent_m2(stored, index, reference_random_m2(series)))
    return crossing(LINE_M, profile_m(stored, index), own_m2, LEVEL_M)


def crossing_of_mean(series, stored, indices):
    """Return the crossing of the mean surface of all scans, with the noise of the mean of some of them."""
    heights_m = np.array([profile_m(stored, index) for index in BASE])
    noise = [along_line(independent_m2(stored, index, reference_random_m2(series))) for index in indices]
    count = np.isfinite(noise).sum(axis=0)
    return crossing(LINE_M, np.nanmean(heights_m, axis=0), np.nansum(noise, axis=0) / count**2, LEVEL_M)


def test_a_contour_moved_since_the_reference(series, stored):
    """The systematic error of the reference moves both places alike; its noise moves one."""
    here = crossing_in(series, stored, LAST)
    there = crossing(LINE_M, PLANE_M, along_line(reference_random_m2(series)), LEVEL_M)
    noise = noise_m2(series, stored, LAST, here[1])
    noise += np.nansum(on_grid(there[1]) ** 2 * reference_random_m2(series))
    systematic = epoch_m2(stored, LAST, here[1]) + reference_m2(stored, here[1] - there[1])
    product = movement(series, LAST)
    assert_movement(product, here, there, noise, systematic)
    assert abs(here[0] - there[0]) > 10
    absolute_m2 = epoch_m2(stored, LAST, here[1]) + reference_m2(stored, here[1])
    assert float(product.distance_systematic_uncertainty) ** 2 == pytest.approx(absolute_m2, rel=3e-3)
    assert systematic < 0.9 * absolute_m2


def mode_effect(stored, weights):
    return on_grid(weights).ravel() @ dense_jacobian(stored, LAST)[0] @ common_mode()


def test_a_contour_moved_since_the_mean_of_scans(series, stored):
    here, there = crossing_in(series, stored, LAST), crossing_of_mean(series, stored, BASE)
    noise = noise_m2(series, stored, LAST, here[1])
    noise += sum(noise_m2(series, stored, index, there[1] / 3) for index in BASE)
    systematic = epoch_m2(stored, LAST, here[1]) + shared_m2(
        stored, LAST, there[1], *mean_errors(stored, BASE, LAST)
    )
    systematic += reference_m2(stored, here[1] - there[1])
    systematic -= 2 * mode_effect(stored, here[1]) * mode_effect(stored, there[1])
    assert_movement(movement(series, LAST, SPAN), here, there, noise, systematic)


def test_the_movement_in_a_scan_of_the_surface_has_its_error_once(series, stored):
    here, there = crossing_in(series, stored, 0), crossing_of_mean(series, stored, (1, 2))
    own, others = here[1] - there[1] / 3, 2 / 3 * there[1]
    noise = noise_m2(series, stored, 0, own)
    noise += sum(noise_m2(series, stored, index, others / 2) for index in (1, 2))
    systematic = epoch_m2(stored, 0, own) + shared_m2(stored, LAST, others, *mean_errors(stored, (1, 2), 0))
    systematic += reference_m2(stored, here[1] - there[1])
    systematic -= 2 * mode_effect(stored, own) * mode_effect(stored, others)
    assert_movement(movement(series, 0, SPAN), here, there, noise, systematic)


def test_a_given_surface_has_no_errors(series, stored):
    raster_m = np.broadcast_to(np.nan, GRID.shape).copy()
    raster_m[ROW] = np.interp(GRID.x_m, GRID.x_m[FIRST:END], PLANE_M) + 0.5
    here = crossing_in(series, stored, LAST)
    there = crossing(LINE_M, PLANE_M + 0.5, np.zeros(END - FIRST), LEVEL_M)
    systematic = epoch_m2(stored, LAST, here[1]) + reference_m2(stored, here[1])
    product = movement(series, LAST, "before.tif", raster_m)
    assert_movement(product, here, there, noise_m2(series, stored, LAST, here[1]), systematic)


def test_transects_are_places_of_one_product(series):
    """Each has the values of a product of its own; the mean of the surface is that of the cells of all."""
    settings = {"name": "test", "kind": "contour", "height_m": LEVEL_M, "surface": SPAN}

    def measured(line, **more):
        section = ProductSection.model_validate(settings | {"line": line} | more)
        lines = {name: sample_line(points, GRID) for name, points in section.lines.items()}
        product = Product(section, {name: line.cells for name, line in lines.items()}, lines)
        update_products(series, [product], [section.key], lambda: None)
        return station.product(series.folder, "test")

    transects = measured(ENDS, count=3, spacing_m=10.0)
    assert transects.place.values.tolist() == ["0 m", "10 m", "20 m"]
    assert transects.place_y.values.tolist() == pytest.approx([GRID.y_m[ROW + k] for k in range(3)])
    for number in range(3):
        alone = measured([(x_m, y_m - 10.0 * number) for x_m, y_m in ENDS])
        for name in ("distance", "distance_change", "distance_uncertainty", "distance_change_uncertainty"):
            np.testing.assert_allclose(transects[name][:, number], alone[name][:, 0], rtol=1e-9)


def test_a_contour_that_the_surface_lacks_has_not_moved_a_known_distance(series):
    product = movement(series, LAST, "flat.tif", np.zeros(GRID.shape))
    assert np.isfinite(product.distance)
    assert np.isnan(product.distance_change)
    assert np.isnan(product.distance_change_uncertainty)
