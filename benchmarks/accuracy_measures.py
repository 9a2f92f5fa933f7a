"""Errors of a processed station against its simulated truth: of boxes, of real change, relative to sigma."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from pathlib import Path

import numpy as np
import xarray as xr
from scipy import sparse
from scipy.stats import median_abs_deviation

from benchmarks.accuracy_stations import Method, site_of
from station.archive.reference_files import read_reference
from station.archive.series.lazy import open_series
from station.config import Site
from station.quantities import (
    Bools,
    ChangeErrors,
    Floats,
    Floats32,
    Grid,
    Quality,
    Reference,
    SharedParameters,
)
from station.queries.aggregates import LEVERAGE_VARIABLES
from station.science.adjustment import ground_classes, leverage
from station.science.analysis import calibration
from station.science.geometry import terrain
from station.science.geometry.observation import Observation
from station.science.uncertainty import common_mode, jacobian, parameters

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
MELT_M = 0.02  # least true change of a melting cell at the end
DEPOSIT_M = 0.5
AFFECTED_M = 0.005
THIN_M = (0.05, 0.15)  # a change of about 10 cm
FEW_POINTS = 2  # per cell
FAR_EVENT_M = 2500.0

Box = tuple[slice, slice]


@dataclass(frozen=True)
class Geometry:
    """Viewing geometry of the cells of a station."""

    grid: Grid
    range_m: Floats  # (ny, nx)
    incidence_deg: Floats  # (ny, nx) NaN where the reference is unknown
    rock: Bools  # (ny, nx) stable ground that an operator may know

    def boxes(self, step_m: float) -> list[Box]:
        """Return all 100 m boxes whose corners are multiples of `step_m`."""
        size, step = round(BOX_M / self.grid.cell_m), max(1, round(step_m / self.grid.cell_m))
        return [
            (slice(top, top + size), slice(left, left + size))
            for top in range(0, self.grid.ny - size + 1, step)
            for left in range(0, self.grid.nx - size + 1, step)
        ]


class Result:
    """A station processed by one method; `error_m` is that of the change since the reference."""

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
            self.rock = truth.stable_polygons.values > 0
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
        """The reference surface of the method."""
        from station.processing.scan_tasks import series_for  # noqa: PLC0415 - a heavy import

        reference = read_reference(series_for(self.site))
        if reference is None:
            raise ValueError("no reference was built")
        return reference

    @cached_property
    def position_m(self) -> tuple[float, float, float]:
        """Position of the scanner on the map [m]."""
        east, north, height = (
            float(self.series[f"scanner_{axis}"][0]) for axis in ("east", "north", "height")
        )
        return east, north, height

    @cached_property
    def gradient(self) -> tuple[Floats32, Floats32]:
        """Smoothed gradient of the reference, east and north (ny, nx)."""
        return terrain.smooth_gradient(self.reference.elevation_m, self.site.grid_cells.cell_m)

    @cached_property
    def geometry(self) -> Geometry:
        """Range and incidence of the cells."""
        grid = self.site.grid_cells
        x_m, y_m = np.meshgrid(grid.x_m, grid.y_m)
        observation = Observation.from_points(
            (x_m, y_m, self.reference.elevation_m), self.position_m, *self.gradient
        )
        horizontal_m = np.hypot(x_m - self.position_m[0], y_m - self.position_m[1])
        return Geometry(grid, horizontal_m, np.degrees(np.arccos(observation.cos_incidence)), self.rock)

    @cached_property
    def observed(self) -> Bools:
        """Cells (ny, nx) that most scans observe."""
        return np.asarray(np.isfinite(self.change_m).mean(axis=0) > 0.5)


def twenty_boxes(result: Result) -> list[Box]:
    """Return boxes off the stable rock, spread over range and incidence as in Table 2 of the paper."""
    geometry = result.geometry
    candidates: list[Box] = []
    places = []
    for box in geometry.boxes(BOX_M / 4):
        observed = result.observed[box]
        angle_deg = np.nanmedian(geometry.incidence_deg[box]) if observed.any() else np.nan
        range_m = geometry.range_m[box].mean()
        in_incidence = BOX_INCIDENCE_DEG[0] <= angle_deg <= BOX_INCIDENCE_DEG[1]
        in_range = BOX_RANGE_M[0] <= range_m <= BOX_RANGE_M[1]
        if observed.mean() >= BOX_COVERAGE and in_incidence and in_range and not geometry.rock[box].any():
            candidates.append(box)
            places.append((range_m, angle_deg))
    chosen: list[int] = []
    place = np.array(places).reshape(-1, 2)
    top = np.array([(box[0].start, box[1].start) for box in candidates]).reshape(-1, 2)
    free = np.ones(len(candidates), bool)
    for number in range(BOXES):
        if not free.any():
            break
        range_m = np.interp(number, (0, BOXES - 1), BOX_RANGE_M)
        angle_deg = np.interp((number * 0.618) % 1, (0, 1), BOX_INCIDENCE_DEG)
        distance = np.hypot((place[:, 0] - range_m) / 100, (place[:, 1] - angle_deg) / 10)
        best = int(np.argmin(np.where(free, distance, np.inf)))
        chosen.append(best)
        size = BOX_M / geometry.grid.cell_m
        free &= (np.abs(top - top[best]) >= size).any(axis=1)
    return [candidates[index] for index in chosen]


def box_means(values_m: Floats, boxes: list[Box]) -> Floats:
    """Return the mean over the known cells of each box (scans, boxes) [m]."""
    return np.stack([np.nanmean(values_m[:, rows, columns], axis=(1, 2)) for rows, columns in boxes], axis=1)


def box_figures(result: Result, boxes: list[Box]) -> dict[str, float]:
    """Return statistics of the errors of boxes, and the noise of far cells [m]."""
    error_m = box_means(result.error_m, boxes)
    absolute_m = np.abs(error_m[np.isfinite(error_m)])
    far = (result.geometry.range_m > FAR_M) & ~result.rock
    noise_m = [
        median_abs_deviation(scan_m[far], scale="normal", nan_policy="omit") for scan_m in result.error_m
    ]
    return {
        "box_rms_m": float(np.sqrt(np.mean(absolute_m**2))),
        "box_95_m": float(np.percentile(absolute_m, 95)),
        "box_max_m": float(absolute_m.max()),
        "box_spread_m": float(np.nanmean(np.nanstd(error_m, axis=1))),
        "box_bias_m": float(np.nanmean(error_m)),
        "far_cell_noise_m": float(np.median(noise_m)),
    }


class Calibration:
    """Standardised errors of cells, boxes and areas, for epochs and for differences of epochs.

    The same as `Aggregates.variance`, for many weighted means at once.
    """

    def __init__(self, result: Result, seed: int = 1) -> None:
        self.result = result
        self.random = np.random.default_rng(seed)
        series = result.series
        names = ("scanner_axis_east", "scanner_axis_north")
        east, north = (float(series[name][0]) for name in names)
        axis = east, north, float(np.sqrt(max(1 - east**2 - north**2, 0)))
        grid = result.site.grid_cells
        self.known = np.isfinite(result.reference.elevation_m)
        self.index = np.cumsum(self.known.ravel()).reshape(self.known.shape) - 1
        cells = jacobian.cell_jacobian(
            parameters.parameter_layout(grid, result.position_m, axis),
            grid,
            result.position_m,
            result.reference.elevation_m,
            result.gradient,
            self.known,
        )
        self.params = cells.params
        self.design = cells.to_sparse()
        self.lines = cells.line_tilt_to_sparse()
        self.projector = parameters.knot_interpolation(self.params).residual_projector
        self.error_m = result.error_m[:, self.known]
        self.random_m2 = result.random_m[:, self.known].astype(np.float64) ** 2
        self.reference_variance_m2 = result.reference.random_variance_m2[self.known].astype(np.float64)
        self.range_m = result.geometry.range_m[self.known]
        self.covariance = series.shared_parameter_covariance.values.astype(np.float64)
        self.line_variance = series.shared_parameter_line_tilt_variance.values.astype(np.float64)
        self.change_errors = np.nan_to_num(series.change_errors.values.astype(np.float64))
        self.change_pattern = np.nan_to_num(series.change_pattern.values.astype(np.float64))
        self.leverage_m2 = np.stack([series[name].values for name in LEVERAGE_VARIABLES], axis=1)
        row, column = np.nonzero(self.known)
        holdout = ground_classes.is_holdout(grid.x_m[column], grid.y_m[row])
        smooth = np.hypot(*cells.pose[3:5]) < ground_classes.MAX_MOVING_SLOPE
        self.ground_class = [
            ground_classes.classify(
                (quality[self.known] & Quality.STABLE_GROUND) > 0, holdout, smooth, holdout & False
            )
            for quality in result.quality
        ]
        self.base: tuple[Floats, Floats] | None = None
        if not result.joint and result.reference.shared is not None:
            self.base = result.reference.shared.covariance, result.reference.shared.line_tilt_variance

    def z(self, targets: sparse.csr_array, epoch: int, other: int | None = None) -> tuple[Floats, Floats]:
        """Return error over sigma of each target (m,), and the share of it that was observed (m,)."""
        epochs = [epoch] if other is None else [epoch, other]
        error_m = self.error_m[epoch] - (0.0 if other is None else self.error_m[other])
        observed = np.isfinite(error_m)
        weights, share = calibration.renormalise(targets, observed)
        g, lines = self._effects(weights)
        squared, variance_m2, least_m2 = weights.power(2), np.zeros(len(share)), np.zeros(len(share))
        first = len(parameters.GLOBAL)
        for index in epochs:
            random_m2, free = np.where(observed, self.random_m2[index], 0.0), np.ones(len(observed))
            covariance, line_m2 = self.covariance[index], self.line_variance[index]
            adjusted_g, adjusted_lines = g, lines
            if other is not None:
                total_m2 = random_m2
                random_m2 = np.where(observed, total_m2 - self.reference_variance_m2, 0.0).clip(0.0)
                if np.isfinite(self.leverage_m2[index]).all():
                    free = 1 - leverage.leverage(
                        random_m2, total_m2, self.ground_class[index], tuple(self.leverage_m2[index])
                    )
                    adjusted = weights @ sparse.diags_array(2 * free - 1)
                    adjusted_g, adjusted_lines = self._effects(adjusted)
            elif self.base is not None:
                covariance, line_m2 = covariance + self.base[0], line_m2 + self.base[1]
            by_line = np.repeat(
                line_m2[first : first + self.params.knot_intervals], parameters.LINE_GROUPS_PER_KNOT
            )
            epoch_m2 = squared @ random_m2 + np.sum((g @ covariance) * adjusted_g, axis=1)
            epoch_m2 += (lines * adjusted_lines) @ by_line
            variance_m2 += np.maximum(epoch_m2, squared @ (random_m2 * free))
            least_m2 += squared @ (random_m2 * free)
        if other is not None and self.base is None:
            common = common_mode.cross_covariance(self._shared(epoch), self._shared(other))
            if common is not None:
                variance_m2 = np.maximum(variance_m2 - 2 * np.sum((g @ common) * g, axis=1), least_m2)
        z = weights @ np.where(observed, error_m, 0.0) / np.sqrt(np.maximum(variance_m2, 1e-12))
        return np.where(share > 0, z, np.nan), share

    def _effects(self, weights: sparse.csr_array) -> tuple[Floats, Floats]:
        """Return the derivatives of means by the shared parameters (m, p) and the line tilts (m, lines)."""
        return (weights @ self.design).toarray(), (weights @ self.lines).toarray() @ self.projector

    def _shared(self, epoch: int) -> SharedParameters:
        """Return the shared parameters of an epoch."""
        change = ChangeErrors(self.change_errors[epoch], self.change_pattern[epoch])
        estimate = np.zeros(len(self.params.names))
        return SharedParameters(
            self.params.names,
            self.params.units,
            estimate,
            self.covariance[epoch],
            self.line_variance[epoch],
            change,
        )

    def targets(self, scale: str) -> sparse.csr_array:
        """Return weights (targets, cells) of a scale, without rock: cell, 10 m, 100 m, or the whole area."""
        moving = self.known & ~self.result.rock & self.result.observed
        grid = self.result.site.grid_cells
        if scale == "area":
            return _means([self.index[moving]], self.known.sum())
        size = {"cell": 1, "10 m": max(1, round(10 / grid.cell_m)), "100 m": round(BOX_M / grid.cell_m)}[
            scale
        ]
        if scale == "100 m":
            corners = [(rows.start, columns.start) for rows, columns in self.result.geometry.boxes(BOX_M)]
        else:
            row, column = np.nonzero(moving)
            sample = self.random.choice(len(row), min(CELLS, len(row)), replace=False)
            corners = list(zip(row[sample], column[sample], strict=True))
        members = []
        for row, column in corners:
            box = slice(row, row + size), slice(column, column + size)
            if moving[box].mean() >= BOX_COVERAGE:
                members.append(self.index[box][moving[box]])
        return _means(members, self.known.sum())

    def figures(self) -> dict[str, dict[str, float]]:
        """Return statistics of z by scale and range, for epochs and for pairs of epochs."""
        epochs = range(len(self.error_m))
        pairs = list(combinations(epochs, 2))
        sample = self.random.choice(len(pairs), min(PAIRS, len(pairs)), replace=False)
        cases: dict[str, list[tuple[int, int | None]]] = {
            "epoch": [(epoch, None) for epoch in epochs],
            "pair": [pairs[index] for index in sample],
        }
        figures = {}
        for scale in ("cell", "10 m", "100 m", "area"):
            targets = self.targets(scale)
            range_km = targets @ self.range_m / 1000
            for case, selections in cases.items():
                results = [self.z(targets, *selection) for selection in selections]
                z = np.where([share >= BOX_COVERAGE for _, share in results], [z for z, _ in results], np.nan)
                figures[f"{case} {scale}"] = _summary(z)
                if scale == "area":
                    continue
                for low, high in BANDS_KM:
                    inside = (range_km >= low) & (range_km < high)
                    figures[f"{case} {scale} {low:g}-{high:g} km"] = _summary(z[:, inside])
        return figures | self._by_ground_class()

    def _by_ground_class(self) -> dict[str, dict[str, float]]:
        """Return statistics of z of cells: stable in the hold-out, stable and fitted, not stable."""
        result = self.result
        holdout = ground_classes.is_holdout(result.site.grid_cells.x_m, result.site.grid_cells.y_m[:, None])
        stable = (result.quality & Quality.STABLE_GROUND) > 0
        with np.errstate(invalid="ignore", divide="ignore"):
            z = result.error_m / result.sigma_m
        return {
            "cells of the hold-out": _summary(z[stable & holdout]),
            "cells fitted": _summary(z[stable & ~holdout]),
            "cells not stable": _summary(z[~stable]),
        }


def _summary(z: Floats) -> dict[str, float]:
    """Return statistics of standardised errors; NaN if there are fewer than 10."""
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


def _means(chosen: list[np.ndarray], cells: int) -> sparse.csr_array:
    """Return weights (means, cells) that average the chosen cells of each mean."""
    size = [len(members) for members in chosen]
    values = np.repeat(1 / np.maximum(size, 1), size)
    row = np.repeat(np.arange(len(chosen)), size)
    column = np.concatenate(chosen) if chosen else np.empty(0, int)
    return sparse.csr_array((values, (row, column)), shape=(len(chosen), int(cells)))


def event_figures(name: str, result: Result, calm: Result | None) -> dict[str, float]:
    """Return the recovery of a scenario's change; `calm` is the same station without it, if processed."""
    if name == "melt":
        return _melt(result) | _thin(result)
    if name == "avalanche":
        return _avalanche(result, calm)
    return _thin(result) if name == "snow" else {}


