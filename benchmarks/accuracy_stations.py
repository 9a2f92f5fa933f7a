"""Stations of the accuracy benchmark: simulated once, processed with the settings of a row."""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # set before numpy is imported: one core per process

import json
import shutil
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from benchmarks.accuracy_rows import Row
from station.config import Site, read_site
from station.inbox.listing import ScanFile
from station.processing import reference_tasks, scan_tasks, store_tasks
from station.simulation.scenario import ROUGH, Scenario, full_resolution, named
from station.simulation.station import simulate

HOURS, SMALL_HOURS = 28, 16


def scenario_of(row: Row, seed: int, *, small: bool, rough: bool) -> Scenario:
    """Return the scenario of a row: 28 scans at full resolution, or 16 on 10 m cells; on rough rock."""
    scenario = named(row.scenario, SMALL_HOURS if small else HOURS, seed)
    scenario = scenario if small else full_resolution(scenario)
    if row.poor:
        scenario = replace(scenario, stable_ground="poor")
    terrain: dict[str, Any] = ROUGH if rough else {}
    return replace(scenario, **terrain)


def simulated(home: Path, scenario: Scenario) -> Path:
    """Return the folder of a station, simulated unless it exists from an earlier run."""
    description = json.dumps(asdict(scenario), default=str)
    marker = home / "scenario.json"
    if not marker.exists() or marker.read_text() != description:
        shutil.rmtree(home, ignore_errors=True)
        simulate(home, scenario)
        marker.write_text(description)
    return home


def processed(home: Path, row: Row) -> tuple[Site, list[tuple[str, str]]]:
    """Process a station as the service does; return its site, and verdict and reason of each later scan.

    The scans of the reference are not processed by themselves. The row has its own site file and data.
    """
    text = (home / "site.toml").read_text().replace('data = "data"', f'data = "data-{row.name}"')
    if not row.log:
        text = text[: text.index("[inclination]")] + text[text.index("[adjustment]") :]
    path = home / f"site-{row.name}.toml"
    path.write_text(text.replace('method = "joint"', f'method = "{row.adjustment}"'))
    site = read_site(path)
    shutil.rmtree(site.station.data, ignore_errors=True)
    scans = [_scan_file(laz, log=row.log) for laz in sorted(site.scans.inbox.glob("*.laz"))]
    count = reference_scans(site)
    reference_tasks.build_reference_version(site, scans[:count], "1", _no_progress)
    results = [scan_tasks.process(site, scan, _no_progress) for scan in scans[count:]]
    store_tasks.update_series(site, _no_progress)
    return site, [(result.verdict, result.reason) for result in results]


def reference_scans(site: Site) -> int:
    """Return the number of scans of the reference, which are the first of the station."""
    count = site.reference.scans
    if not isinstance(count, int):
        raise TypeError("the simulation's site file counts its reference scans")
    return count


def _scan_file(path: Path, *, log: bool) -> ScanFile:
    status = path.stat()
    log_path = path.with_name(f"{path.stem}-incl.txt")
    found = log_path if log and log_path.exists() else None
    return ScanFile(path.name, path, found, status.st_size, status.st_mtime_ns)


def _no_progress() -> None:
    """Ignore progress."""
