"""What is said of sigma, where the truth is drawn."""

import numpy as np
import pytest
from scipy import sparse

from station.quantities import Grid, Shared
from station.science import calibration, shared

GRID = Grid(west_m=600.0, north_m=1600.0, cell_m=10.0, nx=40, ny=30)
OF = shared.basis(GRID, (0.0, 0.0, 3000.0))


def test_a_standard_normal_fits_and_outliers_show():
    z = np.random.default_rng(1).normal(size=20_000)
    told = calibration.fit(np.append(z, np.nan))
    assert (told.z_std, told.z_robust) == pytest.approx((1.0, 1.0), abs=0.02)
    assert told.inside_95 == pytest.approx(0.95, abs=0.005)
    assert told.count == 20_000
    z[:400] = 30.0
    spoilt = calibration.fit(z)
    assert spoilt.z_std > 4
    assert spoilt.z_robust == pytest.approx(1.0, abs=0.05)
    assert np.isnan(calibration.fit(z[:5]).z_std)


@pytest.mark.parametrize(("true", "advised"), [(1.0, False), (1.05, False), (1.6, True), (0.5, True)])
@pytest.mark.parametrize("each", [300, 1])
def test_the_factor_by_which_sigma_is_wrong(true, advised, each):
    """Of many cells an epoch, and of one mean an epoch."""
    rng = np.random.default_rng(2)
    epochs = [true * rng.normal(size=each) for _ in range(120)]
    told = calibration.scale(epochs)
    assert told.factor == pytest.approx(true, rel=0.15 if each == 1 else 0.03)
    assert told.low < told.factor < told.high
    assert told.advised == advised
    assert not calibration.scale(epochs[:5]).advised  # too early to say


def test_its_interval_holds_the_truth_nineteen_times_of_twenty():
    rng = np.random.default_rng(3)
    for each, rounds in ((1, 400), (200, 200)):
        held = [
            (told := calibration.scale([rng.normal(size=each) for _ in range(25)])).low <= 1 <= told.high
            for _ in range(rounds)
        ]
        assert np.mean(held) == pytest.approx(0.95, abs=0.04)
    assert np.isnan(calibration.scale([]).factor)


def test_what_all_cells_of_an_epoch_have_in_common_counts():
    rng = np.random.default_rng(7)
    epochs = [rng.normal() + rng.normal(size=300) for _ in range(200)]
    told = calibration.scale(epochs)
    assert told.factor == pytest.approx(np.sqrt(2), rel=0.08)
    assert told.low < np.sqrt(2) < told.high
    assert told.high - told.low > 0.1  # 200 epochs, not 60,000 cells


@pytest.mark.parametrize("farthest_m", [37.0, 560.0, 4500.0])
def test_bands_of_range_hold_every_cell(farthest_m):
    bands = calibration.range_bands(np.array([1.0, farthest_m]))
    assert bands[0][0] == 0
    assert bands[-1][0] <= farthest_m < bands[-1][1]
    assert 3 <= len(bands) <= 6
    assert [high for _, high in bands[:-1]] == [low for low, _ in bands[1:]]


def sample(count=120):
    rng = np.random.default_rng(4)
    x, y = rng.uniform(600, 1000, count), rng.uniform(1300, 1600, count)
    offset_m = x, y, rng.uniform(-500, 0, count)
    felt = shared.sensitivities(OF, offset_m, rng.normal(0, 0.3, count), rng.normal(0, 0.3, count))
    sigma = np.full(len(OF.names), 1e-4)
    root = sigma[:, None] * rng.normal(size=(len(sigma), 2 * len(sigma)))
    noise = np.zeros(len(sigma))
    noise[9 : 9 + OF.intervals] = 1e-9
    return (
        x,
        y,
        felt,
        Shared(OF.names, OF.units, 0 * sigma, root @ root.T, noise),
        rng.uniform(0, 1e-3, count),
    )


def test_many_sums_at_once_are_each_alone():
    x, y, felt, unknown, random_m2 = sample()
    weights = sparse.vstack(
        [
            calibration.blocks(x, y, 100.0),
            calibration.means(np.zeros(120, int)),
            calibration.differences(np.array([3, 5]), np.array([70, 9]), 120),
        ]
    ).tocsr()  # fmt: skip
    told = calibration.Felt(felt).sums(weights).variance(random_m2, unknown)
    alone = [shared.aggregate_variance(row, random_m2, felt, unknown) for row in weights.toarray()]
    assert told == pytest.approx(alone, rel=1e-9)


def test_blocks_take_means_and_forget_what_was_not_seen():
    x, y = np.meshgrid(GRID.x_m, GRID.y_m)
    weights = calibration.blocks(x.ravel(), y.ravel(), 100.0)
    assert weights.shape == (12, 1200)
    assert np.unique((weights @ x.ravel()).round(6)) == pytest.approx([650.0, 750.0, 850.0, 950.0])
    seen = np.random.default_rng(5).uniform(size=1200) < 0.4
    kept, share = calibration.renormalised(weights, seen)
    assert share == pytest.approx(weights @ seen)
    assert np.asarray(kept.sum(axis=1)).ravel() == pytest.approx(np.ones(12))
    assert not kept.toarray()[:, ~seen].any()


def test_pairs_lie_in_their_class_of_distance():
    x, y = (axis.ravel() for axis in np.meshgrid(GRID.x_m, GRID.y_m))
    edges_m = np.array([10.0, 50.0, 200.0, 400.0])
    first, second, of = calibration.pairs(x, y, edges_m, 150, seed=6)
    away_m = np.hypot(x[first] - x[second], y[first] - y[second])
    assert (away_m >= edges_m[of]).all()
    assert (away_m < edges_m[of + 1]).all()
    assert np.bincount(of).tolist() == [150, 150, 150]
    assert [len(part) for part in calibration.pairs(x[:1], y[:1], edges_m, 5, seed=6)] == [0, 0, 0]
