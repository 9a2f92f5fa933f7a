"""Faults of the environment: full disks, lost permissions, clock steps, arrivals in any order."""

from __future__ import annotations

import ctypes.util
import os
import shutil
import stat
import subprocess
import sys
import tempfile
from pathlib import Path

import harness
import pytest
from support.effort import SHARE

pytestmark = pytest.mark.integration
ALL = range(harness.SCANS)


def wait_for_step(station, step):
    station.wait_until(lambda: station.step() >= step or station.is_finished(*ALL))


def finish(station, undisturbed, hours=ALL):
    station.finish(*hours)
    harness.assert_store_intact(station, hours, undisturbed)


# ---- full disks


def test_full_disk_pauses_the_service(make_station, undisturbed, rng):
    """No file may grow: writes of the netCDF library, SQLite and the log fail anywhere."""
    station = make_station()
    station.drop(*ALL)
    station.start()
    step = 0
    for _ in range(4):
        step += rng.randrange(20, 80)
        wait_for_step(station, step)
        station.limit_file_size(rng.choice([0, 4096, 20_000]))
        harness.pause(rng.uniform(0.1, 0.6))
        station.limit_file_size(None)
    assert station.is_alive(), station.log()[-12_000:]
    finish(station, undisturbed())


@pytest.mark.slow
def test_full_disk_at_write_boundaries(make_station, undisturbed, rng, capsys):
    """Each fsync, rename, mkdir and commit that is drawn fails once; the service recovers without help."""
    station = make_station()
    station.period_s = 0.2
    station.drop(*ALL)
    station.start(once="full", draw=[SHARE, rng.random()])
    station.wait_until(lambda: station.is_finished(*ALL) or not station.is_alive(), within_s=300.0)
    assert station.is_alive(), station.log()[-3000:]
    station.end()
    harness.assert_store_intact(station, ALL, undisturbed())
    failed = len(list(station.died.iterdir()))
    assert failed > 100 / SHARE
    with capsys.disabled():
        print(f"\n  boundaries={failed} lost=0 doubled=0 wrong=0")


@pytest.fixture
def small_disk():
    """Yield a folder on a separate file system of 24 MB."""
    with tempfile.TemporaryDirectory() as folder:
        mounted = subprocess.run(
            ["mount", "-t", "tmpfs", "-o", "size=24m", "station", folder], capture_output=True, check=False
        )
        if mounted.returncode:
            pytest.skip("mounting a small file system requires root")
        yield Path(folder)
        subprocess.run(["umount", folder], check=True)


@pytest.mark.slow
def test_full_file_system_pauses_the_service(make_station, undisturbed, small_disk):
    """The service checks the free space before a scan, pauses, and resumes when there is space."""
    station = make_station(folder=small_disk / "station")
    station.drop(*ALL[:3])
    station.start()
    station.wait_until(lambda: station.is_done(*ALL[:2]))
    ballast = small_disk / "ballast"
    # Unbuffered, because flushing a buffer at the end would fail.
    with ballast.open("wb", buffering=0) as file:
        while file.tell() < 24e6:
            try:
                file.write(bytes(100_000))
            except OSError:
                break
    station.wait_until(lambda: "service=paused" in station.log())
    ballast.unlink()
    station.drop(*ALL[3:])
    finish(station, undisturbed())
    assert "service=resumed" in station.log()


# ---- permissions and folders


@pytest.mark.slow
def test_lost_permissions_pause_the_service(make_station):
    """A read-only data folder, an unlistable inbox and an unreadable scan are logged and waited for."""
    station = make_station(cold=True)
    if not os.getuid():  # root without the capability to bypass permissions
        if shutil.which("setpriv") is None:
            pytest.skip("root bypasses permissions; setpriv, which drops that capability, is not installed")
        station.command_prefix = ["setpriv", "--bounding-set", "-dac_override,-dac_read_search"]
    station.drop(*ALL[:3])
    unreadable = station.inbox / f"{harness.scan_name(1)}.laz"
    unreadable.chmod(0)
    station.start()
    station.wait_until(lambda: "cannot be read" in station.log() or "cannot be opened" in station.log())
    unreadable.chmod(0o644)
    station.wait_until(lambda: station.is_done(*ALL[:2]))
    folders = [path for path in (station.data, *station.data.rglob("*")) if path.is_dir()]
    for path in folders:
        path.chmod(stat.S_IRUSR | stat.S_IXUSR)
    station.drop(*ALL[3:5])
    station.wait_until(lambda: "service=paused" in station.log())
    for path in folders:
        path.chmod(0o755)
    station.inbox.chmod(0)
    harness.pause(0.3)
    station.inbox.chmod(0o755)
    station.drop(5)
    station.finish(*ALL)
    # The unreadable scan was processed late, so the reference has other scans than the undisturbed one.
    harness.assert_store_intact(station, ALL)
    assert "service=resumed" in station.log()


