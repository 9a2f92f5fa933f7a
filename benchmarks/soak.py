"""Endurance of the service: thousands of small scans through one process, memory and time per scan.

python -m benchmarks.soak [--scans N] [--folder DIR]
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.process_cost import SERVICE_PROCESSES, cpu_of, family
from station.config import Site, read_site
from station.errors import StoreError
from station.inbox.journal_reader import JournalReader, State
from station.simulation.files import NAME_FORMAT
from station.simulation.scenario import small
from station.simulation.station import simulate

SIMULATED = 6
START = datetime(2025, 7, 16, tzinfo=UTC)
SOFTWARE_OFFSET, SOFTWARE_LENGTH = 58, 32  # of the generating software in the header of a LAS file
MAX_WAITING = 20  # scans in the inbox
POLL_S = 0.5
PARTS = 4  # of the run, which are compared


@dataclass(frozen=True)
class Sample:
    """State of the service at one moment."""

    time_s: float
    stored: int
    memory_mb: float  # resident, of the service and its fork server
    cpu_s: float  # of these and of all ended worker processes


def main() -> None:
    """Run the service over the scans and print cost and memory by part of the run."""
    parser = argparse.ArgumentParser(description="Thousands of small scans through one service.")
    parser.add_argument("--scans", type=int, default=2000)
    parser.add_argument("--folder", type=Path)
    options = parser.parse_args()
    signal.signal(signal.SIGINT, signal.default_int_handler)  # shells start background jobs with it ignored
    with tempfile.TemporaryDirectory() as temporary:
        samples, counts = soak(options.folder or Path(temporary), options.scans)
    _show(samples, counts)


def soak(folder: Path, scans: int) -> tuple[list[Sample], dict[str, int]]:
    """Feed a service scan by scan; return samples of its state, and the number of scans by final state.

    Ctrl-C ends it early.
    """
    scenario = replace(
        small(SIMULATED), lines=60, shots_per_line=60, cell_m=20.0, reference_scans=2, melt_m_per_h=0.0
    )
    simulate(folder, replace(scenario, avalanche_m=0.0))
    site_file = folder / "site.toml"
    text = site_file.read_text().replace("settle_s = 2 ", "settle_s = 0.1 ")
    site_file.write_text(re.sub(r"\[weather\].*?(?=^\[)", "", text, flags=re.DOTALL | re.MULTILINE))
    site = read_site(site_file)
    (folder / "inbox").rename(folder / "simulated")
    site.scans.inbox.mkdir()
    simulated = sorted((folder / "simulated").glob("*.laz"))
    for path in (folder / "simulated").glob(f"{simulated[0].stem}*"):  # the scan of the SOP
        shutil.copy(path, site.scans.inbox)
    service = subprocess.Popen(
        [sys.executable, "-m", "station", "run", str(site_file)],
        stderr=(folder / "log").open("w", encoding="utf-8"),
    )
    samples: list[Sample] = []
    delivered = 0
    try:
        while not samples or samples[-1].stored < scans:
            if service.poll() is not None:
                raise RuntimeError(f"the service ended with {service.returncode}: {folder / 'log'}")
            counts = _counts(site)
            done = counts[State.STORED] + counts[State.SET_ASIDE]
            while delivered < min(scans, done + MAX_WAITING):
                _deliver(
                    simulated[delivered % len(simulated)],
                    START + timedelta(hours=delivered),
                    site.scans.inbox,
                )
                delivered += 1
            samples.append(_sample(service.pid, done))
            time.sleep(POLL_S)
    except KeyboardInterrupt:  # the samples so far are reported
        pass
    finally:
        service.send_signal(signal.SIGTERM)
        service.wait(120)
    return samples, _counts(site)


def _deliver(scan: Path, start: datetime, inbox: Path) -> None:
    """Put a scan with its log into the inbox under another time, with different bytes."""
    name = start.strftime(NAME_FORMAT)
    content = bytearray(scan.read_bytes())
    content[SOFTWARE_OFFSET : SOFTWARE_OFFSET + SOFTWARE_LENGTH] = name.encode().ljust(SOFTWARE_LENGTH, b"\0")
    (inbox / f"{name}-incl.txt").write_bytes(scan.with_name(f"{scan.stem}-incl.txt").read_bytes())
    (inbox / f".{name}").write_bytes(content)
    (inbox / f".{name}").rename(inbox / f"{name}.laz")


def _counts(site: Site) -> dict[str, int]:
    try:
        with JournalReader(site.station.data / "journal.sqlite") as journal:
            return journal.counts()
    except StoreError:  # not created yet
        return dict.fromkeys((state.value for state in State), 0)


def _sample(pid: int, stored: int) -> Sample:
    """Return the state of the service and of its fork server."""
    pids = family(pid)[:SERVICE_PROCESSES]  # without worker processes
    pages = sum(int(Path(f"/proc/{process}/statm").read_text().split()[1]) for process in pids)
    return Sample(
        time.monotonic(),
        stored,
        pages * os.sysconf("SC_PAGE_SIZE") / 1e6,
        cpu_of(pids),
    )


def _show(samples: list[Sample], counts: dict[str, int]) -> None:
    """Print cost and memory of each part of the run, relative to the second."""
    stored = np.array([sample.stored for sample in samples])
    table = Table(title=f"Soak: {counts}", caption="ratios are to the second part of the run")
    for name in (
        "scans",
        "CPU-s per scan",
        "ratio",
        "seconds per scan",
        "memory of the service, MB",
        "ratio ",
    ):
        table.add_column(name, justify="right")
    rows = []
    for part in range(PARTS):
        first, last = (np.searchsorted(stored, stored[-1] * p / PARTS) for p in (part, part + 1))
        last = min(last, len(samples) - 1)
        begin, end = samples[first], samples[last]
        count = max(end.stored - begin.stored, 1)
        memory_mb = float(np.median([sample.memory_mb for sample in samples[first : last + 1]]))
        rows.append(
            (
                f"{begin.stored}-{end.stored}",
                (end.cpu_s - begin.cpu_s) / count,
                (end.time_s - begin.time_s) / count,
                memory_mb,
            )
        )
    for scans, cpu_s, wall_s, memory_mb in rows:
        table.add_row(
            scans,
            f"{cpu_s:.3f}",
            f"{cpu_s / rows[1][1]:.2f}",
            f"{wall_s:.2f}",
            f"{memory_mb:.0f}",
            f"{memory_mb / rows[1][3]:.2f}",
        )
    Console(width=100).print(table)


if __name__ == "__main__":
    main()
