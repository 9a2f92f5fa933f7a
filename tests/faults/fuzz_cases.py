"""Mutated input, read as the service reads it, in a process with limited memory and time.

    python fuzz_cases.py FOLDER FIRST KIND=COUNT...

Prints a line of JSON: by kind, the numbers of accepted and rejected cases, and the findings. SIGALRM ends a
case that hangs, a native crash its own signal; `FOLDER/at.FIRST` then names the case.
"""

from __future__ import annotations

import json
import math
import os
import random
import re
import resource
import shutil
import signal
import struct
import sys
import warnings
from collections import Counter
from contextlib import suppress
from datetime import UTC, datetime
from importlib import import_module
from pathlib import Path

import numpy as np
from readers.test_weather_dialects import LOGS

from station.config import read_site
from station.errors import ConfigError, ScanError
from station.quantities import AzimuthTrack, Grid
from station.readers.formats.conversion import open_site_scan
from station.readers.formats.riscan import read_project
from station.readers.inclination import read_inclination
from station.readers.polygons import cells_inside, read_polygons
from station.readers.scan import utc_interval
from station.readers.sop import read_matrix
from station.readers.weather import VALID_RANGES, interpolate_air, read_weather
from station.science.geometry import inclination, pose
from station.science.geometry.cyclic_error import fit_cyclic_error
from station.sections.inputs import ScansSection, WeatherSection

for library in ("pye57", "pyogrio"):  # extras, whose own memory does not count
    with suppress(ImportError):
        import_module(library)

TIMEOUT_S = 5  # for one case of a few kilobytes
MEMORY_BYTES = 1 << 29  # in addition to the imported modules
RANGE_M = 3000.0
NAME_PATTERN = "%y%m%d_%H%M%S"
CORPUS = "corpus"
COLUMNS = ("x", "y", "z", "intensity", "time", "return_number", "number_of_returns")
VALID_FILES = {  # kind: file of the corpus, in the order of `write_corpus`
    "las": "250715_000000.las",
    "laz": "250715_000000.laz",
    "old_laz": "250715_010000.laz",
    "week_las": "250720_000000.las",
    "tilt_laz": "250715_020000.laz",
    "e57": "250715_000000.e57",
    "ply": "250715_000000.ply",
    "pcd": "250715_000000.pcd",
    "xyz": "250715_000000.xyz",
    "text": "250715_000000.txt",
    "gz": "250715_030000.laz.gz",
    "copc": "250715_040000.copc.laz",
    "inclination": "incl.txt",
    "toa5": "weather.dat",
    "csv": "weather.csv",
    "smet": "weather.smet",
    "dwd": "weather.dwd",
    "meteoswiss": "weather.meteoswiss",
    "geosphere": "weather.geosphere",
    "davis": "weather.davis",
    "hobo": "weather.hobo",
    "lufft": "weather.lufft",
    "sop": "sop.dat",
    "matrix": "sop.xml",
    "riscan": "project.rsp",
    "site": "site.toml",
    "site_keys": "all_keys.toml",
    "polygons": "stable.geojson",
    "gpkg": "areas.gpkg",
    "shp": "areas.shp",
}
ODD_NUMBERS = (0, 1, 2, 127, 128, 255, 256, 32767, 65535, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**64 - 1)
ODD_DOUBLES = (0.0, -0.0, 1e-300, 1e300, -1e300, 1e18, math.nan, math.inf, -math.inf, -1.0, 604_800.0, 1e9)
ODD_WORDS = (
    "nan", "inf", "-inf", "1e999", "1e300", "-1e300", "1e18", "1e9", "-1", "0", "00", "", " ", "1_0", "0x10",
    "1,5", "NAN", '"', "'", "\\", "\0", "\ufeff", "é", "\u2028", "٣", "\r", "\n", "\t", "9" * 400,
    "a" * 70_000, "[" * 2000, "{" * 300, "../../etc/passwd", "~nobody_at_all/x", "/dev/zero",
    "/dev/full", "9999-12-31", "0001-01-01", "2025-07-15 24:00:00", "-0", "true", "[]", "null", "#", "=", "e",
    "1e-320", "+", "-7999",
)  # fmt: skip


