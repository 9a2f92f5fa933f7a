"""Mutated input files: no crash, no hang, bounded memory, and nothing impossible accepted."""

from __future__ import annotations

import gzip
import json
import os
import resource
import secrets
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress

import fuzz_cases
import harness
import laspy
import numpy as np
import pytest
import shapely
from readers.formats import test_formats as written
from readers.formats.test_riscan import POSITION, SOP, write_project
from readers.test_weather_dialects import LOGS
from support.effort import SHARE

from station.products.exports.copc import write_copc

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
    write_matrices(target)
    write_site(target)
    for write in (write_polygons, write_e57, write_ply, write_pcd):
        with suppress(pytest.skip.Exception):  # their libraries are extras
            write(target)
    write_text(target)
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

    for kind in ("meteoswiss", "geosphere", "davis", "hobo", "lufft"):
        (target / f"weather.{kind}").write_text(LOGS[kind][1])


def write_matrices(target):
    """Write an SOP and a project as RiSCAN does."""
    (target / "sop.xml").write_text(f"<sop><matrix rows='4' cols='4'>{SOP}</matrix></sop>")
    write_project(target, POSITION.format(name="SP1", states="", first="250701_110000", sop=SOP))


def write_site(target):
    """Write a site file with all keys on files of others."""
    text = (target / "site.toml").read_text()
    more = {
        "[scans]": 'zone = "Europe/Vienna"\nsuffix = ".xyz"\ncolumns = ["x", "y", "z", "time"]\n'
        'convert = ["cp", "{in}", "{out}"]\n',
        "[[sop]]": 'files = "*_A*"\nscanner = { model = "VZ-6000", range_sigma_m = 0.02 }\n',
        "[weather]": 'station = "JUN"\nnames = ["time", "t", "rh", "p"]\ntime_format = "unix"\n'
        'units = { temperature_c = "F", humidity_pct = "fraction", pressure_hpa = "Pa" }\n',
    }
    for table, lines in more.items():
        assert f"{table}\n" in text
        text = text.replace(f"{table}\n", f"{table}\n{lines}")
    text += '\n[epoch]\nname = "%Y%m%d_%H%M"\nfiles = 4\nwindow_s = 600\nwait_s = 10\n'
    text += (
        '[registration]\nsuffix = ".sop"\nuse = "given"\ninto = "scanner"\nsigma_m = 0.01\nsigma_deg = 0.01\n'
    )
    (target / "all_keys.toml").write_text(text)


def write_polygons(target):
    """Write two areas as GeoPackage and Shapefile."""
    pyogrio = pytest.importorskip("pyogrio")
    squares = [shapely.box(635_400 + 100 * n, 5_184_600, 635_450 + 100 * n, 5_184_700) for n in (0, 1)]
    for suffix in ("gpkg", "shp"):
        pyogrio.raw.write(
            target / f"areas.{suffix}", shapely.to_wkb(squares), [np.array(["a", "b"], object)], ["name"],
            geometry_type="Polygon", crs="EPSG:32632",
        )  # fmt: skip


def write_e57(target):
    written.e57_file(target / fuzz_cases.VALID_FILES["e57"], written.Points(400))


def write_ply(target):
    written.ply_file(target / fuzz_cases.VALID_FILES["ply"], written.Points(400))


def write_pcd(target):
    written.pcd_file(target / fuzz_cases.VALID_FILES["pcd"], written.Points(400), "BINARY_COMPRESSED")


def write_text(target):
    """Write a few points as text, with names and without."""
    header = "//X Y Z Intensity GpsTime return_number number_of_returns"
    for kind, names in (("xyz", header), ("text", "")):
        path = target / fuzz_cases.VALID_FILES[kind]
        written.text_file(path, written.Points(400), header=names, fields="xyzitnc")


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
    packed = gzip.compress((target / "250715_000000.laz").read_bytes())
    (target / "250715_030000.laz.gz").write_bytes(packed)
    las = laspy.read(target / "250715_000000.laz")
    with (target / "250715_040000.copc.laz").open("w+b") as file:
        write_copc(file, las.header, las.points.array)


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
    counts = {
        kind: each * WEIGHTS.get(kind, 1)
        for kind, name in fuzz_cases.VALID_FILES.items()
        if (corpus / fuzz_cases.CORPUS / name).exists()
    }
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
    fuzz(corpus, capsys, rounds=1, each=15)


@pytest.mark.slow
def test_thousands_of_mutated_files(corpus, capsys):
    assert fuzz(corpus, capsys, rounds=2, each=1200 // SHARE) > 40_000 / SHARE
