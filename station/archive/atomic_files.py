"""Files that appear complete or not at all, also after a power cut."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from station.errors import StoreError


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
        tmp_path.replace(path)
        _sync_folders(path.parent)
    except (OSError, RuntimeError) as error:  # netCDF reports a full disk as RuntimeError, without errno
        raise StoreError(f"{path}: cannot be written: {error}") from error
    finally:
        with suppress(OSError):  # if this fails too, `delete_expired` removes the file later
            tmp_path.unlink(missing_ok=True)


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
