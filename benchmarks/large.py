"""A simulated station of the largest size, 4,000 x 5,000 cells of 1 m, with scans of any number of points.

Rays are intersected with an analytic bowl, line by line, which takes seconds for millions of points. Log,
weather, SOP and site file are those of the simulation. The same arguments give the same bits.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import laspy
import numpy as np

from benchmarks.process_cost import Cost, job_cost
from station.processing.workers.fork_server import WORKER_ENV
from station.quantities import Floats, WeatherLog
from station.simulation import files
from station.simulation.instrument import motion
from station.simulation.randomness import rng_for
from station.simulation.scenario import Mark, Scenario
from station.simulation.truth import grid_of, map_from_enu
from station.simulation.world.air import SCANNER_SETTING

POINTS = 14_400_000  # of a typical scan, and of each scan of the reference
REFERENCE_SCANS = 2
WIDTH_M, LENGTH_M, NEAREST_M = 4000.0, 5000.0, 50.0  # of the grid, and its distance from the scanner
AZIMUTH_DEG = (2.0, 178.0)  # range of the head
LOWEST_DEG = -31.0
SCANNER_HEIGHT_M = 700.0  # above the lowest ground
PROFILE_M = 1.0
OVERLAP = 1.02  # extent of a scan relative to the grid
BLOCK = 2_000_000  # points written at once
NOISE_M = 0.01
ROUGH_M = 0.02
ECHO_LOSS = 0.02
MELT_M = 0.05  # per scan, at the centre of the melting area
STABLE_M = 125.0  # half the side of the squares of rock, of which there is one in each 500 m


@dataclass(frozen=True)
class ScanCost(Cost):
    """Cost of a scan, and its number of points."""

    points: int = 0


def large_station(folder: Path, points: int, *, scans: int = 1, size: float = 1.0) -> Path:
    """Return the site file of a station with two scans for its reference and `scans` of `points` points.

    `size` scales the lengths of valley and grid, and by its square the points of the reference. Files of an
    earlier call are reused.
    """
    scenario = _scenario(scans, size)
    home = folder / f"{points}-{size:g}"
    inbox = home / "inbox"
    inbox.mkdir(parents=True, exist_ok=True)
    for scan in range(REFERENCE_SCANS + scans):
        count = round(POINTS * size**2) if scan < REFERENCE_SCANS else points
        laz = _scan(folder / f"scans-{size:g}", scenario, scan, count)
        for path in (laz, laz.with_name(f"{laz.stem}-incl.txt")):
            if not (inbox / path.name).exists():
                os.link(path, inbox / path.name)
    files.write_matrix(home / "sop.dat", motion.sop(scenario), "scanner's frame to east-north-up at the mark")
    files.write_weather(home / "weather.dat", _weather(scenario))
    crs = scenario.mark.crs
    files.write_polygons(home / "stable.geojson", _squares(size, STABLE_M * size, 500.0 * size), crs)
    areas = _squares(size, 200.0 * size, 1000.0 * size)
    files.write_polygons(home / "areas.geojson", dict(list(areas.items())[8:11]), crs)
    files.write_site(home, scenario, grid_of(scenario))
    return home / "site.toml"


def prepared(folder: Path, points: int, *, size: float = 1.0) -> Path:
    """Return the site file of such a station with its reference built and one scan not yet processed."""
    site = large_station(folder, points, size=size)
    data = folder / f"data-{size:g}"
    if not data.exists():
        first = sorted((site.parent / "inbox").glob("*.laz"))[:REFERENCE_SCANS]
        shutil.rmtree(site.parent / "data", ignore_errors=True)
        command = [sys.executable, "-m", "station", "process", str(site), *map(str, first)]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        (site.parent / "data").rename(data)
    shutil.rmtree(site.parent / "data", ignore_errors=True)
    shutil.copytree(data, site.parent / "data")
    return site


def decoded(scan: Path) -> ScanCost:
    """Decode all of a scan on one thread with laspy and lazrs, in its own process: the baseline."""
    return _scan_cost("benchmarks.peers", "decode", scan.parent, scan=str(scan))


def measured(site: Path) -> ScanCost:
    """Process and store the last scan of a prepared station, in its own process."""
    scan = max((site.parent / "inbox").glob("*.laz"))
    return _scan_cost("benchmarks.station_jobs", "epoch", site.parent, site=str(site), scan=str(scan))


def referenced(site: Path) -> ScanCost:
    """Build the reference of a station without data from its first scans, in its own process."""
    (site.parent / "data").mkdir()
    scans = sorted((site.parent / "inbox").glob("*.laz"))[:REFERENCE_SCANS]
    return _scan_cost(
        "benchmarks.station_jobs", "reference", site.parent, site=str(site), scans=list(map(str, scans))
    )


def _scan_cost(module: str, job: str, folder: Path, **arguments: object) -> ScanCost:
    cost, result = job_cost(module, job, folder, WORKER_ENV, **arguments)
    if result.get("verdict") == "unusable":  # too few points observe less than the scans of the reference
        raise RuntimeError(f"{arguments['scan']}: unusable")
    return ScanCost(**vars(cost), points=int(result.get("points", 0)))


def _scenario(scans: int, size: float) -> Scenario:
    west_m, south_m = -WIDTH_M / 2, NEAREST_M
    return Scenario(
        hours=REFERENCE_SCANS + scans,
        start=datetime(2025, 7, 15, tzinfo=UTC),
        size=size,
        cell_m=1.0,
        extent_m=(west_m, south_m, west_m + WIDTH_M, south_m + LENGTH_M),
        azimuth_deg=AZIMUTH_DEG,
        mount_roll_deg=0.0,  # lines of one bearing
        mount_pitch_deg=0.0,
        mount_heading_deg=0.0,
        log_cyclic_change=0.0,
        reference_scans=REFERENCE_SCANS,
    )


def _weather(scenario: Scenario) -> WeatherLog:
    """Return the air set in the scanner, constant in time: only refraction remains to be corrected."""
    time_s = scenario.start_utc_s + np.arange(-60.0, 60.0 * scenario.hours + 60) * 60
    constant = np.ones_like(time_s)
    return WeatherLog(
        time_s,
        SCANNER_SETTING.temperature_c * constant,
        SCANNER_SETTING.pressure_hpa * constant,
        SCANNER_SETTING.humidity_pct * constant,
    )


def _squares(size: float, half_m: float, spacing_m: float) -> dict[str, Floats]:
    """Return squares on the map, one in each `spacing_m` of the grid, as rings (n, 2)."""
    to_map = map_from_enu(Mark())
    rings: dict[str, Floats] = {}
    for north_m in np.arange(NEAREST_M * size + spacing_m / 2, (NEAREST_M + LENGTH_M) * size, spacing_m):
        for east_m in np.arange((spacing_m - WIDTH_M * size) / 2, WIDTH_M * size / 2, spacing_m):
            corner = half_m * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1)])
            east, north, _ = to_map.transform(east_m + corner[:, 0], north_m + corner[:, 1], np.zeros(5))
            rings[f"{len(rings) + 1}"] = np.stack([east, north], axis=-1)
    return rings


def _height(east_m: Floats, north_m: Floats, size: float) -> Floats:
    """Height of the ground relative to the scanner [m]: a bowl with ridges that hide what is behind."""
    east, north = east_m / (1000 * size), north_m / (1000 * size)
    bowl_m = 60 * ((east - 0.5) ** 2 + (north - 2.05) ** 2)
    ridges_m = 80 * np.sin(9 * east + 2) * np.cos(7 * north) + 20 * np.sin(31 * east) * np.sin(37 * north)
    return np.asarray(size * (bowl_m + ridges_m - SCANNER_HEIGHT_M))


def _rough(east_m: Floats, north_m: Floats) -> Floats:
    return np.asarray(ROUGH_M * np.sin(1.7 * east_m + 0.3 * north_m) * np.sin(2.3 * north_m))


def _melt(east_m: Floats, north_m: Floats, size: float, scan: int) -> Floats:
    squared = ((east_m / size) ** 2 + (north_m / size - 2000) ** 2) / 800**2
    return np.asarray(MELT_M * max(scan - REFERENCE_SCANS + 1, 0) * np.exp(-squared))


def _scan(folder: Path, scenario: Scenario, scan: int, points: int) -> Path:
    """Return the path of a scan of about `points` points, simulated unless it exists, and write its log."""
    folder = folder / str(points)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{files.stem(scenario, scan)}.laz"
    if path.exists():
        return path
    axes, start_s = motion.tilt_axes(scenario), 60.0 + scan
    log = motion.sensor_log(scenario, scan, axes, start_s)
    files.write_inclination(path.with_name(f"{path.stem}-incl.txt"), log)
    tilt = _Tilt.of_scan(scenario, scan, axes)
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
        for shot in _shots(scenario, scan, points, tilt):
            out.write_points(_record(header, shot, start_s))
    part.rename(path)
    return path


@dataclass(frozen=True)
class _Tilt:
    """Tilt of the scanner during a scan."""

    time_s: Floats  # (k,) since the start of the scan
    roll_rad: Floats  # (k,)
    pitch_rad: Floats  # (k,)

    @classmethod
    def of_scan(cls, scenario: Scenario, scan: int, axes: tuple[motion.TiltAxis, motion.TiltAxis]) -> _Tilt:
        time_s = np.arange(0.0, scenario.scan_s + 1, motion.SPACING_S)
        roll_rad, pitch_rad = (axis.tilt(scenario.scan_start_s(scan) + time_s) for axis in axes)
        return cls(time_s, roll_rad, pitch_rad)

    def to_scanner(self, xyz_m: Floats, time_s: float) -> Floats:
        """Return levelled points (3, n) of one moment in the frame of the tilted scanner."""
        roll, pitch = (
            float(np.interp(time_s, self.time_s, angle_rad)) for angle_rad in (self.roll_rad, self.pitch_rad)
        )
        return np.asarray((motion.rotation_y(pitch) @ motion.rotation_x(roll)).T @ xyz_m)


@dataclass(frozen=True)
class _Shot:
    """Echoes, in the scanner's frame."""

    x_m: Floats
    y_m: Floats
    z_m: Floats
    time_s: Floats  # since the start of the scan
    intensity: Floats
    deviation: Floats


