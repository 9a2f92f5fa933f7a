"""Publishing with real processes: rclone, its servers for SSH and WebDAV, a hook, a web server."""

from __future__ import annotations

import json
import os
import shutil
import socket
import sqlite3
import subprocess
import threading
import time
from contextlib import contextmanager, suppress
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import h5py
import pytest
from support.programs import tool
from support.site import char_array

from station.errors import ConfigError, NotReadyError
from station.inbox.lock import exclusive_lock
from station.monitoring.status import queue_status
from station.service.publication import rclone, uploads
from station.service.publication import run as publication

DAY_S = 86_400.0
START_S = 1_752_537_600.0  # 2025-07-15 00:00 UTC


@pytest.fixture(autouse=True)
def _priority_stays(monkeypatch):
    monkeypatch.setattr(publication.os, "nice", lambda _: 0)


@pytest.fixture
def site_with(make_site):
    return lambda text: make_site(more=text)


@pytest.fixture
def add_epoch(tmp_path):
    """Return a function that writes an epoch file of some bytes; it is as old as its hour says."""

    def write(hour, size=2000):
        path = tmp_path / f"data/epochs/2025/07/15/test_20250715T{hour:02d}0000Z.nc"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(os.urandom(size))
        os.utime(path, (START_S + 3600 * hour,) * 2)
        return path

    return write


def target(to, what, more=""):
    return f'[[publish.target]]\nto = "{to}"\nwhat = {what}\n{more}\n'


def publish(site):
    lines = []
    return publication.publish_once(site, lines.append), lines


def contents(folder):
    return {
        path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()
    }


def published(data, *patterns):
    paths = {path for pattern in patterns for path in data.glob(pattern) if path.is_file()}
    return {path.relative_to(data).as_posix(): path.read_bytes() for path in paths}


@pytest.fixture
def folder_target(tmp_path):
    tool("rclone")
    folder = tmp_path / "target"
    folder.mkdir()
    return folder


@pytest.mark.integration
def test_a_target_gets_what_it_lacks_and_nothing_twice(site_with, add_epoch, folder_target, tmp_path):
    site = site_with(target(folder_target, ["areas", "epochs"]))
    areas = tmp_path / "data/areas.nc"
    areas.write_bytes(b"areas 1")
    for hour in range(3):
        add_epoch(hour)
    assert publish(site) == (0, [f"{folder_target}: 4 files sent"])
    assert contents(folder_target) == published(tmp_path / "data", "areas.nc", "epochs/**/*")
    assert publish(site)[1] == [f"{folder_target}: 0 files sent"]
    areas.write_bytes(b"areas 2")  # of equal size
    assert publish(site)[1] == [f"{folder_target}: 1 files sent"]
    assert (folder_target / "areas.nc").read_bytes() == b"areas 2"


@pytest.mark.integration
def test_the_newest_come_first_within_the_bytes_of_a_day(site_with, add_epoch, folder_target):
    for hour in range(6):
        add_epoch(hour, size=100_000)
    site = site_with(target(folder_target, ["epochs"], "daily_mb = 0.25"))
    (site.station.data / "publish").mkdir()
    for now_s, expected_hours in ((0, {4, 5}), (DAY_S / 2, {4, 5}), (DAY_S, {2, 3, 4, 5})):
        uploads.upload(site, site.publish.target[0], now_s=partial(float, now_s))
        assert {int(name[-10:-8]) for name in contents(folder_target)} == expected_hours


@pytest.mark.integration
def test_a_file_beyond_the_bytes_of_a_day_is_named(site_with, add_epoch, folder_target):
    add_epoch(0, size=300_000)
    add_epoch(1, size=100_000)
    status, lines = publish(site_with(target(folder_target, ["epochs"], "daily_mb = 0.25")))
    assert status == 1
    assert len(contents(folder_target)) == 1
    assert "T000000Z.nc has 0.3 MB, more than daily_mb: increase it" in lines[-1]


@pytest.mark.integration
def test_a_day_is_sent_only_if_the_target_lacks_one_of_its_epochs(site_with, add_epoch, folder_target):
    site = site_with(target(folder_target, ["epochs"]))
    epochs = [add_epoch(hour) for hour in range(3)]
    publish(site)
    for name, members in (("test_20250715_r1.nc", epochs), ("test_20250715_r2.nc", [*epochs, add_epoch(3)])):
        day = site.station.data / "days" / name
        day.parent.mkdir(exist_ok=True)
        with h5py.File(day, "w") as file:
            file["time"] = [START_S + 3600.0 * hour for hour in range(len(members))]
            file["epoch_file"] = char_array([path.name for path in members], 64)
    shutil.rmtree(site.station.data / "epochs")  # deleted once a day is compacted, the last one unsent
    publish(site)
    names = {name for name in contents(folder_target) if name.startswith("days")}
    assert names == {"days/test_20250715_r2.nc"}


