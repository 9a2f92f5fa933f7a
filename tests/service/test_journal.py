"""The journal keeps what it was told, through kills, and a reader never disturbs it."""

from __future__ import annotations

import os
import random
import signal
import sqlite3
import subprocess
import sys
import time
from dataclasses import replace

import pytest

from station.errors import NotReadyError, StoreError
from station.service.journal import Journal, State
from station.service.lock import in_use, only_writer

NAME = "261121_030512.laz"


@pytest.fixture
def journal(tmp_path):
    with Journal(tmp_path / "journal.sqlite", now_s=lambda: 1000.0) as opened:
        yield opened


def store(journal, name=NAME, **changes):
    told = {
        "sha256": "aa",
        "verdict": "good",
        "epoch": "epochs/a.nc",
        "start_utc_s": 5.0,
        "revision": 1,
        "figures": {"points": 12.0},
    }
    journal.stored(name, **{**told, **changes})


def test_a_new_scan_waits_and_ends_stored(journal):
    journal.seen([(NAME, 10, 20, "size and time to stand still")])
    assert journal.entry(NAME).state is State.WAITING
    assert journal.entry(NAME).waits_for == "size and time to stand still"
    store(journal)
    entry = journal.entry(NAME)
    assert (entry.state, entry.epoch, entry.figures) == (State.STORED, "epochs/a.nc", {"points": 12.0})
    assert entry.waits_for == ""
    assert journal.counts() == {"waiting": 0, "stored": 1, "set_aside": 0, "later": 0}
    assert journal.last_stored() == entry
    assert journal.others_stored("another.laz", 10) == {"aa": NAME}
    assert journal.others_stored(NAME, 10) == {}
    assert journal.others_stored("another.laz", 11) == {}


def test_the_epochs_it_tells_and_the_names_it_does_not_know(journal):
    journal.seen([(name, 10, 20, "") for name in ("waits.laz", "again.laz", NAME)])
    for name in (NAME, "again.laz"):
        store(journal, name, epoch=f"epochs/{name}.nc")
    journal.again(["again.laz"])
    every = {"again.laz": "epochs/again.laz.nc", NAME: f"epochs/{NAME}.nc"}
    assert journal.epochs() == every
    assert journal.epochs(State.STORED) == {NAME: f"epochs/{NAME}.nc"}
    assert journal.unseen([NAME, "z.laz", "waits.laz", "odd 'name\".laz"]) == ["odd 'name\".laz", "z.laz"]


def test_the_same_sight_again_changes_nothing(journal):
    journal.seen([(NAME, 10, 20, "")])
    store(journal)
    journal.seen([(NAME, 10, 20, "anything")])
    assert journal.entry(NAME).state is State.STORED


def test_a_touched_scan_is_put_back_by_its_bytes(journal):
    journal.seen([(NAME, 10, 20, "")])
    journal.set_aside(NAME, "cut off", sha256="aa")
    journal.seen([(NAME, 10, 21, "settling")])
    assert journal.entry(NAME).state is State.WAITING
    assert not journal.same_again(NAME, "bb")
    assert journal.same_again(NAME, "aa")
    assert (journal.entry(NAME).state, journal.entry(NAME).reason) == (State.SET_ASIDE, "cut off")
    assert not journal.same_again("another.laz", "aa")


def test_a_worse_file_under_the_name_leaves_what_is_stored_known(journal):
    journal.seen([(NAME, 10, 20, "")])
    store(journal)
    journal.seen([(NAME, 5, 30, "")])
    journal.set_aside(NAME, "cut off", sha256="bb")
    entry = journal.entry(NAME)
    assert (entry.state, entry.epoch, entry.revision) == (State.SET_ASIDE, "epochs/a.nc", 1)


def test_the_reason_lies_beside_until_the_scan_is_stored(journal, tmp_path):
    journal.set_aside(NAME, "cut off after 12 of 40 points")
    note = tmp_path / "set_aside" / f"{NAME}.txt"
    assert note.read_text() == f"{NAME}: cut off after 12 of 40 points\n"
    store(journal)
    assert not note.exists()


def test_later_backs_off_to_an_hour_and_starts_anew_when_the_file_changes(journal):
    journal.seen([(NAME, 10, 20, "")])
    pauses_s = [journal.later(NAME, "log is missing") for _ in range(9)]
    assert pauses_s == [30, 60, 120, 240, 480, 960, 1920, 3600, 3600]
    assert journal.entry(NAME).next_try_utc_s == 4600.0
    journal.seen([(NAME, 11, 20, "")])
    assert (journal.entry(NAME).attempts, journal.entry(NAME).next_try_utc_s) == (0, None)


def test_again_has_the_same_bytes_done_once_more(journal):
    journal.seen([(NAME, 10, 20, "")])
    store(journal)
    journal.again([NAME])
    assert [entry.name for entry in journal.waiting()] == [NAME]
    assert not journal.same_again(NAME, "aa")


def test_gone_forgets_what_was_not_done_and_keeps_what_was(journal):
    journal.seen([(NAME, 10, 20, ""), ("b.laz", 1, 1, ""), ("c.laz", 1, 1, "")])
    store(journal)
    journal.set_aside("c.laz", "no")
    journal.again([NAME])
    journal.gone([NAME, "b.laz", "c.laz"])
    assert [(entry.name, entry.state) for entry in journal.rows()] == [
        (NAME, "stored"),
        ("c.laz", "set_aside"),
    ]


def test_a_reader_of_a_closed_journal_leaves_no_file_behind(tmp_path):
    with Journal(tmp_path / "journal.sqlite") as journal:
        store(journal)
    before = sorted(path.name for path in tmp_path.iterdir())
    with Journal(tmp_path / "journal.sqlite", read_only=True) as reader:
        assert reader.counts()["stored"] == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == before == ["journal.sqlite"]


