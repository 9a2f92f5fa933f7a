"""The journal: states of a scan, retries, checksums, readers during writes, kills of the writer."""

from __future__ import annotations

import os
import random
import signal
import sqlite3
import subprocess
import sys
import time
from contextlib import closing
from dataclasses import replace

import pytest

from station.errors import NotReadyError, StoreError
from station.inbox.journal import MAX_FAILURES, Journal
from station.inbox.journal_reader import JournalReader, State
from station.inbox.lock import exclusive_lock, is_locked

NAME = "261121_030512.laz"


@pytest.fixture
def journal(tmp_path):
    with Journal(tmp_path / "journal.sqlite", now_s=lambda: 1000.0) as journal:
        yield journal


def store(journal, name=NAME, **changes):
    values = {
        "sha256": "aa",
        "verdict": "good",
        "epoch": "epochs/a.nc",
        "start_utc_s": 5.0,
        "revision": 1,
        "metrics": {"points": 12.0},
    }
    journal.record_stored(name, **{**values, **changes})


def test_new_scan_waits_until_it_is_stored(journal):
    journal.record_seen([(NAME, 10, 20, "size and mtime to be stable")])
    assert journal.entry(NAME).state is State.WAITING
    assert journal.entry(NAME).waiting_reason == "size and mtime to be stable"
    store(journal)
    entry = journal.entry(NAME)
    assert (entry.state, entry.epoch, entry.metrics) == (State.STORED, "epochs/a.nc", {"points": 12.0})
    assert entry.waiting_reason == ""
    assert journal.counts() == {"waiting": 0, "stored": 1, "set_aside": 0, "later": 0}
    assert journal.last_stored() == entry
    assert journal.others_stored("another.laz", 10) == {"aa": NAME}
    assert journal.others_stored(NAME, 10) == {}
    assert journal.others_stored("another.laz", 11) == {}


def test_epochs_and_unrecorded_names(journal):
    journal.record_seen([(name, 10, 20, "") for name in ("waiting.laz", "requeued.laz", NAME)])
    for name in (NAME, "requeued.laz"):
        store(journal, name, epoch=f"epochs/{name}.nc")
    journal.requeue(["requeued.laz"])
    expected = {"requeued.laz": "epochs/requeued.laz.nc", NAME: f"epochs/{NAME}.nc"}
    assert journal.epochs() == expected
    assert journal.current_epochs() == {NAME: f"epochs/{NAME}.nc"}
    assert journal.unrecorded([NAME, "z.laz", "waiting.laz", "odd 'name\".laz"]) == [
        "odd 'name\".laz",
        "z.laz",
    ]


def test_unchanged_file_keeps_its_state(journal):
    journal.record_seen([(NAME, 10, 20, "")])
    store(journal)
    journal.record_seen([(NAME, 10, 20, "anything")])
    assert journal.entry(NAME).state is State.STORED


def test_touched_scan_with_known_content_is_restored(journal):
    journal.record_seen([(NAME, 10, 20, "")])
    journal.set_aside(NAME, "cut off", sha256="aa")
    journal.record_seen([(NAME, 10, 21, "settling")])
    assert journal.entry(NAME).state is State.WAITING
    assert not journal.restore_unchanged(NAME, "bb")
    assert journal.restore_unchanged(NAME, "aa")
    assert (journal.entry(NAME).state, journal.entry(NAME).reason) == (State.SET_ASIDE, "cut off")
    assert not journal.restore_unchanged("another.laz", "aa")


def test_unusable_file_under_a_stored_name_keeps_the_epoch(journal):
    journal.record_seen([(NAME, 10, 20, "")])
    store(journal)
    journal.record_seen([(NAME, 5, 30, "")])
    journal.set_aside(NAME, "cut off", sha256="bb")
    entry = journal.entry(NAME)
    assert (entry.state, entry.epoch, entry.revision) == (State.SET_ASIDE, "epochs/a.nc", 1)


def test_reason_file_exists_until_the_scan_is_stored(journal, tmp_path):
    journal.set_aside(NAME, "cut off after 12 of 40 points")
    reason_file = tmp_path / "set_aside" / f"{NAME}.txt"
    assert reason_file.read_text() == f"{NAME}: cut off after 12 of 40 points\n"
    store(journal)
    assert not reason_file.exists()


