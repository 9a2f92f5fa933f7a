"""The acceptance table: simulated stations, processed by several methods, against their truth.

python -m benchmarks.accuracy [--scenario NAME …] [--method KEY …] [--seed N] [--small] [--keep]
                              [--folder DIR] [--json FILE] [--only PART …]
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from benchmarks.stations import (  # isort: skip - first, it says how many threads BLAS may have
    METHODS,
    NAMES,
    processed,
    scenario_of,
    simulated,
)

import numpy as np

from benchmarks.disturbed import CASES, disturbed
from benchmarks.events import event_figures, null_boxes
from benchmarks.measures import Calibration, Result, box_figures, twenty_boxes
from benchmarks.speed import AMIDST_M, RIDGE_M, adjustment_seconds
from benchmarks.tables import show

WORKERS = 2
PARTS = ("accuracy", "disturbed", "speed")
Figures = dict[str, Any]


def main() -> None:
    """Measure what is asked for, print it, and write it where it should be."""
    asked = _arguments()
    told: Figures = {"seed": asked.seed, "small": asked.small}
    with (
        tempfile.TemporaryDirectory() as passing,
        ProcessPoolExecutor(WORKERS, mp_context=get_context("spawn")) as pool,
    ):
        folder = asked.folder or Path(passing)
        if "accuracy" in asked.only:
            told["accuracy"] = accuracy(pool, folder, asked)
        if "disturbed" in asked.only:
            jobs = {case: pool.submit(disturbed, folder, asked.seed, case) for case in CASES}
            told["disturbed"] = {case: job.result() for case, job in jobs.items()}
        if "speed" in asked.only:
            told["speed"] = {
                name: pool.submit(adjustment_seconds, place).result()
                for name, place in (("from a ridge", RIDGE_M), ("all round", AMIDST_M))
            }
    show(told)
    if asked.json:
        asked.json.write_text(json.dumps(told, indent=1))


def accuracy(pool: ProcessPoolExecutor, folder: Path, asked: argparse.Namespace) -> Figures:
    """Return the figures of each scenario and method."""
    homes = {name: pool.submit(_home, folder, name, asked.seed, asked.small) for name in asked.scenario}
    home = {name: job.result() for name, job in homes.items()}
    jobs = {
        (name, key): pool.submit(_processed, home[name], key, asked.keep)
        for key in asked.method
        for name in asked.scenario
    }
    verdicts = {job: found.result() for job, found in jobs.items()}
    calm = home.get("calm")
    measured = {
        (name, key): pool.submit(measured_figures, home[name], name, key, asked.method[0], calm)
        for name, key in jobs
    }
    told: Figures = {}
    for (name, key), found in measured.items():
        told.setdefault(name, {})[key] = found.result() | {"verdicts": verdicts[name, key]}
    return told


def measured_figures(home: Path, name: str, key: str, boxes_from: str, calm: Path | None) -> Figures:
    """Return all figures of a scenario that a method processed, in the boxes that one method sees."""
    result = Result(home, METHODS[key])
    boxes = twenty_boxes(Result(home, METHODS[boxes_from]))
    without = None
    if name != "calm" and calm is not None and (calm / f"outcomes_{key}.json").exists():
        without = Result(calm, METHODS[key])
    told: Figures = {
        "boxes": [
            {
                "range_m": float(result.geometry.range_m[box].mean()),
                "incidence_deg": float(np.nanmedian(result.geometry.incidence_deg[box])),
            }
            for box in boxes
        ],
        **box_figures(result, boxes),
        **event_figures(name, result, without),
        "all_boxes_rms_m": float(np.sqrt(np.nanmean(null_boxes(result) ** 2))),
    }
    if METHODS[key].adjustment == "joint":
        told["calibration"] = Calibration(result).figures()
    return told


def _home(folder: Path, name: str, seed: int, small: bool) -> Path:  # noqa: FBT001 - of a job
    ending = "-small" if small else ""
    return simulated(folder, scenario_of(name, seed, small=small), f"{name}-{seed}{ending}")


def _processed(home: Path, key: str, keep: bool) -> Figures:  # noqa: FBT001 - of a job
    """Process a scenario; return how many scans got which verdict, and why."""
    outcomes = processed(home, METHODS[key], keep=keep)
    said = [
        f"{one['verdict']}: {one['reason']}" if one["reason"] else str(one["verdict"]) for one in outcomes
    ]
    return dict(Counter(said))


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Accuracy of the station against simulated truth.")
    parser.add_argument("--scenario", nargs="+", choices=NAMES, default=list(NAMES))
    parser.add_argument("--method", nargs="+", choices=list(METHODS), default=list(METHODS))
    parser.add_argument("--only", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--small", action="store_true", help="few hours, 10 m cells: a quick look")
    parser.add_argument("--keep", action="store_true", help="measure again what was processed before")
    parser.add_argument("--folder", type=Path, help="where simulated stations are kept")
    parser.add_argument("--json", type=Path, help="write the numbers there")
    return parser.parse_args()


if __name__ == "__main__":
    main()
