"""Mixture over models of the ground's change, compared with dense algebra and with direct integration."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm

from station.quantities import VarianceComponents
from station.science.adjustment import ground_change, ground_classes, prior, solution
from station.science.adjustment.ground_change import ChangeModel
from station.science.adjustment.normal_equations import NormalEquations
from station.science.adjustment.patches import GroundClass, Patches
from station.science.uncertainty.jacobian import height_jacobian
from station.science.uncertainty.parameters import ParameterLayout

PARAMS = ParameterLayout(math.radians(10.0), 10, full_circle=False)
PRIOR = prior.state_prior(
    PARAMS, prior.line_times(PARAMS, np.eye(3), None), VarianceComponents(), weather_known=True
)
COUNT, STABLE, SIGMA_M = 150, 15, 0.004


def make_patches(seed, change_m, bare_share=0.0):
    """Return patches of a scanner at rest, of which the first are stable ground; the others have changed.

    Except for a share of bare ground, that is, which is not known to be stable.
    """
    rng = np.random.default_rng(seed)
    line, range_bin = rng.integers(0, PARAMS.line_groups, COUNT), rng.integers(8, 30, COUNT)
    azimuth, range_m, height_m = (
        np.radians(10.1 + 0.2 * line),
        80 * (range_bin + 0.5),
        rng.uniform(-500, 0, COUNT),
    )
    stable = np.arange(COUNT) < STABLE
    offset_m = range_m * np.sin(azimuth), range_m * np.cos(azimuth), height_m
    rock = stable | (rng.uniform(size=COUNT) < bare_share)
    jacobian = height_jacobian(PARAMS, offset_m, *rng.uniform(-0.3, 0.3, (2, COUNT)), rock=rock)
    residual_m = rng.normal(0, SIGMA_M, COUNT) + np.where(rock, 0.0, change_m)
    ground_class = np.where(stable, GroundClass.STABLE, GroundClass.MOVING).astype(np.int64)
    variance_m2, cells = np.full(COUNT, SIGMA_M**2), np.full(COUNT, 20.0)
    smooth = np.zeros(COUNT)
    return Patches(jacobian, range_bin, height_m, ground_class, residual_m, variance_m2, cells, smooth)


def solve(
    seed,
    change_m,
    bare_share=0.0,
    bare_change_m=None,
    thin_snow=ground_change.THIN_SNOW,
    stable_change_m=0.0,
):
    patches = make_patches(seed, change_m, bare_share)
    stable = patches.ground_class == GroundClass.STABLE
    patches = replace(patches, residual_m=patches.residual_m + stable * stable_change_m)
    if bare_change_m is not None:
        bare = (patches.ground_class == GroundClass.MOVING) & ~on_ice(patches)
        patches = replace(patches, residual_m=patches.residual_m + bare * bare_change_m)
    moving = patches.ground_class == GroundClass.MOVING
    change = ground_change.ground_change(patches, moving, thin_snow)
    equations = NormalEquations(patches.jacobian, change.design, patches.residual_m, PRIOR, None)
    reduced = equations.reduce(1 / patches.variance_m2)
    return patches, change, equations.size, solution.Solution(reduced, equations.size, change)


def on_ice(patches):
    """Return whether patches are ice, over which refraction is its own."""
    return patches.jacobian.pose[PARAMS.names.index("refraction_ice")] != 0


def sigma_of(mixture, count):
    """Return sigma of the first unknowns."""
    half = mixture.factor.half_solve(np.eye(len(mixture.estimate))[:, :count])
    return np.sqrt(np.sum(half**2, axis=0))


def test_thin_snow_lies_where_the_air_is_colder_than_8_degrees():
    """At 10 °C at the scanner that is from 308 m below it, as far as cold air may collect there."""
    unknown, cold, mild, warm, hot = (
        solve(3, 0.2, thin_snow=ground_change.ThinSnow(temperature_c, 0.03))
        for temperature_c in (None, 2.0, 8.5, 10.0, 20.0)
    )
    patches, change, _, _ = warm
    first = change.trend_columns + len(change.knot_precisions[0])
    snow = change.design.toarray()[:, first : first + change.snow_columns].sum(axis=1)
    stable = np.arange(COUNT) < STABLE
    assert 3 < np.count_nonzero(snow) < STABLE
    assert (snow == (stable & (patches.height_m < -2.0 / 0.0065))).all()
    up = 5
    sigma_m = [sigma_of(solved[-1].mixture(), up + 1)[up] for solved in (unknown, cold, mild, hot)]
    assert sigma_m[0] == sigma_m[1] > 1.01 * sigma_m[2] > 1.01 * sigma_m[3]


@pytest.mark.parametrize(
    ("model", "depth_m"),
    [
        (ChangeModel(0, 9, 5, snow=1, mean=1), ground_classes.unseen_snow(1.064)[0]),
        # No deeper than the change of other ground.
        (ChangeModel(0, 0, 0, snow=1), np.hypot(0.00024, 0.0005)),
        (ChangeModel(0, 9, 5, snow=0, mean=1), 0.0),
        (ChangeModel(0, 9, 5, snow=2, mean=1), 0.0),
    ],
)
def test_thin_snow_is_none_or_of_any_depth_that_brightness_does_not_show(moderate, model, depth_m):
    _, change, _, _ = moderate
    thin_snow = slice(change.trend_columns, change.trend_columns + change.snow_columns)
    mean_m, sigma_m = (values[thin_snow] for values in change.prior_m(model))
    rng = np.random.default_rng(1)
    draws_m = np.where(rng.uniform(size=100_000) < 0.5, 0.0, rng.uniform(0, depth_m, 100_000))
    assert mean_m == pytest.approx(np.full(4, draws_m.mean()), rel=0.03)
    assert sigma_m == pytest.approx(np.full(4, draws_m.std()), rel=0.03, abs=1e-5)


def test_sigma_covers_thin_snow_unless_brightness_shows_none():
    """Under 0 to 10 mm of snow on all ground, the scanner seems to have sunk by as much."""
    depths_m = np.random.default_rng(5).uniform(0, 0.01, 24)
    rms = {}
    for shows in (False, None, True):
        z = []
        for seed, depth_m in enumerate(depths_m):
            _, change, size, solved = solve(
                seed, depth_m, thin_snow=ground_change.ThinSnow(shows=shows), stable_change_m=depth_m
            )
            assert change.thin_snow.shows == shows
            mixture = solved.mixture()
            z.append((mixture.estimate[size] - depth_m) / sigma_of(mixture, size + 1)[size])
        rms[shows] = np.sqrt(np.mean(np.square(z)))
    assert rms[False] > 1.6
    assert 0.5 < rms[True] < rms[None] < 1.25


def test_rock_that_is_brighter_in_warm_air_is_not_under_snow():
    _, change, _, _ = solve(1, 0.01, thin_snow=ground_change.ThinSnow(15.0, shows=True))
    snow = ChangeModel(0, 9, 5, snow=1)
    assert change.log_prior(snow) == snow.log_prior


@pytest.mark.parametrize(("wavelength_um", "largest_m"), [(1.064, 0.04), (1.55, 0.134)])
def test_under_two_metres_of_snow_a_fiftieth_may_be_unseen(moderate, wavelength_um, largest_m):
    """At 1550 nm a fifteenth: snow shows when it covers two thirds of a cell instead of a fifth."""
    _, change, _, solved = moderate
    deep = replace(change, thin_snow=ground_change.ThinSnow(None, *ground_classes.unseen_snow(wavelength_um)))
    heave_m2 = np.zeros(deep.heave_columns)
    deep = deep.updated(solved.change_m * 2.0 / change.mean_m(solved.change_m), heave_m2)
    mean_m, _ = deep.prior_m(ChangeModel(0, 9, 5, snow=1, mean=1))
    assert deep.mean_change_m == pytest.approx(2.0)
    assert mean_m[change.trend_columns] == pytest.approx(largest_m / 4)


@pytest.fixture(scope="module")
def moderate():
    return solve(1, 0.01)


def test_odds_of_models_are_those_of_the_marginal_likelihood(moderate):
    """With the line tilts and all unknowns integrated over, the residuals are normal.

    The mean change is positive if snow has fallen, and negative if ice changes alone: twice its probability.
    """
    patches, change, _, solved = moderate
    lines = np.zeros((COUNT, PARAMS.line_groups))
    lines[np.arange(COUNT), patches.jacobian.line] = patches.jacobian.sight_tilt
    state = patches.jacobian.to_sparse().toarray()
    rest = state @ PRIOR.knot_covariance @ state.T + lines @ PRIOR.line_tilt.covariance() @ lines.T
    rest += SIGMA_M**2 * np.eye(COUNT)
    design = change.design.toarray()

    def dense(model):
        precision, information = change.precision_at(model)
        prior_m2 = np.linalg.inv(precision)
        predicted = multivariate_normal(design @ prior_m2 @ information, rest + design @ prior_m2 @ design.T)
        log_odds = predicted.logpdf(patches.residual_m) + model.log_prior
        gain = prior_m2 @ design.T @ np.linalg.inv(predicted.cov)
        change_m = prior_m2 @ information + gain @ (patches.residual_m - predicted.mean)
        variance_m2 = (prior_m2 - gain @ design @ prior_m2)[0, 0]
        z = change_m[0] / np.sqrt(variance_m2)
        return log_odds + np.log(2 * norm.cdf((-z, z, 0.0)[model.snow]))

    models = (
        ChangeModel(1, 6, 3, mean=2),
        ChangeModel(0, 3, 2, snow=2),
        ChangeModel(0, 3, 2, snow=1, mean=1),
        ChangeModel(0, 5, 4, snow=1),
    )
    actual, expected = (np.diff([odds(model) for model in models]) for odds in (solved.log_odds, dense))
    assert actual == pytest.approx(expected, abs=1e-5)


def test_mixture_has_the_moments_of_all_models(moderate):
    """Moments by the law of total variance, from one dense inverse per model."""
    _, change, size, solved = moderate
    reduced, moments = solved._reduced, []
    sizes = len(ground_change.CHANGE_STEPS_M), len(ground_change.TREND_SIZES_M)
    models = [ChangeModel(*model) for model in np.ndindex(3, *sizes, 3, 3)]
    odds = np.array([solved.log_odds(model) for model in models])
    weight = np.exp(odds - odds.max())
    weight /= weight.sum()
    for model in models:
        normal, rhs = reduced.normal.copy(), reduced.rhs.copy()
        precision, information = change.precision_at(model)
        normal[size:, size:] += precision
        rhs[size:] += information
        covariance = np.linalg.inv(normal)
        moments.append((covariance @ rhs, covariance))
    mean = sum(share * estimate for share, (estimate, _) in zip(weight, moments, strict=True))
    covariance = sum(
        share * (covariance + np.outer(estimate - mean, estimate - mean))
        for share, (estimate, covariance) in zip(weight, moments, strict=True)
    )
    mixture, sigma = solved.mixture(), np.sqrt(np.diag(covariance))
    assert np.abs((mixture.estimate - mean) / sigma).max() < 0.05  # models of little weight are left out
    assert sigma_of(mixture, 6) == pytest.approx(sigma[:6], rel=0.05)


def test_part_of_the_covariance_that_comes_from_the_change_is_that_of_its_prior(moderate):
    """By propagating the prior of each model, instead of the observations, to its estimate of the change."""
    _, change, size, solved = moderate
    mixture, state, models = solved.mixture(), slice(size), solved._likely_models()
    odds = np.array([solved.log_odds(model) for model in models])
    weight = np.exp(odds - odds.max())
    from_prior = 0.0
    for share, model in zip(weight / weight.sum(), models, strict=True):
        normal, (precision, _) = solved._reduced.normal.copy(), change.precision_at(model)
        normal[size:, size:] += precision
        gain = np.linalg.inv(normal)[size:, size:] @ precision  # of the change by its prior mean
        from_prior = from_prior + share * gain @ np.linalg.inv(precision) @ gain.T
    normal = np.linalg.inv(mixture.factor.inverse())
    of_state = np.linalg.solve(normal[state, state], normal[state, size:])
    root = mixture.change_bias @ np.linalg.inv(normal[size:, size:] - normal[size:, state] @ of_state)
    assert root.T @ root == pytest.approx(from_prior, rel=1e-5, abs=1e-7 * np.abs(from_prior).max())


def test_size_of_change_follows_the_change():
    wave = np.cos(make_patches(2, 0.0).range_bin / 8)
    sizes_m = [solve(2, change_m * wave)[3].mixture().size_m for change_m in (0.0, 0.03, 0.5)]
    assert sizes_m[0] < 0.005 < sizes_m[1] < 0.15 < sizes_m[2] < 2.0


@pytest.mark.parametrize("mean_m", [-0.5, 0.1, 0.4])
def test_even_change_does_not_move_the_scanner(mean_m):
    """However large its mean is, the state and the size of the change about it hardly differ."""
    still, changed = (solve(2, change_m)[3].mixture() for change_m in (0.0, mean_m))
    state = slice(len(PARAMS.names))
    assert changed.size_m < 2 * still.size_m
    shift = (changed.estimate - still.estimate)[state] / sigma_of(changed, len(PARAMS.names))
    assert np.abs(shift).max() < 1.0


def test_change_that_looks_like_tilt_widens_sigma():
    """Settling in proportion to the distance, with a little stable ground on one side."""
    patches = make_patches(3, 0.0)
    distance_m = 80 * (patches.range_bin + 0.5)
    far = distance_m > 2000
    effect = patches.jacobian.aggregate(far / far.sum())

    def far_sigma_m(change_m):
        mixture = solve(3, change_m)[3].mixture()
        on_all = np.zeros((len(mixture.estimate), 1))
        on_all[: len(effect), 0] = effect
        return np.linalg.norm(mixture.factor.half_solve(on_all))

    assert far_sigma_m(-0.2 * distance_m / 2400) > 1.2 * far_sigma_m(0.0)


@pytest.mark.parametrize("change_m", [0.0, 0.1, -3.0])
def test_melt_that_ends_at_the_edge_of_the_ice_is_no_refraction(change_m):
    """Neighbouring bare ground has not changed; k over ice does not differ."""
    moving = PARAMS.names.index("refraction_ice")
    standardised = []
    for seed in range(12):
        mixture = solve(seed, change_m, bare_share=0.4)[3].mixture()
        standardised.append(mixture.estimate[moving] / sigma_of(mixture, moving + 1)[moving])
    assert np.abs(standardised).max() < 3


@pytest.mark.parametrize("settling_m", [0.03, 0.06])
def test_ice_that_settles_with_the_distance_does_not_move_the_scanner(settling_m):
    """By as much at 2,400 m; rock beside it is at rest. Most of the change is kept, sigma covers the rest.

    The scanner is at rest in all draws, so that z has no lower bound.
    """
    error, sigma, change = [], [], []
    for seed in range(12):
        patches = make_patches(seed, 0.0, bare_share=0.4)
        lowering_m = -settling_m * (patches.range_bin + 0.5) / 30
        mixture = solve(seed, lowering_m, bare_share=0.4)[3].mixture()
        ice = on_ice(patches)
        effect = np.zeros((len(mixture.estimate), 1))
        effect[: len(PARAMS.names), 0] = patches.jacobian.aggregate(ice / ice.sum())
        error.append(float(effect[:, 0] @ mixture.estimate))
        sigma.append(np.linalg.norm(mixture.factor.half_solve(effect)))
        change.append(lowering_m[ice].mean())
    assert np.sqrt(np.mean(np.square(error))) < 0.2 * abs(np.mean(change))
    assert abs(np.mean(error)) < 0.12 * abs(np.mean(change))
    assert np.sqrt(np.mean(np.square(np.divide(error, sigma)))) < 1.25


@pytest.mark.parametrize(
    ("ice_m", "bare_m", "log_odds"),
    [(-0.02, 0.004, (-30, -8)), (0.0, 0.004, (-5, 0)), (0.1, 0.1, (30, 100))],
)
def test_snow_raises_ice_and_bare_ground(ice_m, bare_m, log_odds):
    """Melt does not, and millimetres that rough rock shows when the beams move are no snow."""
    sizes = len(ground_change.CHANGE_STEPS_M), len(ground_change.TREND_SIZES_M)
    for seed in range(12):
        wave = 1 + np.cos(make_patches(seed, 0.0).range_bin / 6)
        *_, solved = solve(seed, ice_m * wave, bare_share=0.4, bare_change_m=bare_m * wave)
        without, snowfall = (
            max(
                solved.log_odds(ChangeModel(0, step, trend, snow, mean))
                for step, trend, mean in np.ndindex(*sizes, 3)
            )
            for snow in (0, 1)
        )
        assert log_odds[0] < snowfall - without < log_odds[1]
