"""Journal of the scans, to read: one row per file name, in SQLite. `journal.Journal` writes it."""

from __future__ import annotations

import json
import sqlite3
from contextlib import contextmanager
from dataclasses import dataclass, fields
from enum import StrEnum
from typing import TYPE_CHECKING, NamedTuple, Self

from station.errors import StoreError
from station.inbox.journal_schema import describe_error, open_to_read

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from pathlib import Path


class State(StrEnum):
    """State of a scan."""

    WAITING = "waiting"
    STORED = "stored"
    SET_ASIDE = "set_aside"
    LATER = "later"


UNFINISHED = {State.WAITING, State.LATER}


@dataclass(frozen=True)
class Entry:
    """One row of the journal.

    `waiting_reason` is the reason why the scan is not processed yet. `sha256`, `log_sha256`, `outcome` and
    `reason` describe the content last assessed. `epoch` (relative to the data folder), `start_utc_s`,
    `revision`, `reference` and `metrics` describe the content last stored: they are kept if an unusable file
    arrives under the same name. `judged_under` are the conditions (`Site.judging_conditions`) under which it
    was set aside or failed: '' if they do not matter, None if an older version did not record them. `ahead`
    is True from when a scan is measured ahead of earlier ones until it is measured again in its turn, then
    from the version of the reference that is the newest at that time.
    """

    name: str
    size: int
    mtime_ns: int
    state: State
    waiting_reason: str
    reason: str
    sha256: str | None
    log_sha256: str
    outcome: State | None
    verdict: str | None
    epoch: str | None
    start_utc_s: float | None
    revision: int | None
    reference: str | None
    metrics: dict[str, float | str]
    attempts: int
    next_try_utc_s: float | None
    first_seen_utc_s: float
    changed_utc_s: float
    judged_under: str | None = None
    ahead: bool = False


class EntrySummary(NamedTuple):
    """The columns of a row that each poll of the inbox needs."""

    size: int
    mtime_ns: int
    state: State
    next_try_utc_s: float | None
    has_epoch: bool = False


_NAMES = [field.name for field in fields(Entry)]
COLUMNS = ", ".join(_NAMES)


