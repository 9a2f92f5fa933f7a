"""The service as a process: catches up, hears, reloads, pauses, stops, and survives being killed."""

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

import pytest

from station.errors import ConfigError
from station.service import daemon
from station.service.health import clock_fault, status
from station.service.journal import Journal, State

FAKE = Path(__file__).with_name("fake_service.py")
FIRST, SECOND, THIRD = "261121_010000.laz", "261121_020000.laz", "261121_030000.laz"


class Service:
    """A running service, and what it says to systemd and to its log."""

    def __init__(self, site_path, *, period_s, grace_s, extra):
        self.folder = site_path.parent
        self.address = self.folder / "n"
        self.ear = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.ear.bind(str(self.address))
        self.ear.settimeout(0.05)
        self.said = []
        self.listens = True
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
        """Take every word at once, as systemd does: whoever tells a full socket has to wait."""
        while self.listens:
            with suppress(TimeoutError):
                self.said.append(self.ear.recv(4096).decode())

    def words(self):
        return list(self.said)

    def log(self):
        return self.log_path.read_text()

    def end(self, number=signal.SIGTERM):
        self.process.send_signal(number)
        return self.process.wait(20)

    def close(self):
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait(20)
        self.log_file.close()
        self.listens = False
        self.listener.join()
        self.ear.close()
        self.address.unlink(missing_ok=True)


@pytest.fixture
def start():
    running = []

    def begin(site_path, *, period_s=30.0, grace_s=5.0, ready=True, **extra):
        service = Service(site_path, period_s=period_s, grace_s=grace_s, extra=extra)
        running.append(service)
        if ready:
            wait_for(lambda: "READY=1" in service.words())
        return service

    yield begin
    for service in running:
        service.close()


def wait_for(what, within_s=15.0):
    until_s = time.monotonic() + within_s
    while not what():
        assert time.monotonic() < until_s, "it did not happen in time"
        time.sleep(0.01)


def stored(site_path):
    folder = site_path.parent / "data" / "stored"
    return sorted(path.name for path in folder.glob("[!.]*"))


def did(site_path):
    path = site_path.parent / "data" / "did"
    return path.read_text().splitlines() if path.exists() else []


def drop(site_path, name, content="scan"):
    """Put a scan into the inbox as a transfer does: beside, then renamed."""
    inbox = site_path.parent / "inbox"
    (inbox / f".{name}").write_text(content)
    (inbox / f".{name}").replace(inbox / name)


def test_it_catches_up_in_order_then_hears_what_comes(write_site, start):
    path = write_site(settle_s=0.05)
    for name in (THIRD, FIRST):
        drop(path, name)
    service = start(path)
    wait_for(lambda: stored(path) == [FIRST, THIRD])
    drop(path, SECOND)
    wait_for(lambda: len(stored(path)) == 3, within_s=5.0)
    assert [line for line in did(path) if "take" in line] == [
        f"take {name}" for name in (FIRST, THIRD, SECOND)
    ]
    assert did(path)[0] == "recover"
    assert {"join", "sweep"} < set(did(path))
    words = service.words()
    assert words.index("READY=1") >= 0
    wait_for(lambda: "STATUS=3 stored, 0 waiting, 0 set aside" in service.words())
    assert any(word.startswith(f"STATUS=measuring {FIRST}, ") for word in words)


def test_a_polled_inbox_is_heard_by_its_listing(write_site, start):
    path = write_site(settle_s=0.05, polling="true")
    start(path, period_s=0.2)
    drop(path, FIRST)
    wait_for(lambda: stored(path) == [FIRST])


def test_a_removed_and_remade_inbox_is_survived(write_site, start):
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


def test_bad_scans_and_bugs_take_nothing_down(write_site, start):
    path = write_site(settle_s=0.0)
    (path.parent / "inbox" / "link.laz").symlink_to("/etc/passwd")
    os.mkfifo(path.parent / "inbox" / "pipe.laz")
    for name in ("261120_bad.laz", "261120_bug.laz", "a\nb.laz", FIRST):
        drop(path, name)
    service = start(path)
    wait_for(lambda: stored(path) == [FIRST])
    wait_for(lambda: "STATUS=1 stored, 1 waiting, 4 set aside" in service.words())
    found = status(daemon.read_site(path))
    assert found["service"] == "running"
    assert found["counts"] == {"waiting": 0, "stored": 1, "set_aside": 4, "later": 1}
    assert {one["scan"]: one["reason"].split(":")[0] for one in found["set_aside"]} == {
        "261120_bad.laz": "cut off",
        "a\\nb.laz": "the name has spaces, control or other odd characters, or is too long",
        "link.laz": "is a link",
        "pipe.laz": "is a pipe",
    }
    assert found["waiting"][0]["for"] == "a bug: ZeroDivisionError: division by zero"
    assert found["last"]["figures"] == {"points": 4}
    assert "ZeroDivisionError" in service.log()


