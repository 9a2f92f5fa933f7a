"""A soak: scan after scan while faults of all kinds follow each other; nobody restarts anything by hand."""

from __future__ import annotations

import os
import shutil
import signal
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path

import harness
import laspy
import pytest
from support.effort import SHARE

from station.config import read_site
from station.inbox.journal import Journal
from station.inbox.journal_reader import State
from station.processing.scans.scan_files import scan_file
from station.processing.usable_inputs import with_usable_inputs
from station.service.worker import Worker

pytestmark = pytest.mark.slow

SCANS = 600 // SHARE
MAX_BACKLOG = 12  # scans; then the faults wait for the service
START = datetime(2025, 7, 15, tzinfo=UTC)
CGROUPS = Path("/sys/fs/cgroup")


def name_of(number):
    return f"{START + timedelta(hours=number):%y%m%d_%H%M%S}"


def make_scans(folder):
    """Add copies of the simulated scans, with bytes, logs and weather of their own, for all hours."""
    pending, weather = folder / harness.PENDING, folder / "weather.dat"
    lines = weather.read_text().splitlines()
    header, rows = lines[:4], [line.split(",", 1) for line in lines[4:]]
    times = [datetime.strptime(time.strip('"'), "%Y-%m-%d %H:%M:%S").replace(tzinfo=UTC) for time, _ in rows]
    measured = {}
    for number in range(SCANS):
        base = number % harness.SCANS
        shift = timedelta(hours=number - base)
        for time, (_, values) in zip(times, rows, strict=True):
            if abs(time - START - timedelta(hours=base, minutes=15)) <= timedelta(minutes=20):
                measured[time + shift] = values
        if number >= harness.SCANS:
            shutil.copy(pending / f"{name_of(base)}-incl.txt", pending / f"{name_of(number)}-incl.txt")
            scan = laspy.read(pending / f"{name_of(base)}.laz")
            scan.header.generating_software = name_of(number)
            scan.write(pending / f"{name_of(number)}.laz")
    text = [f'"{time:%Y-%m-%d %H:%M:%S}",{values}' for time, values in sorted(measured.items())]
    weather.write_text("\n".join([*header, *text, ""]))


class InProcess(Worker):
    """A worker without worker processes and page, which updates the series only when it is asked to."""

    def publish(self, *_):
        pass

    def run(self, task, *args):
        if task.__name__ == "update_series" and not self._should_stop():
            return 0
        return with_usable_inputs(task, self._site, *args, lambda: None)


def run_undisturbed(folder):
    site = read_site(folder / "site.toml")
    with Journal(site.station.data / "journal.sqlite") as journal:
        worker = InProcess(site, journal)
        for number in range(SCANS):
            worker.process(scan_file(site, site.scans.inbox / f"{name_of(number)}.laz"))
        while waiting := journal.waiting():
            worker.process(scan_file(site, site.scans.inbox / waiting[0].name))
        worker._should_stop = lambda: True
        worker.store.reconcile()


class Limits:
    """Control groups of the service, of version 1 or 2; without permission nothing is limited."""

    def __init__(self):
        self.folders = {}
        for kind, parents in (("pids", ("pids", ".")), ("memory", ("memory", "."))):
            for parent in parents:
                folder = CGROUPS / parent / f"station-soak-{kind}-{os.getpid()}"
                with suppress(OSError):
                    folder.mkdir(exist_ok=True)
                    files = {"pids": ("pids.max",), "memory": ("memory.limit_in_bytes", "memory.max")}[kind]
                    found = [folder / file for file in files if (folder / file).exists()]
                    if found:
                        self.folders[kind] = folder, found[0]
                        break
                    folder.rmdir()

    def admit(self, pids):
        for folder, _ in self.folders.values():
            for pid in pids:
                with suppress(OSError):
                    (folder / "cgroup.procs").write_text(str(pid))

    def current(self, kind):
        folder = self.folders[kind][0]
        names = ("pids.current", "memory.usage_in_bytes", "memory.current")
        return next(int((folder / name).read_text()) for name in names if (folder / name).exists())

    def set(self, kind, limit):
        _, file = self.folders[kind]
        for text in ("-1", "max") if limit is None else (str(limit),):
            with suppress(OSError):  # memory that is in use cannot be reclaimed, or the other version's word
                file.write_text(text)
                return

    def remove(self):
        for folder, _ in self.folders.values():
            harness.pause(0.2)
            with suppress(OSError):
                folder.rmdir()