class JournalReader:
    """The rows of the journal, for any process at any time; every method is one transaction.

    Methods raise StoreError if the file cannot be read.
    """

    _open = staticmethod(open_to_read)

    def __init__(self, path: Path) -> None:
        self._path = path
        with self._store_errors():
            self._connection = self._open(path)

    def close(self) -> None:
        """Close the file."""
        self._connection.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def checksums(self) -> dict[str, str]:
        """Return the SHA-256 of every file by its path."""
        with self._store_errors():
            return dict(self._connection.execute("SELECT path, sha256 FROM file ORDER BY path").fetchall())

    def entry(self, name: str) -> Entry | None:
        """Return the row of a name, None if there is none."""
        return next(iter(self._select("WHERE name = ?", name)), None)

    def others_stored(self, name: str, size: int) -> dict[str, str]:
        """Return the names of other stored scans of this size by their SHA-256."""
        where = "WHERE size = ? AND epoch IS NOT NULL AND outcome IS NOT 'set_aside' AND name != ?"
        entries = self._select(where, size, name)
        return {entry.sha256: entry.name for entry in entries if entry.sha256}

    def summaries(self) -> dict[str, EntrySummary]:
        """Return a summary of every row by name; 0.1 s for years of hourly scans."""
        with self._store_errors():
            rows = self._connection.execute(
                "SELECT name, size, mtime_ns, state, next_try_utc_s, epoch IS NOT NULL FROM scan"
            ).fetchall()
        return {
            name: EntrySummary(size, mtime_ns, State(state), next_s, bool(has_epoch))
            for name, size, mtime_ns, state, next_s, has_epoch in rows
        }

    def unrecorded(self, names: Iterable[str]) -> list[str]:
        """Return the names that have no row, sorted."""
        query = "SELECT value FROM json_each(?) WHERE value NOT IN (SELECT name FROM scan) ORDER BY value"
        with self._store_errors():
            return [name for (name,) in self._connection.execute(query, (json.dumps(list(names)),))]

    def epochs(self) -> dict[str, str]:
        """Return the epoch file by scan name, for scans that have one."""
        query = "SELECT name, epoch FROM scan WHERE epoch IS NOT NULL ORDER BY name"
        with self._store_errors():
            return dict(self._connection.execute(query).fetchall())

    def current_epochs(self) -> dict[str, str]:
        """Return the epoch file by name of scans that are stored, or are unless their content has changed."""
        query = (
            "SELECT name, epoch FROM scan WHERE epoch IS NOT NULL AND 'stored' IN (state, outcome)"
            " ORDER BY name"
        )
        with self._store_errors():
            return dict(self._connection.execute(query).fetchall())

    def usable(self) -> list[str]:
        """Return the names of the scans stored with verdict `good`, in order of their start."""
        query = "SELECT name FROM scan WHERE state = 'stored' AND verdict = 'good' ORDER BY start_utc_s, name"
        with self._store_errors():
            return [name for (name,) in self._connection.execute(query)]

    def without_reference(self) -> list[str]:
        """Return the names of the scans stored without a reference, sorted."""
        query = "SELECT name FROM scan WHERE state = 'stored' AND coalesce(reference, '') = '' ORDER BY name"
        with self._store_errors():
            return [name for (name,) in self._connection.execute(query)]

    def starting_at(self, start_utc_s: float) -> list[str]:
        """Return the names of the scans with an epoch of this start, to the second; sorted."""
        query = (
            "SELECT name FROM scan WHERE epoch IS NOT NULL AND CAST(start_utc_s AS INTEGER) = ? ORDER BY name"
        )
        with self._store_errors():
            return [name for (name,) in self._connection.execute(query, (int(start_utc_s),))]

    def waiting(self) -> list[Entry]:
        """Return the rows that are neither stored nor set aside, sorted by name."""
        return self._select("WHERE state IN ('waiting', 'later') ORDER BY name")

    def last_stored(self) -> Entry | None:
        """Return the row of the scan stored last, None if there is none."""
        entries = self._select("WHERE state = 'stored' ORDER BY changed_utc_s DESC, start_utc_s DESC LIMIT 1")
        return next(iter(entries), None)

    def rows(self, state: State | None = None) -> list[Entry]:
        """Return all rows, or those of one state, sorted by name."""
        if state is None:
            return self._select("ORDER BY name")
        return self._select("WHERE state = ? ORDER BY name", state)

    def durations_s(self) -> dict[str, float]:
        """Return the processing time of each stored scan by name [s]; the query takes 0.05 s."""
        query = "SELECT name, json_extract(metrics, '$.seconds') FROM scan WHERE state = 'stored'"
        with self._store_errors():
            return {
                str(name): float(seconds)
                for name, seconds in self._connection.execute(query)
                if seconds is not None
            }

    def changed_since(self, utc_s: float) -> list[Entry]:
        """Return the rows changed since a time, in order of their change."""
        return self._select("WHERE changed_utc_s >= ? ORDER BY changed_utc_s", utc_s)

    def measured_again(self, count: int) -> list[tuple[float, int, float, float]]:
        """Return when scans were measured again, newest day first: last time, number, first and last start.

        At most `count` days, times in seconds since 1970.
        """
        query = (
            "SELECT max(changed_utc_s), count(*), min(start_utc_s), max(start_utc_s) FROM scan"
            " WHERE state = 'stored' AND revision > 1 GROUP BY CAST(changed_utc_s / 86400 AS INTEGER)"
            " ORDER BY 1 DESC LIMIT ?"
        )
        with self._store_errors():
            return self._connection.execute(query, (count,)).fetchall()

    def newest(self, count: int) -> list[Entry]:
        """Return the newest stored scans, in order of their start."""
        entries = self._select("WHERE state = 'stored' ORDER BY start_utc_s DESC LIMIT ?", count)
        return entries[::-1]

    def verdicts(self) -> dict[str, int]:
        """Return the number of stored scans by verdict."""
        query = "SELECT verdict, count(*) FROM scan WHERE state = 'stored' GROUP BY verdict"
        with self._store_errors():
            return {str(verdict): int(count) for verdict, count in self._connection.execute(query)}

    def counts(self) -> dict[str, int]:
        """Return the number of scans by state; states without scans are included."""
        with self._store_errors():
            counts = dict(
                self._connection.execute("SELECT state, count(*) FROM scan GROUP BY state").fetchall()
            )
        return {state.value: int(counts.get(state.value, 0)) for state in State}

    def _select(self, where: str, *values: object) -> list[Entry]:
        with self._store_errors():
            rows = self._connection.execute(f"SELECT {COLUMNS} FROM scan {where}", values).fetchall()  # noqa: S608 - constants
        return [_entry_from_row(row) for row in rows]

    @contextmanager
    def _store_errors(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.Error as error:
            raise StoreError(describe_error(self._path, error)) from error


def _entry_from_row(row: tuple[object, ...]) -> Entry:
    values = dict(zip(_NAMES, row, strict=True))
    values["state"] = State(str(values["state"]))
    values["outcome"] = State(str(values["outcome"])) if values["outcome"] else None
    values["metrics"] = json.loads(str(values["metrics"])) if values["metrics"] != "{}" else {}
    values["ahead"] = bool(values["ahead"])
    return Entry(**values)  # type: ignore[arg-type] # the schema is STRICT: each column has its type
