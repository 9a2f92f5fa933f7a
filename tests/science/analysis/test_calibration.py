"""Calibration of sigma: statistics of simulated standardised errors, and weighted sums of cells."""

import numpy as np
import pytest
from scipy import sparse

from station.quantities import Grid, SharedParameters
from station.science.analysis import calibration
from station.science.uncertainty.jacobian import height_jacobian
from station.science.uncertainty.parameters import parameter_layout
from station.science.uncertainty.propagation import aggregate_variance

GRID = Grid(west_m=600.0, north_m=1600.0, cell_m=10.0, nx=40, ny=30)
PARAMS = parameter_layout(GRID, (0.0, 0.0, 3000.0))


def test_z_statistics_of_normal_errors_and_of_outliers():
    z = np.random.default_rng(1).normal(size=20_000)
    statistics = calibration.z_statistics(np.append(z, np.nan))
    assert (statistics.z_std, statistics.z_robust) == pytest.approx((1.0, 1.0), abs=0.02)
    assert statistics.inside_95 == pytest.approx(0.95, abs=0.005)
    assert statistics.count == 20_000
    z[:400] = 30.0
    with_outliers = calibration.z_statistics(z)
    assert with_outliers.z_std > 4
    assert with_outliers.z_robust == pytest.approx(1.0, abs=0.05)
    assert np.isnan(calibration.z_statistics(z[:5]).z_std)


@pytest.mark.parametrize(("true", "advised"), [(1.0, False), (1.05, False), (1.6, True), (0.5, True)])
@pytest.mark.parametrize("per_epoch", [300, 1])
def test_sigma_scale_recovers_the_factor(true, advised, per_epoch):
    """With many cells per epoch, and with one mean per epoch."""
    rng = np.random.default_rng(2)
    epochs = [true * rng.normal(size=per_epoch) for _ in range(120)]
    scale = calibration.sigma_scale(epochs)
    assert scale.factor == pytest.approx(true, rel=0.15 if per_epoch == 1 else 0.03)
    assert scale.low < scale.factor < scale.high
    assert scale.advised == advised
    assert not calibration.sigma_scale(epochs[:5]).advised  # too few epochs


@pytest.mark.integration
def test_interval_of_the_scale_covers_the_true_factor_in_95_percent():
    rng = np.random.default_rng(3)
    for per_epoch, repetitions in ((1, 400), (200, 200)):
        covers = [
            (scale := calibration.sigma_scale([rng.normal(size=per_epoch) for _ in range(25)])).low
            <= 1
            <= scale.high
            for _ in range(repetitions)
        ]
        assert np.mean(covers) == pytest.approx(0.95, abs=0.04)
    assert np.isnan(calibration.sigma_scale([]).factor)


def test_errors_common_to_an_epoch_count_in_the_scale_and_its_interval():
    rng = np.random.default_rng(7)
    epochs = [rng.normal() + rng.normal(size=300) for _ in range(200)]
    scale = calibration.sigma_scale(epochs)
    assert scale.factor == pytest.approx(np.sqrt(2), rel=0.08)
    assert scale.low < np.sqrt(2) < scale.high
    assert scale.high - scale.low > 0.1  # 200 epochs, not 60,000 cells


@pytest.mark.parametrize("farthest_m", [37.0, 560.0, 4500.0])
def test_range_bands_cover_all_ranges(farthest_m):
    bands = calibration.range_bands(np.array([1.0, farthest_m]))
    assert bands[0][0] == 0
    assert bands[-1][0] <= farthest_m < bands[-1][1]
    assert 3 <= len(bands) <= 6
    assert [high for _, high in bands[:-1]] == [low for low, _ in bands[1:]]


def random_sample(count=120):
    rng = np.random.default_rng(4)
    x, y = rng.uniform(600, 1000, count), rng.uniform(1300, 1600, count)
    offset_m = x, y, rng.uniform(-500, 0, count)
    jacobian = height_jacobian(PARAMS, offset_m, rng.normal(0, 0.3, count), rng.normal(0, 0.3, count))
    sigma = np.full(len(PARAMS.names), 1e-4)
    root = sigma[:, None] * rng.normal(size=(len(sigma), 2 * len(sigma)))
    noise = np.zeros(len(sigma))
    noise[10 : 10 + PARAMS.knot_intervals] = 1e-9
    return (
        x,
        y,
        jacobian,
        SharedParameters(PARAMS.names, PARAMS.units, 0 * sigma, root @ root.T, noise),
        rng.uniform(0, 1e-3, count),
    )


def test_variances_of_many_sums_match_those_of_single_sums():
    x, y, jacobian, shared, random_m2 = random_sample()
    weights = sparse.vstack(
        [
            calibration.block_means(x, y, 100.0),
            calibration.group_means(np.zeros(120, int)),
            calibration.pair_differences(np.array([3, 5]), np.array([70, 9]), 120),
        ]
    ).tocsr()  # fmt: skip
    actual = calibration.SparseJacobian(jacobian).sums(weights).variance(random_m2, shared)
    expected = [aggregate_variance(row, random_m2, jacobian, shared) for row in weights.toarray()]
    assert actual == pytest.approx(expected, rel=1e-9)


def test_block_means_and_renormalisation_over_observed_cells():
    x, y = np.meshgrid(GRID.x_m, GRID.y_m)
    weights = calibration.block_means(x.ravel(), y.ravel(), 100.0)
    assert weights.shape == (12, 1200)
    assert np.unique((weights @ x.ravel()).round(6)) == pytest.approx([650.0, 750.0, 850.0, 950.0])
    observed = np.random.default_rng(5).uniform(size=1200) < 0.4
    kept, share = calibration.renormalise(weights, observed)
    assert share == pytest.approx(weights @ observed)
    assert np.asarray(kept.sum(axis=1)).ravel() == pytest.approx(np.ones(12))
    assert not kept.toarray()[:, ~observed].any()


def test_sampled_pairs_belong_to_their_distance_class():
    x, y = (axis.ravel() for axis in np.meshgrid(GRID.x_m, GRID.y_m))
    edges_m = np.array([10.0, 50.0, 200.0, 400.0])
    first, second, distance_class = calibration.sample_pairs(x, y, edges_m, 150, seed=6)
    distance_m = np.hypot(x[first] - x[second], y[first] - y[second])
    assert (distance_m >= edges_m[distance_class]).all()
    assert (distance_m < edges_m[distance_class + 1]).all()
    assert np.bincount(distance_class).tolist() == [150, 150, 150]
    assert [len(part) for part in calibration.sample_pairs(x[:1], y[:1], edges_m, 5, seed=6)] == [0, 0, 0]
