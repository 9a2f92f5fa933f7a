"""Events anywhere on the grid: power, false alarms and extent on simulated blocks of 10 m."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from station.science.time_series.event_tracks import track_events
from station.science.time_series.events import (
    BlockErrors,
    BlockLevels,
    before_level,
    detect_regions,
    distance_blocks,
    event_thresholds,
    overlaps,
)
from station.science.time_series.surroundings import surrounding_weights, surroundings
from station.science.time_series.window_scores import (
    BlockChange,
    block_weights,
    scan_differences,
    window_scatter,
)

SHAPE = 60, 80
HOURS_PER_YEAR = 8766
ROW, COLUMN = np.indices(SHAPE)
RANGE_M = 10.0 * np.hypot(ROW - 30, COLUMN + 20)
ROCK = COLUMN < 16
SIGMA_M = 0.004 + 0.01 * RANGE_M / 1000  # of a block, in one scan
THRESHOLDS = event_thresholds(ROCK.size, HOURS_PER_YEAR)


class Valley:
    """Scans of a valley: random errors with heavy tails, tilt, and stripes along the line of sight."""

    def __init__(self, seed, *, heavy=True, systematic_rad=5e-6):
        self.rng = np.random.default_rng(seed)
        self.heavy, self.systematic_rad = heavy, systematic_rad
        self.azimuth = np.arctan2(ROW - 30, COLUMN + 20)
        self.unseen = ndimage.gaussian_filter(self.rng.normal(size=SHAPE), 4) > 0.12

    def scan(self, surface_m=0.0):
        noise = self.rng.standard_t(5, SHAPE) / np.sqrt(5 / 3) if self.heavy else self.rng.normal(size=SHAPE)
        stripes = np.interp(
            self.azimuth.ravel(), np.linspace(-1.6, 1.6, 90), self.rng.normal(size=90) * self.systematic_rad
        ).reshape(SHAPE)
        tilt = self.rng.normal(size=2) * self.systematic_rad
        errors = RANGE_M * (stripes + tilt[0] * np.cos(self.azimuth) + tilt[1] * np.sin(self.azimuth))
        change = surface_m + errors + SIGMA_M * noise
        hidden = self.unseen | (self.rng.random(SHAPE) < 0.02)
        return BlockLevels(np.where(hidden, np.nan, change), SIGMA_M**2)

    @property
    def systematic_m2(self):
        return (2 * self.systematic_rad * RANGE_M) ** 2

    def regions(self, scans):
        errors = BlockErrors(*[self.systematic_m2] * 3)
        return detect_regions(scans[:-2], scans[-2:], (errors, errors), ROCK, THRESHOLDS)


def disc(row, column, area_m2, depth_m):
    """Mean depth by block of a disc of an area."""
    fine = 10
    y, x = (np.indices((SHAPE[0] * fine, SHAPE[1] * fine)) + 0.5) / fine
    inside = (y - row) ** 2 + (x - column) ** 2 < area_m2 / 100 / np.pi
    return depth_m * inside.reshape(SHAPE[0], fine, SHAPE[1], fine).mean(axis=(1, 3))


@pytest.mark.parametrize("heavy", [False, True])
@pytest.mark.integration
def test_quiet_hours_have_no_event(heavy):
    for seed in range(4):
        valley = Valley(seed, heavy=heavy)
        scans = [valley.scan() for _ in range(20)]
        for last in range(10, 21):
            assert valley.regions(scans[:last]) == []


@pytest.mark.integration
def test_a_small_deposit_is_found_by_the_second_scan_anywhere():
    """0.3 m over 500 m²; where at least 60 % of it is seen."""
    found = seen = 0
    for seed in range(12):
        valley = Valley(seed)
        row, column = valley.rng.uniform(4, SHAPE[0] - 4), valley.rng.uniform(4, SHAPE[1] - 4)
        deposit = disc(row, column, 500, 0.3)
        if deposit[~valley.unseen].sum() < 0.6 * deposit.sum():
            continue
        before = [valley.scan() for _ in range(10)]
        assert valley.regions([*before, valley.scan(), valley.scan(deposit)]) == []
        regions = valley.regions([*before, valley.scan(deposit), valley.scan(deposit)])
        seen += 1
        found += len(regions) == 1 and regions[0].sign == 1 and overlaps(regions[0].blocks, deposit > 0.1)
        assert not any(region.widespread for region in regions)
    assert seen >= 5
    assert found == seen


def test_a_large_avalanche_is_one_region():
    valley = Valley(3)
    deposit = disc(40, 50, 30_000, 2.0)
    regions = valley.regions(
        [*(valley.scan() for _ in range(10)), valley.scan(deposit), valley.scan(deposit)]
    )
    assert [region.sign for region in regions] == [1]
    visible = ~valley.unseen & (deposit > 1.0)
    assert np.count_nonzero(regions[0].blocks & visible) > 0.95 * np.count_nonzero(visible)
    assert regions[0].mean_m == pytest.approx(1.85, abs=0.15)


def test_steady_melt_is_widespread_and_no_local_event():
    """Ice melts by 1 cm an hour, 50 % more or less from place to place; rock does not."""
    valley = Valley(5)
    patches = 1 + 0.5 * ndimage.gaussian_filter(valley.rng.normal(size=SHAPE), 3) / 0.094
    rate_m = np.where(ROCK, 0.0, -0.01 * patches)
    scans = [valley.scan(hour * rate_m) for hour in range(12)]
    regions = valley.regions(scans)
    assert [(region.widespread, region.sign) for region in regions] == [(True, -1)]
    assert np.mean(ROCK[regions[0].blocks]) < 0.05
    true_m = 3.5 * rate_m[regions[0].blocks].mean()  # from amid six scans to the next
    assert regions[0].mean_m == pytest.approx(true_m, rel=0.1)


def test_snowfall_is_widespread_and_hides_no_avalanche():
    valley = Valley(6)
    drifts = 0.1 * (1 + 0.3 * ndimage.gaussian_filter(valley.rng.normal(size=SHAPE), 3) / 0.094)
    after = drifts + disc(30, 50, 6000, 1.5)
    regions = valley.regions([*(valley.scan() for _ in range(10)), valley.scan(after), valley.scan(after)])
    assert [(region.widespread, region.sign) for region in regions] == [(True, 1), (False, 1)]
    assert np.count_nonzero(regions[1].blocks) == pytest.approx(60, abs=20)


@pytest.mark.integration
def test_slow_snowfall_is_widespread_while_it_lasts():
    """2 cm an hour off steep ground, 2 to 4 cm of systematic σ: the hours just before do not show it."""
    valley = Valley(7, systematic_rad=3e-5)
    flat = ROW < 40
    scans = [valley.scan(0.02 * max(0, min(hour - 10, 18)) * flat) for hour in range(38)]
    found = {last: valley.regions(scans[max(last - 25, 0) : last + 1]) for last in range(9, 38)}
    assert not any(found[last] for last in range(9, 12))
    for last in range(20, 28):
        (snow,) = found[last]
        assert (snow.widespread, snow.sign) == (True, 1)
        assert np.mean(flat[snow.blocks]) > 0.95
    assert np.count_nonzero(snow.blocks) > 0.8 * np.count_nonzero(flat & ~valley.unseen)
    assert snow.lag == 18
    assert snow.mean_m == pytest.approx(0.02 * (26 - 10), abs=0.05)
    assert not any(found[last] for last in range(34, 38))


@pytest.mark.integration
def test_quiet_hours_with_large_systematic_errors_are_no_snowfall():
    for seed in range(4):
        valley = Valley(40 + seed, systematic_rad=3e-5)
        scans = [valley.scan() for _ in range(40)]
        assert not any(valley.regions(scans[max(last - 25, 0) : last + 1]) for last in range(9, 40))


@pytest.mark.integration
@pytest.mark.parametrize("rows_per_h", [2, 3, 10, 20])
def test_an_edge_of_melt_that_moves_over_hours_is_one_front(rows_per_h):
    """Snow of 0.3 m goes behind an edge that climbs: too little at once, or nearly everything."""
    valley = Valley(11)
    scans = []
    for hour in range(30):
        behind = np.clip((ROW - SHAPE[0] + rows_per_h * max(hour - 10, 0)) / 3, 0, 1)
        scans.append(valley.scan(np.where(ROCK, 0.0, -0.3 * behind)))
    found = ((last, valley.regions(scans[max(last - 25, 0) : last + 1])) for last in range(9, 30))
    front = max(track_events(found, ROCK.size), key=lambda track: np.count_nonzero(track.blocks))
    assert (front.widespread, front.sign) == (True, -1)
    passed = min(19 * rows_per_h, SHAPE[0]) / SHAPE[0]
    assert np.count_nonzero(front.blocks) > 0.8 * passed * np.count_nonzero(~ROCK & ~valley.unseen)


def test_what_stays_while_its_surroundings_change_is_no_event():
    """Ground that snow does not reach is no loss; of a scar beside it more than the snow is missing."""
    valley = Valley(9)
    for surface_m, signs in (
        (np.where(disc(30, 45, 3000, 1.0) > 0, 0.0, 0.2), [1]),
        (np.where(disc(30, 45, 3000, 1.0) > 0, -1.0, 0.2), [1, -1]),
    ):
        before = [valley.scan() for _ in range(10)]
        regions = valley.regions([*before, valley.scan(surface_m), valley.scan(surface_m)])
        assert [region.sign for region in regions] == signs


def test_noise_beside_a_large_event_is_no_event_of_its_own():
    """Blocks that scatter by 0.05 m, half of the change of the windows of 130 m that reach the event."""
    valley = Valley(1)
    deposit = disc(30, 45, 4000, 1.0)
    scans = [valley.scan(0.05 * valley.rng.normal(size=SHAPE) + (hour >= 24) * deposit) for hour in range(26)]
    (region,) = valley.regions(scans)
    assert overlaps(region.blocks, deposit > 0.1)


def test_a_level_has_the_variance_of_a_median():
    rng = np.random.default_rng(0)
    levels = [BlockLevels(0.02 * rng.normal(size=SHAPE), np.full(SHAPE, 4e-4)) for _ in range(7)]
    level = before_level(levels)
    assert np.std(level.change_m / np.sqrt(level.random_m2)) == pytest.approx(0.95, abs=0.07)
    assert np.isnan(before_level(levels[:2]).change_m).all()


def test_scatter_of_windows_is_that_of_consecutive_scans_whatever_the_trend():
    rng = np.random.default_rng(0)
    hour = np.arange(24)[:, None, None]
    noise = 0.02 * rng.normal(size=(24, 40, 50))
    step = np.where(hour >= 12, 1.0, 0.0) * (np.indices((40, 50))[0] < 3)
    equal = np.ones((40, 50))
    for size in (1, 2, 5):
        scatter_m2 = window_scatter(scan_differences(noise - 0.1 * hour + step), size, equal)
        expected_m = 0.02 / size
        assert scatter_m2.shape == (41 - size, 51 - size)
        assert expected_m < np.median(np.sqrt(scatter_m2)) < 1.2 * expected_m
    edge = np.where(rng.random((24, 40, 50)) < 0.3, 0.6, 0.0)
    assert np.sqrt(window_scatter(scan_differences(noise + edge), 1, equal)).min() > 0.2


def test_weighted_means_of_windows_scatter_as_means_of_least_variance_do():
    """One block of four has ten times the σ: √(1 / (3 / σ² + 1 / (10 σ)²)), the plain mean 2.5 σ."""
    sigma_m = np.where((ROW % 2 == 0) & (COLUMN % 2 == 0), 0.2, 0.02)
    weights = block_weights([BlockChange(np.zeros(SHAPE), sigma_m**2, np.zeros(SHAPE))], ROCK)
    noise = np.random.default_rng(0).normal(0, sigma_m, (25, *SHAPE))
    scatter_m = np.sqrt(np.median(window_scatter(scan_differences(noise), 2, weights)))
    assert 1.0 < scatter_m / (0.02 / np.sqrt(3.01)) < 1.2  # at least the mean of nine windows


def test_no_block_is_most_of_a_window_because_its_stated_sigma_is_small():
    sigma_m = np.full(SHAPE, 0.02)
    sigma_m[30, 40] = 0.0002
    weights = block_weights([BlockChange(np.zeros(SHAPE), sigma_m**2, np.zeros(SHAPE))], ROCK)
    assert weights[30, 40] / weights[30, 41] == pytest.approx(4.0)


def test_blocks_at_an_edge_raise_no_event():
    """Beams that move a little hit either side of a rock step of 1.2 m, along a whole column."""
    valley = Valley(8)
    scans = []
    for _ in range(26):
        shifted = np.where(
            (COLUMN > 40) & (COLUMN < 44) & (valley.rng.random(SHAPE[1]) < 0.3)[None, :], 1.2, 0.0
        )
        scans.append(valley.scan(shifted))
    for last in range(12, 27):
        assert valley.regions(scans[:last]) == []


def found_and_seen(seeds, deposit_of, scan_of):
    """Return how many deposits are found, and how many are seen by 60 %; without them nothing is found."""
    found = seen = 0
    for seed in range(seeds):
        valley = Valley(seed)
        row, column = valley.rng.uniform(8, SHAPE[0] - 8), valley.rng.uniform(24, SHAPE[1] - 8)
        deposit = deposit_of(row, column)
        if deposit[~valley.unseen].sum() < 0.6 * deposit.sum():
            continue
        scans = [scan_of(valley, (number >= 24) * deposit) for number in range(26)]
        assert valley.regions(scans[:24]) == []
        regions = valley.regions(scans)
        seen += 1
        found += len(regions) == 1 and overlaps(regions[0].blocks, deposit > 0.1)
    return found, seen


def test_scatter_beyond_sigma_averages_out_over_an_event_and_is_none_itself():
    """Rough rock, hit otherwise in each scan: blocks scatter by 0.1 m, three times their sigma and more."""
    found, seen = found_and_seen(
        6,
        lambda row, column: disc(row, column, 3000, 0.4),
        lambda valley, surface_m: valley.scan(surface_m + 0.1 * valley.rng.normal(size=SHAPE)),
    )
    assert found == seen >= 4


@pytest.mark.integration
def test_a_small_deposit_is_found_among_blocks_of_very_different_sigma():
    """Every third block has σ of 0.25 m: with one of them the plain mean of four has 0.07 m."""
    sigma_m = np.where((ROW + 2 * COLUMN) % 3 == 0, 0.25, 0.03)
    found, seen = found_and_seen(
        8,
        lambda row, column: disc(row, column, 500, 0.3),
        lambda valley, surface_m: replace(
            valley.scan(surface_m + valley.rng.normal(0, sigma_m)), random_m2=SIGMA_M**2 + sigma_m**2
        ),
    )
    assert found == seen >= 4


def test_surroundings_do_not_follow_the_few_blocks_of_a_tile_that_is_mostly_other_ground():
    values = np.where(COLUMN % 10 < 2, 0.6, 0.0)
    around = surroundings(values, (COLUMN < 10) | (COLUMN == 10))
    assert np.abs(around[COLUMN <= 10]).max() == 0


def test_surroundings_are_those_of_the_same_ground():
    values = np.where(ROCK, 0.0, 0.3 - 0.002 * COLUMN)
    around = surroundings(values + disc(30, 50, 20_000, 3.0), ROCK)
    assert around[ROCK] == pytest.approx(0.0, abs=1e-9)
    assert around[~ROCK][::7] == pytest.approx(values[~ROCK][::7], abs=0.04)


def test_weights_take_off_what_surrounds_a_region():
    blocks = disc(30, 40, 3000, 1.0) > 0.5
    weights = surrounding_weights(blocks, ~ROCK)
    assert np.sum(weights * (0.7 + 2.0 * blocks)) == pytest.approx(2.0)
    assert surrounding_weights(blocks, np.zeros(SHAPE, bool)).sum() == pytest.approx(1.0)


def test_distance_and_overlap_count_blocks():
    first, second = np.zeros((2, *SHAPE), bool)
    first[10, 10], second[10, 15] = True, True
    assert distance_blocks(first, second) == 5
    assert not overlaps(first, second, 4)
    assert overlaps(first, second, 5)
