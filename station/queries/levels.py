"""Filtered level and rate of the cells of an area at the end of each day, from the epochs of a store."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import xarray as xr

from station.archive.derived.computed_rasters import CHANGE, RANDOM, TOTAL, open_raster
from station.archive.epochs import EpochRef
from station.archive.netcdf_layout import Series
from station.archive.schema import FILL
from station.archive.series.index import SeriesIndex, references_and_usable
from station.errors import StoreError
from station.quantities import Bools, Floats, Floats32, Ints, Reference
from station.queries.aggregates import Aggregates
from station.queries.common_errors import common_error_share
from station.queries.epoch_cells import bounding_box
from station.science.time_series.cell_filter import CellFilter, ProcessNoise
from station.science.time_series.class_filter import SAMPLE_CELLS, ClassFilter
from station.science.time_series.filter_errors import filter_errors

DAY_S = 86_400.0
BLOCK_CELLS = 50_000  # filtered at once
BAND_ROWS = 128  # read at once
MIN_RANDOM_SHARE = 0.01  # of the random variance of a change that is the scan's, at least
LEVEL_VARIABLES = {
    "level": ("m", "elevation above the reference surface, filtered"),
    "level_random_uncertainty": ("m", "random uncertainty of the level, independent between cells"),
    "level_systematic_uncertainty": ("m", "uncertainty of the level that cells have in common"),
    "rate": ("m d-1", "rate of the level without steps"),
    "rate_random_uncertainty": ("m d-1", "random uncertainty of the rate, independent between cells"),
    "rate_systematic_uncertainty": ("m d-1", "uncertainty of the rate that cells have in common"),
}


@dataclass(frozen=True)
class _Observations:
    """Change and variances of an epoch at cells (n,), NaN where there is none."""

    change_m: Floats32
    random_m2: Floats32  # without the reference's
    systematic_m2: Floats32

    def take(self, index: Ints | slice) -> tuple[Floats, Floats, Floats]:
        """Return change and variances of some cells in double precision."""
        change_m, random_m2, systematic_m2 = (
            values[index].astype(np.float64) for values in vars(self).values()
        )
        return change_m, random_m2, systematic_m2


def filter_levels(series: Series, cells: Bools, progress: Callable[[], None]) -> xr.Dataset:
    """Return level and rate of the cells (ny, nx) of an area at the last epoch of each day, on their rows.

    Takes the usable epochs of the newest reference in order of time. The noise of the surface is learned
    from cells of the whole grid, so that a cell has the same level in any area. `filled` is 1 where the last
    epoch did not see the cell. `progress` is called after each epoch. Raises StoreError if there is no
    reference, or no usable epoch. Source: equations.md, 6.12.
    """
    aggregates = Aggregates(series)
    reference = aggregates.reference()
    epochs = _usable_epochs(series, reference.version)
    filters = _AreaFilter(reference, cells)
    common_share = common_error_share(aggregates, cells, epochs)
    days: list[tuple[float, dict[str, Floats]]] = []
    for index, epoch in enumerate(epochs):
        filters.advance(epoch)
        is_last = index == len(epochs) - 1 or epochs[index + 1].time_s // DAY_S > epoch.time_s // DAY_S
        if is_last:
            days.append((epoch.time_s, filters.products(common_share)))
        progress()
    return _to_dataset(series, cells, days)


def _usable_epochs(series: Series, version: str) -> list[EpochRef]:
    index = SeriesIndex(series)
    versions, usable = references_and_usable(series)
    chosen = np.flatnonzero(usable & (versions == version.encode()))
    epochs = [index[position] for position in chosen.tolist()]
    if not epochs:
        raise StoreError(f"{series.folder}: no usable epoch of the newest reference yet: no levels")
    return epochs


class _AreaFilter:
    """Filters of the cells of an area, and of the classes of cells of the grid."""

    def __init__(self, reference: Reference, cells: Bools) -> None:
        known = np.isfinite(np.asarray(reference.elevation_m))
        self._cell = np.flatnonzero(cells & known)
        variance_m2 = np.asarray(reference.random_variance_m2)
        classes = _classes(known, np.asarray(reference.stable), variance_m2)
        self._class = classes.ravel()[self._cell]
        samples = [_spread(np.flatnonzero(classes == number)) for number in range(int(classes.max()) + 1)]
        stable = np.asarray(reference.stable).ravel()
        self._classes = [ClassFilter(len(sample), stable=bool(stable[sample].all())) for sample in samples]
        self._sample = np.concatenate(samples)
        self._bounds = np.cumsum([0, *map(len, samples)])
        self._read_cells = np.union1d(self._cell, self._sample)
        self._reference_m2 = variance_m2.ravel()[self._read_cells].astype(np.float32)
        self._filters = [CellFilter.empty(block.stop - block.start) for block in self._blocks()]
        self._last_m2 = np.zeros((2, len(self._cell)), np.float32)  # of the last observation
        self._area = np.searchsorted(self._read_cells, self._cell)
        self._samples = np.searchsorted(self._read_cells, self._sample)
        self._nx = cells.shape[1]
        self._time_s: float | None = None
        self._cells = cells

    def _blocks(self) -> Iterator[slice]:
        for first in range(0, len(self._cell), BLOCK_CELLS):
            yield slice(first, min(first + BLOCK_CELLS, len(self._cell)))

    def advance(self, epoch: EpochRef) -> None:
        """Take the next epoch in order of time."""
        days = 0.0 if self._time_s is None else (epoch.time_s - self._time_s) / DAY_S
        self._time_s = epoch.time_s
        observations = self._read(epoch)
        noises = []
        for number, ground in enumerate(self._classes):
            sample = self._samples[self._bounds[number] : self._bounds[number + 1]]
            noises.append(ground.advance(days, *observations.take(sample)))
        level_m2_d, rate_m2_d3 = (
            np.array([getattr(noise, name) for noise in noises]) for name in ("level_m2_d", "rate_m2_d3")
        )
        for block, cell_filter in zip(self._blocks(), self._filters, strict=True):
            change_m, random_m2, systematic_m2 = observations.take(self._area[block])
            classes = self._class[block]
            noise = ProcessNoise(level_m2_d[classes], rate_m2_d3[classes])
            cell_filter.advance(days, noise, change_m, random_m2 + systematic_m2)
            seen = np.isfinite(change_m)
            for kept, variance_m2 in zip(self._last_m2, (random_m2, systematic_m2), strict=True):
                np.copyto(kept[block], variance_m2, where=seen, casting="same_kind")

    def _read(self, epoch: EpochRef) -> _Observations:
        rasters = [open_raster(epoch.path, name, epoch.index) for name in (CHANGE, RANDOM, TOTAL)]
        row, column = np.divmod(self._read_cells, self._nx)
        values = np.empty((len(rasters), len(row)), np.float32)
        for top in range(0, rasters[0].shape[0], BAND_ROWS):
            band = slice(*np.searchsorted(row, (top, top + BAND_ROWS)))
            if band.start < band.stop:
                for kept, raster in zip(values, rasters, strict=True):
                    kept[band] = raster[top : top + BAND_ROWS][row[band] - top, column[band]]
        values[values == np.float32(FILL)] = np.nan
        change_m, random_m, total_m = values
        own_m2 = np.maximum(random_m**2 - self._reference_m2, MIN_RANDOM_SHARE * random_m**2)
        return _Observations(change_m, own_m2, np.maximum(total_m**2 - random_m**2, 0))

    def products(self, common_share: float) -> dict[str, Floats]:
        """Return the variables at the area's known cells (n,); `filled` is 1 where it was not observed."""
        columns: dict[str, list[Floats]] = {name: [] for name in (*LEVEL_VARIABLES, "filled")}
        for block, cell_filter in zip(self._blocks(), self._filters, strict=True):
            state = cell_filter.estimates()
            unseen_d = cell_filter.cells["unseen_min"] / 1440
            random_m2, systematic_m2 = self._last_m2[:, block].astype(np.float64)
            variances = np.full((4, len(unseen_d)), np.nan)
            for number in np.unique(self._class[block]).tolist():
                shares, inside = self._classes[number].shares, self._class[block] == number
                if shares is not None:
                    errors = filter_errors(
                        state.take(inside),
                        unseen_d[inside],
                        random_m2[inside],
                        systematic_m2[inside] * (1 - common_share),
                        shares,
                    )
                    variances[:, inside] = list(vars(errors).values())
            variances[0] += self._reference_m2[self._area[block]]
            variances[1] += common_share * systematic_m2
            sigmas = np.sqrt(variances)
            filled = np.where(np.isnan(state.level_m), np.nan, unseen_d > 0)
            sigmas[:, np.isnan(state.level_m)] = np.nan
            rate_m_d = np.where(np.isnan(state.level_m), np.nan, state.rate_m_d)
            values = state.level_m, *sigmas[:2], rate_m_d, *sigmas[2:], filled
            for column, value in zip(columns.values(), values, strict=True):
                column.append(value)
        return {name: self._on_area(np.concatenate([[], *parts])) for name, parts in columns.items()}

    def _on_area(self, values: Floats) -> Floats:
        """Return values of the known cells at all cells of the area, row by row."""
        all_values = np.full(self._cells.size, np.nan, np.float32)
        all_values[self._cell] = values
        return np.asarray(all_values[self._cells.ravel()])


