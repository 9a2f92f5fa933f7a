"""Tasks for the tests of the isolation; a fresh interpreter imports this module by name."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import threading
import time
from pathlib import Path

from station.errors import ScanError, StoreError


class Panic(BaseException):
    """Like pyo3's PanicException: not an Exception."""


def add(a, b, _progress):
    return a + b


def progress_all_the_time(seconds, progress):
    until_s, steps = time.monotonic() + seconds, 0
    while time.monotonic() < until_s:
        progress()
        steps += 1
    return steps


def environment(name, progress):
    progress()
    import numpy as np

    np.ones((200, 200)) @ np.ones((200, 200))
    return os.environ.get(name), len(list(Path("/proc/self/task").iterdir()))


def allocate(gigabytes, _progress):
    return len(bytearray(int(gigabytes * 2**30)))


def allocate_in_numpy(gigabytes, _progress):
    import numpy as np

    return float(np.ones(int(gigabytes * 2**27)).sum())


def kill(number, _progress):
    os.kill(os.getpid(), number)
    time.sleep(10)


def killed_times(times, note, _progress):
    with Path(note).open("ab") as count:
        count.write(b".")
    size = Path(note).stat().st_size
    if size <= times:
        os.kill(os.getpid(), signal.SIGKILL)
    return size - 1


def killed_during_its_report(note, _progress):
    if not Path(note).exists():
        Path(note).touch()
        threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGKILL)).start()
    return bytes(5_000_000)


def abort(_progress):
    os.abort()


def segfault(_progress):
    ctypes.string_at(0)


def hang(_progress):
    while True:
        time.sleep(0.05)


def hang_ignoring_signals(note, _progress):
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, signal.SIG_IGN)
    Path(note).write_text(str(os.getpid()), encoding="ascii")
    while True:
        time.sleep(0.05)


def read_pipe(pipe, note, _progress):
    Path(note).write_text(str(os.getpid()), encoding="ascii")
    return Path(pipe).read_bytes()


def work_silently(seconds, _progress):
    until_s, steps = time.monotonic() + seconds, 0
    while time.monotonic() < until_s:
        steps += 1
    return steps


def note_pid_and_spin(note, progress):
    with Path(note).open("a", encoding="ascii") as file:
        file.write(f"{os.getpid()}\n")
    while True:
        progress()


def panic(_progress):
    raise Panic("called `Option::unwrap()` on a `None` value")


def exit_task(_progress):
    sys.exit(3)


def vanish(_progress):
    os._exit(0)


def raise_scan_error(_progress):
    raise ScanError("contains no points")


def raise_store_error(_progress):
    raise StoreError("no space left")


def raise_key_error(_progress):
    return {}["missing"]


def return_unpicklable(_progress):
    return lambda: None


def many_bytes(count, _progress):
    return b"x" * count
