"""Mutated files of every kind: no crash, no hang, no gigabytes, and nothing accepted that cannot be."""

from __future__ import annotations

import json
import os
import resource
import secrets
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import fuzz_cases
import harness
import laspy
import numpy as np
import pytest

WEIGHTS = {"las": 3, "laz": 4, "old_laz": 3, "week_las": 2}  # the others one each


@pytest.fixture(scope="session")
def corpus(tmp_path_factory):
    """Return a folder with one sound file of each kind."""
    folder = tmp_path_factory.mktemp("fuzz")
    station = harness.build(folder / "station", hours=1)
    place = folder / fuzz_cases.CORPUS
    place.mkdir()
    for name in ("sop.dat", "site.toml", "stable.geojson", "areas.geojson"):
        shutil.copy(station / name, place / name)
    shutil.copy(station / harness.LATER / f"{harness.stem(0)}-incl.txt", place / "incl.txt")
    weather = (station / "weather.dat").read_text().splitlines(keepends=True)[:200]
    (place / "weather.dat").write_text("".join(weather))
    rows = [
        f"2025-07-15T0{n // 60}:{n % 60:02d}:00Z,{n / 10 - 3},{50 + n / 9},{684 + n / 50}\n"
        for n in range(180)
    ]
    (place / "weather.csv").write_text("time,t,rh,p\n" + "".join(rows))
    write_scans(laspy.read(station / harness.LATER / f"{harness.stem(0)}.laz"), place)
    return folder


def write_scans(scan, place):
    """Write a few points of a scan as each kind of file."""
    few = slice(0, 400)
    order = np.argsort(scan.gps_time[few])
    for name, form, version, first_s in (
        ("250715_000000.las", 6, "1.4", 100.0),
        ("250715_000000.laz", 6, "1.4", 100.0),
        ("250715_010000.laz", 3, "1.2", 100.0),
        ("250720_000000.las", 1, "1.2", 604_790.0),  # across the end of the GPS week
    ):
        header = laspy.LasHeader(point_format=form, version=version)
        header.scales, header.offsets = [0.001] * 3, [0.0] * 3
        made = laspy.LasData(header)
        made.x, made.y, made.z = (np.asarray(axis[few])[order] for axis in (scan.x, scan.y, scan.z))
        made.intensity = np.asarray(scan.intensity[few])[order]
        made.gps_time = (first_s + np.linspace(0, 60, len(order))) % 604_800
        made.return_number[:] = made.number_of_returns[:] = 1
        made.write(place / name)


def cases(corpus, first, wanted):
    """Run cases in a process of their own; return by kind what it told, or how it died."""
    counts = [f"{kind}={count}" for kind, count in wanted.items()]
    done = subprocess.run(
        [sys.executable, fuzz_cases.__file__, str(corpus), str(first), *counts],
        capture_output=True, text=True, check=False, env=harness.environment(),
    )  # fmt: skip
    if done.returncode:
        where = (corpus / f"at.{first}").read_text()
        return {"died": {"found": [f"{where}: died ({done.returncode}): {done.stderr[-500:]}"], "finds": 1}}
    return json.loads(done.stdout)


def fuzz(corpus, capsys, *, rounds, each):
    """Read so many mutations of every kind, times its weight, so many times; say what became of them."""
    seed = int(os.environ.get("STATION_FAULTS_SEED", secrets.randbits(31)))
    wanted = {kind: each * WEIGHTS.get(kind, 1) for kind in fuzz_cases.SOUND}
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    with ThreadPoolExecutor(max_workers=min(2, rounds)) as pool:
        firsts = [seed + 100_000 * number for number in range(rounds)]
        told = list(pool.map(lambda first: cases(corpus, first, wanted), firsts))
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    found = [line for part in told for one in part.values() for line in one["found"]]
    names = ("accepted", "refused", "finds")
    sums = {
        kind: [sum(part.get(kind, {}).get(name, 0) for part in told) for name in names] for kind in wanted
    }
    total = sum(map(sum, sums.values()))
    with capsys.disabled():
        print(f"\n  STATION_FAULTS_SEED={seed}")
        for kind, counts in sums.items():
            print(f"  {kind:12}", *(f"{name}={count}" for name, count in zip(names, counts, strict=True)))
        cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        print(f"  cases={total} cpu_s={cpu_s:.0f} found={len(found)}")
    assert not found, "\n".join(found)
    assert total > sum(counts[1] for counts in sums.values()) > total / 4, "mutations of nothing, or of all"
    return total


def test_a_few_mutated_files_of_every_kind(corpus, capsys):
    fuzz(corpus, capsys, rounds=1, each=20)


@pytest.mark.slow
def test_twenty_thousand_mutated_files(corpus, capsys):
    assert fuzz(corpus, capsys, rounds=12, each=100) > 20_000
