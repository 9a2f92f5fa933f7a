"""Interpolated voids of an area: weights compared with a plain loop, variance with simulated change."""

import numpy as np
import pytest
from scipy import ndimage

from station.science.analysis.voids import area_weights, void_variance

SHAPE = (60, 80)
ALL_CELLS = np.ones(SHAPE, bool)


def plain_weights(cells, observed):
    """The weights of `area_weights`, cell by cell."""
    weights = np.zeros(cells.shape)
    for row, column in np.argwhere(cells):
        if observed[row, column]:
            weights[row, column] += 1
            continue
        half_width = 1
        while True:
            box = np.s_[
                max(row - half_width, 0) : row + half_width + 1,
                max(column - half_width, 0) : column + half_width + 1,
            ]
            count = np.count_nonzero((cells & observed)[box])
            if count >= (3 if half_width < max(cells.shape) else 1):
                break
            half_width *= 2
        weights[box] += (cells & observed)[box] / count
    return weights / cells.sum()


def test_weights_match_a_plain_loop():
    rng = np.random.default_rng(3)
    cells = rng.uniform(size=SHAPE) < 0.9
    observed = rng.uniform(size=SHAPE) < 0.5
    observed[10:40, 20:60] = False
    weights, fill_distance = area_weights(cells, observed)
    assert weights == pytest.approx(plain_weights(cells, observed), abs=1e-12)
    assert weights.sum() == pytest.approx(1, abs=1e-12)
    assert (fill_distance > 0).tolist() == (cells & ~observed).tolist()
    assert set(np.unique(fill_distance)) <= {0, 1, 2, 4, 8, 16, 32}


def test_mean_of_a_plane_is_kept_over_a_void():
    row, column = np.indices(SHAPE)
    change = 0.02 * row - 0.01 * column
    observed = ALL_CELLS.copy()
    observed[20:40, 30:50] = False
    weights, _ = area_weights(ALL_CELLS, observed)
    assert (weights * change).sum() == pytest.approx(change.mean(), abs=1e-3)
    observed[:, :30] = False  # the mean of the observed cells alone is far off
    weights, _ = area_weights(ALL_CELLS, observed)
    assert abs((weights * change).sum() - change.mean()) < 0.7 * abs(change[observed].mean() - change.mean())


@pytest.mark.parametrize("observed", [ALL_CELLS, ~ALL_CELLS])
def test_weights_without_voids_and_without_observations(observed):
    weights, fill_distance = area_weights(ALL_CELLS, observed)
    assert weights.sum() == pytest.approx(1.0 if observed.any() else 0.0)
    assert not fill_distance.any()
    assert void_variance(ALL_CELLS, fill_distance, np.zeros(SHAPE), np.zeros(SHAPE)) == 0.0


def test_a_single_observed_cell_gets_all_the_weight():
    observed = ~ALL_CELLS
    observed[5, 7] = True
    weights, _ = area_weights(ALL_CELLS, observed)
    assert weights[5, 7] == pytest.approx(1)


@pytest.mark.parametrize("shape", ["scattered", "one large", "two"])
def test_sigma_covers_the_error_of_interpolated_voids(shape):
    """Root mean square error over stated sigma, of many smooth random changes with noise."""
    rng = np.random.default_rng(5)
    observed = ALL_CELLS.copy()
    if shape == "scattered":
        observed = rng.uniform(size=SHAPE) < 0.7
    else:
        observed[10:50, 10:36] = False
        observed[10:50, 46:72] &= shape == "one large"
    weights, fill_distance = area_weights(ALL_CELLS, observed)
    errors, sigmas = [], []
    for _ in range(60):
        truth = ndimage.gaussian_filter(rng.normal(size=SHAPE), 6, mode="wrap") * 2
        noise = 0.02
        measured = np.where(observed, truth + noise * rng.normal(size=SHAPE), np.nan)
        errors.append(np.nansum(weights * measured) - truth.mean())
        void_m2 = void_variance(ALL_CELLS, fill_distance, measured, np.full(SHAPE, noise**2))
        sigmas.append(np.sqrt(np.sum(weights**2) * noise**2 + void_m2))
    ratio = np.sqrt(np.mean(np.square(errors)) / np.mean(np.square(sigmas)))
    assert 0.3 < ratio < 1.15, ratio  # errors within a void are correlated, so the ratio scatters
    without = np.sqrt(np.mean(np.square(errors)) / (np.sum(weights**2) * 0.02**2))
    if shape != "scattered":
        assert without > 3  # the noise of the observed cells alone is far too small
