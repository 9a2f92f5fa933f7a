"""What surrounds blocks: tiles of blocks, and medians over them. Source: equations.md, 6.11."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from station.quantities import Bools, Floats

TILE = 10  # blocks along the edge of a tile, over which surroundings are averaged
LEAST_IN_TILE = 25  # blocks of the same ground
SURROUNDING_TILES = 7  # along the edge of the surroundings of a tile
NEIGHBOURS = np.ones((3, 3), np.bool_)  # of a block, itself included


def surroundings(values: Floats, rock: Bools, excluded: Bools | None = None) -> Floats:
    """Return the median of what surrounds each block (by, bx): bare ground of bare ground, others of others.

    It is the median over tiles of their medians, interpolated between tiles, NaN where none is observed. A
    tile in which few blocks are of that ground may be all edge: it counts only if there is no other.
    """
    result = np.full(values.shape, np.nan)
    for ground in (rock, ~rock):
        used = ground if excluded is None else ground & ~excluded
        blocks = tiles_of(np.where(used, values, np.nan))
        tiles = nanmedian(blocks, 2)
        full = np.isfinite(blocks).sum(axis=2) >= LEAST_IN_TILE
        if full.any():
            tiles[~full] = np.nan
        margin = SURROUNDING_TILES // 2
        padded = np.pad(tiles, margin, constant_values=np.nan)
        shape = SURROUNDING_TILES, SURROUNDING_TILES
        around = np.lib.stride_tricks.sliding_window_view(padded, shape).reshape(*tiles.shape, -1)
        smooth = nanmedian(around, 2)
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


def tiles_of(values: Floats) -> Floats:
    """Return the blocks (ty, tx, TILE²) of each tile, NaN beyond the edges."""
    height, width = (-(-size // TILE) for size in values.shape)
    padded = np.full((height * TILE, width * TILE), np.nan)
    padded[: values.shape[0], : values.shape[1]] = values
    return padded.reshape(height, TILE, width, TILE).swapaxes(1, 2).reshape(height, width, TILE**2)


def nanmedian(values: Floats, axis: int) -> Floats:
    """Return the median of the finite values along an axis, NaN without any, at a tenth of numpy's time."""
    ordered = np.sort(values, axis=axis)  # NaN last
    count = np.isfinite(values).sum(axis=axis, keepdims=True)
    lower, upper = (
        np.take_along_axis(ordered, np.maximum(rank, 0), axis) for rank in ((count - 1) // 2, count // 2)
    )
    upper = np.where(count > 0, upper, np.nan)
    return np.asarray(np.squeeze((lower + upper) / 2, axis))


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
