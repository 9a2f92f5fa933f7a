"""A station as large as the largest: 4,000 x 5,000 cells of 1 m, scans of as many points as one likes.

Rays meet an analytic bowl line by line, which takes seconds for millions of points; everything else is the
simulation's: log, weather, SOP, site file. Made from the same numbers it is the same to the last bit.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib import import_module
from pathlib import Path

import laspy
import numpy as np

from station.quantities import Floats, WeatherLog
from station.service import child
from station.simulation import files, motion
from station.simulation.air import SCANNER_SETTING
from station.simulation.randomness import stream
from station.simulation.scenario import Scenario
from station.simulation.truth import grid_of, map_from_enu

POINTS = 14_400_000  # of each scan of the reference, and of one as they come
REFERENCE_SCANS = 2
WIDTH_M, LENGTH_M, NEAREST_M = 4000.0, 5000.0, 50.0  # of the grid, which begins in front of the scanner
SIDE_DEG = (2.0, 178.0)  # between which the head turns
LOWEST_DEG = -31.0
ABOVE_M = 700.0  # the scanner above the lowest ground
PROFILE_M = 1.0
BEYOND = 1.02  # of the grid's edge a scan still sees
BLOCK = 2_000_000  # points written at once
NOISE_M = 0.01
ROUGH_M = 0.02
ECHO_LOSS = 0.02
MELT_M = 0.05  # in the middle, from scan to scan
STABLE_M = 125.0  # half a side of a square of rock, one in each 500 m


@dataclass(frozen=True)
class Taken:
    """What a piece of work with a scan takes."""

    points: int
    cpu_s: float
    wall_s: float
    peak_gb: float


def large_station(folder: Path, points: int, *, scans: int = 1, size: float = 1.0) -> Path:
    """Return the site file of a station with two scans for its reference and `scans` of so many points.

    `size`: of valley and grid, length for length; the reference's points go with its square. What is there
    from an earlier call is not made again.
    """
    scenario = _scenario(scans, size)
    home = folder / f"{points}-{size:g}"
    inbox = home / "inbox"
    inbox.mkdir(parents=True, exist_ok=True)
    for scan in range(REFERENCE_SCANS + scans):
        wanted = round(POINTS * size**2) if scan < REFERENCE_SCANS else points
        held = _scan(folder / f"scans-{size:g}", scenario, scan, wanted)
        for path in (held, held.with_name(f"{held.stem}-incl.txt")):
            if not (inbox / path.name).exists():
                os.link(path, inbox / path.name)
    files.write_sop(home / "sop.dat", motion.sop(scenario))
    files.write_weather(home / "weather.dat", _weather(scenario))
    files.write_polygons(home / "stable.geojson", _squares(size, STABLE_M * size, 500.0 * size))
    areas = _squares(size, 200.0 * size, 1000.0 * size)
    files.write_polygons(home / "areas.geojson", dict(list(areas.items())[8:11]))
    files.write_site(home / "site.toml", scenario, grid_of(scenario))
    return home / "site.toml"


def prepared(folder: Path, points: int, *, size: float = 1.0) -> Path:
    """Return the site file of such a station whose reference is made, with one scan still to be measured."""
    site = large_station(folder, points, size=size)
    made = folder / f"data-{size:g}"
    if not made.exists():
        first = sorted((site.parent / "inbox").glob("*.laz"))[:REFERENCE_SCANS]
        shutil.rmtree(site.parent / "data", ignore_errors=True)
        subprocess.run(
            [sys.executable, "-m", "station.cli", "process", str(site), *map(str, first)],
            check=True,
            stdout=subprocess.DEVNULL,
        )
        (site.parent / "data").rename(made)
    shutil.rmtree(site.parent / "data", ignore_errors=True)
    shutil.copytree(made, site.parent / "data")
    return site


def decoded(scan: Path) -> Taken:
    """Decode all of a scan on one thread with laspy and lazrs, in a process of its own: the floor."""
    return _told("decode", scan)


def measured(site: Path, *, adjusted: bool = True) -> Taken:
    """Measure and store the last scan of a prepared station, in a process of its own that has the modules."""
    return _told("measure" if adjusted else "measure_bare", site)


def referenced(site: Path) -> Taken:
    """Make the reference of a station without data from its first scans, in a process of its own."""
    return _told("refer", site)


def _told(what: str, path: Path) -> Taken:
    told = subprocess.run(
        [sys.executable, "-m", "benchmarks.large", what, str(path)],
        capture_output=True,
        text=True,
        check=True,
        env=os.environ | child.SURROUNDINGS,
    ).stdout.split()
    return Taken(int(told[0]), *map(float, told[1:]))


def main() -> None:
    """Do what is asked for and print points, CPU seconds, seconds and the most memory [GB]."""
    what, path = sys.argv[1], Path(sys.argv[2])
    work = {
        "decode": lambda: _decode,
        "refer": _refer,
        "measure": lambda: _measure(path, adjusted=True),
        "measure_bare": lambda: _measure(path, adjusted=False),
    }[what]()
    used_s, began_s = _cpu_s(), time.monotonic()
    points = work(path)
    used_s, began_s = _cpu_s() - used_s, time.monotonic() - began_s
    peak_kb = re.search(r"VmHWM:\s+(\d+)", Path("/proc/self/status").read_text())
    print(points, used_s, began_s, int(peak_kb[1]) / 1e6)


def _cpu_s() -> float:
    """User and system time of this process and of those it has waited for [s]."""
    return sum(os.times()[:4])


def _decode(scan: Path) -> int:
    with laspy.open(scan, laz_backend=laspy.LazBackend.Lazrs) as reader:
        return sum(len(block) for block in reader.chunk_iterator(50_000))


def _refer() -> Callable[[Path], int]:
    """Return the work, once all it needs is imported."""
    from station.config import read_site  # noqa: PLC0415 - not of the floor
    from station.service.places import arrival_of  # noqa: PLC0415
    from station.service.references import build_reference  # noqa: PLC0415

    def work(site_file: Path) -> int:
        site = read_site(site_file)
        site.station.data.mkdir()
        scans = sorted(site.scans.inbox.glob("*.laz"))[:REFERENCE_SCANS]
        build_reference(site, [arrival_of(site, scan) for scan in scans], "1", lambda: None)
        return 0

    return work


def _measure(site_file: Path, *, adjusted: bool) -> Callable[[Path], int]:
    """Return the work, once all it needs is imported, as in the children of a running service."""
    from station.config import read_site  # noqa: PLC0415 - not of the floor
    from station.service import tasks  # noqa: PLC0415
    from station.service.inbox import Arrival  # noqa: PLC0415

    for module in child.PRELOAD:
        import_module(module)
    site = read_site(site_file)
    if not adjusted:
        site = site.model_copy(update={"adjustment": site.adjustment.model_copy(update={"method": "none"})})
    scan = max(site.scans.inbox.glob("*.laz"))
    log = scan.with_name(f"{scan.stem}-incl.txt")
    status = scan.stat()
    arrival = Arrival(scan.name, scan, log, status.st_size, status.st_mtime_ns)

    def work(_: Path) -> int:
        outcome = tasks.process(site, arrival, lambda: None)
        if outcome.verdict == "unusable":  # few points see less than the scans of the reference
            raise RuntimeError(f"{scan}: {outcome.verdict}: {outcome.reason}")
        return int(outcome.figures["points"])

    return work


def _scenario(scans: int, size: float) -> Scenario:
    west_m, south_m = -WIDTH_M / 2, NEAREST_M
    return Scenario(
        hours=REFERENCE_SCANS + scans,
        start=datetime(2025, 7, 15, tzinfo=UTC),
        size=size,
        cell_m=1.0,
        extent_m=(west_m, south_m, west_m + WIDTH_M, south_m + LENGTH_M),
        azimuth_deg=SIDE_DEG,
        mount_roll_deg=0.0,  # lines of one bearing
        mount_pitch_deg=0.0,
        mount_heading_deg=0.0,
        log_cyclic_change=0.0,
        reference_scans=REFERENCE_SCANS,
    )


def _weather(scenario: Scenario) -> WeatherLog:
    """Return the air that the scanner was told of, all the time: nothing is left to correct but bending."""
    time_s = scenario.start_utc_s + np.arange(-60.0, 60.0 * scenario.hours + 60) * 60
    one = np.ones_like(time_s)
    return WeatherLog(
        time_s,
        SCANNER_SETTING.temperature_c * one,
        SCANNER_SETTING.pressure_hpa * one,
        SCANNER_SETTING.humidity_pct * one,
    )


def _squares(size: float, half_m: float, apart_m: float) -> dict[str, Floats]:
    """Return squares on the map, one in each `apart_m` of the grid, as rings (n, 2)."""
    to_map = map_from_enu()
    rings = {}
    for north_m in np.arange(NEAREST_M * size + apart_m / 2, (NEAREST_M + LENGTH_M) * size, apart_m):
        for east_m in np.arange((apart_m - WIDTH_M * size) / 2, WIDTH_M * size / 2, apart_m):
            corner = half_m * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1)])
            east, north, _ = to_map.transform(east_m + corner[:, 0], north_m + corner[:, 1], np.zeros(5))
            rings[f"{len(rings) + 1}"] = np.stack([east, north], axis=-1)
    return rings


def _height(east_m: Floats, north_m: Floats, size: float) -> Floats:
    """Height of the ground above the scanner's foot: a bowl with ridges, which hide what is behind them."""
    east, north = east_m / (1000 * size), north_m / (1000 * size)
    bowl_m = 60 * ((east - 0.5) ** 2 + (north - 2.05) ** 2)
    ridges_m = 80 * np.sin(9 * east + 2) * np.cos(7 * north) + 20 * np.sin(31 * east) * np.sin(37 * north)
    return np.asarray(size * (bowl_m + ridges_m - ABOVE_M))


