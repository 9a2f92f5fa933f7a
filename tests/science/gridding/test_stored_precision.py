"""Heights and σ as stored: two digits of the total, the systematic and the random part."""

import numpy as np
import pytest

from station.science.gridding.stored_precision import quantum, round_sigma, round_total

HALF_STEP = 1 / 64  # of 32 steps for a factor of two
SIGMA_M = np.geomspace(1.1e-3, 0.03, 5001)


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


def test_quantum_is_a_power_of_two_between_an_8th_and_a_quarter_of_sigma():
    quantum_m = quantum(round_sigma(SIGMA_M)).astype(np.float64)
    assert np.array_equal(np.log2(quantum_m) % 1, np.zeros(len(SIGMA_M)))
    ratio = quantum_m / SIGMA_M
    assert ratio.max() <= 1 / 4 * (1 + 1 / 64)
    assert ratio.min() >= 1 / 8 * (1 - 1 / 64)


def test_quantum_is_bounded_where_sigma_is_zero_unknown_or_huge():
    assert quantum(np.array([0.0, np.nan, np.inf, 1e6], np.float32)).tolist() == [2.0**-14, *[2.0**-4] * 3]


def test_sigma_keeps_two_digits_and_nan():
    rounded = round_sigma(SIGMA_M)
    assert rounded == pytest.approx(SIGMA_M, rel=1 / 64)
    assert len(np.unique(rounded)) < 32 * 6  # as many per doubling as five bits hold
    assert np.array_equal(round_sigma(rounded), rounded)
    assert np.isnan(round_sigma(np.array([np.nan]))).all()


def test_rounding_adds_less_than_three_thousandths_to_sigma():
    rng = np.random.default_rng(1)
    sigma_m = rng.uniform(0.002, 0.5, 200_000).astype(np.float32)
    error_m, step_m = sigma_m * rng.standard_normal(len(sigma_m)), quantum(sigma_m)
    stored_m = np.rint(error_m / step_m) * step_m
    assert np.std(stored_m / sigma_m) == pytest.approx(np.std(error_m / sigma_m), rel=3e-3)
