"""SQLite file of the journal: schema, opening, error messages."""

from __future__ import annotations

import sqlite3
from pathlib import Path

_SCHEMA = """
CREATE TABLE IF NOT EXISTS scan (
    name TEXT PRIMARY KEY,
    size INTEGER NOT NULL,
    mtime_ns INTEGER NOT NULL,
    state TEXT NOT NULL CHECK (state IN ('waiting', 'stored', 'set_aside', 'later')),
    waiting_reason TEXT NOT NULL DEFAULT '',
    reason TEXT NOT NULL DEFAULT '',
    sha256 TEXT,
    log_sha256 TEXT NOT NULL DEFAULT '',
    outcome TEXT CHECK (outcome IN ('stored', 'set_aside')),
    verdict TEXT,
    epoch TEXT,
    start_utc_s REAL,
    revision INTEGER,
    reference TEXT,
    metrics TEXT NOT NULL DEFAULT '{}',
    attempts INTEGER NOT NULL DEFAULT 0,
    next_try_utc_s REAL,
    first_seen_utc_s REAL NOT NULL,
    changed_utc_s REAL NOT NULL,
    judged_under TEXT,
    ahead INTEGER NOT NULL DEFAULT 0 CHECK (ahead IN (0, 1))
) STRICT;
CREATE INDEX IF NOT EXISTS scan_by_size ON scan (size);
CREATE TABLE IF NOT EXISTS file (
    path TEXT PRIMARY KEY,
    sha256 TEXT NOT NULL
) STRICT;
"""
_ADDED_COLUMNS = {  # missing in older journals
    "log_sha256": "TEXT NOT NULL DEFAULT ''",
    "judged_under": "TEXT",
    "ahead": "INTEGER NOT NULL DEFAULT 0 CHECK (ahead IN (0, 1))",
}


def open_to_write(path: Path) -> sqlite3.Connection:
    """Return a writable connection; create the file or add missing columns. Raises sqlite3.Error."""
    connection = sqlite3.connect(path, isolation_level=None, timeout=20.0)
    try:
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("PRAGMA synchronous = FULL")
        connection.executescript(_SCHEMA)
        for column in _missing_columns(connection):
            connection.execute(f"ALTER TABLE scan ADD COLUMN {column} {_ADDED_COLUMNS[column]}")
    except sqlite3.Error:
        connection.close()
        raise
    return connection


def open_to_read(path: Path) -> sqlite3.Connection:
    """Return a read-only connection; creates no files, so that a reader never owns the writer's WAL files."""
    if not path.exists():
        return _empty()
    wal = path.with_name(path.name + "-wal")
    is_idle = not wal.exists() or wal.stat().st_size == 0
    mode = "immutable=1" if is_idle else "mode=ro"
    uri = f"{path.absolute().as_uri()}?{mode}"
    connection = sqlite3.connect(uri, uri=True, isolation_level=None, timeout=20.0)
    if connection.execute("SELECT 1 FROM sqlite_master WHERE name = 'scan'").fetchone():
        return _with_all_columns(connection)
    connection.close()  # the service has just started, or was killed while it created the file
    return _empty()


def _missing_columns(connection: sqlite3.Connection) -> list[str]:
    existing = {column[1] for column in connection.execute("PRAGMA table_info(scan)")}
    return [column for column in _ADDED_COLUMNS if column not in existing]


def _with_all_columns(connection: sqlite3.Connection) -> sqlite3.Connection:
    """Return the connection; of a journal that no new service has opened yet, a completed copy in memory."""
    if not (missing := _missing_columns(connection)):
        return connection
    copy = sqlite3.connect(":memory:", isolation_level=None)
    connection.backup(copy)
    connection.close()
    for column in missing:
        copy.execute(f"ALTER TABLE scan ADD COLUMN {column} {_ADDED_COLUMNS[column]}")
    return copy


def _empty() -> sqlite3.Connection:
    connection = sqlite3.connect(":memory:", isolation_level=None)
    connection.executescript(_SCHEMA)
    return connection


def describe_error(path: Path, error: sqlite3.Error) -> str:
    """Return a message that explains to the operator what is wrong with the file."""
    if isinstance(error, sqlite3.OperationalError):
        return f"{path}: the journal cannot be used: {error}: is the disk full, or the folder not writable?"
    return (
        f"{path}: the journal is damaged: {error}: move it and its -wal away; it is rebuilt from the epochs"
    )
