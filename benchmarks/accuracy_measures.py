"""Errors of a processed station against its simulated truth, beside the station's own sigma."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy import stats

from station.archive.series.lazy import open_series, open_virtual
from station.config import Site
from station.processing.site_files import series_for
from station.quantities import Bools, Floats, Quality
from station.queries.aggregates import Aggregates
from station.science.analysis.calibration import z_statistics

SCALES_M = {"10 m": 10.0, "100 m": 100.0}
SCALES = ("cell", *SCALES_M, "area")
BOX_COVERAGE = 0.6
BANDS_KM = ((0.0, 1.0), (1.0, 1.5), (1.5, 2.5), (2.5, 9.0))
CELLS_PER_SCAN = 20_000
BOXES_PER_BAND = 12  # with a sigma
PAIRS = 5  # differences of two scans
UNCHANGED_M = 0.001
FEW_POINTS = 2  # per cell

RECORD = np.dtype([
    ("scale", "U5"), ("seed", "i2"), ("scan", "i2"), ("other", "i2"),  # scan: after those of the reference
    ("range_m", "f4"), ("error_m", "f4"), ("sigma_m", "f4"), ("true_m", "f4"),
    ("points", "i4"), ("significant", "?"),
])  # fmt: skip
Records = NDArray[np.void]
Box = tuple[slice, slice]


class StationErrors:
    """Errors of the change since the reference, of all scans after those of the reference."""

    def __init__(self, site: Site, truth_file: Path, reference_scans: int, seed: int) -> None:
        self.seed, self.grid = seed, site.grid_cells
        self.random = np.random.default_rng(seed)
        self.aggregates = Aggregates(series_for(site))
        with open_series(site.station.data) as series:
            self.series = series.load()
        with open_virtual(series_for(site).processing_path) as processing:
            scanner_m = [float(processing[f"scanner_{axis}"][0]) for axis in ("east", "north")]
        with xr.open_dataset(truth_file) as truth:
            true_m = truth.change.values
            stable = truth.stable_polygons.values > 0
        self.true_m = true_m[reference_scans:] - true_m[:reference_scans].mean(axis=0)
        self.error_m = self.series.elevation_change.values - self.true_m
        self.scans = range(len(self.error_m))
        self.epochs = [self.aggregates.find_epoch(scan) for scan in self.scans]
        self.observed = np.isfinite(self.error_m)
        self.moving = ~stable & (self.observed.mean(axis=0) > 0.5)
        self.range_m = np.hypot(self.grid.x_m - scanner_m[0], self.grid.y_m[:, None] - scanner_m[1])

    def records(self) -> Records:
        """Return the errors at all scales; with a sigma for a sample of the boxes, the same in each scan."""
        parts = [self._cells(scan) for scan in self.scans]
        for scale, size_m in SCALES_M.items():
            if size_m > self.grid.cell_m:
                boxes = self._boxes(round(size_m / self.grid.cell_m))
                sampled = self._sample(boxes)
                parts.append(self._means(scale, boxes if scale == "100 m" else sampled, sampled))
        parts.append(self._means("area", [np.s_[:, :]], [np.s_[:, :]]))
        return np.concatenate(parts)

    def _cells(self, scan: int) -> Records:
        """Return a sample of the cells of a scan, stable ground included."""
        cells = np.flatnonzero(self.observed[scan])
        cells = self.random.choice(cells, min(CELLS_PER_SCAN, len(cells)), replace=False)
        epoch = self.series.isel(time=scan)
        records = np.zeros(len(cells), RECORD)
        records["scale"], records["seed"], records["scan"], records["other"] = "cell", self.seed, scan, -1
        for name, values in (
            ("range_m", self.range_m),
            ("error_m", self.error_m[scan]),
            ("sigma_m", epoch.elevation_change_uncertainty.values),
            ("true_m", self.true_m[scan]),
            ("points", epoch.point_count.values),
            ("significant", (epoch.quality.values.astype(int) & Quality.CHANGE_SIGNIFICANT) > 0),
        ):
            records[name] = values.ravel()[cells]
        return records

    def _boxes(self, size: int) -> list[Box]:
        """Return the boxes of `size` × `size` cells off the stable polygons that most scans observe."""
        ny, nx = self.grid.ny // size, self.grid.nx // size
        blocks = self.moving[: ny * size, : nx * size].reshape(ny, size, nx, size)
        rows, columns = np.nonzero(blocks.mean(axis=(1, 3)) >= BOX_COVERAGE)
        return [
            np.s_[row * size : (row + 1) * size, column * size : (column + 1) * size]
            for row, column in zip(rows, columns, strict=True)
        ]

    def _sample(self, boxes: list[Box]) -> list[Box]:
        """Return as many boxes of each band of range, chosen at random."""
        range_km = np.array([self.range_m[box].mean() for box in boxes]) / 1000
        chosen: list[int] = []
        for low, high in BANDS_KM:
            inside = np.flatnonzero((range_km >= low) & (range_km < high))
            chosen += self.random.choice(inside, min(BOXES_PER_BAND, len(inside)), replace=False).tolist()
        return [boxes[index] for index in chosen]

    def _means(self, scale: str, boxes: list[Box], with_sigma: list[Box]) -> Records:
        """Return the mean errors of boxes in each scan, and between some pairs of scans."""
        pairs = [(scan, scan + 1) for scan in self.scans[:-1:2]][:PAIRS]
        rows = [self._mean(scale, box, scan, None, box in with_sigma) for scan in self.scans for box in boxes]
        rows += [self._mean(scale, box, *pair, True) for pair in pairs for box in with_sigma]
        return np.array([row for row in rows if row is not None], RECORD)

    def _mean(self, scale: str, box: Box, scan: int, other: int | None, with_sigma: bool) -> Any:  # noqa: ANN401, FBT001
        """Return the record of the mean over the observed moving cells of a box; None if they are too few."""
        known = self.moving[box] & self.observed[scan][box]
        error_m, true_m = self.error_m[scan][box], self.true_m[scan][box]
        if other is not None:
            known &= self.observed[other][box]
            error_m, true_m = error_m - self.error_m[other][box], true_m - self.true_m[other][box]
        if known.sum() < BOX_COVERAGE * self.moving[box].sum():
            return None
        weights = np.zeros(self.grid.shape)
        weights[box] = known / known.sum()
        epochs = [self.epochs[number] for number in (scan, other) if number is not None]
        sigma_m = np.sqrt(self.aggregates.variance(weights, *epochs)) if with_sigma else np.nan
        return (
            scale, self.seed, scan, -1 if other is None else other,
            self.range_m[box][known].mean(), error_m[known].mean(), sigma_m, true_m[known].mean(), 0, False,
        )  # fmt: skip


def summarise(records: Records, first: int) -> dict[str, Any]:
    """Return the figures of the table from the records of several seeds, of the scans from `first` on."""
    later = records[(records["scan"] >= first)]
    epochs = later[later["other"] < 0]
    cells, boxes, areas = (epochs[epochs["scale"] == scale] for scale in ("cell", "100 m", "area"))
    unchanged = cells[np.abs(cells["true_m"]) < UNCHANGED_M]
    absolute_m = np.abs(boxes["error_m"])
    figures: dict[str, Any] = {
        "box_rms_m": _rms(boxes["error_m"]),
        "box_95_m": float(np.percentile(absolute_m, 95)),
        "box_max_m": float(absolute_m.max()),
        "box_bias_m": float(boxes["error_m"].mean()),
        "z": {scale: z_of(epochs, scale) for scale in SCALES},
        "z_bands": {
            f"{low:g}-{high:g} km": {scale: z_of(_inside(epochs, low, high), scale) for scale in SCALES[:-1]}
            for low, high in BANDS_KM
        },
        "z_pairs": {scale: z_of(later[later["other"] >= 0], scale) for scale in SCALES[1:]},
        "inside_95": float(np.mean(np.abs(cells["error_m"]) < 1.96 * cells["sigma_m"])),
        "significant": float(unchanged["significant"].mean()) if len(unchanged) > 1000 else np.nan,
        "positive": {
            int(seed): float((areas["error_m"][areas["seed"] == seed] > 0).mean())
            for seed in np.unique(areas["seed"])
        },
        "sign_chance": _sign_chance(areas),
        "retained": {
            "100 m": _retained(boxes),
            "cell": _retained(cells),
            "few": _retained(cells[cells["points"] <= FEW_POINTS]),
        },
        "sigma_m": float(np.nanmedian(boxes["sigma_m"])),
    }
    before = records[(records["scan"] < first) & (records["other"] < 0) & (records["scale"] == "100 m")]
    if len(before):
        figures["sigma_ratio"] = figures["sigma_m"] / float(np.nanmedian(before["sigma_m"]))
    return figures


def z_of(records: Records, scale: str) -> float:
    """Return the spread of standardised errors about zero: robust for cells, else their root mean square."""
    chosen = records[records["scale"] == scale]
    z = chosen["error_m"] / chosen["sigma_m"]
    z = z[np.isfinite(z)]
    if scale == "cell":
        return z_statistics(z).z_robust
    return _rms(z) if len(z) >= 5 else np.nan


def _inside(records: Records, low_km: float, high_km: float) -> Records:
    range_km = records["range_m"] / 1000
    return records[(range_km >= low_km) & (range_km < high_km)]


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values.astype(np.float64) ** 2)))


def _sign_chance(areas: Records) -> float:
    """Return the probability that independent mean errors keep their sign as much as those of any seed."""
    chances = []
    for seed in np.unique(areas["seed"]):
        positive = areas["error_m"][areas["seed"] == seed] > 0
        chances.append(stats.binomtest(int(positive.sum()), len(positive)).pvalue)
    return float(min(1.0, min(chances) * len(chances)))


def _retained(records: Records) -> float:
    """Return the slope of measured on true change through the origin; NaN without change."""
    true_m = records["true_m"].astype(np.float64)
    changed: Bools = np.abs(true_m) > UNCHANGED_M
    if changed.sum() < 10:
        return np.nan
    measured_m = true_m + records["error_m"]
    return float(true_m[changed] @ measured_m[changed] / (true_m[changed] @ true_m[changed]))


def verdict_shares(verdicts: list[tuple[str, str]]) -> dict[str, float]:
    """Return the share of each verdict."""
    counts = Counter(verdict for verdict, _ in verdicts)
    return {verdict: counts[verdict] / len(verdicts) for verdict in ("good", "degraded", "unusable")}


def common_reason(verdicts: list[tuple[str, str]]) -> str:
    """Return the most frequent reason without the figures that differ between scans; '' if there is none."""
    parts = [part for _, reason in verdicts for part in reason.split("; ") if part]
    counts = Counter(re.sub(r"[\d.]+", "…", part) for part in parts)
    return counts.most_common(1)[0][0] if counts else ""


def reason_share(verdicts: list[tuple[str, str]], pattern: str) -> float:
    """Return the share of the scans with a reason that matches a pattern."""
    return float(np.mean([re.search(pattern, reason) is not None for _, reason in verdicts]))
