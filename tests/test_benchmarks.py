import os
import re
import resource
import subprocess
import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from benchmarks import event_stations, events, level_seasons
from benchmarks.accuracy_measures import RECORD, SCALES, summarise
from benchmarks.accuracy_rows import ROWS
from benchmarks.accuracy_table import missed, write_markdown
from benchmarks.levels import measure
from benchmarks.markdown_tables import marks
from benchmarks.page_cost import kept_hours
from benchmarks.peers import GridTask, Peer, peer_cost
from benchmarks.process_cost import Cost, FailedError, Row, cost_of, job_cost, median_cost

ROOT = Path(__file__).parents[1]
WORK = """
import os, resource, subprocess, sys
memory = bytearray(300_000_000)
for offset in range(0, len(memory), 4096):
    memory[offset] = 1
subprocess.run([sys.executable, "-c", "sum(range(20_000_000))"], check=True)
for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN):
    usage = resource.getrusage(who)
    print(usage.ru_utime + usage.ru_stime)
"""


@pytest.mark.integration
def test_cost_of_a_program_includes_its_children(tmp_path):
    cost, output = cost_of([sys.executable, "-c", WORK], tmp_path)
    own_s, children_s = map(float, output.split())  # before the exit, which frees the memory
    assert own_s + children_s <= cost.cpu_s + 0.01 < own_s + 1.5 * children_s
    assert 0.3 < cost.peak_gb < 0.4 or resource.getrusage(resource.RUSAGE_SELF).ru_maxrss > 3e5
    assert cost.wall_s > 0.9 * cost.cpu_s


def test_error_of_a_failed_program_contains_its_last_line(tmp_path):
    with pytest.raises(FailedError, match=r"exit status 3: no such scan"):
        cost_of([sys.executable, "-c", "import sys; print('no such scan'); sys.exit(3)"], tmp_path)


@pytest.mark.integration
def test_cost_of_a_job_excludes_start_up(tmp_path):
    laspy, numpy = pytest.importorskip("laspy"), pytest.importorskip("numpy")
    path = tmp_path / "scan.laz"
    las = laspy.LasData(laspy.LasHeader(point_format=6, version="1.4"))
    las.x = numpy.arange(10.0)
    las.write(path)
    cost, result = job_cost("benchmarks.peers", "decode", tmp_path, scan=str(path))
    assert result == {"points": 10}
    assert cost.cpu_s < cost.startup_s
    assert 0.01 < cost.peak_gb < 0.2  # of the job alone, however large this process is


def test_row_has_ratios_to_its_base_and_names_exceeded_limits():
    base = median_cost([Cost(4.0, 8.0, 0.1), Cost(5.0, 5.0, 0.2), Cost(9.0, 4.0, 0.3)])
    assert base == Cost(5.0, 5.0, 0.2)
    row = Row("station", Cost(9.0, 10.0, 0.8), base, {"cpu": 2.0, "wall": 1.6, "peak_gb": 0.9})
    assert row.figures == {"cpu_s": 9.0, "wall_s": 10.0, "peak_gb": 0.8, "cpu": 1.8, "wall": 2.0}
    assert row.exceeded == ["wall"]
    assert row.cells()[-2] == "CPU × 2: met, wall × 1.6: missed, 0.90 GB: met"
    assert Row("not installed", None, limits={"cpu": 2.0}).exceeded == []


def test_a_year_of_hourly_scans_leaves_hours_days_and_months():
    kept = kept_hours(datetime(2025, 7, 15, 3, tzinfo=UTC), 365)
    assert kept[-72:] == [kept[-1] - timedelta(hours=back) for back in range(71, -1, -1)]  # three days
    assert [start.day for start in kept[:11]] == [
        31,
        31,
        30,
        31,
        30,
        31,
        31,
        28,
        31,
        30,
        15,
    ]  # then days
    assert kept[11:-72] == [datetime(2026, 5, 16, 23, tzinfo=UTC) + timedelta(days=day) for day in range(58)]
    assert kept[-1] == datetime(2026, 7, 15, 23, tzinfo=UTC)


def test_peers_without_their_program_are_not_installed():
    assert not Peer("x", "X", "no-such-program", "", is_command=True).is_installed
    assert not Peer("x", "X", "no_such_module", "").is_installed
    assert Peer("x", "X", "scipy", "").is_installed


