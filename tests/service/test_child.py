"""A child that hangs, dies, panics or eats memory costs one scan and nothing else."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest

from station.errors import NotReadyError, ScanError, StoreError
from station.service import child

HERE = Path(__file__).parent


@pytest.fixture
def tasks(monkeypatch):
    monkeypatch.syspath_prepend(HERE)
    import child_tasks

    # pytest, because a child imports the main module again, which for a test run is pytest's
    child.prepare(("station.service.child", "numpy", "pytest"))
    return child_tasks


@pytest.fixture(autouse=True)
def hurry(monkeypatch):
    monkeypatch.setattr(child, "PAUSES_S", (0.01, 0.01))


def run(task, *args, memory_gb=1.0, timeout_s=20.0, **hooks):
    return child.run(task, *args, memory_gb=memory_gb, timeout_s=timeout_s, **hooks)


def test_what_the_task_returns_comes_back_and_progress_pings(tasks):
    pings = []
    assert run(tasks.progress_all_the_time, 0.5, on_progress=lambda: pings.append(1)) > 1000
    assert 4 <= len(pings) < 100  # each takes the parent's time too
    assert run(tasks.add, 2, 3) == 5
    assert len(run(tasks.many_bytes, 5_000_000)) == 5_000_000


def test_after_the_first_a_child_starts_in_well_under_a_tenth_of_a_second(tasks):
    run(tasks.add, 1, 1)
    took_s = []
    for _ in range(5):
        begun_s = time.monotonic()
        run(tasks.add, 1, 1)
        took_s.append(time.monotonic() - begun_s)
    assert min(took_s) < 0.1


def test_a_child_has_one_thread_and_the_parent_keeps_its_environment(tasks, monkeypatch):
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    assert run(tasks.environment, "OPENBLAS_NUM_THREADS") == ("1", 1)
    assert "OPENBLAS_NUM_THREADS" not in os.environ


def test_while_the_disk_of_the_log_is_full_work_is_put_off(tasks, monkeypatch):
    """What waits to be written there is flushed before each child is started."""
    with suppress(OSError), Path("/dev/full").open("w") as full, monkeypatch.context() as meanwhile:
        full.write("a line of the log")
        meanwhile.setattr(sys, "stderr", full)
        with pytest.raises(NotReadyError, match=r"could not be started: .* No space left"):
            run(tasks.add, 2, 3)
    assert run(tasks.add, 2, 3) == 5


@pytest.mark.parametrize("task", ["allocate", "allocate_in_numpy"])
def test_ten_gigabytes_under_one_are_refused(tasks, task):
    with pytest.raises(ScanError, match="needs more than 1 GB"):
        run(getattr(tasks, task), 10)


def test_the_memory_is_the_scans_own(tasks):
    assert run(tasks.allocate, 0.9, memory_gb=1.0) > 9e8
    with pytest.raises(ScanError, match="needs more"):
        run(tasks.allocate, 1.1, memory_gb=1.0)


@pytest.mark.parametrize(
    ("number", "fault"),
    [
        (signal.SIGABRT, ScanError),
        (signal.SIGSEGV, ScanError),
        (signal.SIGKILL, NotReadyError),  # no decoder does that: the machine is out of memory
        (signal.SIGTERM, NotReadyError),
    ],
)
def test_a_death_by_signal_says_which(tasks, number, fault):
    with pytest.raises(fault, match=number.name):
        run(tasks.kill, number)


def test_a_child_killed_once_or_twice_is_started_again(tasks, tmp_path):
    assert run(tasks.killed_times, 2, str(tmp_path / "count")) == 2
    with pytest.raises(NotReadyError, match="SIGKILL"):
        run(tasks.killed_times, 9, str(tmp_path / "other"))
    assert (tmp_path / "other").stat().st_size == 3


def test_a_child_killed_amid_its_report_is_started_again(tasks, tmp_path):
    """More than a pipe holds is told, and the parent looks when the child is gone."""
    late = [1.0]
    pause = lambda: time.sleep(late.pop() if late else 0)  # noqa: E731
    assert len(run(tasks.killed_amid_its_report, str(tmp_path / "note"), on_progress=pause)) == 5_000_000
    assert not late


def test_a_stop_ends_the_pause_before_the_next_try(tasks, tmp_path, monkeypatch):
    monkeypatch.setattr(child, "PAUSES_S", (60.0,))
    until_s = time.monotonic() + 1.0
    with pytest.raises(NotReadyError, match="stopped"):
        run(tasks.killed_times, 9, str(tmp_path / "count"), should_stop=lambda: time.monotonic() > until_s)
    assert time.monotonic() < until_s + 10.0


@pytest.mark.parametrize(
    ("task", "said"), [("abort", "SIGABRT"), ("segfault", "SIGSEGV"), ("vanish", "without a word")]
)
def test_a_native_crash_is_the_scans_fault(tasks, task, said):
    with pytest.raises(ScanError, match=said):
        run(getattr(tasks, task))


@pytest.mark.parametrize("task", ["panic", "leave"])
def test_what_passes_by_exception_is_caught(tasks, task):
    with pytest.raises(ScanError, match=r"panicked: (Panic: called|SystemExit)"):
        run(getattr(tasks, task))


def test_a_hang_ends_at_its_time_out_and_pings_until_then(tasks, tmp_path):
    pings = []
    begun_s = time.monotonic()
    with pytest.raises(ScanError, match="longer than 1 s"):
        run(
            tasks.hang_ignoring_signals,
            str(tmp_path / "pid"),
            timeout_s=1.0,
            on_progress=lambda: pings.append(1),
        )
    assert time.monotonic() - begun_s < 3.0
    assert len(pings) >= 3
    assert not is_alive(int((tmp_path / "pid").read_text()))


def test_a_stop_ends_the_child_and_the_scan_comes_again(tasks):
    until_s = time.monotonic() + 0.4
    with pytest.raises(NotReadyError, match="stopped"):
        run(tasks.hang, should_stop=lambda: time.monotonic() > until_s)


def test_station_errors_come_back_as_themselves(tasks):
    with pytest.raises(ScanError, match=r"^no points in it$"):
        run(tasks.refuse)
    with pytest.raises(StoreError, match=r"^no space left$"):
        run(tasks.no_room)


@pytest.mark.parametrize(("task", "said"), [("trip", "KeyError: 'missing'"), ("unpicklable", "pickle")])
def test_a_bug_comes_back_with_its_traceback(tasks, task, said):
    with pytest.raises(RuntimeError, match=said) as caught:
        run(getattr(tasks, task))
    assert f"a bug in {task}" in str(caught.value)


ORPHANED = """
import sys
sys.path.insert(0, sys.argv[1])
import child_tasks
from station.service import child
if __name__ == "__main__":
    child.prepare(("station.service.child",))
    child.run(child_tasks.hang_ignoring_signals, sys.argv[2], memory_gb=1, timeout_s=60)