@pytest.mark.slow
def test_removed_inbox_is_watched_again(make_station, undisturbed, rng):
    station = make_station()
    station.period_s = 0.3
    station.drop(0, 1, 2)
    station.start()
    station.wait_until(lambda: station.is_done(0, 1, 2))
    for hour in ALL[3:]:
        shutil.rmtree(station.inbox)
        harness.pause(rng.uniform(0.0, 0.4))
        station.inbox.mkdir()
        station.drop(hour)
        station.wait_until(lambda: station.is_done(*range(hour + 1)))  # noqa: B023 - called at once
    finish(station, undisturbed())


# ---- arrivals


def test_arrivals_out_of_order_and_repeated(make_station, undisturbed, rng):
    """Late scans are sorted in; repeated, touched or slowly written scans change nothing."""
    station = make_station()
    station.drop(0, 1)
    station.start()
    station.wait_until(lambda: station.is_done(0, 1) and (station.data / "reference.nc").exists())
    hours = list(ALL[2:])
    rng.shuffle(hours)
    for hour in [*hours, *rng.choices(hours, k=4)]:
        station.drop(hour, whole=rng.random() < 0.5)
        harness.pause(rng.uniform(0.0, 0.4))
        os.utime(station.inbox / f"{harness.scan_name(rng.choice([0, 1]))}.laz")
    finish(station, undisturbed())


def test_touched_scans_change_no_value_although_the_reference_falls_due(make_station, undisturbed, rng):
    """Scans that others overtake while they settle belong to the first reference all the same."""
    station = make_station()
    station.start()
    for hour in ALL:
        station.drop(hour)
        for touched in rng.choices(range(hour + 1), k=3):
            os.utime(station.inbox / f"{harness.scan_name(touched)}.laz")
            harness.pause(rng.uniform(0.0, 0.2))
    finish(station, undisturbed())


@pytest.mark.slow
def test_scan_replaced_while_it_is_read(make_station, undisturbed, rng):
    """Finally the last version of the file is stored, once."""
    station = make_station()
    station.drop(0, 1)
    station.start()
    station.wait_until(lambda: station.is_done(0, 1) and (station.data / "reference.nc").exists())
    station.drop(*ALL[2:])
    name = f"{harness.scan_name(3)}.laz"
    whole = (station.folder / harness.PENDING / name).read_bytes()
    other = (station.folder / harness.PENDING / f"{harness.scan_name(4)}.laz").read_bytes()
    for content in (other, whole[: len(whole) // 2], other, whole):
        step = station.step()
        partial = station.inbox / f".{name}"
        partial.write_bytes(content)
        partial.replace(station.inbox / name)
        if rng.random() < 0.7:
            station.wait_until(lambda: station.step() > step + 3)  # noqa: B023 - called at once
        harness.pause(rng.uniform(0.0, 0.3))
    station.finish(*ALL)
    harness.assert_store_intact(station, ALL, undisturbed())


# ---- clocks


@pytest.mark.slow
def test_clock_steps(make_station, undisturbed, rng):
    """Steps of up to 400 days in both directions while scans are processed, deferred and compacted."""
    station = make_station()
    station.clock = station.folder / "clock"
    station.clock.write_text("0")
    station.drop(0, 1)
    station.start()
    for hour in ALL[2:]:
        partial = station.clock.with_name("clock.new")
        partial.write_text(str(rng.choice([-1, 1]) * rng.choice([30, 4000, 86_400 * 3, 86_400 * 400])))
        partial.replace(station.clock)
        station.drop(hour)
        harness.pause(rng.uniform(0.0, 0.4))
    station.clock.write_text("0")
    finish(station, undisturbed())


# ---- systemd unit


def test_systemd_unit_allows_the_required_system_calls(make_station, undisturbed, request):
    """Includes the compaction of a closed day in a process of low priority."""
    unit = request.config.rootpath / "systemd/station@.service"
    if shutil.which("systemd-analyze") is None or ctypes.util.find_library("seccomp") is None:
        pytest.skip("systemd-analyze or libseccomp is not installed (Debian: systemd)")
    station = make_station(cold=True)
    station.command_prefix = [sys.executable, str(Path(harness.__file__).with_name("confined.py")), str(unit)]
    station.drop(*ALL)
    station.finish(*ALL)
    station.start()  # compacts closed days
    compacted = station.folder / "data/days/2025/07"
    station.wait_until(lambda: compacted.exists() or "Error" in station.log())
    finish(station, undisturbed())
    assert compacted.exists()
