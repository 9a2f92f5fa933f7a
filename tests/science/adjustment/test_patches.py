"""Aggregation of cells into patches, compared with plain loops and with simulated noise."""

from collections import defaultdict
from dataclasses import replace

import numpy as np
import pytest

from station.science.adjustment.patches import CellObservations, GroundClass, aggregate_patches
from station.science.uncertainty.jacobian import height_jacobian
from station.science.uncertainty.parameters import ParameterLayout

PARAMS = ParameterLayout(np.radians(10.0), 20, full_circle=False)
MAX_RANGE_M = 3000.0
FIELDS = ("range_bin", "ground_class", "residual_m", "variance_m2", "cell_count", "sampling_ratio")


def random_cells(seed=0, count=4000):
    rng = np.random.default_rng(seed)
    azimuth, range_m = rng.uniform(np.radians(10), np.radians(30), count), rng.uniform(200, 3200, count)
    offset_m = range_m * np.sin(azimuth), range_m * np.cos(azimuth), rng.uniform(-300, 500, count)
    jacobian = height_jacobian(PARAMS, offset_m, *rng.uniform(-0.5, 0.5, (2, count)))
    sigma_m = rng.uniform(0.02, 0.1, count)
    ground_class = rng.integers(0, 4, count)
    ratio = rng.uniform(0, 1, count)
    return CellObservations(
        jacobian, range_m, offset_m[2], ground_class, rng.normal(0, sigma_m), sigma_m**2, ratio
    ), azimuth


def subset(cells, chosen):
    return CellObservations(
        cells.jacobian.take(chosen),
        cells.range_m[chosen],
        cells.height_m[chosen],
        cells.ground_class[chosen],
        cells.residual_m[chosen],
        cells.variance_m2[chosen],
        cells.sampling_ratio[chosen],
    )


