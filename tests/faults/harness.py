"""A very small station, a real service on it, and the invariants that no fault may violate."""

from __future__ import annotations

import json
import os
import resource
import select
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import netCDF4
import numpy as np
import pytest
from support.tiny_station import PENDING, SCANS, assert_same_values, build, scan_name  # noqa: F401 - for tests

from benchmarks.process_cost import family
from station.inbox.journal_reader import JournalReader, State

FOLDER = Path(__file__).parent
HOOKS = FOLDER / "hooks"
RECORD = 96  # bytes per boundary, see hooks/boundaries.py
TIMEOUT_S = 120.0  # a worker process that keeps dying is restarted after 1, 5 and 30 s


class Warm:
    """The process from which services are forked (see `warm.py`)."""

    def __init__(self):
        self.process = subprocess.Popen(
            [sys.executable, str(FOLDER / "warm.py")],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, encoding="utf-8", env=environment(),
        )  # fmt: skip
        assert self.process.stdout.readline() == "warm\n"

    def start(self, order):
        self.process.stdin.write(json.dumps(order) + "\n")
        self.process.stdin.flush()
        return int(self.process.stdout.readline())

    def close(self):
        with self.process:
            self.process.stdin.close()


def environment(**more):
    env = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(sys.path), **more}
    for name in ("NOTIFY_SOCKET", "JOURNAL_STREAM", "WATCHDOG_USEC"):
        env.pop(name, None)
    return env


@dataclass
class Station:
    """A folder with a station and, while it runs, its service."""

    folder: Path
    warm: Warm | None = None
    pid: int | None = None
    starts: int = 0
    logged: int = 0  # characters of the log before this start
    earlier_kills: int = 0  # kills before this start
    steps: Path | None = None
    period_s: float = 5.0
    clock: Path | None = None  # file with the offset of the service's clock [s]
    popen: subprocess.Popen | None = None
    command_prefix: list[str] = field(default_factory=list)

    # ---- service

    def start(self, **plan):
        """Start the service: forked from the warm process if there is one, else by its command."""
        assert self.pid is None
        self.starts += 1
        self.logged = len(self.log())
        self.earlier_kills = self.kills
        self.steps = self.folder / f"steps.{self.starts}"
        plan = {"steps": str(self.steps), "died": str(self.died), **plan}
        self.died.mkdir(exist_ok=True)
        fault_environment = {"FAULTS_PLAN": json.dumps(plan)}
        site, log = str(self.folder / "site.toml"), str(self.folder / "log")
        if self.warm is not None:
            order = {"site": site, "log": log, "environment": fault_environment}
            order |= {"period_s": self.period_s, "clock": str(self.clock) if self.clock else ""}
            self.pid = self.warm.start(order)
            return
        fault_environment["PYTHONPATH"] = os.pathsep.join([str(HOOKS), *sys.path])
        with open(log, "a") as log_file:  # noqa: PTH123 - the path is a string
            self.popen = subprocess.Popen(
                [*self.command_prefix, sys.executable, "-m", "station", "run", site],
                stderr=log_file, env=environment(**fault_environment),
            )  # fmt: skip
        self.pid = self.popen.pid

    def is_alive(self):
        """Return True while the service runs."""
        if self.pid is None:
            return False
        if not self._has_ended(0):
            return True
        self.pid = self.popen = None
        return False

    def wait(self, within_s=TIMEOUT_S):
        """Wait for the service to end."""
        assert self._has_ended(within_s), self.log()
        self.pid = self.popen = None

    def end(self):
        """Stop the service; it must log its end, unless a kill came first."""
        with suppress(ProcessLookupError):
            os.kill(self.pid, signal.SIGTERM)
        self.wait()
        assert self.log().endswith("service=stopped\n") or self.kills > self.earlier_kills, self.log()[-2000:]

    def close(self):
        """Kill the service if it still runs."""
        if self.is_alive():
            os.kill(self.pid, signal.SIGKILL)
            self.wait()

    def _has_ended(self, within_s):
        if self.popen is not None:
            try:
                self.popen.wait(within_s)
            except subprocess.TimeoutExpired:
                return False
            return True
        try:
            pidfd = os.pidfd_open(self.pid)
        except ProcessLookupError:
            return True
        try:
            return bool(select.select([pidfd], [], [], within_s)[0])
        finally:
            os.close(pidfd)

    def processes(self):
        """Return the process ids of the service and its descendants."""
        return family(self.pid)

    def limit_file_size(self, size):
        """Limit the size of the service's files [bytes], as a full disk does; None removes the limit."""
        for pid in self.processes():
            try:
                _, hard_limit = resource.prlimit(pid, resource.RLIMIT_FSIZE)
                soft_limit = hard_limit if size is None else size
                resource.prlimit(pid, resource.RLIMIT_FSIZE, (soft_limit, hard_limit))
            except ProcessLookupError:
                continue

    def step(self):
        """Return how many boundaries the running service has crossed."""
        return self.steps.stat().st_size // RECORD if self.steps.exists() else 0

    # ---- files

    @property
    def died(self):
        """Folder with a file per boundary at which a process died or the disk was full."""
        return self.folder / "died"

    @property
    def kills(self):
        """Number of kills so far, without full disks."""
        claims = [path.name for path in self.died.glob("*") if not path.name.startswith("full ")]
        return len(claims) + len(list(self.folder.glob("steps.*.kill*")))

    @property
    def inbox(self):
        return self.folder / "inbox"

    @property
    def data(self):
        return self.folder / "data"

    def drop(self, *hours, whole=True):
        """Put scans into the inbox, log first; `whole`: by a rename, as careful transfers do."""
        for hour in hours:
            for path in sorted((self.folder / PENDING).glob(f"{scan_name(hour)}*"), reverse=True):
                partial = self.inbox / (f".{path.name}" if whole else path.name)
                shutil.copyfile(path, partial)
                if whole:
                    partial.replace(self.inbox / path.name)

    def log(self):
        path = self.folder / "log"
        return path.read_text() if path.exists() else ""

    def rows(self):
        """Return the rows of the journal by scan."""
        with JournalReader(self.data / "journal.sqlite") as journal:
            return {row.name: row for row in journal.rows()}

    def is_done(self, *hours):
        """Return True if these scans are stored or rejected and no scan waits."""
        rows = self.rows()
        at_rest = all(row.state in {State.STORED, State.SET_ASIDE} for row in rows.values())
        return at_rest and {f"{scan_name(hour)}.laz" for hour in hours} <= rows.keys()

    def state(self, name):
        """Return the state of a scan; None before the service has recorded it."""
        row = self.rows().get(name)
        return row.state if row else None

    def is_finished(self, *hours):
        """Return True if the running service has polled the inbox and has nothing left to do."""
        has_polled = "service=running" in self.log()[self.logged :]
        return has_polled and self.is_done(*hours) and not self.processes()[3:]

    def wait_until(self, condition, within_s=TIMEOUT_S):
        """Wait for a condition; on failure, report the stacks of all processes."""
        until_s = time.monotonic() + within_s
        while not condition():
            if time.monotonic() > until_s:
                self._log_stacks()
                liveness = "alive" if self.is_alive() else "dead"
                pytest.fail(f"{liveness}, step {self.step()}, after {within_s:g} s:\n{self.log()[-12_000:]}")
            pause()

    def _log_stacks(self):
        """Have each process write its stacks to the log (see hooks/boundaries.py)."""
        if self.is_alive():
            self.limit_file_size(None)
            for pid in self.processes():
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGUSR1)
            pause(1.0)

    def finish(self, *hours):
        """Let an undisturbed service process everything, then stop it."""
        if not self.is_alive():
            self.start()
        self.wait_until(lambda: self.is_alive() and self.is_finished(*hours))
        self.end()


