"""The real service as a user has it: a folder, a process, power cuts, broken files."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

import station
from station.simulation.station import simulate, tiny

PATIENCE_S = 60.0


class Service:
    """`station run` as a child process."""

    def __init__(self, folder):
        self.folder = folder
        self.site = folder / "site.toml"
        self.process = None

    def start(self):
        log = (self.folder / "log").open("a")
        self.process = subprocess.Popen([sys.executable, "-m", "station.cli", "run", self.site], stderr=log)
        log.close()

    def end(self, how):
        self.process.send_signal(how)
        return self.process.wait(timeout=PATIENCE_S)

    def status(self):
        told = subprocess.run(
            [sys.executable, "-m", "station.cli", "status", self.site, "--json"],
            capture_output=True, text=True, check=True, timeout=30,
        )  # fmt: skip
        return json.loads(told.stdout)

    def scans(self):
        if not (self.folder / "data" / "series.nc").exists():
            return []
        with station.open(self.folder / "data") as series:
            assert np.all(np.diff(series.time.values.astype(np.int64)) > 0)
            return [str(scan) for scan in series.scan_id.values]

    def await_(self, what):
        until = time.monotonic() + PATIENCE_S
        while not what():
            assert self.process.poll() is None, (self.folder / "log").read_text()
            assert time.monotonic() < until, (self.folder / "log").read_text()
            time.sleep(0.2)

    def log(self):
        return (self.folder / "log").read_text()


@pytest.fixture
def service(tmp_path):
    folder = tmp_path / "station"
    simulate(folder, tiny(hours=6))
    site = (folder / "site.toml").read_text()
    (folder / "site.toml").write_text(site.replace("settle_s = 2 ", "settle_s = 0.3 "))
    (folder / "inbox").rename(folder / "later")
    (folder / "inbox").mkdir()
    made = Service(folder)
    yield made
    if made.process is not None and made.process.poll() is None:
        made.process.kill()
        made.process.wait()


def drop(service, *hours):
    for hour in hours:
        for path in sorted((service.folder / "later").glob(f"250715_{hour:02d}0000*"), reverse=True):
            shutil.copy(path, service.folder / "inbox" / path.name)


def names(*hours):
    return [f"250715_{hour:02d}0000" for hour in hours]


def test_a_day_in_the_life_of_a_station(service):
    service.start()
    drop(service, 0, 1)
    service.await_(lambda: service.scans() == names(0, 1))
    assert "Traceback" not in service.log(), service.log()[-12_000:]

    # The power goes while a scan is on its way, more than once.
    for hour in (2, 3):
        drop(service, hour)
        time.sleep(0.9)
        service.end(signal.SIGKILL)
        service.start()
    service.await_(lambda: service.scans() == names(0, 1, 2, 3))
    told = len(service.log())  # perhaps by a child that nobody was left to tell its work: an EOFError

    # A late start of the copy, a truncated file, a link, the same file again.
    whole = (service.folder / "later" / "250715_040000.laz").read_bytes()
    (service.folder / "inbox" / "250715_040000-incl.txt").write_bytes(
        (service.folder / "later" / "250715_040000-incl.txt").read_bytes()
    )
    (service.folder / "inbox" / "250715_040000.laz").write_bytes(whole[: len(whole) // 2])
    (service.folder / "inbox" / "250715_100000.laz").symlink_to("/etc/passwd")
    os.utime(service.folder / "inbox" / "250715_010000.laz")
    drop(service, 5)
    service.await_(lambda: service.scans() == names(0, 1, 2, 3, 5))
    service.await_(lambda: service.status()["counts"]["set_aside"] == 2)
    reasons = {path.name: path.read_text() for path in (service.folder / "data" / "set_aside").iterdir()}
    assert "cut off or corrupt" in reasons["250715_040000.laz.txt"]
    assert "is a link" in reasons["250715_100000.laz.txt"]

    # A broken file is not waited with until its log comes.
    (service.folder / "inbox" / "250715_110000.laz").write_bytes(b"LASF" + bytes(500))
    service.await_(lambda: service.status()["counts"]["set_aside"] == 3)

    # The whole file comes after all and takes its right place.
    (service.folder / "inbox" / "250715_040000.laz").write_bytes(whole)
    service.await_(lambda: service.scans() == names(0, 1, 2, 3, 4, 5))
    assert service.end(signal.SIGTERM) == 0
    assert "Traceback" not in service.log()[told:], service.log()[-12_000:]

    with station.open(service.folder / "data") as series:
        assert np.isfinite(series.elevation_change.values).any(axis=(1, 2)).all()
        assert set(series.reference_version.values.tolist()) == {"1", "2"}  # a better one at four scans
        assert "joint" in series.adjustment.values.tolist()
        # Another start without anything new does nothing.
        before = series.load()
    files = sorted((service.folder / "data" / "epochs").rglob("*.nc"))
    service.start()
    service.await_(lambda: "service=running" in service.log().rpartition("service=stopped")[2])
    time.sleep(1.5)
    assert service.end(signal.SIGTERM) == 0
    assert sorted((service.folder / "data" / "epochs").rglob("*.nc")) == files
    with station.open(service.folder / "data") as series:
        assert series.load().identical(before)


def test_a_second_service_on_the_same_data_is_refused(service):
    service.start()
    drop(service, 0)
    service.await_(lambda: service.scans() == names(0))
    second = subprocess.run(
        [sys.executable, "-m", "station.cli", "run", service.site],
        capture_output=True, text=True, check=False, timeout=PATIENCE_S,
    )  # fmt: skip
    assert second.returncode == 75
    assert "in use by another station process" in second.stderr


def test_reload_takes_a_good_site_file_and_keeps_the_old_one_for_a_bad(service):
    service.start()
    drop(service, 0)
    service.await_(lambda: service.scans() == names(0))
    good = service.site.read_text()
    service.site.write_text(good.replace("cell_m = 5.0", "cell_m = 5.1"))
    service.process.send_signal(signal.SIGHUP)
    service.await_(lambda: "reload=refused" in service.log())
    service.site.write_text(good.replace("settle_s = 0.3", "settle_s = 0.2"))
    service.process.send_signal(signal.SIGHUP)
    service.await_(lambda: "reload=done" in service.log())
    drop(service, 1)
    service.await_(lambda: service.scans() == names(0, 1))


def test_a_bad_site_file_does_not_start(tmp_path):
    (tmp_path / "site.toml").write_text("[station]\n")
    done = subprocess.run(
        [sys.executable, "-m", "station.cli", "run", tmp_path / "site.toml"],
        capture_output=True, text=True, check=False, timeout=PATIENCE_S,
    )  # fmt: skip
    assert done.returncode == 78
    assert "station.id: missing" in done.stderr


@pytest.mark.slow
def test_random_kills_lose_nothing_and_change_no_value(service, tmp_path):
    """Twenty kills at random moments; then every value is that of an undisturbed run."""
    seed = int(np.random.default_rng().integers(1 << 30))
    rng = np.random.default_rng(seed)
    for kill in range(20):
        service.start()
        drop(service, kill % 6)
        time.sleep(rng.uniform(0.3, 2.5))
        service.end(signal.SIGKILL)
    service.start()
    drop(service, *range(6))
    service.await_(lambda: service.scans() == names(*range(6)))
    service.await_(lambda: service.status()["counts"]["waiting"] == 0)
    assert service.end(signal.SIGTERM) == 0

    quiet = Service(tmp_path / "quiet")
    shutil.copytree(service.folder, quiet.folder, ignore=shutil.ignore_patterns("data", "log"))
    quiet.start()
    quiet.await_(lambda: quiet.scans() == names(*range(6)))
    quiet.await_(lambda: quiet.status()["counts"]["waiting"] == 0)
    assert quiet.end(signal.SIGTERM) == 0
    with station.open(service.folder / "data") as told, station.open(quiet.folder / "data") as wanted:
        for name in set(wanted.variables) - {"epoch_file"}:  # a revision more or less is no other value
            assert told[name].identical(wanted[name]), f"{name}, seed {seed}"