def cells_by_patch(per_patch, count=400, seed=1):
    """Cells with normal errors: `per_patch` (count,) in each patch, with equal Jacobians within a patch."""
    rng = np.random.default_rng(seed)
    line, range_bin = (
        np.repeat(index, per_patch) for index in (np.arange(count) % 100, 5 + np.arange(count) // 100)
    )
    azimuth, range_m = np.radians(10 + 0.2 * (line + 0.5)), 80 * (range_bin + 0.5)
    level = np.zeros(len(line))
    jacobian = height_jacobian(
        PARAMS, (range_m * np.sin(azimuth), range_m * np.cos(azimuth), level), level, level
    )
    sigma_m = rng.uniform(0.02, 0.1, len(line))
    return CellObservations(
        jacobian, range_m, level, np.ones(len(line), np.int64), rng.normal(0, sigma_m), sigma_m**2, level
    )


def test_patches_match_a_plain_loop():
    cells, azimuth = random_cells()
    groups = defaultdict(list)
    for i, (ground_class, azimuth_rad, range_m) in enumerate(
        zip(cells.ground_class, azimuth, cells.range_m, strict=True)
    ):
        if ground_class != GroundClass.UNUSED:
            line = int((np.degrees(azimuth_rad) - 10) / 0.2)
            groups[ground_class, line, min(int(range_m // 80), 37)].append(i)
    patches = aggregate_patches(PARAMS, [cells], MAX_RANGE_M)
    assert len(patches) == len(groups)
    line = np.rint(patches.jacobian.knot_position * 5 - 0.5).astype(int)
    for i, key in enumerate(zip(patches.ground_class, line, patches.range_bin, strict=True)):
        members = groups[key]
        weight = 1 / cells.variance_m2[members]
        assert patches.cell_count[i] == len(members)
        share = weight / weight.sum()
        for actual, effect in (
            *zip(patches.jacobian.pose[:, i], cells.jacobian.pose, strict=True),
            (patches.jacobian.sight_tilt[i], cells.jacobian.sight_tilt),
            (patches.jacobian.refraction[i], cells.jacobian.refraction),
            (patches.height_m[i], cells.height_m),
            (patches.sampling_ratio[i], cells.sampling_ratio),
        ):
            assert abs(actual - share @ effect[members]) < 1e-9 * np.abs(effect[members]).max()
        min_sigma_m = weight.sum() ** -0.5
        plain_m = np.average(cells.residual_m[members], weights=weight)
        assert abs(patches.residual_m[i] - plain_m) < 1.5 * min_sigma_m  # robust, but from the same cells
        assert np.sqrt(patches.variance_m2[i]) > 0.99 * min_sigma_m


@pytest.mark.parametrize("per_patch", [1, 2, 3, 8, 50])
def test_variance_of_a_patch_matches_the_scatter_of_its_mean(per_patch):
    cells = cells_by_patch(per_patch)
    patches = aggregate_patches(PARAMS, [cells], MAX_RANGE_M)
    z = patches.residual_m / np.sqrt(patches.variance_m2)
    assert len(z) == 400
    assert z.std() == pytest.approx(1, abs=0.12)
    min_variance_m2 = 1 / np.bincount(np.repeat(np.arange(400), per_patch), 1 / cells.variance_m2)
    assert (
        np.sqrt(patches.variance_m2.mean() / min_variance_m2.mean()) < 1.15
    )  # efficiency of the robust mean


def test_patches_of_four_cells_are_efficient_among_patches_of_one():
    per_patch = np.where(np.arange(400) % 8 == 0, 4, 1)
    cells = cells_by_patch(per_patch)
    min_variance_m2 = 1 / np.bincount(np.repeat(np.arange(400), per_patch), 1 / cells.variance_m2)
    patches = aggregate_patches(PARAMS, [cells], MAX_RANGE_M)
    variance_m2 = patches.variance_m2[patches.cell_count == 4]
    assert np.sqrt(variance_m2.mean() / min_variance_m2[per_patch == 4].mean()) < 1.15


def test_variance_grows_if_cells_scatter_more_than_stated():
    cells = cells_by_patch(50)
    expected = aggregate_patches(PARAMS, [cells], MAX_RANGE_M)
    scattered = replace(cells, residual_m=3 * cells.residual_m)
    actual = aggregate_patches(PARAMS, [scattered], MAX_RANGE_M)
    assert np.sqrt(actual.variance_m2 / expected.variance_m2).mean() == pytest.approx(3, rel=0.1)


def test_one_outlier_among_fifty_cells_hardly_moves_the_mean():
    cells = cells_by_patch(50)
    clean = aggregate_patches(PARAMS, [cells], MAX_RANGE_M)
    residual_m = cells.residual_m.copy()
    residual_m[::50] += 5.0
    with_outliers = aggregate_patches(
        PARAMS,
        [replace(cells, residual_m=residual_m)],
        MAX_RANGE_M,
    )
    moved_m = np.abs(with_outliers.residual_m - clean.residual_m)
    sigma_m = np.sqrt(clean.variance_m2)
    assert np.median(moved_m) < 0.3 * np.median(sigma_m)
    assert moved_m.max() < 0.02  # a plain mean moves by 0.1 m


def test_result_does_not_depend_on_order_or_blocks():
    cells, _ = random_cells(1)
    whole = aggregate_patches(PARAMS, [cells], MAX_RANGE_M)
    permutation = np.random.default_rng(2).permutation(len(cells.range_m))
    blocks = [subset(cells, chosen) for chosen in np.split(permutation, [10, 10, 1500, 3999])]
    actual = aggregate_patches(PARAMS, blocks, MAX_RANGE_M)
    for name in FIELDS:
        assert getattr(actual, name) == pytest.approx(getattr(whole, name), rel=1e-5, abs=1e-7)
    assert np.allclose(actual.jacobian.pose, whole.jacobian.pose)
    assert np.array_equal(actual.jacobian.knot_position, whole.jacobian.knot_position)


def test_unused_cells_are_excluded():
    cells, _ = random_cells(3)
    used = cells.ground_class != GroundClass.UNUSED
    whole, actual = (
        aggregate_patches(PARAMS, [block], MAX_RANGE_M) for block in (cells, subset(cells, used))
    )
    assert whole.cell_count.sum() == used.sum() < len(used)
    assert set(whole.ground_class) == {GroundClass.MOVING, GroundClass.STABLE, GroundClass.HOLDOUT}
    for name in FIELDS:
        assert np.array_equal(getattr(actual, name), getattr(whole, name))


def test_unused_cells_only_give_no_patches():
    cells, _ = random_cells(4, 50)
    unused = replace(cells, ground_class=np.full(50, GroundClass.UNUSED))
    assert len(aggregate_patches(PARAMS, [unused], MAX_RANGE_M)) == 0


def test_no_blocks_give_no_patches():
    assert len(aggregate_patches(PARAMS, [], MAX_RANGE_M)) == 0
