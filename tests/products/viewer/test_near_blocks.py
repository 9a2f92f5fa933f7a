"""Sigma of blocks near the scanner, against a block of many cells."""

import numpy as np
import pytest

from station.products.viewer.near_blocks import sigma_ratio
from station.quantities import SharedParameters
from station.science.uncertainty.jacobian import height_jacobian
from station.science.uncertainty.parameters import GLOBAL, ParameterLayout

BLOCK_M = 10.0


@pytest.mark.parametrize(("side", "tolerance", "nearest"), [(2, 0.02, 0.9), (20, 0.08, 0.85)])
def test_the_sigma_of_a_block_is_that_of_the_mean_of_its_cells(side, tolerance, nearest):
    params = ParameterLayout(0.0, 360, full_circle=True)
    count = len(params.names)
    sigma = np.full(count, 1e-9)
    sigma[len(GLOBAL) : len(GLOBAL) + params.sight_tilt_knots] = 2e-4
    line_m2 = np.zeros(count)
    line_m2[len(GLOBAL) : len(GLOBAL) + params.sight_tilt_knots] = 1e-8
    shared = SharedParameters(params.names, ("1",) * count, np.zeros(count), np.diag(sigma**2), line_m2)
    middle_m = np.array([[150.0, 80.0], [-300.0, 420.0], [2500.0, 900.0]]).T
    step_m = (np.arange(side) + 0.5) / side * BLOCK_M - BLOCK_M / 2

    def jacobian(east_m, north_m):
        slope = 0.3 + 0 * east_m
        offset_m = east_m, north_m, 0.1 * east_m - 60
        return height_jacobian(params, offset_m, slope, 0.2 * slope, rock=slope > 0)

    blocks = jacobian(*middle_m)
    ratio = sigma_ratio(blocks, shared, (*middle_m, 0.1 * middle_m[0] - 60), BLOCK_M / side, side)
    for index, (east_m, north_m) in enumerate(middle_m.T):
        east, north = (part.ravel() for part in np.meshgrid(east_m + step_m, north_m + step_m))
        cells = jacobian(east, north)
        mean = np.full(side**2, side**-2.0)
        gradient = cells.aggregate(mean)
        by_line = cells.aggregate_by_line(mean)
        middle = blocks.take(np.array([index]))
        # Lines are independent here, and what the knots represent of them is little.
        whole_m2 = gradient @ shared.covariance @ gradient + 1e-8 * np.sum(by_line**2)
        one = np.ones(1)
        one_m2 = middle.aggregate(one) ** 2 @ sigma**2 + 1e-8 * np.sum(middle.aggregate_by_line(one) ** 2)
        expected = np.sqrt(whole_m2 / one_m2)
        is_far = index == 2  # its places are not distinguished
        assert ratio[index] == pytest.approx(min(expected, 1.0), abs=0.08 if is_far else tolerance)
    assert ratio[0] < nearest
    assert ratio[2] == 1.0
