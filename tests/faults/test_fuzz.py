"""Mutated input files: no crash, no hang, bounded memory, and nothing impossible accepted."""

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
from readers.formats import test_formats as written

WEIGHTS = {"las": 3, "laz": 4, "old_laz": 3, "week_las": 2}  # 1 for the others


@pytest.fixture(scope="session")
def corpus(tmp_path_factory):
    """Return a folder with one valid file of each kind."""
    folder = tmp_path_factory.mktemp("fuzz")
    station = harness.build(folder / "station", hours=1)
    target = folder / fuzz_cases.CORPUS
    target.mkdir()
    for name in ("sop.dat", "site.toml", "stable.geojson", "areas.geojson"):
        shutil.copy(station / name, target / name)
    shutil.copy(station / harness.PENDING / f"{harness.scan_name(0)}-incl.txt", target / "incl.txt")
    weather = (station / "weather.dat").read_text().splitlines(keepends=True)[:200]
    (target / "weather.dat").write_text("".join(weather))
    rows = [
        f"2025-07-15T0{n // 60}:{n % 60:02d}:00Z,{n / 10 - 3},{50 + n / 9},{684 + n / 50}\n"
        for n in range(180)
    ]
    (target / "weather.csv").write_text("time,t,rh,p\n" + "".join(rows))
    write_dialects(target)
    write_formats(target)
    write_scans(laspy.read(station / harness.PENDING / f"{harness.scan_name(0)}.laz"), target)
    return folder


def write_dialects(target):
    """Write weather of three hours as SMET and as the DWD does."""
    rows = [(n, n / 10 - 3, 50 + n / 9, 684 + n / 50) for n in range(180)]
    header = "SMET 1.1 ASCII\n[HEADER]\nnodata = -999\ntz = 0\nfields = timestamp TA RH P\n[DATA]\n"
    lines = [
        f"2025-07-15T0{n // 60}:{n % 60:02d}:00 {t + 273.15} {rh / 100} {p * 100}\n" for n, t, rh, p in rows
    ]
    (target / "weather.smet").write_text(header + "".join(lines))
    header = "STATIONS_ID;MESS_DATUM;  QN;PP_10;TT_10;RF_10;eor\n"
    lines = [f"3;202507150{n // 60}{n % 60:02d};3;{p:.1f};{t:.1f};{rh:.1f};eor\n" for n, t, rh, p in rows]
    (target / "weather.dwd").write_text(header + "".join(lines))


def write_formats(target):
    """Write a few points in the formats of other programs."""
    points, stem = written.Points(400), target / "250715_000000"
    written.e57_file(stem.with_suffix(".e57"), points)
    written.ply_file(stem.with_suffix(".ply"), points)
    written.pcd_file(stem.with_suffix(".pcd"), points, "BINARY_COMPRESSED")
    header = "//X Y Z Intensity GpsTime return_number number_of_returns"
    written.text_file(stem.with_suffix(".xyz"), points, header=header, fields="xyzitnc")


def write_scans(scan, target):
    """Write a few points of a scan in each point format."""
    subset = slice(0, 400)
    order = np.argsort(scan.gps_time[subset])
    for name, form, version, first_s in (
        ("250715_000000.las", 6, "1.4", 100.0),
        ("250715_000000.laz", 6, "1.4", 100.0),
        ("250715_010000.laz", 3, "1.2", 100.0),
        ("250720_000000.las", 1, "1.2", 604_790.0),  # across the end of the GPS week
        ("250715_020000.laz", 6, "1.4", 100.0),  # with roll and pitch
    ):
        header = laspy.LasHeader(point_format=form, version=version)
        tilt = ("Roll", "Pitch") if name.startswith("250715_02") else ()
        for axis in tilt:
            header.add_extra_dim(laspy.ExtraBytesParams(axis, "float32"))
        header.scales, header.offsets = [0.001] * 3, [0.0] * 3
        las = laspy.LasData(header)
        las.x, las.y, las.z = (np.asarray(axis[subset])[order] for axis in (scan.x, scan.y, scan.z))
        las.intensity = np.asarray(scan.intensity[subset])[order]
        las.gps_time = (first_s + np.linspace(0, 60, len(order))) % 604_800
        las.return_number[:] = las.number_of_returns[:] = 1
        for axis in tilt:
            las[axis] = 0.003 * (las.gps_time.astype(int) % 7)
        las.write(target / name)


def run_cases(corpus, first, counts):
    """Run cases in a separate process; return its results by kind, or how it died."""
    arguments = [f"{kind}={count}" for kind, count in counts.items()]
    result = subprocess.run(
        [sys.executable, fuzz_cases.__file__, str(corpus), str(first), *arguments],
        capture_output=True, text=True, check=False, env=harness.environment(),
    )  # fmt: skip
    if result.returncode:
        where = (corpus / f"at.{first}").read_text()
        reason = f"{where}: died ({result.returncode}): {result.stderr[-500:]}"
        return {"died": {"found": [reason], "finds": 1}}
    return json.loads(result.stdout)


def fuzz(corpus, capsys, *, rounds, each):
    """Read `each` mutations of every kind, times its weight, in each round; print the counts."""
    seed = int(os.environ.get("STATION_FAULTS_SEED", secrets.randbits(31)))
    counts = {kind: each * WEIGHTS.get(kind, 1) for kind in fuzz_cases.VALID_FILES}
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    with ThreadPoolExecutor(max_workers=min(2, rounds)) as pool:
        firsts = [seed + 100_000 * index for index in range(rounds)]
        results = list(pool.map(lambda first: run_cases(corpus, first, counts), firsts))
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    findings = [line for result in results for kind in result.values() for line in kind["found"]]
    names = ("accepted", "refused", "finds")
    sums = {
        kind: [sum(result.get(kind, {}).get(name, 0) for result in results) for name in names]
        for kind in counts
    }
    total = sum(map(sum, sums.values()))
    with capsys.disabled():
        print(f"\n  STATION_FAULTS_SEED={seed}")
        for kind, totals in sums.items():
            print(f"  {kind:12}", *(f"{name}={count}" for name, count in zip(names, totals, strict=True)))
        cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        print(f"  cases={total} cpu_s={cpu_s:.0f} found={len(findings)}")
    assert not findings, "\n".join(findings)
    assert total > sum(totals[1] for totals in sums.values()) > total / 4, "mutations change nothing or all"
    return total


@pytest.mark.integration
def test_few_mutated_files_of_every_kind(corpus, capsys):
    fuzz(corpus, capsys, rounds=1, each=20)


@pytest.mark.slow
def test_twenty_thousand_mutated_files(corpus, capsys):
    assert fuzz(corpus, capsys, rounds=12, each=100) > 20_000