def _rough(east_m: Floats, north_m: Floats) -> Floats:
    return np.asarray(ROUGH_M * np.sin(1.7 * east_m + 0.3 * north_m) * np.sin(2.3 * north_m))


def _melted(east_m: Floats, north_m: Floats, size: float, scan: int) -> Floats:
    away = ((east_m / size) ** 2 + (north_m / size - 2000) ** 2) / 800**2
    return np.asarray(MELT_M * max(scan - REFERENCE_SCANS + 1, 0) * np.exp(-away))


def _scan(folder: Path, scenario: Scenario, scan: int, points: int) -> Path:
    """Return a scan of about so many points, with its log beside it; made unless it is there."""
    folder = folder / str(points)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{files.stem(scenario, scan)}.laz"
    if path.exists():
        return path
    axes, start_s = motion.axes(scenario), 60.0 + scan
    log = motion.sensor_log(scenario, scan, axes, start_s)
    files.write_inclination(path.with_name(f"{path.stem}-incl.txt"), log)
    lean = _Lean.of(scenario, scan, axes)
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = np.full(3, files.SCALE_M), np.zeros(3)
    header.creation_date = scenario.start.date()
    header.add_extra_dims(
        [
            laspy.ExtraBytesParams("Amplitude", "u2", scales=np.array([0.01]), offsets=np.zeros(1)),
            laspy.ExtraBytesParams("Reflectance", "i2", scales=np.array([0.01]), offsets=np.zeros(1)),
            laspy.ExtraBytesParams("Deviation", "u2"),
        ]
    )
    part = path.with_suffix(".part.laz")
    backend = laspy.LazBackend.LazrsParallel
    with laspy.open(part, mode="w", header=header, laz_backend=backend) as out:
        for shot in _shots(scenario, scan, points, lean):
            out.write_points(_record(header, shot, start_s))
    part.rename(path)
    return path


