"""The record of what was published: files at each target, bytes of each day, epochs passed to the hook."""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from station.errors import StoreError

_SCHEMA = """
CREATE TABLE IF NOT EXISTS sent (target TEXT, path TEXT, size INT, mtime_ns INT, PRIMARY KEY (target, path));
CREATE TABLE IF NOT EXISTS epoch (target TEXT, name TEXT, PRIMARY KEY (target, name));
CREATE TABLE IF NOT EXISTS traffic (target TEXT, day TEXT, bytes INT, PRIMARY KEY (target, day));
CREATE TABLE IF NOT EXISTS notice (kind TEXT, name TEXT, tries INT, is_done INT, PRIMARY KEY (kind, name));
"""
_BUSY_S = 60.0


@dataclass(frozen=True)
class SourceFile:
    """A file to publish: path relative to the data folder, size, time, and names of the epochs in it."""

    path: str
    size: int
    mtime_ns: int
    epochs: tuple[str, ...] = ()


class UploadRecord:
    """The record, a SQLite file; each method is one transaction and raises StoreError if it fails."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / "record.sqlite"
        with self._store_errors():
            self._connection = sqlite3.connect(self._path, timeout=_BUSY_S)
            self._connection.executescript(_SCHEMA)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._connection.close()

    def sent(self, target: str) -> dict[str, tuple[int, int]]:
        """Return size and time of the files that a target has, by path."""
        rows = self._rows("SELECT path, size, mtime_ns FROM sent WHERE target = ?", target)
        return {path: (size, mtime_ns) for path, size, mtime_ns in rows}

    def epochs(self, target: str) -> set[str]:
        """Return the names of the epochs that a target has, in whatever files."""
        return {name for (name,) in self._rows("SELECT name FROM epoch WHERE target = ?", target)}

    def add_sent(self, target: str, files: Iterable[SourceFile]) -> None:
        """Record that a target has these files."""
        files = list(files)
        with self._store_errors(), self._connection:
            self._connection.executemany(
                "INSERT OR REPLACE INTO sent VALUES (?, ?, ?, ?)",
                [(target, file.path, file.size, file.mtime_ns) for file in files],
            )
            self._connection.executemany(
                "INSERT OR IGNORE INTO epoch VALUES (?, ?)",
                [(target, name) for file in files for name in file.epochs],
            )

    def traffic_bytes(self, target: str, day: str) -> int:
        """Return the bytes that were sent to a target on a day (UTC)."""
        rows = self._rows("SELECT bytes FROM traffic WHERE target = ? AND day = ?", target, day)
        return int(rows[0][0]) if rows else 0

    def add_traffic(self, target: str, day: str, count: int) -> None:
        """Add to the bytes sent to a target on a day; a negative count takes back what was not sent."""
        query = "INSERT INTO traffic VALUES (?1, ?2, ?3) ON CONFLICT DO UPDATE SET bytes = bytes + ?3"
        with self._store_errors(), self._connection:
            self._connection.execute(query, (target, day, count))

    def tries(self, kind: str) -> dict[str, float]:
        """Return the number of failed tries of each epoch's notice, infinite once it is done."""
        rows = self._rows("SELECT name, tries, is_done FROM notice WHERE kind = ?", kind)
        return {name: math.inf if is_done else tries for name, tries, is_done in rows}

    def add_try(self, kind: str, names: Iterable[str], *, is_done: bool) -> None:
        """Record a try of a notice about each of these epochs."""
        with self._store_errors(), self._connection:
            self._connection.executemany(
                "INSERT INTO notice VALUES (?1, ?2, 1, ?3)"
                " ON CONFLICT DO UPDATE SET tries = tries + 1, is_done = ?3",
                [(kind, name, is_done) for name in names],
            )

    def _rows(self, query: str, *values: object) -> list[Any]:
        with self._store_errors():
            return self._connection.execute(query, values).fetchall()

    @contextmanager
    def _store_errors(self) -> Iterator[None]:
        try:
            yield
        except (sqlite3.Error, OSError) as error:
            raise StoreError(
                f"{self._path}: {error}; nothing is lost: what is not recorded is sent again. If the file is"
                " damaged, delete it"
            ) from error
