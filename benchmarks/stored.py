"""A store of a year: what a scan costs, reading, joining, starting the service.

python -m benchmarks.stored [--folder DIR]
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from multiprocessing.connection import Connection
from pathlib import Path

from rich.console import Console
from rich.table import Table

from benchmarks.cost import cpu_of, family, peak_of
from benchmarks.growth import (
    DISTINCT,
    FEW,
    FULL,
    SEEN,
    SMALL,
    YEAR,
    alone,
    cost,
    epoch_of,
    fill,
    forget,
    reading,
    station_of,
)
from station.archive import join, store
from station.archive.layout import Series
from station.archive.series import build_series


def joining(folder: Path) -> dict[str, float]:
    """Return how long the joining of a day takes on the full grid, and the most memory it needs."""
    series = Series(folder / "data", "hef", FULL, "EPSG:32632")
    templates = replace(series, folder=folder / "templates")
    day = datetime(2026, 7, 1, tzinfo=UTC)
    for hour in range(DISTINCT):
        store.write_epoch(templates, epoch_of(FULL, day + timedelta(hours=hour)))
    for hour in range(24):
        alone(series, store.epochs(templates)[hour % DISTINCT].path, day + timedelta(hours=hour))
    build_series(series)
    here, there = multiprocessing.get_context("spawn").Pipe()
    child = multiprocessing.get_context("spawn").Process(target=_join_once, args=(series, there))
    child.start()
    taken = here.recv()
    child.join()
    return dict(zip(("join_day_s", "join_day_cpu_s", "join_day_gb"), taken, strict=True))


def _join_once(series: Series, there: Connection) -> None:
    began_s, before_s = time.monotonic(), time.process_time()
    join.join_closed(series, datetime(2026, 7, 3, tzinfo=UTC), lambda: None)
    there.send((time.monotonic() - began_s, time.process_time() - before_s, peak_of(os.getpid())))


def starting(site_file: Path) -> dict[str, float]:
    """Return how long the service takes until it says that it runs [s], and CPU of all its processes [s].

    `cold`: the files of the store are read from the disk.
    """
    found = {}
    for state in ("cold", "warm"):
        if state == "cold":
            forget(site_file.parent)
        began_s = time.monotonic()
        command = [sys.executable, "-m", "station.cli", "run", str(site_file)]
        with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as service:
            assert service.stderr is not None  # noqa: S101 - asked for
            for line in service.stderr:
                if "service=running" in line:
                    break
            found[f"ready_{state}_s"] = time.monotonic() - began_s
            found[f"ready_{state}_cpu_s"] = cpu_of(family(service.pid))
            service.send_signal(signal.SIGTERM)
            service.communicate()
    return found


def main() -> None:
    """Print what a scan costs at few epochs and at a year of them."""
    parser = argparse.ArgumentParser(description="What a scan costs as the store grows.")
    parser.add_argument("--folder", type=Path)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as passing:
        folder = asked.folder or Path(passing)
        found = stored(folder)
    table = Table(title="Growth")
    table.add_column("figure")
    table.add_column("value", justify="right")
    for name, value in found.items():
        table.add_row(name, f"{value:.3g}")
    Console(width=100).print(table)


def stored(folder: Path) -> dict[str, float]:
    """Return what a scan costs once measured, at few epochs and a year; what reading and starting take."""
    found: dict[str, float] = {}
    for grid, seen, size in ((SMALL, SEEN, "small"), (FULL, 0.0, "full")):  # joined rasters are not read
        for word, epochs in (("few", FEW), ("year", YEAR)):
            place = folder / f"{size}-{word}"
            shutil.rmtree(place, ignore_errors=True)
            site = station_of(place, grid)
            taken = cost(site, fill(site, epochs, joined_seen=seen))
            found |= {f"{name}_{size}_{word}": value for name, value in taken.items()}
    found |= starting(folder / "small-year" / "site.toml")
    for work in (joining, reading):
        place = folder / work.__name__
        shutil.rmtree(place, ignore_errors=True)
        found |= work(place)
    return found


if __name__ == "__main__":
    main()
