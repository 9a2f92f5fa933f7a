"""A worker process that hangs, dies, panics or exhausts its memory costs one scan and nothing else."""

from __future__ import annotations

import math
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from multiprocessing import forkserver, util
from pathlib import Path

import pytest

from station.errors import InconclusiveError, NotReadyError, ScanError, StationError, StoreError
from station.processing.workers import fork_server, isolation
from station.processing.workers.isolation import TaskRunner

HERE = Path(__file__).parent


@pytest.fixture
def tasks(monkeypatch):
    monkeypatch.syspath_prepend(HERE)
    import isolated_tasks

    # pytest, because a worker imports the main module, which is that of pytest in a test run
    fork_server.ensure_running(("station.processing.workers.worker_process", "numpy", "pytest"))
    return isolated_tasks


@pytest.fixture(autouse=True)
def short_retry_delays(monkeypatch):
    monkeypatch.setattr(isolation, "RETRY_DELAYS_S", (0.01, 0.01))


def run(task, *args, memory_gb=1.0, timeout_s=20.0, runner=None, **hooks):
    return (runner or TaskRunner()).run(task, *args, memory_gb=memory_gb, timeout_s=timeout_s, **hooks)


def test_result_is_returned_and_progress_is_reported(tasks):
    reports = []
    assert run(tasks.progress_all_the_time, 0.5, on_progress=lambda: reports.append(1)) > 1000
    assert 4 <= len(reports) < 100  # each takes time of the parent too
    assert run(tasks.add, 2, 3) == 5
    assert len(run(tasks.many_bytes, 5_000_000)) == 5_000_000


def test_second_worker_starts_within_a_tenth_of_a_second(tasks):
    run(tasks.add, 1, 1)
    durations_s = []
    for _ in range(5):
        start_s = time.monotonic()
        run(tasks.add, 1, 1)
        durations_s.append(time.monotonic() - start_s)
    assert min(durations_s) < 0.1


def test_worker_has_one_thread_and_the_parent_keeps_its_environment(tasks, monkeypatch):
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    assert run(tasks.environment, "OPENBLAS_NUM_THREADS") == ("1", 1)
    assert "OPENBLAS_NUM_THREADS" not in os.environ


def test_full_disk_of_stderr_raises_not_ready(tasks, monkeypatch):
    """Buffered output is flushed before each worker is started."""
    with suppress(OSError), Path("/dev/full").open("w") as full, monkeypatch.context() as patch:
        full.write("a line of the log")
        patch.setattr(sys, "stderr", full)
        with pytest.raises(NotReadyError, match=r"could not be started: .* No space left"):
            run(tasks.add, 2, 3)
    assert run(tasks.add, 2, 3) == 5


@pytest.mark.parametrize("task", ["allocate", "allocate_in_numpy"])
def test_memory_limit_raises_inconclusive_error(tasks, task):
    with pytest.raises(InconclusiveError, match="needs more than 1 GB"):
        run(getattr(tasks, task), 10)


@pytest.mark.integration
def test_memory_of_preloaded_modules_does_not_count(tasks):
    assert run(tasks.allocate, 0.9, memory_gb=1.0) > 9e8
    with pytest.raises(InconclusiveError, match="needs more"):
        run(tasks.allocate, 1.1, memory_gb=1.0)


@pytest.mark.parametrize(
    ("number", "error"),
    [
        (signal.SIGABRT, InconclusiveError),
        (signal.SIGSEGV, InconclusiveError),
        (signal.SIGKILL, NotReadyError),  # not sent by a decoder: the machine is out of memory
        (signal.SIGTERM, NotReadyError),
    ],
)
def test_death_by_signal_is_classified_by_the_signal(tasks, number, error):
    with pytest.raises(error, match=number.name):
        run(tasks.kill, number)


def test_killed_worker_is_restarted_twice(tasks, tmp_path):
    assert run(tasks.killed_times, 2, str(tmp_path / "count")) == 2
    with pytest.raises(NotReadyError, match="SIGKILL"):
        run(tasks.killed_times, 9, str(tmp_path / "other"))
    assert (tmp_path / "other").stat().st_size == 3


