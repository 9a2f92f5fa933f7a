"""Journal of the scans: one row per file name, in SQLite, never lost.

WAL mode with `synchronous=FULL`: once a method has returned, its change survives `kill -9` and a power cut.
The file `set_aside/<name>.txt` explains to the operator why a scan could not be used.
Source: store.md, 2.
"""

from __future__ import annotations

import json
import time
from contextlib import contextmanager, suppress
from dataclasses import fields
from typing import TYPE_CHECKING

from station.errors import StoreError
from station.inbox.journal_reader import COLUMNS, Entry, JournalReader, State
from station.inbox.journal_schema import open_to_write

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping
    from pathlib import Path

FIRST_RETRY_S = 30.0  # until a deferred scan is tried again; doubled after each attempt
MAX_RETRY_S = 3600.0
MAX_FAILURES = 12  # attempts until a scan is no longer waited for: 17 h, the last pause 8.5 h
REJECTED_FOR_NOW = "rejected for now"
RETRY_REJECTED_S = 7 * 86_400.0  # the machine may have recovered: one attempt, which costs little
LONGEST_RETRY_S = FIRST_RETRY_S * 2.0 ** (MAX_FAILURES - 2)
JUST_TRIED_S = 600.0  # after a failure the machine is still as it was then
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


class Journal(JournalReader):
    """The rows of the journal and the changes the service makes to them.

    Every method is one transaction and raises StoreError if the file cannot be read or written. One thread of
    one process writes (`lock.exclusive_lock`), and `station retry`, which only queues scans. Any other
    process opens it as a `JournalReader` at any time.
    """

    _open = staticmethod(open_to_write)

    def __init__(self, path: Path, *, now_s: Callable[[], float] = time.time) -> None:
        super().__init__(path)
        self._reasons_folder = path.parent / "set_aside"
        self._now_s = now_s

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

    def defer_behind(self, name: str, earlier: str, reason: str) -> float:
        """Defer a scan that waits for an earlier one; return the delay until its next attempt [s].

        If the earlier one has failed so often that its next attempt is hours away, it is tried at once: the
        machine may have recovered. If it fails again, this scan waits for it no longer.
        """
        entry = self.entry(earlier)
        if entry is None or entry.attempts < MAX_FAILURES or not entry.judged_under:
            return self.defer(name, reason)
        own = self.entry(name)
        self._retry_in(0.0, earlier, entry.waiting_reason, entry.attempts, entry.judged_under)
        self._retry_in(FIRST_RETRY_S, name, reason, own.attempts if own else 0, "")
        return FIRST_RETRY_S

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
                f"INSERT INTO scan ({COLUMNS}) VALUES ({placeholders})"  # noqa: S608 - constants
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

    def _add_checksum(self, path: str, sha256: str) -> None:
        self._connection.execute("INSERT OR REPLACE INTO file (path, sha256) VALUES (?, ?)", (path, sha256))

    # ---- queries

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

        Scans that have failed often, perhaps because of the machine, are among them until they have just been
        tried again; with `however_often_failed` until they are rejected.
        """
        query = (
            "SELECT name, start_utc_s FROM scan"
            " WHERE (state = 'waiting' AND (waiting_reason = '' OR abs(changed_utc_s - ?) < ?))"
            " OR (state = 'later' AND (attempts < ?"
            " OR (judged_under IS NOT '' AND (? OR abs(changed_utc_s - ?) > ?)))) ORDER BY name"
        )
        with self._store_errors():
            now_s = self._now_s()
            parameters = now_s, SETTLING_S, MAX_FAILURES, however_often_failed, now_s, JUST_TRIED_S
            return dict(self._connection.execute(query, parameters).fetchall())

    # ---- SQLite

    def _write_reason(self, name: str, reason: str) -> None:
        try:
            self._reason_file(name).parent.mkdir(parents=True, exist_ok=True)
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
