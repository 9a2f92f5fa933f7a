"""Years of a station's faults in minutes: the service on a simulated machine, and all that happens to it.

A year has nine bursts of four hourly scans, a change of the SOP, and two faults around each scan; what
happens follows from the seed. Everything but the machine (`simulated_machine.py`) is the production code.

    python tests/faults/simulated_world.py --seed 0 --years 100
"""

from __future__ import annotations

import argparse
import logging
import os
import shutil
import sys
import tempfile
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from unittest import mock

if __name__ == "__main__":
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as in worker processes; more threads are slower
    sys.path[:0] = [str(Path(__file__).parents[1]), str(Path(__file__).parents[2])]

import laspy
import numpy as np
from simulated_faults import (
    BASE_SCANS,
    BURST_INTERVAL_S,
    DAY_S,
    HOUR_S,
    HOUSEKEEPING_S,
    SCANS_PER_BURST,
    SCANS_PER_YEAR,
    SOP_CHANGE_S,
    START_S,
    Faults,
)
from simulated_machine import DiedError
from support.tiny_station import PENDING, build, scan_name, values

from station.errors import StationError
from station.inbox.journal_reader import State
from station.inbox.lock import pause_reason
from station.service.daemon import Daemon, LoopTiming
from station.service.scheduler import LoopEvent
from station.service.worker import Worker

MAX_RECOVERY_S = 40 * DAY_S  # after the last fault; the longest pause of a scan is hours
TIMING = LoopTiming(period_s=6 * HOUR_S, first_pause_s=5.0)


