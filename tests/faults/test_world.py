"""What a station's world does to it: disks fill up, rights go, clocks jump, scans come as they like."""

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

ALL = range(harness.SCANS)


def wait_for_step(station, step):
    station.await_(lambda: station.step() >= step or station.is_through(*ALL))


def finish(station, quiet, hours=ALL):
    station.finish(*hours)
    harness.assert_sound(station, hours, quiet)


# ---- full disks


def test_a_disk_that_fills_up_is_waited_out(make, quiet, dice):
    """No file may grow: writes fail anywhere within the netCDF library, SQLite and the log."""
    station = make()
    station.drop(*ALL)
    station.start()
    step = 0
    for _ in range(4):
        step += dice.randrange(20, 80)
        wait_for_step(station, step)
        station.limit_files(dice.choice([0, 4096, 20_000]))
        harness.nap(dice.uniform(0.1, 0.6))
        station.limit_files(None)
    assert station.is_alive(), station.log()[-12_000:]
    finish(station, quiet())


@pytest.mark.slow
def test_a_full_disk_at_every_boundary(make, quiet, capsys):
    """Each fsync, rename, new folder and commit fails once; the service goes on by itself."""
    station = make()
    station.period_s = 0.2
    station.drop(*ALL)
    station.start(once="full")
    station.await_(lambda: station.is_through(*ALL) or not station.is_alive(), within_s=300.0)
    assert station.is_alive(), station.log()[-3000:]
    station.end()
    harness.assert_sound(station, ALL, quiet())
    failed = len(list(station.died.iterdir()))
    assert failed > 100
    with capsys.disabled():
        print(f"\n  boundaries={failed} lost=0 doubled=0 wrong=0")


@pytest.fixture
def small_disk():
    """Return a folder on a disk of 24 MB of its own."""
    with tempfile.TemporaryDirectory() as folder:
        mounted = subprocess.run(
            ["mount", "-t", "tmpfs", "-o", "size=24m", "station", folder], capture_output=True, check=False
        )
        if mounted.returncode:
            pytest.skip("a small disk takes the rights of root")
        yield Path(folder)
        subprocess.run(["umount", folder], check=True)


@pytest.mark.slow
def test_a_really_full_disk_is_waited_out(make, quiet, small_disk):
    """The service must know that there is no room before it begins, pause, and go on when there is room."""
    station = make(folder=small_disk / "station")
    station.drop(*ALL[:3])
    station.start()
    station.await_(lambda: station.is_done(*ALL[:2]))
    ballast = small_disk / "ballast"
    # All there is, without a buffer: that would want to be emptied at the end.
    with ballast.open("wb", buffering=0) as file:
        while file.tell() < 24e6:
            try:
                file.write(bytes(100_000))
            except OSError:
                break
    station.await_(lambda: "service=paused" in station.log())
    ballast.unlink()
    station.drop(*ALL[3:])
    finish(station, quiet())
    assert 'service="goes on"' in station.log()


# ---- rights and folders


@pytest.mark.slow
def test_rights_that_go_and_come_back(make):
    """Read-only data, an inbox nobody may list, a scan nobody may read: waited out, and told."""
    station = make(cold=True)
    if not os.getuid():  # root without the right to ignore rights
        if shutil.which("setpriv") is None:
            pytest.skip("root heeds no rights; setpriv would make it")
        station.before = ["setpriv", "--bounding-set", "-dac_override,-dac_read_search"]
    station.drop(*ALL[:3])
    unreadable = station.inbox / f"{harness.stem(1)}.laz"
    unreadable.chmod(0)
    station.start()
    station.await_(lambda: "cannot be read" in station.log() or "cannot be opened" in station.log())
    unreadable.chmod(0o644)
    station.await_(lambda: station.is_done(*ALL[:2]))
    folders = [path for path in (station.data, *station.data.rglob("*")) if path.is_dir()]
    for path in folders:
        path.chmod(stat.S_IRUSR | stat.S_IXUSR)
    station.drop(*ALL[3:5])
    station.await_(lambda: "service=paused" in station.log())
    for path in folders:
        path.chmod(0o755)
    station.inbox.chmod(0)
    harness.nap(0.3)
    station.inbox.chmod(0o755)
    station.drop(5)
    station.finish(*ALL)
    # The scan that could not be read came after others: the reference is of others than in the quiet run.
    harness.assert_sound(station, ALL)
    assert 'service="goes on"' in station.log()


