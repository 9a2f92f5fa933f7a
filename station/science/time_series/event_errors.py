"""Errors of blocks and of events: systematic ones, alone and against what surrounds them, and patches.

Source: equations.md, 6.11.
"""

from __future__ import annotations

from functools import cached_property
from typing import TypeGuard

import numpy as np
from scipy import ndimage, sparse

from station.quantities import Bools, Floats, Ints, Reals, SharedParameters
from station.science.analysis.calibration import SparseJacobian, group_means
from station.science.geometry.robust_statistics import MEDIAN_ABSOLUTE_NORMAL
from station.science.time_series.contrast_errors import ContrastErrors
from station.science.time_series.events import BlockErrors
from station.science.time_series.surroundings import SURROUNDING_TILES, TILE
from station.science.uncertainty.jacobian import HeightJacobian, line_tilt_variance
from station.science.uncertainty.parameters import knot_interpolation

LEAST_SQUARES = 30  # around a region, in any position, for their scatter


class SystematicErrors:
    """Systematic errors of blocks (by, bx), by the shared parameters of a difference of scans.

    `jacobian` is of the observed blocks, `rock` marks those of bare ground. The errors are zero without a
    Jacobian, and for parameters that are not its own.
    """

    def __init__(self, jacobian: HeightJacobian | None, observed: Bools, rock: Bools) -> None:
        self._jacobian, self._observed, self._rock = jacobian, observed, rock

    def of_scan(self, newest: SharedParameters | None, oldest: SharedParameters | None) -> BlockErrors:
        """Return the errors of a scan less the newest, and less the oldest, of the scans before it."""
        return BlockErrors(self.of_blocks(newest), self.against_surroundings(newest), self.of_blocks(oldest))

    def of_blocks(self, difference: SharedParameters | None) -> Floats:
        """Return the variance of each block (by, bx) [m²]."""
        if self._jacobian is None or not self._are_known(difference):
            return np.zeros(self._observed.shape)
        return self._placed(self._jacobian.variance(difference))

    def against_surroundings(self, difference: SharedParameters | None) -> ContrastErrors | Floats:
        """Return the errors of the blocks less those of what surrounds them, or zeros (by, bx) [m²]."""
        if self._jacobian is None or not self._are_known(difference):
            return np.zeros(self._observed.shape)
        params = self._jacobian.params
        return ContrastErrors(
            self._observed,
            *self._surroundings,
            difference.covariance,
            np.asarray(self._jacobian.sight_tilt, np.float64),
            self._jacobian.line,
            knot_interpolation(params).residual_projector ** 2 @ line_tilt_variance(params, difference),
        )

    def of_sum(self, weights: Floats, difference: SharedParameters | None) -> float:
        """Return the variance of a weighted sum (by, bx) [m²]."""
        if self._jacobian is None or not self._are_known(difference):
            return 0.0
        row = sparse.csr_array(weights[self._observed][None, :])
        return float(SparseJacobian(self._jacobian).sums(row).variance(np.zeros(row.shape[1]), difference)[0])

    def _are_known(self, difference: SharedParameters | None) -> TypeGuard[SharedParameters]:
        return (
            difference is not None
            and self._jacobian is not None
            and difference.names == self._jacobian.params.names
        )

    def _placed(self, values: Reals) -> Floats:
        placed = np.zeros(self._observed.shape)
        placed[self._observed] = values
        return placed

    @cached_property
    def _surroundings(self) -> tuple[sparse.csr_array, Floats, Ints]:
        """Jacobian (n, p), its mean (g, p) over the surroundings of each tile and ground, and which is whose.

        The last (n,) has the row of the second for each block.
        """
        assert self._jacobian is not None  # noqa: S101 - its caller returns before
        design = self._jacobian.to_sparse()
        row, column = (index // TILE for index in np.nonzero(self._observed))
        tiles, group = np.unique(
            np.stack([self._rock[self._observed], row, column]), axis=1, return_inverse=True
        )
        group = np.ravel(group)
        apart = np.abs(tiles[1:, :, None] - tiles[1:, None, :]).max(axis=0)
        near = (apart <= SURROUNDING_TILES // 2) & (tiles[0][:, None] == tiles[0])
        shares = sparse.csr_array(near / near.sum(axis=1, keepdims=True))
        return design, np.asarray(shares @ (group_means(group) @ design).toarray(), np.float64), group


def like_regions_variance(members: Bools, usable: Bools, change_m: Floats, random_m2: Floats) -> float:
    """Return the variance of the mean of a region (by, bx) less its surroundings, beyond random errors [m²].

    It is what squares of its area around it scatter against their own surroundings: melt and drifts of snow
    differ from place to place. Without room for them, that of single blocks.
    """
    size, reach = round(np.sqrt(np.count_nonzero(members))), SURROUNDING_TILES // 2 * TILE
    window = tuple(
        slice(max(int(index[0]) - reach, 0), int(index[-1]) + reach + 1)
        for index in (np.flatnonzero(members.any(axis=axis)) for axis in (1, 0))
    )
    seen = (usable & ~ndimage.binary_dilation(members, iterations=2))[window]
    change_m, random_m2 = (np.where(seen, values[window], 0.0) for values in (change_m, random_m2))

    def sums(values: Floats | Bools, width: int) -> Floats:
        means = ndimage.uniform_filter(values.astype(np.float64), width, mode="constant")
        return np.asarray(means * width**2)

    fields = seen, change_m, random_m2
    inside, change_inside, random_inside = (sums(values, size) for values in fields)
    around, change_around, random_around = (
        sums(values, size + 2 * TILE) - sums(values, size + 2) for values in fields
    )
    chosen = seen & (inside > size**2 / 2) & (around > size**2 / 2)
    inside, around = np.maximum(inside, 1), np.maximum(around, 1)
    if np.count_nonzero(chosen) < LEAST_SQUARES:
        excess_m, expected_m2 = (change_m - np.median(change_m[seen]))[seen], random_m2[seen]
    else:
        excess_m = (change_inside[chosen] / inside[chosen]) - change_around[chosen] / around[chosen]
        expected_m2 = (
            random_inside[chosen] / inside[chosen] ** 2 + random_around[chosen] / around[chosen] ** 2
        )
    if not len(excess_m):
        return 0.0
    scatter_m = float(np.median(np.abs(excess_m))) / MEDIAN_ABSOLUTE_NORMAL
    return max(scatter_m**2 - float(np.median(expected_m2)), 0.0)


def sampling_variance(count: Floats, cells: int, weights: Floats, change_m: Floats) -> float:
    """Return the variance of the weighted sum because the observed cells are a sample of their block.

    The scatter within a block is that of it and its neighbours, as on a steady slope of the change.
    """
    inside = weights > 0
    filled = np.where(np.isfinite(change_m), change_m, 0.0)
    number = np.maximum(ndimage.uniform_filter(np.isfinite(change_m).astype(np.float64), 3), 1 / 9)
    mean_m = ndimage.uniform_filter(filled, 3) / number
    scatter_m2 = np.maximum(ndimage.uniform_filter(filled**2, 3) / number - mean_m**2, 0.0)
    unseen = 1 - count / cells**2 if cells > 1 else np.ones_like(count)
    sample_m2 = scatter_m2 * np.clip(unseen, 0.0, 1.0) / np.maximum(count, 1)
    return float(np.sum((weights**2 * sample_m2)[inside]))
