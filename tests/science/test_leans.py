"""The lines' own leans, solved without a matrix of all of them: against plain dense algebra."""

import numpy as np
import pytest
from scipy import sparse

from station.science.leans import OwnLeans

PASSED = {
    "one way": np.arange(300),
    "all round, backwards, begun elsewhere": np.roll(np.arange(300), 57)[::-1],
    "a few": np.array([2, 0, 1]),
}


def dense(time_s, alike_rad2, alone_rad2):
    """Covariance of an Ornstein-Uhlenbeck process of 3 s and of what is each line's alone."""
    apart_s = np.abs(np.subtract.outer(time_s, time_s))
    return alike_rad2 * np.exp(-apart_s / 3) + np.diag(alone_rad2)


@pytest.mark.parametrize("order", PASSED.values(), ids=PASSED.keys())
def test_own_leans_against_dense_algebra(order):
    rng = np.random.default_rng(4)
    count = len(order)
    steps_s = rng.uniform(0.5, 3, count - 1)
    time_s = np.empty(count)
    time_s[order] = np.concatenate([[0.0], np.cumsum(steps_s)])
    alone_rad2 = rng.uniform(1e-10, 3e-10, count)
    own = OwnLeans(order, np.exp(-steps_s / 3), 3e-10, alone_rad2)
    covariance = dense(time_s, 3e-10, alone_rad2)
    assert own.covariance() == pytest.approx(covariance, rel=1e-9, abs=1e-22)
    assert own.twice().covariance() == pytest.approx(2 * covariance, rel=1e-9, abs=1e-22)
    told = 10 ** rng.uniform(7, 13, count) * (rng.uniform(size=count) > 0.3)  # some lines saw nothing
    wanted = np.linalg.inv(np.linalg.inv(covariance) + np.diag(told))
    given = own.given(told)
    assert given.times(np.eye(count)) == pytest.approx(wanted, rel=1e-9, abs=1e-9 * wanted.max())
    assert given.variance() == pytest.approx(np.diag(wanted), rel=1e-9)
    matrix = rng.normal(size=(count, 40)) * 10.0 ** rng.uniform(-3, 3, 40)
    matrix[:, 3:] *= np.abs(np.subtract.outer(np.linspace(0, 40, count), np.arange(3, 40))) < 2
    between = matrix.T @ wanted @ matrix
    scale = np.sqrt(np.diag(between)) + 1e-30
    apart = np.abs(given.between(sparse.csr_array(matrix)) - between) / np.outer(scale, scale)
    assert apart.max() < 1e-9
