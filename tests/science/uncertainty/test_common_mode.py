"""Errors that two scans have in common through the change of moving ground, against algebra."""

import numpy as np
import pytest

from station.quantities import ChangeErrors, SharedParameters
from station.science.uncertainty import common_mode, parameters
from station.science.uncertainty.common_mode import cross_covariance

PARAMS = parameters.ParameterLayout(np.radians(20), 20, full_circle=False)
SECTORS = 24 * 12


@pytest.mark.parametrize(
    ("factor", "correlation"), [(1.0, 1.0), (-1.0, -1.0), (0.5, 0.8), (2.0, 0.8), (-0.5, -0.8), (0.0, 0.0)]
)
def test_pattern_correlation_of_scaled_patterns(factor, correlation):
    pattern = np.random.default_rng(1).normal(size=SECTORS)
    pattern[::2] = 0.0  # sectors without data
    centred = np.where(pattern != 0, pattern - pattern[pattern != 0].mean(), 0.0)
    assert common_mode.pattern_correlation(centred, factor * centred) == pytest.approx(correlation)
    assert common_mode.pattern_correlation(pattern, factor * pattern) == pytest.approx(correlation)


def test_pattern_correlation_ignores_the_mean():
    first, second = np.random.default_rng(1).normal(size=(2, SECTORS))
    assert abs(common_mode.pattern_correlation(first + 5, second + 5)) < 0.2
    assert common_mode.pattern_correlation(first + 5, first - 5) == pytest.approx(1.0)


def test_pattern_correlation_of_empty_patterns_is_zero():
    assert common_mode.pattern_correlation(np.zeros(SECTORS), np.zeros(SECTORS)) == 0.0


def test_polar_mean_by_sector_and_ring():
    azimuth = np.radians([359.0, -1.0, 1.0, 16.0, 16.0])
    actual = common_mode.polar_mean(
        azimuth, np.array([100.0, 499.0, 100.0, 700.0, 9e4]), np.array([1.0, 2, 4, 8, 16])
    )
    assert np.flatnonzero(actual).tolist() == [0, 12 + 1, 12 + 11, 23 * 12]
    assert actual[actual != 0].tolist() == [4.0, 8.0, 16.0, 1.5]


def test_dominant_modes_have_the_largest_effect_on_heights():
    """Against the singular values of the heights (Eckart and Young), for very different units."""
    rng = np.random.default_rng(2)
    units = 10.0 ** rng.integers(-6, 2, 50)
    effect, factor = rng.normal(size=(400, 50)) / units, rng.normal(size=(60, 50)) * units
    factor *= 0.8 ** np.arange(60)[:, None]
    modes = common_mode.dominant_modes(factor, effect.T @ effect)
    assert modes.shape == (50, common_mode.MODES)
    size = np.linalg.svd(effect @ factor.T, compute_uv=False) ** 2
    assert np.sum((effect @ modes) ** 2) == pytest.approx(size[: common_mode.MODES].sum(), rel=1e-6)
    few = common_mode.dominant_modes(factor[:5], effect.T @ effect)
    assert (few @ few.T) / np.outer(units, units) == pytest.approx(
        (factor[:5].T @ factor[:5]) / np.outer(units, units), abs=1e-5
    )


def shared_parameters(modes, pattern, names=PARAMS.names):
    count = len(modes)
    covariance = modes @ modes.T + np.diag(np.linspace(0.5, 2, count) ** 2)
    return SharedParameters(
        names, PARAMS.units, np.zeros(count), covariance, np.zeros(count), ChangeErrors(modes, pattern)
    )


def test_common_errors_of_the_same_change_cancel_in_the_difference():
    """Whatever the order and the signs of the modes, which an estimate does not determine."""
    rng = np.random.default_rng(3)
    count = len(PARAMS.names)
    modes, pattern = rng.normal(size=(count, 8)), rng.normal(size=SECTORS)
    rotation, _ = np.linalg.qr(rng.normal(size=(8, 8)))
    first, second = shared_parameters(modes, pattern), shared_parameters(0.4 * modes @ rotation, pattern)
    whole = modes @ modes.T
    for sign in (1, -1):
        common = cross_covariance(first, shared_parameters(second.change_errors.modes, sign * pattern))
        difference = whole + 0.16 * whole - common - common.T
        assert difference == pytest.approx((1 - sign * 0.4) ** 2 * whole, abs=1e-9)


def test_variance_of_a_difference_is_never_negative():
    rng = np.random.default_rng(4)
    count = len(PARAMS.names)
    for _ in range(5):
        first, second = (
            shared_parameters(rng.normal(size=(count, 6)), rng.normal(size=SECTORS) + 2) for _ in range(2)
        )
        common = cross_covariance(first, second)
        difference = (
            sum(shared.change_errors.modes @ shared.change_errors.modes.T for shared in (first, second))
            - common
            - common.T
        )
        assert np.linalg.eigvalsh(difference)[0] > -1e-9


def test_no_cross_covariance_for_other_parameters_or_without_moving_ground():
    shared = shared_parameters(np.ones((len(PARAMS.names), 4)), np.ones(SECTORS))
    relocated = shared_parameters(
        np.ones((len(PARAMS.names), 4)), np.ones(SECTORS), tuple(f"{name}x" for name in PARAMS.names)
    )
    without_change = SharedParameters(
        PARAMS.names, PARAMS.units, shared.estimate, shared.covariance, shared.line_tilt_variance
    )
    assert cross_covariance(shared, relocated) is None
    assert cross_covariance(shared, without_change) is None
    assert cross_covariance(shared, shared) is not None
