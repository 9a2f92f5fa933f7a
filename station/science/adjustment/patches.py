"""Patches: cells aggregated into the observations of the adjustment."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from station.quantities import Bools, Floats, Floats32, Grid, Ints, Ints32, Reals
from station.science.uncertainty.jacobian import HeightJacobian
from station.science.uncertainty.parameters import GLOBAL, LINE_GROUPS_PER_KNOT, ParameterLayout

RANGE_BIN_M = 80.0  # range extent of a patch
FACE_BINS = 8  # of a face, from its foot to its top
ROBUST_ITERATIONS = 3
CAUCHY = 2.385  # 95 % efficient for normal errors
CHI2_MEDIAN = 0.45494  # with one degree of freedom


class GroundClass(IntEnum):
    """Ground class of a cell: its role in the adjustment."""

    MOVING = 0  # ground that changes smoothly in space
    STABLE = 1
    HOLDOUT = 2  # stable, but excluded from every fit
    UNUSED = 3


@dataclass(frozen=True)
class CellObservations:
    """Cells (n,) of a scan: Jacobian, ground class, residual to the reference and its random variance."""

    jacobian: HeightJacobian
    range_m: Reals  # along the scan line, see `distance_along_line`
    height_m: Reals  # above the scanner
    ground_class: Ints
    residual_m: Floats
    variance_m2: Floats
    sampling_ratio: Reals  # roughness of the ground against the grazing angle (`variance_factors`)
    sampling_step: tuple[int, int] = (1, 1)  # every n-th cell is used: n of moving, of stable cells


@dataclass(frozen=True)
class Patches:
    """Patches (m,): cells of one line group, range bin and ground class, one observation each."""

    jacobian: HeightJacobian  # of the mean height of the patch
    range_bin: Ints  # (m,) index of the bin along the scan line, see `distance_along_line`
    height_m: Floats  # (m,) above the scanner
    ground_class: Ints  # (m,)
    residual_m: Floats  # (m,) above the reference surface
    variance_m2: Floats  # (m,) random variance of the residual
    cell_count: Floats  # (m,)
    sampling_ratio: Floats  # (m,) mean of the cells
    sampling_step: tuple[int, int] = (1, 1)  # that of the cells
    bin_m: float = RANGE_BIN_M  # extent of a range bin

    def __len__(self) -> int:
        """Return the number of patches."""
        return len(self.residual_m)

    def take(self, selection: Bools) -> Patches:
        """Return the selected patches."""
        return Patches(
            self.jacobian.take(selection),
            self.range_bin[selection],
            self.height_m[selection],
            self.ground_class[selection],
            self.residual_m[selection],
            self.variance_m2[selection],
            self.cell_count[selection],
            self.sampling_ratio[selection],
            self.sampling_step,
            self.bin_m,
        )


def distance_along_line(grid: Grid, cell: Ints32, offset_m: tuple[Reals, Reals, Reals]) -> Reals:
    """Return how far cells (n,) lie along their scan lines [m]: from the scanner, on a face from its foot.

    On the map that is the horizontal range. Up a face the range hardly changes.
    """
    if grid.plane.is_map:
        return np.asarray(np.hypot(*offset_m[:2]))
    row, _ = grid.row_and_column(cell)
    return np.asarray((grid.ny - 0.5 - row) * grid.cell_m)


def line_length(grid: Grid, range_max_m: float) -> tuple[float, float]:
    """Return the largest distance along a scan line, and the extent of a patch along it [m]."""
    if grid.plane.is_map:
        return range_max_m, RANGE_BIN_M
    height_m = grid.ny * grid.cell_m
    return height_m, height_m / FACE_BINS


def aggregate_patches(
    params: ParameterLayout,
    blocks: Iterable[CellObservations],
    max_range_m: float,
    bin_m: float = RANGE_BIN_M,
) -> Patches:
    """Return the patches of all cells, with robust means: outliers in a patch get small weights.

    `max_range_m` is the largest range; cells beyond it go to the last range bin.
    """
    range_bins = int(max_range_m / bin_m) + 1
    class_size = params.line_groups * range_bins
    size = class_size * GroundClass.UNUSED
    sums = np.zeros((len(GLOBAL) + 6, GroundClass.UNUSED, params.line_groups, range_bins))
    collected: list[tuple[Ints32, Floats32, Floats32]] = []
    sampling_step = (1, 1)
    for cells in blocks:
        used, sampling_step = np.flatnonzero(cells.ground_class != GroundClass.UNUSED), cells.sampling_step
        if not len(used):
            continue
        jacobian, ground_class, line = cells.jacobian, cells.ground_class[used], cells.jacobian.line[used]
        range_bin = np.minimum((cells.range_m[used] / bin_m).astype(np.int64), range_bins - 1)
        precision = 1 / cells.variance_m2[used]
        # A block covers few line groups; adding to all groups for every block would dominate the run time.
        first, lines = int(line.min()), int(np.ptp(line)) + 1
        local_key = (ground_class * lines + line - first) * range_bins + range_bin
        total = sums[:, :, first : first + lines]
        effects = *jacobian.pose, jacobian.sight_tilt, jacobian.refraction, jacobian.cross_tilt
        for row, effect in enumerate([*effects, cells.height_m, cells.sampling_ratio, None]):
            weighted = precision if effect is None else precision * effect[used]
            total[row] += np.bincount(local_key, weighted, total[row].size).reshape(total[row].shape)
        key = ground_class * class_size + line * range_bins + range_bin
        collected.append(
            (key.astype(np.int32), cells.residual_m[used].astype(np.float32), precision.astype(np.float32))
        )
    if not collected:
        collected.append((np.empty(0, np.int32), np.empty(0, np.float32), np.empty(0, np.float32)))
    key, residual_m, weight = (np.concatenate(parts) for parts in zip(*collected, strict=True))
    collected.clear()  # frees the largest arrays of this function
    patch_sums = sums.reshape(len(sums), size)
    occupied = np.flatnonzero(patch_sums[-1])
    mean_m, variance_m2, count = (values[occupied] for values in _robust_means(key, residual_m, weight, size))
    means = patch_sums[:-1, occupied] / patch_sums[-1, occupied]
    patch_index = occupied % class_size
    knot_position = (patch_index // range_bins + 0.5) / LINE_GROUPS_PER_KNOT
    sight_tilt, refraction, cross_tilt, height_m, sampling_ratio = means[len(GLOBAL) :]
    jacobian = HeightJacobian(params, means[: len(GLOBAL)], sight_tilt, refraction, cross_tilt, knot_position)
    return Patches(
        jacobian,
        patch_index % range_bins,
        height_m,
        occupied // class_size,
        mean_m,
        variance_m2,
        count,
        sampling_ratio,
        sampling_step,
        bin_m,
    )


def _robust_means(
    key: Ints32, residual_m: Floats32, weight: Floats32, size: int
) -> tuple[Floats, Floats, Floats]:
    """Return the mean, its random variance and the number of cells by patch (size,), with Cauchy weights."""
    robust_weight = weight
    scale2 = 1.0
    centre_m = np.zeros(size)
    for _ in range(ROBUST_ITERATIONS):
        weight_sum = np.bincount(key, robust_weight, size)
        centre_m = np.bincount(key, robust_weight * residual_m, size) / np.maximum(weight_sum, 1e-100)
        squared_ratio = (residual_m - centre_m.astype(np.float32)[key]) ** 2 * weight
        if len(squared_ratio):
            scale2 = max(float(np.median(squared_ratio)) / CHI2_MEDIAN, 1.0)
        robust_weight = weight / (1 + squared_ratio / np.float32(CAUCHY**2 * scale2))
    weight_sum = np.maximum(np.bincount(key, robust_weight, size), 1e-100)
    variance_m2 = scale2 * np.bincount(key, robust_weight**2 / weight, size) / weight_sum**2
    return centre_m, variance_m2, np.bincount(key, minlength=size).astype(np.float64)
