"""What two scans have wrong alike by the change of the ground: against algebra."""

import numpy as np
import pytest

from station.quantities import ChangeErrors, Shared
from station.science import likeness, shared
from station.science.likeness import common_errors

OF = shared.Basis(np.radians(20), 20, closed=False)
SECTORS = 24 * 12


@pytest.mark.parametrize(
    ("times", "alike"), [(1.0, 1.0), (-1.0, -1.0), (0.5, 0.8), (2.0, 0.8), (-0.5, -0.8), (0.0, 0.0)]
)
def test_patterns_of_one_shape_are_as_alike_as_their_sizes(times, alike):
    one = np.random.default_rng(1).normal(size=SECTORS)
    one[::2] = 0.0  # where nothing lies
    shape = np.where(one != 0, one - one[one != 0].mean(), 0.0)
    assert likeness.likeness(shape, times * shape) == pytest.approx(alike)
    assert likeness.likeness(one, times * one) == pytest.approx(alike)


def test_how_much_fell_does_not_count_but_where():
    one, other = np.random.default_rng(1).normal(size=(2, SECTORS))
    assert abs(likeness.likeness(one + 5, other + 5)) < 0.2
    assert likeness.likeness(one + 5, one - 5) == pytest.approx(1.0)


def test_where_nothing_was_found_nothing_is_alike():
    assert likeness.likeness(np.zeros(SECTORS), np.zeros(SECTORS)) == 0.0


def test_a_pattern_is_the_mean_of_each_sector():
    azimuth = np.radians([359.0, -1.0, 1.0, 16.0, 16.0])
    told = likeness.pattern(
        azimuth, np.array([100.0, 499.0, 100.0, 700.0, 9e4]), np.array([1.0, 2, 4, 8, 16])
    )
    assert np.flatnonzero(told).tolist() == [0, 12 + 1, 12 + 11, 23 * 12]
    assert told[told != 0].tolist() == [4.0, 8.0, 16.0, 1.5]


def test_modes_are_those_that_heights_feel_most():
    """Against the singular values of the heights themselves (Eckart and Young), of units far apart."""
    rng = np.random.default_rng(2)
    units = 10.0 ** rng.integers(-6, 2, 50)
    effect, factor = rng.normal(size=(400, 50)) / units, rng.normal(size=(60, 50)) * units
    factor *= 0.8 ** np.arange(60)[:, None]
    told = likeness.modes(factor, effect.T @ effect)
    assert told.shape == (50, likeness.MODES)
    size = np.linalg.svd(effect @ factor.T, compute_uv=False) ** 2
    assert np.sum((effect @ told) ** 2) == pytest.approx(size[: likeness.MODES].sum(), rel=1e-6)
    few = likeness.modes(factor[:5], effect.T @ effect)
    assert (few @ few.T) / np.outer(units, units) == pytest.approx(
        (factor[:5].T @ factor[:5]) / np.outer(units, units), abs=1e-5
    )


def known_of(modes, pattern, names=OF.names):
    count = len(modes)
    covariance = modes @ modes.T + np.diag(np.linspace(0.5, 2, count) ** 2)
    return Shared(names, OF.units, np.zeros(count), covariance, np.zeros(count), ChangeErrors(modes, pattern))


def test_of_the_same_change_only_what_one_scan_has_more_is_in_the_difference():
    """Whatever the order and the signs of the modes are: an estimate does not tell them."""
    rng = np.random.default_rng(3)
    count = len(OF.names)
    modes, pattern = rng.normal(size=(count, 8)), rng.normal(size=SECTORS)
    turned, _ = np.linalg.qr(rng.normal(size=(8, 8)))
    one, other = known_of(modes, pattern), known_of(0.4 * modes @ turned, pattern)
    whole = modes @ modes.T
    for sign in (1, -1):
        common = common_errors(one, known_of(other.change.modes, sign * pattern))
        left = whole + 0.16 * whole - common - common.T
        assert left == pytest.approx((1 - sign * 0.4) ** 2 * whole, abs=1e-9)


def test_what_is_common_is_never_more_than_both_have():
    rng = np.random.default_rng(4)
    count = len(OF.names)
    for _ in range(5):
        one, other = (known_of(rng.normal(size=(count, 6)), rng.normal(size=SECTORS) + 2) for _ in range(2))
        common = common_errors(one, other)
        left = sum(known.change.modes @ known.change.modes.T for known in (one, other)) - common - common.T
        assert np.linalg.eigvalsh(left)[0] > -1e-9


def test_scans_of_other_parameters_or_without_moving_ground_have_nothing_in_common():
    one = known_of(np.ones((len(OF.names), 4)), np.ones(SECTORS))
    moved = known_of(np.ones((len(OF.names), 4)), np.ones(SECTORS), tuple(f"{name}x" for name in OF.names))
    alone = Shared(OF.names, OF.units, one.estimate, one.covariance, one.noise_variance)
    assert common_errors(one, moved) is None
    assert common_errors(one, alone) is None
    assert common_errors(one, one) is not None
