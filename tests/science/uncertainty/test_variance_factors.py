"""Variance factors of a scan: a model that is wrong by class, and systematic errors of stable ground."""

import numpy as np
import pytest

from station.quantities import ChangeErrors, SharedParameters
from station.science.geometry.robust_statistics import robust_scale
from station.science.uncertainty.variance_factors import (
    CELL_CLASSES,
    NOISE_CLASSES,
    Residuals,
    class_in_scan,
    estimate_variance_factors,
    noise_class,
    sampling_ratio,
)

SIDE_M, CELL_M, GROUP_M, POINTS = 3000.0, 5.0, 50.0, 3


def residuals(seed, true_factor, systematic_sigma_m=0.0, stable_share=1.0, reference_share=0.125):
    """Return residuals of a square of ground, modelled with 2 cm of noise, 1 mm of systematic error."""
    rng = np.random.default_rng(seed)
    x_m, y_m = (axis.ravel() for axis in np.meshgrid(*[np.arange(0, SIDE_M, CELL_M)] * 2))
    classes = (x_m >= SIDE_M / 2).astype(np.uint8)
    scan_m2 = np.full(len(x_m), 0.02**2)
    reference_m2 = reference_share * scan_m2
    truth_m2 = np.asarray(true_factor)[classes] * scan_m2 + reference_m2
    blocks = rng.normal(0, systematic_sigma_m, (10, 10))  # correlated over 300 m
    systematic_m = blocks[(y_m / 300).astype(int), (x_m / 300).astype(int)]
    residual_m = rng.normal(0, np.sqrt(truth_m2)) + systematic_m
    group = (y_m // GROUP_M).astype(int) * 60 + (x_m // GROUP_M).astype(int)
    stable = y_m < stable_share * SIDE_M
    model = scan_m2, reference_m2, np.full(len(x_m), 0.001**2)
    freedom = np.full(len(x_m), POINTS - 1)
    scatter_m2 = np.asarray(true_factor)[classes] * scan_m2 * POINTS * rng.chisquare(freedom) / freedom
    return Residuals(x_m, y_m, group, classes, stable, residual_m, *model, scatter_m2, freedom)


@pytest.mark.parametrize("factors", [(1.0, 1.0), (4.0, 0.25), (0.5, 9.0), (1.0, 0.04)])
def test_random_factors_are_found_by_class_in_both_directions(factors):
    found = estimate_variance_factors(residuals(1, factors)).random
    assert found[:2] == pytest.approx(factors, rel=0.03)
    assert (found[2:14] == 1).all()  # rougher ground at the same range
    assert found[NOISE_CLASSES : NOISE_CLASSES + 2] == pytest.approx(factors, rel=0.03)  # of stable ground
    assert len(found) == 2 * NOISE_CLASSES


def test_classes_with_few_cells_have_the_factor_of_the_same_roughness_at_all_ranges():
    observed = residuals(1, (0.04, 0.04))
    far, rougher = (noise_class(np.array([2200.0]), np.array([ratio]), False)[0] for ratio in (0.01, 0.07))
    classes = observed.noise_class.copy()
    classes[:20] = far
    found = estimate_variance_factors(Residuals(**{**vars(observed), "noise_class": classes})).random
    assert found[far] == pytest.approx(0.04, rel=0.1)
    assert found[rougher] == 1


def test_systematic_factor_is_one_where_stable_ground_fits_better_than_expected():
    assert estimate_variance_factors(residuals(1, (1.0, 1.0), 0.0002)).systematic == pytest.approx(
        1.0, abs=1e-6
    )


@pytest.mark.parametrize("sigma_m", [0.0015, 0.004])
@pytest.mark.integration
def test_systematic_factor_is_found_from_blocks_of_stable_ground(sigma_m):
    found = [estimate_variance_factors(residuals(seed, (1.0, 1.0), sigma_m)).systematic for seed in range(4)]
    assert np.mean(np.log(found)) == pytest.approx(np.log((sigma_m / 0.001) ** 2), abs=0.4)


def test_errors_that_cells_of_a_block_share_are_not_errors_of_the_state():
    """Rough rock errs by 5 mm from block to block, where independent cells would have means within 1 mm."""
    quiet = residuals(1, (1.0, 1.0))
    block = (quiet.y_m // 100 * 30 + quiet.x_m // 100).astype(int)
    local_m = np.random.default_rng(6).normal(0, 0.005, block.max() + 1)[block]
    found = estimate_variance_factors(Residuals(**{**vars(quiet), "residual_m": quiet.residual_m + local_m}))
    assert 1 <= found.systematic < 1.5


def test_blocks_with_far_more_random_error_hardly_change_the_systematic_variance():
    """Blocks of ten cells have random errors of 6 mm, on which systematic ones of 1 mm do not show."""
    factors = []
    for seed in range(6):
        observed = residuals(seed, (1.0, 1.0), 0.001)
        few = np.random.default_rng(seed).random(len(observed.x_m)) < 1 / 40
        sampled = Residuals(**{name: values[few] for name, values in vars(observed).items()})
        factors.append(estimate_variance_factors(sampled).systematic)
    assert max(factors) < 1.3


def test_without_stable_ground_the_systematic_variance_stays_as_modelled():
    assert estimate_variance_factors(residuals(1, (1.0, 1.0), 0.01, stable_share=0.0)).systematic == 1.0


def test_a_hut_hardly_changes_the_systematic_variance():
    found = estimate_variance_factors(residuals(1, (1.0, 1.0), 0.01, stable_share=0.034)).systematic
    assert 1 < found < 20  # of 100: 30 blocks count as three independent ones, as many as the model


def with_a_shot_too_many(observed, share):
    """Return the residuals of which a share of the cells have a shot too many, and where those are."""
    more = np.random.default_rng(8).random(len(observed.x_m)) < share
    usual = np.full(len(more), POINTS, np.float16)
    classes = class_in_scan(observed.noise_class, np.zeros(len(more), bool), POINTS + more, usual)
    return Residuals(**{**vars(observed), "noise_class": classes}), more


def test_cells_with_a_shot_too_many_have_a_factor_of_their_own():
    observed, more = with_a_shot_too_many(residuals(7, (0.25, 0.25)), 0.3)
    residual_m = np.where(more, 3, 1) * observed.residual_m
    found = estimate_variance_factors(Residuals(**{**vars(observed), "residual_m": residual_m}))
    for part, factor in ((~more, 0.25), (more, 9 * (0.25 + 0.125) - 0.125)):
        classes = np.unique(observed.noise_class[part])
        assert found.random[classes] == pytest.approx(np.full(2, factor), rel=0.05)
    assert found.median_random == pytest.approx(0.25, rel=0.05)


def test_cells_that_err_far_more_than_modelled_do_not_blur_the_means_around_the_others():
    """Weighted as modelled, the mean of a group of 100 cells has a variance of 0.4: ten times a cell's."""
    observed, wild = with_a_shot_too_many(residuals(7, (0.04, 0.04), reference_share=0.01), 0.1)
    residual_m = np.where(wild, 100, 1) * observed.residual_m
    found = estimate_variance_factors(Residuals(**{**vars(observed), "residual_m": residual_m})).random
    assert found[np.unique(observed.noise_class[~wild])] == pytest.approx(np.full(2, 0.04), rel=0.05)


def test_few_cells_with_a_shot_too_many_have_the_factor_of_the_others():
    observed, more = with_a_shot_too_many(residuals(7, (0.25, 0.25)), 5e-5)
    found = estimate_variance_factors(observed).random[np.unique(observed.noise_class[more])]
    assert 3 < more.sum() < 30
    assert found == pytest.approx([0.25, 0.25], rel=0.05)


def test_moving_ground_does_not_tell_the_noise_of_the_few_stable_cells_with_a_shot_too_many():
    """Some 20: others of the same class, with the usual number of points, are enough."""
    observed, more = with_a_shot_too_many(residuals(3, (1.0, 1.0), stable_share=0.01), 0.006)
    drifts_m = np.where(observed.stable, 0, np.random.default_rng(4).normal(0, 0.1, len(more)))
    changed = Residuals(**{**vars(observed), "residual_m": observed.residual_m + drifts_m})
    found = estimate_variance_factors(changed).random[np.unique(observed.noise_class[more])]
    assert np.count_nonzero(more & ~observed.stable) > 2000
    assert found == pytest.approx([1, 1], rel=0.2)  # with moving ground 3


def test_class_in_scan_parts_scatter_and_number_of_points():
    cell_class = np.array([0, 7, 255], np.uint8)
    usual = np.full(3, 2.5, np.float16)
    every = {
        tuple(class_in_scan(cell_class, np.full(3, excess), np.full(3, count), usual))
        for excess in (False, True)
        for count in (2.5, 2.2, 3.0, 1.0)
    }
    assert sorted(np.concatenate([*every])) == sorted(
        (cell_class + CELL_CLASSES * np.arange(8)[:, None]).flat
    )
    unknown = np.full(3, np.nan, np.float16)  # as in references of early versions
    assert np.array_equal(class_in_scan(cell_class, np.zeros(3, bool), np.arange(1, 4), unknown), cell_class)
    # As many too few as too many.
    pair = [class_in_scan(cell_class, np.zeros(3, bool), np.full(3, count), usual) for count in (2, 3)]
    assert np.array_equal(*pair)


def test_change_of_moving_ground_does_not_widen_the_noise_of_stable_ground():
    quiet = residuals(3, (1.0, 1.0), stable_share=0.5)
    drifts_m = np.where(quiet.stable, 0, np.random.default_rng(4).normal(0, 0.1, len(quiet.x_m)))
    changed = Residuals(**{**vars(quiet), "residual_m": quiet.residual_m + drifts_m})
    assert estimate_variance_factors(changed).random[:2] == pytest.approx([1, 1], rel=0.03)


def test_rock_among_deep_snow_has_deviations_of_its_own():
    """A third of each group of 100 cells is bare rock, the rest under 2 m of snow."""
    quiet, rng = residuals(3, (1.0, 4.0)), np.random.default_rng(5)
    rock = rng.random(len(quiet.x_m)) < 1 / 3
    residual_m = quiet.residual_m + np.where(rock, 0.0, 2.0)
    found = estimate_variance_factors(Residuals(**{**vars(quiet), "residual_m": residual_m, "stable": rock}))
    assert found.random[:2] == pytest.approx([1, 4], rel=0.03)


def test_little_rock_does_not_have_the_noise_of_the_snow_around():
    """Two patches of 150 cells of rock: new snow scatters by 1.5 times as modelled, rock by a half."""
    quiet = residuals(3, (1.0, 1.0), reference_share=0.0)
    rock = (quiet.x_m % (SIDE_M / 2) < 50) & (quiet.y_m < 75)
    residual_m = quiet.residual_m * np.where(rock, 0.5, 1.5)
    found = estimate_variance_factors(Residuals(**{**vars(quiet), "residual_m": residual_m, "stable": rock}))
    assert found.random[:2] == pytest.approx([2.25, 2.25], rel=0.05)
    of_rock = found.random[NOISE_CLASSES : NOISE_CLASSES + 2]
    assert of_rock == pytest.approx([0.25, 0.25], rel=0.35)  # one sigma is 14 %
    snow_and_rock = found.random_of(np.zeros(2, np.int64), np.array([False, True]))
    assert snow_and_rock == pytest.approx(found.random[[0, NOISE_CLASSES]])


def test_change_that_slopes_is_not_noise():
    """Melt that grows by 3 mm every 2 m differs by 22 mm (sigma) within a group: as much as the noise."""
    quiet = residuals(3, (1.0, 4.0), stable_share=0.0)
    melt_m = -0.0015 * quiet.x_m
    changed = Residuals(**{**vars(quiet), "residual_m": quiet.residual_m + melt_m})
    assert estimate_variance_factors(changed).random[:2] == pytest.approx([1, 4], rel=0.03)


@pytest.mark.parametrize("drift_m", [0.3, 1.0])
def test_drifts_on_ground_without_any_stable_ground_do_not_count_as_noise(drift_m):
    quiet = residuals(3, (1.0, 4.0), stable_share=0.0)
    drifts_m = np.random.default_rng(4).normal(0, drift_m, len(quiet.x_m))
    changed = Residuals(**{**vars(quiet), "residual_m": quiet.residual_m + drifts_m})
    assert estimate_variance_factors(quiet).random[:2] == pytest.approx([1, 4], rel=0.03)
    assert estimate_variance_factors(changed).random[:2] == pytest.approx([1, 4], rel=0.1)


def test_a_few_cells_do_not_show_a_variance():
    few = residuals(5, (9.0, 9.0))
    few = Residuals(*(column[:20] for column in vars(few).values()))
    assert (estimate_variance_factors(few).random == 1).all()


def test_robust_scale_is_the_sigma_of_normal_values_and_is_between_middle_and_tails():
    rng = np.random.default_rng(2)
    assert robust_scale(rng.normal(0, 3, 100_000)) == pytest.approx(3, rel=0.01)
    heavy = rng.standard_t(3, 100_000)
    # Quantiles of Student's t with 3 degrees of freedom: 0.7649 (50 % of the absolute values), 3.1824 (95 %).
    assert robust_scale(heavy) == pytest.approx(np.sqrt(0.7649 / 0.6745 * 3.1824 / 1.96), rel=0.02)
    assert np.mean(np.abs(heavy) < 1.96 * robust_scale(heavy)) == pytest.approx(0.924, abs=0.005)


def test_noise_classes_fit_a_byte_and_part_range_roughness_and_sampling():
    range_m, ratio = (
        axis.ravel() for axis in np.meshgrid(np.linspace(0, 20_000, 201), np.geomspace(1e-3, 9, 50))
    )
    classes = noise_class(range_m, ratio, np.ones(len(ratio), bool))
    assert (classes.min(), classes.max() < CELL_CLASSES) == (1, True)
    one = np.array([1200.0]), np.array([0.07])
    of_one = noise_class(*one, np.array([True]))
    assert of_one == noise_class(one[0] + 200, one[1] + 0.02, np.array([True]))
    for other in ((1600.0, 0.07, True), (1200.0, 0.12, True), (1200.0, 0.07, False)):
        assert noise_class(*(np.array([value]) for value in other)) != of_one


@pytest.mark.parametrize(("ratio", "middle"), [(0.01, 0.0177), (0.07, 0.0707), (0.39, 0.283), (5.0, 1.131)])
def test_the_sampling_ratio_of_a_class_is_the_geometric_mean_of_its_edges(ratio, middle):
    """At any range, of cells as a reference stores them."""
    range_m = np.array([100.0, 2200.0, 8900.0])
    classes = noise_class(range_m, np.full(3, ratio), np.array([True, False, True])).astype(np.uint8)
    assert sampling_ratio(classes) == pytest.approx(np.full(3, middle), rel=0.003)


def test_scaled_parameters_have_the_factor_in_every_variance():
    root = np.random.default_rng(1).normal(size=(4, 3))
    errors = ChangeErrors(np.ones((4, 2)), np.zeros(3))
    shared = SharedParameters(
        tuple("abcd"), ("1",) * 4, np.arange(4.0), root @ root.T, np.full(4, 0.1), errors
    )
    scaled = shared.scaled(4.0)
    assert np.array_equal(scaled.estimate, shared.estimate)
    assert scaled.covariance == pytest.approx(4 * root @ root.T)
    assert (scaled.line_tilt_variance == 0.4).all()
    modes = scaled.change_errors.modes
    assert modes @ modes.T == pytest.approx(4 * errors.modes @ errors.modes.T)
