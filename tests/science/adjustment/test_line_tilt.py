"""Prior and posterior of the line tilts, compared with dense linear algebra."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import sparse

from station.science.adjustment.line_tilt import LineTiltPrior

LINE_ORDERS = {
    "ascending": np.arange(300),
    "full circle, descending, shifted start": np.roll(np.arange(300), 57)[::-1],
    "three lines": np.array([2, 0, 1]),
}


def dense_covariance(time_s, correlated_rad2, white_rad2):
    """Covariance of an Ornstein-Uhlenbeck process of 3 s plus white noise."""
    separation_s = np.abs(np.subtract.outer(time_s, time_s))
    return correlated_rad2 * np.exp(-separation_s / 3) + np.diag(white_rad2)


@pytest.mark.parametrize("order", LINE_ORDERS.values(), ids=LINE_ORDERS.keys())
def test_prior_and_posterior_match_dense_algebra(order):
    rng = np.random.default_rng(4)
    count = len(order)
    steps_s = rng.uniform(0.5, 3, count - 1)
    time_s = np.empty(count)
    time_s[order] = np.concatenate([[0.0], np.cumsum(steps_s)])
    white_rad2 = rng.uniform(1e-10, 3e-10, count)
    prior = LineTiltPrior(order, np.exp(-steps_s / 3), 3e-10, white_rad2)
    covariance = dense_covariance(time_s, 3e-10, white_rad2)
    assert_allclose(prior.covariance(), covariance, rtol=1e-9, atol=1e-22)
    assert_allclose(prior.doubled().covariance(), 2 * covariance, rtol=1e-9, atol=1e-22)
    weight = 10 ** rng.uniform(7, 13, count) * (rng.uniform(size=count) > 0.3)  # some without observations
    expected = np.linalg.inv(np.linalg.inv(covariance) + np.diag(weight))
    posterior = prior.condition_on(weight)
    assert_allclose(posterior.apply(np.eye(count)), expected, rtol=0, atol=1e-9 * expected.max())
    assert_allclose(posterior.variance(), np.diag(expected), rtol=1e-9)
    matrix = rng.normal(size=(count, 40)) * 10.0 ** rng.uniform(-3, 3, 40)
    matrix[:, 3:] *= np.abs(np.subtract.outer(np.linspace(0, 40, count), np.arange(3, 40))) < 2
    quadratic_form = matrix.T @ expected @ matrix
    scale = np.sqrt(np.diag(quadratic_form)) + 1e-30
    error = np.abs(posterior.quadratic_form(sparse.csr_array(matrix)) - quadratic_form) / np.outer(
        scale, scale
    )
    assert error.max() < 1e-9
