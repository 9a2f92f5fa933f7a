"""Change of blocks of cells and its σ: of every epoch, and of daily means.

The systematic errors of a block are those of its mean surface: the Jacobian is linear in the gradient and
changes little within 10 m. Larger blocks are weighted sums of such blocks. Source: equations.md, 6.2.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import combinations
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np
from scipy import sparse

from station.archive.derived.boxes import (
    BOX_M,
    DAY_S,
    Entries,
    Rasters,
    box_file,
    daily_file,
    update_blocks,
    update_days,
)
from station.archive.derived.computed_rasters import CHANGE, RANDOM, TOTAL
from station.archive.epochs import EpochRef
from station.archive.netcdf_layout import Series
from station.archive.series.index import SeriesIndex, references_and_usable
from station.quantities import Bools, Floats, Ints, Reference, SharedParameters
from station.queries.block_sums import Sums, cells_per_block, drop_epoch_sums, epoch_sums, reference_sums
from station.queries.epoch_cells import EpochCells, EpochReader, layout_of_scanner, read_window
from station.science.analysis.calibration import SparseJacobian
from station.science.geometry.observation import Observation
from station.science.geometry.terrain import GRADIENT_CELLS, smooth_gradient
from station.science.uncertainty.common_mode import cross_covariance
from station.science.uncertainty.jacobian import HeightJacobian, height_jacobian
from station.science.uncertainty.propagation import difference_to_reference

if TYPE_CHECKING:
    import xarray as xr

CACHED_EPOCHS = 2  # whose blocks are in memory
MIN_GRADIENT_BLOCKS = 0.5  # one sigma of the Gaussian


@dataclass(frozen=True)
class Blocks:
    """Means over blocks of cells (by, bx) of an epoch; zero where none has a change."""

    count: Floats  # cells with a change
    change_m: Floats
    random_m2: Floats  # variance of the mean
    reference_m2: Floats  # the part of it that comes from the reference, at the mean of its known cells
    rock: Floats  # share of the cells that are bare ground
    jacobian: HeightJacobian | None  # of the observed blocks; None if the epoch has no shared parameters
    cells: EpochCells  # without cells: the shared parameters

    @property
    def observed(self) -> Bools:
        """Blocks with a change."""
        return np.asarray(self.count > 0)

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the shared parameters; they depend on the position of the scanner."""
        return () if self.cells.shared is None else self.cells.shared.names

    @property
    def shared(self) -> SharedParameters | None:
        """Shared parameters relative to the reference."""
        return relative_parameters(self.cells)


def relative_parameters(cells: EpochCells) -> SharedParameters | None:
    """Return the shared parameters of an epoch relative to its reference; None if it has none."""
    own = cells.shared
    return own if own is None or cells.adjusted else difference_to_reference(own, cells.reference.shared)


@dataclass(frozen=True)
class SurfaceBlocks:
    """Blocks (n,) in which the reference surface is known."""

    known: Bools  # (by, bx)
    points: tuple[Floats, Floats, Floats]  # centre, and mean height [m]
    observation: Observation
    random_m2: Floats  # mean random variance of a cell of the reference
    jacobian: HeightJacobian | None  # of heights by the shared parameters; None without any