@pytest.mark.integration
def test_worker_killed_during_its_report_is_restarted(tasks, tmp_path):
    """The report exceeds the pipe's buffer, and the parent reads it after the worker was killed."""
    delays_s = [1.0]

    def read_late():
        time.sleep(delays_s.pop() if delays_s else 0)

    result = run(tasks.killed_during_its_report, str(tmp_path / "note"), on_progress=read_late)
    assert len(result) == 5_000_000
    assert not delays_s


@pytest.mark.integration
def test_stop_ends_the_delay_before_a_restart(tasks, tmp_path, monkeypatch):
    monkeypatch.setattr(isolation, "RETRY_DELAYS_S", (60.0,))
    until_s = time.monotonic() + 1.0
    with pytest.raises(NotReadyError, match="stopped"):
        run(tasks.killed_times, 9, str(tmp_path / "count"), should_stop=lambda: time.monotonic() > until_s)
    assert time.monotonic() < until_s + 10.0


@pytest.mark.parametrize(
    ("task", "message"), [("abort", "SIGABRT"), ("segfault", "SIGSEGV"), ("vanish", "without a message")]
)
def test_native_crash_raises_inconclusive_error(tasks, task, message):
    with pytest.raises(InconclusiveError, match=message):
        run(getattr(tasks, task))


@pytest.mark.parametrize("task", ["panic", "exit_task"])
def test_base_exceptions_of_a_task_raise_inconclusive_error(tasks, task):
    with pytest.raises(InconclusiveError, match=r"panicked: (Panic: called|SystemExit)"):
        run(getattr(tasks, task))


@pytest.mark.integration
def test_hanging_worker_is_killed_at_its_timeout(tasks, tmp_path):
    start_s = time.monotonic()
    with pytest.raises(InconclusiveError, match="longer than 1 s"):
        run(tasks.hang_ignoring_signals, str(tmp_path / "pid"), timeout_s=1.0)
    assert time.monotonic() - start_s < 3.0
    assert not is_alive(int((tmp_path / "pid").read_text()))


@pytest.mark.integration
def test_blocked_worker_reports_no_progress_and_is_killed(tasks, tmp_path, monkeypatch):
    """A pipe without a writer stands for a network folder that hangs; then nothing may feed the watchdog."""
    monkeypatch.setattr(isolation, "STALL_S", 0.8)
    os.mkfifo(tmp_path / "weather.dat")
    reports = []
    with pytest.raises(NotReadyError, match=r"blocked for 0.8 s"):
        run(
            tasks.read_pipe,
            str(tmp_path / "weather.dat"),
            str(tmp_path / "pid"),
            timeout_s=math.inf,
            on_progress=lambda: reports.append(1),
        )
    assert len(reports) <= 3  # it started
    assert not is_alive(int((tmp_path / "pid").read_text()))


@pytest.mark.integration
def test_silent_work_counts_as_progress(tasks, monkeypatch):
    monkeypatch.setattr(isolation, "STALL_S", 0.5)
    reports = []
    assert run(tasks.work_silently, 1.2, on_progress=lambda: reports.append(1)) > 0
    assert len(reports) >= 3


@pytest.mark.integration
def test_fork_server_is_restarted_when_its_socket_was_deleted(tasks):
    """Programs that clean /tmp delete it after some days."""
    runner = TaskRunner()
    assert run(tasks.add, 2, 3, runner=runner) == 5
    shutil.rmtree(util.get_temp_dir())
    assert run(tasks.add, 2, 3, runner=runner) == 5
    assert runner.seconds_without_worker() == 0.0


@pytest.mark.integration
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_worker_outlives_its_fork_server_but_not_its_timeout(tasks, tmp_path, number):
    note = tmp_path / "pids"

    def end_server():
        if note.exists() and note.read_text() and server_pid() is not None:
            os.kill(server_pid(), number)
            fork_server.stop()

    with pytest.raises(StationError, match="longer than"):
        run(tasks.note_pid_and_spin, str(note), timeout_s=1.5, on_progress=end_server)
    (pid,) = note.read_text().split()
    assert not is_alive(int(pid))
    assert run(tasks.add, 2, 3) == 5


def test_seconds_without_worker_count_failed_starts(tasks, monkeypatch):
    def fail(*_):
        raise BlockingIOError("no more tasks")

    runner = TaskRunner()
    with monkeypatch.context() as patch:
        patch.setattr(fork_server, "ensure_running", fail)
        with pytest.raises(NotReadyError, match="could not be started: no more tasks"):
            run(tasks.add, 2, 3, runner=runner)
    assert runner.seconds_without_worker() > 0.0
    assert run(tasks.add, 2, 3, runner=runner) == 5
    assert runner.seconds_without_worker() == 0.0


