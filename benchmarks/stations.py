"""The stations of the benchmark: simulated once, kept in a folder, processed by several methods."""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy: two processes, one core each

import json
import shutil
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from station.config import Site, read_site
from station.service import references, tasks, upkeep
from station.service.inbox import Arrival
from station.simulation import files
from station.simulation.scenario import Scenario, dense, named
from station.simulation.station import Station, simulate

HOURS, SMALL_HOURS = 36, 20
REFERENCE_SCANS, SMALL_REFERENCE_SCANS = 8, 5
SNOW_HOURS, SMALL_SNOW_HOURS = (14.0, 24.0), (8.0, 13.0)
AVALANCHE_HOUR, SMALL_AVALANCHE_HOUR = 24.0, 14.0
NAMES = ("calm", "snow", "melt", "avalanche")


@dataclass(frozen=True)
class Method:
    """One way to process a station: what its site file says in place of the simulation's."""

    key: str
    title: str
    inclination: bool = True
    adjustment: str = "none"
    polygons: str = "good.geojson"


METHODS = {
    one.key: one
    for one in (
        Method("fixed", "fixed SOP", inclination=False),
        Method("filtered", "filtered inclination"),
        Method("joint_good", "joint, rock all round", adjustment="joint"),
        Method("joint_poor", "joint, ridge and hut", adjustment="joint", polygons="poor.geojson"),
    )
}


def scenario_of(name: str, seed: int, *, small: bool) -> Scenario:
    """Return what a station of the benchmark lives through.

    The hut's roof stays free of snow, and which stable ground its owner knows is left to the method.
    """
    hours = SMALL_HOURS if small else HOURS
    reference = SMALL_REFERENCE_SCANS if small else REFERENCE_SCANS
    snow_hours = SMALL_SNOW_HOURS if small else SNOW_HOURS
    events = {
        "calm": {},
        "snow": {"snowfall_m": 0.4, "snow_hours": snow_hours},
        "melt": {"melt_m_per_h": 0.005, "melt_from_hour": float(reference)},
        "avalanche": {
            "avalanche_m": 2.0,
            "avalanche_size": 0.11,
            "avalanche_hour": SMALL_AVALANCHE_HOUR if small else AVALANCHE_HOUR,
        },
    }
    usual = named("poor", hours, seed)
    return replace(usual if small else dense(usual), reference_scans=reference, **events[name])


def simulated(folder: Path, scenario: Scenario, name: str) -> Path:
    """Return the folder of a simulated station, made unless it is there from an earlier run."""
    home = folder / name
    told = json.dumps(asdict(scenario), default=str)
    if (home / "scenario.json").exists() and (home / "scenario.json").read_text() == told:
        return home
    shutil.rmtree(home, ignore_errors=True)
    simulate(home, scenario)
    _write_polygons(home, scenario)
    (home / "scenario.json").write_text(told)
    return home


def _write_polygons(home: Path, scenario: Scenario) -> None:
    """Write what an owner may know to be stable: much, little, and nothing (a place out of sight)."""
    for known in ("good", "poor"):
        station = Station(replace(scenario, stable_ground=known))
        rings_m = {one.name: one.ring_m(station.surface.grid) for one in station.stable}
        files.write_polygons(home / f"{known}.geojson", rings_m)


def site_of(home: Path, method: Method) -> Site:
    """Return a station's site for a method, with a data folder of its own."""
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
    """Process all scans of a station by the normal code path; return what became of each.

    From nothing, unless `keep` and it was done before, by whatever version.
    """
    site = site_of(home, method)
    told = home / f"outcomes_{method.key}.json"
    if keep and told.exists():
        return json.loads(told.read_text())
    told.unlink(missing_ok=True)
    shutil.rmtree(site.station.data, ignore_errors=True)
    arrivals = [_arrival(path, log=method.inclination) for path in sorted(site.scans.inbox.glob("*.laz"))]
    count = site.reference.scans
    if not isinstance(count, int):
        raise TypeError("the simulation's site file counts its reference scans")
    references.build_reference(site, arrivals[:count], "1", _quiet)
    outcomes = [asdict(tasks.process(site, arrival, _quiet)) for arrival in arrivals]
    upkeep.publish(site, _quiet)
    told.write_text(json.dumps(outcomes))
    return outcomes


def _arrival(path: Path, *, log: bool) -> Arrival:
    status = path.stat()
    beside = path.with_name(f"{path.stem}-incl.txt")
    return Arrival(
        path.name, path, beside if log and beside.exists() else None, status.st_size, status.st_mtime_ns
    )


def _quiet() -> None:
    """Nobody waits for progress."""