@pytest.mark.integration
def test_only_its_own_folder_is_written_and_the_service_may_run(
    site_with, add_epoch, folder_target, tmp_path
):
    site = site_with(target(folder_target, ["epochs"]))
    add_epoch(0)
    with exclusive_lock(tmp_path / "data"):  # as the service has
        before = {path: path.stat() for path in (tmp_path / "data").rglob("*")}
        assert publish(site)[0] == 0
        after = {path: path.stat() for path in before}
    ours = {path.relative_to(tmp_path / "data").parts[0] for path in (tmp_path / "data").rglob("*")}
    assert ours == {"epochs", "service.lock", ".store_id", "publish"}
    changed = [path for path in before if before[path].st_mtime_ns != after[path].st_mtime_ns]
    assert changed == [] or changed == [tmp_path / "data"]


@pytest.mark.integration
def test_two_runs_do_not_meet(site_with, folder_target):
    site = site_with(target(folder_target, ["areas"]))
    publish(site)
    with publication._single_instance(site.station.data / "publish"), pytest.raises(NotReadyError):
        publish(site)


@pytest.mark.integration
def test_a_folder_that_is_not_mounted_is_not_created(site_with, add_epoch, tmp_path):
    add_epoch(0)
    site = site_with(target(tmp_path / "usb", ["epochs"]))
    status, lines = publish(site)
    assert status == 1
    assert "no such folder: mount its disk, or create it" in lines[-1]
    assert not (tmp_path / "usb").exists()
    assert [fault for fault in queue_status(site)["faults"] if fault.startswith("not published")]
    (tmp_path / "usb").mkdir()
    tool("rclone")
    assert publish(site)[0] == 0
    assert not [fault for fault in queue_status(site)["faults"] if fault.startswith("not published")]


@pytest.mark.integration
def test_a_full_target_keeps_no_other_from_its_files(site_with, add_epoch, folder_target, tmp_path):
    full = tmp_path / "full"
    full.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", full], check=False).returncode:
        pytest.skip("no small file system can be mounted")
    try:
        for hour in range(3):
            add_epoch(hour, size=50_000)
        site = site_with(target(full, ["epochs"]) + target(folder_target, ["epochs"]))
        status, lines = publish(site)
        assert status == 1
        assert " space" in lines[-1]
        assert len(contents(folder_target)) == 3
        subprocess.run(["mount", "-o", "remount,size=1m", full], check=True)
        assert publish(site)[0] == 0
        assert contents(full) == contents(folder_target)
    finally:
        subprocess.run(["umount", full], check=True)


def test_without_the_section_or_rclone_it_says_what_to_do(make_site, site_with, monkeypatch, tmp_path):
    with pytest.raises(ConfigError, match=r"has no \[publish\]"):
        publish(make_site())
    (tmp_path / "data/areas.nc").write_bytes(b"areas")
    monkeypatch.setattr(shutil, "which", lambda _: None)
    status, lines = publish(site_with(target("nas:hef", ["areas"])))
    assert (status, "apt install rclone" in lines[-1]) == (1, True)


# ---- hook and heartbeat


def test_the_hook_runs_once_for_each_new_epoch_in_a_bare_environment(
    site_with, add_epoch, tmp_path, monkeypatch
):
    monkeypatch.setenv("SECRET", "s3cret")
    log = tmp_path / "log"
    site = site_with(f"[publish]\nhook = ['/bin/sh', '-c', 'env >> {log}; echo arg=$1 >> {log}', 'hook']")
    add_epoch(0)  # from before publishing began
    publish(site)
    assert not log.exists()
    paths = [add_epoch(2), add_epoch(1)]
    for _ in range(2):
        assert publish(site)[0] == 0
    lines = log.read_text().splitlines()
    assert [line for line in lines if line.startswith("arg=")] == [f"arg={path}" for path in sorted(paths)]
    assert {line.partition("=")[0] for line in lines} <= {
        "PATH", "PWD", "OLDPWD", "SHLVL", "_", "STATION_ID", "STATION_SITE", "STATION_EPOCH", "arg",
    }  # fmt: skip


