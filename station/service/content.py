"""The bytes of a file: what they are, and whether they stood still."""

from __future__ import annotations

import hashlib
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from station.errors import NotReadyError, ScanError


@contextmanager
def held_still(path: Path) -> Iterator[str]:
    """Give the SHA-256 of a regular file; raise NotReadyError if it changed meanwhile."""
    before = fingerprint(path)
    yield sha256_of(path)
    if fingerprint(path) != before:
        raise NotReadyError("the file changed while it was read")


def fingerprint(path: Path) -> tuple[int, int, int]:
    """Return what changes with a file; raise ScanError where it is no regular one, NotReadyError if gone."""
    try:
        status = path.lstat()
    except FileNotFoundError as error:
        raise NotReadyError("the file is gone") from error
    except OSError as error:
        raise NotReadyError(f"the file cannot be looked at: {error.strerror}") from error
    if not stat.S_ISREG(status.st_mode):
        raise ScanError("not a regular file: links, pipes and devices are refused")
    return status.st_ino, status.st_size, status.st_mtime_ns


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file, links not followed; raise NotReadyError where it cannot be read."""
    try:
        with os.fdopen(os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK), "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise NotReadyError(f"{path.name} cannot be read: {error.strerror}") from error
