"""Exclusive lock on the data folder: only one process writes to it, and never to another folder in its place.

A folder has a random identity, `.store_id`. The service remembers the identity in the state folder that
systemd provides, so that it does not begin a second series in the mount point of a disk that is missing.
"""

from __future__ import annotations

import fcntl
import os
import time
import uuid
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

from station.errors import NotReadyError, StoreError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

LOCK = "service.lock"
IDENTITY = ".store_id"
HOLDER_BYTES = 4096  # of the lock file: one block of a disk, which is there when the disk is full


class LockedFolder:
    """The data folder that this process has locked."""

    def __init__(self, data: Path, lock_fd: int) -> None:
        self._data = data
        self._lock_fd = lock_fd
        self._folder = _file_id(data)
        self._identity = _identify(data)

    def require_same(self) -> None:
        """Raise StoreError unless the path still leads to the folder that is locked.

        A lock file that was deleted is created and locked again.
        """
        locked = os.fstat(self._lock_fd)
        if _file_id(self._data / LOCK) == (locked.st_dev, locked.st_ino):
            return
        if _file_id(self._data) != self._folder:
            raise StoreError(
                f"{self._data}: another folder is in its place, or none: mount or move the right one back,"
                " the service then resumes"
            )
        new_fd = _open_lock(self._data)
        try:
            if not _try_lock(new_fd, fcntl.LOCK_EX):
                raise StoreError(f"{self._data}: its lock was deleted, and another process uses it now")
            os.dup2(new_fd, self._lock_fd, inheritable=False)
            _write_holder(self._lock_fd, "")
        finally:
            os.close(new_fd)

    def record_pause(self, reason: str) -> None:
        """Write into the lock file, for `status`, why the service pauses; '' if it works.

        The file keeps its size, so that this is possible on a full disk too.
        """
        _write_holder(self._lock_fd, reason)

    def is_remounted(self) -> bool:
        """Return True if the path leads to the same store through another mount than when it was locked."""
        return _file_id(self._data) != self._folder and self._identity == read_identity(self._data) != ""


def require_known(data: Path, state: Path) -> None:
    """Raise StoreError if a data folder is not the store that it was before, as remembered in `state`.

    The store is remembered for the next time.
    """
    if data == state or state in data.parents:  # they come and go together
        return
    path, remembered_path, remembered = state / "data_folder", "", ""
    with suppress(OSError):
        remembered_path, _, remembered = path.read_text(encoding="utf-8", errors="replace").partition("\n")
    identity = read_identity(data)
    if remembered_path == str(data) and remembered.strip() not in {"", identity}:
        raise StoreError(
            f"{data}: is not the folder of the stored series: is its disk mounted? To begin a new series in"
            f" this folder, delete {path}"
        )
    identity = identity or _identify(data)
    if identity:  # a folder that is yet to be created has none
        with suppress(OSError):
            path.write_text(f"{data}\n{identity}\n", encoding="utf-8")


def read_identity(data: Path) -> str:
    """Return the identity of a data folder, '' if it has none."""
    try:
        return (data / IDENTITY).read_text(encoding="ascii", errors="replace").strip()
    except OSError:
        return ""


def _identify(data: Path) -> str:
    """Return the identity of a data folder, which is given one if it has none and the disk is not full."""
    if not read_identity(data):
        tmp_path = data / f"{IDENTITY}.{os.getpid()}"
        with suppress(OSError):
            tmp_path.write_text(f"{uuid.uuid4()}\n", encoding="ascii")
            tmp_path.replace(data / IDENTITY)
    return read_identity(data)


def _file_id(path: Path) -> tuple[int, int]:
    """Return device and inode of a file or folder; zeros if it does not exist."""
    try:
        status = path.stat()
    except OSError:
        return 0, 0
    return status.st_dev, status.st_ino


def _open_lock(data: Path) -> int:
    try:
        return os.open(data / LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o640)
    except OSError as error:
        raise StoreError(f"{data}: the data folder is not writable: {error.strerror}") from error


@contextmanager
def exclusive_lock(data: Path, *, timeout_s: float = 2.0) -> Iterator[LockedFolder]:
    """Lock the data folder for this process; raise NotReadyError if another process has locked it.

    The time-out is needed because `station status` takes the same lock for a moment.
    """
    try:
        data.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StoreError(f"{data}: the data folder is not writable: {error.strerror}") from error
    lock_fd = _open_lock(data)
    try:
        until_s = time.monotonic() + timeout_s
        while not _try_lock(lock_fd, fcntl.LOCK_EX):
            if time.monotonic() > until_s:
                pid = _read_holder(lock_fd)[0] or "unknown"
                raise NotReadyError(
                    f"{data} is in use by another station process (pid {pid}): stop that process first,"
                    " or give each site its own station.data"
                )
            time.sleep(0.05)
        _write_holder(lock_fd, "")
        yield LockedFolder(data, lock_fd)
    finally:
        os.close(lock_fd)


def is_locked(data: Path) -> bool:
    """Return True if a process has locked the data folder."""
    try:
        lock_fd = os.open(data / LOCK, os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return False
    try:
        return not _try_lock(lock_fd, fcntl.LOCK_SH)
    finally:
        os.close(lock_fd)


def pause_reason(data: Path) -> str:
    """Return why the process that has locked a data folder pauses; '' if it works, or no process has."""
    if not is_locked(data):
        return ""
    try:
        lock_fd = os.open(data / LOCK, os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return ""
    try:
        return _read_holder(lock_fd)[1]
    finally:
        os.close(lock_fd)


def _write_holder(lock_fd: int, pause: str) -> None:
    """Write process id and reason of a pause into the lock file."""
    content = f"{os.getpid()}\n{' '.join(pause.split())}\n".encode()[: HOLDER_BYTES - 1]
    with suppress(OSError):  # the disk is full or gone: the lock is valid, only the text is missing
        os.pwrite(lock_fd, content.ljust(HOLDER_BYTES, b"\n"), 0)


def _read_holder(lock_fd: int) -> tuple[str, str]:
    """Return process id and reason of a pause from the lock file, as far as they are there."""
    try:
        text = os.pread(lock_fd, HOLDER_BYTES, 0).decode("utf-8", "ignore")  # it may end within a character
    except OSError:
        text = ""
    pid, _, rest = text.partition("\n")
    return pid.strip(), rest.strip()


def _try_lock(descriptor: int, kind: int) -> bool:
    try:
        fcntl.flock(descriptor, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
