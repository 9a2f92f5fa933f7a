"""Events on simulated stations, one disturbance each: deposits found, their volumes, and false alarms.

python -m benchmarks.event_stations [--cases NAME …] [--quiet] [--seeds N] [--first SEED] [--folder DIR]
                                    [--markdown PAGE]

The stations have the real scanner's points in a sector of 25°, and cells of 5 m. On each, debris of 0.3 m
comes to rest on 500 m² at four places 2 km away, one after another; at the first of them as much again three
scans later. The places are drawn from what the first scan sees, on slopes below 40°. Quiet ones are
longer and have no debris; a rock face with cells of 0.5 m and a snow field with cells of 1 m are among them.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import Any
from unittest import mock

from benchmarks import accuracy_stations  # isort: skip - sets the number of BLAS threads before numpy loads
import numpy as np
import shapely
from scipy import ndimage

from benchmarks.accuracy_rows import Row
from benchmarks.markdown_tables import write_tables
from station.archive.derived.event_table import FILE_NAME, FOUND_NAME, Event, read_outlines
from station.config import read_site
from station.processing.site_files import series_for
from station.queries.blocks import BlockQueries
from station.queries.events import LEAST_HISTORY, EventQueries
from station.science.time_series.events import Thresholds
from station.simulation.kinds import mammoth, rockfall
from station.simulation.scenario import Deposit, Scenario, full_resolution, named
from station.simulation.station import Station
from station.simulation.truth import map_from_enu

HOURS, QUIET_HOURS = 33, 57
DEPOSIT_SCANS = (18, 24, 27, 30)  # that show a new deposit
GROWTH_SCAN = 21  # that shows the first deposit twice as deep
AREA_M2, DEPTH_M = 500.0, 0.3
AZIMUTH_DEG = (195.0, 220.0)  # rock, then ice from 1 km on, then rock
EXTENT_M = (-2500.0, 150.0, 150.0, 2650.0)
RANGE_M, STEEPEST_DEG = (1700.0, 2300.0), 40.0
SEEN, APART_M, EDGE_M = 0.6, 200.0, 60.0
TOUCHES_M = 20.0  # from the edge of a deposit to an event that is taken for it
LOCAL = ("gain", "loss", "paired")
LEAST_Z = 3.0  # of what is searched for the largest z


@dataclass(frozen=True)
class Case:
    """A station of the table: its scenario in `named`, and what else is changed."""

    title: str
    scenario: str | Callable[[int, int], Scenario]  # of the valley; or of another kind, by hours and seed
    overrides: dict[str, Any] = field(default_factory=dict)


CASES = {
    "calm": Case("calm", "quiet"),
    "rough": Case("rough rock, tilt that wanders", "rough"),
    "drift": Case(
        "twice the drift, steps, daily wave", "drift", {"tilt_daily_deg": 0.005, "tilt_walk_deg": 0.003}
    ),
    "disturbed": Case("steps, gusts, heavy tails, patchy air", "disturbed"),
    "ice-refraction": Case("k over ice differs by 0.1", "ice-refraction"),
    "melt": Case("melt of 0.24 m a day, by day only", "melt", {"melt_m_per_h": 0.01, "melt_by_day": True}),
    "melt-front": Case(
        "0.3 m of snow go below an edge that climbs", "quiet", {"thaw_m": 0.3, "thaw_from_hour": 12.0}
    ),
    "breathing": Case("rock heaves by 3 mm and creeps by 20 mm", "breathing"),
    "snow": Case("0.4 m of patchy snow in half of the hours", "snowfall"),
    "airborne": Case("0.1 % of the echoes from the air", "airborne"),
}
QUIET_CASES = CASES | {
    "rock-face": Case("rock face, cells of 0.5 m", rockfall, {"rockfall_m": 0.0}),
    "snow-field": Case("snow field, cells of 1 m", mammoth, {"snowfall_m": 0.0}),
}
HEADS = "station", "found by the second scan", "later", "volumes: rms of z, σ", "false alarms", "widespread"
QUIET_HEADS = "station", "searched scans", "false alarms", "largest z", "widespread"


@dataclass
class Score:
    """What the tables of stations say of their deposits, and what else is in them."""

    late: list[int | None] = field(default_factory=list)  # scans after the second; None if missed
    z: list[float] = field(default_factory=list)  # of the volumes found
    sigma_m3: list[float] = field(default_factory=list)
    false: int = 0
    widespread: list[str] = field(default_factory=list)
    scans: int = 0  # that were searched
    largest_z: float = 0.0  # of local change in quiet scans

    def __add__(self, other: Score) -> Score:
        """Return the score of the stations of both."""
        summed = {name: value + getattr(other, name) for name, value in vars(self).items()}
        return Score(**summed | {"largest_z": max(self.largest_z, other.largest_z)})

    def cells(self, *, quiet: bool) -> tuple[str, ...]:
        """Return the cells of its row of the table, but for the first."""
        widespread = ", ".join(
            f"{self.widespread.count(kind)} {kind}" for kind in dict.fromkeys(self.widespread)
        )
        if quiet:
            largest = f"{self.largest_z:.1f}" if self.largest_z else f"below {LEAST_Z:g}"
            return str(self.scans), str(self.false), largest, widespread or "none"
        rms_z, rms_m3 = (
            float(np.sqrt(np.mean(np.square(v)))) if v else np.nan for v in (self.z, self.sigma_m3)
        )
        return (
            f"{self.late.count(0)} of {len(self.late)}",
            str(sum(bool(scans) for scans in self.late)),
            f"{rms_z:.2f}, {rms_m3:.0f} m³",
            f"{self.false} in {self.scans} scans",
            widespread or "none",
        )


def scenario_of(case: str, seed: int, *, quiet: bool = False) -> Scenario:
    """Return the scenario of a case with its deposits, or a longer one without them."""
    its = QUIET_CASES[case]
    if not isinstance(its.scenario, str):
        scans_per_hour = 3600 / its.scenario(1, seed).interval_s
        return replace(its.scenario(round(QUIET_HOURS / scans_per_hour), seed), **its.overrides)
    full = full_resolution(named(its.scenario, QUIET_HOURS if quiet else HOURS, seed))
    share = (AZIMUTH_DEG[1] - AZIMUTH_DEG[0]) / (full.azimuth_deg[1] - full.azimuth_deg[0])
    sector = replace(full, azimuth_deg=AZIMUTH_DEG, lines=round(full.lines * share), extent_m=EXTENT_M)
    scenario = replace(sector, **its.overrides)
    return scenario if quiet else with_deposits(scenario, DEPOSIT_SCANS, GROWTH_SCAN)


def with_deposits(scenario: Scenario, scans: Sequence[int], growth_scan: int | None = None) -> Scenario:
    """Return a scenario with a deposit from each of the scans on, the first of which grows once."""
    places = visible_places(scenario)
    deposits = [Deposit(scan - 0.25, *next(places), AREA_M2, DEPTH_M) for scan in scans]
    if growth_scan is not None:
        deposits.append(replace(deposits[0], hour=growth_scan - 0.25))
    return replace(scenario, deposits=tuple(deposits))


def visible_places(scenario: Scenario) -> Iterator[tuple[float, float]]:
    """Yield east and north [m] of places that the first scan sees, drawn by the seed of the scenario."""
    station, cell_m = Station(scenario), scenario.cell_m
    west, south, east, north = scenario.extent_m
    points_m, ground = station.scan(0).true_m, station.valley.ground
    edges = np.arange(south, north + 1, cell_m), np.arange(west, east + 1, cell_m)
    hit = np.histogram2d(points_m[:, 1], points_m[:, 0], edges)[0] > 0
    north_m, east_m = np.meshgrid(*((edge[1:] + edge[:-1]) / 2 for edge in edges), indexing="ij")
    reach = np.ceil(np.sqrt(AREA_M2 / np.pi) / cell_m)
    disc = np.hypot(*np.mgrid[-reach : reach + 1, -reach : reach + 1]) * cell_m < np.sqrt(AREA_M2 / np.pi)
    smooth = ground.with_nodes(ndimage.gaussian_filter(ground.node, 10.0 / ground.step_m))
    slope = np.hypot(*smooth.with_slope(east_m, north_m)[1:])
    below_m = scenario.mount_position_m[2] - ground.at(east_m, north_m)
    range_m = np.sqrt(east_m**2 + north_m**2 + below_m**2)
    suitable = ndimage.convolve(hit.astype(float), disc / disc.sum()) >= SEEN
    suitable &= (range_m > RANGE_M[0]) & (range_m < RANGE_M[1]) & (slope < np.tan(np.radians(STEEPEST_DEG)))
    suitable &= (east_m > west + EDGE_M) & (east_m < east - EDGE_M)
    suitable &= (north_m > south + EDGE_M) & (north_m < north - EDGE_M)
    chosen: list[tuple[float, float]] = []
    for cell in np.random.default_rng(scenario.seed).permutation(np.flatnonzero(suitable)):
        place = float(east_m.flat[cell]), float(north_m.flat[cell])
        if all(np.hypot(place[0] - x, place[1] - y) > APART_M for x, y in chosen):
            chosen.append(place)
            yield place


def events_of(home: Path, scenario: Scenario) -> list[tuple[Event, shapely.Geometry]]:
    """Return the events of a station; it is simulated and processed unless an earlier run did that."""
    row = Row("events", "", "")
    accuracy_stations.simulated(home, scenario)
    data = home / f"data-{row.name}"
    if not (data / FILE_NAME).exists():
        accuracy_stations.processed(home, row)
    return searched(home)


def searched(home: Path) -> list[tuple[Event, shapely.Geometry]]:
    """Return the events of a processed station, searched again."""
    site = read_site(home / "site-events.toml")
    for name in (FILE_NAME, FOUND_NAME):
        (site.station.data / name).unlink(missing_ok=True)
    series = series_for(site)
    EventQueries(series, BlockQueries(series), site.scans.expected_every_s).update(lambda: None)
    return read_outlines(site.station.data)


def largest_z(home: Path) -> float:
    """Return the largest z of local change in the scans of a processed station, 0 if it is below LEAST_Z."""
    thresholds = Thresholds(LEAST_Z, np.inf)
    with mock.patch("station.queries.events.event_thresholds", return_value=thresholds):
        return max((event.sigmas for event, _ in searched(home)), default=0.0)


def score(total: Score, events: Sequence[tuple[Event, shapely.Geometry]], scenario: Scenario) -> None:
    """Compare the events of a station with its deposits."""
    rest = list(events)
    ground = Station(scenario).valley.ground
    places = dict.fromkeys((deposit.east_m, deposit.north_m) for deposit in scenario.deposits)
    for place in places:
        fallen = [each for each in scenario.deposits if (each.east_m, each.north_m) == place]
        first_scan = int(np.ceil(fallen[0].hour))
        easting_m, northing_m, _ = map_from_enu(scenario.mark).transform(*place, float(ground.at(*place)))
        point, reach_m = shapely.Point(easting_m, northing_m), np.sqrt(AREA_M2 / np.pi) + TOUCHES_M
        its = [
            (event, outline)
            for event, outline in rest
            if event.kind in LOCAL and event.volume_m3 > 0 and outline.distance(point) < reach_m
            and scan_of(event.confirmed, scenario) > first_scan
        ]  # fmt: skip
        rest = [pair for pair in rest if pair not in its]
        if not its:
            total.late.append(None)
            print(f"    scan {first_scan}: missed at {easting_m:.0f} {northing_m:.0f}")
            continue
        event = its[0][0]
        late, end_scan = (scan_of(event.confirmed, scenario) - first_scan - 1), scan_of(event.end, scenario)
        true_m3 = sum(each.area_m2 * each.depth_m for each in fallen if each.hour < end_scan)
        total.late.append(late)
        total.z.append((event.volume_m3 - true_m3) / event.volume_sigma_m3)
        total.sigma_m3.append(event.volume_sigma_m3)
        print(f"    scan {first_scan}: {late} late, true {true_m3:.0f} m³: {described(event, scenario)}")
    total.scans += scenario.scans - scenario.reference_scans - LEAST_HISTORY - 1
    for event, _ in rest:
        print(f"    {'false' if event.kind in LOCAL else 'widespread'}: {described(event, scenario)}")
        if event.kind in LOCAL:
            total.false += 1
        else:
            total.widespread.append(event.kind)


def described(event: Event, scenario: Scenario) -> str:
    """Return an event as a line of text."""
    scans = f"scans {scan_of(event.confirmed, scenario)} to {scan_of(event.end, scenario)}"
    return (
        f"{event.kind}, {scans}, {event.sigmas:.1f} σ, {event.area_m2:.0f} m²,"
        f" {event.volume_m3:.0f} ± {event.volume_sigma_m3:.0f} m³ at {event.east_m:.0f} {event.north_m:.0f}"
    )


def scan_of(time: str, scenario: Scenario) -> int:
    """Return the number of the scan with this middle."""
    seconds = datetime.fromisoformat(time).timestamp() - scenario.start_utc_s - scenario.scan_s / 2
    return round(seconds / scenario.interval_s)


def main() -> None:
    """Print a row for each case, and a line for each deposit and each other event."""
    parser = argparse.ArgumentParser(description="Events on simulated stations with disturbances.")
    parser.add_argument("--cases", nargs="+", choices=list(QUIET_CASES), metavar="NAME")
    parser.add_argument("--quiet", action="store_true", help="57 scans without deposits: false alarms only")
    parser.add_argument("--seeds", type=int, default=1, help="number of stations of each case")
    parser.add_argument("--first", type=int, default=1, help="the first seed")
    parser.add_argument("--folder", type=Path, help="folder that keeps the simulated and processed stations")
    parser.add_argument("--markdown", type=Path, help="page of the docs whose table is replaced")
    options = parser.parse_args()
    quiet, scores = options.quiet, {}
    cases = QUIET_CASES if quiet else CASES
    if unknown := set(options.cases or ()) - set(cases):
        parser.error(f"only quiet: {', '.join(unknown)}")
    with tempfile.TemporaryDirectory() as temporary:
        for case in options.cases or cases:
            scores[case] = Score()
            for seed in range(options.first, options.first + options.seeds):
                print(f"  {case}-{seed}", flush=True)
                scenario = scenario_of(case, seed, quiet=quiet)
                home = (options.folder or Path(temporary)) / f"{case}{'-quiet' * quiet}-{seed}"
                score(scores[case], events_of(home, scenario), scenario)
                if quiet:
                    scores[case].largest_z = max(scores[case].largest_z, largest_z(home))
            print(f"{case}: {'; '.join(scores[case].cells(quiet=quiet))}", flush=True)
    if options.markdown:
        first, last = options.first, options.first + options.seeds - 1
        seeds = f"seeds {first} to {last}" if last > first else f"seed {first}"
        rows = {cases[case].title: its for case, its in scores.items()} | {
            "all": sum(scores.values(), Score())
        }
        write_tables(
            options.markdown,
            f"event_stations{' --quiet' * quiet}",
            f"{QUIET_HOURS if quiet else HOURS} scans, {seeds}",
            [
                (
                    QUIET_HEADS if quiet else HEADS,
                    [(name, *its.cells(quiet=quiet)) for name, its in rows.items()],
                )
            ],
        )


if __name__ == "__main__":
    main()
