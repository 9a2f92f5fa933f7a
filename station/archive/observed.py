"""What withheld stable ground shows of the stated sigma, over the life of a station."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from typing import Any

import netCDF4
import numpy as np
from scipy import sparse

from station.archive.aggregate import Aggregates
from station.archive.layout import Series
from station.archive.store import Row, rows, said
from station.quantities import Bools, Floats, Floats32, Ints, Quality, Reference, Shared
from station.science import calibration, ground
from station.science.shared import against

Told = list[dict[str, Any]]

BLOCK_SHARE = 0.5  # of a block's cells that a scan must have seen
RECENT = 50  # epochs that say by what to multiply sigma now
LAGS = 8  # classes of distance
PAIRS = 500  # of each


@dataclass(frozen=True)
class _Seen:
    """The withheld cells (n,) that an epoch saw, by their place in the grid, and what it says of them."""

    row: Row
    scan_id: str
    cell: Ints
    change_m: Floats32
    sigma_m: Floats32
    random_m2: Floats32
    scanner: tuple[float, ...]
    unknown: Shared
    reference: Reference


@dataclass(frozen=True)
class Observed:
    """Stated against observed: by epoch, over all epochs, and by distance; rows ready for a table.

    Empty where no epoch has stable ground that was withheld from its adjustment.
    """

    epochs: Told  # time, scan_id, scale, band, count, z_std, z_robust, inside_95
    overall: Told  # scale, band, count, z_std, inside_95, factor, low, high, advised
    variogram: Told  # lag_m, pairs, observed_m2, stated_m2


def observe(series: Series, most: int, progress: Callable[[], None]) -> Observed:
    """Compare change with its sigma on withheld stable ground.

    In at most so many epochs, spread over the series. Epochs that the reference was made of are left out:
    they know it. Raises StoreError where nothing is stored.
    """
    found = list(_read(series, most, progress))
    if not found:
        return Observed([], [], [])
    ground_of = _Ground(series, found)
    epochs, lags = [], []
    for one in found:
        epochs += ground_of.fits(one)
        lags.append(ground_of.lags(one))
        progress()
    return Observed(epochs, _overall(epochs), _variogram(np.array(lags), ground_of.edges_m))


def some_epochs(series: Series, most: int) -> list[Row]:
    """Return the epochs that have a reference, or so many of them, spread evenly over the series."""
    usable = [row for row in rows(series) if said(row.path)["reference_version"]]
    if not usable:
        return []
    return [
        usable[at]
        for at in np.unique(np.linspace(0, len(usable) - 1, min(most, len(usable))).astype(np.int64))
    ]


def _read(series: Series, most: int, progress: Callable[[], None]) -> Iterator[_Seen]:
    held, grid = Aggregates(series), series.grid
    kept_out = ground.withheld(grid.x_m[None, :], grid.y_m[:, None])
    for row in some_epochs(series, most):
        with netCDF4.Dataset(row.path) as file:
            quality = np.ma.filled(file["quality"][row.index], 0)
            scan_id = str(file["scan_id"][row.index])
            chosen = kept_out & ((quality & Quality.STABLE_GROUND) > 0)
            sigma_m = np.ma.filled(file["elevation_change_uncertainty"][row.index].astype(np.float64), np.nan)
        progress()
        if not chosen.any():
            continue
        of = held.read(row, chosen)
        known = np.isfinite(of.change_m)
        if of.unknown is None or scan_id in of.reference.scan_ids or not known.any():
            continue
        unknown = of.unknown if of.adjusted else against(of.unknown, of.reference.shared)
        change_m, stated_m, random_m = (
            values[known].astype(np.float32) for values in (of.change_m, sigma_m[chosen], of.random_m)
        )
        cell = np.flatnonzero(chosen)[known]
        yield _Seen(row, scan_id, cell, change_m, stated_m, random_m**2, of.scanner, unknown, of.reference)


class _Ground:
    """All withheld cells of some epochs, and the sums over them that are looked at."""

    def __init__(self, series: Series, found: list[_Seen]) -> None:
        grid = series.grid
        self.cells = np.zeros(grid.shape, bool)
        self.cells.ravel()[np.unique(np.concatenate([one.cell for one in found]))] = True
        row, column = np.nonzero(self.cells)
        x_m, y_m = grid.x_m[column], grid.y_m[row]
        east_m, north_m = found[-1].scanner[:2]
        range_m = np.hypot(x_m - east_m, y_m - north_m)
        self.bands = calibration.range_bands(range_m)
        band = np.searchsorted([high for _, high in self.bands], range_m, side="right")
        self.sums: dict[str, tuple[sparse.csr_array, Ints]] = {}
        for size_m in calibration.SCALES_M:
            if size_m > grid.cell_m:
                weights = calibration.blocks(x_m, y_m, size_m)
                self.sums[f"{size_m:g} m"] = weights, np.rint(weights @ band).astype(np.int64)
        self.band = band
        self.sums["all"] = calibration.means(np.zeros(len(row), np.int64)), np.array([-1])
        self.sums["all of band"] = calibration.means(band), np.arange(len(self.bands))
        self.place = np.cumsum(self.cells.ravel()) - 1
        reach_m = float(np.hypot(np.ptp(x_m), np.ptp(y_m)))
        self.edges_m = np.geomspace(grid.cell_m, max(reach_m / 2, 4 * grid.cell_m), LAGS + 1)
        self.pairs = calibration.pairs(x_m, y_m, self.edges_m, PAIRS, seed=1)
        self._held = Aggregates(series)
        self._known: dict[tuple[str, tuple[float, ...]], tuple[calibration.Felt, calibration.Sums]] = {}

    def _felt(self, one: _Seen) -> tuple[calibration.Felt, calibration.Sums]:
        """Return what cells and pairs of them feel: the same as long as scanner and reference are."""
        key = one.reference.version, one.scanner
        if key not in self._known:
            held = self._held.read(one.row, self.cells)
            felt = calibration.Felt(self._held.felt(held, self.cells))
            apart = calibration.differences(*self.pairs[:2], len(self.band))
            self._known = {key: (felt, felt.sums(apart))}
        return self._known[key]

    def _spread_out(self, one: _Seen) -> tuple[Bools, Floats, Floats]:
        """Return which of all cells an epoch saw, their change and random variance."""
        at = self.place[one.cell]
        seen, change_m, random_m2 = (
            np.zeros(len(self.band), bool),
            np.zeros(len(self.band)),
            np.zeros(len(self.band)),
        )
        seen[at], change_m[at], random_m2[at] = True, one.change_m, one.random_m2
        return seen, change_m, random_m2

    def fits(self, one: _Seen) -> Told:
        """Return how the errors of an epoch compare with their sigma, by scale and band."""
        (felt, _), (seen, change_m, random_m2) = self._felt(one), self._spread_out(one)
        z_of = {
            "cell": (
                np.asarray(one.change_m / one.sigma_m, dtype=np.float64),
                self.band[self.place[one.cell]],
            )
        }
        for scale, (weights, band) in self.sums.items():
            kept, share = calibration.renormalised(weights, seen)
            z = (kept @ change_m) / np.sqrt(
                np.maximum(felt.sums(kept).variance(random_m2, one.unknown), 1e-18)
            )
            z_of[scale] = np.where(share >= BLOCK_SHARE, z, np.nan), band[: len(z)]
        told = []
        for scale, (z, band) in z_of.items():
            for number, name in [(-1, "all"), *((n, _name(b)) for n, b in enumerate(self.bands))]:
                chosen = z if number < 0 else z[band == number]
                if scale.startswith("all") and (number < 0) != (scale == "all"):
                    continue
                if np.isfinite(chosen).any():
                    told.append(
                        _one_epoch(one, scale.split()[0] if scale.startswith("all") else scale, name, chosen)
                    )
        return told

    def lags(self, one: _Seen) -> Floats:
        """Return sums by distance (3, LAGS): half the squared differences, half their variance, how many."""
        first, second, lag = self.pairs
        (_, apart), (seen, change_m, random_m2) = self._felt(one), self._spread_out(one)
        both = seen[first] & seen[second]
        stated_m2 = apart.variance(random_m2, one.unknown)[both]
        observed_m2 = (change_m[first] - change_m[second])[both] ** 2
        lag = lag[both]
        return np.stack(
            [np.bincount(lag, w, LAGS) for w in (observed_m2 / 2, stated_m2 / 2, np.ones(len(lag)))]
        )


def _name(band: tuple[float, float]) -> str:
    return f"{band[0]:g}-{band[1]:g} m"


def _one_epoch(one: _Seen, scale: str, band: str, z: Floats) -> dict[str, Any]:
    known = z[np.isfinite(z)]
    return {
        "time": one.row.start.strftime("%Y-%m-%dT%H:%M:%SZ"), "scan_id": one.scan_id,
        "scale": scale, "band": band, "z": known.astype(np.float32), **asdict(calibration.fit(known)),
    }  # fmt: skip


def _overall(epochs: Told) -> Told:
    """Take all epochs together, by scale and band; the newest say by what to multiply sigma."""
    told = []
    for scale, band in dict.fromkeys((one["scale"], one["band"]) for one in epochs):
        of = [one for one in epochs if (one["scale"], one["band"]) == (scale, band)]
        together = calibration.fit(np.concatenate([one["z"] for one in of]))
        factor = calibration.scale([one["z"] for one in of[-RECENT:]])
        told.append({"scale": scale, "band": band, "epochs": len(of), **asdict(together), **asdict(factor)})
    return told


def _variogram(lags: Floats, edges_m: Floats) -> Told:
    observed_m2, stated_m2, count = lags.sum(axis=0)
    return [
        {
            "lag_m": float(np.sqrt(edges_m[at] * edges_m[at + 1])), "pairs": int(count[at]),
            "observed_m2": float(observed_m2[at] / count[at]), "stated_m2": float(stated_m2[at] / count[at]),
        }
        for at in np.flatnonzero(count)
    ]  # fmt: skip
