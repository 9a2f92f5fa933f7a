"""Thousands of small scans through one service process: neither memory nor time per scan may grow.

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

from benchmarks.cost import LASTING, cpu_of, family
from station.config import Site, read_site
from station.errors import StoreError
from station.service.journal import Journal, State
from station.simulation.files import NAME
from station.simulation.scenario import tiny
from station.simulation.station import simulate

SIMULATED = 6
START = datetime(2025, 7, 16, tzinfo=UTC)
SOFTWARE_AT, SOFTWARE_LENGTH = 58, 32  # of the generating software, in the header of a LAS file
AHEAD = 20  # scans that wait in the inbox at most
LOOKS_S = 0.5
PARTS = 4  # of the run, that are set against each other


@dataclass(frozen=True)
class Sample:
    """The service at one moment."""

    at_s: float
    stored: int
    memory_mb: float  # resident, of the service and its fork server
    cpu_s: float  # of these and of all children they have waited for


def main() -> None:
    """Run the soak and print what grew."""
    parser = argparse.ArgumentParser(description="A soak of one service process.")
    parser.add_argument("--scans", type=int, default=2000)
    parser.add_argument("--folder", type=Path)
    asked = parser.parse_args()
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell has its background jobs ignore it
    with tempfile.TemporaryDirectory() as passing:
        samples, counts = soak(asked.folder or Path(passing), asked.scans)
    _show(samples, counts)


def soak(folder: Path, scans: int) -> tuple[list[Sample], dict[str, int]]:
    """Feed a service scan by scan; return samples on the way and how many scans ended where.

    Ctrl-C ends it early.
    """
    few = replace(
        tiny(SIMULATED), lines=60, shots_per_line=60, cell_m=20.0, reference_scans=2, melt_m_per_h=0.0
    )
    simulate(folder, replace(few, avalanche_m=0.0))
    site_file = folder / "site.toml"
    told = site_file.read_text().replace("settle_s = 2 ", "settle_s = 0.1 ")
    site_file.write_text(re.sub(r"\[weather\].*?(?=^\[)", "", told, flags=re.DOTALL | re.MULTILINE))
    site = read_site(site_file)
    (folder / "inbox").rename(folder / "made")
    site.scans.inbox.mkdir()
    made = sorted((folder / "made").glob("*.laz"))
    for path in (folder / "made").glob(f"{made[0].stem}*"):  # that of the SOP
        shutil.copy(path, site.scans.inbox)
    service = subprocess.Popen(
        [sys.executable, "-m", "station.cli", "run", str(site_file)],
        stderr=(folder / "log").open("w", encoding="utf-8"),
    )
    samples: list[Sample] = []
    given = 0
    try:
        while not samples or samples[-1].stored < scans:
            if service.poll() is not None:
                raise RuntimeError(f"the service ended with {service.returncode}: {folder / 'log'}")
            counts = _counts(site)
            done = counts[State.STORED] + counts[State.SET_ASIDE]
            while given < min(scans, done + AHEAD):
                _give(made[given % len(made)], START + timedelta(hours=given), site.scans.inbox)
                given += 1
            samples.append(_sample(service.pid, done))
            time.sleep(LOOKS_S)
    except KeyboardInterrupt:  # what there is will do
        pass
    finally:
        service.send_signal(signal.SIGTERM)
        service.wait(120)
    return samples, _counts(site)


def _give(scan: Path, start: datetime, inbox: Path) -> None:
    """Put a scan into the inbox as one of another time: other bytes, and its own log."""
    name = start.strftime(NAME)
    content = bytearray(scan.read_bytes())
    content[SOFTWARE_AT : SOFTWARE_AT + SOFTWARE_LENGTH] = name.encode().ljust(SOFTWARE_LENGTH, b"\0")
    (inbox / f"{name}-incl.txt").write_bytes(scan.with_name(f"{scan.stem}-incl.txt").read_bytes())
    (inbox / f".{name}").write_bytes(content)
    (inbox / f".{name}").rename(inbox / f"{name}.laz")


def _counts(site: Site) -> dict[str, int]:
    try:
        with Journal(site.station.data / "journal.sqlite", read_only=True) as journal:
            return journal.counts()
    except StoreError:  # it has not begun
        return dict.fromkeys((state.value for state in State), 0)


def _sample(pid: int, stored: int) -> Sample:
    """Look at the service and the server its children are forked from."""
    lasting = family(pid)[:LASTING]  # then come children
    pages = sum(int(Path(f"/proc/{one}/statm").read_text().split()[1]) for one in lasting)
    return Sample(
        time.monotonic(),
        stored,
        pages * os.sysconf("SC_PAGE_SIZE") / 1e6,
        cpu_of(lasting),
    )


def _show(samples: list[Sample], counts: dict[str, int]) -> None:
    stored = np.array([one.stored for one in samples])
    table = Table(title=f"Soak: {counts}", caption="the parts of one run, set against the second")
    for name in ("scans", "CPU-s a scan", "ratio", "seconds a scan", "memory of the service, MB", "ratio "):
        table.add_column(name, justify="right")
    rows = []
    for part in range(PARTS):
        first, last = (np.searchsorted(stored, stored[-1] * p / PARTS) for p in (part, part + 1))
        last = min(last, len(samples) - 1)
        begin, end = samples[first], samples[last]
        count = max(end.stored - begin.stored, 1)
        memory_mb = float(np.median([one.memory_mb for one in samples[first : last + 1]]))
        rows.append(
            (
                f"{begin.stored}-{end.stored}",
                (end.cpu_s - begin.cpu_s) / count,
                (end.at_s - begin.at_s) / count,
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
