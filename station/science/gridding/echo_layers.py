"""Layers of height in each cell: they tell the surface from echoes of the air above it.

Source: equations.md, 6.6.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from station.quantities import Bools, Floats, Floats32, Ints, Ints32, Reals

MIN_THICKNESS_M = 2.0
THICKNESS_SIGMAS = 3.5  # of a point in the cell; with the layers next to it the usual one reaches 5 σ
RELIEF_CELLS = 0.5  # relief within a cell whose roughness is unknown
THICKNESS_CELLS = 2.0  # without a reference: no gap in a cell that slopes by less than 55°
THICKEST = 10  # doublings of the smallest thickness
OUTERMOST = 32767  # layers count from that around the reference or datum, 0, as far as 16 bits can
USUAL_WEIGHT = 10  # ground at its usual height may return a tenth of the echoes of a cloud before it
MIN_SURFACE_POINTS = 3  # fewer, far from the reference, need the support of adjacent cells
SIMILAR_SHARE = 0.25  # of a change, or two layers
MIN_SUPPORT = 2  # adjacent cells with a similar change
MAX_SURFACE_LAYERS = 4  # a run of more, far from the reference, is no surface but a cloud
MAX_STORED_LAYERS = 2**18  # beyond, those with the fewest echoes are dropped
PENDING_POINTS = 2**16
BLOCK_CELLS = 100_000

KEY_BITS = 17  # for layers, in keys that sort by cell and layer


def thickness_code(
    point_variance_m2: Reals, cell_m: float, *, is_roughness_known: bool = True
) -> NDArray[np.uint8]:
    """Return the thickness of the layers of reference cells (n,), as 1 + doublings of the smallest one."""
    least_m = 0.0 if is_roughness_known else RELIEF_CELLS * cell_m
    # A cell whose echoes scatter by more than itself contains none of the ground.
    most_m = max(MIN_THICKNESS_M, THICKNESS_CELLS * cell_m)
    needed_m2 = np.clip(THICKNESS_SIGMAS**2 * np.nan_to_num(point_variance_m2), least_m**2, most_m**2)
    code = np.ones(len(needed_m2), np.uint8)
    thicker = np.flatnonzero(needed_m2 > MIN_THICKNESS_M**2)  # the few cells on rough ground
    doublings = np.ceil(0.5 * np.log2(needed_m2[thicker] / MIN_THICKNESS_M**2))
    code[thicker] += np.minimum(doublings, THICKEST).astype(np.uint8)
    return code


def _layers_per_m(cell_m: float) -> Floats:
    """Return the reciprocal of the thickness by code [1/m]; code 0 is a cell without reference."""
    unknown_m = max(MIN_THICKNESS_M, THICKNESS_CELLS * cell_m)
    return 1 / np.concatenate([[unknown_m], MIN_THICKNESS_M * 2.0 ** np.arange(THICKEST + 1)])


@dataclass(frozen=True)
class LayerSums:
    """Sums over the echoes of runs of adjacent layers in cells (n,): see `CellSums`."""

    cell_index: Ints
    low: Ints  # lowest layer
    high: Ints
    count: Ints
    residual: Ints
    square: Ints
    intensity: Ints

    def __len__(self) -> int:
        """Return the number of runs."""
        return len(self.cell_index)

    @classmethod
    def concatenate(cls, parts: list[LayerSums]) -> LayerSums:
        """Return the runs of all parts."""
        return cls(
            *(np.concatenate([getattr(part, column.name) for part in parts]) for column in fields(cls))
        )

    def take(self, selection: Ints) -> LayerSums:
        """Return the selected runs."""
        return LayerSums(*(getattr(self, column.name)[selection] for column in fields(self)))

    def merged(self, *, adjacent: bool) -> LayerSums:
        """Return the sums of equal layers, or of all that overlap or are `adjacent`, by cell and height."""
        if not len(self):
            return self
        first = self.cell_index << KEY_BITS
        order = np.argsort(first + self.low + OUTERMOST, kind="stable")
        first, cell_index, low = first[order], self.cell_index[order], self.low[order]
        highest = np.maximum.accumulate(first + self.high[order] + OUTERMOST)  # so far, in the cell
        gap = first[1:] + low[1:] + OUTERMOST > highest[:-1] + int(adjacent)
        starts = np.flatnonzero(np.concatenate([[True], gap]))
        sums = (
            np.add.reduceat(values[order], starts)
            for values in (self.count, self.residual, self.square, self.intensity)
        )
        ends = np.append(starts[1:], len(order)) - 1
        return LayerSums(cell_index[starts], low[starts], (highest - first)[ends] - OUTERMOST, *sums)


class EchoLayers:
    """The layers with echoes of each cell: a run of adjacent ones in dense sums, all others in a small table.

    The run of a cell is the usual layer, around the reference, or else starts with that of its first echo,
    and grows by adjacent layers. Whatever the order of the echoes, run and table together are the same layers
    with the same sums.
    """

    def __init__(self, cells: int, cell_m: float, thickness: NDArray[np.uint8]) -> None:
        """Start without echoes; `thickness` (n,) are the codes of the reference cells."""
        self._layers_per_m = _layers_per_m(cell_m)
        self._reference_cells = len(thickness)
        self._thickness = thickness if thickness.any() and thickness.max() > 1 else None
        self._run = np.zeros((cells + 1, 2), np.int16)  # lowest and highest layer
        self._table: list[LayerSums] = []
        self._pending = 0
        self.dropped = 0  # echoes of layers that the table had no room for

    def outside(self, cell_index: Ints, residual_m: Floats) -> tuple[Ints, Ints]:
        """Return the echoes (m,) of a block (n,) outside the runs of their cells, and their layers."""
        unusual = self._run.view(np.int32).reshape(-1).take(cell_index) != 0
        unusual |= np.abs(residual_m) > MIN_THICKNESS_M / 2
        echo = np.flatnonzero(unusual)
        cell_index = cell_index[echo]
        height = residual_m[echo] * self._layers_per_m.take(self._codes(cell_index))
        layer = np.clip(np.rint(height), -OUTERMOST, OUTERMOST).astype(np.int64)
        low, high = self._run[cell_index].T
        outside = np.flatnonzero((layer < low) | (layer > high))
        return echo[outside], layer[outside]

    def grow(self, cell_index: Ints, layer: Ints, count: Ints32) -> Bools:
        """Return True for those of the echoes (n,) outside the runs that the runs can grow to.

        `count` are the echoes in the runs by cell: an empty one takes any layer.
        """
        empty = np.flatnonzero(count.take(cell_index) == 0)
        self._run[cell_index[empty]] = layer[empty, None]  # of several the last one wins
        left = np.arange(len(cell_index))
        while True:
            low, high = self._run[cell_index[left]].T
            left = left[(layer[left] < low) | (layer[left] > high)]
            low, high = self._run[cell_index[left]].T
            below, above = left[layer[left] == low - 1], left[layer[left] == high + 1]
            if not len(below) + len(above):
                break
            self._run[cell_index[below], 0] = layer[below]
            self._run[cell_index[above], 1] = layer[above]
        joins = np.ones(len(cell_index), bool)
        joins[left] = False
        return joins

    def store(self, cell_index: Ints, layer: Ints, units: Ints, squares: Ints, intensity: Ints) -> None:
        """Add echoes (n,) outside the runs to the table: residual and its square, in units of the sums."""
        echoes = LayerSums(cell_index, layer, layer, np.ones_like(layer), units, squares, intensity)
        self._table.append(echoes.merged(adjacent=False))
        self._pending += len(self._table[-1])
        if self._pending > PENDING_POINTS:
            self._compact()

    def _compact(self) -> None:
        """Merge the parts of the table, and bound its size."""
        if not self._table:
            return
        table = LayerSums.concatenate(self._table).merged(adjacent=False)
        if len(table) > MAX_STORED_LAYERS:
            fullest = np.sort(np.argsort(-table.count, kind="stable")[: MAX_STORED_LAYERS // 2])
            self.dropped += int(table.count.sum() - table.count[fullest].sum())
            table = table.take(fullest)
        self._table, self._pending = [table], 0

    def choose(self, dense: LayerSums, reference_cells: int) -> tuple[LayerSums, int]:
        """Return the run of each cell of `dense` that is its surface, and the number of echoes below these.

        The cells are those of the table. The surface is the fullest run, of equal ones the lowest. In the
        first `reference_cells`, ground at its usual height counts more, and a cloud nothing.
        """
        # The usual layer counts as one with echoes, which it is in a run that starts with it.
        usual = LayerSums(dense.cell_index, *np.zeros((6, len(dense)), np.int64))
        runs = LayerSums.concatenate([dense, usual, *self._table]).merged(adjacent=True)
        is_usual = (runs.low <= 1) & (runs.high >= -1)
        weight = np.where(is_usual, USUAL_WEIGHT, runs.high < runs.low + MAX_SURFACE_LAYERS)
        weight[runs.cell_index >= reference_cells] = 1
        order = np.lexsort((-runs.low, runs.count * weight, runs.cell_index))
        cell_index = runs.cell_index[order]
        last = np.flatnonzero(np.append(cell_index[1:] != cell_index[:-1], True))
        chosen = runs.take(order[last])
        self._run[chosen.cell_index] = np.stack([chosen.low, chosen.high], axis=1)
        surface_low = chosen.low[np.searchsorted(chosen.cell_index, runs.cell_index)]
        return chosen, int(runs.count[runs.high < surface_low].sum())

    def cells_in_table(self) -> Ints:
        """Return the cells (m,) with layers in the table, ascending."""
        self._compact()
        return np.unique(self._table[0].cell_index) if self._table else np.empty(0, np.int64)

    @property
    def stored(self) -> int:
        """Number of echoes in the table."""
        return sum(int(part.count.sum()) for part in self._table)

    def run_bounds(self, cell_index: Ints) -> tuple[Ints, Ints]:
        """Return lowest and highest layer of the runs of cells (n,)."""
        low, high = self._run[cell_index].astype(np.int64).T
        return low, high

    def far_from_reference(self, count: Ints32) -> tuple[Ints, Bools]:
        """Return the cells (m,) of a doubtful surface far from the reference, and which of them are clouds.

        `count` (n,) are the echoes of the reference cells. A surface is doubtful if it has few of them.
        """
        cells, clouds = [np.empty(0, np.int64)], [np.empty(0, np.bool_)]
        for first in range(0, len(count), BLOCK_CELLS):
            block = slice(first, min(first + BLOCK_CELLS, len(count)))
            low, high = self._run[block].T
            is_cloud = high >= low + MAX_SURFACE_LAYERS
            doubtful = (is_cloud | (count[block] < MIN_SURFACE_POINTS)) & (count[block] > 0)
            far = np.flatnonzero(((low > 1) | (high < -1)) & doubtful)
            cells.append(first + far)
            clouds.append(is_cloud[far])
        return np.concatenate(cells), np.concatenate(clouds)

    def thickness_m(self, cell_index: Ints) -> Floats:
        """Return the thickness of the layers of cells (n,) [m]."""
        return np.asarray(1 / self._layers_per_m.take(self._codes(cell_index)))

    def _codes(self, cell_index: Ints) -> Ints:
        """Return the codes of the thickness in cells (n,)."""
        known = cell_index < self._reference_cells
        code = known.astype(np.int64)
        if self._thickness is not None:
            code[known] = self._thickness[cell_index[known]]
        return code


def supported(residual_m: Floats, neighbours_m: Floats32, thickness_m: Floats) -> Bools:
    """Return True for cells (n,) whose change is similar in enough adjacent cells (n, 8), NaN if unknown [m].

    Echoes of the air are alone, real change is not.
    """
    tolerance_m = np.maximum(2 * thickness_m, SIMILAR_SHARE * np.abs(residual_m))
    similar = np.abs(neighbours_m - residual_m[:, None]) <= tolerance_m[:, None]
    return np.asarray(similar.sum(axis=1) >= MIN_SUPPORT)
