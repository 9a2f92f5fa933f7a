import os
import re
import resource
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.cost import Cost, FailedError, cost_of, job_cost, middle
from benchmarks.peers import Peer, Work, take
from benchmarks.ratios import Row

ROOT = Path(__file__).parents[1]
BURN = """
import os, resource, subprocess, sys
held = bytearray(300_000_000)
for at in range(0, len(held), 4096):
    held[at] = 1
subprocess.run([sys.executable, "-c", "sum(range(20_000_000))"], check=True)
used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
print(sum(one.ru_utime + one.ru_stime for one in used))
"""


def test_the_cost_of_a_program_is_what_it_says_itself_with_its_children(tmp_path):
    cost, said = cost_of([sys.executable, "-c", BURN], tmp_path)
    assert cost.cpu_s == pytest.approx(float(said), abs=0.05)
    assert 0.3 < cost.peak_gb < 0.4 or resource.getrusage(resource.RUSAGE_SELF).ru_maxrss > 3e5
    assert cost.wall_s > 0.9 * cost.cpu_s


def test_a_program_that_fails_is_told_with_its_last_words(tmp_path):
    with pytest.raises(FailedError, match=r"exit status 3: no such scan"):
        cost_of([sys.executable, "-c", "import sys; print('no such scan'); sys.exit(3)"], tmp_path)


def test_start_up_is_taken_off(tmp_path):
    laspy, numpy = pytest.importorskip("laspy"), pytest.importorskip("numpy")
    path = tmp_path / "one.laz"
    las = laspy.LasData(laspy.LasHeader(point_format=6, version="1.4"))
    las.x = numpy.arange(10.0)
    las.write(path)
    cost, figures = job_cost("benchmarks.peerwork", "decode", tmp_path, scan=str(path))
    assert figures == {"points": 10}
    assert cost.cpu_s < cost.startup_s


def test_ratios_are_to_the_base_and_say_what_is_missed():
    floor = middle([Cost(4.0, 8.0, 0.1), Cost(5.0, 5.0, 0.2), Cost(9.0, 4.0, 0.3)])
    assert floor == Cost(5.0, 5.0, 0.2)
    row = Row("one", Cost(9.0, 10.0, 0.8), floor, {"cpu": 2.0, "wall": 1.6, "peak_gb": 0.9})
    assert row.figures == {"cpu_s": 9.0, "wall_s": 10.0, "peak_gb": 0.8, "cpu": 1.8, "wall": 2.0}
    assert row.missed == ["wall"]
    assert Row("none", None, must={"cpu": 2.0}).missed == []


def test_a_peer_that_is_not_installed_is_not_there():
    assert not Peer("x", "X", "no-such-program", "", is_program=True).is_there
    assert not Peer("x", "X", "no_such_module", "").is_there
    assert Peer("x", "X", "scipy", "").is_there


@pytest.fixture(scope="module")
def quick(tmp_path_factory):
    folder = tmp_path_factory.mktemp("quick")
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks", "--quick", "--folder", str(folder)],
        cwd=ROOT, capture_output=True, text=True, check=False, env=os.environ | {"COLUMNS": "200"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return folder, done.stdout


@pytest.mark.slow
def test_the_quick_benchmark_prints_its_rows_and_right_ratios(quick):
    rows = {}
    for line in quick[1].splitlines():
        title, *cells = (cell.strip() for cell in re.split("[│┃]", line)[1:-1]) if "│" in line else [""]
        if title:
            rows[title] = cells
    floor_s = float(rows["laspy + lazrs, one thread"][0])
    for title in ("station, on the grid", "station, epoch written", "station, running service"):
        cpu_s, ratio = map(float, rows[title][:2])
        assert ratio == pytest.approx(cpu_s / floor_s, rel=0.01 / floor_s)
    for title in ("scipy binned_statistic_2d", "datashader", "PDAL", "CloudCompare", "py4dgeo M3C2"):
        assert rows[title][0] or rows[title][-1] == "not installed"
    assert {"50 x 62", "200 x 250", "0.004 million", "0.08 million", "station --help"} <= set(rows)


@pytest.mark.slow
def test_scipy_fills_the_cells_that_the_station_fills(quick):
    folder = quick[0]
    site = next(folder.glob("40000-0.05/alone.toml"))
    scan, before = sorted((site.parent / "inbox").glob("*.laz"))[2::-2]
    told = {"site": str(site), "scan": str(scan)}
    _, work = job_cost("benchmarks.own", "work", folder, before=str(before), **told)
    _, theirs = take(Peer("scipy", "", "scipy", ""), Work(**work), folder)
    _, ours = job_cost("benchmarks.own", "epoch", folder, **told)
    assert theirs["cells"] == pytest.approx(ours["cells"], rel=0.01)
