"""The service as a process: backlog, events, reload, pauses, stop, and recovery after kills."""

from __future__ import annotations

import os
import random
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace

import pytest
from support.fake_service import FakeWorker

from station.clock import Clock
from station.errors import ConfigError, NotReadyError, StoreError
from station.inbox.journal_reader import JournalReader, State
from station.inbox.lock import is_locked, read_identity
from station.monitoring.status import status
from station.service import daemon
from station.service.host import Host

FAKE = Path(__file__).parents[1] / "support" / "fake_service.py"
FIRST, SECOND, THIRD = "261121_010000.laz", "261121_020000.laz", "261121_030000.laz"


def test_service_without_worker_processes_ends_for_systemd(write_site):
    """A restart gives it a new fork server and a new place in its control group."""
    tasks = SimpleNamespace(seconds_without_worker=lambda: 301.0)
    service = daemon.Daemon(write_site(), FakeWorker, daemon.LoopTiming(), Host(tasks=tasks))
    with pytest.raises(NotReadyError, match="no worker process could be started for 301 s"):
        service.serve()


def test_folder_that_the_first_start_creates_is_remembered_at_once(write_site, monkeypatch, tmp_path):
    """Another disk may be in its place at the second."""
    site_path = write_site()
    data = site_path.parent / "data"
    shutil.rmtree(data, ignore_errors=True)
    state = tmp_path / "state"
    state.mkdir()
    monkeypatch.setenv("STATE_DIRECTORY", str(state))
    service = daemon.Daemon(site_path, FakeWorker, daemon.LoopTiming(), Host())
    service.stop()
    service.serve()
    assert (state / "data_folder").read_text() == f"{data}\n{read_identity(data)}\n"
    data.rename(tmp_path / "right")
    data.mkdir()
    with pytest.raises(StoreError, match="is not the folder of the stored series"):
        daemon.Daemon(site_path, FakeWorker, daemon.LoopTiming(), Host()).serve()


def test_journal_and_store_are_reconciled_again_after_a_failed_task_on_the_store(write_site):
    """It may have moved a damaged epoch away and not queued its scan yet."""
    service = daemon.Daemon(write_site(), FakeWorker, daemon.LoopTiming(), Host())
    failures = [StoreError("the disk is full")]

    class Worker(FakeWorker):
        def recover(self):
            self.record_call("recover")
            if not failures:
                service.stop()

        def run_maintenance(self):
            self.record_call("maintenance")
            if failures:
                raise failures.pop()

    service._make_worker = Worker
    service._timing = daemon.LoopTiming(first_pause_s=0.01)
    service.serve()
    path = service._site.path
    assert calls(path)[:4] == ["recover", "compact", "maintenance", "recover"]


class Service:
    """A running service, its notifications to systemd and its log."""

    def __init__(self, site_path, *, period_s, grace_s, extra):
        self.folder = site_path.parent
        self.address = self.folder / "n"
        self.receiver = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.receiver.bind(str(self.address))
        self.receiver.settimeout(0.05)
        self.received = []
        self.is_listening = True
        self.listener = threading.Thread(target=self.listen)
        self.listener.start()
        self.log_path = self.folder / "log"
        self.log_file = self.log_path.open("a")
        environment = {**os.environ, "NOTIFY_SOCKET": str(self.address), **extra}
        environment.pop("JOURNAL_STREAM", None)
        self.process = subprocess.Popen(
            [sys.executable, str(FAKE), str(site_path), str(period_s), str(grace_s)],
            stderr=self.log_file,
            env=environment,
        )

    def listen(self):
        """Receive notifications at once, as systemd does: a sender blocks on a full socket."""
        while self.is_listening:
            with suppress(TimeoutError):
                self.received.append(self.receiver.recv(4096).decode())

    def notifications(self):
        return list(self.received)

    def log(self):
        return self.log_path.read_text()

    def end(self, signal_number=signal.SIGTERM):
        self.process.send_signal(signal_number)
        return self.process.wait(20)

    def close(self):
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait(20)
        self.log_file.close()
        self.is_listening = False
        self.listener.join()
        self.receiver.close()
        self.address.unlink(missing_ok=True)


@pytest.fixture
def start():
    running = []

    def launch(site_path, *, period_s=30.0, grace_s=5.0, ready=True, **extra):
        service = Service(site_path, period_s=period_s, grace_s=grace_s, extra=extra)
        running.append(service)
        if ready:
            wait_for(lambda: "READY=1" in service.notifications())
        return service

    yield launch
    for service in running:
        service.close()


def wait_for(condition, within_s=15.0):
    until_s = time.monotonic() + within_s
    while not condition():
        assert time.monotonic() < until_s, f"not within {within_s:g} s"
        time.sleep(0.01)


