"""One process writes in a data folder."""

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
def only_writer(data: Path, *, patience_s: float = 2.0) -> Iterator[None]:
    """Hold the data folder for this process; raise NotReadyError where another one holds it.

    `station status` asks for a glimpse of the same lock, hence the patience.
    """
    try:
        data.mkdir(parents=True, exist_ok=True)
        held = os.open(data / "service.lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o640)
    except OSError as error:
        raise StoreError(f"{data}: the data folder cannot be written: {error.strerror}") from error
    try:
        until_s = time.monotonic() + patience_s
        while not _take_lock(held, fcntl.LOCK_EX):
            if time.monotonic() > until_s:
                owner = os.pread(held, 20, 0).decode("ascii", "replace").strip() or "unknown"
                raise NotReadyError(
                    f"{data} is in use by another station process (pid {owner}): stop that one first,"
                    " or give each site its own station.data"
                )
            time.sleep(0.05)
        with suppress(OSError):  # a full disk: the lock holds all the same, only the number is missing
            os.ftruncate(held, 0)
            os.pwrite(held, b"%d\n" % os.getpid(), 0)
        yield
    finally:
        os.close(held)


def in_use(data: Path) -> bool:
    """Tell whether a process holds the data folder."""
    try:
        probe = os.open(data / "service.lock", os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return False
    try:
        return not _take_lock(probe, fcntl.LOCK_SH)
    finally:
        os.close(probe)


def _take_lock(descriptor: int, kind: int) -> bool:
    try:
        fcntl.flock(descriptor, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
