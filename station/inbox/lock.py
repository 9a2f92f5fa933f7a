"""Exclusive lock on the data folder: only one process writes to it."""

from __future__ import annotations

import fcntl
import os
import time
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

from station.errors import NotReadyError, StoreError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


@contextmanager
def exclusive_lock(data: Path, *, timeout_s: float = 2.0) -> Iterator[None]:
    """Lock the data folder for this process; raise NotReadyError if another process has locked it.

    The time-out is needed because `station status` takes the same lock for a moment.
    """
    try:
        data.mkdir(parents=True, exist_ok=True)
        lock_fd = os.open(data / "service.lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o640)
    except OSError as error:
        raise StoreError(f"{data}: the data folder is not writable: {error.strerror}") from error
    try:
        until_s = time.monotonic() + timeout_s
        while not _try_lock(lock_fd, fcntl.LOCK_EX):
            if time.monotonic() > until_s:
                pid = os.pread(lock_fd, 20, 0).decode("ascii", "replace").strip() or "unknown"
                raise NotReadyError(
                    f"{data} is in use by another station process (pid {pid}): stop that process first,"
                    " or give each site its own station.data"
                )
            time.sleep(0.05)
        with suppress(OSError):  # the disk is full: the lock is valid, only the pid is missing
            os.ftruncate(lock_fd, 0)
            os.pwrite(lock_fd, b"%d\n" % os.getpid(), 0)
        yield
    finally:
        os.close(lock_fd)


def is_locked(data: Path) -> bool:
    """Return True if a process has locked the data folder."""
    try:
        lock_fd = os.open(data / "service.lock", os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return False
    try:
        return not _try_lock(lock_fd, fcntl.LOCK_SH)
    finally:
        os.close(lock_fd)


def _try_lock(descriptor: int, kind: int) -> bool:
    try:
        fcntl.flock(descriptor, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