class BlockQueries:
    """Blocks of 10 m or less, and boxes of about 100 m made of them, of the epochs of a store."""

    def __init__(self, series: Series) -> None:
        self._reader, self._series = EpochReader(series), series
        self._surfaces: dict[str, Sums] = {}  # by version of the reference
        self.read = lru_cache(CACHED_EPOCHS)(self._read)
        self.cells = cells_per_block(series.grid)  # rows and columns of a block
        self.blocks_per_box = max(round(BOX_M / (self.cells * series.grid.cell_m)), 1)

    def single(self, epoch: EpochRef) -> Rasters:
        """Return the rasters of a file of `blocks/` of an epoch."""
        blocks = self.read(epoch)
        variance_m2 = blocks.random_m2.copy()
        if blocks.jacobian is not None and blocks.shared is not None:
            variance_m2[blocks.observed] += blocks.jacobian.variance(blocks.shared)
        rasters = {
            CHANGE: blocks.change_m,
            TOTAL: np.sqrt(variance_m2),
            RANDOM: np.sqrt(blocks.random_m2),
            "coverage": blocks.count / self.cells**2,
        }
        return {name: np.where(blocks.observed, v, np.nan) for name, v in rasters.items()}

    def boxes(self, epoch: EpochRef) -> Rasters:
        """Return the rasters of `boxes.nc` of an epoch."""
        blocks, size = self.read(epoch), self.blocks_per_box
        shape = -(-blocks.count.shape[0] // size), -(-blocks.count.shape[1] // size)
        row, column = np.nonzero(blocks.observed)
        box, count = row // size * shape[1] + column // size, blocks.count[blocks.observed]
        total = np.bincount(box, count, shape[0] * shape[1])
        entries = count / total[box], (box, np.arange(len(box)))
        weights = sparse.csr_array(entries, shape=(len(total), len(box)))
        independent_m2 = blocks.random_m2[blocks.observed]
        random_m2 = variance_m2 = weights.power(2) @ independent_m2
        if blocks.jacobian is not None and blocks.shared is not None:
            variance_m2 = (
                SparseJacobian(blocks.jacobian).sums(weights).variance(independent_m2, blocks.shared)
            )
        rasters = {
            CHANGE: weights @ blocks.change_m[blocks.observed],
            TOTAL: np.sqrt(variance_m2),
            RANDOM: np.sqrt(random_m2),
            "coverage": total / (self.cells * size) ** 2,
        }
        return {name: np.where(total > 0, v, np.nan).reshape(shape) for name, v in rasters.items()}

    def daily_mean(self, epochs: Sequence[EpochRef]) -> Rasters:
        """Return the rasters of `daily.nc` of the epochs of a day, which have one reference.

        Every epoch in which a block was observed has the same weight, except those with other shared
        parameters than the last, which are left out. The errors of the reference, and those that similar
        change causes, are common to all epochs. Blocks that some epochs did not observe get the mean
        covariance of the day.
        """
        day = [self.read(epoch) for epoch in epochs]
        day = [blocks for blocks in day if blocks.parameters == day[-1].parameters]
        epoch_count = np.sum([blocks.observed for blocks in day], axis=0)
        seen, count = epoch_count > 0, np.maximum(epoch_count, 1)
        change_m, random_m2, reference_m2, cells = (
            np.sum([getattr(blocks, name) for blocks in day], axis=0)
            for name in ("change_m", "random_m2", "reference_m2", "count")
        )
        random_m2 = np.maximum(random_m2 - reference_m2, 0.0) / count**2 + reference_m2 / count
        single, common = mean_covariances(day)
        shared_m2, missing = np.zeros(count.shape), seen.copy()
        for blocks in day:
            first = missing & blocks.observed
            if blocks.jacobian is not None and single is not None and common is not None:
                jacobian = blocks.jacobian.take(first[blocks.observed])
                single_m2, common_m2 = (np.asarray(jacobian.variance(shared)) for shared in (single, common))
                shared_m2[first] = common_m2 + np.maximum(single_m2 - common_m2, 0.0) / count[first]
            missing &= ~first
        rasters = {
            CHANGE: change_m / count,
            TOTAL: np.sqrt(random_m2 + shared_m2),
            RANDOM: np.sqrt(random_m2),
            "coverage": cells / count / self.cells**2,
        }
        return {name: np.where(seen, values, np.nan) for name, values in rasters.items()} | {
            "epoch_count": epoch_count
        }

    def _read(self, epoch: EpochRef) -> Blocks:
        """Return the blocks of an epoch."""
        epoch_cells = self._reader.read_shared(epoch)
        sums, surface = epoch_sums(self._series, epoch), self._reference_sums(epoch_cells.reference)
        count, known = np.maximum(sums["count"], 1), np.maximum(surface["known"], 1)
        observed = (sums["count"] > 0) & (surface["known"] > 0)
        jacobian = None
        if epoch_cells.shared is not None:
            jacobian = self._jacobian(epoch_cells, sums, surface, observed)
        random_m2 = sums["random_m2"] / count**2
        return Blocks(
            np.where(observed, sums["count"], 0.0),
            np.where(observed, sums["change_m"] / count, 0.0),
            np.where(observed, random_m2, 0.0),
            np.where(observed, np.minimum(surface["random_m2"] / known / count, random_m2), 0.0),
            sums["rock"] / count,
            jacobian,
            epoch_cells,
        )

    def shared(self, epoch: EpochRef) -> SharedParameters | None:
        """Return the shared parameters of an epoch relative to the reference; None if it has none."""
        return relative_parameters(self._reader.read_shared(epoch))

    def reference_blocks(self, version: str) -> Sums:
        """Return the sums of a version of the reference over its blocks."""
        return self._reference_sums(self._reader.reference(version))

    def _reference_sums(self, reference: Reference) -> Sums:
        if reference.version not in self._surfaces:
            self._surfaces[reference.version] = reference_sums(self._series, reference)
        return self._surfaces[reference.version]

    def surface(self, epoch: EpochRef, rock: Bools) -> SurfaceBlocks:
        """Return the blocks of the reference surface of an epoch, as its scanner sees them.

        `rock` (by, bx) marks blocks that are bare ground.
        """
        epoch_cells = self._reader.read_shared(epoch)
        sums = self._reference_sums(epoch_cells.reference)
        known, block_m, grid = sums["known"] > 0, self.cells * self._series.grid.cell_m, self._series.grid
        row, column = np.nonzero(known)
        count = sums["known"][known]
        points = (
            np.asarray(grid.west_m + (column + 0.5) * block_m, np.float64),
            np.asarray(grid.north_m - (row + 0.5) * block_m, np.float64),
            sums["surface_m"][known] / count,
        )
        east, north = self._gradient(sums, known)
        east_m, north_m, height_m, *_ = epoch_cells.scanner
        observation = Observation.from_points(points, (east_m, north_m, height_m), east, north)
        jacobian = None
        if epoch_cells.shared is not None:
            params, _ = layout_of_scanner(grid, epoch_cells.scanner)
            jacobian = height_jacobian(params, observation.offset_m, east, north, rock=rock[known])
        return SurfaceBlocks(known, points, observation, sums["random_m2"][known] / count, jacobian)

    def _gradient(self, surface: Sums, blocks: Bools) -> tuple[Floats, Floats]:
        """Return the eastward and northward gradient (n,) [1] of the mean surface in some blocks."""
        with np.errstate(invalid="ignore"):
            surface_m = surface["surface_m"] / surface["known"]
        block_m = self.cells * self._series.grid.cell_m
        gradient = smooth_gradient(surface_m, block_m, max(GRADIENT_CELLS / self.cells, MIN_GRADIENT_BLOCKS))
        east, north = (np.nan_to_num(component[blocks].astype(np.float64)) for component in gradient)
        return east, north

    def _jacobian(
        self, epoch_cells: EpochCells, sums: Sums, surface: Sums, observed: Bools
    ) -> HeightJacobian:
        """Return the Jacobian of the mean surfaces of the observed blocks."""
        east, north = self._gradient(surface, observed)
        params, position_m = layout_of_scanner(self._series.grid, epoch_cells.scanner)
        count = sums["count"][observed]
        offset_m = (
            sums["x_m"][observed] / count - position_m[0],
            sums["y_m"][observed] / count - position_m[1],
            surface["surface_m"][observed] / surface["known"][observed] - position_m[2],
        )
        rock = sums["rock"][observed] > count / 2
        return height_jacobian(params, offset_m, east, north, rock=rock)


def mean_covariances(day: Sequence[Blocks]) -> tuple[SharedParameters | None, SharedParameters | None]:
    """Return the mean covariance of the shared parameters of epochs, and the mean of that between two epochs.

    Both as shared parameters relative to the reference; None if the epochs have none.
    """
    known = [params for params in (blocks.shared for blocks in day) if params is not None]
    if not known:
        return None, None
    single = replace(
        known[-1],
        covariance=np.mean([params.covariance for params in known], axis=0),
        line_tilt_variance=np.mean([params.line_tilt_variance for params in known], axis=0),
    )
    between = np.zeros_like(single.covariance)
    for first, second in combinations(day, 2):
        covariance = _covariance_between(first.cells, second.cells)
        if covariance is not None:
            between += covariance + covariance.T
    between /= max(len(day) * (len(day) - 1), 1)
    return single, replace(single, covariance=between, line_tilt_variance=np.zeros_like(between[0]))


def _covariance_between(first: EpochCells, second: EpochCells) -> Floats | None:
    """Return the covariance (p, p) of the errors of two epochs, each relative to their common reference."""
    if first.shared is None or second.shared is None or first.adjusted != second.adjusted:
        return None
    if first.adjusted:
        return cross_covariance(first.shared, second.shared)
    reference = first.reference.shared
    return reference.covariance if reference is not None and reference.names == first.shared.names else None


def update_boxes(
    series: Series, queries: BlockQueries, progress: Callable[[], None], keep: Collection[str] = ()
) -> None:
    """Bring `boxes.nc`, `blocks/` and `daily.nc` up to date with the epochs that have a reference.

    A day is in `daily.nc` when a later day has begun; unusable epochs do not count. The sums of the epochs
    named in `keep` are kept, as those of the last day are. Raises as `update_blocks`.
    """
    index = SeriesIndex(series)
    if not len(index):
        return
    versions, usable = references_and_usable(series)
    measured = np.flatnonzero(versions != b"")
    start_s, end_s = index.start_s, 2 * index.time_s - index.start_s
    entries = Entries(start_s[measured], end_s[measured], index.epoch_file[measured], versions[measured])
    update_blocks(
        series,
        box_file(series.grid, queries.cells * queries.blocks_per_box),
        entries,
        lambda entry: queries.boxes(index[int(measured[entry])]),
        progress,
    )
    update_days(
        series,
        queries.cells,
        entries,
        lambda entry: queries.single(index[int(measured[entry])]),
        progress,
    )
    days = list(_closed_days(start_s // DAY_S, measured, usable, versions))
    day_s = np.array([start_s[day[0]] // DAY_S * DAY_S for day in days])
    sources = [hashlib.sha256(index.epoch_file[day].tobytes()).hexdigest() for day in days]
    update_blocks(
        series,
        daily_file(series.grid, queries.cells),
        Entries(day_s, day_s + DAY_S, np.array(sources, "S64"), versions[[day[0] for day in days]]),
        lambda entry: queries.daily_mean([index[position] for position in days[entry].tolist()]),
        progress,
    )
    last_day = np.flatnonzero(start_s // DAY_S == start_s[-1] // DAY_S).tolist()
    drop_epoch_sums(series, {*keep, *(index[position].epoch_file for position in last_day)})


def _closed_days(
    day_number: Floats, measured: Ints, usable: Bools, versions: np.ndarray[Any, Any]
) -> Iterator[Ints]:
    """Yield the usable epochs of each day before the last one, of the newest reference of that day."""
    for epochs in np.split(measured, np.flatnonzero(np.diff(day_number[measured])) + 1)[:-1]:
        chosen = epochs[usable[epochs]]
        if len(chosen):
            yield chosen[versions[chosen] == versions[chosen[-1]]]


def coarsen(series: Series, epoch: EpochRef, cells: int) -> xr.Dataset:
    """Return the change of an epoch in blocks of `cells` × `cells` with one sigma [m].

    Every point has the same weight; `point_count` is the sum. Shared errors are taken as fully correlated
    within a block. Rows and columns that do not fill a block are omitted.
    """
    import xarray as xr  # noqa: PLC0415 - the service does not need it

    grid = series.grid
    ny, nx = grid.ny // cells, grid.nx // cells
    if not ny or not nx:
        raise ValueError(f"blocks of {cells} cells do not fit a grid of {grid.ny} × {grid.nx}")
    with h5py.File(epoch.path, "r") as file:
        change_m, random_m, sigma_m, count = (
            read_window(file, name, epoch.index, (slice(ny * cells), slice(nx * cells)))
            for name in (CHANGE, RANDOM, TOTAL, "point_count")
        )
    count = np.where(np.isfinite(change_m), count, 0.0)

    def block_sum(values: Floats) -> Floats:
        return np.asarray(np.nansum(values.reshape(ny, cells, nx, cells), axis=(1, 3)))

    point_sum = block_sum(count)
    with np.errstate(invalid="ignore", divide="ignore"):
        random_m2 = block_sum(count**2 * random_m**2) / point_sum**2
        shared_m2 = block_sum(count * (sigma_m**2 - random_m**2)) / point_sum
        rasters = {
            CHANGE: block_sum(count * change_m) / point_sum,
            TOTAL: np.sqrt(random_m2 + np.maximum(shared_m2, 0.0)),
            RANDOM: np.sqrt(random_m2),
            "point_count": point_sum,
        }
    y_m = grid.y_m[: ny * cells].reshape(ny, cells).mean(axis=1)
    x_m = grid.x_m[: nx * cells].reshape(nx, cells).mean(axis=1)
    return xr.Dataset({name: (("y", "x"), v) for name, v in rasters.items()}, {"y": y_m, "x": x_m})
