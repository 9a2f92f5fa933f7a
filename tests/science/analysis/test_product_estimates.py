"""Quantities that owners ask for, against simulated noise and closed forms."""

import numpy as np
import pytest
from scipy import ndimage
from scipy.stats import norm

from station.science.analysis.product_estimates import (
    Estimate,
    crest,
    crossing,
    sign_of_change,
    thickness_between,
    water_equivalent,
)


def test_water_equivalent_has_the_variance_of_a_product_of_two_normal_factors():
    rng = np.random.default_rng(1)
    thickness_m, density = rng.normal(-2.0, 0.3, 400_000), rng.normal(850, 50, 400_000)
    mass = water_equivalent(Estimate(-2.0, 0.05, 0.04), 850.0, 50.0)
    assert mass.value == pytest.approx((thickness_m * density / 1000).mean(), abs=2e-3)
    assert mass.variance == pytest.approx((thickness_m * density / 1000).var(), rel=0.01)
    assert mass.random_variance == pytest.approx(0.85**2 * 0.05)


def test_an_offset_adds_its_variance_to_the_systematic_part():
    assert Estimate(1.0, 0.25, 0.5).with_offset(-0.1, 2.0) == Estimate(0.9, 0.25, 4.5)


@pytest.mark.parametrize("true_m", [0.0, 0.02])
def test_a_budget_of_noise_has_no_bias_without_a_level_of_detection(true_m):
    """A quarter of the area gained 2 cm, below the noise of 5 cm; elsewhere nothing changed.

    The sum of the positive cells is off by 0.4 sigma for each cell, and a level of detection of 95 % finds
    a tenth of the gain.
    """
    rng, sigma_m, shape = np.random.default_rng(2), 0.05, (60, 60)
    change_m = np.zeros(shape)
    change_m[:30, :30] = 3 * true_m
    gains, losses, naive, detected = [], [], [], []
    for _ in range(200):
        measured_m = change_m + rng.normal(0, sigma_m, shape)
        gain = sign_of_change(measured_m, np.full(shape, sigma_m**2), np.zeros(shape)).gained
        gains.append(measured_m[gain].sum())
        losses.append(measured_m[~gain].sum())
        naive.append(measured_m[measured_m > 0].sum())
        detected.append(measured_m[measured_m > 1.96 * sigma_m].sum())
    expected = change_m.sum()
    error = np.std(gains) / np.sqrt(len(gains))
    assert np.mean(gains) == pytest.approx(expected, abs=4 * error + 0.01 * expected)
    assert np.mean(losses) == pytest.approx(0.0, abs=4 * error + 0.01 * expected)
    assert np.mean(naive) > expected + 40 * error
    assert abs(np.mean(detected) - expected) > 40 * error


def test_a_single_block_beyond_the_noise_decides_for_itself_and_its_window():
    change_m, window = np.full((9, 9), -0.001), np.zeros((9, 9), bool)
    change_m[4, 4], window[2:7, 2:7] = 1.0, True
    change_m[3, 3], window[3, 3] = -1.0, False
    change_m[0, 0] = np.nan
    change_m[4, 4] = 2.0
    sign = sign_of_change(change_m, np.full((9, 9), 0.05**2), np.zeros((9, 9)))
    assert (sign.gained == window).all()


def test_a_cell_without_neighbours_decides_itself():
    change_m = np.full((9, 9), np.nan)
    change_m[0, 0], change_m[8, 8] = 0.02, -0.02
    sign = sign_of_change(change_m, np.full((9, 9), 0.05**2), np.zeros((9, 9)))
    assert np.argwhere(sign.gained).tolist() == [[0, 0]]
    assert not sign.certain.any()
    assert sign.random_m2[0, 0] == 0.05**2


@pytest.mark.parametrize(("sigma_m", "common_m"), [(0.01, 0.004), (0.002, 0.01), (0.01, 0.0)])
def test_the_sign_of_even_change_is_certain_as_often_as_a_normal_mean_exceeds_its_sigma(sigma_m, common_m):
    """In the middle of 5 x 5 cells: the mean of 24 values decides, and is certain beyond 1.96 sigma."""
    rng, shape, true_m = np.random.default_rng(4), (5, 5), 0.006
    certain, gains = [], []
    for _ in range(4000):
        measured_m = true_m + rng.normal(0, sigma_m, shape) + rng.normal(0, common_m)
        sign = sign_of_change(measured_m, np.full(shape, sigma_m**2), np.full(shape, common_m**2))
        gains.append(sign.gained[2, 2])
        certain.append(sign.certain[2, 2])
    deciding_m = np.sqrt(sigma_m**2 / 24 + common_m**2)
    assert sign.random_m2[2, 2] == pytest.approx(sigma_m**2 / 24)
    z, tolerance = true_m / deciding_m, 0.025
    assert np.mean(gains) == pytest.approx(norm.cdf(z), abs=tolerance)
    assert np.mean(certain) == pytest.approx(norm.cdf(z - 1.96) + norm.cdf(-z - 1.96), abs=tolerance)


def test_thickness_between_levels_is_clipped():
    thickness_m, derivative = thickness_between(
        np.array([-1.0, 0.5, 3.0]), np.array(0.0), np.array([2.0, 2.0, 2.0])
    )
    assert thickness_m.tolist() == [0.0, 0.5, 2.0]
    assert derivative.tolist() == [0.0, 1.0, 0.0]


def moved(position, distance_m, height_m, sample):
    """Return how far a position moves by a tenth of a millimetre of one sample, per metre."""
    lifted_m = height_m.copy()
    lifted_m[sample] += 1e-4
    return (position(distance_m, lifted_m).distance_m - position(distance_m, height_m).distance_m) / 1e-4


