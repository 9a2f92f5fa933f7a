"""Jobs of the station for the cost table, each in its own process, and the running service.

`python -m benchmarks.station_jobs JOB ARGUMENTS`, as `process_cost.job_cost` runs it.
"""

from __future__ import annotations

import importlib
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any
from unittest import mock

import laspy
import numpy as np

from benchmarks.large import large_station
from benchmarks.page_cost import page, page_year
from benchmarks.process_cost import SERVICE_PROCESSES, cpu_of, end_startup, family, peak_of, run_job
from station.archive import geometry_cache
from station.config import Site, read_site
from station.errors import StoreError
from station.inbox.journal_reader import JournalReader, State
from station.processing import scan_tasks
from station.processing.pipeline import Pose
from station.processing.reference_tasks import build_reference_version
from station.processing.scans import adjusted_scan
from station.processing.scans.epoch_inputs import load_scan_inputs
from station.processing.scans.open_scans import open_scan_for
from station.processing.scans.scan_files import scan_file
from station.processing.workers.fork_server import PRELOAD
from station.quantities import Shots
from station.readers.las import LasScan
from station.science.gridding.gridder import Gridder

CHUNK_POINTS = 1_000_000
POLL_S = 0.03
IDLE_S = 3.0  # without a worker process, after which a scan is finished
TIMEOUT_S = 3600.0


def make(folder: str, points: int, scans: int, size: float) -> dict[str, Any]:
    """Simulate a station; return its site file and its scans, those of the reference first."""
    site = large_station(Path(folder), points, scans=scans, size=size)
    return {"site": str(site), "scans": [str(path) for path in sorted((site.parent / "inbox").glob("*.laz"))]}


def grid_task(site: str, scan: str, earlier_scan: str) -> dict[str, Any]:
    """Return the task of the peers for a scan: the grid, and the transformation to it as a matrix (4, 4)."""
    settings = read_site(Path(site))
    grid = settings.grid_cells
    with open_scan_for(settings, scan_file(settings, Path(scan))) as opened:
        inputs = load_scan_inputs(settings, opened, save_tilt_offset=False)
    frame = inputs.pose.frame
    assert frame is not None  # noqa: S101 - the scan is in the scanner's frame
    corners_m = np.hstack([np.zeros((3, 1)), np.eye(3)])
    map_m = np.array(frame.to_map(frame.to_local[:3, :3] @ corners_m))
    map_m -= np.array([[grid.west_m], [grid.north_m - grid.ny * grid.cell_m], [0.0]])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = map_m[:, 1:] - map_m[:, :1], map_m[:, 0]
    return {
        "scan": scan,
        "earlier_scan": earlier_scan,
        "matrix": matrix.tolist(),
        "cell_m": grid.cell_m,
        "nx": grid.nx,
        "ny": grid.ny,
    }


class _GriddedError(Exception):
    """All points are on the grid."""


def gridding(site: str, scan: str) -> dict[str, Any]:
    """Grid a scan: decode, tilt, SOP, air, map projection, residuals, sums of each cell; nothing else."""
    grid_scan = adjusted_scan.grid_scan  # type: ignore[attr-defined]

    def grid_only(
        gridder: Gridder, blocks: Iterable[Shots], pose: Pose, progress: Callable[[], None]
    ) -> None:
        end_startup()
        grid_scan(gridder, blocks, pose, progress)
        raise _GriddedError

    with mock.patch.object(adjusted_scan, "grid_scan", grid_only), suppress(_GriddedError):
        epoch(site, scan)
        raise RuntimeError("the scan was not gridded by `adjusted_scan.grid_scan`")
    return {}


def large_blocks(site: str, scan: str) -> dict[str, Any]:
    """Grid a scan by the same functions, a million points at once, with all fields decoded."""
    with mock.patch.object(LasScan, "blocks", lambda self, *_, **__: _million_points(self.path)):
        return gridding(site, scan)


def _million_points(path: Path) -> Iterator[Shots]:
    with laspy.open(path, laz_backend=laspy.LazBackend.Lazrs) as scan:
        for chunk in scan.chunk_iterator(CHUNK_POINTS):
            intensity = np.asarray(chunk.intensity) / 65535
            xyz_m = np.stack([np.asarray(chunk[axis]) for axis in "xyz"])
            yield Shots(xyz_m, np.asarray(chunk.gps_time), intensity)


def epoch(site: str, scan: str) -> dict[str, Any]:
    """Process a scan and write its epoch, as a worker process of the service does; return its counts."""
    settings = read_site(Path(site))
    result = scan_tasks.process(settings, scan_file(settings, Path(scan)), _no_progress)
    return {"cells": result.metrics["cells"], "points": result.metrics["points"], "verdict": result.verdict}


def reference(site: str, scans: list[str]) -> dict[str, Any]:
    """Build the reference of a station from scans."""
    settings = read_site(Path(site))
    build_reference_version(settings, [scan_file(settings, Path(scan)) for scan in scans], "1", _no_progress)
    return {}


