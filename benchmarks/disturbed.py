"""A small quiet station whose inputs are spoilt, one at a time: it must finish and say what was wrong."""

from __future__ import annotations

import json
import re
import shutil
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.measures import Calibration, Result, box_figures, twenty_boxes
from benchmarks.stations import METHODS, processed, scenario_of, simulated, site_of
from station.service.late_log import late_log

CASES = (
    "as it was",
    "log 5 s late",
    "log missing",
    "cyclic error changed",
    "weather missing",
    "nothing stable",
)
LATE_S = 5.0
AWAY_M = 100_000.0


def disturbed(folder: Path, seed: int, case: str) -> dict[str, object]:
    """Process the spoilt station; return verdicts, reasons, errors of boxes and their z."""
    scenario = scenario_of("calm", seed, small=True)
    if case == "cyclic error changed":
        home = simulated(folder, replace(scenario, log_cyclic_change=0.5), f"cyclic-{seed}-small")
    else:
        home = folder / f"{case.replace(' ', '-')}-{seed}-small"
        shutil.rmtree(home, ignore_errors=True)
        shutil.copytree(simulated(folder, scenario, f"calm-{seed}-small"), home, ignore=_results)
    _spoil(home, case, scenario.reference_scans)
    outcomes = processed(home, METHODS["joint_good"])
    result = Result(home, METHODS["joint_good"])
    reasons = Counter(_without_numbers(str(one["reason"])) for one in outcomes if one["reason"])
    if series := late_log(site_of(home, METHODS["joint_good"])):
        reasons[f"of the series: {series}"] = 1
    known = Calibration(result)
    targets = known.targets("100 m")
    z = np.array([known.z(targets, epoch)[0] for epoch in range(len(result.error_m))])
    return {
        "finished": len(outcomes),
        "verdicts": Counter(str(one["verdict"]) for one in outcomes),
        "reasons": reasons,
        "z_std_100_m": float(np.nanstd(z)),
        **box_figures(result, twenty_boxes(result)),
    }


def _without_numbers(reason: str) -> str:
    """Return a reason that scans may share."""
    return re.sub(r"[0-9.]+ (s|degree)\b", r"… \1", reason.split(" of 2", maxsplit=1)[0])


def _results(_folder: str, names: list[str]) -> set[str]:
    return {name for name in names if name.startswith(("data_", "site_", "outcomes_"))}


def _spoil(home: Path, case: str, first: int) -> None:
    """Spoil what came after the reference, or all of the weather, or all that is known to be stable."""
    logs = sorted((home / "inbox").glob("*-incl.txt"))[first:]
    if case == "log 5 s late":
        for path in logs:
            header, *rows = path.read_text().splitlines()
            late = [f"{float(row.split(',')[0]) + LATE_S:.4f},{row.split(',', 1)[1]}" for row in rows]
            path.write_text("\n".join([header, *late, ""]))
    elif case == "log missing":
        for path in logs:
            path.unlink()
    elif case == "weather missing":
        weather = home / "weather.dat"
        weather.write_text("\r\n".join([*weather.read_text().splitlines()[:4], ""]), newline="")
    elif case == "nothing stable":
        polygons = json.loads((home / "good.geojson").read_text())
        away = polygons["features"][0]
        ring = away["geometry"]["coordinates"][0]
        away["geometry"]["coordinates"] = [[[x + AWAY_M, y + AWAY_M] for x, y in ring]]
        (home / "good.geojson").write_text(json.dumps({**polygons, "features": [away]}))
