"""Detection of events: connected change anywhere on the grid, at a given rate of false alarms.

The means of blocks in two scans are compared with those of the scans before. What the surroundings of a block
do too (melt, snowfall, an error of the tilt) is taken off, and what remains is summed over windows of several
sizes. Source: equations.md, 6.11.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from station.quantities import Bools, Floats
from station.science.analysis.change_detection import threshold_sigmas
from station.science.geometry.robust_statistics import MEDIAN_ABSOLUTE_NORMAL

WINDOWS = (2, 3, 5, 8, 13)  # edge of the windows [blocks]
TILE = 10  # blocks along the edge of a tile, over which surroundings are averaged
LEAST_IN_TILE = 25  # blocks of the same ground
SURROUNDING_TILES = 7  # along the edge of the surroundings of a tile
MIN_OBSERVED = 0.5  # share of the blocks of a window
MIN_DEPTH_M = 0.05  # less is no event, however significant
MIN_WIDESPREAD_M = 0.01
WIDESPREAD_SHARE = 0.25  # of the observed tiles: what changes them alike is snowfall or melt
PATCH_BLOCKS = 9  # that change alike where melt or snow is patchy
NEIGHBOURS = np.ones((3, 3), np.bool_)  # of a block, itself included
EXTENT_SIGMAS = 3.0  # of a block that belongs to an event
MIN_BLOCKS = 2  # of an event: a single block may be an edge that was hit otherwise
TAIL_QUANTILE, TAIL_SIGMAS = 0.99, 2.576  # two-sided, of a normal distribution
OUTLIER_SIGMAS = 6.0  # beyond, a window has changed, and is no sample of the errors
MEDIAN_VARIANCE = np.pi / 2  # of a median, over that of the mean
SCATTER_VARIANCE = 1.3  # of a scan less the median of six, over that of a scan
SCATTER_QUANTILE, SCATTER_SIGMAS = 0.9, 1.645  # of absolute values, two-sided
TINY = 1e-9
GAP_BLOCKS = 2  # parts of an event that are no farther apart


@dataclass(frozen=True)
class BlockLevels:
    """Means over blocks (by, bx) of a scan: change against the reference [m], NaN where not observed.

    `random_m2` is the variance of the scan's own random errors.
    """

    change_m: Floats
    random_m2: Floats


@dataclass(frozen=True)
class Region:
    """Blocks (by, bx) that changed together, up or down; everywhere, or against their surroundings."""

    blocks: Bools
    sign: int
    widespread: bool
    mean_m: float  # of the change of the blocks, as detected
    sigmas: float  # of the most significant window


@dataclass(frozen=True)
class _Contrast:
    """Change of a scan against those before: of the blocks, less the surroundings, and variances (by, bx)."""

    change_m: Floats
    excess_m: Floats
    random_m2: Floats
    systematic_m2: Floats  # of the change
    contrast_m2: Floats  # of the excess: what errors of the scan do otherwise here than around
    patchy_m2: Floats  # by which the change differs from block to block, beyond the errors


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


def before_level(before: list[BlockLevels], least: int) -> BlockLevels:
    """Return the median level of scans and its variance; NaN in blocks that fewer than `least` observed."""
    change_m = np.stack([levels.change_m for levels in before])
    observed = np.isfinite(change_m)
    count = np.maximum(observed.sum(axis=0), 1)
    random_m2 = np.where(observed, [levels.random_m2 for levels in before], 0.0).sum(axis=0) / count
    known = observed.sum(axis=0) >= least
    return BlockLevels(
        np.where(known, _nanmedian(change_m, 0), np.nan),
        np.where(known, MEDIAN_VARIANCE * random_m2 / count, 0.0),
    )


def scan_differences(history_m: Floats) -> Floats:
    """Return how consecutive scans (n, by, bx) differ (n - 1, by, bx) [m], less what surrounds a block."""
    differences_m = np.diff(history_m, axis=0)
    observed = np.isfinite(differences_m)
    extent = 1, TILE * SURROUNDING_TILES, TILE * SURROUNDING_TILES
    around_m, share = (
        ndimage.uniform_filter(np.where(observed, values, 0.0), extent) for values in (differences_m, 1.0)
    )
    return differences_m - around_m / np.maximum(share, TINY)


def window_scatter(differences_m: Floats, size: int) -> Floats:
    """Return the variance of the means of windows in one scan [m²], as consecutive scans differ.

    The shape is (by - size + 1, bx - size + 1). The tenth largest of a hundred differences is used: one event
    does not raise it, but an edge does, which beams hit in some scans only. Its neighbours are on the same
    edge, so that a window has the largest variance of those around it.
    """
    means_m = []
    for difference_m in differences_m:
        observed = np.isfinite(difference_m)
        count = _window_sums(observed, size)
        count[count < MIN_OBSERVED * size**2] = np.nan
        means_m.append(np.abs(_window_sums(np.where(observed, difference_m, 0.0), size)) / count)
    ordered = np.sort(means_m, axis=0)  # NaN last
    pairs = np.isfinite(ordered).sum(axis=0)
    rank = np.maximum(np.ceil(SCATTER_QUANTILE * pairs).astype(np.int64) - 1, 0)
    typical_m = np.nan_to_num(np.take_along_axis(ordered, rank[None], 0)[0])
    return np.asarray(ndimage.maximum_filter(typical_m**2 / (2 * SCATTER_SIGMAS**2), 3))


def detect_regions(
    before: list[BlockLevels],
    after: Sequence[BlockLevels],
    systematic_m2: Sequence[Floats],
    contrast_m2: Sequence[Floats],
    history_m: Floats,
    rock: Bools,
    thresholds: Thresholds,
    least_before: int = 3,
) -> list[Region]:
    """Return the regions that two scans show to have changed since the scans before, the largest first.

    `systematic_m2` (by, bx) is the variance of the systematic errors in the difference of each of the two
    scans and those before, `contrast_m2` that of a block less its surroundings. `history_m` (n, by, bx) are
    all earlier scans, `rock` marks blocks of bare ground.
    Both scans must show the change with the same sign, beyond the thresholds.
    """
    base = before_level(before, least_before)
    first, second = (
        _contrast(base, levels, shared_m2, excess_m2, rock)
        for levels, shared_m2, excess_m2 in zip(after, systematic_m2, contrast_m2, strict=True)
    )
    regions = list(_widespread_regions(first, second, thresholds.widespread))
    regions += _local_regions((first, second), history_m, rock, thresholds.local)
    return sorted(regions, key=lambda region: (-int(region.blocks.sum()), -region.sign))


def _contrast(
    base: BlockLevels, levels: BlockLevels, systematic_m2: Floats, contrast_m2: Floats, rock: Bools
) -> _Contrast:
    change_m = levels.change_m - base.change_m
    random_m2 = levels.random_m2 + base.random_m2
    excess_m = change_m - surroundings(change_m, rock)
    spread_m = surroundings(np.abs(excess_m), rock) / MEDIAN_ABSOLUTE_NORMAL
    usual_m2 = surroundings(np.where(np.isfinite(change_m), random_m2, np.nan), rock)
    patchy_m2 = np.nan_to_num(np.maximum(spread_m**2 - usual_m2, 0.0))  # as melt and drifts of snow differ
    return _Contrast(change_m, excess_m, random_m2, systematic_m2, contrast_m2, patchy_m2)


def surroundings(values: Floats, rock: Bools, excluded: Bools | None = None) -> Floats:
    """Return the median of what surrounds each block (by, bx): bare ground of bare ground, others of others.

    It is the median over tiles of their medians, interpolated between tiles, NaN where none is observed. A
    tile in which few blocks are of that ground may be all edge: it counts only if there is no other.
    """
    result = np.full(values.shape, np.nan)
    for ground in (rock, ~rock):
        used = ground if excluded is None else ground & ~excluded
        blocks = _tiles(np.where(used, values, np.nan))
        tiles = _nanmedian(blocks, 2)
        full = np.isfinite(blocks).sum(axis=2) >= LEAST_IN_TILE
        if full.any():
            tiles[~full] = np.nan
        margin = SURROUNDING_TILES // 2
        padded = np.pad(tiles, margin, constant_values=np.nan)
        shape = SURROUNDING_TILES, SURROUNDING_TILES
        around = np.lib.stride_tricks.sliding_window_view(padded, shape).reshape(*tiles.shape, -1)
        smooth = _nanmedian(around, 2)
        if not np.isfinite(smooth).any():
            continue
        nearest = ndimage.distance_transform_edt(
            np.isnan(smooth), return_distances=False, return_indices=True
        )
        smooth = smooth[tuple(nearest)]
        row, column = ((np.arange(size) - (TILE - 1) / 2) / TILE for size in values.shape)
        coordinates = np.meshgrid(row, column, indexing="ij")
        interpolated = ndimage.map_coordinates(smooth, coordinates, order=1, mode="nearest")
        result[ground] = interpolated[ground]
    return result


def _tiles(values: Floats) -> Floats:
    """Return the blocks (ty, tx, TILE²) of each tile, NaN beyond the edges."""
    height, width = (-(-size // TILE) for size in values.shape)
    padded = np.full((height * TILE, width * TILE), np.nan)
    padded[: values.shape[0], : values.shape[1]] = values
    return padded.reshape(height, TILE, width, TILE).swapaxes(1, 2).reshape(height, width, TILE**2)


def _nanmedian(values: Floats, axis: int) -> Floats:
    """Return the median of the finite values along an axis, NaN without any, at a tenth of numpy's time."""
    ordered = np.sort(values, axis=axis)  # NaN last
    count = np.isfinite(values).sum(axis=axis, keepdims=True)
    lower, upper = (
        np.take_along_axis(ordered, np.maximum(rank, 0), axis) for rank in ((count - 1) // 2, count // 2)
    )
    upper = np.where(count > 0, upper, np.nan)
    return np.asarray(np.squeeze((lower + upper) / 2, axis))


def _local_regions(
    contrasts: tuple[_Contrast, _Contrast], history_m: Floats, rock: Bools, sigmas: float
) -> Iterator[Region]:
    shape = rock.shape
    sizes = [size for size in WINDOWS if size <= min(shape) and _may_have_changed(contrasts, size, sigmas)]
    if not sizes:
        return
    differences_m = scan_differences(history_m)
    score, depth_m = np.zeros(shape), np.zeros(shape)
    for size in sizes:
        mean_m, window_z = _scores_of_both(contrasts, size, differences_m, rock)
        hit = (np.abs(window_z) > sigmas) & (np.abs(mean_m) > MIN_DEPTH_M)
        for row, column in np.argwhere(hit).tolist():  # few
            window = slice(row, row + size), slice(column, column + size)
            higher = np.abs(score[window]) < abs(window_z[row, column])
            score[window][higher] = window_z[row, column]
            depth_m[window][higher] = mean_m[row, column]
    excess_m, block_z = _scores_of_both(contrasts, 1, differences_m, rock)
    for sign in (1, -1):
        inside = sign * score > 0
        member = inside & (sign * excess_m > sign * depth_m / 2)
        member |= (sign * block_z > EXTENT_SIGMAS) & (sign * excess_m > MIN_DEPTH_M / 2)
        labels, _ = ndimage.label(ndimage.binary_dilation(member, NEIGHBOURS, GAP_BLOCKS // 2))
        for label in np.unique(labels[member & inside]).tolist():
            blocks = (labels == label) & member
            if np.count_nonzero(blocks) >= MIN_BLOCKS:
                most = float(np.max(sign * score[blocks]))
                yield Region(
                    blocks, sign, widespread=False, mean_m=float(excess_m[blocks].mean()), sigmas=most
                )


def _may_have_changed(contrasts: tuple[_Contrast, _Contrast], size: int, sigmas: float) -> bool:
    """Return True if windows exceed the threshold by their stated errors: few scans show any."""
    means, variances = zip(*(_window_means(contrast, size) for contrast in contrasts), strict=True)
    mean_m = np.abs(_confirmed(*means))
    return bool(((mean_m > MIN_DEPTH_M) & (mean_m > sigmas * np.sqrt(np.fmin(*variances)))).any())


def _scores_of_both(
    contrasts: tuple[_Contrast, _Contrast], size: int, differences_m: Floats, rock: Bools
) -> tuple[Floats, Floats]:
    """Return mean excess [m] and z of windows that both scans confirm, else 0.

    The variance is that of the errors, or what the window scattered before, if that is more. If windows
    around it have a larger z than normal errors, so has this one.
    """
    scatter_m2 = SCATTER_VARIANCE * window_scatter(differences_m, size)
    height, width = scatter_m2.shape
    middle = size // 2
    ground = rock[middle : middle + height, middle : middle + width]
    means, scores = [], []
    for contrast in contrasts:
        mean_m, variance_m2 = _window_means(contrast, size)
        z = mean_m / np.sqrt(np.maximum(variance_m2, scatter_m2))
        z /= np.fmax(surroundings(np.abs(z), ground) / MEDIAN_ABSOLUTE_NORMAL, 1.0)
        for kind in (ground, ~ground):
            z[kind] /= _tail_factor(np.abs(z[kind]))
        means.append(mean_m)
        scores.append(z)
    return _confirmed(*means), _confirmed(*scores)


def _window_means(contrast: _Contrast, size: int) -> tuple[Floats, Floats]:
    """Return mean excess [m] and its variance of all windows (by - size + 1, bx - size + 1).

    They are NaN where a window is hardly observed.
    """
    observed = np.isfinite(contrast.excess_m) & (contrast.random_m2 > 0)
    count = _window_sums(observed, size)
    count[count < MIN_OBSERVED * size**2] = np.nan
    mean_m, random_m2, contrast_m2 = (
        _window_sums(np.where(observed, values, 0.0), size) / count
        for values in (contrast.excess_m, contrast.random_m2, contrast.contrast_m2)
    )
    return mean_m, random_m2 / count + contrast_m2


def _tail_factor(absolute_z: Floats) -> float:
    """Return by how much the tail of z is larger than of normal errors, at least 1.

    Outliers are left out: they may be events.
    """
    errors = absolute_z[absolute_z < OUTLIER_SIGMAS]
    return max(float(np.quantile(errors, TAIL_QUANTILE)) / TAIL_SIGMAS, 1.0) if len(errors) else 1.0


def _window_sums(values: Floats | Bools, size: int) -> Floats:
    """Return the sums over all windows of size × size."""
    total = np.zeros((values.shape[0] + 1, values.shape[1] + 1))
    np.cumsum(np.cumsum(values, axis=0, dtype=np.float64), axis=1, out=total[1:, 1:])
    return np.asarray(
        total[size:, size:] - total[:-size, size:] - total[size:, :-size] + total[:-size, :-size]
    )


def _confirmed(first: Floats, second: Floats) -> Floats:
    """Return the value with the smaller magnitude where both have the same sign, else 0."""
    return np.where(first * second > 0, np.sign(first) * np.fmin(np.abs(first), np.abs(second)), 0.0)


def _widespread_regions(first: _Contrast, second: _Contrast, sigmas: float) -> Iterator[Region]:
    """Yield the tiles that rose, and those that fell, if they are many."""
    means, z = zip(*(_tile_scores(contrast) for contrast in (first, second)), strict=True)
    mean_m, tile_z = _confirmed(*means), _confirmed(*z)
    observed = np.isfinite(means[0])
    block_tile = tuple(np.indices(first.change_m.shape) // TILE)
    for sign in (1, -1):
        changed = observed & (sign * tile_z > sigmas) & (sign * mean_m > MIN_WIDESPREAD_M)
        if np.count_nonzero(changed) < max(WIDESPREAD_SHARE * np.count_nonzero(observed), 4):
            continue
        blocks = changed[block_tile] & np.isfinite(first.change_m) & np.isfinite(second.change_m)
        most = float(np.max(sign * tile_z))
        mean_change_m = float(_confirmed(first.change_m, second.change_m)[blocks].mean())
        yield Region(blocks, sign, widespread=True, mean_m=mean_change_m, sigmas=most)


def _tile_scores(contrast: _Contrast) -> tuple[Floats, Floats]:
    """Return the median change [m] of each tile (ty, tx) and its z; NaN where not observed."""
    independent_m2 = contrast.random_m2 + PATCH_BLOCKS * contrast.patchy_m2
    change_m, random_m2, systematic_m2 = (
        _tiles(values) for values in (contrast.change_m, independent_m2, contrast.systematic_m2)
    )
    observed = np.isfinite(change_m)
    count = observed.sum(axis=2)
    mean_m = np.where(count >= MIN_BLOCKS, _nanmedian(change_m, 2), np.nan)
    variances = [
        np.where(observed, v, 0.0).sum(axis=2) / np.maximum(count, 1) for v in (random_m2, systematic_m2)
    ]
    with np.errstate(divide="ignore", invalid="ignore"):
        z = mean_m / np.sqrt(MEDIAN_VARIANCE * variances[0] / np.maximum(count, 1) + variances[1])
    return mean_m, np.nan_to_num(z)


def surrounding_weights(blocks: Bools, usable: Bools, margin: int = TILE) -> Floats:
    """Return weights (by, bx) of the mean of `blocks` less that of the usable blocks around them.

    Around is the rectangle of the blocks, widened by `margin`. Without usable blocks it is the plain mean.
    """
    rows, columns = (np.flatnonzero(blocks.any(axis=axis)) for axis in (1, 0))
    window = tuple(
        slice(max(int(index[0]) - margin, 0), int(index[-1]) + margin + 1) for index in (rows, columns)
    )
    around = np.zeros_like(blocks)
    near = ndimage.binary_dilation(blocks, NEIGHBOURS)
    around[window] = usable[window] & ~near[window]
    weights = blocks / int(np.count_nonzero(blocks))
    return weights - around / max(int(np.count_nonzero(around)), 1)


def overlaps(first: Bools, second: Bools, margin: int = 1) -> bool:
    """Return True if regions (by, bx) overlap, or are less than `margin` blocks apart."""
    return bool((ndimage.binary_dilation(first, NEIGHBOURS, margin) & second).any())


def distance_blocks(first: Bools, second: Bools) -> float:
    """Return the distance between two regions (by, bx) [blocks]."""
    distance = ndimage.distance_transform_edt(~first)
    return float(distance[second].min())
