"""What reading a damaged file may raise, in one place: each library has its own way."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from isal.igzip_lib import IsalError

from station.errors import StoreError


@contextmanager
def read_errors(path: Path) -> Iterator[None]:
    """Raise StoreError that names the file in place of what a library raises if it is missing or damaged.

    h5py alone raises OSError, RuntimeError, KeyError or ValueError, depending on the bytes that are damaged;
    damaged text cannot be decoded or found.
    """
    try:
        yield
    except (OSError, RuntimeError, KeyError, IndexError, AttributeError, ValueError, IsalError) as error:  # type: ignore[misc] # the stub has no class
        cause = error.args[0] if isinstance(error, KeyError) else error  # which would be in quotes
        raise StoreError(f"{path}: cannot be read: {cause}") from error
