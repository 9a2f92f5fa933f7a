"""What is decoded beside comes as what is decoded here, and goes wrong as it does."""

import os
import signal
import subprocess
import sys
import textwrap

import numpy as np
import pytest

from station.readers.las import LasScan
from station.service.child import SURROUNDINGS

# A fork takes a process without threads, which that of the tests need not be.
BEGIN = """
import os, signal, sys, time
from contextlib import contextmanager
from pathlib import Path
from station.errors import ScanError
from station.readers.ahead import filled
from station.readers.las import LasScan

def children():
    return Path(f"/proc/self/task/{os.getpid()}/children").read_text().split()

@contextmanager
def beside():
    number = 0
    def fill(room):
        nonlocal number
        number += 1
        if number == 3:
            at_third()
        room[:] = number
    yield fill
"""


def run(script, *args):
    command = [sys.executable, "-c", BEGIN + textwrap.dedent(script), *map(str, args)]
    environment = os.environ | SURROUNDINGS | {"PYTHONPATH": os.pathsep.join(sys.path)}
    return subprocess.run(command, capture_output=True, timeout=60, check=False, env=environment)


def test_every_echo_comes_as_without_it(a_sweep, tmp_path):
    path = a_sweep("s.laz", 30_001)
    script = """
        import numpy as np
        blocks = []
        for block in LasScan(Path(sys.argv[1])).blocks(1000):
            blocks.append([*block.xyz_m, block.time_s, block.intensity])
            if len(blocks) == 1:
                assert len(children()) == 1  # or this test tests nothing
        assert not children()
        np.save(sys.argv[2], np.concatenate(blocks, axis=1))
        """
    done = run(script, path, tmp_path / "seen.npy")
    assert done.returncode == 0, done.stderr.decode()
    shots = LasScan(path).blocks(30_001)
    wanted = [[*one.xyz_m, one.time_s, one.intensity] for one in shots]
    assert np.array_equal(np.load(tmp_path / "seen.npy"), np.concatenate(wanted, axis=1))


def test_rooms_are_filled_ahead_and_none_while_it_is_read():
    script = """
        def at_third():
            pass
        seen = []
        for room in filled(beside, [10] * 7 + [4]):
            time.sleep(0.05)  # long enough to fill all that may be
            seen.append((len(room), set(room.tolist())))
        assert seen == [(10, {n}) for n in range(1, 8)] + [(4, {8})], seen
        """
    done = run(script)
    assert done.returncode == 0, done.stderr.decode()


def test_who_wants_no_more_leaves_nobody_behind():
    script = """
        def at_third():
            time.sleep(60)
        rooms = filled(beside, [10] * 8)
        next(rooms), next(rooms)
        assert len(children()) == 1
        rooms.close()
        assert not children()
        """
    done = run(script)
    assert done.returncode == 0, done.stderr.decode()


def test_a_fault_beside_is_raised_here_after_what_was_sound():
    script = """
        def at_third():
            raise ScanError("corrupt after point 2")
        for room in filled(beside, [10] * 8):
            print(room[0], flush=True)
        """
    done = run(script)
    assert done.stdout.split() == [b"1", b"2"]
    assert done.stderr.endswith(b"station.errors.ScanError: corrupt after point 2\n")


@pytest.mark.parametrize("name", ["SIGSEGV", "SIGABRT", "SIGKILL"])
def test_a_death_beside_is_a_death_here(name):
    """So whoever waits for this process hears of it as if the decoder had run here."""
    script = """
        import resource
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        def at_third():
            os.kill(os.getpid(), getattr(signal, sys.argv[1]))
        list(filled(beside, [10] * 8))
        """
    assert run(script, name).returncode == -getattr(signal, name)


def test_an_end_without_a_word_is_told():
    script = """
        def at_third():
            os._exit(3)
        list(filled(beside, [10] * 8))
        """
    assert b"ScanError: the decoder ended without a word" in run(script).stderr


def test_it_does_not_outlive_a_process_that_is_killed():
    script = """
        def at_third():
            time.sleep(0.2)
        rooms = filled(beside, [10] * 8)
        next(rooms)
        print(*children(), flush=True)
        os.kill(os.getpid(), signal.SIGKILL)
        """
    done = run(script)  # in vain, if the other kept the output open
    assert done.returncode == -signal.SIGKILL
    assert done.stdout.strip()


def test_a_process_with_threads_does_without():
    script = """
        import threading
        def at_third():
            pass
        over = threading.Event()
        threading.Thread(target=over.wait).start()
        assert [(room[0], children()) for room in filled(beside, [10] * 3)] == [(n, []) for n in (1, 2, 3)]
        over.set()
        """
    done = run(script)
    assert done.returncode == 0, done.stderr.decode()


def test_where_no_process_is_granted_it_does_without():
    script = """
        def at_third():
            pass
        def refused():
            raise BlockingIOError(11, "Resource temporarily unavailable")
        os.fork = refused
        assert [room[0] for room in filled(beside, [10] * 3)] == [1, 2, 3]
        """
    done = run(script)
    assert done.returncode == 0, done.stderr.decode()


def test_a_process_that_ignores_its_children_reads_all_the_same():
    script = """
        def at_third():
            pass
        signal.signal(signal.SIGCHLD, signal.SIG_IGN)
        for room in filled(beside, [10] * 3):
            time.sleep(0.05)  # the other is through, and gone, before the last is read
        assert room[0] == 3
        """
    done = run(script)
    assert done.returncode == 0, done.stderr.decode()