@pytest.mark.integration
def test_a_hook_that_hangs_is_ended_with_its_children_and_tried_three_times(site_with, add_epoch, tmp_path):
    log, late = tmp_path / "log", tmp_path / "late"
    script = f"echo begun >> {log}; (sleep 1.5; echo late >> {late}) & wait"
    site = site_with(f"[publish]\nhook_limit_s = 0.3\nhook = ['/bin/sh', '-c', '{script}']")
    publish(site)
    add_epoch(1)
    statuses = [publish(site)[0] for _ in range(4)]
    assert statuses == [1, 1, 1, 0]
    assert log.read_text().splitlines() == ["begun"] * 3
    time.sleep(1.5)
    assert not late.exists()


def test_a_hook_that_fails_delays_no_later_epoch(site_with, add_epoch, tmp_path):
    log = tmp_path / "log"
    script = f'case "$1" in *T010000Z*) exit 3;; esac; echo "$1" >> {log}'
    site = site_with(f"[publish]\nhook = ['/bin/sh', '-c', '{script}', 'hook']")
    publish(site)
    add_epoch(1)
    later = add_epoch(2)
    status, lines = publish(site)
    assert (status, log.read_text().split()) == (1, [str(later)])
    assert "T010000Z.nc: exit status 3" in lines[-1]


@contextmanager
def web_server(statuses):
    """Yield a port and the paths requested; each answer has the next status."""
    requested = []

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            requested.append(self.path)
            self.send_response(statuses.pop(0))
            self.end_headers()

        def log_message(self, *_):
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield server.server_port, requested
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def test_the_heart_beats_once_for_each_epoch_until_it_is_heard(site_with, add_epoch, credentials):
    site = site_with('[publish]\nheartbeat = "switch"')
    with web_server([503, 200, 200]) as (port, requested):
        credentials(switch=f"http://127.0.0.1:{port}/s3cret")
        assert publish(site) == (0, [])  # nothing was measured yet
        add_epoch(0)
        assert publish(site) == (1, ["failed: heartbeat switch: status 503"])
        assert [publish(site)[0] for _ in range(3)] == [0, 0, 0]
        assert len(requested) == 2
        add_epoch(1)
        publish(site)
        assert requested == ["/s3cret"] * 3


def test_a_switch_that_cannot_be_reached_keeps_its_address_secret(site_with, add_epoch, credentials):
    site = site_with('[publish]\nheartbeat = "switch"')
    add_epoch(0)
    credentials(switch="http://127.0.0.1:1/s3cret")
    assert publish(site) == (1, ["failed: heartbeat switch: URLError"])


def test_the_heartbeat_does_not_wait_for_a_slow_target(site_with, add_epoch, credentials, monkeypatch):
    monkeypatch.setattr(publication, "NOTICE_PERIOD_S", 0.05)
    finish = threading.Event()

    def slow_upload(*_):
        add_epoch(1)
        finish.wait(30)
        return 0, ""

    monkeypatch.setattr(publication, "upload", slow_upload)
    site = site_with('[publish]\nheartbeat = "switch"\n' + target("nas:hef", ["epochs"]))
    with web_server([200, 200]) as (port, requested):
        credentials(switch=f"http://127.0.0.1:{port}/")
        run = threading.Thread(target=publish, args=(site,))
        run.start()
        deadline_s = time.monotonic() + 30
        while not requested and time.monotonic() < deadline_s:
            time.sleep(0.02)
        finish.set()
        run.join()
    assert requested == ["/"]


# ---- lines and keys


def free_port():
    with socket.create_server(("127.0.0.1", 0)) as server:
        return server.getsockname()[1]


@contextmanager
def serving(kind, folder, *options):
    """Run rclone as a server of a folder; yield its port once it answers."""
    port = free_port()
    process = subprocess.Popen(
        [tool("rclone"), "serve", kind, folder, f"--addr=127.0.0.1:{port}", "--user=u", "--pass=p", *options],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        deadline_s = time.monotonic() + 60
        while time.monotonic() < deadline_s:
            try:
                socket.create_connection(("127.0.0.1", port)).close()
                break
            except OSError:
                time.sleep(0.05)
        yield port
    finally:
        process.terminate()
        process.wait()


class CutLine:
    """A line to a port of this machine, cut after so many bytes, until it is mended."""

    def __init__(self, port, after_bytes):
        self.far_port, self.remaining_bytes, self.mended = port, after_bytes, False
        self.server = socket.create_server(("127.0.0.1", 0))
        self.port = self.server.getsockname()[1]
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self):
        with suppress(OSError):  # closed at the end
            while True:
                near = self.server.accept()[0]
                if self.remaining_bytes < 0 and not self.mended:
                    near.close()
                    continue
                far = socket.create_connection(("127.0.0.1", self.far_port))
                threading.Thread(target=self._pass_on, args=(near, far, True), daemon=True).start()
                threading.Thread(target=self._pass_on, args=(far, near, False), daemon=True).start()

    def _pass_on(self, source, sink, counts):
        with source, sink, suppress(OSError):
            while data := source.recv(4096):
                self.remaining_bytes -= len(data) if counts else 0
                if self.remaining_bytes < 0 and not self.mended:
                    sink.shutdown(socket.SHUT_RDWR)
                    source.shutdown(socket.SHUT_RDWR)
                    break
                sink.sendall(data)
            with suppress(OSError):
                sink.shutdown(socket.SHUT_WR)


