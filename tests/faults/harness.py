"""A very small station, a real service on it, and what must hold whatever befell it."""

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
from dataclasses import dataclass, field, replace
from pathlib import Path

import netCDF4
import numpy as np
import pytest

from benchmarks.cost import family
from station.service.journal import Journal, State
from station.simulation.scenario import tiny
from station.simulation.station import simulate

HERE = Path(__file__).parent
HOOKS = HERE / "hooks"
RECORD = 96  # bytes a boundary takes, see hooks/boundaries.py
PATIENCE_S = 120.0  # a child that dies again and again is started anew after 1, 5 and 30 s
SCANS = 6
LATER = "later"  # where scans lie before they arrive
NOT_VALUES = {"epoch_file"}  # a revision more or less is no other value


def build(folder, *, method="none", hours=SCANS):
    """Simulate a station whose scans take a fifth of a second, and empty its inbox."""
    few = replace(
        tiny(hours=hours),
        lines=30,
        shots_per_line=60,
        cell_m=25.0,
        azimuth_deg=(150.0, 165.0),
        terrain_step_m=10.0,
        scan_s=60.0,
        reference_scans=2,
    )
    simulate(folder, few)
    text = (folder / "site.toml").read_text()
    for old, new in (('method = "joint" ', f'method = "{method}" '), ("settle_s = 2 ", "settle_s = 0.05 ")):
        assert old in text
        text = text.replace(old, new)
    (folder / "site.toml").write_text(text)
    (folder / "inbox").rename(folder / LATER)
    (folder / "inbox").mkdir()
    return folder


class Warm:
    """The process that services are forked from (see `warm.py`)."""

    def __init__(self):
        self.process = subprocess.Popen(
            [sys.executable, str(HERE / "warm.py")],
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
    told = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(sys.path), **more}
    for name in ("NOTIFY_SOCKET", "JOURNAL_STREAM", "WATCHDOG_USEC"):
        told.pop(name, None)
    return told


@dataclass
class Station:
    """A folder with a station, and the service that runs on it, if one does."""

    folder: Path
    warm: Warm | None = None
    pid: int | None = None
    starts: int = 0
    logged: int = 0  # characters of the log before this start
    killed: int = 0  # deaths before this start
    steps: Path | None = None
    period_s: float = 5.0
    clock: Path | None = None  # file that says by how much the service's clock is off
    popen: subprocess.Popen | None = None
    before: list[str] = field(default_factory=list)  # of the command that starts it

    # ---- the service

    def start(self, **plan):
        """Start the service: forked from the warm process, or by its command where there is none."""
        assert self.pid is None
        self.starts += 1
        self.logged = len(self.log())
        self.killed = self.kills
        self.steps = self.folder / f"steps.{self.starts}"
        plan = {"steps": str(self.steps), "died": str(self.died), **plan}
        self.died.mkdir(exist_ok=True)
        orders = {"FAULTS_PLAN": json.dumps(plan)}
        site, log = str(self.folder / "site.toml"), str(self.folder / "log")
        if self.warm is not None:
            order = {"site": site, "log": log, "environment": orders}
            order |= {"period_s": self.period_s, "clock": str(self.clock) if self.clock else ""}
            self.pid = self.warm.start(order)
            return
        orders["PYTHONPATH"] = os.pathsep.join([str(HOOKS), *sys.path])
        with open(log, "a") as told:  # noqa: PTH123 - a text of a path
            self.popen = subprocess.Popen(
                [*self.before, sys.executable, "-m", "station.cli", "run", site],
                stderr=told, env=environment(**orders),
            )  # fmt: skip
        self.pid = self.popen.pid

    def is_alive(self):
        """Tell whether the service still runs."""
        if self.pid is None:
            return False
        if not self._has_ended(0):
            return True
        self.pid = self.popen = None
        return False

    def wait(self, within_s=PATIENCE_S):
        """Wait for the service to end."""
        assert self._has_ended(within_s), self.log()
        self.pid = self.popen = None

    def end(self):
        """Ask the service to end; it must say so, unless one of its kills came first."""
        with suppress(ProcessLookupError):
            os.kill(self.pid, signal.SIGTERM)
        self.wait()
        assert self.log().endswith("service=stopped\n") or self.kills > self.killed, self.log()[-2000:]

    def close(self):
        """Leave nothing running."""
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
            watched = os.pidfd_open(self.pid)
        except ProcessLookupError:
            return True
        try:
            return bool(select.select([watched], [], [], within_s)[0])
        finally:
            os.close(watched)

    def processes(self):
        """Return the service and all it has started."""
        return family(self.pid)

    def limit_files(self, size):
        """Let no file of the service grow beyond a size, as on a full disk; None: as before."""
        for pid in self.processes():
            try:
                _, most = resource.prlimit(pid, resource.RLIMIT_FSIZE)
                resource.prlimit(pid, resource.RLIMIT_FSIZE, (most if size is None else size, most))
            except ProcessLookupError:
                continue

    def step(self):
        """Return how many boundaries the running service has crossed."""
        return self.steps.stat().st_size // RECORD if self.steps.exists() else 0

    # ---- its world

    @property
    def died(self):
        """Folder of the boundaries where someone died, or the disk was full."""
        return self.folder / "died"

    @property
    def kills(self):
        """Deaths so far; a full disk is none."""
        named = [path.name for path in self.died.glob("*") if not path.name.startswith("full ")]
        return len(named) + len(list(self.folder.glob("steps.*.kill*")))

    @property
    def inbox(self):
        return self.folder / "inbox"

    @property
    def data(self):
        return self.folder / "data"

    def drop(self, *hours, whole=True):
        """Have scans arrive, log first; `whole`: by a rename, as careful transfers do."""
        for hour in hours:
            for path in sorted((self.folder / LATER).glob(f"{stem(hour)}*"), reverse=True):
                beside = self.inbox / (f".{path.name}" if whole else path.name)
                shutil.copyfile(path, beside)
                if whole:
                    beside.replace(self.inbox / path.name)

    def log(self):
        path = self.folder / "log"
        return path.read_text() if path.exists() else ""

    def rows(self):
        """Return the rows of the journal by scan."""
        with Journal(self.data / "journal.sqlite", read_only=True) as journal:
            return {row.name: row for row in journal.rows()}

    def is_done(self, *hours):
        """Tell whether all of these are in their place and nothing waits."""
        rows = self.rows()
        at_rest = all(row.state in {State.STORED, State.SET_ASIDE} for row in rows.values())
        return at_rest and {f"{stem(hour)}.laz" for hour in hours} <= rows.keys()

    def state(self, name):
        """Tell where a scan stands, None before it was seen."""
        row = self.rows().get(name)
        return row.state if row else None

    def is_through(self, *hours):
        """Tell whether the service that runs has looked around and found nothing left to do."""
        looked = "service=running" in self.log()[self.logged :]
        return looked and self.is_done(*hours) and not self.processes()[3:]

    def await_(self, what, within_s=PATIENCE_S):
        """Wait until something holds; where it never does, say what all processes are at."""
        until_s = time.monotonic() + within_s
        while not what():
            if time.monotonic() > until_s:
                self._tell_stacks()
                lives = "alive" if self.is_alive() else "dead"
                pytest.fail(f"{lives}, step {self.step()}, after {within_s:g} s:\n{self.log()[-12_000:]}")
            nap()

    def _tell_stacks(self):
        """Have each process write to the log where it is (see hooks/boundaries.py)."""
        if self.is_alive():
            self.limit_files(None)
            for pid in self.processes():
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGUSR1)
            nap(1.0)

    def finish(self, *hours):
        """Have an undisturbed service bring all to an end."""
        if not self.is_alive():
            self.start()
        self.await_(lambda: self.is_alive() and self.is_through(*hours))
        self.end()