def _melt(result: Result) -> dict[str, float]:
    """Return the regression over scans of measured on true mean change of the melting ice."""
    melting = (np.abs(result.true_m[-1]) > MELT_M) & result.observed
    used = np.isfinite(result.change_m) & melting
    true_m, measured_m = (
        np.array([np.mean(values[cells]) for values, cells in zip(field, used, strict=True)])
        for field in (result.true_m, result.change_m)
    )
    slope, offset_m = np.polyfit(true_m, measured_m, 1)
    return {
        "melt_retained": float(slope),
        "melt_offset_m": float(offset_m),
        "melt_scatter_m": float(np.std(measured_m - slope * true_m - offset_m)),
        "melt_last_ratio": float(measured_m[-3:].mean() / true_m[-3:].mean()),
        "melt_true_end_m": float(true_m[-1]),
    }


def _avalanche(result: Result, calm: Result | None) -> dict[str, float]:
    """Return the recovery of a deposit in its first scan, and its effect on boxes elsewhere."""
    scan = int(np.argmax(np.abs(result.true_m).max(axis=(1, 2)) > DEPOSIT_M))
    deposit = (result.true_m[scan] > DEPOSIT_M) & np.isfinite(result.change_m[scan])
    affected = np.abs(result.true_m[scan]) > AFFECTED_M
    flagged = (result.quality[scan] & Quality.CHANGE_SIGNIFICANT) > 0
    unaffected = _unaffected_boxes(result, affected)
    step_m = box_means(result.error_m[scan : scan + 1] - result.error_m[scan - 1 : scan], unaffected)
    figures = {
        "deposit_ratio": float(result.change_m[scan][deposit].sum() / result.true_m[scan][deposit].sum()),
        "deposit_cells": float(deposit.sum()),
        "deposit_significant": float(flagged[deposit].mean()),
        "unaffected_step_max_m": float(np.nanmax(np.abs(step_m))),
        "unaffected_step_rms_m": float(np.sqrt(np.nanmean(step_m**2))),
    }
    if calm is not None:  # same motion and shots, so that the difference is due to the avalanche
        leak_m = box_means((result.error_m - calm.error_m)[scan : scan + 1], unaffected)
        figures |= {
            "leak_max_m": float(np.nanmax(np.abs(leak_m))),
            "leak_rms_m": float(np.sqrt(np.nanmean(leak_m**2))),
        }
    return figures


