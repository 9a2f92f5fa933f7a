"""Cells taken together into patches: what the adjustment of a scan looks at."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from station.quantities import Bools, Floats, Floats32, Ints, Ints32
from station.science.shared import GLOBAL, LINES_A_KNOT, Basis, Sensitivities

STRETCH_M = 80.0  # of range, that one patch takes together
ROUNDS = 3
CAUCHY = 2.385  # 95 % efficient for normal errors
CHI2_MEDIAN = 0.45494  # of one degree of freedom


class Kind(IntEnum):
    """What a cell is taken for."""

    MOVING = 0  # ground that changes, but not steeply from place to place
    STABLE = 1
    WITHHELD = 2  # stable, and kept out of every fit
    UNUSED = 3


@dataclass(frozen=True)
class Cells:
    """Some cells (n,) of a scan: residual to the reference, its random variance, and what they feel."""

    felt: Sensitivities
    range_m: Floats  # horizontal
    kind: Ints
    residual_m: Floats
    variance_m2: Floats
    one_in: tuple[int, int] = (1, 1)  # of so many cells one is looked at: of moving ones, of stable ones


@dataclass(frozen=True)
class Patches:
    """Cells of one group of lines, one stretch of range and one kind, taken together: m observations."""

    felt: Sensitivities  # of the patch's mean
    stretch: Ints  # (m,) of range
    kind: Ints  # (m,)
    residual_m: Floats  # (m,) above the reference surface
    variance_m2: Floats  # (m,) of their random errors
    cells: Floats  # (m,) how many
    one_in: tuple[int, int] = (1, 1)  # as of its cells

    def __len__(self) -> int:
        """Return how many there are."""
        return len(self.residual_m)

    def some(self, chosen: Bools) -> Patches:
        """Return the chosen (m,)."""
        return Patches(
            self.felt.some(chosen),
            self.stretch[chosen],
            self.kind[chosen],
            self.residual_m[chosen],
            self.variance_m2[chosen],
            self.cells[chosen],
            self.one_in,
        )


def collect(of: Basis, bands: Iterable[Cells], reach_m: float) -> Patches:
    """Take the cells of all bands together; outliers among the cells of a patch count little."""
    stretches = int(reach_m / STRETCH_M) + 1
    a_kind = of.line_count * stretches
    size = a_kind * Kind.UNUSED
    sums = np.zeros((len(GLOBAL) + 4, Kind.UNUSED, of.line_count, stretches))
    held: list[tuple[Ints32, Floats32, Floats32]] = []
    one_in = (1, 1)
    for cells in bands:
        used, one_in = np.flatnonzero(cells.kind != Kind.UNUSED), cells.one_in
        if not len(used):
            continue
        felt, kind, line = cells.felt, cells.kind[used], cells.felt.line[used]
        stretch = np.minimum((cells.range_m[used] / STRETCH_M).astype(np.int64), stretches - 1)
        precision = 1 / cells.variance_m2[used]
        # Cells of a band lie in few lines: to sum up over all of them each time takes most of the time.
        first, lines = int(line.min()), int(np.ptp(line)) + 1
        near = (kind * lines + line - first) * stretches + stretch
        total = sums[:, :, first : first + lines]
        for row, effect in enumerate([*felt.globals_, felt.lean, felt.refraction, felt.across, None]):
            weighted = precision if effect is None else precision * effect[used]
            total[row] += np.bincount(near, weighted, total[row].size).reshape(total[row].shape)
        key = kind * a_kind + line * stretches + stretch
        held.append(
            (key.astype(np.int32), cells.residual_m[used].astype(np.float32), precision.astype(np.float32))
        )
    if not held:
        held.append((np.empty(0, np.int32), np.empty(0, np.float32), np.empty(0, np.float32)))
    key, residual_m, weight = (np.concatenate(parts) for parts in zip(*held, strict=True))
    held.clear()  # of many cells it is the most that is held here
    of_patch = sums.reshape(len(sums), size)
    there = np.flatnonzero(of_patch[-1])
    mean_m, variance_m2, count = (values[there] for values in _robust_means(key, residual_m, weight, size))
    effects = of_patch[:-1, there] / of_patch[-1, there]
    place = there % a_kind
    passed = (place // stretches + 0.5) / LINES_A_KNOT
    lean, refraction, across = effects[len(GLOBAL) :]
    felt = Sensitivities(of, effects[: len(GLOBAL)], lean, refraction, across, passed)
    return Patches(felt, place % stretches, there // a_kind, mean_m, variance_m2, count, one_in)


def _robust_means(
    key: Ints32, residual_m: Floats32, weight: Floats32, size: int
) -> tuple[Floats, Floats, Floats]:
    """Mean, its random variance and the number of cells by patch (size,), after Cauchy's weights."""
    trusted = weight
    scale2 = 1.0
    centre_m = np.zeros(size)
    for _ in range(ROUNDS):
        mass = np.bincount(key, trusted, size)
        centre_m = np.bincount(key, trusted * residual_m, size) / np.maximum(mass, 1e-100)
        apart = (residual_m - centre_m.astype(np.float32)[key]) ** 2 * weight
        if len(apart):
            scale2 = max(float(np.median(apart)) / CHI2_MEDIAN, 1.0)
        trusted = weight / (1 + apart / np.float32(CAUCHY**2 * scale2))
    mass = np.maximum(np.bincount(key, trusted, size), 1e-100)
    variance_m2 = scale2 * np.bincount(key, trusted**2 / weight, size) / mass**2
    return centre_m, variance_m2, np.bincount(key, minlength=size).astype(np.float64)
