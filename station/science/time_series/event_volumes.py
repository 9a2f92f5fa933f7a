"""Volume of an event: the weights of its blocks, those at its edge, and what surrounds it.

Source: equations.md, 6.11.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from station.quantities import Bools, Floats
from station.science.analysis.voids import area_weights, void_variance
from station.science.time_series.event_errors import like_regions_variance
from station.science.time_series.event_tracks import Track
from station.science.time_series.events import BlockLevels
from station.science.time_series.surroundings import NEIGHBOURS, surrounding_weights

EDGE_BLOCKS = 2  # around what was detected: an event covers them in part
EDGE_SIGMAS = 3.0  # of a block at the edge that has changed the other way: it belongs to another event
EDGE_SHARE = 0.25  # one sigma of the change of a block at the edge, over the mean change of the event
TINY_M2 = 1e-12  # against division by zero


@dataclass(frozen=True)
class VolumeParts:
    """A volume as a weighted sum of the change of blocks, in units of a block."""

    weights: Floats  # (by, bx)
    sum_m: float  # of the change
    variance_m2: float  # random, and of what was not observed; without systematic errors


def volume_parts(
    track: Track, change: BlockLevels, rock: Bools, others: Bools, surface: Bools
) -> VolumeParts | None:
    """Return the weights of an event's volume, its sum and random variance; None if nothing was observed.

    A widespread event counts in full, another one less what its surroundings did, on ground of its own kind
    that no other event has changed. `rock` marks bare ground, `others` (by, bx) the blocks of other events,
    `surface` those in which the reference is known: blocks within the event that were not observed are
    interpolated.
    """
    known = np.isfinite(change.change_m)
    core = track.blocks & known
    if not core.any():
        return None
    ground = rock if rock[core].mean() > 0.5 else ~rock
    usable = known & ground & ~others
    members = core.copy() if track.widespread else _with_edge(track, core, known, usable, change, surface)
    filled, distance = area_weights(members, known)
    around, level_m = np.zeros_like(filled), 0.0
    if not track.widespread:
        around, level_m = _surrounding_level(members, usable, change.change_m)
    edge_m2 = (EDGE_SHARE * (float(change.change_m[core].mean()) - level_m)) ** 2
    edge = members & known & ~core
    left_out = np.where(edge, change.random_m2 / np.maximum(edge_m2 + change.random_m2, TINY_M2), 0.0)
    blocks = int(np.count_nonzero(members))
    weights = blocks * filled * (1 - left_out)
    variance_m2 = edge_m2 * float(np.sum((blocks * filled * left_out) ** 2))
    variance_m2 += blocks**2 * void_variance(members, distance, change.change_m, change.random_m2)
    if around.any():
        patches_m2 = like_regions_variance(members, usable, change.change_m, change.random_m2)
        variance_m2 += weights.sum() ** 2 * patches_m2
    weights = weights - weights.sum() * around
    variance_m2 += float(np.sum((weights**2 * change.random_m2)[known]))
    return VolumeParts(weights, float(np.sum((weights * change.change_m)[known])), variance_m2)


def mean_level(first: BlockLevels, second: BlockLevels) -> BlockLevels:
    """Return the mean level of two scans (by, bx), that of one where the other lacks it."""
    levels_m = np.stack([first.change_m, second.change_m])
    observed = np.isfinite(levels_m)
    count = observed.sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean_m = np.where(observed, levels_m, 0.0).sum(axis=0) / count
        random_m2 = np.where(observed, [first.random_m2, second.random_m2], 0.0).sum(axis=0) / count**2
    return BlockLevels(mean_m, random_m2)


def _surrounding_level(blocks: Bools, usable: Bools, change_m: Floats) -> tuple[Floats, float]:
    """Return the weights (by, bx) of the usable blocks around some, and their mean change [m]."""
    around = np.maximum(-surrounding_weights(blocks, usable), 0.0)
    return around, float(np.sum((around * change_m)[around > 0]))


def _with_edge(
    track: Track, core: Bools, known: Bools, usable: Bools, change: BlockLevels, surface: Bools
) -> Bools:
    """Return the blocks (by, bx) of an event, with those at its edge, and those within that were not seen.

    Blocks at the edge that changed the other way belong to another event.
    """
    _, level_m = _surrounding_level(core, usable, change.change_m)
    opposite_m = -track.sign * (change.change_m - level_m)
    edge = ndimage.binary_dilation(core, NEIGHBOURS, EDGE_BLOCKS) & known
    inside = ndimage.binary_closing(core, NEIGHBOURS, EDGE_BLOCKS) & ~known & surface
    with np.errstate(invalid="ignore"):
        is_its = opposite_m < EDGE_SIGMAS * np.sqrt(change.random_m2)
    return np.asarray(core | (edge & is_its) | inside)
