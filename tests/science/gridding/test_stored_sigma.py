"""σ as stored: two digits of the total, the systematic and, of their difference, the random part."""

import numpy as np
import pytest

from station.science.gridding.cell_estimates import quantum, round_sigma, round_total

HALF_STEP = 1 / 64  # of 32 steps for a factor of two


@pytest.mark.parametrize("ratio", [0.0, 0.01, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0])
def test_the_random_part_has_two_digits_whatever_the_systematic_part_is(ratio):
    random_m = np.geomspace(0.003, 1.0, 20_001).astype(np.float32)
    systematic_m = round_sigma(ratio * random_m)
    total_m = round_total(random_m, systematic_m)
    difference_m = np.sqrt((total_m - systematic_m) * (total_m + systematic_m))
    assert np.abs(difference_m / random_m - 1).max() < HALF_STEP + 1e-3
    np.testing.assert_allclose(total_m, np.hypot(random_m, systematic_m), rtol=HALF_STEP)


def test_the_bound_for_means_is_right_from_one_cell_to_a_million():
    rng = np.random.default_rng(1)
    random_m, systematic_m = rng.uniform(0.01, 0.4, 10**6), rng.uniform(0.001, 0.05, 10**6)
    stored_m = round_sigma(systematic_m)
    total_m = round_total(random_m.astype(np.float32), stored_m).astype(np.float64)
    for n in (1, 10, 1000, 10**6):
        bound_m = np.sqrt(np.sum(total_m[:n] ** 2 - stored_m[:n] ** 2.0) / n**2 + stored_m[:n].mean() ** 2)
        true_m = np.sqrt(np.sum(random_m[:n] ** 2) / n**2 + systematic_m[:n].mean() ** 2)
        assert bound_m == pytest.approx(true_m, rel=0.02 if n < 1000 else 0.003)


def test_rounding_to_a_quarter_of_sigma_biases_no_sum():
    rng = np.random.default_rng(2)
    random_m = rng.uniform(0.01, 0.04, 10**6).astype(np.float32)
    change_m = 0.0123 + random_m * rng.normal(size=10**6).astype(np.float32)
    step_m = quantum(random_m)
    assert (step_m <= random_m / 4).all()
    error_m = np.rint(change_m / step_m) * step_m - change_m
    assert abs(error_m.mean()) < 4 * step_m.mean() / np.sqrt(12 * 10**6)
    assert error_m.std() / random_m.mean() < 0.075  # adds .3 % to sigma at most