class Soak:
    """The station, what has been delivered to it, and the faults."""

    def __init__(self, station, rng):
        self.station, self.rng, self.limits = station, rng, Limits()
        self.delivered, self.counts, self.ends = [], {}, []
        self.inbox = station.inbox

    def keep_running(self):
        """Restart the service if it has died, as systemd does."""
        if not self.station.is_alive():
            self.station.start()
            self.limits.admit(self.station.processes())

    def backlog(self):
        with suppress(Exception):
            return sum(row.state in {State.WAITING, State.LATER} for row in self.station.rows().values())
        return 0

    def deliver(self, number):
        self.delivered.append(name_of(number))
        pending = self.station.folder / harness.PENDING
        names = [f"{name_of(number)}-incl.txt", f"{name_of(number)}.laz"]
        if self.rng.random() < 0.2:
            names.reverse()
        for name in names:
            content = (pending / name).read_bytes()
            if self.rng.random() < 0.1:
                (self.inbox / name).write_bytes(content[: len(content) // 2])
                harness.pause(0.03)
            (self.inbox / f".{name}").write_bytes(content)
            (self.inbox / f".{name}").replace(self.inbox / name)

    def disturb(self):
        kinds = sorted(name for name in dir(self) if name.startswith("fault_"))
        kind = self.rng.choice(kinds)
        self.counts[kind] = self.counts.get(kind, 0) + 1
        end = getattr(self, kind)()
        if end is not None:
            self.ends.append((self.rng.randrange(1, 4), end))

    def end_faults(self, *, all_of_them=False):
        for remaining, end in [*self.ends]:
            self.ends.remove((remaining, end))
            if remaining <= 0 or all_of_them:
                end()
            else:
                self.ends.append((remaining - 1, end))

    # ---- faults; each may return what ends it

    def fault_none(self):
        pass

    def fault_service_killed(self):
        with suppress(ProcessLookupError, TypeError):
            os.kill(self.station.pid, signal.SIGKILL)

    def fault_service_stopped(self):
        with suppress(ProcessLookupError, TypeError):
            os.kill(self.station.pid, signal.SIGTERM)

    def fault_workers_killed(self):
        for pid in self.station.processes()[1:] if self.station.is_alive() else []:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)

    def fault_socket_deleted(self):
        for pid in self.station.processes() if self.station.is_alive() else []:
            with suppress(OSError):
                for line in Path(f"/proc/{pid}/net/unix").read_text().splitlines():
                    path = line.split()[-1]
                    if "listener-" in path and self._is_of(pid, line):
                        Path(path).unlink(missing_ok=True)

    def _is_of(self, pid, line):
        """Return True if a process has a socket of /proc/net/unix open."""
        target = f"socket:[{line.split()[6]}]"
        with suppress(OSError):
            return any(str(fd.readlink()) == target for fd in Path(f"/proc/{pid}/fd").iterdir())
        return False

    def fault_disk_full(self):
        if not self.station.is_alive():
            return None
        self.station.limit_file_size(self.rng.choice([0, 4096, 20_000]))
        return lambda: self.station.is_alive() and self.station.limit_file_size(None)

    def fault_no_tasks(self):
        if "pids" not in self.limits.folders:
            return None
        self.limits.set("pids", self.limits.current("pids") + self.rng.randrange(3))
        return lambda: self.limits.set("pids", None)

    def fault_no_memory(self):
        if "memory" not in self.limits.folders:
            return None
        self.limits.set("memory", self.limits.current("memory") + self.rng.choice([1, 5, 20]) * 2**20)
        return lambda: self.limits.set("memory", None)

    def fault_other_disk(self):
        data, away = self.station.data, self.station.folder / "data.away"
        if away.exists() or not data.exists():
            return None
        data.rename(away)
        data.mkdir()

        def mount_again():
            shutil.rmtree(data)
            away.rename(data)

        return mount_again

    def fault_inbox_away(self):
        away = self.station.folder / "inbox.away"
        if away.exists():
            return None
        self.inbox = self.station.inbox.rename(away)

        def back():
            self.inbox = away.rename(self.station.inbox)

        return back

    def fault_areas_broken(self):
        return self._break("areas.geojson")

    def _break(self, name):
        path, good = self.station.folder / name, self.station.folder / f"{name}.good"
        if good.exists():
            return None
        path.rename(good)
        path.write_text("{")
        return lambda: good.replace(path)

    def fault_reload_with_other_limits(self):
        site = self.station.folder / "site.toml"
        text = site.read_text().partition("[service]")[0]
        site.write_text(f"{text}[service]\nmemory_gb = {self.rng.choice([2.0, 3.0, 4.0])}\n")
        with suppress(ProcessLookupError, TypeError):
            os.kill(self.station.pid, signal.SIGHUP)

    def fault_touched(self):
        for name in self.rng.sample(self.delivered, min(3, len(self.delivered))):
            with suppress(OSError):
                os.utime(self.inbox / f"{name}.laz")

    def fault_copied(self):
        with suppress(OSError):
            original = self.rng.choice(self.delivered[:-1] or self.delivered)
            self._put_odd("260801", (self.inbox / f"{original}.laz").read_bytes())

    def fault_junk(self):
        content = self.rng.randbytes(3000)
        self._put_odd("250602", content)
        (self.inbox / f"odd name {self.rng.randrange(10)}.laz").write_bytes(content)

    def _put_odd(self, day, content):
        name = f"{day}_{self.rng.randrange(24):02d}0000"
        (self.inbox / f"{name}-incl.txt").write_bytes(b"Time,Roll,Pitch\n")
        (self.inbox / f"{name}.laz").write_bytes(content)

    def fault_derived_damaged(self):
        derived = [
            "series.nc",
            "processing.nc",
            "areas.nc",
            *(f"sop_tilt_offset/{p.name}" for p in self.station.data.glob("sop*/*")),
        ]
        path = self.station.data / self.rng.choice(derived)
        with suppress(OSError):
            content = bytearray(path.read_bytes())
            position = self.rng.randrange(len(content))
            content[position] ^= 0x55
            with path.open("r+b") as file:
                file.write(content[: self.rng.choice([0, position, len(content)])])
                file.truncate()

    def fault_lock_deleted(self):
        with suppress(OSError):
            (self.station.data / "service.lock").unlink()


def test_soak(make_station, tmp_path, rng, capsys):
    """Stored once, with the values of an undisturbed run; nothing set aside; nothing done by hand."""
    station = make_station()
    site = station.folder / "site.toml"
    site.write_text(site.read_text() + "[products]\npage = false\n")
    make_scans(station.folder)
    undisturbed = shutil.copytree(station.folder, tmp_path / "undisturbed")
    shutil.copytree(undisturbed / harness.PENDING, undisturbed / "inbox", dirs_exist_ok=True)
    (undisturbed / "data").mkdir()
    run_undisturbed(undisturbed)
    soak = Soak(station, rng)
    try:
        for number in range(SCANS):
            soak.keep_running()
            soak.deliver(number)
            soak.disturb()
            soak.end_faults()
            until_s = 0.0
            while soak.backlog() > MAX_BACKLOG and until_s < 30.0:
                until_s += 0.2
                harness.pause(0.2)
                soak.keep_running()
                if until_s > 5.0:
                    soak.end_faults(all_of_them=True)
        soak.end_faults(all_of_them=True)

        def is_done():
            soak.keep_running()
            rows = station.rows()
            return all(
                f"{name}.laz" in rows and rows[f"{name}.laz"].state is State.STORED for name in soak.delivered
            )

        station.wait_until(is_done, within_s=900.0)
        station.finish()
    finally:
        soak.limits.remove()
    rows = station.rows()
    assert {name for name, row in rows.items() if row.state is State.STORED} == {
        f"{name}.laz" for name in soak.delivered
    }
    harness.assert_nothing_twice(station)
    for path in sorted((undisturbed / "data").glob("*.nc")):
        harness.assert_same_values(station.data / path.name, path)
    assert "a bug" not in station.log()
    with capsys.disabled():
        faults = " ".join(
            f"{kind.removeprefix('fault_')}={count}" for kind, count in sorted(soak.counts.items())
        )
        print(f"\n  scans={SCANS} starts={station.starts} limited={sorted(soak.limits.folders)} {faults}")
