"""Events over time: growth, rest, joining, and a deposit below its scar."""

import numpy as np

from station.science.time_series.event_tracks import REST_SCANS, pair_tracks, track_events
from station.science.time_series.events import BEFORE, Region

SHAPE = 40, 50
OBSERVED = SHAPE[0] * SHAPE[1]


def region(rows, columns, *, sign=1, mean_m=0.5, widespread=False):
    blocks = np.zeros(SHAPE, bool)
    blocks[rows, columns] = True
    return Region(blocks, sign, widespread, sign * mean_m, 10.0)


def test_a_region_seen_again_is_one_event_which_grows_and_rests():
    small, large = region(slice(5, 8), slice(5, 8)), region(slice(5, 10), slice(5, 10))
    (track,) = track_events(
        [(7, [small]), (8, [small]), (9, [large]), (10, [large]), (11, [large])], OBSERVED
    )
    assert (track.first, track.grew, track.last) == (7, 9, 11)
    assert np.array_equal(track.blocks, large.blocks)
    assert track.is_open(11 + REST_SCANS - 1)
    assert not track.is_open(11 + REST_SCANS)


def test_what_comes_after_rest_or_elsewhere_or_downward_is_another_event():
    here, there = region(slice(5, 8), slice(5, 8)), region(slice(20, 22), slice(5, 8))
    down = region(slice(5, 8), slice(5, 8), sign=-1)
    assert len(track_events([(7, [here, there]), (8, [down]), (7 + REST_SCANS, [here])], OBSERVED)) == 4


def test_a_region_between_two_events_joins_them():
    left, right = region(slice(5, 8), slice(5, 8)), region(slice(5, 8), slice(20, 24))
    both = region(slice(5, 8), slice(5, 24))
    (track,) = track_events([(3, [left, right]), (4, [both])], OBSERVED)
    assert track.first == 3
    assert np.array_equal(track.blocks, both.blocks)


def test_widespread_change_is_one_event_however_it_moves():
    low, high = (
        region(slice(30, 40), slice(0, 50), widespread=True),
        region(slice(0, 8), slice(0, 50), widespread=True),
    )
    assert len(track_events([(3, [low]), (4, [high])], OBSERVED)) == 1


def test_a_loss_that_moves_over_a_quarter_of_the_ground_is_a_widespread_front():
    """Whatever is found of it at first; a later local loss far away is another event."""
    strips = [region(slice(40 - 4 * n, 46 - 4 * n), slice(0, 50), sign=-1) for n in range(1, 8)]
    everywhere = region(slice(8, 40), slice(0, 50), sign=-1, widespread=True)
    found = [(n, [strip]) for n, strip in enumerate(strips)]
    (slow,) = track_events(found[:2], OBSERVED)
    assert not slow.widespread
    found[3][1].append(everywhere)
    (front,) = track_events(found, OBSERVED)
    assert front.widespread
    assert (front.first, front.last) == (0, 6)
    assert np.count_nonzero(front.blocks) > OBSERVED / 2
    far = region(slice(0, 3), slice(10, 13), sign=-1)
    assert len(track_events([*found, (7, [far])], OBSERVED)) == 2


def test_local_loss_at_the_edge_of_widespread_loss_is_part_of_it_unless_it_is_deeper():
    edge, scar = (
        region(slice(5, 8), slice(5, 9), sign=-1),
        region(slice(5, 8), slice(20, 24), sign=-1, mean_m=2),
    )
    later = region(slice(36, 38), slice(0, 9), sign=-1)
    melt = region(slice(4, 36), slice(0, 50), sign=-1, widespread=True)
    tracks = track_events([(3, [edge, scar]), (4, [melt, scar]), (5, [later])], OBSERVED)
    assert {(track.first, track.last, track.widespread) for track in tracks} == {(3, 5, True), (3, 4, False)}
    snow = region(slice(4, 36), slice(0, 50), widespread=True)
    assert len(track_events([(3, [region(slice(5, 8), slice(5, 9))]), (4, [snow])], OBSERVED)) == 2


def test_local_loss_is_where_widespread_loss_began_if_that_was_compared_with_scans_before_it():
    begin, melt = (
        region(slice(5, 8), slice(5, 9), sign=-1, mean_m=0.1),
        region(slice(4, 36), slice(0, 50), sign=-1, widespread=True),
    )
    (track,) = track_events([(3, [begin]), (3 + BEFORE, [melt])], OBSERVED)
    assert (track.first, track.last) == (3, 3 + BEFORE)
    assert len(track_events([(3, [begin]), (4 + BEFORE, [melt])], OBSERVED)) == 2


def test_a_deposit_is_paired_with_the_nearest_scar_above():
    elevation_m = np.repeat(3000.0 - 5 * np.arange(SHAPE[0]), SHAPE[1]).reshape(SHAPE)
    scar, deposit = region(slice(5, 8), slice(5, 8), sign=-1), region(slice(20, 23), slice(6, 9))
    far, below = region(slice(2, 4), slice(40, 44), sign=-1), region(slice(36, 38), slice(5, 8), sign=-1)
    tracks = track_events([(3, [scar, deposit, far, below])], OBSERVED)
    assert pair_tracks(tracks, elevation_m, 10.0) == {0: 1, 1: 0}
    assert pair_tracks(tracks, elevation_m, 100.0) == {}  # more than 500 m apart
    late = track_events([(3, [scar]), (6, [deposit])], OBSERVED)
    assert pair_tracks(late, elevation_m, 10.0) == {}
