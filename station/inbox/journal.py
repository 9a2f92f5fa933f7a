"""Journal of the scans: one row per file name, in SQLite, never lost.

WAL mode with `synchronous=FULL`: once a method has returned, its change survives `kill -9` and a power cut.
The file `set_aside/<name>.txt` explains to the operator why a scan could not be used.
Source: store.md, 2.
"""

from __future__ import annotations

import json
import sqlite3
import time
from contextlib import contextmanager, suppress
from dataclasses import dataclass, fields
from enum import StrEnum
from typing import TYPE_CHECKING, NamedTuple, Self

from station.errors import StoreError
from station.inbox.journal_schema import describe_error, open_to_read, open_to_write

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping
    from pathlib import Path

FIRST_RETRY_S = 30.0  # until a deferred scan is tried again; doubled after each attempt
MAX_RETRY_S = 3600.0
MAX_FAILURES = 12  # attempts until a scan is no longer waited for: 17 h, the last pause 8.5 h
REJECTED_FOR_NOW = "rejected for now"
RETRY_REJECTED_S = 7 * 86_400.0  # the machine may have recovered: one attempt, which costs little
LONGEST_RETRY_S = FIRST_RETRY_S * 2.0 ** (MAX_FAILURES - 2)
SETTLING_S = 6 * 3600.0  # a scan that is not ready for so long, as one that stays open, delays no others

_EPOCH_COLUMNS = (
    "sha256",
    "log_sha256",
    "verdict",
    "reason",
    "epoch",
    "start_utc_s",
    "revision",
    "reference",
)


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
_COLUMNS = ", ".join(_NAMES)


