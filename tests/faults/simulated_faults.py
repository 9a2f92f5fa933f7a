"""Faults of a simulated station: of the machine, its disk and inputs, of people and programs."""

from __future__ import annotations

import errno
import os
import shutil
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from simulated_machine import Machine
from support.tiny_station import PENDING, scan_name

from station.config import read_site
from station.inbox.journal_reader import JournalReader, State
from station.inbox.lock import IDENTITY
from station.processing import integrity
from station.service.scheduler import LoopEvent

if TYPE_CHECKING:
    from station.service.daemon import Daemon

START_S = datetime(2035, 7, 15, tzinfo=UTC).timestamp()  # later than the real clock, which stamps the files
BASE_SCANS = 12  # simulated ones, of which all others are copies with bytes of their own
DAY_S, HOUR_S = 86_400.0, 3600.0
BURST_INTERVAL_S = 40 * DAY_S
SCANS_PER_BURST = 4
SCANS_PER_YEAR = 36
HOUSEKEEPING_S = 20 * DAY_S
REFERENCES_DUE_S = 2.5 * BURST_INTERVAL_S  # the first after 3 scans, its update after 12
SOP_CHANGE_S = 4.5 * BURST_INTERVAL_S


class Faults(Machine):
    """A station's folder on a machine, and the faults of both; each returns what ends it."""

    def __init__(self, folder: Path, seed: int) -> None:
        super().__init__(START_S, seed)
        self.folder = folder
        self.data, self.inbox = folder / "data", folder / "inbox"
        self.daemon: Daemon | None = None
        self.version = "1.0"
        self.names: list[str] = []  # of the good scans
        self.unreported: list[str] = []  # damaged files that `station check --store` did not report

    # ---- used by the faults

    def rows(self) -> dict[str, object]:
        """Return the rows of the journal by scan."""
        if not (self.data / "journal.sqlite").exists():
            return {}
        with JournalReader(self.data / "journal.sqlite") as opened:
            return {row.name: row for row in opened.rows()}

    def _put(self, content: bytes, name: str) -> None:
        path = self.inbox / name
        path.write_bytes(content)
        os.utime(path, (self.now_s(), self.now_s()))
        self._post(LoopEvent.INBOX_CHANGED)

    def _post(self, event: LoopEvent) -> None:
        if self.daemon is not None:
            self.daemon.post(event)

    # ---- faults; each returns what ends it

    def fault_service_killed(self) -> None:
        self.countdown["service"] = self.rng.randint(1, 150)

    def fault_child_killed(self) -> None:
        self.countdown["child"] = self.rng.randint(1, 40)

    def fault_child_hangs(self) -> None:
        self.countdown["hang"] = self.rng.randint(1, 40)

    def fault_socket_deleted(self) -> None:
        """Delete the socket of the fork server, as programs do that clean a folder of temporary files."""
        self.is_socket_deleted = True

    def fault_no_tasks(self) -> object:
        self.start_error = BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))
        return lambda: setattr(self, "start_error", None)

    def fault_no_memory(self) -> object:
        self.is_out_of_memory = True
        return lambda: setattr(self, "is_out_of_memory", False)

    def fault_disk_full(self) -> object:
        self.is_disk_full = True
        return lambda: setattr(self, "is_disk_full", False)

    def fault_no_space(self) -> object:
        self.is_out_of_space = True
        return lambda: setattr(self, "is_out_of_space", False)

    def fault_other_disk_mounted(self) -> object:
        away = self.folder / "data.away"
        if away.exists() or self.in_child:
            return None
        self.data.rename(away)
        self.data.mkdir()
        return self._mount_again

    def _mount_again(self) -> None:
        shutil.rmtree(self.data)
        (self.folder / "data.away").rename(self.data)

    def fault_inbox_away(self) -> object:
        away = self.folder / "inbox.away"
        if away.exists():
            return None
        self.inbox.rename(away)
        self.inbox = away
        return self._inbox_back

    def _inbox_back(self) -> None:
        self.inbox = self.inbox.rename(self.folder / "inbox")
        self._post(LoopEvent.INBOX_CHANGED)

    def fault_clock_wrong(self) -> object:
        self.clock_error_s = self.rng.choice([-3 * DAY_S, -HOUR_S, HOUR_S, 3 * DAY_S])
        return lambda: setattr(self, "clock_error_s", 0.0)

    def fault_areas_broken(self) -> object:
        return self._break(self.folder / "areas.geojson")

    def fault_weather_broken(self) -> object:
        """A scan without weather is part of no reference: not while one falls due."""
        if self.elapsed_s < REFERENCES_DUE_S:
            return None
        return self._break(self.folder / "weather.dat")

    def _break(self, path: Path) -> object:
        good = path.with_suffix(".good")
        if good.exists():
            return None
        path.rename(good)
        path.write_bytes(self.rng.randbytes(200))

        def repair() -> None:
            appended = path.read_bytes()[200:]
            good.replace(path)
            with path.open("ab") as file:
                file.write(appended)

        return repair

    def fault_bits_rot(self) -> None:
        """Damage a derived file.

        Epochs, also in files of days and months, are proved by `station check --store`, not by the service,
        and a file that is being written gets its checksum afterwards.
        """
        files = [
            path
            for path in self.data.rglob("*")
            if path.is_file() and path.suffix not in {".damaged", ".part"}
            and path.name != IDENTITY
            and not path.name.startswith(("journal", "reference"))
            and path.relative_to(self.data).parts[0] not in {"epochs", "days", "months", "set_aside"}
        ]  # fmt: skip
        if files:
            self._damage(self.rng.choice(sorted(files)))

    def fault_series_damaged(self) -> None:
        """Damage a file that people open; `station check --store` must report it."""
        path = self.data / self.rng.choice(["series.nc", "areas.nc"])
        if path.exists() and path.with_name("journal.sqlite").exists():
            self._damage(path)
            with JournalReader(path.with_name("journal.sqlite")) as opened:
                site, rows, known = read_site(self.folder / "site.toml"), opened.rows(), opened.checksums()
            findings = integrity.check_store(site, rows, known, lambda: None)
            if not any(level != "ok" and path.name in message for level, _, message in findings):
                self.unreported.append(f"{path.name}: its damage was not reported at {self.elapsed_s:.0f} s")

    def fault_tilt_offset_damaged(self) -> None:
        for path in sorted(self.data.glob("sop_tilt_offset/*")):
            self._damage(path)

    def _damage(self, path: Path) -> None:
        """Halve a file, or flip some bits of a byte."""
        content = bytearray(path.read_bytes())
        if self.rng.random() < 0.3:
            del content[len(content) // 2 :]
        elif content:
            content[self.rng.randrange(len(content))] ^= 0x55
        with path.open("r+b") as file:
            file.truncate(0)
            file.write(content)

    def fault_scan_touched(self) -> None:
        """Touch a scan for two hours, as a mirror does: it is settling while others are processed."""
        path = self._some_scan()
        if path is not None:
            for delay_s in range(0, 7200, 50):
                self.at(self.elapsed_s + delay_s, lambda: self._touch(path.name))

    def _touch(self, name: str) -> None:
        os.utime(self.inbox / name, (self.now_s(), self.now_s()))
        self._post(LoopEvent.INBOX_CHANGED)

    def fault_scan_copied(self) -> None:
        path = self._some_scan()
        if path is not None:
            at = datetime.fromtimestamp(START_S + self.elapsed_s + self.rng.randrange(3000), UTC)
            name = at.strftime("%y%m%d_%H%M%S")
            log = self.inbox / f"{path.stem}-incl.txt"
            self._put(log.read_bytes() if log.exists() else b"", f"{name}-incl.txt")
            self._put(path.read_bytes(), f"{name}.laz")

    def fault_other_scan_of_a_start(self) -> None:
        path = self._some_scan()
        if path is not None:
            content = bytearray(
                (self.folder / PENDING / f"{scan_name(self.rng.randrange(BASE_SCANS))}.laz").read_bytes()
            )
            self._put(bytes(content), f"{path.stem}.LAZ")

    def fault_hostile_scan(self) -> None:
        path = self._some_scan()
        if path is not None:
            at = datetime.fromtimestamp(START_S + self.elapsed_s - self.rng.randrange(3000), UTC)
            content = bytearray(path.read_bytes())
            for _ in range(20):
                content[self.rng.randrange(300, len(content))] = self.rng.randrange(256)
            name = at.strftime("%y%m%d_%H%M%S")
            self._put(b"Time,Roll,Pitch\n", f"{name}-incl.txt")
            self._put(bytes(content), f"{name}.laz")

    def fault_limits_changed(self) -> None:
        site = self.folder / "site.toml"
        text = site.read_text().partition("[service]")[0]
        site.write_text(f"{text}[service]\nmemory_gb = {self.rng.choice([2.0, 3.0, 4.0])}\n")
        self._post(LoopEvent.RELOAD)

    def fault_upgrade(self) -> None:
        """Stop the service as a package manager does, and start another version."""
        self.version = f"{self.rng.randrange(1000)}.0"
        if self.daemon is not None:
            self.daemon.stop()

    def fault_epoch_cut(self) -> None:
        """Cut an epoch off, as a disk without a journal does when power fails."""
        files = sorted(self.data.rglob("epochs/**/*.nc"))
        if files:
            os.truncate(self.rng.choice(files), 1000)

    def _some_scan(self) -> Path | None:
        """Return a scan that is stored, at random."""
        stored = {name for name, row in self.rows().items() if row.state is State.STORED}
        scans = [self.inbox / name for name in self.names if name in stored]
        return self.rng.choice(scans) if scans else None
