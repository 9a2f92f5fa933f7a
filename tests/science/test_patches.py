"""Cells taken together: against plain loops and drawn noise."""

from collections import defaultdict

import numpy as np
import pytest

from station.science import shared
from station.science.patches import Cells, Kind, collect

OF = shared.Basis(np.radians(10.0), 20, closed=False)
REACH_M = 3000.0
FIELDS = ("stretch", "kind", "residual_m", "variance_m2", "cells")


def some_cells(seed=0, count=4000):
    rng = np.random.default_rng(seed)
    azimuth, away_m = rng.uniform(np.radians(10), np.radians(30), count), rng.uniform(200, 3200, count)
    offset_m = away_m * np.sin(azimuth), away_m * np.cos(azimuth), rng.uniform(-300, 500, count)
    felt = shared.sensitivities(OF, offset_m, *rng.uniform(-0.5, 0.5, (2, count)))
    sigma_m = rng.uniform(0.02, 0.1, count)
    kind = rng.integers(0, 4, count)
    return Cells(felt, away_m, kind, rng.normal(0, sigma_m), sigma_m**2), azimuth


def part(cells, chosen):
    felt = cells.felt
    return Cells(
        felt.some(chosen),
        cells.range_m[chosen],
        cells.kind[chosen],
        cells.residual_m[chosen],
        cells.variance_m2[chosen],
    )


def in_patches(each, count=400, seed=1):
    """Put `each` (count,) cells of equal sensitivities, of normal errors, in so many patches."""
    rng = np.random.default_rng(seed)
    line, stretch = (
        np.repeat(place, each) for place in (np.arange(count) % 100, 5 + np.arange(count) // 100)
    )
    azimuth, away_m = np.radians(10 + 0.2 * (line + 0.5)), 80 * (stretch + 0.5)
    level = np.zeros(len(line))
    felt = shared.sensitivities(OF, (away_m * np.sin(azimuth), away_m * np.cos(azimuth), level), level, level)
    sigma_m = rng.uniform(0.02, 0.1, len(line))
    cells = Cells(felt, away_m, np.ones(len(line), np.int64), rng.normal(0, sigma_m), sigma_m**2)
    return cells, np.lexsort((stretch, line))


def test_patches_against_a_plain_loop():
    cells, azimuth = some_cells()
    groups = defaultdict(list)
    for i, (kind, turned, away_m) in enumerate(zip(cells.kind, azimuth, cells.range_m, strict=True)):
        if kind != Kind.UNUSED:
            line = int((np.degrees(turned) - 10) / 0.2)
            groups[kind, line, min(int(away_m // 80), 37)].append(i)
    patches = collect(OF, [cells], REACH_M)
    assert len(patches) == len(groups)
    line = np.rint(patches.felt.passed * 5 - 0.5).astype(int)
    for i, key in enumerate(zip(patches.kind, line, patches.stretch, strict=True)):
        of = groups[key]
        weight = 1 / cells.variance_m2[of]
        assert patches.cells[i] == len(of)
        for told, effect in (
            *zip(patches.felt.globals_[:, i], cells.felt.globals_, strict=True),
            (patches.felt.lean[i], cells.felt.lean),
            (patches.felt.refraction[i], cells.felt.refraction),
        ):
            assert told == pytest.approx(np.average(effect[of], weights=weight), rel=1e-9, abs=1e-12)
        least_m = weight.sum() ** -0.5
        plain_m = np.average(cells.residual_m[of], weights=weight)
        assert abs(patches.residual_m[i] - plain_m) < 1.5 * least_m  # robust, but of the same cells
        assert np.sqrt(patches.variance_m2[i]) > 0.99 * least_m


@pytest.mark.parametrize("each", [1, 2, 3, 8, 50])
def test_stated_variance_is_that_of_the_means(each):
    cells, _ = in_patches(each)
    patches = collect(OF, [cells], REACH_M)
    z = patches.residual_m / np.sqrt(patches.variance_m2)
    assert len(z) == 400
    assert z.std() == pytest.approx(1, abs=0.12)
    least_m2 = 1 / np.bincount(np.repeat(np.arange(400), each), 1 / cells.variance_m2)
    assert np.sqrt(patches.variance_m2.mean() / least_m2.mean()) < 1.15  # little is lost to being robust


def test_patches_of_four_use_all_their_cells_also_where_most_have_one():
    each = np.where(np.arange(400) % 8 == 0, 4, 1)
    cells, _ = in_patches(each)
    least_m2 = 1 / np.bincount(np.repeat(np.arange(400), each), 1 / cells.variance_m2)
    patches = collect(OF, [cells], REACH_M)
    told_m2 = patches.variance_m2[patches.cells == 4]
    assert np.sqrt(told_m2.mean() / least_m2[each == 4].mean()) < 1.15


def test_cells_that_vary_more_than_stated_make_the_mean_less_sure():
    cells, _ = in_patches(50)
    calm = collect(OF, [cells], REACH_M)
    threefold = Cells(cells.felt, cells.range_m, cells.kind, 3 * cells.residual_m, cells.variance_m2)
    wild = collect(OF, [threefold], REACH_M)
    assert np.sqrt(wild.variance_m2 / calm.variance_m2).mean() == pytest.approx(3, rel=0.1)


def test_one_wild_cell_among_fifty_hardly_moves_the_mean():
    cells, _ = in_patches(50)
    before = collect(OF, [cells], REACH_M)
    residual_m = cells.residual_m.copy()
    residual_m[::50] += 5.0
    after = collect(
        OF, [Cells(cells.felt, cells.range_m, cells.kind, residual_m, cells.variance_m2)], REACH_M
    )
    moved_m = np.abs(after.residual_m - before.residual_m)
    sigma_m = np.sqrt(before.variance_m2)
    assert np.median(moved_m) < 0.3 * np.median(sigma_m)
    assert moved_m.max() < 0.02  # of the 0.1 m that a plain mean moves by


def test_order_and_bands_do_not_matter():
    cells, _ = some_cells(1)
    whole = collect(OF, [cells], REACH_M)
    mixed = np.random.default_rng(2).permutation(len(cells.range_m))
    bands = [part(cells, chosen) for chosen in np.split(mixed, [10, 10, 1500, 3999])]
    told = collect(OF, bands, REACH_M)
    for name in FIELDS:
        assert getattr(told, name) == pytest.approx(getattr(whole, name), rel=1e-5, abs=1e-7)
    assert np.allclose(told.felt.globals_, whole.felt.globals_)
    assert np.array_equal(told.felt.passed, whole.felt.passed)


def test_unused_cells_are_left_out():
    cells, _ = some_cells(3)
    used = cells.kind != Kind.UNUSED
    whole, told = (collect(OF, [one], REACH_M) for one in (cells, part(cells, used)))
    assert whole.cells.sum() == used.sum() < len(used)
    assert set(whole.kind) == {Kind.MOVING, Kind.STABLE, Kind.WITHHELD}
    for name in FIELDS:
        assert np.array_equal(getattr(told, name), getattr(whole, name))


def test_nothing_used_gives_no_patch():
    cells, _ = some_cells(4, 50)
    none = Cells(cells.felt, cells.range_m, np.full(50, Kind.UNUSED), cells.residual_m, cells.variance_m2)
    assert len(collect(OF, [none], REACH_M)) == 0


def test_no_band_gives_no_patch():
    assert len(collect(OF, [], REACH_M)) == 0
