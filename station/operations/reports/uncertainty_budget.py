"""`station sensitivity --budget`: the uncertainty budget of an area by effect, and its traceability diagram.

The table is that of the GUM (JCGM 100:2008, annex H) with the columns that CEOS-FRM asks for: how an effect
is known, its form, and over what its errors are correlated.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from station.config import Site
from station.errors import ConfigError
from station.operations.reports.report_pages import write_page
from station.processing.site_files import load_areas, series_for
from station.processing.workers import isolation
from station.quantities import Bools, SharedParameters
from station.queries.variance_shares import VarianceShares, compute_variance_shares
from station.science.uncertainty.jacobian import HeightJacobian
from station.science.uncertainty.propagation import aggregate_variance, restricted_to

EVERYTHING = "everything"
WHOLE_SCAN = "all points of the scan"


@dataclass(frozen=True)
class Effect:
    """An effect of the measurement: the parameters that hold it, how it is known, where it is correlated."""

    name: str
    prefixes: tuple[str, ...]  # of its parameters
    known_from: str
    correlation: str


EFFECTS = (
    Effect(  # of the scan as a whole and within it: what one explains, the other does not
        "tilt",
        ("tilt_", "sight_tilt_", "cross_tilt_"),
        "stable ground, log, earlier scans",
        "scan; within it 300 s of drift, 3 s of jitter, lines",
    ),
    Effect("heading", ("heading",), "stable ground, earlier scans", WHOLE_SCAN),
    Effect(
        "position, horizontal",
        ("translation_east", "translation_north"),
        "stable ground, earlier scans",
        WHOLE_SCAN,
    ),
    Effect("position, up", ("translation_up",), "stable ground, earlier scans", WHOLE_SCAN),
    Effect("range, constant", ("range_bias",), "stable ground, earlier scans", WHOLE_SCAN),
    Effect("range, in proportion (air)", ("range_scale",), "weather, IUGG (1999)", WHOLE_SCAN),
    Effect("refraction", ("refraction",), "stable ground, weather, earlier scans", "scan; 15° of azimuth"),
)  # fmt: skip


def uncertainty_budget(site: Site, epoch: int | str, area: str | None) -> dict[str, Any]:
    """Return the budget of the mean change of an area, or of all cells, in an epoch.

    Raises StoreError if the epoch lacks the inputs, ConfigError without such an area.
    """
    memory_gb, timeout_s = site.service.memory_gb, site.scans.timeout_s
    return isolation.TaskRunner().run(
        _compute_budget, site, epoch, area, memory_gb=memory_gb, timeout_s=timeout_s
    )


def _compute_budget(
    site: Site, epoch: int | str, area: str | None, progress: Callable[[], None]
) -> dict[str, Any]:
    """Return the budget of `uncertainty_budget`; runs in a worker process."""
    areas = {EVERYTHING: np.ones(site.grid_cells.shape, bool)} | load_areas(site)
    name = area or EVERYTHING
    if name not in areas:
        raise ConfigError(f"no area {name!r}; there are {', '.join(areas)}")
    shares = compute_variance_shares(series_for(site), epoch)
    progress()
    return {
        "station": site.station.name or site.station.id,
        "epoch": shares.epoch.epoch_file,
        "area": name,
        **budget_of(shares, areas[name]),
    }


def budget_of(shares: VarianceShares, area_cells: Bools) -> dict[str, Any]:
    """Return number of cells, combined uncertainty [m] and rows of the budget of an area (ny, nx).

    A row has the standard uncertainty of the effect in its unit, the sensitivity coefficient [m per unit],
    their product [m] and its share of the variance. Of an effect with many parameters the first is their root
    mean square, and the coefficient the quotient. The rest of the variance is from correlations between
    effects. Source: equations.md, 6.2; JCGM 100:2008, 5.2.2.
    """
    inside = area_cells[shares.cells]
    weights = inside / max(1, int(inside.sum()))
    jacobian, shared = shares.jacobian, shares.shared
    variance_m2 = aggregate_variance(weights, shares.random_m2, jacobian, shared)
    rows = [_effect_row(effect, weights, jacobian, shared) for effect in EFFECTS]
    random_m = float(np.sqrt(np.sum(weights**2 * shares.random_m2)))
    one_cell_m = float(np.sqrt(np.mean(shares.random_m2[inside]))) if inside.any() else np.nan
    rows.append(
        _row(
            "random: range, beam, roughness",
            "none",
            "residuals of the scan and of the reference",
            one_cell_m,
            "m",
            random_m,
        )
        | {"form": "random"}
    )
    offset_m2 = variance_m2 - sum(row["contribution_m"] ** 2 for row in rows)
    for row in rows:
        row["share"] = row["contribution_m"] ** 2 / variance_m2
    return {
        "cells": int(inside.sum()),
        "sigma_m": float(np.sqrt(variance_m2)),
        "rows": rows,
        "correlations_share": offset_m2 / variance_m2,
    }


def _effect_row(
    effect: Effect, weights: np.ndarray[Any, Any], jacobian: HeightJacobian, shared: SharedParameters
) -> dict[str, Any]:
    """Return the row of an effect that parameters hold."""
    chosen = np.array([name.startswith(effect.prefixes) for name in shared.names])
    alone_m2 = aggregate_variance(weights, np.zeros(len(weights)), jacobian, restricted_to(shared, chosen))
    standard = float(np.sqrt(np.mean(np.diag(shared.covariance)[chosen])))
    unit = shared.units[int(np.flatnonzero(chosen)[0])]
    contribution_m = float(np.sqrt(alone_m2))
    return _row(effect.name, effect.correlation, effect.known_from, standard, unit, contribution_m)


def _row(
    effect: str, correlation: str, known_from: str, standard: float, unit: str, contribution_m: float
) -> dict[str, Any]:
    return {
        "effect": effect,
        "uncertainty": standard,
        "unit": unit,
        "sensitivity": contribution_m / standard if standard else 0.0,
        "contribution_m": contribution_m,
        "form": "systematic",
        "correlation": correlation,
        "known_from": known_from,
    }


def format_budget(budget: dict[str, Any]) -> str:
    """Return the budget as text."""
    lines = [
        f"Mean change of {budget['area']}, {budget['cells']} cells, {budget['epoch']}",
        f"{'effect':32}{'u(x)':>10} {'unit':6}{'m/unit':>11}{'u, m':>10}{'share':>7}  form        over",
    ]
    lines += [
        f"{row['effect']:32}{row['uncertainty']:10.2e} {row['unit']:6}{row['sensitivity']:11.3g}"
        f"{row['contribution_m']:10.5f}{100 * row['share']:6.0f}%  {row['form']:12}{row['correlation']}"
        for row in budget["rows"]
    ]
    share = 100 * budget["correlations_share"]
    lines.append(f"{'correlations between effects':69}{share:6.0f}%")
    lines.append(f"{'all':59}{budget['sigma_m']:10.5f}{100:6.0f}%")
    return "\n".join(lines)


def write_budget(budget: dict[str, Any], path: Path) -> None:
    """Write diagram and table as one HTML page; raise StoreError if that fails."""
    write_page(path, "budget.html", budget=budget)