def nap(seconds=0.05):
    """Wait a moment."""
    time.sleep(seconds)


def stem(hour):
    """Return the name of a scan without its suffix."""
    return f"250715_{hour:02d}0000"


# ---- what must hold


def values(path):
    """Return every variable of a file, as it stands there, and its dimensions."""
    with netCDF4.Dataset(path) as file:
        file.set_auto_mask(False)
        return {
            name: (variable.dimensions, np.asarray(variable[...]))
            for name, variable in file.variables.items()
            if name not in NOT_VALUES
        }


def assert_same_values(path, quiet_path):
    """Every value of every variable is that of an undisturbed run, to the last bit."""
    told, wanted = values(path), values(quiet_path)
    assert told.keys() == wanted.keys()
    for name, (dims, value) in wanted.items():
        assert told[name][0] == dims, name
        assert told[name][1].tobytes() == value.tobytes(), f"{path.name}: {name} differs"


def assert_sound(station, hours, quiet=None):
    """Everything that arrived is stored once; the series is whole, in order, and as undisturbed."""
    rows = station.rows()
    for hour in hours:
        row = rows[f"{stem(hour)}.laz"]
        assert row.state is State.STORED, (row.name, row.state, row.reason, row.waits_for)
    with netCDF4.Dataset(station.data / "series.nc") as file:
        assert [str(name) for name in file["scan_id"][:]] == [stem(hour) for hour in sorted(hours)]
        assert np.all(np.diff(file["time"][:]) > 0)
        for name in ("elevation", "elevation_change"):
            seen = np.isfinite(np.ma.filled(file[name][:], np.nan)).any(axis=(1, 2))
            assert seen.all(), f"{name} of {np.flatnonzero(~seen)} is half written"
    assert_nothing_twice(station)
    if quiet is not None:
        for path in sorted(quiet.data.glob("*.nc")):
            assert_same_values(station.data / path.name, path)
        assert {path.name for path in station.data.glob("*.nc")} == {p.name for p in quiet.data.glob("*.nc")}
    assert "a bug" not in station.log(), station.log()


def assert_nothing_twice(station):
    """No two epochs were made from the same bytes in the same way."""
    made = []
    for path in sorted(station.data.glob("epochs/*/*/*/*.nc")):
        with netCDF4.Dataset(path) as file:
            names = ("scan_id", "scan_sha256", "log_sha256", "reference_version", "science_hash", "lean_zero")
            made.append(tuple(str(file[name][0]) for name in names))
    assert len(set(made)) == len(made), made