"""


def test_a_child_dies_with_a_service_that_is_killed(tmp_path):
    script, note = tmp_path / "orphaned.py", tmp_path / "pid"
    script.write_text(ORPHANED)
    with subprocess.Popen([sys.executable, str(script), str(HERE), str(note)]) as service:
        wait_for(lambda: note.exists() and note.read_text())
        orphan = int(note.read_text())
        assert is_alive(orphan)
        service.kill()
    wait_for(lambda: not is_alive(orphan))


GONE = """
import multiprocessing, os
from station.service import child
ours, theirs = os.pipe()
os.close(theirs)
class Parent:
    sentinel = ours
multiprocessing.parent_process = Parent
here, there = multiprocessing.Pipe()
here.close()
"""


@pytest.mark.parametrize("step", ["_end_with_the_parent()", "_say(there, 'progress', None)"])
def test_a_child_that_finds_its_parent_gone_ends_without_a_traceback(step):
    """It would stand in the journal after every power cut, and look like a bug."""
    done = subprocess.run(
        [sys.executable, "-c", f"{GONE}child.{step}\nprint('went on')"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stdout, done.stderr) == (1, "", "")


def is_alive(pid):
    try:
        return "Z" not in Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return False


def wait_for(what, within_s=10.0):
    until_s = time.monotonic() + within_s
    while not what():
        assert time.monotonic() < until_s
        time.sleep(0.02)
