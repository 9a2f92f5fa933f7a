"""`station sensitivity`: shares of the inputs in the variance of an epoch and its areas."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from station.config import Site
from station.processing.site_files import load_areas, series_for
from station.processing.workers import isolation
from station.queries.aggregates import Aggregates
from station.queries.variance_shares import compute_variance_shares
from station.science.analysis.sensitivity import INPUTS

SensitivityReport = dict[str, Any]
COLUMN_WIDTH = 13
SHARE_LABELS = {
    "covariance_share": "share, adds up to 100",
    "first": "removed if it were known",
    "total": "left if all others were",
}


def sensitivity_report(site: Site, epoch: int | str, maps: Path | None) -> SensitivityReport:
    """Return the shares of the inputs in the variance of an epoch's cells and areas; optionally write maps.

    Raises StoreError if the epoch has no such data or the maps cannot be written, IndexError if the series
    has no such position.
    """
    Aggregates(series_for(site)).find_epoch(epoch)
    memory_gb, timeout_s = site.service.memory_gb, site.scans.timeout_s
    return isolation.TaskRunner().run(
        compute_shares, site, epoch, maps, memory_gb=memory_gb, timeout_s=timeout_s
    )


def compute_shares(
    site: Site, epoch: int | str, maps: Path | None, progress: Callable[[], None]
) -> SensitivityReport:
    """Return the report of `sensitivity_report`; runs in a worker process."""
    shares = compute_variance_shares(series_for(site), epoch)
    if maps is not None:
        shares.write(maps)
    progress()
    areas = {"everything": np.ones(site.grid_cells.shape, bool)} | load_areas(site)
    rows = [shares.area_shares(name, cells) for name, cells in areas.items()]
    return {
        "epoch": shares.epoch.epoch_file,
        "cells": shares.by_range(),
        "areas": [row for row in rows if row is not None],
        "maps": str(maps) if maps is not None else None,
    }


def format_report(report: SensitivityReport) -> str:
    """Return the shares as text, in percent."""
    header = f"{'':34}{'sigma, m':>10}" + "".join(f"{name:>{COLUMN_WIDTH}}" for name in INPUTS)
    lines = [f"{report['epoch']}: share of the variance in %", header]
    lines += [
        _format_line(f"one cell, {row['cells']}", row["covariance_share"], row["sigma_m"])
        for row in report["cells"]
    ]
    for area in report["areas"]:
        lines += ["", f"mean of {area['area']}, {area['cells']} cells"]
        lines += [
            _format_line(f"  {label}", area[kind], area["sigma_m"] if kind == "covariance_share" else None)
            for kind, label in SHARE_LABELS.items()
        ]
        simulated, deviations = area["simulated"], list[float]()
        lines.append(_format_line("  if independent: linear", simulated["linear"], None))
        for order in ("first", "total"):
            in_sampling_errors = [
                abs(simulated[order][key] - simulated["linear"][key])
                / max(simulated[f"{order}_error"][key], 1e-3)
                for key in INPUTS
            ]
            deviations.append(max(in_sampling_errors))
            lines.append(
                _format_line(
                    f"  if independent: Sobol {order}", simulated[order], None, simulated[f"{order}_error"]
                )
            )
        lines.append(f"  largest deviation {max(deviations):.1f} sampling errors")
        *pairs, triple = area["interactions"]
        largest = max(pairs, key=lambda pair: abs(pair["share"]))
        lines.append(
            f"  interactions: largest {_format_percent(largest)} between {' and '.join(largest['inputs'])};"
            f" {', '.join(triple['inputs'])} together {_format_percent(triple)}"
        )
    if report["maps"]:
        lines += ["", report["maps"]]
    return "\n".join(lines)


def _format_percent(index: SensitivityReport) -> str:
    return f"{round(100 * index['share'], 2) + 0.0:.2f} ± {100 * index['error']:.2f}"


def _format_line(
    name: str, shares: dict[str, float], sigma_m: float | None, errors: dict[str, float] | None = None
) -> str:
    columns = [
        f"{round(100 * shares[key]):d}" + (f" ± {100 * errors[key]:.0f}" if errors else "") for key in INPUTS
    ]
    sigma = f"{sigma_m:10.4f}" if sigma_m is not None else " " * 10
    return f"{name:34}{sigma}" + "".join(f"{column:>{COLUMN_WIDTH}}" for column in columns)