def stored(site_path):
    folder = site_path.parent / "data" / "stored"
    return sorted(path.name for path in folder.glob("[!.]*"))


def calls(site_path):
    path = site_path.parent / "data" / "calls"
    return path.read_text().splitlines() if path.exists() else []


def drop(site_path, name, content="scan"):
    """Put a scan into the inbox as transfers do: under another name, then renamed."""
    inbox = site_path.parent / "inbox"
    (inbox / f".{name}").write_text(content)
    (inbox / f".{name}").replace(inbox / name)


def test_backlog_is_processed_in_order_then_new_scans(write_site, start):
    path = write_site(settle_s=0.05)
    for name in (THIRD, FIRST):
        drop(path, name)
    service = start(path)
    wait_for(lambda: stored(path) == [FIRST, THIRD])
    drop(path, SECOND)
    wait_for(lambda: len(stored(path)) == 3, within_s=5.0)
    assert [line for line in calls(path) if "process" in line] == [
        f"process {name}" for name in (FIRST, THIRD, SECOND)
    ]
    assert calls(path)[0] == "recover"
    assert {"compact", "maintenance"} < set(calls(path))
    notifications = service.notifications()
    assert notifications.index("READY=1") >= 0
    wait_for(lambda: "STATUS=3 stored, 0 waiting, 0 set aside" in service.notifications())
    assert any(notification.startswith(f"STATUS=measuring {FIRST}, ") for notification in notifications)


@pytest.mark.integration
def test_polled_inbox_finds_new_scans(write_site, start):
    path = write_site(settle_s=0.05, polling="true")
    start(path, period_s=0.2)
    drop(path, FIRST)
    wait_for(lambda: stored(path) == [FIRST])


@pytest.mark.integration
def test_inbox_may_be_removed_and_recreated(write_site, start):
    path = write_site(settle_s=0.05)
    service = start(path, period_s=0.5)
    inbox = path.parent / "inbox"
    for turn, name in enumerate((FIRST, SECOND, THIRD)):
        shutil.rmtree(inbox)
        if turn:
            wait_for(lambda: "cannot be listed" in service.log())
        inbox.mkdir()
        drop(path, name)
        wait_for(lambda: name in stored(path))  # noqa: B023 - called at once
    assert service.process.poll() is None


@pytest.mark.integration
def test_service_pauses_while_another_folder_is_in_place_of_its_data(write_site, start):
    """As after `umount -l`: the mount point, an empty folder, comes to light."""
    path = write_site(settle_s=0.0)
    service = start(path, period_s=0.1)
    drop(path, FIRST)
    wait_for(lambda: "STATUS=1 stored, 0 waiting, 0 set aside" in service.notifications())
    data = path.parent / "data"
    data.rename(path.parent / "elsewhere")
    data.mkdir()
    drop(path, SECOND)
    wait_for(lambda: "another folder is in its place" in service.log())
    time.sleep(0.3)
    assert list(data.iterdir()) == []
    data.rmdir()
    (path.parent / "elsewhere").rename(data)
    wait_for(lambda: stored(path) == [FIRST, SECOND])
    wait_for(lambda: "service=resumed" in service.log())


@pytest.mark.integration
def test_deleted_lock_is_taken_again(write_site, start):
    path = write_site(settle_s=0.0)
    start(path, period_s=0.1)
    lock = path.parent / "data" / "service.lock"
    lock.unlink()
    wait_for(lambda: lock.exists() and is_locked(lock.parent))


@pytest.mark.integration
def test_bad_scans_and_bugs_do_not_stop_the_service(write_site, start):
    path = write_site(settle_s=0.0)
    (path.parent / "inbox" / "link.laz").symlink_to("/etc/passwd")
    os.mkfifo(path.parent / "inbox" / "pipe.laz")
    for name in ("261120_bad.laz", "261120_bug.laz", "a\nb.laz", FIRST):
        drop(path, name)
    service = start(path)
    wait_for(lambda: stored(path) == [FIRST])
    wait_for(lambda: "STATUS=1 stored, 1 waiting, 4 set aside" in service.notifications())
    report = status(daemon.read_site(path))
    assert report["service"] == "running"
    assert report["counts"] == {"waiting": 0, "stored": 1, "set_aside": 4, "later": 1}
    assert {scan["scan"]: scan["reason"].split(":")[0] for scan in report["set_aside"]} == {
        "261120_bad.laz": "cut off",
        "a\\nb.laz": "the name has special characters, a space at its end, or is too long",
        "link.laz": "is a link",
        "pipe.laz": "is a pipe",
    }
    assert report["waiting"][0]["for"] == "a bug: ZeroDivisionError: division by zero"
    assert report["last"]["figures"] == {"points": 4}
    assert "ZeroDivisionError" in service.log()


