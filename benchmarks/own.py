"""The station's own work on a scan, each part in a process of its own, and as the running service does it."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any
from unittest import mock

import laspy
import numpy as np

from benchmarks.cost import LASTING, cpu_of, family, peak_of, ready, run_job
from benchmarks.large import large_station
from station.config import Site, read_site
from station.errors import StoreError
from station.quantities import Shots
from station.readers.las import LasScan
from station.readers.scan import ScanReader, utc_interval
from station.service import tasks
from station.service.gather import Gathered, gather
from station.service.journal import Journal, State
from station.service.places import arrival_of
from station.service.references import build_reference

CHUNK = 1_000_000
LOOKS_S = 0.03
QUIET_S = 3.0  # without a child: nothing more comes of a scan
PATIENCE_S = 3600.0


def make(folder: str, points: int, scans: int, size: float) -> dict[str, Any]:
    """Make a station; return its site file and its scans, those of the reference first."""
    site = large_station(Path(folder), points, scans=scans, size=size)
    return {"site": str(site), "scans": [str(path) for path in sorted((site.parent / "inbox").glob("*.laz"))]}


def work(site: str, scan: str, before: str) -> dict[str, Any]:
    """Return what peers are told of a scan: the grid, and the way there as one matrix (4, 4)."""
    told = read_site(Path(site))
    grid = told.grid_cells
    with _gathered(told, scan) as (_, gathered):
        frame = gathered.pose.frame
    assert frame is not None  # noqa: S101 - the scan is in the scanner's frame
    corners_m = np.hstack([np.zeros((3, 1)), np.eye(3)])
    turned_m = frame.to_local[:3, :3] @ corners_m
    mapped_m = frame.to_map(turned_m)
    mapped_m -= np.array([[grid.west_m], [grid.north_m - grid.ny * grid.cell_m], [0.0]])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = mapped_m[:, 1:] - mapped_m[:, :1], mapped_m[:, 0]
    return {
        "scan": scan,
        "before": before,
        "matrix": matrix.tolist(),
        "cell_m": grid.cell_m,
        "nx": grid.nx,
        "ny": grid.ny,
    }


def hot(site: str, scan: str) -> dict[str, float]:
    """Lay a scan on the grid: decode, lean, SOP, air, map, residuals, sums of each cell; and no more."""
    survey = tasks.survey

    def only(*told: object) -> None:
        ready()
        survey(*told)
        raise _LaidError

    with mock.patch.object(tasks, "survey", only), suppress(_LaidError):
        epoch(site, scan)
    return {}


class _LaidError(Exception):
    """All points are on the grid."""


def chunks(site: str, scan: str) -> dict[str, float]:
    """Do the same as `hot` by the same functions, a million points at once and all of each decoded."""
    with mock.patch.object(LasScan, "blocks", lambda self, *_, **__: _millions(self.path)):
        return hot(site, scan)


def _millions(path: Path) -> Iterator[Shots]:
    with laspy.open(path, laz_backend=laspy.LazBackend.Lazrs) as scan:
        for chunk in scan.chunk_iterator(CHUNK):
            brightness = np.asarray(chunk.intensity) / 65535
            xyz_m = np.stack([np.asarray(chunk[axis]) for axis in "xyz"])
            yield Shots(xyz_m, np.asarray(chunk.gps_time), brightness)


def epoch(site: str, scan: str) -> dict[str, Any]:
    """Measure a scan and write its epoch, as a child of the service does."""
    told = read_site(Path(site))
    found = tasks.process(told, arrival_of(told, Path(scan)), _quiet)
    return {"cells": found.figures["cells"]}


def referenced(site: str, scans: list[str]) -> dict[str, str]:
    """Return a site file without adjustment, in a store of its own that has a reference of these scans."""
    path = _with(Path(site), "alone", 'method = "joint"', 'method = "none"')
    told = read_site(path)
    build_reference(told, [arrival_of(told, Path(scan)) for scan in scans], "1", _quiet)
    return {"site": str(path)}


def served(site: str, alone: str) -> dict[str, str]:
    """Return a site file with an empty inbox, in a store of its own that has the same reference."""
    path = _with(Path(site), "served", 'inbox = "inbox"', 'inbox = "arrivals"')
    shutil.rmtree(path.with_name("arrivals"), ignore_errors=True)
    path.with_name("arrivals").mkdir()
    held, data = (read_site(Path(one)).station.data for one in (alone, path))
    data.mkdir()
    for one in (*held.glob("reference*"), *held.glob(".outlook*")):
        shutil.copy2(one, data)
    shutil.copytree(held / "lean_zero", data / "lean_zero")
    return {"site": str(path)}


def serve(site: str, scans: list[str]) -> dict[str, Any]:
    """Run the service over a station that has its reference; return what each scan took."""
    told, took = read_site(Path(site)), []
    with _service(site) as service:
        _until_quiet(service, told, 0)
        for number, path in enumerate(map(Path, scans), 1):
            before_s = cpu_of(family(service.pid))
            given_s = time.monotonic() + told.scans.settle_s
            _give(path, told.scans.inbox)
            ended_s, peak_gb = _until_quiet(service, told, number)
            cpu_s = cpu_of(family(service.pid)) - before_s
            took.append({"cpu_s": cpu_s, "wall_s": ended_s - given_s, "peak_gb": peak_gb})
    return {"took": took}


@contextmanager
def _service(site: str) -> Iterator[subprocess.Popen[bytes]]:
    """Run the service, from when it is ready for scans."""
    log = Path("service.log")
    with log.open("w", encoding="utf-8") as out:
        service = subprocess.Popen([sys.executable, "-m", "station.cli", "run", site], stderr=out)
    try:
        while "service=running" not in log.read_text(encoding="utf-8"):
            if service.poll() is not None:
                raise RuntimeError(f"the service does not start: {log.read_text(encoding='utf-8')}")
            time.sleep(LOOKS_S)
        yield service
    finally:
        service.send_signal(signal.SIGTERM)
        service.wait(120)


def _with(site: Path, name: str, says: str, instead: str) -> Path:
    """Write a site file that says something else, with an empty store of its own; return it."""
    told, data = site.read_text(encoding="utf-8"), read_site(site).station.data
    path = site.with_name(f"{name}.toml")
    path.write_text(
        told.replace(f'data = "{data.name}"', f'data = "{name}"').replace(says, instead), encoding="utf-8"
    )
    shutil.rmtree(site.with_name(name), ignore_errors=True)
    return path


def epochs() -> dict[str, float]:
    """Return what the store takes, where few epochs are stored and where a year is."""
    from benchmarks.stored import stored  # noqa: PLC0415 - the other jobs do without

    return stored(Path("epochs"))


@contextmanager
def _gathered(site: Site, scan: str) -> Iterator[tuple[ScanReader, Gathered]]:
    arrival = arrival_of(site, Path(scan))
    with tasks.opened(site, arrival.path) as reader:
        start, end, _ = utc_interval(reader, site.scans.name)
        yield reader, gather(site, reader, arrival.log, start, end, keep_zero=False)


def _give(scan: Path, inbox: Path) -> None:
    """Put a scan into the inbox, its log first."""
    log = scan.with_name(f"{scan.stem}-incl.txt")
    os.link(log, inbox / log.name)
    os.link(scan, inbox / scan.name)


def _until_quiet(service: subprocess.Popen[bytes], site: Site, stored: int) -> tuple[float, float]:
    """Wait until so many scans are stored and all is still; return since when, and the peak [GB]."""
    peak_gb, busy_s = 0.0, time.monotonic()
    until_s = busy_s + PATIENCE_S
    while time.monotonic() < until_s:
        if service.poll() is not None:
            raise RuntimeError(f"the service ended with {service.returncode}")
        children = family(service.pid)[LASTING:]
        if children:
            busy_s = time.monotonic()
            peak_gb = max(peak_gb, *map(peak_of, children))
        elif time.monotonic() > busy_s + QUIET_S and _stored(site) >= stored:
            return busy_s, peak_gb
        time.sleep(LOOKS_S)
    raise RuntimeError(f"the service took more than {PATIENCE_S:g} s for a scan")


def _stored(site: Site) -> int:
    try:
        with Journal(site.station.data / "journal.sqlite", read_only=True) as journal:
            return journal.counts()[State.STORED]
    except StoreError:  # it has not begun
        return 0


def _quiet() -> None:
    """Nobody waits for progress."""


if __name__ == "__main__":
    jobs = make, work, hot, chunks, epoch, referenced, served, serve, epochs
    run_job({job.__name__: job for job in jobs})
