"""Content hash of a file, and a check that the file did not change while it was read."""

from __future__ import annotations

import hashlib
import os
import stat
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from station.errors import NotReadyError, ScanError

SAMPLE_BYTES = 4096


@contextmanager
def hash_if_unchanged(paths: Sequence[Path]) -> Iterator[str]:
    """Yield the SHA-256 of regular files; raise NotReadyError on exit if one changed meanwhile."""
    identities = [file_identity(path) for path in paths]
    yield sha256_files(paths)
    if [file_identity(path) for path in paths] != identities:
        raise NotReadyError("the file changed while it was read")


def file_identity(path: Path) -> tuple[int, int, int]:
    """Return (inode, size, mtime_ns) of a file.

    Raises ScanError if it is not a regular file, NotReadyError if it does not exist or cannot be accessed.
    """
    try:
        status = path.lstat()
    except FileNotFoundError as error:
        raise NotReadyError("the file no longer exists") from error
    except OSError as error:
        raise NotReadyError(f"the file cannot be accessed: {error.strerror}") from error
    if not stat.S_ISREG(status.st_mode):
        raise ScanError("not a regular file: links, pipes and devices are rejected")
    return status.st_ino, status.st_size, status.st_mtime_ns


def sample_file(path: Path, size: int) -> bytes:
    """Return 4 kB each of the beginning, middle and end of a file of this size: another sample, another file.

    Links are not followed. Raises NotReadyError if it cannot be read.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
        try:
            offsets = (0, size // 2, max(0, size - SAMPLE_BYTES))
            return b"".join(os.pread(descriptor, SAMPLE_BYTES, offset) for offset in offsets)
        finally:
            os.close(descriptor)
    except OSError as error:
        raise NotReadyError(f"{path.name} cannot be read: {error.strerror}") from error


def sha256_file(path: Path) -> str:
    """Return the SHA-256 of a file; links are not followed. Raises NotReadyError if it cannot be read."""
    try:
        with os.fdopen(os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK), "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise NotReadyError(f"{path.name} cannot be read: {error.strerror}") from error


def sha256_files(paths: Sequence[Path]) -> str:
    """Return the SHA-256 of a file, or one of the contents of several, whatever their names.

    Files with the same bytes count once. '' without any file; raises as `sha256_file`.
    """
    contents = sorted({sha256_file(path) for path in paths})
    if len(contents) > 1:
        return hashlib.sha256("\n".join(contents).encode()).hexdigest()
    return "".join(contents)


def distinct_files(paths: Sequence[Path]) -> list[Path]:
    """Return the files without those that have the same bytes as one before; raises as `sha256_file`."""
    sizes = [file_identity(path)[1] for path in paths]
    contents: set[str] = set()
    kept = []
    for path, size in zip(paths, sizes, strict=True):
        content = sha256_file(path) if sizes.count(size) > 1 else str(path)
        if content not in contents:
            kept.append(path)
        contents.add(content)
    return kept
