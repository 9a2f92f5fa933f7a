"""What was done with each scan: one row a name, in SQLite, never lost.

WAL with `synchronous=FULL`: what a method has returned from survives `kill -9` and a power cut (STORE.md).
Beside it, `set_aside/<name>.txt` tells a person why a scan could not be used.
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
from station.service.journal_file import explain, open_to_read, open_to_write

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping
    from pathlib import Path

FIRST_PAUSE_S = 30.0  # before a scan that was not ready is tried again; doubled each time
LONGEST_PAUSE_S = 3600.0

_OF_EPOCH = ("sha256", "log_sha256", "verdict", "reason", "epoch", "start_utc_s", "revision", "reference")


class State(StrEnum):
    """Where a scan stands."""

    WAITING = "waiting"
    STORED = "stored"
    SET_ASIDE = "set_aside"
    LATER = "later"


@dataclass(frozen=True)
class Entry:
    """One row of the journal.

    `waits_for` says why it is not done yet. `sha256`, `log_sha256`, `outcome` and `reason` are of the content
    that was last judged; `epoch` (relative to the data folder), `start_utc_s`, `revision`, `reference` and
    `figures` of the content that was last stored: they stay when a worse file comes under the same name.
    """

    name: str
    size: int
    mtime_ns: int
    state: State
    waits_for: str
    reason: str
    sha256: str | None
    log_sha256: str
    outcome: State | None
    verdict: str | None
    epoch: str | None
    start_utc_s: float | None
    revision: int | None
    reference: str | None
    figures: dict[str, float | str]
    attempts: int
    next_try_utc_s: float | None
    seen_utc_s: float
    changed_utc_s: float


class Glimpse(NamedTuple):
    """As much of a row as every look at the inbox needs."""

    size: int
    mtime_ns: int
    state: State
    next_try_utc_s: float | None


_COLUMNS = ", ".join(field.name for field in fields(Entry))


class Journal:
    """The rows, and the words of the service for changing them.

    Every method is one commit and raises StoreError where the file cannot be written or read. One thread, one
    writing process (`lock.only_writer`); `read_only=True` is for everyone else, at any moment.
    """

    def __init__(
        self, path: Path, *, read_only: bool = False, now_s: Callable[[], float] = time.time
    ) -> None:
        self._path = path
        self._notes = path.parent / "set_aside"
        self._now_s = now_s
        try:
            self._rows = open_to_read(path) if read_only else open_to_write(path)
        except sqlite3.Error as error:
            raise StoreError(explain(path, error)) from error

    def close(self) -> None:
        """Let go of the file."""
        self._rows.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # ---- what the inbox says

    def seen(self, files: Iterable[tuple[str, int, int, str]]) -> None:
        """Note (name, size, mtime_ns, what it waits for) of scans that are new, or of which one has changed.

        A new name, or another size or mtime under a known one, puts the scan to `waiting`; what was last
        judged and stored under that name stays known.
        """
        now_s = self._now_s()
        with self._commit():
            self._rows.executemany(
                """INSERT INTO scan (name, size, mtime_ns, waits_for, state, seen_utc_s, changed_utc_s)
                   VALUES (?, ?, ?, ?, 'waiting', ?, ?)
                   ON CONFLICT (name) DO UPDATE SET
                       waits_for = excluded.waits_for, changed_utc_s = excluded.changed_utc_s,
                       state = 'waiting', size = excluded.size, mtime_ns = excluded.mtime_ns,
                       attempts = 0, next_try_utc_s = NULL
                   WHERE size != excluded.size OR mtime_ns != excluded.mtime_ns
                       OR (state = 'waiting' AND waits_for != excluded.waits_for)""",
                [(*file, now_s, now_s) for file in files],
            )

    def gone(self, names: Iterable[str]) -> None:
        """Forget scans that left the inbox before they were done; what is stored of them stays stored."""
        listed = [(name,) for name in names]
        with self._commit():
            self._rows.executemany(
                """UPDATE scan SET state = 'stored', waits_for = '',
                   reason = 'left the inbox before it was done again'
                   WHERE name = ? AND state IN ('waiting', 'later') AND epoch IS NOT NULL""",
                listed,
            )
            self._rows.executemany(
                "DELETE FROM scan WHERE name = ? AND state IN ('waiting', 'later')", listed
            )

    # ---- what the worker says

    def stored(
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
        figures: Mapping[str, float | str] | None = None,
        log_sha256: str = "",
        epoch_sha256: str = "",
    ) -> None:
        """Note that a scan is in the store, and the checksum of its epoch.

        `figures` are what `station status` shows of it.
        """
        with self._commit():
            if epoch_sha256:
                self._note_file(epoch, epoch_sha256)
            self._change(
                name,
                state=State.STORED,
                outcome=State.STORED,
                sha256=sha256,
                log_sha256=log_sha256,
                verdict=verdict,
                waits_for="",
                reason=reason,
                epoch=epoch,
                start_utc_s=start_utc_s,
                revision=revision,
                reference=reference,
                figures=json.dumps(dict(figures or {})),
                attempts=0,
                next_try_utc_s=None,
            )
        with suppress(OSError):  # it is stored all the same
            self._note(name).unlink(missing_ok=True)

    def set_aside(self, name: str, reason: str, *, sha256: str | None = None, log_sha256: str = "") -> None:
        """Note that a scan cannot be used, and why, here and in `set_aside/<name>.txt`."""
        try:
            self._notes.mkdir(exist_ok=True)
            self._note(name).write_text(f"{name}: {reason}\n", encoding="utf-8")
        except OSError as error:
            raise StoreError(f"{self._notes}: the reason for {name} cannot be written: {error}") from error
        with self._commit():
            self._change(
                name,
                state=State.SET_ASIDE,
                outcome=State.SET_ASIDE,
                sha256=sha256,
                log_sha256=log_sha256,
                waits_for="",
                reason=reason,
                attempts=0,
                next_try_utc_s=None,
            )

    def later(self, name: str, reason: str) -> float:
        """Note that a scan is not ready; return the pause until the next try [s]: 30 s, doubled up to 1 h."""
        entry = self.entry(name)
        attempts = entry.attempts + 1 if entry else 1
        pause_s = min(FIRST_PAUSE_S * 2.0 ** min(attempts - 1, 20), LONGEST_PAUSE_S)
        with self._commit():
            self._change(
                name,
                state=State.LATER,
                waits_for=reason,
                attempts=attempts,
                next_try_utc_s=self._now_s() + pause_s,
            )
        return pause_s

    def same_again(self, name: str, sha256: str) -> bool:
        """Tell whether this name was already judged with these bytes; if so it is back where it was."""
        entry = self.entry(name)
        if entry is None or entry.outcome is None or entry.sha256 != sha256:
            return False
        with self._commit():
            self._change(name, state=entry.outcome, waits_for="", attempts=0, next_try_utc_s=None)
        return True

    def again(self, names: Iterable[str]) -> None:
        """Have scans done again although their bytes are the same."""
        now_s = self._now_s()
        with self._commit():
            self._rows.executemany(
                """UPDATE scan SET state = 'waiting', outcome = NULL, attempts = 0,
                   waits_for = 'to be done again', next_try_utc_s = NULL, changed_utc_s = ? WHERE name = ?""",
                [(now_s, name) for name in names],
            )

    def adopt(self, entries: Iterable[Entry]) -> None:
        """Take in rows made of epochs that the journal did not know; older ones are brought up to them."""
        marks = ", ".join("?" for _ in fields(Entry))
        brought = ", ".join(f"{column} = excluded.{column}" for column in _OF_EPOCH)
        listed = [
            [json.dumps(value) if key == "figures" else value for key, value in vars(entry).items()]
            for entry in entries
        ]
        with self._commit():
            self._rows.executemany(
                f"INSERT INTO scan ({_COLUMNS}) VALUES ({marks})"  # noqa: S608 - own words
                f" ON CONFLICT (name) DO UPDATE SET {brought}"
                " WHERE epoch IS NULL OR excluded.revision > revision",
                listed,
            )

    # ---- checksums of the store's files, by their place in the data folder

    def note_files(self, checksums: Mapping[str, str]) -> None:
        """Note the SHA-256 of files that never change from now on."""
        with self._commit():
            for path, sha256 in checksums.items():
                self._note_file(path, sha256)

    def forget_files(self, paths: Iterable[str]) -> None:
        """Forget files that were deleted or put out of the way."""
        with self._commit():
            self._rows.executemany("DELETE FROM file WHERE path = ?", [(path,) for path in paths])

    def files(self) -> dict[str, str]:
        """Return the SHA-256 of every file by its place."""
        with self._faults():
            return dict(self._rows.execute("SELECT path, sha256 FROM file ORDER BY path").fetchall())

    def _note_file(self, path: str, sha256: str) -> None:
        self._rows.execute("INSERT OR REPLACE INTO file (path, sha256) VALUES (?, ?)", (path, sha256))

    # ---- what everyone may ask

    def entry(self, name: str) -> Entry | None:
        """Return the row of one name."""
        return next(iter(self._select("WHERE name = ?", name)), None)

    def others_stored(self, name: str, size: int) -> dict[str, str]:
        """Return the names of other scans that are stored and of this size, by their SHA-256."""
        found = self._select("WHERE size = ? AND outcome = 'stored' AND name != ?", size, name)
        return {row.sha256: row.name for row in found if row.sha256}

    def glimpses(self) -> dict[str, Glimpse]:
        """Return a glimpse of every row by its name; years of hourly scans take a tenth of a second."""
        with self._faults():
            found = self._rows.execute(
                "SELECT name, size, mtime_ns, state, next_try_utc_s FROM scan"
            ).fetchall()
        return {
            name: Glimpse(size, mtime_ns, State(state), next_s)
            for name, size, mtime_ns, state, next_s in found
        }

    def unseen(self, names: Iterable[str]) -> list[str]:
        """Return, sorted, the names that no row has."""
        told = "SELECT value FROM json_each(?) WHERE value NOT IN (SELECT name FROM scan) ORDER BY value"
        with self._faults():
            return [name for (name,) in self._rows.execute(told, (json.dumps(list(names)),))]

    def epochs(self, state: State | None = None) -> dict[str, str]:
        """Return the epoch of each scan that has one, or of those of one state, by the scan's name."""
        told = "SELECT name, epoch FROM scan WHERE epoch IS NOT NULL AND state = coalesce(?, state)"
        with self._faults():
            return dict(self._rows.execute(f"{told} ORDER BY name", (state,)).fetchall())

    def usable(self) -> list[str]:
        """Return the scans stored with a good verdict, by their start."""
        told = "SELECT name FROM scan WHERE state = 'stored' AND verdict = 'good' ORDER BY start_utc_s, name"
        with self._faults():
            return [name for (name,) in self._rows.execute(told)]

    def bare(self) -> list[str]:
        """Return the scans stored without a change, by name."""
        told = "SELECT name FROM scan WHERE state = 'stored' AND coalesce(reference, '') = '' ORDER BY name"
        with self._faults():
            return [name for (name,) in self._rows.execute(told)]

    def waiting(self) -> list[Entry]:
        """Return the rows that are neither stored nor set aside, by name."""
        return self._select("WHERE state IN ('waiting', 'later') ORDER BY name")

    def last_stored(self) -> Entry | None:
        """Return the row that was stored last."""
        rows = self._select("WHERE state = 'stored' ORDER BY changed_utc_s DESC, start_utc_s DESC LIMIT 1")
        return next(iter(rows), None)

    def rows(self, state: State | None = None) -> list[Entry]:
        """Return all rows, or those of one state, by name."""
        if state is None:
            return self._select("ORDER BY name")
        return self._select("WHERE state = ? ORDER BY name", state)

    def seconds(self) -> dict[str, float]:
        """Return how long each stored scan took [s], by its name; all of them in a twentieth of a second."""
        told = "SELECT name, json_extract(figures, '$.seconds') FROM scan WHERE state = 'stored'"
        with self._faults():
            return {str(name): float(took) for name, took in self._rows.execute(told) if took is not None}

    def changed_since(self, utc_s: float) -> list[Entry]:
        """Return the rows with which something happened since then, by that time."""
        return self._select("WHERE changed_utc_s >= ? ORDER BY changed_utc_s", utc_s)

    def newest(self, count: int) -> list[Entry]:
        """Return the newest scans that are stored, by their start."""
        found = self._select("WHERE state = 'stored' ORDER BY start_utc_s DESC LIMIT ?", count)
        return found[::-1]

    def verdicts(self) -> dict[str, int]:
        """Return how many stored scans have which verdict."""
        told = "SELECT verdict, count(*) FROM scan WHERE state = 'stored' GROUP BY verdict"
        with self._faults():
            return {str(verdict): int(count) for verdict, count in self._rows.execute(told)}

    def counts(self) -> dict[str, int]:
        """Return how many scans stand where; every state is named."""
        with self._faults():
            found = dict(self._rows.execute("SELECT state, count(*) FROM scan GROUP BY state").fetchall())
        return {state.value: int(found.get(state.value, 0)) for state in State}

    # ---- SQLite

    def _note(self, name: str) -> Path:
        return self._notes / f"{name}.txt"

    def _change(self, name: str, **values: object) -> None:
        """Set columns of a row, which is made where the scan was never seen (`station process`)."""
        values["changed_utc_s"] = self._now_s()
        self._rows.execute(
            """INSERT OR IGNORE INTO scan (name, size, mtime_ns, state, seen_utc_s, changed_utc_s)
               VALUES (?, -1, -1, 'waiting', ?, ?)""",
            (name, values["changed_utc_s"], values["changed_utc_s"]),
        )
        columns = ", ".join(f"{column} = ?" for column in values)
        self._rows.execute(f"UPDATE scan SET {columns} WHERE name = ?", (*values.values(), name))  # noqa: S608 - own words

    def _select(self, where: str, *values: object) -> list[Entry]:
        with self._faults():
            found = self._rows.execute(f"SELECT {_COLUMNS} FROM scan {where}", values).fetchall()  # noqa: S608 - own words
        return [_entry(row) for row in found]

    @contextmanager
    def _commit(self) -> Iterator[None]:
        with self._faults():
            self._rows.execute("BEGIN IMMEDIATE")
            try:
                yield
                self._rows.execute("COMMIT")
            except BaseException:
                if self._rows.in_transaction:
                    self._rows.execute("ROLLBACK")
                raise

    @contextmanager
    def _faults(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.Error as error:
            raise StoreError(explain(self._path, error)) from error


def _entry(row: tuple[object, ...]) -> Entry:
    values = dict(zip((field.name for field in fields(Entry)), row, strict=True))
    values["state"] = State(str(values["state"]))
    values["outcome"] = State(str(values["outcome"])) if values["outcome"] else None
    values["figures"] = json.loads(str(values["figures"]))
    return Entry(**values)  # type: ignore[arg-type] # the schema is STRICT: each column has its type