def test_retry_delay_doubles_up_to_an_hour_and_restarts_when_the_file_changes(journal):
    journal.record_seen([(NAME, 10, 20, "")])
    delays_s = [journal.defer(NAME, "log is missing") for _ in range(9)]
    assert delays_s == [30, 60, 120, 240, 480, 960, 1920, 3600, 3600]
    assert journal.entry(NAME).next_try_utc_s == 4600.0
    journal.record_seen([(NAME, 11, 20, "")])
    assert (journal.entry(NAME).attempts, journal.entry(NAME).next_try_utc_s) == (0, None)


def test_failures_count_only_under_the_same_conditions(journal):
    for _ in range(20):
        journal.defer(NAME, "permission denied")
    delays_s = [journal.record_failure(NAME, "killed", "0.1 a") for _ in range(3)]
    assert delays_s == [30, 60, 120]
    assert journal.judged_otherwise("0.1 a") == []
    assert journal.judged_otherwise("0.2 a") == [NAME]
    assert journal.record_failure(NAME, "killed", "0.2 a") == 30
    assert [journal.record_failure(NAME, "killed", "0.2 a") for _ in range(10)][-1] == 30 * 2**10
    store(journal, "other.laz")
    assert journal.record_failure(NAME, "killed", "0.2 a") is None
    assert journal.entry(NAME).state is State.SET_ASIDE


def test_scan_is_not_rejected_while_no_other_is_stored(tmp_path):
    """Then the machine is the cause: it is tried as rarely as before, and references wait for it."""
    now_s = [1000.0]
    with Journal(tmp_path / "journal.sqlite", now_s=lambda: now_s[0]) as journal:
        store(journal, "other.laz")
        for failure in range(1, 20):
            now_s[0] += 3600
            assert journal.record_failure(NAME, "no memory", "0.1 a") == 30 * 2 ** min(failure - 1, 10)
        assert journal.unsettled() == {}  # just tried
        assert journal.unsettled(however_often_failed=True) == {NAME: None}
        store(journal, "other.laz")
        assert journal.record_failure(NAME, "no memory", "0.1 a") is None


def test_scan_behind_one_that_failed_for_a_day_waits_until_that_is_tried_again(tmp_path):
    """Otherwise a night without memory decides which scan is the first under an SOP."""
    now_s, later = [1000.0], "later.laz"
    with Journal(tmp_path / "journal.sqlite", now_s=lambda: now_s[0]) as journal:
        for _ in range(MAX_FAILURES):
            journal.record_failure(NAME, "no memory", "0.1 a")
        assert journal.unsettled() == {}
        now_s[0] += 7 * 3600
        assert journal.unsettled() == {NAME: None}
        assert journal.defer_behind(later, NAME, f"waits for {NAME}") == 30
        assert (journal.entry(NAME).next_try_utc_s, journal.entry(NAME).waiting_reason) == (
            now_s[0],
            "no memory",
        )
        now_s[0] += 10
        journal.record_failure(NAME, "no memory", "0.1 a")
        now_s[0] += 20
        assert list(journal.unsettled()) == [later]
        assert journal.defer_behind("other.laz", later, "permission denied") == 30
        assert [journal.defer_behind("other.laz", "", "permission denied") for _ in range(2)] == [60, 120]


def test_scans_set_aside_whatever_the_settings_are_not_judged_again(journal):
    journal.set_aside("copy.laz", "the same bytes as a.laz, which is stored")
    journal.set_aside("short.laz", "cut off", judged_under="0.1 a")
    journal.reject([("notes.laz", 10, 1, "not a name of a scan")])
    assert journal.judged_otherwise("0.2 a") == ["short.laz"]


def test_settled_scans_delay_no_other(tmp_path):
    now_s = [1000.0]
    with Journal(tmp_path / "journal.sqlite", now_s=lambda: now_s[0]) as journal:
        journal.record_seen([(name, 10, 20, "") for name in ("queued.laz", "stored.laz", "later.laz")])
        journal.record_seen([("open.laz", 10, 20, "another process to close it")])
        store(journal, "stored.laz")
        journal.defer("later.laz", "permission denied")
        assert journal.unsettled() == {"later.laz": None, "open.laz": None, "queued.laz": None}
        for _ in range(MAX_FAILURES - 1):
            journal.defer("later.laz", "permission denied")
        assert list(journal.unsettled()) == ["open.laz", "queued.laz"]
        now_s[0] += 7 * 3600
        assert list(journal.unsettled()) == ["queued.laz"]  # its turn comes
        store(journal, "queued.laz")
        journal.record_seen([("stored.laz", 10, 21, "")])
        assert journal.unsettled() == {"stored.laz": 5.0}


