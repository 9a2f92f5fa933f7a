"""Decoding ahead in a child process gives the same points and the same errors as decoding inline."""

import os
import signal
import subprocess
import sys
import textwrap

import numpy as np
import pytest

from station.processing.workers.fork_server import WORKER_ENV
from station.readers.las import LasScan

# In a process of its own: only a process without other threads forks.
PREAMBLE = """
import os, signal, sys, time
from contextlib import contextmanager
from pathlib import Path
from station.errors import ScanError
from station.readers.prefetch import prefetch
from station.readers.las import LasScan

def children():
    return Path(f"/proc/self/task/{os.getpid()}/children").read_text().split()

@contextmanager
def open_decoder():
    count = 0
    def fill(buffer):
        nonlocal count
        count += 1
        if count == 3:
            on_third()
        buffer[:] = count
    yield fill
"""


def run(script, *args):
    command = [sys.executable, "-c", PREAMBLE + textwrap.dedent(script), *map(str, args)]
    environment = os.environ | WORKER_ENV | {"PYTHONPATH": os.pathsep.join(sys.path)}
    return subprocess.run(command, capture_output=True, timeout=60, check=False, env=environment)


def test_prefetched_echoes_equal_those_decoded_inline(write_sweep, tmp_path):
    path = write_sweep("s.laz", 30_001)
    script = """
        import numpy as np
        blocks = []
        for block in LasScan(Path(sys.argv[1])).blocks(1000):
            blocks.append([*block.xyz_m, block.time_s, block.intensity])
            if len(blocks) == 1:
                assert len(children()) == 1  # else nothing is prefetched
        assert not children()
        np.save(sys.argv[2], np.concatenate(blocks, axis=1))
        """
    result = run(script, path, tmp_path / "echoes.npy")
    assert result.returncode == 0, result.stderr.decode()
    shots = LasScan(path).blocks(30_001)
    expected = [[*block.xyz_m, block.time_s, block.intensity] for block in shots]
    assert np.array_equal(np.load(tmp_path / "echoes.npy"), np.concatenate(expected, axis=1))


@pytest.mark.integration
def test_a_buffer_is_not_overwritten_while_it_is_read():
    script = """
        def on_third():
            pass
        contents = []
        for buffer in prefetch(open_decoder, [10] * 7 + [4]):
            time.sleep(0.05)  # long enough to fill all free buffers
            contents.append((len(buffer), set(buffer.tolist())))
        assert contents == [(10, {n}) for n in range(1, 8)] + [(4, {8})], contents
        """
    result = run(script)
    assert result.returncode == 0, result.stderr.decode()


def test_closing_the_iterator_ends_the_child():
    script = """
        def on_third():
            time.sleep(60)
        buffers = prefetch(open_decoder, [10] * 8)
        next(buffers), next(buffers)
        assert len(children()) == 1
        buffers.close()
        assert not children()
        """
    result = run(script)
    assert result.returncode == 0, result.stderr.decode()


@pytest.mark.integration
def test_error_in_the_child_is_raised_after_the_valid_buffers():
    script = """
        def on_third():
            raise ScanError("corrupt after point 2")
        for buffer in prefetch(open_decoder, [10] * 8):
            print(buffer[0], flush=True)
        """
    result = run(script)
    assert result.stdout.split() == [b"1", b"2"]
    assert result.stderr.endswith(b"station.errors.ScanError: corrupt after point 2\n")


@pytest.mark.integration
@pytest.mark.parametrize("name", ["SIGSEGV", "SIGABRT", "SIGKILL"])
def test_fatal_signal_in_the_child_kills_the_parent(name):
    """The exit status is the same as if the decoder had run in this process."""
    script = """
        import resource
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        def on_third():
            os.kill(os.getpid(), getattr(signal, sys.argv[1]))
        list(prefetch(open_decoder, [10] * 8))
        """
    assert run(script, name).returncode == -getattr(signal, name)


@pytest.mark.integration
def test_silent_exit_of_the_child_is_reported():
    script = """
        def on_third():
            os._exit(3)
        list(prefetch(open_decoder, [10] * 8))
        """
    assert b"InconclusiveError: the decoder process ended without a message" in run(script).stderr


@pytest.mark.integration
def test_child_ends_when_the_parent_is_killed():
    script = """
        def on_third():
            time.sleep(0.2)
        buffers = prefetch(open_decoder, [10] * 8)
        next(buffers)
        print(*children(), flush=True)
        os.kill(os.getpid(), signal.SIGKILL)
        """
    result = run(script)  # times out if the child keeps the output open
    assert result.returncode == -signal.SIGKILL
    assert result.stdout.strip()


@pytest.mark.integration
def test_process_with_threads_decodes_inline():
    script = """
        import threading
        def on_third():
            pass
        finished = threading.Event()
        threading.Thread(target=finished.wait).start()
        contents = [(buffer[0], children()) for buffer in prefetch(open_decoder, [10] * 3)]
        assert contents == [(n, []) for n in (1, 2, 3)]
        finished.set()
        """
    result = run(script)
    assert result.returncode == 0, result.stderr.decode()


@pytest.mark.integration
def test_failed_fork_decodes_inline():
    script = """
        def on_third():
            pass
        def fail():
            raise BlockingIOError(11, "Resource temporarily unavailable")
        os.fork = fail
        assert [buffer[0] for buffer in prefetch(open_decoder, [10] * 3)] == [1, 2, 3]
        """
    result = run(script)
    assert result.returncode == 0, result.stderr.decode()


@pytest.mark.integration
def test_parent_that_ignores_sigchld():
    script = """
        def on_third():
            pass
        signal.signal(signal.SIGCHLD, signal.SIG_IGN)
        for buffer in prefetch(open_decoder, [10] * 3):
            time.sleep(0.05)  # the child has exited before the last buffer is read
        assert buffer[0] == 3
        """
    result = run(script)
    assert result.returncode == 0, result.stderr.decode()