def _unaffected_boxes(result: Result, affected: Bools) -> list[tuple[slice, slice]]:
    return [
        box
        for box in result.geometry.boxes(BOX_M)
        if result.observed[box].mean() >= BOX_COVERAGE and not affected[box].any()
    ]


def _thin(result: Result) -> dict[str, float]:
    """Return the recovered share of a change of about 10 cm in cells of one or two points, and of more."""
    true_m = np.abs(result.true_m)
    thin = (true_m > THIN_M[0]) & (true_m < THIN_M[1]) & np.isfinite(result.change_m)
    far = np.broadcast_to(result.geometry.range_m > FAR_EVENT_M, thin.shape)
    few = (result.count > 0) & (result.count <= FEW_POINTS)
    return {
        "thin_few_points": _slope(result, thin & few),
        "thin_more_points": _slope(result, thin & ~few),
        "thin_few_points_far": _slope(result, thin & few & far),
        "thin_cells": float((thin & few).sum()),
    }


def _slope(result: Result, cells: Bools) -> float:
    """Return the slope of measured on true change of cells, through the origin."""
    true_m, measured_m = (field[cells].astype(np.float64) for field in (result.true_m, result.change_m))
    return float(true_m @ measured_m / max(true_m @ true_m, 1e-12))


def all_box_errors(result: Result) -> Floats:
    """Return errors of all 100 m boxes off the rock (scans, boxes) [m]."""
    return box_means(result.error_m, _unaffected_boxes(result, result.rock))