# ---- mutation


def mutate(raw, kind, rng):
    """Return a copy of the bytes with a few mutations."""
    raw = bytearray(raw)
    mutations = TEXT if kind in TEXT_CHECKS else BINARY
    for _ in range(rng.choice((1, 1, 1, 2, 3, 8))):
        if raw:
            rng.choice(mutations)(raw, rng)
    return bytes(raw)


def _position(raw, rng):
    """Draw a position, in the head of the file more often than in the rest."""
    return rng.randrange(min(len(raw), rng.choice((240, 520, len(raw)))))


def _flip(raw, rng):
    raw[_position(raw, rng)] ^= 1 << rng.randrange(8)


def _byte(raw, rng):
    raw[_position(raw, rng)] = rng.randrange(256)


def _cut(raw, rng):
    del raw[rng.randrange(len(raw)) :]


def _drop(raw, rng):
    at = _position(raw, rng)
    del raw[at : at + rng.choice((1, 2, 8, 100, 1000))]


def _double(raw, rng):
    at = _position(raw, rng)
    raw[at:at] = raw[at : at + rng.choice((1, 4, 54, 1000))]


def _zero(raw, rng):
    """Zero a block, as a power cut does in a file whose blocks were not yet written."""
    at = rng.randrange(len(raw))
    size = min(rng.choice((16, 512, 4096)), len(raw) - at)
    raw[at : at + size] = bytes(size)


def _number(raw, rng):
    kind = rng.choice(("<B", "<H", "<I", "<Q"))
    size = struct.calcsize(kind)
    at = _position(raw, rng)
    if at + size <= len(raw):
        struct.pack_into(kind, raw, at, rng.choice(ODD_NUMBERS) % (1 << 8 * size))


def _double_number(raw, rng):
    """Put an unusual number where the header or a point stores a double."""
    at = rng.choice((131, 139, 147, 155, 163, 171, 179, 187, 195, 203, 211, 219, _position(raw, rng)))
    if at + 8 <= len(raw):
        struct.pack_into("<d", raw, at, rng.choice(ODD_DOUBLES))


def _word(raw, rng):
    """Replace a word or number of a text."""
    words = list(re.finditer(rb"[^\s,=]+", raw[:20_000]))
    if words:
        start, end = rng.choice(words).span()
        raw[start:end] = rng.choice(ODD_WORDS).encode()


def _line(raw, rng):
    """Repeat, drop or move a line."""
    lines = raw.split(b"\n")
    line = lines.pop(rng.randrange(len(lines)))
    for _ in range(rng.choice((0, 1, 2, 50))):
        lines.insert(rng.randrange(len(lines) + 1), line)
    raw[:] = b"\n".join(lines)


BINARY = (_flip, _flip, _byte, _cut, _drop, _double, _zero, _number, _number, _double_number)
TEXT = (_flip, _byte, _cut, _drop, _double, _zero, _word, _word, _word, _line)


# ---- properties of accepted input


