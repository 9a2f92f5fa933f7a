"""Volume of an event against its truth, on ground whose blocks are of very different σ."""

import numpy as np
import pytest

from station.science.time_series.event_tracks import Track
from station.science.time_series.event_volumes import mean_level, volume_parts
from station.science.time_series.events import BlockLevels

SHAPE = 60, 70
ROW, COLUMN = np.indices(SHAPE)
ROCK, OTHERS, SURFACE = np.zeros(SHAPE, bool), np.zeros(SHAPE, bool), np.ones(SHAPE, bool)


def track_of(blocks, *, widespread=False):
    return Track(9, 10, 10, blocks, 1, widespread, 9.0, 1.0, 0.3, 0)


def deposit(centre_row, centre_column):
    """Return 0.3 m over 500 m² as the means of blocks of 10 m."""
    fine = (np.arange(10) + 0.5) / 10
    row = (ROW[..., None, None] + fine[:, None]) - centre_row
    column = (COLUMN[..., None, None] + fine) - centre_column
    return 0.3 * (row**2 + column**2 < 5 / np.pi).mean(axis=(2, 3))


def draws(sigma_m, number=300, surface_m=0.0):
    """Return volumes, their σ and the truth, each (n,) [blocks · m], of deposits at random places."""
    rng = np.random.default_rng(1)
    values = []
    for _ in range(number):
        true_m = deposit(*rng.uniform(25, 35, 2))
        change = BlockLevels(true_m + surface_m + sigma_m * rng.normal(size=SHAPE), sigma_m**2)
        seen = (true_m > 0.1) & (change.change_m - surface_m > 0.1)
        parts = volume_parts(track_of(seen), change, ROCK, OTHERS, SURFACE)
        values.append((parts.sum_m, np.sqrt(parts.variance_m2), true_m.sum()))
    return np.array(values).T


def test_a_volume_on_smooth_ground_is_that_of_all_blocks_it_touches():
    volume, sigma, true = draws(np.full(SHAPE, 0.01))
    assert 0.8 < np.std((volume - true) / sigma) < 1.25
    assert np.mean(volume) == pytest.approx(np.mean(true), rel=0.01)


def test_the_edge_adds_no_more_noise_than_an_event_can_have_there():
    """Every other block has σ of 0.3 m, as much as the event is deep; 36 blocks and more are around it."""
    sigma_m = np.where((ROW + COLUMN) % 2 == 0, 0.3, 0.03)
    volume, sigma, true = draws(sigma_m)
    z = (volume - true) / sigma
    assert 0.8 < np.sqrt(np.mean(z**2)) < 1.25
    assert np.abs(np.mean(volume) / np.mean(true) - 1) < 0.1
    assert np.mean(sigma) < 0.5 * np.sqrt(36 / 2) * 0.3  # half of a plain sum over these


def test_what_surrounds_an_event_is_no_part_of_it():
    volume, sigma, true = draws(np.full(SHAPE, 0.02), surface_m=0.5)
    assert 0.8 < np.std((volume - true) / sigma) < 1.25


def test_widespread_change_counts_in_full():
    level = BlockLevels(np.full(SHAPE, 0.2), np.full(SHAPE, 1e-4))
    parts = volume_parts(track_of(SURFACE, widespread=True), level, ROCK, OTHERS, SURFACE)
    assert parts.sum_m == pytest.approx(0.2 * SURFACE.size)
    assert parts.variance_m2 == pytest.approx(1e-4 * SURFACE.size)


def test_an_event_that_no_scan_observed_has_no_volume():
    level = BlockLevels(np.full(SHAPE, np.nan), np.zeros(SHAPE))
    assert volume_parts(track_of(ROW < 3), level, ROCK, OTHERS, SURFACE) is None


def test_the_mean_of_two_scans_is_that_of_one_where_the_other_saw_nothing():
    first, second = np.full(SHAPE, 1.0), np.full(SHAPE, 2.0)
    second[:10], first[5:15] = np.nan, np.nan
    level = mean_level(BlockLevels(first, np.full(SHAPE, 4.0)), BlockLevels(second, np.full(SHAPE, 2.0)))
    assert level.change_m[[0, 12, 20], 0].tolist() == [1.0, 2.0, 1.5]
    assert level.random_m2[[0, 12, 20], 0].tolist() == [4.0, 2.0, 1.5]
    assert np.isnan(level.change_m[7]).all()