def test_a_reader_sees_what_is_being_written(journal, tmp_path):
    store(journal)
    with Journal(tmp_path / "journal.sqlite", read_only=True) as reader:
        assert reader.counts()["stored"] == 1
        with pytest.raises(StoreError, match="readonly"):
            reader.again([NAME])


def test_no_journal_reads_as_an_empty_one(tmp_path):
    with Journal(tmp_path / "journal.sqlite", read_only=True) as reader:
        assert reader.rows() == []
    assert list(tmp_path.iterdir()) == []


def test_a_damaged_journal_says_what_to_do(tmp_path):
    (tmp_path / "journal.sqlite").write_bytes(b"not a database" * 100)
    with pytest.raises(StoreError, match="move it"):
        Journal(tmp_path / "journal.sqlite")


def test_a_folder_that_is_gone_is_a_store_error(tmp_path):
    with pytest.raises(StoreError, match="cannot be used"):
        Journal(tmp_path / "nowhere" / "journal.sqlite")


def test_a_failed_change_leaves_nothing_half_done(journal):
    def broken():
        yield ("a.laz", 1, 1, "")
        raise ValueError("listing broke")

    with pytest.raises(ValueError, match="listing broke"):
        journal.seen(broken())
    assert journal.rows() == []
    journal.seen([("b.laz", 1, 1, "")])


def test_a_journal_of_an_older_version_is_brought_up_to_date(tmp_path):
    path = tmp_path / "journal.sqlite"
    with Journal(path) as journal:
        store(journal)
    old = sqlite3.connect(path)
    old.executescript("ALTER TABLE scan DROP COLUMN log_sha256; DROP TABLE file")
    old.close()
    with Journal(path) as journal:
        assert (journal.entry(NAME).sha256, journal.entry(NAME).log_sha256) == ("aa", "")
        assert journal.files() == {}


def test_a_checksum_is_noted_with_its_epoch_or_not_at_all(journal):
    store(journal, epoch_sha256="ee")
    journal.note_files({"days/a.nc": "dd"})
    assert journal.files() == {"days/a.nc": "dd", "epochs/a.nc": "ee"}
    with pytest.raises(StoreError):
        store(journal, epoch="epochs/b.nc", epoch_sha256="ff", start_utc_s="no number")
    assert journal.files() == {"days/a.nc": "dd", "epochs/a.nc": "ee"}
    assert journal.entry(NAME).epoch == "epochs/a.nc"
    journal.forget_files(["epochs/a.nc"])
    assert journal.files() == {"days/a.nc": "dd"}


def test_rows_made_of_epochs_bring_older_ones_up_to_date_and_leave_newer_ones(journal):
    store(journal, revision=2)
    known = journal.entry(NAME)
    journal.adopt([replace(known, revision=1, epoch="epochs/old.nc")])
    assert journal.entry(NAME) == known
    newer = replace(known, revision=3, epoch="epochs/new.nc", sha256="bb", figures={})
    journal.adopt([newer, replace(newer, name="other.laz")])
    assert (journal.entry(NAME).epoch, journal.entry(NAME).sha256) == ("epochs/new.nc", "bb")
    assert journal.entry("other.laz") == replace(newer, name="other.laz")


def test_one_writer_a_data_folder(tmp_path):
    assert not in_use(tmp_path)
    with only_writer(tmp_path):
        assert in_use(tmp_path)
        with pytest.raises(NotReadyError, match=f"pid {os.getpid()}"), only_writer(tmp_path, patience_s=0.1):
            pass
    assert not in_use(tmp_path)


WRITER = """
import sys
from pathlib import Path
from station.service.journal import Journal
with Journal(Path(sys.argv[1])) as journal:
    for i in range(int(sys.argv[2]), 1_000_000):
        name = f"{i:06d}.laz"
        journal.seen([(name, i, i, "")])
        journal.stored(name, sha256=str(i), verdict="good", epoch=name, start_utc_s=i, revision=1)
        print(i, flush=True)
"""


def test_what_was_acknowledged_survives_twenty_kills(tmp_path):
    dice = random.Random(7)  # noqa: S311 - no secret
    path = tmp_path / "journal.sqlite"
    told = 0
    for _ in range(20):
        with subprocess.Popen(
            [sys.executable, "-c", WRITER, str(path), str(told)], stdout=subprocess.PIPE, text=True
        ) as writer:
            writer.stdout.readline()
            time.sleep(dice.random() * 0.05)
            writer.send_signal(signal.SIGKILL)
            lines = writer.stdout.read().splitlines()
        with Journal(path, read_only=True) as reader:
            stored = [entry.start_utc_s for entry in reader.rows(State.STORED)]
            acknowledged = int(lines[-1]) + 1 if lines else told + 1
            assert stored == list(range(len(stored)))
            assert len(stored) >= acknowledged
            assert len(reader.rows()) - len(stored) <= 1
        told = len(stored)
    check = sqlite3.connect(path)
    assert check.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
    check.close()


@pytest.mark.parametrize("content", [b"", None])
def test_a_journal_that_has_only_just_begun_is_empty_to_its_readers(tmp_path, content):
    """As a service leaves it that was killed in its first moment: without a table, or without a byte."""
    path = tmp_path / "journal.sqlite"
    if content is None:
        rows = sqlite3.connect(path)
        rows.execute("PRAGMA journal_mode = WAL")
        rows.close()
    else:
        path.write_bytes(content)
    with Journal(path, read_only=True) as reader:
        assert reader.rows() == []