def test_a_bug_in_what_no_scan_waits_for_is_told_and_survived(write_site, start):
    path = write_site(settle_s=0.0)
    (path.parent / "data").mkdir(exist_ok=True)
    (path.parent / "data" / "bug").touch()
    service = start(path)
    wait_for(lambda: "sweep" in did(path))
    assert did(path) == ["recover", "join", "sweep"]
    assert 'failed=join reason="a bug: please report it"' in service.log()
    drop(path, FIRST)
    wait_for(lambda: stored(path) == [FIRST])
    assert service.end() == 0


def test_sigterm_lets_the_scan_be_done_or_gives_it_up_after_the_grace(write_site, start):
    path = write_site(settle_s=0.0)
    drop(path, "slow.laz")
    service = start(path, grace_s=0.5)
    wait_for(lambda: "take slow.laz" in did(path))
    begun_s = time.monotonic()
    assert service.end() == 0
    assert 0.4 < time.monotonic() - begun_s < 4.0
    assert stored(path) == []
    with Journal(path.parent / "data" / "journal.sqlite", read_only=True) as journal:
        assert journal.entry("slow.laz").state is State.LATER
    assert "STOPPING=1" in service.words()
    assert service.log().splitlines()[-1].endswith("service=stopped")


def test_a_second_sigterm_does_not_wait_for_the_grace(write_site, start):
    path = write_site(settle_s=0.0)
    drop(path, "slow.laz")
    service = start(path, grace_s=60.0)
    wait_for(lambda: "take slow.laz" in did(path))
    service.process.send_signal(signal.SIGTERM)
    time.sleep(0.1)
    begun_s = time.monotonic()
    assert service.end(signal.SIGINT) == 0
    assert time.monotonic() - begun_s < 4.0


def test_a_good_reload_is_swapped_in_and_a_bad_one_refused(write_site, start):
    path = write_site(settle_s=0.0)
    service = start(path)
    path.write_text(path.read_text().replace("settle_s", "setle_s"))
    service.process.send_signal(signal.SIGHUP)
    wait_for(lambda: "reload=refused" in service.log())
    assert "did you mean 'settle_s'" in service.log()
    wait_for(lambda: any("site file was refused" in word for word in service.words()))
    drop(path, FIRST)
    wait_for(lambda: stored(path) == [FIRST])
    elsewhere = path.parent / "inbox2"
    elsewhere.mkdir()
    path.write_text(path.read_text().replace("setle_s", "settle_s").replace('"inbox"', '"inbox2"'))
    service.process.send_signal(signal.SIGHUP)
    wait_for(lambda: "reload=done" in service.log())
    (elsewhere / SECOND).write_text("scan")
    wait_for(lambda: stored(path) == [FIRST, SECOND])
    words = service.words()
    began = next(word for word in words if word.startswith("RELOADING=1"))
    name, value = began.splitlines()[1].split("=")
    assert name == "MONOTONIC_USEC"
    assert 0 <= time.monotonic() - int(value) / 1e6 < 60
    assert "READY=1" in words[words.index(began) :]


def test_a_moved_data_folder_takes_a_restart(write_site, start):
    path = write_site(settle_s=0.0)
    service = start(path)
    path.write_text(path.read_text().replace('"data"', '"data2"'))
    service.process.send_signal(signal.SIGHUP)
    wait_for(lambda: "takes a restart" in service.log())
    assert not (path.parent / "data2").exists()


def test_a_full_disk_is_waited_out(write_site, start):
    path = write_site(settle_s=0.0)
    (path.parent / "data" / "full").touch()
    drop(path, FIRST)
    service = start(path)
    wait_for(lambda: "STATUS=paused: no space left on the device" in service.words())
    time.sleep(0.5)
    assert service.log().count("service=paused") == 1
    (path.parent / "data" / "full").unlink()
    wait_for(lambda: stored(path) == [FIRST])
    wait_for(lambda: 'service="goes on"' in service.log())
    assert did(path).count("recover") > 1  # what was broken off between file and journal is made to agree


