"""Errors of blocks less what surrounds them: systematic ones against dense algebra, patches by simulation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage
from support.epochs import random_epoch
from support.shared_parameters import SCANNER, random_shared

from station.archive import epochs
from station.archive.netcdf_layout import Series
from station.archive.reference_files import write_reference
from station.archive.series.index import list_epochs
from station.archive.series.virtual import build_series
from station.quantities import Grid, Quality, Reference
from station.queries.blocks import BlockQueries
from station.science.time_series.event_errors import SystematicErrors, like_regions_variance
from station.science.time_series.surroundings import surrounding_weights, surroundings

GRID = Grid(west_m=632_000.0, north_m=5_186_000.0, cell_m=10.0, nx=57, ny=93)
SHARED = random_shared(1, GRID)
ROCK = np.arange(GRID.nx) < 24
TILE, REACH = 10, 3  # blocks along the edge of a tile, and tiles to each side


@pytest.fixture(scope="module")
def blocks(tmp_path_factory):
    """Blocks of a scan on rugged ground, the west of it rock; one block a cell, a fifth not observed."""
    series = Series(tmp_path_factory.mktemp("errors"), "hef", GRID, "EPSG:32632")
    relief_m = 30 * np.random.default_rng(2).normal(size=GRID.shape).cumsum(axis=0).cumsum(axis=1) / 60
    surface = Reference.from_elevation(GRID, "1", 2800 + relief_m)
    write_reference(series, replace(surface, random_variance_m2=np.full(GRID.shape, 1e-4, np.float32)))
    epoch = random_epoch(
        0,
        GRID,
        np.full(GRID.shape, 0.02),
        quality=np.where(ROCK, int(Quality.STABLE_GROUND), 0) * np.ones(GRID.shape, int),
        scatter_m=0.02,
        shared=SHARED,
        scalars=SCANNER,
        provenance={"adjustment": "joint", "reference_version": "1"},
    )
    hidden = np.random.default_rng(3).random(epoch.measurement.change_m.shape) < 0.2
    change_m = np.where(hidden, np.float32(np.nan), epoch.measurement.change_m)
    epochs.write_epoch(series, replace(epoch, measurement=replace(epoch.measurement, change_m=change_m)))
    build_series(series)
    return BlockQueries(series).read(list_epochs(series)[0])


def errors_of(blocks):
    return SystematicErrors(blocks.jacobian, blocks.observed, ROCK & blocks.observed)


def stated_m2(blocks, shared):
    """Variances of blocks less what surrounds them, where the blocks themselves tell nothing."""
    contrast = errors_of(blocks).against_surroundings(shared)
    change_m = np.where(blocks.observed, 0.0, np.nan)
    error_m, variance_m2 = contrast.estimate(change_m, np.full(change_m.shape, 1e9))
    assert not error_m.any()
    return variance_m2


def test_a_scan_shows_its_own_errors_and_what_is_left_has_its_sigma(blocks):
    """Drawn errors of parameters and lines, noise of 5 mm, and a deposit, which is no error."""
    rng = np.random.default_rng(4)
    shared, jacobian, rock = blocks.shared, blocks.jacobian, ROCK & blocks.observed
    contrast = errors_of(blocks).against_surroundings(shared)
    stated_m = np.sqrt(stated_m2(blocks, shared)[blocks.observed])
    root = np.linalg.cholesky(shared.covariance + 1e-18 * np.eye(len(shared.names)))
    deposit_m = np.zeros(GRID.shape)
    deposit_m[40:43, 30:33] = 0.5
    z, left_m, kept_m = [], [], []
    for _ in range(12):
        tilt_rad = np.sqrt(contrast.line_rad2) * rng.normal(size=len(contrast.line_rad2))
        drawn_m = jacobian.effect(root @ rng.normal(size=len(root)))
        errors_m = np.full(GRID.shape, np.nan)
        errors_m[blocks.observed] = drawn_m + contrast.line_effect * tilt_rad[contrast.line]
        true_m = errors_m - surroundings(errors_m, rock)
        noisy_m = true_m + 0.005 * rng.normal(size=GRID.shape) + deposit_m
        estimate_m, variance_m2 = contrast.estimate(noisy_m, np.full(GRID.shape, 2.5e-5))
        left = (true_m - estimate_m)[blocks.observed]
        z.append(left / np.sqrt(variance_m2[blocks.observed]))
        left_m.append(left)
        kept_m.append(np.nanmean((noisy_m - estimate_m)[40:43, 30:33]))
    assert 0.8 < np.sqrt(np.mean(np.square(z))) < 1.25
    assert np.sqrt(np.mean(np.square(left_m))) < np.sqrt(np.mean(stated_m**2)) / 2
    assert np.mean(kept_m) == pytest.approx(0.5, abs=0.05)


def test_a_block_less_its_surroundings_has_the_variance_of_dense_algebra(blocks):
    jacobian, shared = blocks.jacobian, blocks.shared
    dense = np.stack([jacobian.effect(unit) for unit in np.eye(len(shared.names))], axis=1)
    row, column = np.nonzero(blocks.observed)
    tile = np.stack([row, column], axis=1) // TILE
    rock = ROCK[column]
    no_lines = replace(shared, line_tilt_variance=0 * shared.line_tilt_variance)
    actual_m2 = stated_m2(blocks, no_lines)[blocks.observed]
    for block in range(0, len(row), 97):
        near = (np.abs(tile - tile[block]).max(axis=1) <= REACH) & (rock == rock[block])
        tiles = np.unique(tile[near], axis=0)
        means = [dense[near & (tile == each).all(axis=1)].mean(axis=0) for each in tiles]
        contrast = dense[block] - np.mean(means, axis=0)
        assert actual_m2[block] == pytest.approx(contrast @ shared.covariance @ contrast, rel=1e-4)


def test_a_block_keeps_the_tilt_of_its_own_line(blocks):
    lines = replace(blocks.shared, covariance=0 * blocks.shared.covariance)
    errors = errors_of(blocks)
    assert stated_m2(blocks, lines) == pytest.approx(errors.of_blocks(lines), rel=1e-5)
    assert errors.of_blocks(lines)[blocks.observed].min() > 0
    assert not errors.against_surroundings(None).any()


@pytest.mark.parametrize("patch_blocks", [0.5, 3, 8])
def test_patches_of_any_size_are_in_the_variance_of_a_region(patch_blocks):
    """The change of the region less its surroundings, over its sigma, in many draws of patchy snow."""
    members = np.zeros((90, 90), bool)
    members[40:47, 40:47] = True
    usable = np.ones_like(members)
    usable[:, 80:] = False
    weights = surrounding_weights(members, usable)
    z = []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        patches = ndimage.gaussian_filter(rng.normal(size=members.shape), patch_blocks, mode="wrap")
        change_m = 0.03 * patches / patches.std() + 0.02 * rng.normal(size=members.shape)
        random_m2 = np.full(members.shape, 0.02**2)
        variance_m2 = like_regions_variance(members, usable, change_m + 0.5, random_m2)
        z.append(np.sum(weights * change_m) / np.sqrt(variance_m2 + np.sum(weights**2 * random_m2)))
    assert 0.8 < np.sqrt(np.mean(np.square(z))) < 1.25


def test_a_scan_that_saw_nothing_has_no_errors(blocks):
    nothing = np.zeros_like(blocks.observed)
    errors = SystematicErrors(blocks.jacobian.take(slice(0)), nothing, nothing)
    unseen_m = np.full(nothing.shape, np.nan)
    error_m, variance_m2 = errors.against_surroundings(blocks.shared).estimate(unseen_m, 0 * unseen_m)
    assert not error_m.any()
    assert not variance_m2.any()
    assert not errors.of_blocks(blocks.shared).any()