def _record(header: laspy.LasHeader, shot: _Shot, start_s: float) -> laspy.ScaleAwarePointRecord:
    count = len(shot.x_m)
    record = laspy.ScaleAwarePointRecord.zeros(count, header=header)
    record["x"], record["y"], record["z"] = shot.x_m, shot.y_m, shot.z_m
    record["gps_time"] = start_s + shot.time_s
    record["intensity"] = np.rint(65535 * shot.intensity)
    record["return_number"] = record["number_of_returns"] = np.ones(count, np.uint8)
    range_m = np.sqrt(shot.x_m**2 + shot.y_m**2 + shot.z_m**2)
    reflectance_db = 10 * np.log10(shot.intensity)
    record["Reflectance"] = reflectance_db
    record["Amplitude"] = np.maximum(reflectance_db + 40 - range_m / 250, 0.1)
    record["Deviation"] = np.rint(shot.deviation)
    return record


def _shots(scenario: Scenario, scan: int, points: int, tilt: _Tilt) -> Iterator[_Shot]:
    """Yield a scan in blocks, line by line, each upwards at equal angles."""
    size, rng = scenario.size, rng_for(scenario.seed, 70, scan, points)
    first, last = np.radians(AZIMUTH_DEG)
    coarse = [_line(bearing, size)[0] for bearing in np.linspace(first, last, 90)]
    spans = np.array([elevation[-1] - max(elevation[0], np.radians(LOWEST_DEG)) for elevation in coarse])
    step_rad = np.sqrt(float(spans.mean()) * (last - first) * (1 - ECHO_LOSS) / points)
    lines = round((last - first) / step_rad)
    lines_per_block = round(BLOCK * lines / points)
    block: list[_Shot] = []
    for line in range(lines):
        bearing = first + (last - first) * (line + rng.uniform()) / lines
        elevation, distance_m = _line(bearing, size)
        aim = np.arange(max(elevation[0], np.radians(LOWEST_DEG)), elevation[-1], step_rad)
        share = np.arange(len(aim)) / len(aim)
        kept = rng.uniform(size=len(aim)) > ECHO_LOSS
        shot_m = np.interp(aim, elevation, distance_m)[kept]
        time_s = np.round(scenario.scan_s * (line + 0.75 * share[kept]) / lines, 7)
        block.append(_echoes(scenario, scan, bearing, shot_m, time_s, tilt, rng))
        if len(block) == lines_per_block or line == lines - 1:
            fields = ([getattr(shot, name) for shot in block] for name in _Shot.__annotations__)
            yield _Shot(*map(np.concatenate, fields))
            block = []


