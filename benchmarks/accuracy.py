"""Accuracy of simulated stations, processed by several methods, against their truth.

python -m benchmarks.accuracy [--scenario NAME …] [--method KEY …] [--seed N] [--small] [--keep]
                              [--folder DIR] [--json FILE] [--only PART …]
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import tempfile
from collections import Counter
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from benchmarks.accuracy_stations import (  # isort: skip - sets the number of BLAS threads before numpy loads
    FIELD_NAMES,
    METHODS,
    NAMES,
    processed,
    scenario_of,
    simulated,
    site_of,
    spoil,
)

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.accuracy_measures import (
    Calibration,
    Result,
    all_box_errors,
    box_figures,
    event_figures,
    twenty_boxes,
)
from benchmarks.adjustment_speed import INSIDE_M, RIDGE_M, adjustment_seconds
from station.monitoring.log_clock import log_clock_offset

WORKERS = 2
PARTS = ("accuracy", "disturbed", "speed")
CASES = (
    "unchanged",
    "log 5 s late",
    "log missing",
    "cyclic error changed",
    "weather missing",
    "nothing stable",
)
Figures = dict[str, Any]

PUBLISHED = (  # error of 100 m boxes [m]: Voordendag et al. (2023), and a prototype on its own simulation
    ("published: unattended", "±0.50"),
    ("published: by hand", "±0.10"),
    ("prototype, fixed SOP", "0.134 rms"),
    ("prototype, filtered inclination", "0.197 rms"),
    ("prototype, adjusted: rock all round / ridge and hut", "0.020 / 0.078 rms"),
    ("prototype, adjusted, moving reference: ridge and hut", "0.025 rms"),
)
BOX_LIMITS_M = {  # limit and goal of rms / 95 % / max of 100 m boxes
    ("calm", "joint_good"): ("0.03 / 0.06 / 0.10", "0.015 / 0.03 / 0.06"),
    ("calm", "joint_poor"): ("0.04 / 0.08 / 0.15", "0.025 / 0.05 / 0.10"),
    ("snow", "joint_good"): ("0.05", "0.03"),
    ("snow", "joint_poor"): ("0.08", "0.045"),
}
EVENTS = {  # description, limit and goal of each figure
    "melt_retained": ("melt, slope of measured on true", "0.95-1.05", "1.00"),
    "melt_last_ratio": ("melt at the end, measured / true", "0.95-1.05", "1.00"),
    "melt_scatter_m": ("scatter of the melting area's mean [m]", "", ""),
    "melt_true_end_m": ("its true change at the end [m]", "", ""),
    "deposit_ratio": ("deposit, measured / true", "", "1.00"),
    "deposit_significant": ("cells of the deposit flagged as significant", "", "1.00"),
    "deposit_cells": ("cells of the deposit", "", ""),
    "unaffected_step_max_m": ("largest step of a box elsewhere [m]", "", ""),
    "unaffected_step_rms_m": ("rms step of boxes elsewhere [m]", "", ""),
    "leak_max_m": ("largest box error due to the event [m]", "≤ 0.01", ""),
    "leak_rms_m": ("rms box error due to the event [m]", "", ""),
    "thin_few_points": ("recovered share of 10 cm, 1-2 points per cell", "≥ 0.92", "0.98"),
    "thin_few_points_far": ("the same beyond 2.5 km", "≥ 0.92", "0.98"),
    "thin_more_points": ("recovered share of 10 cm, more points", "", ""),
    "thin_cells": ("cells with 1-2 points", "", ""),
}
SPEED_LIMIT_S, SPEED_GOAL_S = 3.0, 2.0


def main() -> None:
    """Measure the selected parts, print them, and write them to a file if asked to."""
    options = _arguments()
    figures: Figures = {"seed": options.seed, "small": options.small}
    with (
        tempfile.TemporaryDirectory() as temporary,
        ProcessPoolExecutor(WORKERS, mp_context=get_context("spawn")) as pool,
    ):
        folder = options.folder or Path(temporary)
        if "accuracy" in options.only:
            figures["accuracy"] = accuracy(pool, folder, options)
        if "disturbed" in options.only:
            jobs = {case: pool.submit(disturbed, folder, options.seed, case) for case in CASES}
            figures["disturbed"] = {case: job.result() for case, job in jobs.items()}
        if "speed" in options.only:  # one after the other: a second process would slow the first
            figures["speed"] = {
                name: pool.submit(adjustment_seconds, position_m).result()
                for name, position_m in (("from a ridge", RIDGE_M), ("all round", INSIDE_M))
            }
    print_tables(figures)
    if options.json:
        options.json.write_text(json.dumps(figures, indent=1))


def accuracy(pool: ProcessPoolExecutor, folder: Path, options: argparse.Namespace) -> Figures:
    """Return the figures of each scenario and method."""
    simulations = {
        name: pool.submit(_simulated, folder, name, options.seed, options.small) for name in options.scenario
    }
    home = {name: job.result() for name, job in simulations.items()}
    jobs = {
        (name, key): pool.submit(_processed, home[name], key, options.keep)
        for key in options.method
        for name in options.scenario
    }
    verdicts = {selection: job.result() for selection, job in jobs.items()}
    calm = home.get("calm")
    evaluations = {
        (name, key): pool.submit(evaluate, home[name], name, key, options.method[0], calm)
        for name, key in jobs
    }
    figures: Figures = {}
    for (name, key), job in evaluations.items():
        figures.setdefault(name, {})[key] = job.result() | {"verdicts": verdicts[name, key]}
    return figures


def evaluate(home: Path, name: str, key: str, boxes_from: str, calm: Path | None) -> Figures:
    """Return all figures of a scenario and method, in the boxes chosen from the method `boxes_from`."""
    result = Result(home, METHODS[key])
    boxes = twenty_boxes(Result(home, METHODS[boxes_from]))
    calm_result = None
    if name != "calm" and calm is not None and (calm / f"outcomes_{key}.json").exists():
        calm_result = Result(calm, METHODS[key])
    figures: Figures = {
        "boxes": [
            {
                "range_m": float(result.geometry.range_m[box].mean()),
                "incidence_deg": float(np.nanmedian(result.geometry.incidence_deg[box])),
            }
            for box in boxes
        ],
        **box_figures(result, boxes),
        **event_figures(name, result, calm_result),
        "all_boxes_rms_m": float(np.sqrt(np.nanmean(all_box_errors(result) ** 2))),
    }
    if METHODS[key].adjustment == "joint":
        figures["calibration"] = Calibration(result).figures()
    return figures


def _simulated(folder: Path, name: str, seed: int, small: bool) -> Path:  # noqa: FBT001 - argument of a job
    ending = "-small" if small else ""
    return simulated(folder, scenario_of(name, seed, small=small), f"{name}-{seed}{ending}")


def _processed(home: Path, key: str, keep: bool) -> Figures:  # noqa: FBT001 - argument of a job
    """Process a scenario; return the number of scans by verdict and reason."""
    results = processed(home, METHODS[key], keep=keep)
    verdicts = (": ".join(filter(None, [str(row["verdict"]), str(row["reason"])])) for row in results)
    return dict(Counter(verdicts))


def disturbed(folder: Path, seed: int, case: str) -> dict[str, object]:
    """Return verdicts, reasons, box errors and their z of a small calm station with spoilt inputs."""
    scenario = scenario_of("calm", seed, small=True)
    if case == "cyclic error changed":
        home = simulated(folder, replace(scenario, log_cyclic_change=0.5), f"cyclic-{seed}-small")
    else:
        home = folder / f"{case.replace(' ', '-')}-{seed}-small"
        shutil.rmtree(home, ignore_errors=True)
        shutil.copytree(simulated(folder, scenario, f"calm-{seed}-small"), home, ignore=_result_files)
    spoil(home, case, scenario.reference_scans)
    results = processed(home, METHODS["joint_good"])
    result = Result(home, METHODS["joint_good"])
    reasons = Counter(_without_numbers(str(row["reason"])) for row in results if row["reason"])
    if warning := log_clock_offset(site_of(home, METHODS["joint_good"])):
        reasons[f"series: {warning}"] = 1
    calibration = Calibration(result)
    targets = calibration.targets("100 m")
    z = np.array([calibration.z(targets, epoch)[0] for epoch in range(len(result.error_m))])
    return {
        "finished": len(results),
        "verdicts": Counter(str(row["verdict"]) for row in results),
        "reasons": reasons,
        "z_std_100_m": float(np.nanstd(z)),
        **box_figures(result, twenty_boxes(result)),
    }


def _without_numbers(reason: str) -> str:
    """Return a reason without the figures that differ between scans."""
    return re.sub(r"[0-9.]+ (s|degree)\b", r"… \1", reason.split(" of 2", maxsplit=1)[0])


def _result_files(_folder: str, names: list[str]) -> set[str]:
    return {name for name in names if name.startswith(("data_", "site_", "outcomes_"))}


def print_tables(figures: Figures) -> None:
    """Print all figures as tables."""
    console = Console(width=150)
    console.print(_table("For comparison: error of 100 m boxes", ("what", "m"), PUBLISHED))
    if "accuracy" in figures:
        _print_accuracy(console, figures["accuracy"])
    if "disturbed" in figures:
        console.print(_disturbed_table(figures["disturbed"]))
    for name, seconds in figures.get("speed", {}).items():
        console.print(_speed_table(name, seconds))


def _print_accuracy(console: Console, accuracy: Figures) -> None:
    for name, by_method in accuracy.items():
        console.print(_box_table(name, by_method))
        events = [
            (what, METHODS[key].title, _number(figures[figure]), limit, goal)
            for figure, (what, limit, goal) in EVENTS.items()
            for key, figures in by_method.items()
            if figure in figures
        ]
        if events:
            heads = ("what", "method", "measured", "limit", "goal")
            console.print(_table(f"{name}: recovery of the change", heads, events))
        for key, figures in by_method.items():
            if "calibration" in figures:
                console.print(_calibration_table(f"{name}, {METHODS[key].title}", figures["calibration"]))
            console.print(f"{name}, {METHODS[key].title}: {figures['verdicts']}")


def _box_table(name: str, by_method: Figures) -> Table:
    fixed = by_method.get("fixed")
    rows = []
    for key, figures in by_method.items():
        limit, goal = BOX_LIMITS_M.get((name, key), ("", ""))
        rows.append((
            METHODS[key].title,
            *(_number(figures[f"box_{statistic}_m"]) for statistic in ("rms", "95", "max", "bias", "spread")),
            _number(figures["all_boxes_rms_m"]),
            _number(figures["far_cell_noise_m"]),
            _number(figures["far_cell_noise_m"] / fixed["far_cell_noise_m"]) if fixed else "",
            _number(fixed["box_rms_m"] / figures["box_rms_m"]) if fixed else "",
            limit,
            goal,
        ))  # fmt: skip
    heads = (
        "method", "rms", "95 %", "max", "bias", "spread", "rms of all", "cell noise > 2 km", "to fixed SOP",
        "fixed rms / rms", "limit", "goal",
    )  # fmt: skip
    return _table(f"{name}: errors of the twenty 100 m boxes [m]", heads, rows)


def _calibration_table(title: str, statistics: Figures) -> Table:
    """Return the table of spread and coverage of error / sigma; they should be 1 and 0.95."""
    rows = [
        (what, *(_number(row.get(name, float("nan"))) for name in ("z_std", "z_robust", "z_mean")),
         _number(row["inside_95"]), str(int(row["count"])))
        for what, row in statistics.items()
    ]  # fmt: skip
    heads = ("scale and range", "sd of z (goal 1)", "robust sd", "mean", "in 95 % (goal .95)", "n")
    return _table(f"{title}: error / sigma", heads, rows)


def _disturbed_table(cases: Figures) -> Table:
    rows = [
        (
            case, str(figures["finished"]), _counted(figures["verdicts"]), _counted(figures["reasons"]),
            _number(figures["box_rms_m"]), _number(figures["box_max_m"]), _number(figures["z_std_100_m"]),
        )
        for case, figures in cases.items()
    ]  # fmt: skip
    heads = ("input", "scans finished", "verdicts", "reasons", "box rms [m]", "max [m]", "sd of z, 100 m")
    return _table("Spoilt inputs: a small calm station, adjusted", heads, rows)


def _counted(counts: dict[str, int]) -> str:
    return "\n".join(f"{count} × {what}" for what, count in counts.items())


def _speed_table(name: str, seconds: Figures) -> Table:
    rows = [(key, _number(value), "", "") for key, value in seconds.items() if key != "adjustment_s"]
    last = ("adjustment_s", _number(seconds["adjustment_s"]), f"≤ {SPEED_LIMIT_S:g}", f"{SPEED_GOAL_S:g}")
    return _table(
        f"CPU of the adjustment, 20 M cells, one core, {name}",
        ("what", "measured", "limit", "goal"),
        [*rows, last],
    )


def _number(value: float) -> str:
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3f}"


def _table(title: str, heads: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> Table:
    table = Table(title=title, title_justify="left")
    for head in heads:
        table.add_column(head)
    for row in rows:
        table.add_row(*row)
    return table


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Accuracy of the station against simulated truth.")
    parser.add_argument("--scenario", nargs="+", choices=(*NAMES, *FIELD_NAMES), default=list(NAMES))
    parser.add_argument("--method", nargs="+", choices=list(METHODS), default=list(METHODS))
    parser.add_argument("--only", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--small", action="store_true", help="few hours, 10 m cells")
    parser.add_argument("--keep", action="store_true", help="reuse the results of an earlier run")
    parser.add_argument("--folder", type=Path, help="folder that keeps the simulated stations")
    parser.add_argument("--json", type=Path, help="file for the figures")
    return parser.parse_args()


if __name__ == "__main__":
    main()
