"""The service as a user runs it: a folder, a process, power cuts, broken files."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from support.series import open_with_processing, without_dates

import station
from station.simulation.station import simulate, small

pytestmark = pytest.mark.integration
TIMEOUT_S = 180.0


class Service:
    """`station run` as a child process."""

    def __init__(self, folder):
        self.folder = folder
        self.site = folder / "site.toml"
        self.process = None

    def start(self):
        log = (self.folder / "log").open("a")
        self.process = subprocess.Popen([sys.executable, "-m", "station", "run", self.site], stderr=log)
        log.close()

    def end(self, signal_number):
        self.process.send_signal(signal_number)
        return self.process.wait(timeout=TIMEOUT_S)

    def status(self):
        result = subprocess.run(
            [sys.executable, "-m", "station", "status", self.site, "--json"],
            capture_output=True, text=True, check=True, timeout=30,
        )  # fmt: skip
        return json.loads(result.stdout)

    def scans(self):
        if not (self.folder / "data" / "series.nc").exists():
            return []
        with station.open(self.folder / "data") as series:
            assert np.all(np.diff(series.time.values.astype(np.int64)) > 0)
            return [str(scan) for scan in series.scan_id.values]

    def wait_until(self, condition):
        deadline_s = time.monotonic() + TIMEOUT_S
        while not condition():
            assert self.process.poll() is None, (self.folder / "log").read_text()
            assert time.monotonic() < deadline_s, (self.folder / "log").read_text()
            time.sleep(0.2)

    def log(self):
        return (self.folder / "log").read_text()


@pytest.fixture
def service(tmp_path):
    folder = tmp_path / "station"
    simulate(folder, small(hours=6))
    site = (folder / "site.toml").read_text()
    (folder / "site.toml").write_text(site.replace("settle_s = 2 ", "settle_s = 0.3 "))
    (folder / "inbox").rename(folder / "later")
    (folder / "inbox").mkdir()
    running = Service(folder)
    yield running
    if running.process is not None and running.process.poll() is None:
        running.process.kill()
        running.process.wait()


def drop(service, *hours):
    for hour in hours:
        for path in sorted((service.folder / "later").glob(f"250715_{hour:02d}0000*"), reverse=True):
            shutil.copy(path, service.folder / "inbox" / path.name)


def scan_names(*hours):
    return [f"250715_{hour:02d}0000" for hour in hours]


def test_station_survives_kills_bad_files_and_late_scans(service):
    service.start()
    drop(service, 0, 1)
    service.wait_until(lambda: service.scans() == scan_names(0, 1))
    assert "Traceback" not in service.log(), service.log()[-12_000:]

    # Power cuts while a scan is being processed.
    for hour in (2, 3):
        drop(service, hour)
        time.sleep(0.9)
        service.end(signal.SIGKILL)
        service.start()
    service.wait_until(lambda: service.scans() == scan_names(0, 1, 2, 3))
    logged = len(service.log())  # a worker process killed without its service may log an EOFError

    # A scan copied after its log, a truncated file, a link, a touched file.
    content = (service.folder / "later" / "250715_040000.laz").read_bytes()
    (service.folder / "inbox" / "250715_040000-incl.txt").write_bytes(
        (service.folder / "later" / "250715_040000-incl.txt").read_bytes()
    )
    (service.folder / "inbox" / "250715_040000.laz").write_bytes(content[: len(content) // 2])
    (service.folder / "inbox" / "250715_100000.laz").symlink_to("/etc/passwd")
    os.utime(service.folder / "inbox" / "250715_010000.laz")
    drop(service, 5)
    service.wait_until(lambda: service.scans() == scan_names(0, 1, 2, 3, 5))
    service.wait_until(lambda: service.status()["counts"]["set_aside"] == 2)
    reasons = {path.name: path.read_text() for path in (service.folder / "data" / "set_aside").iterdir()}
    assert "cut off or corrupt" in reasons["250715_040000.laz.txt"]
    assert "is a link" in reasons["250715_100000.laz.txt"]

    # A broken file is rejected without waiting for its log.
    (service.folder / "inbox" / "250715_110000.laz").write_bytes(b"LASF" + bytes(500))
    service.wait_until(lambda: service.status()["counts"]["set_aside"] == 3)

    # The complete file arrives late and is sorted in.
    (service.folder / "inbox" / "250715_040000.laz").write_bytes(content)
    service.wait_until(lambda: service.scans() == scan_names(0, 1, 2, 3, 4, 5))
    assert service.end(signal.SIGTERM) == 0
    assert "Traceback" not in service.log()[logged:], service.log()[-12_000:]

    with open_with_processing(service.folder / "data") as series:
        assert np.isfinite(series.elevation_change.values).any(axis=(1, 2)).all()
        assert set(series.reference_version.values.tolist()) == {"1", "2"}  # replaced at four scans
        assert "joint" in series.adjustment.values.tolist()
        # A restart without new scans changes nothing.
        before = without_dates(series.load())
    files = sorted((service.folder / "data" / "epochs").rglob("*.nc"))
    service.start()
    service.wait_until(lambda: "service=running" in service.log().rpartition("service=stopped")[2])
    time.sleep(1.5)
    assert service.end(signal.SIGTERM) == 0
    assert sorted((service.folder / "data" / "epochs").rglob("*.nc")) == files
    with open_with_processing(service.folder / "data") as series:
        assert without_dates(series.load()).identical(before)


def test_second_service_on_the_same_data_is_rejected(service):
    service.start()
    drop(service, 0)
    service.wait_until(lambda: service.scans() == scan_names(0))
    second = subprocess.run(
        [sys.executable, "-m", "station", "run", service.site],
        capture_output=True, text=True, check=False, timeout=TIMEOUT_S,
    )  # fmt: skip
    assert second.returncode == 75
    assert "in use by another station process" in second.stderr


def test_reload_applies_a_valid_site_file_and_rejects_an_invalid_one(service):
    service.start()
    drop(service, 0)
    service.wait_until(lambda: service.scans() == scan_names(0))
    good = service.site.read_text()
    service.site.write_text(good.replace("cell_m = 5.0", "cell_m = 5.1"))
    service.process.send_signal(signal.SIGHUP)
    service.wait_until(lambda: "reload=rejected" in service.log())
    service.site.write_text(good.replace("settle_s = 0.3", "settle_s = 0.2"))
    service.process.send_signal(signal.SIGHUP)
    service.wait_until(lambda: "reload=done" in service.log())
    drop(service, 1)
    service.wait_until(lambda: service.scans() == scan_names(0, 1))


def test_invalid_site_file_does_not_start(tmp_path):
    (tmp_path / "site.toml").write_text("[station]\n")
    done = subprocess.run(
        [sys.executable, "-m", "station", "run", tmp_path / "site.toml"],
        capture_output=True, text=True, check=False, timeout=TIMEOUT_S,
    )  # fmt: skip
    assert done.returncode == 78
    assert "station.id: missing" in done.stderr


@pytest.mark.slow
def test_random_kills_lose_no_scan_and_change_no_value(service, tmp_path):
    """After twenty kills at random times, every value equals that of an undisturbed run."""
    seed = int(np.random.default_rng().integers(1 << 30))
    rng = np.random.default_rng(seed)
    for kill in range(20):
        service.start()
        drop(service, kill % 6)
        time.sleep(rng.uniform(0.3, 2.5))
        service.end(signal.SIGKILL)
    service.start()
    drop(service, *range(6))
    service.wait_until(lambda: service.scans() == scan_names(*range(6)))
    service.wait_until(lambda: service.status()["counts"]["waiting"] == 0)
    assert service.end(signal.SIGTERM) == 0

    undisturbed = Service(tmp_path / "undisturbed")
    shutil.copytree(service.folder, undisturbed.folder, ignore=shutil.ignore_patterns("data", "log"))
    undisturbed.start()
    undisturbed.wait_until(lambda: undisturbed.scans() == scan_names(*range(6)))
    undisturbed.wait_until(lambda: undisturbed.status()["counts"]["waiting"] == 0)
    assert undisturbed.end(signal.SIGTERM) == 0
    with (
        open_with_processing(service.folder / "data") as actual,
        open_with_processing(undisturbed.folder / "data") as expected,
    ):
        for name in set(expected.variables) - {"epoch_file"}:  # the revision may differ
            assert actual[name].identical(expected[name]), f"{name}, seed {seed}"
