"""Resolution of cells as stored."""

import numpy as np
import pytest

from station.science.gridding.cell_estimates import quantum, round_sigma

SIGMA_M = np.geomspace(1.1e-3, 0.03, 5001)


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