def test_a_second_service_on_the_same_data_is_refused(write_site, start):
    path = write_site()
    first = start(path)
    twin = subprocess.run(
        [sys.executable, str(FAKE), str(path), "30", "5"], capture_output=True, text=True, check=False
    )
    assert twin.returncode != 0
    assert f"in use by another station process (pid {first.process.pid})" in twin.stderr


def test_pings_come_with_progress_and_stop_with_it(write_site, start):
    path = write_site(settle_s=0.0)
    drop(path, "slow.laz")
    service = start(path, WATCHDOG_USEC="300000")
    wait_for(lambda: "take slow.laz" in did(path))
    before = service.words().count("WATCHDOG=1")
    wait_for(lambda: service.words().count("WATCHDOG=1") >= before + 3)
    os.kill(service.process.pid, signal.SIGSTOP)
    time.sleep(0.3)
    silent = len(service.words())
    time.sleep(0.5)
    assert len(service.words()) == silent
    os.kill(service.process.pid, signal.SIGCONT)


def test_an_idle_service_pings_within_a_third_of_the_watchdogs_time(write_site, start):
    service = start(write_site(), WATCHDOG_USEC="600000")
    before = service.words().count("WATCHDOG=1")
    time.sleep(1.2)
    assert service.words().count("WATCHDOG=1") - before >= 3


def test_an_overdue_scan_is_told_once(write_site, start):
    path = write_site(settle_s=0.0, expected_every_s=0.4)
    service = start(path, period_s=0.2)
    wait_for(lambda: "scans=overdue" in service.log())
    time.sleep(0.8)
    assert service.log().count("scans=overdue") == 1
    drop(path, FIRST)
    wait_for(lambda: 'scans="arrive again"' in service.log())
    wait_for(lambda: service.log().count("scans=overdue") == 2)


def test_twenty_kills_lose_and_double_nothing(write_site, start):
    dice = random.Random(11)  # noqa: S311 - no secret
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
        before = len(did(path))
        wait_for(lambda: len(did(path)) > before)  # noqa: B023 - called at once
        time.sleep(dice.random() * 0.1)
        service.end(signal.SIGKILL)
        service.close()
    service = start(path, period_s=0.1)
    wait_for(lambda: len(stored(path)) == len(names))
    wait_for(lambda: "STATUS=240 stored, 0 waiting, 1 set aside" in service.words())
    assert service.end() == 0
    found = {file.name: file.read_text() for file in (path.parent / "data" / "stored").glob("[!.]*")}
    assert found == contents
    takes = [line for line in did(path) if line.startswith("take")]
    assert len(takes) <= len(names) + 1 + 20  # at most the one under way is done again after a kill


def test_a_bad_site_file_is_not_started_with(tmp_path):
    path = tmp_path / "site.toml"
    path.write_text("[station]\n")
    with pytest.raises(ConfigError) as caught:
        daemon.run(path)
    assert caught.value.exit_status == 78


@pytest.mark.parametrize(
    ("now_s", "said"),
    [(0.0, "1970-01-01"), (1_577_836_799.0, "2019-12-31"), (1_700_000_000.0, "was written at"), (None, None)],
)
def test_a_clock_that_cannot_be_right_is_told(tmp_path, now_s, said):
    (tmp_path / "journal.sqlite").touch()
    fault = clock_fault(tmp_path, time.time() if now_s is None else now_s)
    assert (said is None and fault is None) or said in fault


def test_a_doubtful_clock_is_waited_for_and_then_believed(write_site, monkeypatch, caplog):
    path = write_site()
    series = path.parent / "data" / "series.nc"
    series.touch()
    in_two_days_s = time.time() + 2 * 86400
    os.utime(series, (in_two_days_s, in_two_days_s))
    pace = daemon.Pace(first_pause_s=0.05, clock_s=0.2)
    waiting = daemon.Daemon(path, lambda *_, **__: None, pace)
    begun_s = time.monotonic()
    waiting._await_clock()
    assert 0.2 <= time.monotonic() - begun_s < 2.0
    assert "clock=doubtful" in caplog.text
    monkeypatch.setattr(time, "time", lambda: 1000.0)
    hopeless = daemon.Daemon(path, lambda *_, **__: None, pace)
    hopeless.stop()
    hopeless.serve()
