"""Files that appear complete or not at all, also after a power cut."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from station.errors import StoreError

DAMAGED = ".damaged"  # appended to the name of a damaged file, which is never read and never deleted


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Yield a temporary path in the folder of `path`; on success, sync the file and rename it to `path`.

    Raises StoreError if that fails; then the temporary file is deleted.
    Source: store.md, 1.
    """
    tmp_path = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        tmp_path.unlink(missing_ok=True)  # from a killed process that had the same process id
        yield tmp_path
        with tmp_path.open("rb") as file:
            os.fsync(file.fileno())
        move_folder_away(path)
        tmp_path.replace(path)
        _sync_folders(path.parent)
    except (OSError, RuntimeError) as error:  # netCDF reports a full disk as RuntimeError, without errno
        raise StoreError(f"{path}: cannot be written: {error}") from error
    finally:
        with suppress(OSError):  # if this fails too, `delete_expired` removes the file later
            tmp_path.unlink(missing_ok=True)


def move_folder_away(path: Path) -> None:
    """Rename a folder that some accident left in the place of a file; nothing is deleted."""
    if path.is_dir() and not path.is_symlink():
        path.rename(path.with_name(f"{path.name}.{time.time_ns()}{DAMAGED}"))


def _sync_folders(folder: Path) -> None:
    """Sync a folder and its parents, so that a new file name survives a power cut."""
    for parent in (folder, *list(folder.parents)[:4]):
        if not os.access(parent, os.R_OK):
            return
        descriptor = os.open(parent, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