def check_scan(path, rng):
    range_max_m = rng.choice((RANGE_M, None))
    pattern = "%Y" if rng.random() > 0.95 else NAME_PATTERN
    scans = ScansSection(inbox=path.parent, columns=COLUMNS if path.suffix == ".txt" else ())
    with open_site_scan(path, scans, range_max_m=range_max_m, work_folder=path.parent) as scan:
        start, end, _ = utc_interval(scan, pattern)
        blocks = list(scan.blocks(500))
        track, log = scan.azimuth_track(), scan.inclination()
    # A flipped bit may mark a point as noise, as withheld, or as an earlier return, which is not used.
    assert 0 < sum(len(block) for block in blocks) <= scan.header.point_count, (
        "no points, or more than the header counts"
    )
    slack_m = 1.0  # no scale is larger
    for block in filter(len, blocks):
        points_m = block.xyz_m.T
        assert np.isfinite(points_m).all(), "points are not finite"
        assert (points_m >= np.array(scan.header.low_m) - slack_m).all(), "points outside the bounding box"
        assert (points_m <= np.array(scan.header.high_m) + slack_m).all(), "points outside the bounding box"
        if range_max_m is not None:
            assert np.linalg.norm(points_m, axis=1).max() <= range_max_m, "points out of range"
        assert block.time_s is None or np.isfinite(block.time_s).all(), "times are not finite"
    assert datetime(1999, 1, 1, tzinfo=UTC) < start <= end, "a time before 1999"
    if range_max_m is not None:
        assert (end - start).total_seconds() <= 86_400, "a scan longer than a day"
        if track is not None:
            assert np.isfinite(track.azimuth_rad).all(), "azimuths are not finite"
            assert (np.diff(track.time_s) > 0).all(), "times of the head do not increase"
        if log is not None:
            assert (np.diff(log.time_s) > 0).all(), "times of the points' inclination do not increase"
            cleaned, _ = inclination.clean(log, np.radians(10.0))
            assert np.isfinite([cleaned.time_s, cleaned.roll_rad, cleaned.pitch_rad]).all()


def check_inclination(path, _dice):
    log, _ = inclination.clean(read_inclination(path), np.radians(10.0))
    assert np.isfinite([log.time_s, log.roll_rad, log.pitch_rad]).all()
    assert (np.diff(log.time_s) > 0).all(), "times that do not increase"
    if len(log.time_s) < 20:
        return
    time_s = np.linspace(0.0, 60.0, 100)
    track = AzimuthTrack(time_s, np.linspace(2.6, 2.9, 100))
    zero = fit_cyclic_error(log, track, 1.4e-4)
    tilt = inclination.relative_tilt(log, track, zero, 1.4e-4, None, filtered=True)
    assert np.isfinite(tilt.mean_roll_rad)
    assert np.isfinite(tilt.mean_pitch_rad)


def check_weather(path, rng):
    offset_h = rng.choice((0, 1, -7, 5.5))
    moment_s = datetime(2025, 7, 15, 1, tzinfo=UTC).timestamp()
    window = rng.choice((None, (moment_s - 3600, moment_s + 3600)))
    settings = WEATHER[path.name.rpartition(".")[2]]
    offset_h = None if "zone" in settings else offset_h
    settings = settings | ({} if offset_h is None else {"utc_offset_h": offset_h})
    log = read_weather(WeatherSection(file=path, **settings), window)
    assert np.isfinite(log.time_utc_s).all()
    assert (np.diff(log.time_utc_s) > 0).all()
    air = interpolate_air(log, moment_s, 3600.0)
    if air is not None:
        for value, (low, high) in zip(
            (air.temperature_c, air.pressure_hpa, air.humidity_pct), VALID_RANGES, strict=True
        ):
            assert low <= value <= high, "impossible air"


def check_sop(path, _dice):
    matrix = read_matrix(path)
    assert np.isfinite(matrix).all()
    assert np.abs(matrix[:3, :3] @ matrix[:3, :3].T - np.eye(3)).max() < 1e-5, "no rotation"
    assert np.abs(matrix[:3, 3]).max() < 1e9, "beyond any map"
    pose.scanner_to_map_by_origin(matrix, (46.8, 10.8, 3245.0), "EPSG:32632", RANGE_M)


def check_riscan(path, _dice):
    project = read_project(path)
    assert project.pop is None or np.isfinite(project.pop).all()
    for position in project.positions:
        assert np.isfinite(position.sop).all()
        assert position.air is None or np.isfinite(list(vars(position.air).values())).all(), "impossible air"


