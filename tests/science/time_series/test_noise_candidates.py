"""Which process noise is the likeliest, against Bayes' theorem by hand, and after the weather has changed."""

import numpy as np
import pytest

from station.science.time_series.noise_candidates import MEMORY_D, NoiseCandidates

EXPECTED_M2 = np.array([[1.0], [4.0]])


def two_candidates():
    return NoiseCandidates((1e-5, 1e-3), (1e-6,), 0)


def test_probabilities_are_those_of_bayes_and_of_a_change_of_the_weather():
    candidates = two_candidates()
    candidates.learn(0.0, np.zeros((2, 1)), EXPECTED_M2)  # densities 1 and 1/2
    assert candidates.probability == pytest.approx([2 / 3, 1 / 3])
    candidates.learn(MEMORY_D * np.log(2), np.zeros((2, 1)), EXPECTED_M2)  # 4/5 and 1/5, half of it kept
    assert candidates.probability == pytest.approx([0.65, 0.35])
    assert candidates.likeliest.level_m2_d == 1e-5


def test_another_candidate_is_the_likeliest_after_two_scans_however_long_it_was_not():
    candidates = two_candidates()
    for _ in range(2000):
        candidates.learn(1 / 24, np.zeros((2, 1)), EXPECTED_M2)
    assert candidates.best == 0
    assert candidates.probability[1] > 0.001
    for _ in range(2):
        candidates.learn(1 / 24, np.full((2, 1), 3.5), EXPECTED_M2)
    assert candidates.best == 1


def test_what_was_learned_is_restored():
    candidates, again = two_candidates(), two_candidates()
    candidates.learn(1.0, np.full((2, 1), 5.0), EXPECTED_M2)
    again.restore(candidates.to_array())
    assert again.best == candidates.best == 1
    assert np.array_equal(again.probability, candidates.probability)
