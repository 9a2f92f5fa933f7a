"""What a processed station got wrong, against its truth, and whether it had said so."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from pathlib import Path

import numpy as np
import xarray as xr
from scipy import sparse
from scipy.stats import median_abs_deviation

from benchmarks.stations import Method, site_of
from station.archive.aggregate import SLACK
from station.archive.opened import open_series
from station.archive.reference import read_reference
from station.config import Site
from station.quantities import Bools, ChangeErrors, Floats, Grid, Quality, Reference, Shared
from station.science import calibration, ground, held, likeness, shared, terrain
from station.science.view import View

BOX_M = 100.0
BOX_COVERAGE = 0.6
BOX_RANGE_M = (650.0, 3400.0)  # Voordendag et al. (2023), Table 2: 0.65-3.42 km
BOX_INCIDENCE_DEG = (40.0, 75.0)
BOXES = 20
FAR_M = 2000.0
BANDS_KM = ((0.0, 1.0), (1.0, 1.5), (1.5, 2.5), (2.5, 9.0))
PAIRS = 120
CELLS = 300
LIMIT_95 = 1.96


@dataclass(frozen=True)
class Geometry:
    """Where the cells of a station are seen from."""

    grid: Grid
    range_m: Floats  # (ny, nx)
    incidence_deg: Floats  # (ny, nx) NaN where the reference is unknown
    polygons: Bools  # (ny, nx) rock that an owner may know

    def boxes(self, step_m: float) -> list[tuple[slice, slice]]:
        """All 100 m boxes, begun every so many metres."""
        size, step = round(BOX_M / self.grid.cell_m), max(1, round(step_m / self.grid.cell_m))
        return [
            (slice(top, top + size), slice(left, left + size))
            for top in range(0, self.grid.ny - size + 1, step)
            for left in range(0, self.grid.nx - size + 1, step)
        ]


class Result:
    """A station as one method measured it; `error_m` is of the change since the reference."""

    def __init__(self, home: Path, method: Method) -> None:
        self.site: Site = site_of(home, method)
        first = self.site.reference.scans
        if not isinstance(first, int):
            raise TypeError("the simulation's site file counts its reference scans")
        after = slice(first, None)
        with open_series(self.site.station.data) as series:
            self.series = series.isel(time=after).load()
        with xr.open_dataset(home / "truth.nc") as truth:
            true_m = truth.change.values
            self.unchanged_m = truth.unchanged_elevation.values
            self.good_rock = truth.stable_polygons.values > 0
        self.true_m = (true_m[after] - true_m[:first].mean(axis=0)).astype(np.float32)
        self.change_m = self.series.elevation_change.values
        self.error_m = self.change_m - self.true_m
        self.sigma_m = self.series.elevation_change_uncertainty.values
        self.random_m = self.series.elevation_change_random_uncertainty.values
        self.quality = self.series.quality.values.astype(np.int64)
        self.count = self.series.point_count.values
        self.joint = method.adjustment == "joint"

    @cached_property
    def reference(self) -> Reference:
        """The surface that the method measured from."""
        from station.service.tasks import series_of  # noqa: PLC0415 - a heavy import

        found = read_reference(series_of(self.site))
        if found is None:
            raise ValueError("no reference was made")
        return found

    @cached_property
    def position_m(self) -> tuple[float, float, float]:
        """Where the scanner stands on the map."""
        return tuple(float(self.series[f"scanner_{axis}"][0]) for axis in ("east", "north", "height"))

    @cached_property
    def gradient(self) -> tuple[Floats, Floats]:
        """Smoothed gradient of the reference (ny, nx)."""
        return terrain.smooth_gradient(self.reference.elevation_m, self.site.grid_cells.cell_m)

    @cached_property
    def geometry(self) -> Geometry:
        """Range and incidence of the cells."""
        grid = self.site.grid_cells
        x_m, y_m = np.meshgrid(grid.x_m, grid.y_m)
        seen = View.of((x_m, y_m, self.reference.elevation_m), self.position_m, *self.gradient)
        horizontal_m = np.hypot(x_m - self.position_m[0], y_m - self.position_m[1])
        return Geometry(grid, horizontal_m, np.degrees(np.arccos(seen.cos_incidence)), self.good_rock)

    @cached_property
    def seen(self) -> Bools:
        """Tell which cells (ny, nx) most scans see."""
        return np.isfinite(self.change_m).mean(axis=0) > 0.5


def twenty_boxes(result: Result) -> list[tuple[slice, slice]]:
    """Choose boxes off the stable rock, spread over range and incidence as those of the paper's Table 2."""
    told = result.geometry
    found, places = [], []
    for box in told.boxes(BOX_M / 4):
        seen = result.seen[box]
        angle_deg = np.nanmedian(told.incidence_deg[box]) if seen.any() else np.nan
        range_m = told.range_m[box].mean()
        fits = BOX_INCIDENCE_DEG[0] <= angle_deg <= BOX_INCIDENCE_DEG[1]
        within = BOX_RANGE_M[0] <= range_m <= BOX_RANGE_M[1]
        if seen.mean() >= BOX_COVERAGE and fits and within and not told.polygons[box].any():
            found.append(box)
            places.append((range_m, angle_deg))
    chosen: list[int] = []
    where = np.array(places).reshape(-1, 2)
    top = np.array([(box[0].start, box[1].start) for box in found]).reshape(-1, 2)
    apart = np.ones(len(found), bool)
    for number in range(BOXES):
        if not apart.any():
            break
        range_m = np.interp(number, (0, BOXES - 1), BOX_RANGE_M)
        angle_deg = np.interp((number * 0.618) % 1, (0, 1), BOX_INCIDENCE_DEG)
        off = np.hypot((where[:, 0] - range_m) / 100, (where[:, 1] - angle_deg) / 10)
        best = int(np.argmin(np.where(apart, off, np.inf)))
        chosen.append(best)
        size = BOX_M / told.grid.cell_m
        apart &= (np.abs(top - top[best]) >= size).any(axis=1)
    return [found[one] for one in chosen]