@dataclass(frozen=True)
class _Lean:
    """How the scanner leans during a scan."""

    into_s: Floats  # (k,)
    roll_rad: Floats  # (k,)
    pitch_rad: Floats  # (k,)

    @classmethod
    def of(cls, scenario: Scenario, scan: int, axes: tuple[motion.Axis, motion.Axis]) -> _Lean:
        into_s = np.arange(0.0, scenario.scan_s + 1, motion.SPACING_S)
        roll_rad, pitch_rad = (axis.lean(scenario.scan_start_s(scan) + into_s) for axis in axes)
        return cls(into_s, roll_rad, pitch_rad)

    def turned(self, seen_m: Floats, into_s: float) -> Floats:
        """Return points (3, n) of one moment, upright, as the leaning scanner sees them."""
        roll, pitch = (float(np.interp(into_s, self.into_s, one)) for one in (self.roll_rad, self.pitch_rad))
        return np.asarray((motion.rotation_y(pitch) @ motion.rotation_x(roll)).T @ seen_m)


@dataclass(frozen=True)
class _Shot:
    """Echoes, in the scanner's frame."""

    x_m: Floats
    y_m: Floats
    z_m: Floats
    into_s: Floats
    brightness: Floats
    deviation: Floats


def _record(header: laspy.LasHeader, shot: _Shot, start_s: float) -> laspy.ScaleAwarePointRecord:
    count = len(shot.x_m)
    record = laspy.ScaleAwarePointRecord.zeros(count, header=header)
    record["x"], record["y"], record["z"] = shot.x_m, shot.y_m, shot.z_m
    record["gps_time"] = start_s + shot.into_s
    record["intensity"] = np.rint(65535 * shot.brightness)
    record["return_number"] = record["number_of_returns"] = np.ones(count, np.uint8)
    range_m = np.sqrt(shot.x_m**2 + shot.y_m**2 + shot.z_m**2)
    reflectance_db = 10 * np.log10(shot.brightness)
    record["Reflectance"] = reflectance_db
    record["Amplitude"] = np.maximum(reflectance_db + 40 - range_m / 250, 0.1)
    record["Deviation"] = np.rint(shot.deviation)
    return record


