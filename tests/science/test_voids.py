"""Voids of an area: interpolated from what is around, and unsure by what the ground may do there."""

import numpy as np
import pytest
from scipy import ndimage

from station.science.voids import area_weights, void_variance

SHAPE = (60, 80)
EVERYWHERE = np.ones(SHAPE, bool)


def by_hand(cells, seen):
    """The same weights, cell by cell."""
    weights = np.zeros(cells.shape)
    for row, column in np.argwhere(cells):
        if seen[row, column]:
            weights[row, column] += 1
            continue
        half = 1
        while True:
            box = np.s_[max(row - half, 0) : row + half + 1, max(column - half, 0) : column + half + 1]
            count = np.count_nonzero((cells & seen)[box])
            if count >= (3 if half < max(cells.shape) else 1):
                break
            half *= 2
        weights[box] += (cells & seen)[box] / count
    return weights / cells.sum()


def test_weights_are_those_of_a_plain_loop():
    rng = np.random.default_rng(3)
    cells = rng.uniform(size=SHAPE) < 0.9
    seen = rng.uniform(size=SHAPE) < 0.5
    seen[10:40, 20:60] = False
    weights, reach = area_weights(cells, seen)
    assert weights == pytest.approx(by_hand(cells, seen), abs=1e-12)
    assert weights.sum() == pytest.approx(1, abs=1e-12)
    assert (reach > 0).tolist() == (cells & ~seen).tolist()
    assert set(np.unique(reach)) <= {0, 1, 2, 4, 8, 16, 32}


def test_a_tilted_plane_keeps_its_mean_over_a_void_in_its_middle():
    row, column = np.indices(SHAPE)
    change = 0.02 * row - 0.01 * column
    seen = EVERYWHERE.copy()
    seen[20:40, 30:50] = False
    weights, _ = area_weights(EVERYWHERE, seen)
    assert (weights * change).sum() == pytest.approx(change.mean(), abs=1e-3)
    seen[:, :30] = False  # by what is seen alone it would be far off
    weights, _ = area_weights(EVERYWHERE, seen)
    assert abs((weights * change).sum() - change.mean()) < 0.7 * abs(change[seen].mean() - change.mean())


@pytest.mark.parametrize("seen", [EVERYWHERE, ~EVERYWHERE])
def test_all_seen_and_nothing_seen(seen):
    weights, reach = area_weights(EVERYWHERE, seen)
    assert weights.sum() == pytest.approx(1.0 if seen.any() else 0.0)
    assert not reach.any()
    assert void_variance(EVERYWHERE, reach, np.zeros(SHAPE), np.zeros(SHAPE)) == 0.0


def test_one_seen_cell_stands_for_all():
    seen = ~EVERYWHERE
    seen[5, 7] = True
    weights, _ = area_weights(EVERYWHERE, seen)
    assert weights[5, 7] == pytest.approx(1)


@pytest.mark.parametrize("shape", ["pepper", "one large", "two"])
def test_sigma_is_what_the_ground_really_does_in_voids(shape):
    """Smooth random changes with noise: error over stated sigma, over many of them."""
    rng = np.random.default_rng(5)
    seen = EVERYWHERE.copy()
    if shape == "pepper":
        seen = rng.uniform(size=SHAPE) < 0.7
    else:
        seen[10:50, 10:36] = False
        seen[10:50, 46:72] &= shape == "one large"
    weights, reach = area_weights(EVERYWHERE, seen)
    errors, sigmas = [], []
    for _ in range(60):
        truth = ndimage.gaussian_filter(rng.normal(size=SHAPE), 6, mode="wrap") * 2
        noise = 0.02
        measured = np.where(seen, truth + noise * rng.normal(size=SHAPE), np.nan)
        errors.append(np.nansum(weights * measured) - truth.mean())
        own = void_variance(EVERYWHERE, reach, measured, np.full(SHAPE, noise**2))
        sigmas.append(np.sqrt(np.sum(weights**2) * noise**2 + own))
    ratio = np.sqrt(np.mean(np.square(errors)) / np.mean(np.square(sigmas)))
    assert 0.3 < ratio < 1.15, ratio  # never too sure by more than chance; what errs in one void errs alike
    without = np.sqrt(np.mean(np.square(errors)) / (np.sum(weights**2) * 0.02**2))
    if shape != "pepper":
        assert without > 3  # the noise of the seen cells alone says far too little