def remote(kind, port, password, monkeypatch):
    obscured = subprocess.run(["rclone", "obscure", password], capture_output=True, text=True, check=True)
    values = {"TYPE": kind, "USER": "u", "PASS": obscured.stdout.strip()}
    values |= {"URL": f"http://127.0.0.1:{port}"} if kind == "webdav" else {"HOST": "127.0.0.1", "PORT": port}
    for key, value in values.items():
        monkeypatch.setenv(f"RCLONE_CONFIG_NAS_{key}", str(value))


@pytest.mark.integration
@pytest.mark.parametrize("kind", ["sftp", "webdav"])
def test_a_cut_line_loses_nothing(kind, site_with, add_epoch, folder_target, tmp_path, monkeypatch):
    monkeypatch.setattr(uploads, "BATCH_BYTES", 300_000)
    for hour in range(6):
        add_epoch(hour, size=100_000)
    site = site_with(target("nas:hef", ["epochs"]))
    with serving(kind, folder_target) as port:
        line = CutLine(port, 250_000)
        remote(kind, line.port, "p", monkeypatch)
        status, lines = publish(site)
        assert status == 1
        assert lines[-1].startswith("failed: nas:hef: ")
        before = contents(folder_target)
        assert 0 < len(before) < 6
        line.mended = True
        assert publish(site)[0] == 0
    line.server.close()
    expected = published(tmp_path / "data", "epochs/**/*")
    assert {name.removeprefix("hef/"): data for name, data in contents(folder_target).items()} == expected
    with sqlite3.connect(tmp_path / "data/publish/record.sqlite") as record:
        (sent,) = record.execute("SELECT bytes FROM traffic").fetchone()
    assert 600_000 <= sent <= 800_000  # what the cut line had swallowed counts, once


@pytest.mark.integration
@pytest.mark.parametrize("kind", ["sftp", "webdav"])
def test_a_wrong_key_is_reported_and_keeps_no_other_from_its_files(
    kind, site_with, add_epoch, folder_target, tmp_path, monkeypatch
):
    other = tmp_path / "other"
    other.mkdir()
    add_epoch(0)
    site = site_with(target("nas:hef", ["epochs"]) + target(other, ["epochs"]))
    with serving(kind, folder_target) as port:
        remote(kind, port, "wrong", monkeypatch)
        status, lines = publish(site)
        assert status == 1
        assert len(contents(other)) == 1
        assert "auth" in lines[-1].lower()
        assert contents(folder_target) == {}
        remote(kind, port, "p", monkeypatch)
        assert publish(site)[0] == 0
    assert list(contents(folder_target).values()) == list(contents(other).values())


def test_the_page_that_a_server_sends_for_an_error_is_one_line_of_text(monkeypatch, tmp_path):
    """As WsgiDAV does where its disk is full; and rclone's last words have a time, which is no part of it."""
    page = "<!DOCTYPE HTML>\n<html><head>\n<title>500 Error</title></head>\n<body><h1>500</h1>\n"
    log = json.dumps({"level": "error", "msg": f"Failed to copy: {page}", "object": "a"})
    for stderr, fault in (
        (log, "Failed to copy: 500"),
        ("2026/11/27 03:36:58 Failed: 401 Not Authorized", "Failed: 401 Not Authorized"),
    ):
        program = tmp_path / "rclone"
        program.write_text(f"#!/bin/sh\ncat >&2 <<'END'\n{stderr}\nEND\nexit 1\n")
        program.chmod(0o755)
        monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
        to = {"oldest_first": False, "immutable": False, "bandwidth_kbit_s": None}
        assert rclone.copy(tmp_path, ["a"], "nas:", **to).fault == fault
