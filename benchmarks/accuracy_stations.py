"""Stations of the accuracy benchmark: simulated once, stored in a folder, processed by several methods."""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # set before numpy is imported: one core per process

import json
import shutil
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from station.config import Site, read_site
from station.inbox.inbox import ScanFile
from station.processing import reference_tasks, scan_tasks, store_tasks
from station.simulation import files
from station.simulation.scenario import NAMES as SIMULATED_NAMES
from station.simulation.scenario import Scenario, full_resolution, named
from station.simulation.station import Station, simulate

HOURS, SMALL_HOURS = 36, 20
REFERENCE_SCANS, SMALL_REFERENCE_SCANS = 8, 5
SNOW_HOURS, SMALL_SNOW_HOURS = (14.0, 24.0), (8.0, 13.0)
AVALANCHE_HOUR, SMALL_AVALANCHE_HOUR = 24.0, 14.0
NAMES = ("calm", "snow", "melt", "avalanche")
FIELD_NAMES = tuple(name for name in SIMULATED_NAMES if name not in NAMES)  # on request
LATE_S = 5.0
SHIFT_M = 100_000.0


@dataclass(frozen=True)
class Method:
    """A way to process a station: changes to the site file of the simulation."""

    key: str
    title: str
    inclination: bool = True
    adjustment: str = "none"
    polygons: str = "good.geojson"


METHODS = {
    method.key: method
    for method in (
        Method("fixed", "fixed SOP", inclination=False),
        Method("filtered", "filtered inclination"),
        Method("joint_good", "joint, rock all round", adjustment="joint"),
        Method("joint_poor", "joint, ridge and hut", adjustment="joint", polygons="poor.geojson"),
    )
}


def scenario_of(name: str, seed: int, *, small: bool) -> Scenario:
    """Return the scenario of a station: one of NAMES with its own hours, or one of the simulation's.

    The roof of the hut stays free of snow. The method chooses the stable polygons.
    """
    hours = SMALL_HOURS if small else HOURS
    reference = SMALL_REFERENCE_SCANS if small else REFERENCE_SCANS
    snow_hours = SMALL_SNOW_HOURS if small else SNOW_HOURS
    events: dict[str, dict[str, Any]] = {
        "calm": {},
        "snow": {"snowfall_m": 0.4, "snow_hours": snow_hours},
        "melt": {"melt_m_per_h": 0.005, "melt_from_hour": float(reference)},
        "avalanche": {
            "avalanche_m": 2.0,
            "avalanche_size": 0.11,
            "avalanche_hour": SMALL_AVALANCHE_HOUR if small else AVALANCHE_HOUR,
        },
    }
    scenario = replace(named("poor" if name in events else name, hours, seed), stable_ground="poor")
    scenario = scenario if small else full_resolution(scenario)
    return replace(scenario, reference_scans=reference, **events.get(name, {}))


def simulated(folder: Path, scenario: Scenario, name: str) -> Path:
    """Return the folder of a station, simulated unless it exists from an earlier run."""
    home = folder / name
    description = json.dumps(asdict(scenario), default=str)
    if (home / "scenario.json").exists() and (home / "scenario.json").read_text() == description:
        return home
    shutil.rmtree(home, ignore_errors=True)
    simulate(home, scenario)
    _write_polygons(home, scenario)
    (home / "scenario.json").write_text(description)
    return home


def _write_polygons(home: Path, scenario: Scenario) -> None:
    """Write the stable polygons that an operator may know: many, and few."""
    for known in ("good", "poor"):
        station = Station(replace(scenario, stable_ground=known))
        rings_m = {area.name: area.ring_m(station.surface.grid) for area in station.stable}
        files.write_polygons(home / f"{known}.geojson", rings_m)


def site_of(home: Path, method: Method) -> Site:
    """Return the site of a station for a method, with a separate data folder."""
    text = (home / "site.toml").read_text()
    if not method.inclination:
        start, end = text.index("[inclination]"), text.index("[adjustment]")
        text = text[:start] + text[end:]
    text = text.replace('data = "data"', f'data = "data_{method.key}"')
    text = text.replace('method = "joint"', f'method = "{method.adjustment}"')
    text = text.replace('stable = "stable.geojson"', f'stable = "{method.polygons}"')
    path = home / f"site_{method.key}.toml"
    path.write_text(text)
    return read_site(path)


def processed(home: Path, method: Method, *, keep: bool = False) -> list[dict[str, object]]:
    """Process all scans of a station as the service does; return the result of each.

    With `keep`, results of an earlier run are returned, of any version of the program.
    """
    site = site_of(home, method)
    path = home / f"outcomes_{method.key}.json"
    if keep and path.exists():
        earlier: list[dict[str, object]] = json.loads(path.read_text())
        return earlier
    path.unlink(missing_ok=True)
    shutil.rmtree(site.station.data, ignore_errors=True)
    scans = [_scan_file(laz, log=method.inclination) for laz in sorted(site.scans.inbox.glob("*.laz"))]
    count = site.reference.scans
    if not isinstance(count, int):
        raise TypeError("the simulation's site file counts its reference scans")
    reference_tasks.build_reference_version(site, scans[:count], "1", _no_progress)
    results = [asdict(scan_tasks.process(site, scan, _no_progress)) for scan in scans]
    store_tasks.update_series(site, _no_progress)
    path.write_text(json.dumps(results))
    return results


def _scan_file(path: Path, *, log: bool) -> ScanFile:
    status = path.stat()
    log_path = path.with_name(f"{path.stem}-incl.txt")
    return ScanFile(
        path.name, path, log_path if log and log_path.exists() else None, status.st_size, status.st_mtime_ns
    )


def _no_progress() -> None:
    """Ignore progress."""


def spoil(home: Path, case: str, first: int) -> None:
    """Spoil the logs from scan `first` on, all of the weather, or all stable polygons."""
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
        distant = polygons["features"][0]
        ring = distant["geometry"]["coordinates"][0]
        distant["geometry"]["coordinates"] = [[[x + SHIFT_M, y + SHIFT_M] for x, y in ring]]
        (home / "good.geojson").write_text(json.dumps({**polygons, "features": [distant]}))