def check_site(path, _dice):
    site = read_site(path)
    assert len(site.science_hash) == 16
    assert site.grid_cells.nx * site.grid_cells.ny <= 100_000_000
    text = json.dumps(site.model_dump(mode="json"))
    assert "NaN" not in text
    assert "Infinity" not in text
    for bound in site.grid.bounds_m:
        assert abs(bound[1]) < 1e9, "a grid beyond any map"


def check_polygons(path, _dice):
    grid = Grid(635300.0, 5184550.0, 25.0, 38, 18)
    for polygon in read_polygons(path, "EPSG:32632").values():
        cells_inside(polygon, grid)


WEATHER = {  # settings by suffix
    "dat": {
        "format": "toa5",
        "columns": {"temperature_c": "TAact_2m_Avg", "humidity_pct": "RHact_2m_Avg", "pressure_hpa": "Pact"},
    },
    "csv": {
        "format": "csv",
        "columns": {"time": "time", "temperature_c": "t", "humidity_pct": "rh", "pressure_hpa": "p"},
    },
    "smet": {"format": "smet"},
    "dwd": {"format": "dwd"},
    **{kind: LOGS[kind][0] for kind in ("meteoswiss", "geosphere", "davis", "hobo", "lufft")},
}
TEXT_CHECKS = {
    "inclination": check_inclination,
    "toa5": check_weather,
    "csv": check_weather,
    "smet": check_weather,
    "dwd": check_weather,
    "meteoswiss": check_weather,
    "geosphere": check_weather,
    "davis": check_weather,
    "hobo": check_weather,
    "lufft": check_weather,
    "xyz": check_scan,
    "text": check_scan,
    "sop": check_sop,
    "matrix": check_sop,
    "riscan": check_riscan,
    "site": check_site,
    "site_keys": check_site,
    "polygons": check_polygons,
}
BINARY_CHECKS = {"gpkg": check_polygons, "shp": check_polygons}


# ---- running


def run(kind, first, count, folder, at):
    """Read `count` mutations of one kind; return the numbers of outcomes and the findings."""
    valid = (folder / CORPUS / VALID_FILES[kind]).read_bytes()
    check = (TEXT_CHECKS | BINARY_CHECKS).get(kind, check_scan)
    path = folder / str(first) / VALID_FILES[kind]
    counts, findings = Counter(), []
    check(_written(path, valid), random.Random(0))  # noqa: S311 - no secret
    for seed in range(first, first + count):
        os.pwrite(at, f"{kind} {seed} ".encode(), 0)
        rng = random.Random(f"{kind} {seed}")  # noqa: S311 - no secret
        _written(path, mutate(valid, kind, rng))
        signal.setitimer(signal.ITIMER_REAL, TIMEOUT_S)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                check(path, rng)
            counts["accepted"] += 1
        except (ScanError, ConfigError) as error:
            counts["refused"] += 1
            if "MemoryError" in str(error) or not str(error):
                findings.append(f"{kind} {seed}: refused by {error!r}")
        except BaseException as error:  # noqa: BLE001 - any other exception is a finding
            findings.append(f"{kind} {seed}: {type(error).__name__}: {str(error)[:200]}")
        signal.setitimer(signal.ITIMER_REAL, 0)
    _written(path, valid)  # other kinds may refer to it
    return {**counts, "found": findings[:20], "finds": len(findings)}


def _written(path, raw):
    path.write_bytes(raw)
    return path


if __name__ == "__main__":
    folder, first, *arguments = sys.argv[1:]
    at_file = os.open(Path(folder) / f"at.{first}", os.O_WRONLY | os.O_CREAT)
    limit = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (limit + MEMORY_BYTES, limit + MEMORY_BYTES))
    shutil.copytree(Path(folder) / CORPUS, Path(folder) / first)
    counts = {kind: int(count) for kind, count in (argument.split("=") for argument in arguments)}
    print(json.dumps({kind: run(kind, int(first), n, Path(folder), at_file) for kind, n in counts.items()}))