def box_means(values_m: Floats, boxes: list[tuple[slice, slice]]) -> Floats:
    """Mean over the known cells of each box (scans, boxes) [m]."""
    return np.stack([np.nanmean(values_m[:, rows, columns], axis=(1, 2)) for rows, columns in boxes], axis=1)


def box_figures(result: Result, boxes: list[tuple[slice, slice]]) -> dict[str, float]:
    """Return how wrong the boxes are, together and against each other [m], and the noise of far cells."""
    error_m = box_means(result.error_m, boxes)
    flat = np.abs(error_m[np.isfinite(error_m)])
    far = (result.geometry.range_m > FAR_M) & ~result.good_rock
    noise_m = [median_abs_deviation(one[far], scale="normal", nan_policy="omit") for one in result.error_m]
    return {
        "box_rms_m": float(np.sqrt(np.mean(flat**2))),
        "box_95_m": float(np.percentile(flat, 95)),
        "box_max_m": float(flat.max()),
        "box_spread_m": float(np.nanmean(np.nanstd(error_m, axis=1))),
        "box_bias_m": float(np.nanmean(error_m)),
        "far_cell_noise_m": float(np.median(noise_m)),
    }


class Calibration:
    """Errors over their sigma, for cells, boxes and areas, of epochs and of differences of epochs.

    The arithmetic of `Aggregates.variance` for many weights at once.
    """

    def __init__(self, result: Result, seed: int = 1) -> None:
        self.result = result
        self.random = np.random.default_rng(seed)
        told = result.series
        names = ("scanner_axis_east", "scanner_axis_north")
        east, north = (float(told[name][0]) for name in names)
        axis = east, north, float(np.sqrt(max(1 - east**2 - north**2, 0)))
        grid = result.site.grid_cells
        self.known = np.isfinite(result.reference.elevation_m)
        self.index = np.cumsum(self.known.ravel()).reshape(self.known.shape) - 1
        felt = shared.cell_sensitivities(
            shared.basis(grid, result.position_m, axis),
            grid,
            result.position_m,
            result.reference.elevation_m,
            result.gradient,
            self.known,
        )
        self.design, self.lines = calibration.matrices(felt)
        self.of = felt.of
        self.error_m = result.error_m[:, self.known]
        self.random_m2 = result.random_m[:, self.known].astype(np.float64) ** 2
        self.before_m2 = result.reference.random_variance_m2[self.known].astype(np.float64)
        self.range_m = result.geometry.range_m[self.known]
        self.covariance = told.shared_parameter_covariance.values.astype(np.float64)
        self.noise = told.shared_parameter_noise_variance.values.astype(np.float64)
        self.change_errors = np.nan_to_num(told.change_errors.values.astype(np.float64))
        self.change_pattern = np.nan_to_num(told.change_pattern.values.astype(np.float64))
        self.slack_m2 = np.stack([told[name].values for name in SLACK], axis=1)
        row, column = np.nonzero(self.known)
        kept_out = ground.withheld(grid.x_m[column], grid.y_m[row])
        smooth = np.hypot(*felt.globals_[3:5]) < ground.MOVING_STEEPEST
        self.kind = [
            ground.kinds((one[self.known] & Quality.STABLE_GROUND) > 0, kept_out, smooth, kept_out & False)
            for one in result.quality
        ]
        if not result.joint and result.reference.shared is not None:
            self.base = result.reference.shared.covariance, result.reference.shared.noise_variance
        else:
            self.base = None

    def z(self, targets: sparse.csr_array, epoch: int, other: int | None = None) -> tuple[Floats, Floats]:
        """Error over sigma of each target (targets, cells), and how much of it was seen."""
        epochs = [epoch] if other is None else [epoch, other]
        error_m = self.error_m[epoch] - (0.0 if other is None else self.error_m[other])
        seen = np.isfinite(error_m)
        weights = targets @ sparse.diags_array(seen.astype(np.float64))
        share = np.asarray(weights.sum(axis=1)).ravel()
        weights = sparse.diags_array(1 / np.maximum(share, 1e-12)) @ weights
        g, lines = (weights @ self.design).toarray(), (weights @ self.lines).toarray()
        squares, variance_m2, least_m2 = weights.power(2), np.zeros(len(share)), np.zeros(len(share))
        for one in epochs:
            random_m2, free = np.where(seen, self.random_m2[one], 0.0), np.ones(len(seen))
            covariance, noise = self.covariance[one], self.noise[one]
            g_rest, lines_rest = g, lines
            if other is not None:
                whole_m2, random_m2 = random_m2, np.where(seen, random_m2 - self.before_m2, 0.0).clip(0.0)
                if np.isfinite(self.slack_m2[one]).all():
                    free = 1 - held.share(random_m2, whole_m2, self.kind[one], tuple(self.slack_m2[one]))
                    rest = weights @ sparse.diags_array(2 * free - 1)
                    g_rest, lines_rest = (rest @ self.design).toarray(), (rest @ self.lines).toarray()
            elif self.base is not None:
                covariance, noise = covariance + self.base[0], noise + self.base[1]
            first = len(shared.GLOBAL)
            own = np.repeat(noise[first : first + self.of.intervals], shared.LINES_A_KNOT)
            told_m2 = squares @ random_m2 + np.sum((g @ covariance) * g_rest, axis=1)
            told_m2 += (lines * lines_rest) @ own
            variance_m2 += np.maximum(told_m2, squares @ (random_m2 * free))
            least_m2 += squares @ (random_m2 * free)
        if other is not None and self.base is None:
            common = likeness.common_errors(self._shared(epoch), self._shared(other))
            variance_m2 = np.maximum(variance_m2 - 2 * np.sum((g @ common) * g, axis=1), least_m2)
        z = weights @ np.where(seen, error_m, 0.0) / np.sqrt(np.maximum(variance_m2, 1e-12))
        return np.where(share > 0, z, np.nan), share

    def _shared(self, epoch: int) -> Shared:
        """Return what the points of an epoch share."""
        change = ChangeErrors(self.change_errors[epoch], self.change_pattern[epoch])
        nothing = np.zeros(len(self.of.names))
        return Shared(
            self.of.names, self.of.units, nothing, self.covariance[epoch], self.noise[epoch], change
        )

    def targets(self, scale: str) -> sparse.csr_array:
        """Weights (targets, cells) of one scale: cell, 10 m, 100 m, or the whole area; rock is left out."""
        moving = self.known & ~self.result.good_rock & self.result.seen
        grid = self.result.site.grid_cells
        if scale == "area":
            return _rows([self.index[moving]], self.known.sum())
        size = {"cell": 1, "10 m": max(1, round(10 / grid.cell_m)), "100 m": round(BOX_M / grid.cell_m)}[
            scale
        ]
        if scale == "100 m":
            corners = [(rows.start, columns.start) for rows, columns in self.result.geometry.boxes(BOX_M)]
        else:
            row, column = np.nonzero(moving)
            some = self.random.choice(len(row), min(CELLS, len(row)), replace=False)
            corners = list(zip(row[some], column[some], strict=True))
        found = []
        for row, column in corners:
            box = slice(row, row + size), slice(column, column + size)
            if moving[box].mean() >= BOX_COVERAGE:
                found.append(self.index[box][moving[box]])
        return _rows(found, self.known.sum())

    def figures(self) -> dict[str, dict[str, float]]:
        """Spread of z and coverage of 95 %, by scale and band of range, of epochs and of pairs."""
        epochs = range(len(self.error_m))
        pairs = list(combinations(epochs, 2))
        some = self.random.choice(len(pairs), min(PAIRS, len(pairs)), replace=False)
        cases = {"epoch": [(one, None) for one in epochs], "pair": [pairs[one] for one in some]}
        told = {}
        for scale in ("cell", "10 m", "100 m", "area"):
            targets = self.targets(scale)
            range_km = targets @ self.range_m / 1000
            for case, many in cases.items():
                found = [self.z(targets, *one) for one in many]
                z = np.where([share >= BOX_COVERAGE for _, share in found], [z for z, _ in found], np.nan)
                told[f"{case} {scale}"] = _summary(z)
                if scale == "area":
                    continue
                for low, high in BANDS_KM:
                    inside = (range_km >= low) & (range_km < high)
                    told[f"{case} {scale} {low:g}-{high:g} km"] = _summary(z[:, inside])
        return told | self._withheld()

    def _withheld(self) -> dict[str, dict[str, float]]:
        """Spread of z of single cells: stable but kept out of the fit, fitted, and the rest."""
        result = self.result
        kept_out = ground.withheld(result.site.grid_cells.x_m, result.site.grid_cells.y_m[:, None])
        stable = (result.quality & Quality.STABLE_GROUND) > 0
        with np.errstate(invalid="ignore", divide="ignore"):
            z = result.error_m / result.sigma_m
        return {
            "cells withheld": _summary(z[stable & kept_out]),
            "cells fitted": _summary(z[stable & ~kept_out]),
            "cells not stable": _summary(z[~stable]),
        }


def _summary(z: Floats) -> dict[str, float]:
    z = z[np.isfinite(z)]
    if len(z) < 10:
        return {"z_std": np.nan, "z_robust": np.nan, "z_mean": np.nan, "inside_95": np.nan, "count": len(z)}
    return {
        "z_std": float(np.std(z)),
        "z_rms": float(np.sqrt(np.mean(z**2))),
        "z_robust": float(median_abs_deviation(z, scale="normal")),
        "z_mean": float(np.mean(z)),
        "inside_95": float(np.mean(np.abs(z) < LIMIT_95)),
        "count": len(z),
    }


def _rows(chosen: list[np.ndarray], cells: int) -> sparse.csr_array:
    """Rows of equal weights that sum to one."""
    size = [len(one) for one in chosen]
    values = np.repeat(1 / np.maximum(size, 1), size)
    row = np.repeat(np.arange(len(chosen)), size)
    column = np.concatenate(chosen) if chosen else np.empty(0, int)
    return sparse.csr_array((values, (row, column)), shape=(len(chosen), int(cells)))
