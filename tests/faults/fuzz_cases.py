"""Mutated input, read the way the service reads it, in a process with little memory and no patience.

    python fuzz_cases.py FOLDER FIRST KIND=COUNT...

Prints a line of JSON: by kind, how many cases were accepted and refused, and what was found. A case that
hangs is ended by SIGALRM, a native crash by its own signal: `FOLDER/at.FIRST` says which it was.
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
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from station.config import read_site
from station.errors import ConfigError, ScanError
from station.quantities import Grid, HeadTrack
from station.readers.inclination import read_inclination
from station.readers.polygons import mask, read_polygons
from station.readers.scan import open_scan, utc_interval
from station.readers.sop import read_matrix
from station.readers.weather import LIMITS, air_at, read_weather
from station.science import inclination, pose
from station.sections import WeatherColumns

PATIENCE_S = 5  # for one case of a few kilobytes
MEMORY = 1 << 29  # beyond what the modules take
RANGE_M = 3000.0
NAMED = "%y%m%d_%H%M%S"
CORPUS = "corpus"
SOUND = {  # kind: file of the corpus, in the order of `write_corpus`
    "las": "250715_000000.las",
    "laz": "250715_000000.laz",
    "old_laz": "250715_010000.laz",
    "week_las": "250720_000000.las",
    "inclination": "incl.txt",
    "toa5": "weather.dat",
    "csv": "weather.csv",
    "sop": "sop.dat",
    "site": "site.toml",
    "polygons": "stable.geojson",
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


def mutated(raw, kind, dice):
    """Return bytes that are no longer what they were, most often by little."""
    raw = bytearray(raw)
    how = TEXT if kind in READ_TEXT else BINARY
    for _ in range(dice.choice((1, 1, 1, 2, 3, 8))):
        if raw:
            dice.choice(how)(raw, dice)
    return bytes(raw)


def _place(raw, dice):
    """Choose a place, the head of the file more often than the rest."""
    return dice.randrange(min(len(raw), dice.choice((240, 520, len(raw)))))


def _flip(raw, dice):
    raw[_place(raw, dice)] ^= 1 << dice.randrange(8)


def _byte(raw, dice):
    raw[_place(raw, dice)] = dice.randrange(256)


def _cut(raw, dice):
    del raw[dice.randrange(len(raw)) :]


def _drop(raw, dice):
    at = _place(raw, dice)
    del raw[at : at + dice.choice((1, 2, 8, 100, 1000))]


def _double(raw, dice):
    at = _place(raw, dice)
    raw[at:at] = raw[at : at + dice.choice((1, 4, 54, 1000))]


def _zero(raw, dice):
    """Leave a hole, as a power cut does in a file whose blocks were not yet written."""
    at = dice.randrange(len(raw))
    size = min(dice.choice((16, 512, 4096)), len(raw) - at)
    raw[at : at + size] = bytes(size)


def _number(raw, dice):
    kind = dice.choice(("<B", "<H", "<I", "<Q"))
    size = struct.calcsize(kind)
    at = _place(raw, dice)
    if at + size <= len(raw):
        struct.pack_into(kind, raw, at, dice.choice(ODD_NUMBERS) % (1 << 8 * size))


def _double_number(raw, dice):
    """Put an odd number where the header, or a point, keeps a double."""
    at = dice.choice((131, 139, 147, 155, 163, 171, 179, 187, 195, 203, 211, 219, _place(raw, dice)))
    if at + 8 <= len(raw):
        struct.pack_into("<d", raw, at, dice.choice(ODD_DOUBLES))


def _word(raw, dice):
    """Replace a word or number of a text."""
    words = list(re.finditer(rb"[^\s,=]+", raw[:20_000]))
    if words:
        start, end = dice.choice(words).span()
        raw[start:end] = dice.choice(ODD_WORDS).encode()


def _line(raw, dice):
    """Repeat, drop or move a line."""
    lines = raw.split(b"\n")
    line = lines.pop(dice.randrange(len(lines)))
    for _ in range(dice.choice((0, 1, 2, 50))):
        lines.insert(dice.randrange(len(lines) + 1), line)
    raw[:] = b"\n".join(lines)


BINARY = (_flip, _flip, _byte, _cut, _drop, _double, _zero, _number, _number, _double_number)
TEXT = (_flip, _byte, _cut, _drop, _double, _zero, _word, _word, _word, _line)


# ---- what may be accepted


def check_scan(path, dice):
    range_max_m = dice.choice((RANGE_M, None))
    pattern = "%Y" if dice.random() > 0.95 else NAMED
    with open_scan(path, range_max_m=range_max_m) as scan:
        start, end, _ = utc_interval(scan, pattern)
        blocks = list(scan.blocks(500))
        track = scan.head_track()
    assert sum(len(block) for block in blocks) == scan.header.point_count, "another count than its header's"
    slack_m = 1.0  # no scale is larger
    for block in blocks:
        points_m = block.xyz_m.T
        assert np.isfinite(points_m).all(), "points that are no numbers"
        assert (points_m >= np.array(scan.header.low_m) - slack_m).all(), "points outside of the box"
        assert (points_m <= np.array(scan.header.high_m) + slack_m).all(), "points outside of the box"
        if range_max_m is not None:
            assert np.linalg.norm(points_m, axis=1).max() <= range_max_m, "points out of range"
        assert block.time_s is None or np.isfinite(block.time_s).all(), "times that are no numbers"
    assert datetime(1999, 1, 1, tzinfo=UTC) < start <= end, "a time before there were scanners"
    if range_max_m is not None:
        assert (end - start).total_seconds() <= 86_400, "a scan longer than a day"
        if track is not None:
            assert np.isfinite(track.azimuth_rad).all(), "a head that looks nowhere"
            assert (np.diff(track.time_s) > 0).all(), "a head that goes back in time"


def check_inclination(path, _dice):
    log, _ = inclination.clean(read_inclination(path), np.radians(10.0))
    assert np.isfinite([log.time_s, log.roll_rad, log.pitch_rad]).all()
    assert (np.diff(log.time_s) > 0).all(), "times that do not increase"
    if len(log.time_s) < 20:
        return
    time_s = np.linspace(0.0, 60.0, 100)
    track = HeadTrack(time_s, np.linspace(2.6, 2.9, 100))
    zero = inclination.fit_cycle(log, track, 1.4e-4)
    lean = inclination.relative_lean(log, track, zero, 1.4e-4, None, filtered=True)
    assert np.isfinite(lean.mean_roll_rad)
    assert np.isfinite(lean.mean_pitch_rad)


def check_weather(path, dice):
    offset_h = dice.choice((0, 1, -7, 5.5))
    moment_s = datetime(2025, 7, 15, 1, tzinfo=UTC).timestamp()
    window = dice.choice((None, (moment_s - 3600, moment_s + 3600)))
    columns = COLUMNS[path.name.rpartition(".")[2]]
    log = read_weather(
        path,
        format="toa5" if path.name.endswith("dat") else "csv",
        columns=columns,
        utc_offset_h=offset_h,
        window_utc_s=window,
    )
    assert np.isfinite(log.time_utc_s).all()
    assert (np.diff(log.time_utc_s) > 0).all()
    air = air_at(log, moment_s, 3600.0)
    if air is not None:
        for value, (low, high) in zip(
            (air.temperature_c, air.pressure_hpa, air.humidity_pct), LIMITS, strict=True
        ):
            assert low <= value <= high, "air that cannot be"


def check_sop(path, _dice):
    matrix = read_matrix(path)
    assert np.isfinite(matrix).all()
    assert np.abs(matrix[:3, :3] @ matrix[:3, :3].T - np.eye(3)).max() < 1e-5, "no rotation"
    assert np.abs(matrix[:3, 3]).max() < 1e9, "beyond any map"
    pose.frame_by_origin(matrix, (46.8, 10.8, 3245.0), "EPSG:32632", RANGE_M)


def check_site(path, _dice):
    site = read_site(path)
    assert len(site.science_hash) == 16
    assert site.grid_cells.nx * site.grid_cells.ny <= 100_000_000
    told = json.dumps(site.model_dump(mode="json"))
    assert "NaN" not in told
    assert "Infinity" not in told
    for bound in site.grid.bounds_m:
        assert abs(bound[1]) < 1e9, "a grid beyond any map"


def check_polygons(path, _dice):
    grid = Grid(635300.0, 5184550.0, 25.0, 38, 18)
    for polygon in read_polygons(path, "EPSG:32632").values():
        mask(polygon, grid)


COLUMNS = {
    "dat": WeatherColumns(temperature_c="TAact_2m_Avg", humidity_pct="RHact_2m_Avg", pressure_hpa="Pact"),
    "csv": WeatherColumns(time="time", temperature_c="t", humidity_pct="rh", pressure_hpa="p"),
}
READ_TEXT = {
    "inclination": check_inclination,
    "toa5": check_weather,
    "csv": check_weather,
    "sop": check_sop,
    "site": check_site,
    "polygons": check_polygons,
}


# ---- running


def run(kind, first, count, folder, at):
    """Read `count` mutations of one kind; return what became of them."""
    whole = (folder / CORPUS / SOUND[kind]).read_bytes()
    check = READ_TEXT.get(kind, check_scan)
    path = folder / str(first) / SOUND[kind]
    told, found = Counter(), []
    check(_written(path, whole), random.Random(0))  # noqa: S311 - no secret
    for seed in range(first, first + count):
        os.pwrite(at, f"{kind} {seed} ".encode(), 0)
        dice = random.Random(f"{kind} {seed}")  # noqa: S311 - no secret
        _written(path, mutated(whole, kind, dice))
        signal.setitimer(signal.ITIMER_REAL, PATIENCE_S)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                check(path, dice)
            told["accepted"] += 1
        except (ScanError, ConfigError) as error:
            told["refused"] += 1
            if "MemoryError" in str(error) or not str(error):
                found.append(f"{kind} {seed}: refused by {error!r}")
        except BaseException as error:  # noqa: BLE001 - whatever it is, it is a find
            found.append(f"{kind} {seed}: {type(error).__name__}: {str(error)[:200]}")
        signal.setitimer(signal.ITIMER_REAL, 0)
    _written(path, whole)  # other kinds may name it
    return {**told, "found": found[:20], "finds": len(found)}


def _written(path, raw):
    path.write_bytes(raw)
    return path


if __name__ == "__main__":
    folder, first, *counts = sys.argv[1:]
    opened = os.open(Path(folder) / f"at.{first}", os.O_WRONLY | os.O_CREAT)
    limit = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (limit + MEMORY, limit + MEMORY))
    shutil.copytree(Path(folder) / CORPUS, Path(folder) / first)
    wanted = {kind: int(count) for kind, count in (one.split("=") for one in counts)}
    print(json.dumps({kind: run(kind, int(first), n, Path(folder), opened) for kind, n in wanted.items()}))
