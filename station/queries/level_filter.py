"""The filter of level and rate over the epochs of a store, of all cells of the grid or those of an area."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from station.archive.derived.computed_rasters import CHANGE, RANDOM, TOTAL, open_raster
from station.archive.derived.level_files import LEVEL_NAMES
from station.archive.epochs import EpochRef
from station.archive.schema import FILL
from station.quantities import Bools, Floats, Floats32, Reference
from station.queries.blocks import BlockQueries, mean_covariances
from station.science.time_series.cell_filter import CellFilter, Motion, ProcessNoise
from station.science.time_series.class_filter import SAMPLE_CELLS, ClassFilter
from station.science.time_series.filter_errors import day_rates, filter_errors

Cells = NDArray[np.int32]  # indices in the flattened grid
Array = np.ndarray[Any, Any]
DAY_S = 86_400.0
BLOCK_CELLS = 50_000  # filtered at once
BAND_ROWS = 128  # read at once
MIN_RANDOM_SHARE = 0.01  # of the random variance of a change that is the scan's, at least
EPOCHS_COMPARED = 3  # of a day, to see what their errors have in common
MIN_SIGMA_M = 1e-4  # of a reference, for its octave


@dataclass(frozen=True)
class _Observations:
    """Change and variances of an epoch at cells (n,), NaN where there is none."""

    change_m: Floats32
    random_m2: Floats32  # without the reference's
    systematic_m2: Floats32

    def take(self, index: Array | slice) -> tuple[Floats, Floats, Floats]:
        """Return change and variances of some cells in double precision."""
        change_m, random_m2, systematic_m2 = (
            values[index].astype(np.float64) for values in vars(self).values()
        )
        return change_m, random_m2, systematic_m2


class LevelFilter:
    """Filters of cells, and of the classes of cells of the grid, from the first epoch of a reference on.

    The classes are those of the whole grid, so that a cell has the same level in any area.
    """

    def __init__(self, reference: Reference, blocks: BlockQueries, area: Bools | None = None) -> None:
        """Prepare for the known cells of an area (ny, nx), or of the whole grid."""
        surface = np.asarray(reference.elevation_m)
        self._shape: tuple[int, int] = surface.shape
        known = np.flatnonzero(np.isfinite(surface)).astype(np.int32)
        variance_m2 = np.asarray(reference.random_variance_m2).ravel()[known]
        stable = np.asarray(reference.stable).ravel()[known]
        classes = _classes(stable, variance_m2)
        members = [np.flatnonzero(classes == number) for number in np.unique(classes).tolist()]
        samples = [
            chosen[np.linspace(0, len(chosen) - 1, min(len(chosen), SAMPLE_CELLS)).astype(np.int64)]
            for chosen in members
        ]
        self._classes = [ClassFilter(len(sample), stable=bool(stable[sample].all())) for sample in samples]
        sample = np.concatenate([np.empty(0, np.int64), *samples])
        chosen = slice(None) if area is None else np.flatnonzero(area.ravel()[known])
        self._position = chosen  # of its cells among the known ones
        self._cell, self._class, self._reference_m2 = known[chosen], classes[chosen], variance_m2[chosen]
        self._read_cells = known if area is None else np.union1d(self._cell, known[sample])
        self._read_reference_m2 = (
            variance_m2 if area is None else variance_m2[np.searchsorted(known, self._read_cells)]
        )
        self._sample = np.searchsorted(self._read_cells, known[sample])
        self._bounds = np.cumsum([0, *map(len, samples)])
        self._filter = CellFilter.empty(len(self._cell))
        self._seen = np.zeros(len(self._cell), np.uint16)  # epochs of this day
        self._epoch_count = 0
        self._time_s, self._common_share = np.nan, 0.0
        self._blocks = blocks

    def take_day(self, epochs: list[EpochRef], progress: Callable[[], None]) -> None:
        """Take the epochs of the next day in order of time; `progress` is called after each."""
        self._seen[:] = 0
        self._epoch_count = len(epochs)
        if not np.isnan(self._time_s):
            self._begin_day()
        for epoch in epochs:
            is_first = np.isnan(self._time_s)
            self._advance(epoch)
            if is_first:
                self._begin_day()
            progress()
        self._common_share = self._common_share_of(epochs)

    def _begin_day(self) -> None:
        """Let the day begin whose rates are given: with its first epoch, or the last of the day before."""
        self._filter.begin_day()
        for ground in self._classes:
            ground.begin_day()

    def _advance(self, epoch: EpochRef) -> None:
        days = 0.0 if np.isnan(self._time_s) else (epoch.time_s - self._time_s) / DAY_S
        self._time_s = epoch.time_s
        observations = self._read(epoch)
        steps = [
            ground.advance(days, *observations.take(self._sample[first:end]))
            for ground, first, end in zip(self._classes, self._bounds[:-1], self._bounds[1:], strict=True)
        ]
        noises, motions = (_stacked(values) for values in zip(*steps, strict=True))
        for block in self._cell_blocks():
            index: Array | slice = block
            if len(self._read_cells) > len(self._cell):
                index = np.searchsorted(self._read_cells, self._cell[block])
            change_m, random_m2, systematic_m2 = observations.take(index)
            classes = self._class[block]
            noise, motion = ProcessNoise(*noises[:, classes]), Motion(*motions[:, classes])
            self._part(block).advance(days, noise, motion, change_m, random_m2, systematic_m2)
            self._seen[block] += np.isfinite(change_m)

    def _cell_blocks(self) -> Iterator[slice]:
        for first in range(0, len(self._cell), BLOCK_CELLS):
            yield slice(first, min(first + BLOCK_CELLS, len(self._cell)))

    def _part(self, block: slice) -> CellFilter:
        whole = self._filter
        return CellFilter(whole.cells[block], whole.outlier_m[block], whole.begin_m[block])

    def _read(self, epoch: EpochRef) -> _Observations:
        rasters = [open_raster(epoch.path, name, epoch.index) for name in (CHANGE, RANDOM, TOTAL)]
        values = np.empty((len(rasters), len(self._read_cells)), np.float32)
        nx = self._shape[1]
        for top in range(0, self._shape[0], BAND_ROWS):
            band = slice(*np.searchsorted(self._read_cells, (top * nx, (top + BAND_ROWS) * nx)))
            if band.start < band.stop:
                cells = self._read_cells[band] - top * nx
                for kept, raster in zip(values, rasters, strict=True):
                    kept[band] = np.asarray(raster[top : top + BAND_ROWS]).ravel()[cells]
        values[values == np.float32(FILL)] = np.nan
        change_m, random_m, total_m = values
        systematic_m2 = np.maximum(total_m**2 - random_m**2, 0)
        random_m2 = random_m**2
        own_m2 = np.maximum(random_m2 - self._read_reference_m2, MIN_RANDOM_SHARE * random_m2)
        return _Observations(change_m, own_m2, systematic_m2)

    def _common_share_of(self, epochs: list[EpochRef]) -> float:
        """Return the share of the systematic variance that epochs of a day have in common [1].

        It is the median over blocks of 10 m; that of the day before if there is only one epoch. Source:
        equations.md, 6.12.
        """
        places = np.linspace(0, len(epochs) - 1, min(EPOCHS_COMPARED, len(epochs))).astype(int).tolist()
        day = [self._blocks.read(epochs[place]) for place in places]
        day = [blocks for blocks in day if blocks.parameters == day[-1].parameters]
        single, common = mean_covariances(day) if len(day) > 1 else (None, None)
        jacobian = day[-1].jacobian
        if jacobian is None or single is None or common is None or not day[-1].observed.any():
            return self._common_share
        single_m2, common_m2 = (np.asarray(jacobian.variance(shared)) for shared in (single, common))
        share = np.median(common_m2 / np.maximum(single_m2, np.finfo(np.float64).tiny))
        return float(np.clip(share, 0.0, 1.0))

    def rasters(self, rows: slice) -> dict[str, Floats32]:
        """Return the variables of a file of levels at the end of the day, some rows (r, nx) of each."""
        nx = self._shape[1]
        band = slice(*np.searchsorted(self._cell, (rows.start * nx, rows.stop * nx)))
        columns = self._columns(band)
        rasters = {}
        for name, values in columns.items():
            raster = np.full((rows.stop - rows.start) * nx, np.nan, np.float32)
            raster[self._cell[band] - rows.start * nx] = values
            rasters[name] = raster.reshape(-1, nx)
        return rasters

    def _columns(self, band: slice) -> dict[str, Floats]:
        part = self._part(band)
        state, moved_m, unseen_d = part.estimates(), part.moved_m, part.unseen_d
        random_m2, systematic_m2 = part.last_variances()
        rate_m_d, variances = np.full(len(unseen_d), np.nan), np.full((4, len(unseen_d)), np.nan)
        for number in np.unique(self._class[band]).tolist():
            inside, ground = self._class[band] == number, self._classes[number]
            errors = filter_errors(
                state.take(inside),
                moved_m[inside],
                unseen_d[inside],
                random_m2[inside],
                systematic_m2[inside] * (1 - self._common_share),
                ground,
            )
            rate_m_d[inside] = day_rates(state.take(inside), moved_m[inside], ground)
            variances[:, inside] = list(vars(errors).values())
        variances[0] += self._reference_m2[band]
        variances[1] += self._common_share * systematic_m2
        sigmas = np.sqrt(variances)
        coverage = self._seen[band] / max(self._epoch_count, 1)
        values = (state.level_m, *sigmas[:2], rate_m_d, *sigmas[2:], coverage)
        never = np.isnan(state.level_m)
        return {name: np.where(never, np.nan, v) for name, v in zip(LEVEL_NAMES, values, strict=True)}

    def to_arrays(self) -> dict[str, Array]:
        """Return the state at the end of a day, from which `restore` continues with the same bits."""
        outlier = np.flatnonzero(np.isfinite(self._filter.outlier_m))
        arrays: dict[str, Array] = {
            "cells": self._filter.cells,
            "outlier": outlier,
            "outlier_m": self._filter.outlier_m[outlier],
            "scalars": np.array([self._time_s, self._common_share]),
        }
        for number, ground in enumerate(self._classes):
            arrays |= {f"{name}_{number}": values for name, values in ground.to_arrays().items()}
        return arrays

    def restore(self, arrays: Mapping[str, Array]) -> None:
        """Continue from the state of the whole grid; cells outside the area are left out."""
        outlier_m = np.full(len(arrays["cells"]), np.nan, np.float32)
        outlier_m[arrays["outlier"]] = arrays["outlier_m"]
        cells = arrays["cells"][self._position]
        begin_m = cells["level_m"].copy()  # of the next day
        self._filter = CellFilter(cells, outlier_m[self._position], begin_m)
        self._time_s, self._common_share = arrays["scalars"].tolist()
        for number, ground in enumerate(self._classes):
            ground.restore({name: arrays[f"{name}_{number}"] for name in ground.to_arrays()})


def _stacked(values: tuple[ProcessNoise | Motion, ...]) -> Floats:
    """Return the numbers of each class as an array (fields, classes)."""
    return np.array([list(vars(of_class).values()) for of_class in values]).T


def _classes(stable: Bools, variance_m2: Floats32) -> NDArray[np.uint8]:
    """Return the class of each known cell (n,): by ground and octave of the reference's σ."""
    if not len(stable):
        return np.empty(0, np.uint8)
    octave = np.round(np.log2(np.maximum(np.sqrt(variance_m2), np.float32(MIN_SIGMA_M)))).astype(np.int16)
    low, high = np.percentile(octave, (2, 98))
    number = 2 * (np.clip(octave, int(low), int(high)) - int(low)) + stable
    used = np.bincount(number) > 0
    return (np.cumsum(used) - 1).astype(np.uint8)[number]
