"""The SQLite file of the journal: its tables, how it is opened, what can be wrong with it."""

from __future__ import annotations

import sqlite3
from pathlib import Path

_SCHEMA = """
CREATE TABLE IF NOT EXISTS scan (
    name TEXT PRIMARY KEY,
    size INTEGER NOT NULL,
    mtime_ns INTEGER NOT NULL,
    state TEXT NOT NULL CHECK (state IN ('waiting', 'stored', 'set_aside', 'later')),
    waits_for TEXT NOT NULL DEFAULT '',
    reason TEXT NOT NULL DEFAULT '',
    sha256 TEXT,
    log_sha256 TEXT NOT NULL DEFAULT '',
    outcome TEXT CHECK (outcome IN ('stored', 'set_aside')),
    verdict TEXT,
    epoch TEXT,
    start_utc_s REAL,
    revision INTEGER,
    reference TEXT,
    figures TEXT NOT NULL DEFAULT '{}',
    attempts INTEGER NOT NULL DEFAULT 0,
    next_try_utc_s REAL,
    seen_utc_s REAL NOT NULL,
    changed_utc_s REAL NOT NULL
) STRICT;
CREATE INDEX IF NOT EXISTS scan_by_size ON scan (size);
CREATE TABLE IF NOT EXISTS file (
    path TEXT PRIMARY KEY,
    sha256 TEXT NOT NULL
) STRICT;
"""
_LATER_COLUMNS = {"log_sha256": "TEXT NOT NULL DEFAULT ''"}  # which older journals lack


def open_to_write(path: Path) -> sqlite3.Connection:
    """Open or make the file, and bring an older one up to date; raises sqlite3.Error."""
    rows = sqlite3.connect(path, isolation_level=None, timeout=20.0)
    try:
        rows.execute("PRAGMA journal_mode = WAL")
        rows.execute("PRAGMA synchronous = FULL")
        rows.executescript(_SCHEMA)
        known = {column[1] for column in rows.execute("PRAGMA table_info(scan)")}
        for column, kind in _LATER_COLUMNS.items():
            if column not in known:
                rows.execute(f"ALTER TABLE scan ADD COLUMN {column} {kind}")
    except sqlite3.Error:
        rows.close()
        raise
    return rows


def open_to_read(path: Path) -> sqlite3.Connection:
    """Open without leaving a file behind: a reader of another user must not own the writer's side files."""
    if not path.exists():
        return _empty()
    side = path.with_name(path.name + "-wal")
    quiet = not side.exists() or side.stat().st_size == 0
    mode = "immutable=1" if quiet else "mode=ro"
    uri = f"{path.absolute().as_uri()}?{mode}"
    rows = sqlite3.connect(uri, uri=True, isolation_level=None, timeout=20.0)
    if rows.execute("SELECT 1 FROM sqlite_master WHERE name = 'scan'").fetchone():
        return rows
    rows.close()  # the service has only just begun, or was killed just then
    return _empty()


def _empty() -> sqlite3.Connection:
    rows = sqlite3.connect(":memory:", isolation_level=None)
    rows.executescript(_SCHEMA)
    return rows


def explain(path: Path, error: sqlite3.Error) -> str:
    """Say in words a person can act on what is wrong with the file."""
    if isinstance(error, sqlite3.OperationalError):
        return f"{path}: the journal cannot be used: {error}: is the disk full, or the folder another user's?"
    return (
        f"{path}: the journal is damaged: {error}: move it and its -wal away, it is made anew from the epochs"
    )