SOCKET_FOLDER = """
from multiprocessing import util
from station.processing.workers import fork_server
if __name__ == "__main__":
    fork_server.ensure_running(())
    print(util.get_temp_dir())
    fork_server.stop()
"""


def test_socket_is_in_the_runtime_folder_of_the_service(tmp_path):
    script = tmp_path / "service.py"
    script.write_text(SOCKET_FOLDER)
    with tempfile.TemporaryDirectory() as runtime:  # the path of a socket has at most 107 characters
        environment = os.environ | {"RUNTIME_DIRECTORY": runtime}
        printed = subprocess.check_output([sys.executable, script], env=environment, text=True)
    assert str(Path(printed.strip()).parent) == runtime


def test_stop_ends_the_worker_with_not_ready(tasks):
    until_s = time.monotonic() + 0.4
    with pytest.raises(NotReadyError, match="stopped"):
        run(tasks.hang, should_stop=lambda: time.monotonic() > until_s)


def test_station_errors_of_a_task_are_raised(tasks):
    with pytest.raises(ScanError, match=r"^contains no points$"):
        run(tasks.raise_scan_error)
    with pytest.raises(StoreError, match=r"^no space left$"):
        run(tasks.raise_store_error)


@pytest.mark.parametrize(
    ("task", "message"), [("raise_key_error", "KeyError: 'missing'"), ("return_unpicklable", "pickle")]
)
def test_bug_raises_runtime_error_with_its_traceback(tasks, task, message):
    with pytest.raises(RuntimeError, match=message) as raised:
        run(getattr(tasks, task))
    assert f"a bug in {task}" in str(raised.value)


SERVICE = """
import sys
sys.path.insert(0, sys.argv[1])
import isolated_tasks
from station.processing.workers import fork_server, isolation
if __name__ == "__main__":
    fork_server.ensure_running(("station.processing.workers.isolation",))
    isolation.TaskRunner().run(isolated_tasks.hang_ignoring_signals, sys.argv[2], memory_gb=1, timeout_s=60)
"""


def test_worker_dies_with_its_killed_parent(tmp_path):
    script, pid_file = tmp_path / "service.py", tmp_path / "pid"
    script.write_text(SERVICE)
    with subprocess.Popen([sys.executable, str(script), str(HERE), str(pid_file)]) as service:
        wait_for(lambda: pid_file.exists() and pid_file.read_text())
        worker = int(pid_file.read_text())
        assert is_alive(worker)
        service.kill()
    wait_for(lambda: not is_alive(worker))


ORPHAN = """
import multiprocessing, os
from station.processing.workers import worker_process
read_end, write_end = os.pipe()
os.close(write_end)
class Parent:
    sentinel = read_end
multiprocessing.parent_process = Parent
parent_conn, child_conn = multiprocessing.Pipe()
parent_conn.close()
"""


@pytest.mark.parametrize("step", ["_die_with_parent()", "_send(child_conn, 'progress', None)"])
def test_orphaned_worker_exits_without_a_traceback(step):
    """A traceback in the system's log after every power cut would look like a bug."""
    process = subprocess.run(
        [sys.executable, "-c", f"{ORPHAN}worker_process.{step}\nprint('still running')"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (process.returncode, process.stdout, process.stderr) == (1, "", "")


def server_pid():
    return forkserver._forkserver._forkserver_pid


def is_alive(pid):
    try:
        return "Z" not in Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return False


def wait_for(condition, within_s=10.0):
    until_s = time.monotonic() + within_s
    while not condition():
        assert time.monotonic() < until_s
        time.sleep(0.02)


def test_service_and_workers_do_not_import_what_they_do_not_need():
    """Xarray takes 70 MB of each worker and serves users only; scipy.stats takes 0.6 s of each start."""
    preloaded = (module for module in fork_server.PRELOAD if module.startswith("station."))
    modules = ", ".join(["station.service.worker", *preloaded])
    code = f"import sys, {modules}; sys.exit(bool({{'xarray', 'pandas', 'scipy.stats'}} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
