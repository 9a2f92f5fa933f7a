"""What is left of a real change after the adjustment: melt, an avalanche, snow under few points."""

from __future__ import annotations

import numpy as np

from benchmarks.measures import BOX_COVERAGE, BOX_M, Result, box_means
from station.quantities import Bools, Floats, Quality

MELTED_M = 0.02  # of true change at the end, from which on a cell counts as melting
DEPOSIT_M = 0.5
TOUCHED_M = 0.005
THIN_M = (0.05, 0.15)  # a change of about 10 cm
FEW = 2  # points in a cell
FAR_M = 2500.0


def event_figures(name: str, result: Result, calm: Result | None) -> dict[str, float]:
    """Return what a scenario is made to show; `calm` is the same station without the event, if measured."""
    if name == "melt":
        return _melt(result) | _thin(result)
    if name == "avalanche":
        return _avalanche(result, calm)
    return _thin(result) if name == "snow" else {}


def _melt(result: Result) -> dict[str, float]:
    """Slope of the measured against the true mean change of the ice that melts, over the scans."""
    melting = (np.abs(result.true_m[-1]) > MELTED_M) & result.seen
    both = np.isfinite(result.change_m) & melting
    true_m, measured_m = (
        np.array([np.mean(one[cells]) for one, cells in zip(field, both, strict=True)])
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
    """How much of a deposit is found in its own scan, and what it does to boxes away from it."""
    scan = int(np.argmax(np.abs(result.true_m).max(axis=(1, 2)) > DEPOSIT_M))
    deposit = (result.true_m[scan] > DEPOSIT_M) & np.isfinite(result.change_m[scan])
    touched = np.abs(result.true_m[scan]) > TOUCHED_M
    flagged = (result.quality[scan] & Quality.CHANGE_SIGNIFICANT) > 0
    away = _boxes_away(result, touched)
    step_m = box_means(result.error_m[scan : scan + 1] - result.error_m[scan - 1 : scan], away)
    told = {
        "deposit_ratio": float(result.change_m[scan][deposit].sum() / result.true_m[scan][deposit].sum()),
        "deposit_cells": float(deposit.sum()),
        "deposit_significant": float(flagged[deposit].mean()),
        "away_step_most_m": float(np.nanmax(np.abs(step_m))),
        "away_step_rms_m": float(np.sqrt(np.nanmean(step_m**2))),
    }
    if calm is not None:  # the same motion and the same shots: the difference is the avalanche's alone
        leak_m = box_means((result.error_m - calm.error_m)[scan : scan + 1], away)
        told |= {
            "leak_most_m": float(np.nanmax(np.abs(leak_m))),
            "leak_rms_m": float(np.sqrt(np.nanmean(leak_m**2))),
        }
    return told


def _boxes_away(result: Result, touched: Bools) -> list[tuple[slice, slice]]:
    return [
        box
        for box in result.geometry.boxes(BOX_M)
        if result.seen[box].mean() >= BOX_COVERAGE and not touched[box].any()
    ]


def _thin(result: Result) -> dict[str, float]:
    """Share of a change of about 10 cm that is found in cells of one or two points, and of more."""
    true_m = np.abs(result.true_m)
    thin = (true_m > THIN_M[0]) & (true_m < THIN_M[1]) & np.isfinite(result.change_m)
    far = np.broadcast_to(result.geometry.range_m > FAR_M, thin.shape)
    few = (result.count > 0) & (result.count <= FEW)
    return {
        "thin_few_points": _regressed(result, thin & few),
        "thin_more_points": _regressed(result, thin & ~few),
        "thin_few_points_far": _regressed(result, thin & few & far),
        "thin_cells": float((thin & few).sum()),
    }


def _regressed(result: Result, cells: Bools) -> float:
    """Measured against true change of cells, through the origin."""
    true_m, measured_m = (field[cells].astype(np.float64) for field in (result.true_m, result.change_m))
    return float(true_m @ measured_m / max(true_m @ true_m, 1e-12))


def null_boxes(result: Result) -> Floats:
    """Errors of all 100 m boxes off the rock (scans, boxes) [m]."""
    return box_means(result.error_m, _boxes_away(result, result.good_rock))