@pytest.mark.slow
def test_an_inbox_that_is_removed_and_made_again(make, quiet, dice):
    station = make()
    station.period_s = 0.3
    station.drop(0, 1, 2)
    station.start()
    station.await_(lambda: station.is_done(0, 1, 2))
    for hour in ALL[3:]:
        shutil.rmtree(station.inbox)
        harness.nap(dice.uniform(0.0, 0.4))
        station.inbox.mkdir()
        station.drop(hour)
        station.await_(lambda: station.is_done(*range(hour + 1)))  # noqa: B023 - called at once
    finish(station, quiet())


# ---- arrivals


def test_arrivals_out_of_order_again_and_again(make, quiet, dice):
    """Late scans take their place; the same bytes again, touched or under way for long, change nothing."""
    station = make()
    station.drop(0, 1)
    station.start()
    station.await_(lambda: station.is_done(0, 1) and (station.data / "reference.nc").exists())
    hours = list(ALL[2:])
    dice.shuffle(hours)
    for hour in [*hours, *dice.choices(hours, k=4)]:
        station.drop(hour, whole=dice.random() < 0.5)
        harness.nap(dice.uniform(0.0, 0.4))
        os.utime(station.inbox / f"{harness.stem(dice.choice([0, 1]))}.laz")
    finish(station, quiet())


@pytest.mark.slow
def test_a_scan_replaced_while_it_is_read(make, quiet, dice):
    """Whatever was read of it, in the end what lies there is what is stored, once."""
    station = make()
    station.drop(0, 1)
    station.start()
    station.await_(lambda: station.is_done(0, 1) and (station.data / "reference.nc").exists())
    station.drop(*ALL[2:])
    name = f"{harness.stem(3)}.laz"
    whole = (station.folder / harness.LATER / name).read_bytes()
    other = (station.folder / harness.LATER / f"{harness.stem(4)}.laz").read_bytes()
    for content in (other, whole[: len(whole) // 2], other, whole):
        step = station.step()
        beside = station.inbox / f".{name}"
        beside.write_bytes(content)
        beside.replace(station.inbox / name)
        if dice.random() < 0.7:
            station.await_(lambda: station.step() > step + 3)  # noqa: B023 - called at once
        harness.nap(dice.uniform(0.0, 0.3))
    station.finish(*ALL)
    harness.assert_sound(station, ALL, quiet())


# ---- clocks


@pytest.mark.slow
def test_a_clock_that_jumps(make, quiet, dice):
    """Back by years and forth by years, while scans are measured, wait and are joined."""
    station = make()
    station.clock = station.folder / "clock"
    station.clock.write_text("0")
    station.drop(0, 1)
    station.start()
    for hour in ALL[2:]:
        beside = station.clock.with_name("clock.new")
        beside.write_text(str(dice.choice([-1, 1]) * dice.choice([30, 4000, 86_400 * 3, 86_400 * 400])))
        beside.replace(station.clock)
        station.drop(hour)
        harness.nap(dice.uniform(0.0, 0.4))
    station.clock.write_text("0")
    finish(station, quiet())


# ---- its unit


def test_the_unit_leaves_the_service_the_system_calls_it_needs(make, quiet, request):
    """Also for what is not of every scan: a closed day is joined by a process that is less urgent."""
    unit = request.config.rootpath / "systemd/station@.service"
    if shutil.which("systemd-analyze") is None or ctypes.util.find_library("seccomp") is None:
        pytest.skip("systemd-analyze or libseccomp is not installed (Debian: systemd)")
    station = make(cold=True)
    station.before = [sys.executable, str(Path(harness.__file__).with_name("confined.py")), str(unit)]
    station.drop(*ALL)
    station.finish(*ALL)
    station.start()  # which joins what is closed
    joined = station.folder / "data/days/2025/07"
    station.await_(lambda: joined.exists() or "Error" in station.log())
    finish(station, quiet())
    assert joined.exists()
