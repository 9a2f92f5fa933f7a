"""Accuracy of simulated stations against their truth: one row per case, over several seeds.

python -m benchmarks.accuracy [--rows NAME …] [--seeds N] [--first SEED] [--small] [--rough]
                              [--folder DIR] [--keep | --measured] [--json FILE] [--markdown PAGE]
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path

from benchmarks import accuracy_stations  # isort: skip - sets the number of BLAS threads before numpy loads
import numpy as np

from benchmarks.accuracy_measures import (
    Records,
    StationErrors,
    common_reason,
    reason_share,
    summarise,
    verdict_shares,
)
from benchmarks.accuracy_rows import ROWS, Row
from benchmarks.accuracy_table import Figures, missed, print_tables, write_markdown

WORKERS = 2
MAX_SEED = 1000  # of measures that are looked for
Verdicts = list[tuple[str, str]]
Measures = tuple[Records, Verdicts, int]  # the last is the first scan of the figures


def main() -> None:
    """Measure the selected rows, print the tables, and write them to files if asked to."""
    options = _arguments()
    stations: dict[tuple[str, int], list[Row]] = {}
    for name in options.rows:
        for seed in _seeds(ROWS[name], options):
            stations.setdefault((ROWS[name].station, seed), []).append(ROWS[name])
    measures: dict[str, list[Measures]] = {row.name: [] for its in stations.values() for row in its}
    rows = {name: row for name, row in ROWS.items() if name in measures}
    with ProcessPoolExecutor(WORKERS, mp_context=get_context("spawn")) as pool:
        jobs = [pool.submit(measure, its, seed, options) for (_, seed), its in stations.items()]
        for job in as_completed(jobs):
            for name, its_measures in job.result().items():
                measures[name].append(its_measures)
            print(f"{sum(job.done() for job in jobs)} of {len(jobs)} stations", file=sys.stderr, flush=True)
    figures = {name: figures_of(rows[name], measures[name]) for name in rows}
    title = _title(options)
    print_tables(rows, figures, title)
    if options.json:
        options.json.write_text(json.dumps({"title": title, "rows": figures}, indent=1))
    if options.markdown:
        write_markdown(options.markdown, rows, figures, title, small=options.small)


def measure(rows: list[Row], seed: int, options: argparse.Namespace) -> dict[str, Measures]:
    """Return the measures of the rows that share a station, which is simulated unless it exists."""
    scenario = accuracy_stations.scenario_of(rows[0], seed, small=options.small, rough=options.rough)
    with tempfile.TemporaryDirectory() as temporary:
        measures = {}
        for row in rows:
            path = _measures_path(options.folder or Path(temporary), row, seed, options)
            home = path.parent
            if not ((options.keep or options.measured) and path.exists()):
                accuracy_stations.simulated(home, scenario)
                site, verdicts = accuracy_stations.processed(home, row)
                errors = StationErrors(site, home / "truth.nc", scenario.reference_scans, seed)
                np.savez_compressed(path, records=errors.records(), verdicts=np.array(verdicts))
                shutil.rmtree(site.station.data)
            with np.load(path) as stored:
                first = scenario.hours // 2 - scenario.reference_scans if row.second_half else 0
                verdicts = [(str(verdict), str(reason)) for verdict, reason in stored["verdicts"][first:]]
                measures[row.name] = stored["records"], verdicts, first
    return measures


def figures_of(row: Row, measures: list[Measures]) -> Figures:
    """Return the figures of a row from the measures of each seed."""
    records = np.concatenate([records for records, _, _ in measures])
    verdicts = [verdict for _, verdicts, _ in measures for verdict in verdicts]
    figures = summarise(records, measures[0][2]) | {
        "verdicts": verdict_shares(verdicts),
        "reason": common_reason(verdicts),
        "reason_share": reason_share(verdicts, row.reason),
    }
    return figures | {"missed": missed(row, figures)}


def _seeds(row: Row, options: argparse.Namespace) -> range | list[int]:
    """Return the seeds asked for, or those that a row has measures of."""
    if not options.measured:
        return range(options.first, options.first + options.seeds)
    return [seed for seed in range(MAX_SEED) if _measures_path(options.folder, row, seed, options).exists()]


def _measures_path(folder: Path, row: Row, seed: int, options: argparse.Namespace) -> Path:
    size = ("-small" if options.small else "") + ("-rough" if options.rough else "")
    return folder / f"{row.station}-{seed}{size}" / f"measures-{row.name}.npz"


def _title(options: argparse.Namespace) -> str:
    size = "16 scans, 10 m cells" if options.small else "28 scans, 5 m cells"
    return size + (", everything on rough rock" if options.rough else "")


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Accuracy of the station against simulated truth.")
    parser.add_argument("--rows", nargs="+", choices=list(ROWS), default=list(ROWS), metavar="NAME")
    parser.add_argument("--seeds", type=int, default=4, help="number of stations of each row")
    parser.add_argument("--first", type=int, default=1, help="the first seed")
    parser.add_argument("--small", action="store_true", help="16 scans on 10 m cells instead of 28 on 5 m")
    parser.add_argument("--rough", action="store_true", help="rough rock and wandering tilt in every row")
    parser.add_argument("--folder", type=Path, help="folder that keeps the simulated stations and measures")
    earlier = parser.add_mutually_exclusive_group()
    earlier.add_argument("--keep", action="store_true", help="use earlier measures in that folder")
    earlier.add_argument("--measured", action="store_true", help="show those only, whatever their seeds")
    parser.add_argument("--json", type=Path, help="file for the figures")
    parser.add_argument("--markdown", type=Path, help="page of the docs whose tables are replaced")
    options = parser.parse_args()
    if options.measured and not options.folder:
        parser.error("--measured needs the --folder that keeps the measures")
    return options


if __name__ == "__main__":
    main()
