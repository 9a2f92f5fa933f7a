"""`station sensitivity`: which input makes an epoch and its areas unsure."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from station.archive.aggregate import Aggregates
from station.archive.attribution import attribute
from station.config import Site
from station.science.sensitivity import INPUTS
from station.service import child
from station.service.tasks import areas_of, series_of

Told = dict[str, Any]
WIDTH = 13
KINDS = {
    "part": "share, adds up to 100",
    "first": "gone if it were known",
    "total": "left if all else were",
}


def sensitivity(site: Site, epoch: int | str, maps: Path | None) -> Told:
    """Return the shares of the inputs in the variance of an epoch's cells and areas, and write maps of them.

    Raises StoreError where the store holds nothing of the kind, or maps cannot be written; IndexError where
    the series has no such place.
    """
    Aggregates(series_of(site)).row(epoch)
    memory_gb, timeout_s = site.service.memory_gb, site.scans.timeout_s
    return child.run(shares_of, site, epoch, maps, memory_gb=memory_gb, timeout_s=timeout_s)


def shares_of(site: Site, epoch: int | str, maps: Path | None, progress: Callable[[], None]) -> Told:
    """Return what `sensitivity` does; runs in a child process."""
    found = attribute(series_of(site), epoch)
    if maps is not None:
        found.write(maps)
    progress()
    areas = {"everything": np.ones(site.grid_cells.shape, bool)} | areas_of(site)
    told = [found.of_area(name, cells) for name, cells in areas.items()]
    return {
        "epoch": found.row.epoch_file,
        "cells": found.by_range(),
        "areas": [one for one in told if one is not None],
        "maps": str(maps) if maps is not None else None,
    }


def describe(told: Told) -> str:
    """Return the shares as lines for a person, in percent."""
    head = f"{'':34}{'sigma, m':>10}" + "".join(f"{name:>{WIDTH}}" for name in INPUTS)
    lines = [f"{told['epoch']}: share of the variance in %", head]
    lines += [_line(f"one cell, {row['cells']}", row["part"], row["sigma_m"]) for row in told["cells"]]
    for area in told["areas"]:
        lines += ["", f"mean of {area['area']}, {area['cells']} cells"]
        lines += [
            _line(f"  {says}", area[kind], area["sigma_m"] if kind == "part" else None)
            for kind, says in KINDS.items()
        ]
        simulated, worst = area["simulated"], list[float]()
        lines.append(_line("  as if independent: linear", simulated["linear"], None))
        for order in ("first", "total"):
            off = [
                abs(simulated[order][key] - simulated["linear"][key])
                / max(simulated[f"{order}_error"][key], 1e-3)
                for key in INPUTS
            ]
            worst.append(max(off))
            lines.append(
                _line(
                    f"  as if independent: Sobol {order}", simulated[order], None, simulated[f"{order}_error"]
                )
            )
        lines.append(f"  farthest apart by {max(worst):.1f} sampling errors")
        *pairs, three = area["interactions"]
        largest = max(pairs, key=lambda one: abs(one["share"]))
        lines.append(
            f"  by interaction: most {_percent(largest)} of {' and '.join(largest['inputs'])};"
            f" of {', '.join(three['inputs'])} together {_percent(three)}"
        )
    if told["maps"]:
        lines += ["", told["maps"]]
    return "\n".join(lines)


def _percent(index: Told) -> str:
    return f"{round(100 * index['share'], 2) + 0.0:.2f} ± {100 * index['error']:.2f}"


def _line(
    name: str, shares: dict[str, float], sigma_m: float | None, errors: dict[str, float] | None = None
) -> str:
    told = [
        f"{round(100 * shares[key]):d}" + (f" ± {100 * errors[key]:.0f}" if errors else "") for key in INPUTS
    ]
    sigma = f"{sigma_m:10.4f}" if sigma_m is not None else " " * 10
    return f"{name:34}{sigma}" + "".join(f"{one:>{WIDTH}}" for one in told)