def _shots(scenario: Scenario, scan: int, points: int, lean: _Lean) -> Iterator[_Shot]:
    """Give a scan in blocks, line after line, each from below upwards, at equal angles."""
    size, rng = scenario.size, stream(scenario.seed, 70, scan, points)
    first, last = np.radians(SIDE_DEG)
    coarse = [_line(bearing, size)[0] for bearing in np.linspace(first, last, 90)]
    spans = np.array([climb[-1] - max(climb[0], np.radians(LOWEST_DEG)) for climb in coarse])
    step_rad = np.sqrt(float(spans.mean()) * (last - first) * (1 - ECHO_LOSS) / points)
    lines = round((last - first) / step_rad)
    together = round(BLOCK * lines / points)
    held: list[_Shot] = []
    for line in range(lines):
        bearing = first + (last - first) * (line + rng.uniform()) / lines
        climb, away_m = _line(bearing, size)
        aim = np.arange(max(climb[0], np.radians(LOWEST_DEG)), climb[-1], step_rad)
        share = np.arange(len(aim)) / len(aim)
        kept = rng.uniform(size=len(aim)) > ECHO_LOSS
        r_m = np.interp(aim, climb, away_m)[kept]
        into_s = np.round(scenario.scan_s * (line + 0.75 * share[kept]) / lines, 7)
        held.append(_echoes(scenario, scan, bearing, r_m, into_s, lean, rng))
        if len(held) == together or line == lines - 1:
            yield _Shot(*(np.concatenate([getattr(one, k) for one in held]) for k in _Shot.__annotations__))
            held = []


def _line(bearing_rad: float, size: float) -> tuple[Floats, Floats]:
    """Return angle above the horizon (k,), rising, and distance (k,) of what one line sees."""
    cos, sin = float(np.cos(bearing_rad)), float(np.sin(bearing_rad))
    edge_m = min(WIDTH_M / 2 / max(abs(cos), 1e-9), (NEAREST_M + LENGTH_M) / max(sin, 1e-9)) * size * BEYOND
    away_m = np.arange(NEAREST_M * size, edge_m, PROFILE_M)
    climb = np.arctan2(_height(away_m * cos, away_m * sin, size), away_m)
    return np.maximum.accumulate(climb), away_m


def _echoes(
    scenario: Scenario,
    scan: int,
    bearing_rad: float,
    away_m: Floats,
    into_s: Floats,
    lean: _Lean,
    rng: np.random.Generator,
) -> _Shot:
    """Return the echoes of a line, at so many metres from the scanner's foot, as the scanner records them."""
    count, size = len(away_m), scenario.size
    east_m, north_m = away_m * np.cos(bearing_rad), away_m * np.sin(bearing_rad)
    up_m = _height(east_m, north_m, size) + _rough(east_m, north_m) - _melted(east_m, north_m, size, scan)
    seen = np.stack([east_m, north_m, up_m]) - np.array(scenario.mount_position_m)[:, None]
    range_m = np.sqrt((seen**2).sum(axis=0))
    seen *= 1 + NOISE_M * rng.standard_normal(count) / range_m
    x_m, y_m, z_m = lean.turned(seen, float(into_s.mean()))
    white = 0.3 + 0.2 * np.sin(east_m / 170) * np.cos(north_m / 130)
    brightness = white * np.exp(-range_m / 8000) * (1 + 0.05 * rng.standard_normal(count))
    deviation = 5 + 4 * rng.standard_exponential(count)
    return _Shot(x_m, y_m, z_m, into_s, np.clip(brightness, 0.01, 1.0), deviation)


if __name__ == "__main__":
    main()