def _classes(known: Bools, stable: Bools, variance_m2: Floats32) -> Ints:
    """Return the class of each cell (ny, nx): by ground and octave of the reference's σ; -1 if not known."""
    sigma_m = np.sqrt(variance_m2, where=known, out=np.ones(known.shape, np.float32))
    octave = np.round(np.log2(np.maximum(sigma_m, 1e-4)))
    low, high = np.percentile(octave[known], (2, 98)) if known.any() else (0, 0)
    number = 2 * np.clip(octave, low, high) + stable
    classes = np.full(known.shape, -1)
    classes[known] = np.unique(number[known], return_inverse=True)[1]
    return classes


def _spread(cells: Ints) -> Ints:
    """Return a sample of cells, spread evenly."""
    return cells[np.linspace(0, len(cells) - 1, min(len(cells), SAMPLE_CELLS)).astype(np.int64)]


def _to_dataset(series: Series, cells: Bools, days: list[tuple[float, dict[str, Floats]]]) -> xr.Dataset:
    rows, columns = bounds = bounding_box(cells, 0)
    inside = cells[bounds]
    time = np.array([round(time_s * 1000) for time_s, _ in days], "M8[ms]").astype("M8[ns]")
    coordinates = {"time": time, "y": series.grid.y_m[rows], "x": series.grid.x_m[columns]}
    dataset = xr.Dataset(coords=coordinates)
    attributes = LEVEL_VARIABLES | {"filled": ("1", "1 where the last epoch did not see the cell")}
    for name, (units, long_name) in attributes.items():
        rasters = np.full((len(days), *inside.shape), np.nan, np.float32)
        for raster, (_, values) in zip(rasters, days, strict=True):
            raster[inside] = values[name]
        dataset[name] = ("time", "y", "x"), rasters, {"units": units, "long_name": long_name}
    return dataset
