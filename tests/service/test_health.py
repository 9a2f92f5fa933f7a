"""What the service says of itself: to systemd, and to the person who asks for its status."""

from __future__ import annotations

import json
import os
import socket

import pytest

from station.errors import StoreError
from station.service import health
from station.service.health import Heart, describe, need_room, notify, status
from station.service.journal import Journal
from station.service.lock import only_writer


class Systemd:
    """Stands where systemd listens."""

    def __init__(self, address):
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.socket.bind(address)
        self.socket.setblocking(False)

    def heard(self):
        words = []
        while True:
            try:
                words.append(self.socket.recv(4096).decode())
            except BlockingIOError:
                return words


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


def test_a_life_as_systemd_hears_it(systemd, monkeypatch):
    now = [100.0]
    monkeypatch.setenv("WATCHDOG_USEC", "180000000")
    heart = Heart(lambda: now[0])
    assert heart.longest_wait_s == 60.0
    heart.ping()
    heart.ready()
    heart.ready()
    heart.ping()
    now[0] += 1.0
    for _ in range(1000):
        heart.ping()
    heart.status("3 stored")
    heart.status("3 stored")
    heart.status("two\nlines")
    heart.stopping()
    assert systemd.heard() == [
        "EXTEND_TIMEOUT_USEC=120000000",
        "READY=1",
        "WATCHDOG=1",
        "STATUS=3 stored",
        "STATUS=two lines",
        "STOPPING=1",
    ]


def test_a_watchdog_meant_for_another_process_is_not_ours(systemd, monkeypatch):
    monkeypatch.setenv("WATCHDOG_USEC", "3000000")
    monkeypatch.setenv("WATCHDOG_PID", "1")
    assert Heart().longest_wait_s == 60.0
    assert systemd.heard() == []


def test_without_systemd_nothing_is_said(monkeypatch, tmp_path):
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    notify("READY=1")
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "nobody"))
    notify("READY=1")


class Disk:
    """What statvfs would say."""

    f_frsize, f_bavail, f_files, f_favail = 4096, 10_000_000, 1000, 1000

    def __init__(self, **changes):
        self.__dict__.update(changes)


def test_room_is_asked_for_before_work(make_site, monkeypatch):
    site = make_site()
    need_room(site)
    for disk, said in ((Disk(f_bavail=1000), "4 MB free, 16 MB needed"), (Disk(f_favail=3), "inodes")):
        monkeypatch.setattr(health.os, "statvfs", lambda _, disk=disk: disk)
        with pytest.raises(StoreError, match=said):
            need_room(site)
    monkeypatch.setattr(health.os, "statvfs", lambda _: Disk(f_files=0, f_favail=0))  # btrfs counts none
    need_room(site)


def test_status_before_anything_was_ever_done(make_site):
    site = make_site()
    (site.scans.inbox / "261121_010000.laz").touch()
    found = status(site)
    assert found["service"] == "not running"
    assert found["last"] is None
    assert found["series"] is None
    assert [one["scan"] for one in found["waiting"]] == ["261121_010000.laz"]
    assert "not running" in found["waiting"][0]["for"]
    assert sorted(path.name for path in site.station.data.iterdir()) == []


@pytest.mark.parametrize("running", [False, True])
def test_status_tells_what_waits_and_what_was_set_aside_and_why(make_site, running):
    site = make_site()
    now_s = 1_795_243_146.0
    with Journal(site.station.data / "journal.sqlite", now_s=lambda: now_s) as journal:
        journal.seen([("w.laz", 1, 1, "its inclination log"), ("l.laz", 1, 1, "")])
        journal.later("l.laz", "the weather log is held")
        journal.set_aside("bad.laz", "cut off after 12 of 40 points")
        journal.stored(
            "good.laz",
            sha256="aa",
            verdict="degraded",
            reason="no log",
            epoch="epochs/a.nc",
            start_utc_s=now_s - 3600,
            revision=1,
            figures={"points": 12, "sigma_median_m": float("nan")},
        )
        if running:
            with only_writer(site.station.data):
                found = status(site)
    if not running:
        found = status(site)
    assert found["service"] == ("running" if running else "not running")
    assert found["counts"] == {"waiting": 1, "stored": 1, "set_aside": 1, "later": 1}
    assert found["faults"] == []
    told = json.loads(json.dumps(found, allow_nan=False))
    assert told["last"]["figures"] == {"points": 12, "sigma_median_m": None}
    assert told["last"]["start"] == "2026-11-21T05:39:06Z"
    lines = describe(found).splitlines()
    assert "scans    1 stored, 1 set aside, 2 waiting" in lines
    assert "last     good.laz of 2026-11-21T05:39:06Z: degraded (no log) points=12" in lines
    assert "waits    w.laz: its inclination log" in lines
    assert "waits    l.laz: the weather log is held, next try 2026-11-21T06:39:36Z" in lines
    assert "aside    bad.laz: cut off after 12 of 40 points" in lines


def test_status_names_what_is_wrong_with_the_place(make_site):
    site = make_site()
    site.scans.inbox.rmdir()
    site.station.data.rmdir()
    found = status(site)
    assert any("inbox" in fault for fault in found["faults"])
    assert any("data folder" in fault for fault in found["faults"])
    assert "no data folder yet" in describe(found)