def test_a_crossing_of_a_plane_is_exact_and_the_first_is_taken():
    distance_m = np.arange(0.0, 50.0, 2.0)
    quiet_m2 = np.zeros(25)
    assert crossing(distance_m, 7.0 - 0.2 * distance_m, quiet_m2, 3.1).distance_m == pytest.approx(3.9 / 0.2)
    wave_m = np.sin(distance_m / 5)
    found = crossing(distance_m, wave_m, quiet_m2, 0.2)
    assert found.distance_m == pytest.approx(2 * 0.2 / np.sin(0.4))  # what is no noise stays as measured
    noise_m2 = np.full(25, 1.0)
    found = crossing(distance_m, wave_m, noise_m2, 0.2)
    slope, height_m = np.polyfit(distance_m[:3], wave_m[:3], 1)  # all of it may be noise
    assert found.distance_m == pytest.approx((0.2 - height_m) / slope)
    for sample, sensitivity in zip(found.samples, found.sensitivity, strict=True):
        expected = moved(lambda s, h: crossing(s, h, noise_m2, 0.2), distance_m, wave_m, sample)
        assert sensitivity == pytest.approx(expected, rel=1e-3)


def test_a_crest_is_the_summit_of_a_parabola():
    distance_m = np.arange(0.0, 50.0, 2.0)
    height_m = 8.0 - 0.01 * (distance_m - 23.4) ** 2
    noise_m2 = np.zeros(25)
    found = crest(distance_m, height_m, noise_m2)
    assert found.distance_m == pytest.approx(23.4)
    assert found.sensitivity.sum() == pytest.approx(0.0, abs=1e-9)  # not moved by a common error
    for sample, sensitivity in zip(found.samples, found.sensitivity, strict=True):
        expected = moved(lambda s, h: crest(s, h, noise_m2), distance_m, height_m, sample)
        assert sensitivity == pytest.approx(expected, rel=1e-2)
    assert crest(distance_m, distance_m, noise_m2) is None
    assert crest(distance_m, np.full(25, np.nan), noise_m2) is None


def test_there_is_no_crossing_without_both_sides():
    distance_m = np.arange(0.0, 20.0, 1.0)
    height_m = 5.0 - 0.5 * distance_m
    assert crossing(distance_m, height_m, np.zeros(20), 6.0) is None
    height_m[4:7] = np.nan
    assert crossing(distance_m, height_m, np.zeros(20), 2.5) is None


def test_a_crest_on_rough_ground_is_as_uncertain_as_repetitions_show():
    """1,000 ridges with one summit, whose heights scatter by 0.3 m, by noise or not."""
    rng, distance_m = np.random.default_rng(1), np.arange(0.0, 400.0, 10.0)
    ridge_m = -2e-3 * (distance_m - 195.0) ** 2
    for noise_m in (0.0, 0.1, 0.3):
        noise_m2 = np.full(40, noise_m**2)
        found = [crest(distance_m, ridge_m + rng.normal(0, 0.3, 40), noise_m2) for _ in range(1000)]
        error_m = np.array([place.distance_m for place in found]) - 195.0
        stated_m2 = [
            noise_m**2 * place.sensitivity @ place.sensitivity + place.relief_m2 * place.relief @ place.relief
            for place in found
        ]
        assert np.mean(error_m) == pytest.approx(0.0, abs=0.2)
        assert 0.8 < np.std(error_m) / np.sqrt(np.mean(stated_m2)) < 1.25


@pytest.mark.parametrize("noise_m", [0.0, 0.05, 0.2, 0.6])
@pytest.mark.parametrize("length_cells", [0.5, 2.0])
def test_a_contour_is_where_rough_ground_crosses_the_height(noise_m, length_cells):
    """500 slopes, each with relief of 0.3 m and this length of correlation, and noise of its own.

    The truth is between two true heights. Positions are as good as those of a line through four heights or
    between two measured ones, whichever is better on such ground.
    """
    rng, distance_m, noise_m2 = np.random.default_rng(4), np.arange(0.0, 400.0, 10.0), np.full(40, noise_m**2)
    z, errors_m = [], {"position": [], "line": [], "two": []}
    reliefs_m = ndimage.gaussian_filter1d(rng.standard_normal((500, 80)), length_cells, axis=1)[:, 20:60]
    reliefs_m *= 0.3 / np.sqrt(np.sum(ndimage.gaussian_filter1d(np.eye(80)[40], length_cells) ** 2))
    for relief_m in reliefs_m:
        true_m = 100.0 - 0.5 * distance_m + relief_m
        measured_m = true_m + rng.normal(0, noise_m, 40)
        true_place_m, two_m = (np.interp(0.0, -h, distance_m) for h in (true_m, measured_m))
        found = crossing(distance_m, measured_m, noise_m2, 0.0)
        variance_m2 = noise_m**2 * found.sensitivity @ found.sensitivity
        variance_m2 += found.relief_m2 * found.relief @ found.relief
        slope, height_m = np.polyfit(distance_m[found.samples], measured_m[found.samples], 1)
        for name, place_m in (("position", found.distance_m), ("two", two_m), ("line", -height_m / slope)):
            errors_m[name].append(place_m - true_place_m)
        if variance_m2 > 0:
            z.append(errors_m["position"][-1] / np.sqrt(variance_m2))
    rms_m = {name: np.sqrt(np.mean(np.square(values))) for name, values in errors_m.items()}
    assert rms_m["position"] < 1.1 * min(rms_m["line"], rms_m["two"]) + 1e-6
    assert (0.8 < np.sqrt(np.mean(np.square(z))) < 1.25) if noise_m else (rms_m["position"] < 1e-6)
