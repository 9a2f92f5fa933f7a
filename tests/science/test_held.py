"""How far noise of the cells holds a scan: against many simulated scans of nothing but noise."""

import math
from functools import cache

import numpy as np
import pytest

from station.quantities import Habits
from station.science import prior, shared
from station.science.adjustment import adjust
from station.science.held import share
from station.science.patches import Cells, Kind, Patches, collect

OF = shared.Basis(math.radians(20), 20, closed=False)
STILL = np.zeros((3, OF.line_count))
BEFORE = prior.beforehand(
    OF, prior.lines_of(OF, np.eye(3), None), Habits(translation_m=0.1, range_bias_m=0.1), weather_known=True
)
PATCHES, CELLS, SIGMA_M = 600, 16.0, 0.08  # noise of a patch 20 mm, ten times what patches differ by at least


@cache
def place(seed):
    """Places in the sector, one to a group of lines and a stretch of range, and their slopes."""
    rng = np.random.default_rng(seed)
    at = rng.choice(OF.line_count * 20, PATCHES, replace=False)
    line, stretch = at % OF.line_count, 10 + at // OF.line_count
    turn, away_m = np.radians(20.1 + 0.2 * line), 80 * (stretch + 0.5)
    offset_m = away_m * np.sin(turn), away_m * np.cos(turn), rng.uniform(-300, 600, PATCHES)
    return shared.sensitivities(OF, offset_m, *rng.uniform(-0.5, 0.5, (2, PATCHES))), stretch


def patches(residual_m, kind, one_in=(1, 1)):
    felt, stretch = place(1)
    variance_m2, cells = np.full(PATCHES, SIGMA_M**2 / CELLS), np.full(PATCHES, CELLS)
    return Patches(felt, stretch, kind, residual_m, variance_m2, cells, one_in)


def kinds(stable):
    return np.where(np.arange(PATCHES) < stable, Kind.STABLE, Kind.MOVING).astype(np.int64)


def means():
    """Weights of patches: all of them, and those in boxes of four degrees and 400 m."""
    felt, stretch = place(1)
    rows = [np.ones(PATCHES)]
    for first in range(0, 100, 20):
        for near in range(10, 30, 5):
            inside = (felt.line // 20 * 20 == first) & (stretch // 5 * 5 == near)
            rows.append(inside.astype(float))
    return np.array([row / row.sum() for row in rows if row.sum() >= 10])


@pytest.mark.parametrize("stable", [PATCHES, 40])
def test_stated_sigmas_of_what_held_the_scan_are_those_of_many_scans(stable):
    kind, weights, felt = kinds(stable), means(), place(1)[0]
    cell_m2, patch_m2 = np.full(PATCHES, SIGMA_M**2), np.full(PATCHES, SIGMA_M**2 / CELLS)
    rng = np.random.default_rng(5)
    seen_m2, told_m2, apart_m2 = [], [], []
    for _ in range(60):
        noise_m = rng.normal(0, SIGMA_M / np.sqrt(CELLS), PATCHES)
        found = adjust(patches(noise_m, kind), STILL, BEFORE, None)
        held, unknown = share(cell_m2, cell_m2, kind, found.slack_m2), found.shared()
        seen_m2.append((weights @ (noise_m - found.effect(felt))) ** 2)
        for told, noise in ((told_m2, held), (apart_m2, None)):
            told.append([shared.aggregate_variance(row, patch_m2, felt, unknown, noise) for row in weights])
    seen_m2, told_m2, apart_m2 = (np.mean(one, axis=0) for one in (seen_m2, told_m2, apart_m2))
    assert 0.75 < np.mean(seen_m2[1:] / told_m2[1:]) < 1.35
    assert np.mean(seen_m2[1:] / apart_m2[1:]) < 0.6
    assert 0.3 < seen_m2[0] / told_m2[0] < 1.5
    assert seen_m2[0] / apart_m2[0] < 0.2


def test_of_too_many_cells_each_holds_less():
    noise_m = np.random.default_rng(6).normal(0, 0.02, PATCHES)
    every, fourth = (
        share(np.array([SIGMA_M**2]), np.array([SIGMA_M**2]), np.array([Kind.STABLE]), found.slack_m2)
        for found in (
            adjust(patches(noise_m, kinds(PATCHES), one_in), STILL, BEFORE, None)
            for one_in in ((1, 1), (9, 4))
        )
    )
    assert every > 0.8
    assert fourth == pytest.approx(every / 4, rel=1e-3)


def test_ground_that_changes_does_not_hold_the_scan():
    rng = np.random.default_rng(7)
    noise_m, kind = rng.normal(0, 0.02, PATCHES), kinds(100)
    snow_m = np.where(kind == Kind.MOVING, 0.5 + 0.3 * rng.normal(size=PATCHES), 0.0)
    at_rest, changed = (
        adjust(patches(noise_m + change_m, kind), STILL, BEFORE, None).slack_m2 for change_m in (0.0, snow_m)
    )
    assert max(at_rest) < 0.5 * SIGMA_M**2
    assert changed[0] > 10 * max(changed[1], SIGMA_M**2)


def test_the_share_is_of_the_kind_and_of_the_noise_that_counts():
    kind = np.array([Kind.MOVING, Kind.STABLE, Kind.WITHHELD, Kind.UNUSED])
    own_m2, random_m2 = np.full(4, 3.0), np.full(4, 4.0)
    assert share(own_m2, random_m2, kind, (6.0, 1.0)).tolist() == pytest.approx([0.3, 0.6, 0.0, 0.0])


def test_patches_know_of_how_many_cells_theirs_are_one():
    felt = place(1)[0]
    cells = Cells(
        felt, np.full(PATCHES, 1000.0), kinds(300), np.zeros(PATCHES), np.full(PATCHES, 1e-4), (6, 2)
    )
    found = collect(OF, [cells], 4000.0)
    assert found.some(found.kind == Kind.STABLE).one_in == (6, 2)