class World(Faults):
    """A station's folder on a machine and all that happens to both."""

    def __init__(self, folder: Path, seed: int, scans: int = SCANS_PER_YEAR) -> None:
        super().__init__(folder, seed)
        self.starts = self.faults = 0
        self.log: list[str] = []
        self.last_fault_s = 0.0
        for number in range(scans):
            self._plan_scan(number)
        for number in range(1, int(_start_s(scans) / HOUSEKEEPING_S) + 1):
            self.at(number * HOUSEKEEPING_S, self._housekeeping)

    # ---- what will happen

    def plan_faults(self, *kinds: str) -> None:
        """Plan two faults, of any kind or one of these, around each scan."""
        kinds = [f"fault_{kind}" for kind in kinds] or [
            name for name in dir(self) if name.startswith("fault_")
        ]
        for number in range(1, len(self.names)):
            for _ in range(2):
                begin_s = _start_s(number) + self.rng.uniform(-2, 0.2) * HOUR_S
                end_s = begin_s + self.rng.choice([0.1, 1.0, 5.0, 20.0]) * HOUR_S
                fault = getattr(self, self.rng.choice(kinds))
                self.at(begin_s, lambda fault=fault, end_s=end_s: self._begin(fault, end_s))
                self.last_fault_s = max(self.last_fault_s, end_s)

    def _begin(self, fault: object, end_s: float) -> None:
        self.faults += 1
        undo = fault()
        if undo is not None:
            self.at(max(end_s, self.elapsed_s), undo)

    def _plan_scan(self, number: int) -> None:
        start_s = START_S + _start_s(number)
        name = datetime.fromtimestamp(start_s, UTC).strftime("%y%m%d_%H%M%S")
        self.names.append(f"{name}.laz")
        self.at(_start_s(number) + 120, lambda: self._deliver(number % BASE_SCANS, name))

    def _deliver(self, base: int, name: str) -> None:
        """Put a scan, its log and the weather of its time into their folders."""
        pending = self.folder / PENDING
        scan = laspy.read(pending / f"{scan_name(base)}.laz")
        scan.header.generating_software = name
        scan.write(pending / f"{name}.laz")
        with (self.folder / "weather.dat").open("a", newline="") as weather:
            for minute in range(-5, 15, 5):
                at = datetime.fromtimestamp(START_S + self.elapsed_s + 60 * minute, UTC)
                weather.write(f'"{at:%Y-%m-%d %H:%M:%S}",0,{-base / 3:.4f},80.0,690.0,12.6\r\n')
        self._put((pending / f"{scan_name(base)}-incl.txt").read_bytes(), f"{name}-incl.txt")
        content = (pending / f"{name}.laz").read_bytes()
        if self.faults and self.rng.random() < 0.3:  # half an upload, which stalls for some minutes
            self._put(content[: len(content) // 2], f"{name}.laz")
            self.at(self.elapsed_s + self.rng.uniform(5, 50), lambda: self._put(content, f"{name}.laz"))
        else:
            self._put(content, f"{name}.laz")

    def _housekeeping(self) -> None:
        self._post(LoopEvent.MAINTENANCE)
        self._post(LoopEvent.COMPACT)

    # ---- running

    @contextmanager
    def installed(self):
        """Let this process run on the machine, and collect the log of the service."""
        handler = logging.Handler()
        handler.emit = lambda record: self.log.append(record.getMessage())
        logger = logging.getLogger("station")
        environment = {"STATE_DIRECTORY": str(self.folder / "state")}
        with self.disk(), mock.patch.dict(os.environ, environment):
            logger.addHandler(handler)
            try:
                yield
            finally:
                logger.removeHandler(handler)

    def stop_service(self) -> None:
        """Stop the service as systemd does."""
        self.daemon.stop()

    def run(self) -> None:
        """Run the service through all that is planned, and restart it whenever it dies, as systemd does."""
        (self.folder / "state").mkdir(exist_ok=True)
        starts_in_vain = 0
        with self.installed():
            while not (self.is_finished or self.is_time_up()):
                self.starts += 1
                self.daemon = None
                self.stop()  # a new service has a fork server of its own
                try:
                    with mock.patch("station.config.__version__", self.version):
                        self.daemon = Daemon(self.folder / "site.toml", Worker, TIMING, self.host())
                        self.daemon.serve()
                except DiedError:
                    self.deaths += 1
                    starts_in_vain = 0
                except StationError as error:
                    self.log.append(f"service ended: {error}")
                    starts_in_vain += 1
                    self.advance(600.0 * starts_in_vain)  # many starts in vain would only take time
                self.in_child = False
                self.advance(10.0)

    def is_over(self) -> bool:
        """Return True if nothing is planned any more, no scan waits and no fault, or if time is up."""
        if self.is_time_up():
            return True
        if (
            self.timeline
            or self.elapsed_s < self.last_fault_s + 2 * HOUSEKEEPING_S
            or pause_reason(self.data)
        ):
            return False
        rows = self.rows()
        return set(self.names) <= rows.keys() and all(
            row.state in {State.STORED, State.SET_ASIDE} for row in rows.values()
        )

    def is_time_up(self) -> bool:
        """Return True long after the last scan and the last fault."""
        end_s = max(self.last_fault_s, _start_s(len(self.names))) + 2 * HOUSEKEEPING_S + MAX_RECOVERY_S
        return not self.timeline and self.elapsed_s > end_s

    def defects(self, undisturbed: World) -> list[str]:
        """Return what differs from a world in which nothing happened."""
        rows = self.rows()
        defects = [
            f"{name}: {rows[name].state if name in rows else 'unknown'}"
            f" {getattr(rows.get(name), 'reason', '')}"
            for name in self.names
            if name not in rows or rows[name].state is not State.STORED
        ]
        defects += [
            f"{name}: stored although it is no good scan"
            for name, row in rows.items()
            if row.state is State.STORED and name not in self.names
        ]
        defects += [line for line in self.log if "a bug" in line]
        defects += self.unreported
        for file in ("series.nc", "processing.nc", "areas.nc"):
            try:
                actual, expected = values(self.data / file), values(undisturbed.data / file)
            except (OSError, RuntimeError) as error:
                defects.append(f"{file}: {error}")
                continue
            if actual.keys() != expected.keys():
                defects.append(f"{file}: variables {actual.keys() ^ expected.keys()}")
                continue
            for name, (dims, value) in expected.items():
                if actual[name][0] != dims or actual[name][1].tobytes() != value.tobytes():
                    defects.append(f"{file}: {name} differs{_where(actual[name][1], value)}")
        return defects


def _where(actual: np.ndarray, expected: np.ndarray) -> str:
    """Return the epochs in which a variable differs."""
    if actual.shape != expected.shape:
        return f": {actual.shape} instead of {expected.shape}"
    axis = tuple(range(1, actual.ndim))
    is_float = actual.dtype.kind == "f"
    same = np.isclose(actual, expected, rtol=0, atol=0, equal_nan=True) if is_float else actual == expected
    return f" in {np.flatnonzero(~np.all(same, axis=axis)).tolist()}"


def _start_s(number: int) -> float:
    """Return when a scan begins [s since the start]."""
    burst, hour = divmod(number, SCANS_PER_BURST)
    return burst * BURST_INTERVAL_S + hour * HOUR_S


def make_world(folder: Path, template: Path, seed: int, scans: int = SCANS_PER_YEAR) -> World:
    """Return a world in a new folder; `template` is a station made by `make_template`."""
    shutil.copytree(template, folder)
    return World(folder, seed, scans)


def make_template(folder: Path) -> Path:
    """Simulate the scans of which all worlds have copies."""
    build(folder, hours=BASE_SCANS, method="joint")
    shutil.copy(folder / "sop.dat", folder / "next_sop.dat")
    change = datetime.fromtimestamp(START_S + SOP_CHANGE_S, UTC)
    site = folder / "site.toml"
    text = site.read_text()
    for old, new in (
        ("settle_s = 0.05", "settle_s = 60"),
        ("scans = 2  ", "scans = 3  "),
        ("expected_every_s = 3600", "expected_every_s = 7200"),
        ('scan = "250715_000000"', "# the first scan defines the tilt offset"),
        ("[map]", f'[[sop]]\nfrom = {change:%Y-%m-%dT%H:%M:%SZ}\nfile = "next_sop.dat"\n[map]'),
    ):
        assert old in text
        text = text.replace(old, new)
    site.write_text(f"{text}[products]\npage = false\n")
    return folder


def main() -> int:
    """Run worlds with consecutive seeds; print the defects of each."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=0, help="the first seed")
    parser.add_argument(
        "--years", type=int, default=10, help="number of station-years, each with its own seed"
    )
    parser.add_argument("--keep", type=Path, help="copy the folder of each world into this folder")
    parser.add_argument("--log", action="store_true", help="print the service's log")
    options = parser.parse_args()
    failed: list[int] = []
    with tempfile.TemporaryDirectory() as temporary:
        template = make_template(Path(temporary) / "template")
        undisturbed = make_world(Path(temporary) / "undisturbed", template, 0)
        undisturbed.run()
        for seed in range(options.seed, options.seed + options.years):
            world = make_world(Path(temporary) / str(seed), template, seed)
            world.plan_faults()
            world.run()
            defects = world.defects(undisturbed)
            print(f"seed {seed}: {world.faults} faults, {world.deaths} deaths, {world.hangs} hangs,"
                  f" {world.starts} starts, {len(defects)} defects", flush=True)  # fmt: skip
            print(*(world.log if options.log else []), *defects, sep="\n", end="\n" if defects else "")
            if defects:
                failed.append(seed)
            if options.keep:
                shutil.copytree(world.folder, options.keep / str(seed))
            shutil.rmtree(world.folder)
    print(f"{options.years} station-years, {len(failed)} with defects")
    for seed in failed:
        print(f"replay: python tests/faults/simulated_world.py --seed {seed} --years 1 --log --keep FOLDER")
    return min(len(failed), 1)


if __name__ == "__main__":
    sys.exit(main())