def test_copy_is_recognised_while_its_original_waits(journal):
    journal.record_seen([(NAME, 10, 20, "")])
    store(journal)
    journal.requeue([NAME])
    assert journal.others_stored("copy.laz", 10) == {"aa": NAME}
    assert journal.starting_at(5.9) == [NAME]


def test_older_journal_is_read_and_completed(tmp_path):
    path = tmp_path / "journal.sqlite"
    with Journal(path) as journal:
        store(journal)
        journal.set_aside("short.laz", "cut off", judged_under="0.1 a")
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("ALTER TABLE scan DROP COLUMN judged_under")
    with JournalReader(path) as journal:
        assert [row.name for row in journal.rows()] == [NAME, "short.laz"]
    with Journal(path) as journal:
        assert journal.judged_otherwise("0.2 a") == ["short.laz"]


def test_requeued_scan_is_not_restored_by_its_content(journal):
    journal.record_seen([(NAME, 10, 20, "")])
    store(journal)
    journal.requeue([NAME])
    assert [entry.name for entry in journal.waiting()] == [NAME]
    assert not journal.restore_unchanged(NAME, "aa")


def test_removed_scans_are_dropped_unless_they_have_an_epoch_or_are_set_aside(journal):
    journal.record_seen([(NAME, 10, 20, ""), ("b.laz", 1, 1, ""), ("c.laz", 1, 1, "")])
    store(journal)
    journal.set_aside("c.laz", "no")
    journal.requeue([NAME])
    journal.record_removed([NAME, "b.laz", "c.laz"])
    assert [(entry.name, entry.state) for entry in journal.rows()] == [
        (NAME, "stored"),
        ("c.laz", "set_aside"),
    ]


def test_reader_of_a_closed_journal_creates_no_file(tmp_path):
    with Journal(tmp_path / "journal.sqlite") as journal:
        store(journal)
    before = sorted(path.name for path in tmp_path.iterdir())
    with JournalReader(tmp_path / "journal.sqlite") as reader:
        assert reader.counts()["stored"] == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == before == ["journal.sqlite"]


def test_reader_of_an_open_journal_sees_changes_and_cannot_write(journal, tmp_path):
    store(journal)
    with JournalReader(tmp_path / "journal.sqlite") as reader:
        assert reader.counts()["stored"] == 1
        with pytest.raises(sqlite3.OperationalError, match="readonly"):
            reader._connection.execute("DELETE FROM scan")


def test_missing_journal_reads_as_empty(tmp_path):
    with JournalReader(tmp_path / "journal.sqlite") as reader:
        assert reader.rows() == []
    assert list(tmp_path.iterdir()) == []


def test_damaged_journal_raises_an_error_with_the_remedy(tmp_path):
    (tmp_path / "journal.sqlite").write_bytes(b"not a database" * 100)
    with pytest.raises(StoreError, match="move it"):
        Journal(tmp_path / "journal.sqlite")


def test_missing_folder_raises_store_error(tmp_path):
    with pytest.raises(StoreError, match="cannot be used"):
        Journal(tmp_path / "missing" / "journal.sqlite")


def test_failed_transaction_is_rolled_back(journal):
    def failing_listing():
        yield ("a.laz", 1, 1, "")
        raise ValueError("listing failed")

    with pytest.raises(ValueError, match="listing failed"):
        journal.record_seen(failing_listing())
    assert journal.rows() == []
    journal.record_seen([("b.laz", 1, 1, "")])


def test_journal_without_log_sha256_and_checksums_is_migrated(tmp_path):
    path = tmp_path / "journal.sqlite"
    with Journal(path) as journal:
        store(journal)
    connection = sqlite3.connect(path)
    connection.executescript("ALTER TABLE scan DROP COLUMN log_sha256; DROP TABLE file")
    connection.close()
    with Journal(path) as journal:
        assert (journal.entry(NAME).sha256, journal.entry(NAME).log_sha256) == ("aa", "")
        assert journal.checksums() == {}