class Journal:
    """The rows of the journal and the changes the service makes to them.

    Every method is one transaction and raises StoreError if the file cannot be read or written. One thread of
    one process writes (`lock.exclusive_lock`), and `station retry`, which only queues scans. Any other
    process opens it with `read_only=True` at any time.
    """

    def __init__(
        self, path: Path, *, read_only: bool = False, now_s: Callable[[], float] = time.time
    ) -> None:
        self._path = path
        self._reasons_folder = path.parent / "set_aside"
        self._now_s = now_s
        try:
            self._connection = open_to_read(path) if read_only else open_to_write(path)
        except sqlite3.Error as error:
            raise StoreError(describe_error(path, error)) from error

    def close(self) -> None:
        """Close the file."""
        self._connection.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # ---- called by the inbox

    def record_seen(self, files: Iterable[tuple[str, int, int, str]]) -> None:
        """Record (name, size, mtime_ns, waiting_reason) of scans; rows that have not changed are left alone.

        A new name, or another size or mtime under a known name, sets the state to `waiting`; the results of
        the content last assessed and last stored under that name are kept.
        """
        now_s = self._now_s()
        with self._transaction():
            self._connection.executemany(
                """INSERT INTO scan
                       (name, size, mtime_ns, waiting_reason, state, first_seen_utc_s, changed_utc_s)
                   VALUES (?, ?, ?, ?, 'waiting', ?, ?)
                   ON CONFLICT (name) DO UPDATE SET
                       waiting_reason = excluded.waiting_reason, changed_utc_s = excluded.changed_utc_s,
                       state = 'waiting', size = excluded.size, mtime_ns = excluded.mtime_ns,
                       attempts = 0, next_try_utc_s = NULL
                   WHERE size != excluded.size OR mtime_ns != excluded.mtime_ns
                       OR (state = 'waiting' AND waiting_reason != excluded.waiting_reason)""",
                [(*file, now_s, now_s) for file in files],
            )

    def reject(self, files: Iterable[tuple[str, int, int, str]]) -> None:
        """Set files aside that cannot be scans, (name, size, mtime_ns, reason), in one transaction."""
        files = list(files)
        for name, _, _, reason in files:
            self._write_reason(name, reason)
        now_s = self._now_s()
        with self._transaction():
            self._connection.executemany(
                """INSERT INTO scan (name, size, mtime_ns, reason, state, outcome, judged_under,
                       first_seen_utc_s, changed_utc_s)
                   VALUES (?, ?, ?, ?, 'set_aside', 'set_aside', '', ?, ?)
                   ON CONFLICT (name) DO UPDATE SET
                       size = excluded.size, mtime_ns = excluded.mtime_ns, reason = excluded.reason,
                       state = 'set_aside', outcome = 'set_aside', sha256 = NULL, log_sha256 = '',
                       waiting_reason = '', attempts = 0, next_try_utc_s = NULL, judged_under = '',
                       changed_utc_s = excluded.changed_utc_s""",
                [(*file, now_s, now_s) for file in files],
            )

    def record_removed(self, names: Iterable[str]) -> None:
        """Drop scans removed from the inbox before they were processed; their stored epochs stay."""
        parameters = [(name,) for name in names]
        with self._transaction():
            self._connection.executemany(
                """UPDATE scan SET state = 'stored', waiting_reason = '', ahead = 0,
                   reason = 'removed before it was reprocessed'
                   WHERE name = ? AND state IN ('waiting', 'later') AND epoch IS NOT NULL""",
                parameters,
            )
            self._connection.executemany(
                "DELETE FROM scan WHERE name = ? AND state IN ('waiting', 'later')", parameters
            )

    # ---- called by the worker

    def record_stored(
        self,
        name: str,
        *,
        sha256: str,
        verdict: str,
        epoch: str,
        start_utc_s: float,
        revision: int,
        reference: str | None = None,
        reason: str = "",
        metrics: Mapping[str, float | str] | None = None,
        log_sha256: str = "",
        epoch_sha256: str = "",
        ahead: bool = False,
    ) -> None:
        """Record that a scan is stored, and the checksum of its epoch.

        `metrics` are the metrics that `station status` shows for it. A scan measured `ahead` of earlier ones
        goes on waiting for its turn.
        """
        with self._transaction():
            if epoch_sha256:
                self._add_checksum(epoch, epoch_sha256)
            self._update(
                name,
                state=State.WAITING if ahead else State.STORED,
                outcome=None if ahead else State.STORED,
                ahead=ahead,
                sha256=sha256,
                log_sha256=log_sha256,
                verdict=verdict,
                waiting_reason="",
                reason=reason,
                epoch=epoch,
                start_utc_s=start_utc_s,
                revision=revision,
                reference=reference,
                metrics=json.dumps(dict(metrics or {})),
                attempts=0,
                next_try_utc_s=None,
            )
        with suppress(OSError):  # the scan is stored even if the old note stays
            self._reason_file(name).unlink(missing_ok=True)

    def set_aside(
        self,
        name: str,
        reason: str,
        *,
        sha256: str | None = None,
        log_sha256: str = "",
        judged_under: str = "",
    ) -> None:
        """Record that a scan cannot be used, and why; write the reason to `set_aside/<name>.txt` too.

        `judged_under` are the conditions whose change makes it worth another attempt, if any do.
        """
        self._write_reason(name, reason)
        with self._transaction():
            self._update(
                name,
                state=State.SET_ASIDE,
                outcome=State.SET_ASIDE,
                ahead=False,
                sha256=sha256,
                log_sha256=log_sha256,
                waiting_reason="",
                reason=reason,
                attempts=0,
                next_try_utc_s=None,
                judged_under=judged_under,
            )

    def defer(self, name: str, reason: str) -> float:
        """Defer a scan that is not ready; return the delay until its next attempt, 30 to 3600 s."""
        entry = self.entry(name)
        attempts = entry.attempts + 1 if entry else 1
        delay_s = min(FIRST_RETRY_S * 2.0 ** min(attempts - 1, 20), MAX_RETRY_S)
        self._retry_in(delay_s, name, reason, attempts, "")
        return delay_s

    def record_failure(self, name: str, reason: str, judged_under: str) -> float | None:
        """Defer a scan whose attempt failed for a reason that may not be its own; return the delay [s].

        Return None if it was set aside for now: after MAX_FAILURES attempts under the same conditions, if
        another scan was stored since the last of them. If none was, the machine may be the cause.
        """
        entry = self.entry(name)
        failures = 1 + (entry.attempts if entry and entry.judged_under == judged_under else 0)
        if entry and failures >= MAX_FAILURES and self._stored_since(entry.changed_utc_s):
            self.set_aside(
                name, f"{REJECTED_FOR_NOW}, after {failures} attempts: {reason}", judged_under=judged_under
            )
            return None
        delay_s = min(FIRST_RETRY_S * 2.0 ** (failures - 1), LONGEST_RETRY_S)
        self._retry_in(delay_s, name, reason, failures, judged_under)
        return delay_s

    def _stored_since(self, utc_s: float) -> bool:
        query = "SELECT 1 FROM scan WHERE state = 'stored' AND changed_utc_s >= ?"
        with self._store_errors():
            return self._connection.execute(query, (utc_s,)).fetchone() is not None

    def rejected_for_now(self) -> list[str]:
        """Return the names of scans that were rejected for now more than `RETRY_REJECTED_S` ago; sorted."""
        query = (
            "SELECT name FROM scan WHERE state = 'set_aside' AND reason LIKE ?"
            " AND abs(changed_utc_s - ?) > ? ORDER BY name"
        )
        with self._store_errors():
            parameters = f"{REJECTED_FOR_NOW}%", self._now_s(), RETRY_REJECTED_S
            return [name for (name,) in self._connection.execute(query, parameters)]

    def try_once(self, name: str, reason: str, judged_under: str) -> None:
        """Queue a scan for a single attempt: if that fails, it is rejected for now again."""
        self._retry_in(0.0, name, reason, MAX_FAILURES - 1, judged_under)

    def _retry_in(self, delay_s: float, name: str, reason: str, attempts: int, judged_under: str) -> None:
        with self._transaction():
            self._update(
                name,
                state=State.LATER,
                waiting_reason=reason,
                attempts=attempts,
                next_try_utc_s=self._now_s() + delay_s,
                judged_under=judged_under,
            )

    def restore_unchanged(self, name: str, sha256: str) -> bool:
        """Return True if this content was already assessed under this name; then restore its former state."""
        entry = self.entry(name)
        if entry is None or entry.outcome is None or entry.sha256 != sha256:
            return False
        with self._transaction():
            self._update(name, state=entry.outcome, waiting_reason="", attempts=0, next_try_utc_s=None)
        return True

    def mark_ahead(self, name: str) -> None:
        """Record, before a scan is measured ahead of earlier ones, that its turn is still to come."""
        with self._transaction():
            self._update(name, ahead=True)

    def requeue(
        self, names: Iterable[str], reason: str = "reprocessing", *, keep_reference: bool = True
    ) -> None:
        """Queue scans for processing although their content is unchanged.

        They are measured from the version of the reference used before, or else from the newest.
        """
        now_s = self._now_s()
        with self._transaction():
            self._connection.executemany(
                """UPDATE scan SET state = 'waiting', outcome = NULL, attempts = 0, next_try_utc_s = NULL,
                   waiting_reason = ?, changed_utc_s = ?, reference = iif(?, reference, NULL)
                   WHERE name = ?""",
                [(reason, now_s, keep_reference, name) for name in names],
            )

    def import_entries(self, entries: Iterable[Entry]) -> None:
        """Insert rows rebuilt from epochs; update rows without an epoch or with an older revision."""
        placeholders = ", ".join("?" for _ in fields(Entry))
        updates = ", ".join(f"{column} = excluded.{column}" for column in _EPOCH_COLUMNS)
        parameters = [
            [json.dumps(value) if key == "metrics" else value for key, value in vars(entry).items()]
            for entry in entries
        ]
        with self._transaction():
            self._connection.executemany(
                f"INSERT INTO scan ({_COLUMNS}) VALUES ({placeholders})"  # noqa: S608 - constants
                f" ON CONFLICT (name) DO UPDATE SET {updates}"
                " WHERE epoch IS NULL OR excluded.revision > revision",
                parameters,
            )

    # ---- checksums of the files of the store, by path relative to the data folder

    def add_checksums(self, checksums: Mapping[str, str]) -> None:
        """Record the SHA-256 of files that are final."""
        with self._transaction():
            for path, sha256 in checksums.items():
                self._add_checksum(path, sha256)

    def drop_checksums(self, paths: Iterable[str]) -> None:
        """Drop the checksums of files that were deleted or quarantined."""
        with self._transaction():
            self._connection.executemany("DELETE FROM file WHERE path = ?", [(path,) for path in paths])

    def checksums(self) -> dict[str, str]:
        """Return the SHA-256 of every file by its path."""
        with self._store_errors():
            return dict(self._connection.execute("SELECT path, sha256 FROM file ORDER BY path").fetchall())

    def _add_checksum(self, path: str, sha256: str) -> None:
        self._connection.execute("INSERT OR REPLACE INTO file (path, sha256) VALUES (?, ?)", (path, sha256))

    # ---- queries

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

    def epochs(self, state: State | None = None) -> dict[str, str]:
        """Return the epoch file by scan name, for scans that have one and, if given, are in this state."""
        query = "SELECT name, epoch FROM scan WHERE epoch IS NOT NULL AND state = coalesce(?, state)"
        with self._store_errors():
            return dict(self._connection.execute(f"{query} ORDER BY name", (state,)).fetchall())

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

    def judged_otherwise(self, conditions: str) -> list[str]:
        """Return the names of scans set aside, or failed, under other conditions than these; sorted."""
        query = (
            "SELECT name FROM scan WHERE state IN ('set_aside', 'later')"
            " AND judged_under IS NOT '' AND judged_under IS NOT ? ORDER BY name"
        )
        with self._store_errors():
            return [name for (name,) in self._connection.execute(query, (conditions,))]

    def unsettled(self, *, however_often_failed: bool = False) -> dict[str, float | None]:
        """Return the starts [s], if known, of scans that will be judged soon, for which others may wait.

        `however_often_failed`: include those that may fail because of the machine until they are rejected.
        """
        query = (
            "SELECT name, start_utc_s FROM scan"
            " WHERE (state = 'waiting' AND (waiting_reason = '' OR abs(changed_utc_s - ?) < ?))"
            " OR (state = 'later' AND (attempts < ? OR (? AND judged_under IS NOT ''))) ORDER BY name"
        )
        with self._store_errors():
            parameters = self._now_s(), SETTLING_S, MAX_FAILURES, however_often_failed
            return dict(self._connection.execute(query, parameters).fetchall())

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

    # ---- SQLite

    def _write_reason(self, name: str, reason: str) -> None:
        try:
            self._reasons_folder.mkdir(exist_ok=True)
            self._reason_file(name).write_text(f"{name}: {reason}\n", encoding="utf-8")
        except OSError as error:
            raise StoreError(
                f"{self._reasons_folder}: the reason for {name} cannot be written: {error}"
            ) from error

    def _reason_file(self, name: str) -> Path:
        return self._reasons_folder / f"{name}.txt"

    def _update(self, name: str, **values: object) -> None:
        """Set columns of a row; insert the row first if the scan has none (`station process`)."""
        values["changed_utc_s"] = self._now_s()
        self._connection.execute(
            """INSERT OR IGNORE INTO scan (name, size, mtime_ns, state, first_seen_utc_s, changed_utc_s)
               VALUES (?, -1, -1, 'waiting', ?, ?)""",
            (name, values["changed_utc_s"], values["changed_utc_s"]),
        )
        assignments = ", ".join(f"{column} = ?" for column in values)
        self._connection.execute(f"UPDATE scan SET {assignments} WHERE name = ?", (*values.values(), name))  # noqa: S608 - constants

    def _select(self, where: str, *values: object) -> list[Entry]:
        with self._store_errors():
            rows = self._connection.execute(f"SELECT {_COLUMNS} FROM scan {where}", values).fetchall()  # noqa: S608 - constants
        return [_entry_from_row(row) for row in rows]

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        with self._store_errors():
            self._connection.execute("BEGIN IMMEDIATE")
            try:
                yield
                self._connection.execute("COMMIT")
            except BaseException:
                if self._connection.in_transaction:
                    self._connection.execute("ROLLBACK")
                raise

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