def unadjusted(site: str, scans: list[str]) -> dict[str, str]:
    """Return a site file without adjustment, whose store contains a reference of these scans."""
    path = _variant(Path(site), "unadjusted", 'method = "joint"', 'method = "none"')
    reference(str(path), scans)
    return {"site": str(path)}


def service_site(site: str, referenced: str) -> dict[str, str]:
    """Return a site file with an empty inbox, whose store contains the reference of another site file."""
    path = _variant(Path(site), "service", 'inbox = "inbox"', 'inbox = "arrivals"')
    shutil.rmtree(path.with_name("arrivals"), ignore_errors=True)
    path.with_name("arrivals").mkdir()
    source, data = (read_site(Path(name)).station.data for name in (referenced, path))
    data.mkdir()
    for item in (*source.glob("reference*"), *source.glob(f"{geometry_cache.PREFIX}*")):
        (shutil.copytree if item.is_dir() else shutil.copy2)(item, data / item.name)
    shutil.copytree(source / "sop_tilt_offset", data / "sop_tilt_offset")
    return {"site": str(path)}


def service(site: str, scans: list[str]) -> dict[str, Any]:
    """Run the service on a station that has its reference; return the cost of each scan."""
    settings, costs = read_site(Path(site)), []
    with _running_service(site) as process:
        _wait_until_idle(process, settings, 0)
        for number, path in enumerate(map(Path, scans), 1):
            before_s = cpu_of(family(process.pid))
            start_s = time.monotonic() + settings.scans.settle_s
            _deliver(path, settings.scans.inbox)
            end_s, peak_gb = _wait_until_idle(process, settings, number)
            cpu_s = cpu_of(family(process.pid)) - before_s
            costs.append({"cpu_s": cpu_s, "wall_s": end_s - start_s, "peak_gb": peak_gb})
    return {"costs": costs}


def year() -> dict[str, float]:
    """Return the costs of the store with few epochs and with a year of them."""
    from benchmarks.growth import store_costs  # noqa: PLC0415 - the other jobs do not need it

    return store_costs(Path("epochs"))


@contextmanager
def _running_service(site: str) -> Iterator[subprocess.Popen[bytes]]:
    """Run the service; yield when it is ready for scans."""
    log = Path("service.log")
    with log.open("w", encoding="utf-8") as out:
        process = subprocess.Popen([sys.executable, "-m", "station", "run", site], stderr=out)
    try:
        while "service=running" not in log.read_text(encoding="utf-8"):
            if process.poll() is not None:
                raise RuntimeError(f"the service does not start: {log.read_text(encoding='utf-8')}")
            time.sleep(POLL_S)
        yield process
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait(120)


def _variant(site: Path, name: str, old: str, new: str) -> Path:
    """Return a site file with a changed setting and an empty store."""
    text, data = site.read_text(encoding="utf-8"), read_site(site).station.data
    path = site.with_name(f"{name}.toml")
    text = text.replace(f'data = "{data.name}"', f'data = "{name}"').replace(old, new)
    path.write_text(text, encoding="utf-8")
    shutil.rmtree(site.with_name(name), ignore_errors=True)
    return path


def _deliver(scan: Path, inbox: Path) -> None:
    """Put a scan into the inbox, its log first."""
    log = scan.with_name(f"{scan.stem}-incl.txt")
    os.link(log, inbox / log.name)
    os.link(scan, inbox / scan.name)


def _wait_until_idle(process: subprocess.Popen[bytes], settings: Site, stored: int) -> tuple[float, float]:
    """Wait until `stored` scans are stored and no worker runs; return the time [s] and the peak [GB].

    The time is that of the last running worker.
    """
    peak_gb, busy_s = 0.0, time.monotonic()
    deadline_s = busy_s + TIMEOUT_S
    while time.monotonic() < deadline_s:
        if process.poll() is not None:
            raise RuntimeError(f"the service ended with {process.returncode}")
        workers = family(process.pid)[SERVICE_PROCESSES:]
        if workers:
            busy_s = time.monotonic()
            peak_gb = max(peak_gb, *map(peak_of, workers))
        elif time.monotonic() > busy_s + IDLE_S and _stored_scans(settings) >= stored:
            return busy_s, peak_gb
        time.sleep(POLL_S)
    raise RuntimeError(f"the service took more than {TIMEOUT_S:g} s for a scan")


def _stored_scans(settings: Site) -> int:
    try:
        with JournalReader(settings.station.data / "journal.sqlite") as journal:
            return journal.counts()[State.STORED]
    except StoreError:  # not created yet
        return 0


def _no_progress() -> None:
    """Ignore progress."""


if __name__ == "__main__":
    for module in PRELOAD:  # as the service's workers have, before their start-up ends
        importlib.import_module(module)
    jobs: tuple[Callable[..., dict[str, Any]], ...] = (
        make, grid_task, gridding, large_blocks, epoch, reference, unadjusted, service_site, service, page,
        page_year, year,
    )  # fmt: skip
    run_job({job.__name__: job for job in jobs})
