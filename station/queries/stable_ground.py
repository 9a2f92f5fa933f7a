"""Validation of the stated sigma on hold-out stable ground, over all epochs of a station."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Any

import h5py
import numpy as np
from scipy import sparse

from station.archive.derived.computed_rasters import CHANGE, TOTAL
from station.archive.epochs import EpochRef, read_provenance
from station.archive.netcdf_layout import Series
from station.archive.read_errors import read_errors
from station.archive.series.index import list_epochs
from station.archive.small_variables import read_text
from station.quantities import Bools, Floats, Floats32, Ints, Quality, Reference, SharedParameters
from station.queries.aggregates import Aggregates
from station.queries.epoch_cells import read_scanner, read_window
from station.science.adjustment import ground_classes
from station.science.analysis import calibration
from station.science.geometry.robust_statistics import nmad
from station.science.uncertainty.propagation import difference_to_reference

Table = list[dict[str, Any]]

MIN_BLOCK_SHARE = 0.5  # share of the cells of a block that a scan must have observed
RANGE_EDGES_M = (100.0, 250.0, 500.0, 1000.0, 2000.0, 4000.0)  # of the distances that the page names
RECENT_EPOCHS = 50  # epochs that determine the current factor of sigma
LAG_CLASSES = 8  # distance classes
PAIRS_PER_CLASS = 500  # pairs per distance class


@dataclass(frozen=True)
class _HoldoutCells:
    """Hold-out cells (n,) observed in an epoch, by flat grid index, with change and uncertainty."""

    epoch: EpochRef
    scan_id: str
    cell_index: Ints
    change_m: Floats32
    sigma_m: Floats32
    random_m2: Floats32
    scanner: tuple[float, ...]
    shared: SharedParameters
    reference: Reference


@dataclass(frozen=True)
class SigmaValidation:
    """Stated against observed uncertainty by epoch, over all epochs, and by distance; rows of tables.

    Empty if no epoch has hold-out stable ground.
    """

    epochs: Table  # time, scan_id, scale, band, count, z_std, z_robust, inside_95
    overall: Table  # scale, band, count, z_std, inside_95, factor, low, high, advised
    variogram: Table  # lag_m, pairs, observed_m2, stated_m2


def validate_sigma(series: Series, max_epochs: int, progress: Callable[[], None]) -> SigmaValidation:
    """Compare the change with its sigma on hold-out stable ground.

    Uses at most `max_epochs` epochs, spread over the series. Epochs that are part of the reference are
    omitted, because they are correlated with it. Raises StoreError if nothing is stored.
    """
    holdout = list(_read_holdout(series, max_epochs, progress))
    if not holdout:
        return SigmaValidation([], [], [])
    holdout_ground = _HoldoutGround(series, holdout)
    epochs, lags = [], []
    for epoch_cells in holdout:
        epochs += holdout_ground.epoch_statistics(epoch_cells)
        lags.append(holdout_ground.variogram_sums(epoch_cells))
        progress()
    return SigmaValidation(epochs, _overall(epochs), _variogram(np.array(lags), holdout_ground.edges_m))


def z_by_range(series: Series, epoch: EpochRef) -> list[tuple[float, float | None, int, float]]:
    """Return how the change of hold-out stable ground scatters over its sigma, by distance from the scanner.

    Rows of lower and upper distance [m], number of cells, and robust standard deviation of the standardised
    change, as in `stable_z_std`; distances without a cell are left out. Empty without a scanner position.
    Raises StoreError if the epoch cannot be read.
    """
    grid = series.grid
    with read_errors(epoch.path), h5py.File(epoch.path, "r") as file:
        if "scanner_east" not in file:
            return []
        position_m = read_scanner(file, epoch.index, grid)[:3]
        quality = file["quality"][epoch.index]
        row, column = np.nonzero((quality & Quality.STABLE_GROUND) > 0)
        holdout = ground_classes.is_holdout(grid.x_m[column], grid.y_m[row])
        row, column = row[holdout], column[holdout]
        if not len(row) or not np.isfinite(position_m).all():
            return []
        window = slice(row.min(), row.max() + 1), slice(column.min(), column.max() + 1)
        change_m, sigma_m = (
            read_window(file, name, epoch.index, window)[row - row.min(), column - column.min()]
            for name in (CHANGE, TOTAL)
        )
    z = change_m / sigma_m
    range_m = grid.horizontal_range_m(row, column, position_m)
    band, table = np.searchsorted(RANGE_EDGES_M, range_m, side="right"), []
    for number, (low_m, high_m) in enumerate(pairwise((0.0, *RANGE_EDGES_M, None))):
        band_z = z[(band == number) & np.isfinite(z)]
        if len(band_z):
            table.append((low_m or 0.0, high_m, len(band_z), nmad(band_z)))
    return table


def sample_epochs(series: Series, max_epochs: int) -> list[EpochRef]:
    """Return at most `max_epochs` epochs that have a reference, spread evenly over the series."""
    usable = [epoch for epoch in list_epochs(series) if read_provenance(epoch.path)["reference_version"]]
    if not usable:
        return []
    return [
        usable[index]
        for index in np.unique(np.linspace(0, len(usable) - 1, min(max_epochs, len(usable))).astype(np.int64))
    ]


def _read_holdout(series: Series, max_epochs: int, progress: Callable[[], None]) -> Iterator[_HoldoutCells]:
    aggregates, grid = Aggregates(series), series.grid
    is_holdout_cell = ground_classes.is_holdout(grid.x_m[None, :], grid.y_m[:, None])
    for epoch in sample_epochs(series, max_epochs):
        with h5py.File(epoch.path, "r") as file:
            quality = file["quality"][epoch.index]
            scan_id = read_text(file, "scan_id", epoch.index)
            holdout_cells = is_holdout_cell & ((quality & Quality.STABLE_GROUND) > 0)
            sigma_m = read_window(file, TOTAL, epoch.index, (slice(None), slice(None)))
        progress()
        if not holdout_cells.any():
            continue
        epoch_cells = aggregates.read_cells(epoch, holdout_cells)
        has_change = np.isfinite(epoch_cells.change_m)
        if epoch_cells.shared is None or scan_id in epoch_cells.reference.scan_ids or not has_change.any():
            continue
        shared = (
            epoch_cells.shared
            if epoch_cells.adjusted
            else difference_to_reference(epoch_cells.shared, epoch_cells.reference.shared)
        )
        change_m, stated_m, random_m = (
            values[has_change].astype(np.float32)
            for values in (epoch_cells.change_m, sigma_m[holdout_cells], epoch_cells.random_m)
        )
        cell_index = np.flatnonzero(holdout_cells)[has_change]
        yield _HoldoutCells(
            epoch,
            scan_id,
            cell_index,
            change_m,
            stated_m,
            random_m**2,
            epoch_cells.scanner,
            shared,
            epoch_cells.reference,
        )


class _HoldoutGround:
    """All hold-out cells of some epochs, and the weighted sums computed over them."""

    def __init__(self, series: Series, holdout: list[_HoldoutCells]) -> None:
        grid = series.grid
        self.cells = np.zeros(grid.shape, bool)
        self.cells.ravel()[np.unique(np.concatenate([epoch_cells.cell_index for epoch_cells in holdout]))] = (
            True
        )
        row, column = np.nonzero(self.cells)
        x_m, y_m = grid.x_m[column], grid.y_m[row]
        range_m = grid.horizontal_range_m(row, column, holdout[-1].scanner)
        self.bands = calibration.range_bands(range_m)
        band = np.searchsorted([upper_m for _, upper_m in self.bands], range_m, side="right")
        self.sums: dict[str, tuple[sparse.csr_array, Ints]] = {}
        for size_m in calibration.SCALES_M:
            if size_m > grid.cell_m:
                weights = calibration.block_means(x_m, y_m, size_m)
                self.sums[f"{size_m:g} m"] = weights, np.rint(weights @ band).astype(np.int64)
        self.band = band
        self.sums["all"] = calibration.group_means(np.zeros(len(row), np.int64)), np.array([-1])
        self.sums["all of band"] = calibration.group_means(band), np.arange(len(self.bands))
        self.position = np.cumsum(self.cells.ravel()) - 1
        extent_m = float(np.hypot(np.ptp(x_m), np.ptp(y_m)))
        self.edges_m = np.geomspace(grid.cell_m, max(extent_m / 2, 4 * grid.cell_m), LAG_CLASSES + 1)
        self.pairs = calibration.sample_pairs(x_m, y_m, self.edges_m, PAIRS_PER_CLASS, seed=1)
        self._aggregates = Aggregates(series)
        self._jacobian_cache: dict[
            tuple[str, tuple[float, ...]], tuple[calibration.SparseJacobian, calibration.WeightedSums]
        ] = {}

    def _jacobians(
        self, epoch_cells: _HoldoutCells
    ) -> tuple[calibration.SparseJacobian, calibration.WeightedSums]:
        """Return the Jacobians of cells and of pairs; constant for the same scanner and reference."""
        key = epoch_cells.reference.version, epoch_cells.scanner
        if key not in self._jacobian_cache:
            all_cells = self._aggregates.read_cells(epoch_cells.epoch, self.cells)
            jacobian = calibration.SparseJacobian(self._aggregates.jacobian(all_cells, self.cells))
            pair_differences = calibration.pair_differences(*self.pairs[:2], len(self.band))
            self._jacobian_cache = {key: (jacobian, jacobian.sums(pair_differences))}
        return self._jacobian_cache[key]

    def _to_all_cells(self, epoch_cells: _HoldoutCells) -> tuple[Bools, Floats, Floats]:
        """Return observed mask, change [m] and random variance [m²] of an epoch at all hold-out cells."""
        index = self.position[epoch_cells.cell_index]
        observed, change_m, random_m2 = (
            np.zeros(len(self.band), bool),
            np.zeros(len(self.band)),
            np.zeros(len(self.band)),
        )
        observed[index], change_m[index], random_m2[index] = True, epoch_cells.change_m, epoch_cells.random_m2
        return observed, change_m, random_m2

    def epoch_statistics(self, epoch_cells: _HoldoutCells) -> Table:
        """Return z statistics of the errors of an epoch, by scale and range band."""
        (jacobian, _), (observed, change_m, random_m2) = (
            self._jacobians(epoch_cells),
            self._to_all_cells(epoch_cells),
        )
        z_by_scale = {
            "cell": (
                np.asarray(epoch_cells.change_m / epoch_cells.sigma_m, dtype=np.float64),
                self.band[self.position[epoch_cells.cell_index]],
            )
        }
        for scale, (weights, band) in self.sums.items():
            observed_weights, share = calibration.renormalise(weights, observed)
            z = (observed_weights @ change_m) / np.sqrt(
                np.maximum(jacobian.sums(observed_weights).variance(random_m2, epoch_cells.shared), 1e-18)
            )
            z_by_scale[scale] = np.where(share >= MIN_BLOCK_SHARE, z, np.nan), band[: len(z)]
        table = []
        for scale, (z, band) in z_by_scale.items():
            for band_number, name in [(-1, "all"), *((n, _band_name(b)) for n, b in enumerate(self.bands))]:
                band_z = z if band_number < 0 else z[band == band_number]
                if scale.startswith("all") and (band_number < 0) != (scale == "all"):
                    continue
                if np.isfinite(band_z).any():
                    table.append(
                        _epoch_row(
                            epoch_cells, scale.split()[0] if scale.startswith("all") else scale, name, band_z
                        )
                    )
        return table

    def variogram_sums(self, epoch_cells: _HoldoutCells) -> Floats:
        """Return sums by distance class (3, n): half squared differences, half their variance [m²], count."""
        first, second, lag = self.pairs
        (_, pair_sums), (observed, change_m, random_m2) = (
            self._jacobians(epoch_cells),
            self._to_all_cells(epoch_cells),
        )
        both = observed[first] & observed[second]
        stated_m2 = pair_sums.variance(random_m2, epoch_cells.shared)[both]
        observed_m2 = (change_m[first] - change_m[second])[both] ** 2
        lag = lag[both]
        return np.stack(
            [np.bincount(lag, w, LAG_CLASSES) for w in (observed_m2 / 2, stated_m2 / 2, np.ones(len(lag)))]
        )


def _band_name(band: tuple[float, float]) -> str:
    return f"{band[0]:g}-{band[1]:g} m"


def _epoch_row(epoch_cells: _HoldoutCells, scale: str, band: str, z: Floats) -> dict[str, Any]:
    finite_z = z[np.isfinite(z)]
    return {
        "time": epoch_cells.epoch.start.strftime("%Y-%m-%dT%H:%M:%SZ"), "scan_id": epoch_cells.scan_id,
        "scale": scale, "band": band, "z": finite_z.astype(np.float32),
        **asdict(calibration.z_statistics(finite_z)),
    }  # fmt: skip


def _overall(epochs: Table) -> Table:
    """Return z statistics over all epochs, by scale and band, with the factor of sigma of recent epochs."""
    table = []
    for scale, band in dict.fromkeys((row["scale"], row["band"]) for row in epochs):
        group = [row for row in epochs if (row["scale"], row["band"]) == (scale, band)]
        statistics = calibration.z_statistics(np.concatenate([row["z"] for row in group]))
        factor = calibration.sigma_scale([row["z"] for row in group[-RECENT_EPOCHS:]])
        table.append(
            {"scale": scale, "band": band, "epochs": len(group), **asdict(statistics), **asdict(factor)}
        )
    return table


def _variogram(lags: Floats, edges_m: Floats) -> Table:
    observed_m2, stated_m2, count = lags.sum(axis=0)
    return [
        {
            "lag_m": float(np.sqrt(edges_m[lag] * edges_m[lag + 1])),
            "pairs": int(count[lag]),
            "observed_m2": float(observed_m2[lag] / count[lag]),
            "stated_m2": float(stated_m2[lag] / count[lag]),
        }
        for lag in np.flatnonzero(count)
    ]