@pytest.fixture(scope="module")
def quick(tmp_path_factory):
    """Folder and output of a quick run of the benchmark."""
    folder = tmp_path_factory.mktemp("quick")
    process = subprocess.run(
        [sys.executable, "-m", "benchmarks", "--quick", "--folder", str(folder)],
        cwd=ROOT, capture_output=True, text=True, check=False, env=os.environ | {"COLUMNS": "200"},
    )  # fmt: skip
    assert process.returncode == 0, process.stderr
    return folder, process.stdout


@pytest.mark.slow
def test_quick_benchmark_prints_all_rows_with_correct_ratios(quick):
    rows = {}
    for line in quick[1].splitlines():
        title, *cells = (cell.strip() for cell in re.split("[│┃]", line)[1:-1]) if "│" in line else [""]
        if title:
            rows[title] = cells
    base_s = float(rows["laspy + lazrs, one thread"][0])
    cpu_s, ratio = map(float, rows["station, running service"][:2])
    assert (cpu_s - 0.005) / (base_s + 0.005) - 0.005 <= ratio <= (cpu_s + 0.005) / (base_s - 0.005) + 0.005
    assert all(float(cell) > 0 for cell in rows["station, page alone, mean of a day"][:2])
    assert rows["its folder after a year"][5]  # GB on the disk
    for title in ("station, on the grid", "station, epoch written"):  # beside their own decodes, not printed
        assert all(float(cell) > 0 for cell in rows[title][:2])
    for title in ("scipy binned_statistic_2d", "datashader", "PDAL", "CloudCompare", "py4dgeo M3C2"):
        assert rows[title][0] or rows[title][-1] == "not installed"
    assert {"50 x 62", "200 x 250", "0.004 million", "0.08 million", "station --help"} <= set(rows)


@pytest.mark.slow
def test_scipy_fills_as_many_cells_as_the_station(quick):
    folder = quick[0]
    site = next(folder.glob("40000-0.05/unadjusted.toml"))
    scan, earlier_scan = sorted((site.parent / "inbox").glob("*.laz"))[2::-2]
    arguments = {"site": str(site), "scan": str(scan)}
    _, task = job_cost(
        "benchmarks.station_jobs", "grid_task", folder, earlier_scan=str(earlier_scan), **arguments
    )
    _, by_scipy = peer_cost(Peer("scipy", "", "scipy", ""), GridTask(**task), folder)
    _, by_station = job_cost("benchmarks.station_jobs", "epoch", folder, **arguments)
    assert by_scipy["cells"] == pytest.approx(by_station["cells"], rel=0.01)


def records_of(factor, true_m, retained=1.0):
    """Return records of four stations with normal errors, `factor` times as large as stated."""
    rng = np.random.default_rng(1)
    parts = []
    for scale, count in zip(SCALES, (2000, 40, 40, 1), strict=True):
        for seed, scan, other in np.ndindex(4, 20, 2):
            part = np.zeros(count, RECORD)
            part["scale"], part["seed"], part["scan"], part["other"] = scale, seed, scan, other - 1
            part["sigma_m"] = 0.01
            part["true_m"] = true_m * scan
            part["error_m"] = factor * rng.normal(0, 0.01, count) + (retained - 1) * part["true_m"]
            part["range_m"] = rng.uniform(200, 3500, count)
            part["points"], part["significant"] = 2, np.abs(part["error_m"]) > 0.0196
            parts.append(part)
    return np.concatenate(parts)


def figures_of_row(records, good=1.0, reason_share=1.0):
    verdicts = {"good": good, "degraded": 1 - good, "unusable": 0.0}
    return summarise(records, 0) | {"verdicts": verdicts, "reason": "", "reason_share": reason_share}


def test_accuracy_figures_are_those_of_the_simulated_errors():
    figures = figures_of_row(records_of(1.0, 0.0))
    assert figures["box_rms_m"] == pytest.approx(0.01, rel=0.05)
    assert figures["box_95_m"] == pytest.approx(0.0196, rel=0.05)
    assert [*figures["z"].values()] == pytest.approx([1.0] * 4, abs=0.2)
    assert [*figures["z_pairs"].values()] == pytest.approx([1.0] * 3, abs=0.2)
    assert figures["inside_95"] == pytest.approx(0.95, abs=0.01)
    assert figures["significant"] == pytest.approx(0.05, abs=0.01)
    assert missed(ROWS["rough"], figures) == []
    retained = summarise(records_of(1.0, 0.01, 0.6), 0)["retained"]
    assert [*retained.values()] == pytest.approx([0.6] * 3, abs=0.02)
    assert np.isnan(figures["retained"]["100 m"])