def _line(bearing_rad: float, size: float) -> tuple[Floats, Floats]:
    """Return elevation angle (k,), increasing, and horizontal distance (k,) of the surface along one line."""
    cos, sin = float(np.cos(bearing_rad)), float(np.sin(bearing_rad))
    edge_m = min(WIDTH_M / 2 / max(abs(cos), 1e-9), (NEAREST_M + LENGTH_M) / max(sin, 1e-9)) * size * OVERLAP
    distance_m = np.arange(NEAREST_M * size, edge_m, PROFILE_M)
    elevation = np.arctan2(_height(distance_m * cos, distance_m * sin, size), distance_m)
    return np.maximum.accumulate(elevation), distance_m


def _echoes(
    scenario: Scenario,
    scan: int,
    bearing_rad: float,
    distance_m: Floats,
    time_s: Floats,
    tilt: _Tilt,
    rng: np.random.Generator,
) -> _Shot:
    """Return the echoes of a line at horizontal distances [m], in the frame of the tilted scanner."""
    count, size = len(distance_m), scenario.size
    east_m, north_m = distance_m * np.cos(bearing_rad), distance_m * np.sin(bearing_rad)
    up_m = _height(east_m, north_m, size) + _rough(east_m, north_m) - _melt(east_m, north_m, size, scan)
    offset_m = np.stack([east_m, north_m, up_m]) - np.array(scenario.mount_position_m)[:, None]
    range_m = np.sqrt((offset_m**2).sum(axis=0))
    offset_m *= 1 + NOISE_M * rng.standard_normal(count) / range_m
    x_m, y_m, z_m = tilt.to_scanner(offset_m, float(time_s.mean()))
    albedo = 0.3 + 0.2 * np.sin(east_m / 170) * np.cos(north_m / 130)
    intensity = albedo * np.exp(-range_m / 8000) * (1 + 0.05 * rng.standard_normal(count))
    deviation = 5 + 4 * rng.standard_exponential(count)
    return _Shot(x_m, y_m, z_m, time_s, np.clip(intensity, 0.01, 1.0), deviation)
