"""Detection of events: connected change anywhere on the grid, at a given rate of false alarms.

The means of blocks in two scans are compared with those of the scans before. What the surroundings of a block
do too (melt, snowfall, an error of the tilt) is taken off, and what remains is summed over windows of several
sizes. Source: equations.md, 6.11.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from station.quantities import Bools, Floats
from station.science.analysis.change_detection import threshold_sigmas
from station.science.geometry.robust_statistics import MEDIAN_ABSOLUTE_NORMAL
from station.science.time_series.contrast_errors import ContrastErrors
from station.science.time_series.surroundings import NEIGHBOURS, TILE, nanmedian, surroundings, tiles_of
from station.science.time_series.window_scores import (
    LEAST_BEFORE,
    BlockChange,
    block_weights,
    may_exceed,
    scan_differences,
    smaller_of_both,
    window_scores,
)

BEFORE = 6  # newest of the earlier scans, with whose median a scan is compared
WINDOWS = (2, 3, 5, 8, 13)  # edge of the windows [blocks]
MIN_DEPTH_M = 0.05  # less is no event, however significant
MIN_WIDESPREAD_M = 0.01
ONGOING = 0.5  # of its mean rate: snowfall that is slower is over
WIDESPREAD_SHARE = 0.25  # of the observed tiles: what changes them alike is snowfall or melt
PATCH_BLOCKS = 9  # that change alike where melt or snow is patchy
EXTENT_SIGMAS = 3.0  # of a block that belongs to an event
MIN_BLOCKS = 2  # of an event: a single block may be an edge that was hit otherwise
MEDIAN_VARIANCE = np.pi / 2  # of a median, over that of the mean
GAP_BLOCKS = 2  # parts of an event that are no farther apart


@dataclass(frozen=True)
class BlockLevels:
    """Means over blocks (by, bx) of a scan: change against the reference [m], NaN where not observed.

    `random_m2` is the variance of the scan's own random errors.
    """

    change_m: Floats
    random_m2: Floats


@dataclass(frozen=True)
class BlockErrors:
    """Systematic errors of a scan against those before it: variances of blocks (by, bx) [m²].

    Those of a block less what surrounds it may have a model, by which the blocks of the scan show them.
    """

    systematic_m2: Floats
    contrast: Floats | ContrastErrors  # of a block less what surrounds it
    oldest_m2: Floats  # of a block, against the oldest scans instead


@dataclass(frozen=True)
class Region:
    """Blocks (by, bx) that changed together, up or down; everywhere, or against their surroundings.

    Of a local region that was just found, `window` is the most significant one, and `around_m` the change of
    its surroundings, which is taken off.
    """

    blocks: Bools
    sign: int
    widespread: bool
    mean_m: float  # of the change of the blocks, as detected
    sigmas: float  # of the most significant window
    lag: int = 0  # scans between those compared with and the first of the two
    window: tuple[slice, slice] | None = None
    around_m: float = 0.0


@dataclass(frozen=True)
class Thresholds:
    """Thresholds [sigma] that limit the false alarms of a year: of a window, and of all tiles together."""

    local: float
    widespread: float


def event_thresholds(blocks: int, scans_per_year: float, false_alarms_per_year: float = 1.0) -> Thresholds:
    """Return the thresholds at which a year of scans has that many false alarms at most.

    Windows of w × w blocks are taken as 4 / w² times as many independent ones as there are blocks, because
    they overlap. What is widespread must show in many tiles at once: it counts as one test of an error that
    all of them share. The thresholds hold for a single scan and normal errors; the second scan must exceed
    them as well, which leaves a margin for heavier tails.
    """
    windows = max(blocks, 1) * sum(min(4 / size**2, 1.0) for size in WINDOWS)
    rate = false_alarms_per_year / 2  # half for each kind
    return Thresholds(
        threshold_sigmas(rate, scans_per_year * windows), threshold_sigmas(rate, scans_per_year)
    )


def before_level(before: Sequence[BlockLevels]) -> BlockLevels:
    """Return the median level of scans and its variance; NaN in blocks that few of them observed."""
    change_m = np.stack([levels.change_m for levels in before])
    observed = np.isfinite(change_m)
    count = np.maximum(observed.sum(axis=0), 1)
    random_m2 = np.where(observed, [levels.random_m2 for levels in before], 0.0).sum(axis=0) / count
    known = observed.sum(axis=0) >= LEAST_BEFORE
    return BlockLevels(
        np.where(known, nanmedian(change_m, 0), np.nan),
        np.where(known, MEDIAN_VARIANCE * random_m2 / count, 0.0),
    )


def detect_regions(
    history: Sequence[BlockLevels],
    after: Sequence[BlockLevels],
    errors: Sequence[BlockErrors],
    rock: Bools,
    thresholds: Thresholds,
) -> list[Region]:
    """Return the regions that two scans show to have changed since the scans before, the largest first.

    `history` are the scans before, the oldest first: the two are compared with the last of them, and with the
    first as well to recognise slow snowfall, and all show how blocks scatter. `errors` are those of the two,
    `rock` marks blocks of bare ground. Both scans must show the change with the same sign, beyond the
    thresholds.
    """
    newest = before_level(history[-BEFORE:])
    scans = list(zip(after, errors, strict=True))
    absolute, relative = zip(
        *(_changes(newest, levels, block_errors, rock) for levels, block_errors in scans), strict=True
    )
    regions = list(_widespread_regions(absolute, thresholds.widespread))
    if not any(region.sign > 0 for region in regions):
        regions += _slow_rise(history, scans, rock, thresholds.widespread)
    history_m = np.stack([levels.change_m for levels in history])
    change_m = smaller_of_both(*(change.change_m for change in absolute))
    around_m = np.mean(
        [whole.change_m - excess.change_m for whole, excess in zip(absolute, relative, strict=True)], axis=0
    )
    regions += [
        replace(region, around_m=float(np.nanmean(around_m[region.window])))
        for region in _local_regions(relative, history_m, rock, thresholds.local)
        if region.sign * np.mean(change_m[region.blocks]) > abs(region.mean_m) / 2
    ]  # where it did not change, its surroundings did
    return sorted(regions, key=lambda region: (-int(region.blocks.sum()), -region.sign))


def _changes(
    base: BlockLevels, levels: BlockLevels, errors: BlockErrors, rock: Bools
) -> tuple[BlockChange, BlockChange]:
    """Return the change of the blocks of a scan, and their change less that of their surroundings.

    By how much the latter differs from block to block beyond the errors, as melt and drifts of snow do, is a
    random error of the former. The systematic errors that it shows are taken off.
    """
    change_m = levels.change_m - base.change_m
    random_m2 = levels.random_m2 + base.random_m2
    excess_m = change_m - surroundings(change_m, rock)
    spread_m = surroundings(np.abs(excess_m), rock) / MEDIAN_ABSOLUTE_NORMAL
    usual_m2 = surroundings(np.where(np.isfinite(change_m), random_m2, np.nan), rock)
    patchy_m2 = np.nan_to_num(np.maximum(spread_m**2 - usual_m2, 0.0))
    patched_m2 = random_m2 + PATCH_BLOCKS * patchy_m2
    absolute = BlockChange(change_m, patched_m2, errors.systematic_m2)
    if not isinstance(errors.contrast, ContrastErrors):
        return absolute, BlockChange(excess_m, random_m2, errors.contrast)
    error_m, contrast_m2 = errors.contrast.estimate(excess_m, patched_m2)
    return absolute, BlockChange(excess_m - error_m, random_m2, contrast_m2)


def _local_regions(
    changes: Sequence[BlockChange], history_m: Floats, rock: Bools, sigmas: float
) -> Iterator[Region]:
    """Yield connected blocks whose change less that of their surroundings exceeds the threshold."""
    shape, weights = rock.shape, block_weights(changes, rock)
    sizes = [
        size
        for size in WINDOWS
        if size <= min(shape) and may_exceed(changes, size, weights, sigmas, MIN_DEPTH_M)
    ]
    if not sizes:
        return
    differences_m = scan_differences(history_m)
    score, depth_m, source = np.zeros(shape), np.zeros(shape), np.zeros(shape, np.int64)
    windows: list[tuple[slice, slice]] = []
    for size in sizes:
        mean_m, window_z = window_scores(changes, size, weights, differences_m, rock)
        hit = (np.abs(window_z) > sigmas) & (np.abs(mean_m) > MIN_DEPTH_M)
        for row, column in np.argwhere(hit).tolist():  # few
            window = slice(row, row + size), slice(column, column + size)
            higher = np.abs(score[window]) < abs(window_z[row, column])
            score[window][higher] = window_z[row, column]
            depth_m[window][higher] = mean_m[row, column]
            source[window][higher] = len(windows)
            windows.append(window)
    excess_m, block_z = window_scores(changes, 1, weights, differences_m, rock)
    for sign in (1, -1):
        inside = sign * score > 0
        member = inside & (sign * excess_m > sign * depth_m / 2)
        member |= (sign * block_z > EXTENT_SIGMAS) & (sign * excess_m > MIN_DEPTH_M / 2)
        labels, _ = ndimage.label(ndimage.binary_dilation(member, NEIGHBOURS, GAP_BLOCKS // 2))
        for label in np.unique(labels[member & inside]).tolist():
            blocks = (labels == label) & member
            most = int(np.argmax(np.where(blocks, sign * score, 0.0)))
            window = windows[source.flat[most]]
            inside_m = sign * np.sum(excess_m[window] * blocks[window])
            is_most = inside_m > sign * np.sum(excess_m[window]) / 2  # else it is beside another change
            if np.count_nonzero(blocks) >= MIN_BLOCKS and is_most:
                mean_change_m = float(excess_m[blocks].mean())
                sigmas_most = float(abs(score.flat[most]))
                yield Region(
                    blocks, sign, widespread=False, mean_m=mean_change_m, sigmas=sigmas_most, window=window
                )


def _widespread_regions(changes: Sequence[BlockChange], sigmas: float) -> Iterator[Region]:
    """Yield the tiles that rose, and those that fell, if they are many."""
    means, z = zip(*map(_tile_scores, changes), strict=True)
    mean_m, tile_z = smaller_of_both(*means), smaller_of_both(*z)
    observed = np.isfinite(means[0])
    first_m, second_m = (change.change_m for change in changes)
    block_tile = tuple(np.indices(first_m.shape) // TILE)
    for sign in (1, -1):
        changed = observed & (sign * tile_z > sigmas) & (sign * mean_m > MIN_WIDESPREAD_M)
        if np.count_nonzero(changed) < max(WIDESPREAD_SHARE * np.count_nonzero(observed), 4):
            continue
        blocks = changed[block_tile] & np.isfinite(first_m) & np.isfinite(second_m)
        most = float(np.max(sign * tile_z))
        mean_change_m = float(smaller_of_both(first_m, second_m)[blocks].mean())
        yield Region(blocks, sign, widespread=True, mean_m=mean_change_m, sigmas=most)


def _slow_rise(
    history: Sequence[BlockLevels],
    scans: Sequence[tuple[BlockLevels, BlockErrors]],
    rock: Bools,
    sigmas: float,
) -> Iterator[Region]:
    """Yield the tiles that rose since the oldest scans, if they are many and still rise: slow snowfall."""
    lag = len(history) - BEFORE
    oldest, newest = before_level(history[:BEFORE]), before_level(history[-BEFORE:])
    rise_m = scans[0][0].change_m - oldest.change_m
    if np.count_nonzero(rise_m > MIN_DEPTH_M) < WIDESPREAD_SHARE * np.count_nonzero(np.isfinite(rise_m)):
        return  # most scans
    changes = [
        _changes(oldest, levels, replace(errors, systematic_m2=errors.oldest_m2), rock)[0]
        for levels, errors in scans
    ]
    steady = (BEFORE + 1) / (2 * lag + BEFORE + 1)  # share since the newest of what rose since the oldest
    for region in _widespread_regions(changes, sigmas):
        recent_m = min(
            float(np.nanmean((levels.change_m - newest.change_m)[region.blocks])) for levels, _ in scans
        )
        if region.mean_m > MIN_DEPTH_M and recent_m > ONGOING * steady * region.mean_m:
            yield replace(region, lag=lag)


def _tile_scores(change: BlockChange) -> tuple[Floats, Floats]:
    """Return the median change [m] of each tile (ty, tx) and its z; NaN where not observed."""
    change_m, *variances_m2 = map(tiles_of, (change.change_m, change.random_m2, change.systematic_m2))
    observed = np.isfinite(change_m)
    count = observed.sum(axis=2)
    mean_m = np.where(count >= MIN_BLOCKS, nanmedian(change_m, 2), np.nan)
    random_m2, systematic_m2 = (
        np.where(observed, v, 0.0).sum(axis=2) / np.maximum(count, 1) for v in variances_m2
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        z = mean_m / np.sqrt(MEDIAN_VARIANCE * random_m2 / np.maximum(count, 1) + systematic_m2)
    return mean_m, np.nan_to_num(z)


def overlaps(first: Bools, second: Bools, margin: int = 1) -> bool:
    """Return True if regions (by, bx) overlap, or are less than `margin` blocks apart."""
    return bool((ndimage.binary_dilation(first, NEIGHBOURS, margin) & second).any())


def distance_blocks(first: Bools, second: Bools) -> float:
    """Return the distance between two regions (by, bx) [blocks]."""
    distance = ndimage.distance_transform_edt(~first)
    return float(distance[second].min())