@pytest.mark.parametrize("factor", [1.3, 1 / 1.35])
@pytest.mark.integration
def test_accuracy_row_misses_its_limits_if_sigma_is_wrong_by_a_third(factor):
    found = missed(ROWS["rough"], figures_of_row(records_of(factor, 0.0), good=0.9))
    assert {"z cell", "z 10 m", "z 100 m", "z cell 1.5-2.5 km", "significant", "good"} <= set(found)
    assert missed(ROWS["snow-no-brightness"], figures_of_row(records_of(1.0, 0.0), reason_share=0.5)) == [
        "reason"
    ]


def test_change_that_is_taken_for_motion_misses_the_limits_unless_sigma_covers_it():
    figures = figures_of_row(records_of(1.0, 0.01, 0.6))
    assert {"retained", "sign", "z area"} <= set(missed(ROWS["settling"], figures))
    figures["z"]["area"], figures["sign_chance"] = 1.0, 1.0
    assert "retained" not in missed(ROWS["settling"], figures)


@pytest.mark.parametrize("small", [False, True])
def test_accuracy_tables_replace_those_of_a_page(tmp_path, small):
    page = tmp_path / "accuracy.md"
    begin, end = marks("accuracy --small" if small else "accuracy")
    page.write_text(f"before\n\n{begin}\n\nold\n\n{end}\n\nafter\n")
    figures = {"rough": figures_of_row(records_of(1.0, 0.0))}
    for _ in range(2):  # the second time replaces the tables of the first
        write_markdown(page, ROWS, figures, "28 scans", small=small)
    text = page.read_text()
    assert text.startswith(f"before\n\n{begin}\n\n28 scans:\n\n| case |")
    assert text.endswith(f"|\n\n{end}\n\nafter\n")
    row = r"\| rough: rough valley, rock all round \| 0\.010 / 0\.0(19|20) \| 0\.015 / 0\.03 \("
    assert len(re.findall(row, text)) == 1
    assert "old" not in text


def test_scores_of_event_stations_make_a_row_and_a_sum():
    found = event_stations.Score(late=[0, None, 2], z=[1.0, -1.0], sigma_m3=[20.0, 20.0], scans=16)
    snow = event_stations.Score(
        late=[0], z=[2.0], sigma_m3=[40.0], false=1, widespread=["snowfall"] * 2, scans=16
    )
    assert found.cells(quiet=False) == ("1 of 3", "1", "1.00, 20 m³", "0 in 16 scans", "none")
    assert (found + snow).cells(quiet=False) == (
        "2 of 4", "1", "1.41, 28 m³", "1 in 32 scans", "2 snowfall",
    )  # fmt: skip
    quiet = event_stations.Score(scans=40, largest_z=4.26) + event_stations.Score(scans=40)
    assert quiet.cells(quiet=True) == ("80", "0", "4.3", "none")
    assert event_stations.Score().cells(quiet=True) == ("0", "0", "below 3", "none")


def test_quiet_stations_have_no_event():
    for case in event_stations.QUIET_CASES:
        scenario = event_stations.scenario_of(case, 3, quiet=True)
        assert scenario.scans in {57, 56}
        assert not scenario.deposits
        assert scenario.rockfall_m == 0


@pytest.mark.integration
def test_filter_of_levels_is_as_good_as_a_plain_one_and_keeps_steps():
    quiet, avalanche = (
        {
            method: measure((method, kind, 100, 6))["level [mm]"]
            for method in ("single scans", "plain Kalman", "station")
        }
        for kind in ("quiet", "avalanche")
    )
    assert quiet["station"] < 1.1 * quiet["plain Kalman"]
    assert quiet["station"] < quiet["single scans"] / 3
    assert avalanche["station"] < avalanche["plain Kalman"] / 2  # the first scan shows it to neither


@pytest.mark.integration
def test_a_season_of_melt_makes_a_row_of_the_table_of_levels():
    kind, levels, rates, _, _ = level_seasons.row("melt", range(1, 2), 1.0)
    z = [float(value) for value in f"{levels} / {rates}".split(" / ")]
    assert kind == "melt"
    assert len(z) == 6
    assert 0.5 < min(z) < max(z) < 1.6  # one season


@pytest.mark.integration
def test_events_of_the_table_are_found_by_the_station_and_none_in_a_quiet_series():
    total = events.Score()
    for seed, area_m2 in ((1, 1000), (2, 0)):
        series = events.simulate(seed, 60, 36, area_m2)
        events.score(series, events.station_objects(series), total, 1)
    assert (total.found, total.events, total.false_alarms, total.hours) == (1, 1, 0, 72)