@pytest.mark.integration
def test_retry_beside_the_running_service(write_site, start):
    path = write_site(settle_s=0.0)
    drop(path, "261120_bad.laz")
    start(path, period_s=0.2)
    wait_for(lambda: "process 261120_bad.laz" in calls(path))
    result = subprocess.run(
        [sys.executable, "-m", "station", "retry", str(path)], capture_output=True, text=True, check=True
    )
    assert result.stdout == "261120_bad.laz: queued\n1 scans, tried again within a minute\n"
    wait_for(lambda: calls(path).count("process 261120_bad.laz") == 2)


@pytest.mark.integration
def test_bug_in_housekeeping_is_logged_and_survived(write_site, start):
    path = write_site(settle_s=0.0)
    (path.parent / "data").mkdir(exist_ok=True)
    (path.parent / "data" / "bug").touch()
    service = start(path)
    wait_for(lambda: "maintenance" in calls(path))
    assert calls(path) == ["recover", "compact", "maintenance"]
    assert 'failed=compact reason="a bug: please report it"' in service.log()
    drop(path, FIRST)
    wait_for(lambda: stored(path) == [FIRST])
    assert service.end() == 0


@pytest.mark.integration
def test_sigterm_abandons_the_scan_after_the_grace_period(write_site, start):
    path = write_site(settle_s=0.0)
    drop(path, "slow.laz")
    service = start(path, grace_s=0.5)
    wait_for(lambda: "process slow.laz" in calls(path))
    start_s = time.monotonic()
    assert service.end() == 0
    assert 0.4 < time.monotonic() - start_s < 4.0
    assert stored(path) == []
    with JournalReader(path.parent / "data" / "journal.sqlite") as journal:
        assert journal.entry("slow.laz").state is State.LATER
    assert "STOPPING=1" in service.notifications()
    assert service.log().splitlines()[-1].endswith("service=stopped")


@pytest.mark.integration
def test_second_signal_ends_the_grace_period(write_site, start):
    path = write_site(settle_s=0.0)
    drop(path, "slow.laz")
    service = start(path, grace_s=60.0)
    wait_for(lambda: "process slow.laz" in calls(path))
    service.process.send_signal(signal.SIGTERM)
    time.sleep(0.1)
    start_s = time.monotonic()
    assert service.end(signal.SIGINT) == 0
    assert time.monotonic() - start_s < 4.0


@pytest.mark.integration
def test_reload_applies_a_valid_site_file_and_rejects_an_invalid_one(write_site, start):
    path = write_site(settle_s=0.0)
    service = start(path)
    path.write_text(path.read_text().replace("settle_s", "setle_s"))
    service.process.send_signal(signal.SIGHUP)
    wait_for(lambda: "reload=rejected" in service.log())
    assert "did you mean 'settle_s'" in service.log()
    wait_for(
        lambda: any("site file was rejected" in notification for notification in service.notifications())
    )
    drop(path, FIRST)
    wait_for(lambda: stored(path) == [FIRST])
    new_inbox = path.parent / "inbox2"
    new_inbox.mkdir()
    path.write_text(path.read_text().replace("setle_s", "settle_s").replace('"inbox"', '"inbox2"'))
    service.process.send_signal(signal.SIGHUP)
    wait_for(lambda: "reload=done" in service.log())
    (new_inbox / SECOND).write_text("scan")
    wait_for(lambda: stored(path) == [FIRST, SECOND])
    notifications = service.notifications()
    reloading = next(notification for notification in notifications if notification.startswith("RELOADING=1"))
    name, value = reloading.splitlines()[1].split("=")
    assert name == "MONOTONIC_USEC"
    assert 0 <= time.monotonic() - int(value) / 1e6 < 60
    assert "READY=1" in notifications[notifications.index(reloading) :]


@pytest.mark.integration
def test_new_data_folder_requires_a_restart(write_site, start):
    path = write_site(settle_s=0.0)
    service = start(path)
    path.write_text(path.read_text().replace('"data"', '"data2"'))
    service.process.send_signal(signal.SIGHUP)
    wait_for(lambda: "restart the service" in service.log())
    assert not (path.parent / "data2").exists()


@pytest.mark.integration
def test_service_pauses_on_a_full_disk_and_resumes(write_site, start):
    path = write_site(settle_s=0.0)
    (path.parent / "data" / "full").touch()
    drop(path, FIRST)
    service = start(path)
    wait_for(lambda: "STATUS=paused: no space left on the device" in service.notifications())
    time.sleep(0.5)
    assert service.log().count("service=paused") == 1
    (path.parent / "data" / "full").unlink()
    wait_for(lambda: stored(path) == [FIRST])
    wait_for(lambda: "service=resumed" in service.log())
    assert calls(path).count("recover") > 1  # reconciles store and journal after the interruption


