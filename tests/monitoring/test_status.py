"""Notifications to systemd and the status report."""

from __future__ import annotations

import json
import os
import socket

import pytest

from station.inbox.journal import Journal
from station.inbox.lock import exclusive_lock
from station.monitoring.status import format_status, status
from station.service.systemd import SystemdNotifier, notify


class Systemd:
    """A socket in place of that of systemd."""

    def __init__(self, address):
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.socket.bind(address)
        self.socket.setblocking(False)

    def received(self):
        messages = []
        while True:
            try:
                messages.append(self.socket.recv(4096).decode())
            except BlockingIOError:
                return messages


@pytest.fixture(params=["file", "abstract"])
def systemd(request, tmp_path, monkeypatch):
    name = (
        f"@station-test-{os.getpid()}-{tmp_path.name}" if request.param == "abstract" else str(tmp_path / "n")
    )
    listener = Systemd(name.replace("@", "\0", 1) if name.startswith("@") else name)
    monkeypatch.setenv("NOTIFY_SOCKET", name)
    monkeypatch.delenv("WATCHDOG_USEC", raising=False)
    monkeypatch.delenv("WATCHDOG_PID", raising=False)
    yield listener
    listener.socket.close()


def test_notifications_from_start_to_stop(systemd, monkeypatch):
    now = [100.0]
    monkeypatch.setenv("WATCHDOG_USEC", "180000000")
    notifier = SystemdNotifier(lambda: now[0])
    assert notifier.max_wait_s == 60.0
    notifier.watchdog()
    notifier.ready()
    notifier.ready()
    notifier.watchdog()
    now[0] += 1.0
    for _ in range(1000):
        notifier.watchdog()
    notifier.status("3 stored")
    notifier.status("3 stored")
    notifier.status("two\nlines")
    notifier.stopping()
    assert systemd.received() == [
        "EXTEND_TIMEOUT_USEC=120000000",
        "READY=1",
        "WATCHDOG=1",
        "STATUS=3 stored",
        "STATUS=two lines",
        "STOPPING=1",
    ]


def test_watchdog_of_another_process_is_ignored(systemd, monkeypatch):
    monkeypatch.setenv("WATCHDOG_USEC", "3000000")
    monkeypatch.setenv("WATCHDOG_PID", "1")
    assert SystemdNotifier().max_wait_s == 60.0
    assert systemd.received() == []


def test_notification_without_systemd_is_harmless(monkeypatch, tmp_path):
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    notify("READY=1")
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "nobody"))
    notify("READY=1")


def test_status_before_the_first_start(make_site):
    site = make_site()
    (site.scans.inbox / "261121_010000.laz").touch()
    report = status(site)
    assert report["service"] == "not running"
    assert report["last"] is None
    assert report["series"] is None
    assert [scan["scan"] for scan in report["waiting"]] == ["261121_010000.laz"]
    assert "not running" in report["waiting"][0]["for"]
    assert sorted(path.name for path in site.station.data.iterdir()) == []


def test_status_tells_why_the_service_pauses(make_site):
    """For instance for a fault of the store that status itself cannot see; what it sees is reported once."""
    site = make_site()
    with exclusive_lock(site.station.data) as folder:
        for reason in ("epoch.nc: damaged\nat byte 7", f"the inbox {site.scans.inbox} cannot be listed: no"):
            folder.record_pause(reason)
            report = status(site)
            assert report["service"] == "paused"
            assert report["faults"] == [" ".join(reason.split())]
            assert (site.station.data / "service.lock").stat().st_size == 4096
        for odd in ("", "a"):  # a text that is too long is cut, not within a character of two bytes
            folder.record_pause(odd + "é" * 4000)
            cut = status(site)["faults"][0]
            assert cut == odd + "é" * len(cut.removeprefix(odd))
            assert 2040 < len(cut) < 2048
        folder.record_pause("")
        report = status(site)
        assert (report["service"], report["faults"]) == ("running", [])
        folder.record_pause("killed meanwhile")
    report = status(site)
    assert (report["service"], report["faults"]) == ("not running", [])


@pytest.mark.parametrize("running", [False, True])
def test_status_lists_waiting_and_rejected_scans_with_reasons(make_site, running):
    site = make_site()
    now_s = 1_795_243_146.0
    with Journal(site.station.data / "journal.sqlite", now_s=lambda: now_s) as journal:
        journal.record_seen([("w.laz", 1, 1, "its inclination log"), ("l.laz", 1, 1, "")])
        journal.defer("l.laz", "the weather log is missing")
        journal.set_aside("bad.laz", "cut off after 12 of 40 points")
        journal.record_stored(
            "good.laz",
            sha256="aa",
            verdict="degraded",
            reason="no log",
            epoch="epochs/a.nc",
            start_utc_s=now_s - 3600,
            revision=1,
            metrics={"points": 12, "sigma_median_m": float("nan")},
        )
        if running:
            with exclusive_lock(site.station.data):
                report = status(site)
    if not running:
        report = status(site)
    assert report["service"] == ("running" if running else "not running")
    assert report["counts"] == {"waiting": 1, "stored": 1, "set_aside": 1, "later": 1}
    assert report["faults"] == []
    parsed = json.loads(json.dumps(report, allow_nan=False))
    assert parsed["last"]["figures"] == {"points": 12, "sigma_median_m": None}
    assert parsed["last"]["start"] == "2026-11-21T05:39:06Z"
    lines = format_status(report).splitlines()
    assert "scans    1 stored, 1 set aside, 2 waiting" in lines
    assert "last     good.laz of 2026-11-21T05:39:06Z: degraded (no log) points=12" in lines
    assert "waits    w.laz: its inclination log" in lines
    assert "waits    l.laz: the weather log is missing, next try 2026-11-21T06:39:36Z" in lines
    assert "aside    bad.laz: cut off after 12 of 40 points" in lines


def test_status_names_missing_folders(make_site):
    site = make_site()
    site.scans.inbox.rmdir()
    site.station.data.rmdir()
    report = status(site)
    assert any("inbox" in fault for fault in report["faults"])
    assert any("data folder" in fault for fault in report["faults"])
    assert "no data folder yet" in format_status(report)