def test_checksum_is_recorded_in_the_transaction_of_its_epoch(journal):
    store(journal, epoch_sha256="ee")
    journal.add_checksums({"days/a.nc": "dd"})
    assert journal.checksums() == {"days/a.nc": "dd", "epochs/a.nc": "ee"}
    with pytest.raises(StoreError):
        store(journal, epoch="epochs/b.nc", epoch_sha256="ff", start_utc_s="not a number")
    assert journal.checksums() == {"days/a.nc": "dd", "epochs/a.nc": "ee"}
    assert journal.entry(NAME).epoch == "epochs/a.nc"
    journal.drop_checksums(["epochs/a.nc"])
    assert journal.checksums() == {"days/a.nc": "dd"}


def test_imported_entries_update_older_rows_only(journal):
    store(journal, revision=2)
    known = journal.entry(NAME)
    journal.import_entries([replace(known, revision=1, epoch="epochs/old.nc")])
    assert journal.entry(NAME) == known
    newer = replace(known, revision=3, epoch="epochs/new.nc", sha256="bb", metrics={})
    journal.import_entries([newer, replace(newer, name="other.laz")])
    assert (journal.entry(NAME).epoch, journal.entry(NAME).sha256) == ("epochs/new.nc", "bb")
    assert journal.entry("other.laz") == replace(newer, name="other.laz")


def test_lock_admits_one_process_per_data_folder(tmp_path):
    assert not is_locked(tmp_path)
    with exclusive_lock(tmp_path):
        assert is_locked(tmp_path)
        with (
            pytest.raises(NotReadyError, match=f"pid {os.getpid()}"),
            exclusive_lock(tmp_path, timeout_s=0.1),
        ):
            pass
    assert not is_locked(tmp_path)


WRITER = """
import sys
from pathlib import Path
from station.inbox.journal import Journal
from station.inbox.journal_reader import JournalReader
with Journal(Path(sys.argv[1])) as journal:
    for i in range(int(sys.argv[2]), 1_000_000):
        name = f"{i:06d}.laz"
        journal.record_seen([(name, i, i, "")])
        journal.record_stored(name, sha256=str(i), verdict="good", epoch=name, start_utc_s=i, revision=1)
        print(i, flush=True)
"""


@pytest.mark.integration
def test_acknowledged_rows_survive_twenty_kills(tmp_path):
    rng = random.Random(7)  # noqa: S311 - not for cryptography
    path = tmp_path / "journal.sqlite"
    stored_count = 0
    for _ in range(20):
        with subprocess.Popen(
            [sys.executable, "-c", WRITER, str(path), str(stored_count)], stdout=subprocess.PIPE, text=True
        ) as writer:
            writer.stdout.readline()
            time.sleep(rng.random() * 0.05)
            writer.send_signal(signal.SIGKILL)
            lines = writer.stdout.read().splitlines()
        with JournalReader(path) as reader:
            stored = [entry.start_utc_s for entry in reader.rows(State.STORED)]
            acknowledged = int(lines[-1]) + 1 if lines else stored_count + 1
            assert stored == list(range(len(stored)))
            assert len(stored) >= acknowledged
            assert len(reader.rows()) - len(stored) <= 1
        stored_count = len(stored)
    check = sqlite3.connect(path)
    assert check.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
    check.close()


@pytest.mark.parametrize("content", [b"", None])
def test_journal_without_tables_reads_as_empty(tmp_path, content):
    """A service killed while it creates the journal leaves a file without a table, or without a byte."""
    path = tmp_path / "journal.sqlite"
    if content is None:
        connection = sqlite3.connect(path)
        connection.execute("PRAGMA journal_mode = WAL")
        connection.close()
    else:
        path.write_bytes(content)
    with JournalReader(path) as reader:
        assert reader.rows() == []


def test_current_epochs_are_those_of_scans_that_are_or_were_stored(journal):
    """A scan that waits because it was touched is restored as stored later: its epoch must not be missed."""
    for name in ("stored", "touched", "unusable", "queued"):
        journal.record_seen([(name, 1, 1, "")])
        journal.record_stored(
            name, sha256="0", verdict="good", epoch=f"{name}.nc", start_utc_s=1e9, revision=1
        )
    journal.record_seen([("touched", 1, 2, ""), ("unusable", 2, 2, ""), ("new", 1, 1, "")])
    journal.set_aside("unusable", "cut off")
    journal.requeue(["queued"])
    assert journal.current_epochs() == {"stored": "stored.nc", "touched": "touched.nc"}
    assert set(journal.epochs()) == {"stored", "touched", "unusable", "queued"}