def pause(seconds=0.05):
    """Wait [s]."""
    time.sleep(seconds)


# ---- invariants


def assert_store_intact(station, hours, undisturbed=None):
    """Assert that every scan is stored once and that the series is complete and undisturbed."""
    rows = station.rows()
    for hour in hours:
        row = rows[f"{scan_name(hour)}.laz"]
        assert row.state is State.STORED, (row.name, row.state, row.reason, row.waiting_reason)
    with netCDF4.Dataset(station.data / "series.nc") as file:
        assert [str(name) for name in file["scan_id"][:]] == [scan_name(hour) for hour in sorted(hours)]
        assert np.all(np.diff(file["time"][:]) > 0)
        for name in ("elevation_change_uncertainty", "elevation_change"):
            observed = np.isfinite(np.ma.filled(file[name][:], np.nan)).any(axis=(1, 2))
            assert observed.all(), f"{name} of {np.flatnonzero(~observed)} is half written"
    assert_nothing_twice(station)
    if undisturbed is not None:
        for path in sorted(undisturbed.data.glob("*.nc")):
            assert_same_values(station.data / path.name, path)
        assert {path.name for path in station.data.glob("*.nc")} == {
            p.name for p in undisturbed.data.glob("*.nc")
        }
    assert "a bug" not in station.log(), station.log()


def assert_nothing_twice(station):
    """Assert that no two epochs have the same input bytes and settings."""
    identities = []
    for path in sorted(station.data.glob("epochs/*/*/*/*.nc")):
        with netCDF4.Dataset(path) as file:
            names = (
                "scan_id",
                "scan_sha256",
                "log_sha256",
                "reference_version",
                "science_hash",
                "sop_tilt_offset",
            )
            identities.append(tuple(str(file[name][0]) for name in names))
    assert len(set(identities)) == len(identities), identities