@pytest.mark.integration
def test_second_service_on_the_same_data_is_rejected(write_site, start):
    path = write_site()
    first = start(path)
    second = subprocess.run(
        [sys.executable, str(FAKE), str(path), "30", "5"], capture_output=True, text=True, check=False
    )
    assert second.returncode != 0
    assert f"in use by another station process (pid {first.process.pid})" in second.stderr


@pytest.mark.integration
def test_watchdog_notifications_follow_progress(write_site, start):
    path = write_site(settle_s=0.0)
    drop(path, "slow.laz")
    service = start(path, WATCHDOG_USEC="300000")
    wait_for(lambda: "process slow.laz" in calls(path))
    initial = service.notifications().count("WATCHDOG=1")
    wait_for(lambda: service.notifications().count("WATCHDOG=1") >= initial + 3)
    os.kill(service.process.pid, signal.SIGSTOP)
    time.sleep(0.3)
    count_while_stopped = len(service.notifications())
    time.sleep(0.5)
    assert len(service.notifications()) == count_while_stopped
    os.kill(service.process.pid, signal.SIGCONT)


@pytest.mark.integration
def test_idle_service_notifies_within_a_third_of_the_watchdog_time(write_site, start):
    service = start(write_site(), WATCHDOG_USEC="600000")
    initial = service.notifications().count("WATCHDOG=1")
    time.sleep(1.2)
    assert service.notifications().count("WATCHDOG=1") - initial >= 3


@pytest.mark.integration
def test_overdue_scan_is_logged_once(write_site, start):
    path = write_site(settle_s=0.0, expected_every_s=0.4)
    service = start(path, period_s=0.2)
    wait_for(lambda: "scans=overdue" in service.log())
    time.sleep(0.8)
    assert service.log().count("scans=overdue") == 1
    drop(path, FIRST)
    wait_for(lambda: 'scans="arriving again"' in service.log())
    wait_for(lambda: service.log().count("scans=overdue") == 2)


@pytest.mark.integration
def test_twenty_kills_lose_and_duplicate_no_scan(write_site, start):
    rng = random.Random(11)  # noqa: S311 - no secret
    path = write_site(settle_s=0.0)
    names = [f"2611{day:02d}_{hour:02d}0000.laz" for day in range(1, 11) for hour in range(24)]
    contents = {name: f"{name} {i}" for i, name in enumerate(names)}
    (path.parent / "inbox" / "bad.laz").write_text("bad")
    waiting = list(names)
    for _ in range(20):
        service = start(path, period_s=0.1, ready=False)
        for name in waiting[:12]:
            drop(path, name, contents[name])
        waiting = waiting[12:]
        call_count = len(calls(path))
        wait_for(lambda: len(calls(path)) > call_count)  # noqa: B023 - called at once
        time.sleep(rng.random() * 0.1)
        service.end(signal.SIGKILL)
        service.close()
    service = start(path, period_s=0.1)
    wait_for(lambda: len(stored(path)) == len(names))
    wait_for(lambda: "STATUS=240 stored, 0 waiting, 1 set aside" in service.notifications())
    assert service.end() == 0
    actual = {file.name: file.read_text() for file in (path.parent / "data" / "stored").glob("[!.]*")}
    assert actual == contents
    processed = [line for line in calls(path) if line.startswith("process")]
    assert len(processed) <= len(names) + 1 + 20  # after a kill, at most the interrupted scan is repeated


def test_invalid_site_file_is_rejected_at_start(tmp_path):
    path = tmp_path / "site.toml"
    path.write_text("[station]\n")
    with pytest.raises(ConfigError) as caught:
        daemon.run(path)
    assert caught.value.exit_status == 78


def test_doubtful_clock_is_waited_for_then_accepted(write_site, caplog):
    path = write_site()
    series = path.parent / "data" / "series.nc"
    series.touch()
    in_two_days_s = time.time() + 2 * 86400
    os.utime(series, (in_two_days_s, in_two_days_s))
    timing = daemon.LoopTiming(first_pause_s=0.05, clock_wait_s=0.2)
    doubtful = daemon.Daemon(path, lambda *_, **__: None, timing, Host())
    start_s = time.monotonic()
    doubtful._wait_for_clock()
    assert 0.2 <= time.monotonic() - start_s < 2.0
    assert "clock=doubtful" in caplog.text
    host = Host(clock=Clock(now_s=lambda: 1000.0))
    impossible = daemon.Daemon(path, lambda *_, **__: None, timing, host)
    impossible.stop()
    impossible.serve()
