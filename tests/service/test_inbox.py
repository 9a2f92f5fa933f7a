"""The inbox gives each scan once, whole, in the order of time; and says what the others wait for."""

from __future__ import annotations

import errno
import fcntl
import math
import os
import shutil
import socket

import pytest

from station.errors import NotReadyError
from station.service.inbox import Inbox, quoted
from station.service.journal import Journal, State

FIRST, SECOND = "261121_010000.laz", "261121_020000.laz"
LOG = """
[inclination]
required = {required}
wait_s = 900
"""


class Clock:
    """Monotonic and wall clock, moved by hand."""

    def __init__(self):
        self.monotonic_s, self.now_s = 50.0, 1_800_000_000.0

    def forward(self, seconds):
        self.monotonic_s += seconds
        self.now_s += seconds


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def journal(tmp_path, clock):
    (tmp_path / "data").mkdir(exist_ok=True)
    with Journal(tmp_path / "data" / "journal.sqlite", now_s=lambda: clock.now_s) as opened:
        yield opened


@pytest.fixture
def make_inbox(make_site, journal, clock):
    def make(**settings):
        return Inbox(
            make_site(**settings),
            journal,
            (".las", ".laz"),
            monotonic_s=lambda: clock.monotonic_s,
            now_s=lambda: clock.now_s,
        )

    return make


@pytest.fixture
def drop(tmp_path):
    (tmp_path / "inbox").mkdir(exist_ok=True)

    def put(name, content="scan"):
        (tmp_path / "inbox" / name).write_text(content)
        return tmp_path / "inbox" / name

    return put


def test_a_scan_is_taken_when_it_has_stood_still(make_inbox, drop, clock, journal):
    inbox, path = make_inbox(), drop(FIRST)
    seen = inbox.look()
    assert (seen.first, seen.new, seen.next_s) == (None, 1, 60.0)
    assert "stand still" in journal.entry(FIRST).waits_for
    clock.forward(59)
    assert inbox.look().first is None
    drop(FIRST, "more of it")
    clock.forward(2)
    assert inbox.look().first is None
    clock.forward(60)
    seen = inbox.look()
    assert (seen.first.path, seen.first.size, seen.first.log) == (path, 10, None)
    assert (seen.queued, seen.new) == (1, 0)


def test_the_wall_clock_has_no_say_in_settling(make_inbox, drop, clock):
    inbox = make_inbox()
    drop(FIRST)
    inbox.look()
    clock.now_s += 86400
    assert inbox.look().first is None
    clock.now_s -= 10 * 86400
    clock.monotonic_s += 60
    assert inbox.look().first.name == FIRST


def test_names_give_the_order_of_time(make_inbox, drop, journal, clock):
    inbox = make_inbox(settle_s=0)
    for name in ("zz.laz", SECOND, "a_no_time.laz", FIRST, "251231_235959.LAZ"):
        drop(name)
    order = []
    for _ in range(5):
        taken = inbox.look().first
        order.append(taken.name)
        journal.set_aside(taken.name, "done")
    assert order == ["251231_235959.LAZ", FIRST, SECOND, "a_no_time.laz", "zz.laz"]
    clock.forward(1)
    last = inbox.look()
    assert (last.first, last.queued, last.next_s) == (None, 0, math.inf)


def test_only_what_changed_is_taken_again(make_inbox, drop, journal):
    inbox, path = make_inbox(settle_s=0), drop(FIRST)
    inbox.look()
    journal.set_aside(FIRST, "cut off")
    assert inbox.look().first is None
    os.utime(path, ns=(1, 1))
    assert inbox.look().first.name == FIRST
    journal.set_aside(FIRST, "cut off")
    drop(FIRST, "another scan")
    assert inbox.look().first.name == FIRST
    assert journal.entry(FIRST).state is State.WAITING


def test_a_scan_to_be_done_again_goes_before_later_ones(make_inbox, drop, clock, journal):
    """Else what is made of the first scans would depend on when they were done again."""
    inbox = make_inbox()
    drop(FIRST)
    inbox.look()
    clock.forward(60)
    journal.stored(
        inbox.look().first.name, sha256="0", verdict="good", epoch="e", start_utc_s=0.0, revision=1
    )
    drop(SECOND)
    for anew in (inbox, make_inbox()):  # also after a restart
        anew.look()
        clock.forward(60)
        assert anew.look().first.name == SECOND
        journal.again([FIRST])
        assert anew.look().first.name == FIRST
        journal.stored(FIRST, sha256="0", verdict="good", epoch="e", start_utc_s=0.0, revision=1)


def test_later_is_not_taken_before_its_time(make_inbox, drop, clock, journal):
    inbox = make_inbox(settle_s=0)
    drop(FIRST)
    drop(SECOND)
    inbox.look()
    journal.later(FIRST, "the weather log is held")
    seen = inbox.look()
    assert (seen.first.name, seen.next_s) == (SECOND, 30.0)
    assert journal.entry(FIRST).waits_for == "the weather log is held"
    clock.forward(31)
    assert inbox.look().first.name == FIRST


def test_a_clock_set_back_does_not_hold_a_scan_for_years(make_inbox, drop, clock, journal):
    inbox = make_inbox(settle_s=0)
    drop(FIRST)
    inbox.look()
    journal.later(FIRST, "not yet")
    clock.now_s -= 365 * 86400
    assert inbox.look().first.name == FIRST


def test_a_scan_waits_for_its_log_and_then_goes_with_it(make_inbox, drop, clock, journal):
    inbox = make_inbox(more=LOG.format(required="true"))
    drop(FIRST)
    inbox.look()
    clock.forward(300)
    seen = inbox.look()
    assert (seen.first, seen.next_s) == (None, 600.0)
    assert journal.entry(FIRST).waits_for == "its inclination log 261121_010000-incl.txt"
    drop("261121_010000-incl.txt", "")
    assert inbox.look().first is None
    beside = drop("261121_010000-incl.txt", "Time,Roll,Pitch")
    assert inbox.look().next_s == 60.0
    clock.forward(60)
    assert inbox.look().first.log == beside


@pytest.mark.parametrize(("required", "after_s"), [("true", 900), ("false", 60)])
def test_a_scan_goes_without_its_log_in_the_end(make_inbox, drop, clock, required, after_s):
    inbox = make_inbox(more=LOG.format(required=required))
    drop(FIRST)
    inbox.look()
    clock.forward(after_s - 1)
    assert inbox.look().first is None
    clock.forward(1)
    assert inbox.look().first.log is None


def test_a_link_is_not_taken_for_a_log(make_inbox, drop, tmp_path):
    inbox = make_inbox(settle_s=0, more=LOG.format(required="false"))
    drop(FIRST)
    (tmp_path / "inbox" / "261121_010000-incl.txt").symlink_to("/etc/passwd")
    assert inbox.look().first.log is None


def test_what_is_no_regular_file_is_refused_and_takes_nothing_down(make_inbox, drop, journal, tmp_path):
    inbox, folder = make_inbox(settle_s=0), tmp_path / "inbox"
    (folder / "link.laz").symlink_to("/etc/passwd")
    (folder / "dangling.laz").symlink_to("nowhere")
    os.mkfifo(folder / "pipe.laz")
    (folder / "folder.laz").mkdir()
    plug = socket.socket(socket.AF_UNIX)
    plug.bind(os.path.relpath(folder / "plug.laz"))
    plug.close()
    drop(FIRST)
    assert inbox.look().first.name == FIRST
    reasons = {row.name: row.reason.split(":")[0] for row in journal.rows(State.SET_ASIDE)}
    assert reasons == {
        "dangling.laz": "is a link",
        "folder.laz": "is a folder",
        "link.laz": "is a link",
        "pipe.laz": "is a pipe",
        "plug.laz": "is a socket",
    }
    assert "is a link" in (tmp_path / "data" / "set_aside" / "link.laz.txt").read_text()
    assert inbox.look().new == 0
    shutil.copyfile(folder / FIRST, folder / "solid")
    (folder / "solid").replace(folder / "link.laz")
    assert inbox.look().queued == 2


@pytest.mark.parametrize(
    "name",
    [
        "a\nb.laz",
        "a b.laz",
        "\x1b[31m.laz",
        "ä.laz",
        os.fsdecode(b"\xff\xfe.laz"),
        "-rf.laz",
        "x" * 250 + ".laz",
    ],
)
def test_odd_names_are_refused_in_words_that_can_be_printed(make_inbox, drop, journal, name):
    inbox = make_inbox(settle_s=0)
    drop(name)
    assert inbox.look().first is None
    (row,) = journal.rows()
    assert row.state is State.SET_ASIDE
    assert row.name == quoted(name)
    assert row.name.isascii()
    assert row.name.isprintable()
    assert "rename" in row.reason
    seen = inbox.look()
    assert (seen.first, seen.new) == (None, 0)


def test_other_files_and_transfers_under_way_are_left_alone(make_inbox, drop, journal):
    inbox = make_inbox(settle_s=0)
    for name in ("notes.txt", ".261121_010000.laz", ".261121_010000.laz.Xy12", "261121_010000.laz.part"):
        drop(name)
    assert inbox.look().first is None
    assert journal.rows() == []


def test_a_scan_someone_writes_is_not_taken(make_inbox, drop, tmp_path):
    inbox, probe = make_inbox(settle_s=0), drop("probe")
    with probe.open() as opened:
        try:
            fcntl.fcntl(opened, fcntl.F_SETLEASE, fcntl.F_RDLCK)
            fcntl.fcntl(opened, fcntl.F_SETLEASE, fcntl.F_UNLCK)
        except OSError as error:
            pytest.skip(f"no leases on {tmp_path}: {errno.errorcode[error.errno]}")
    path = drop(FIRST)
    with path.open("a"):
        seen = inbox.look()
        assert seen.first is None
        assert seen.next_s <= 5.0
    assert inbox.look().first.name == FIRST


def test_what_left_before_it_was_done_is_forgotten(make_inbox, drop, journal):
    inbox, path = make_inbox(), drop(FIRST)
    inbox.look()
    path.unlink()
    assert inbox.look().first is None
    assert journal.rows() == []


def test_an_inbox_that_is_gone_comes_later(make_inbox, tmp_path):
    inbox = make_inbox()
    (tmp_path / "inbox").rmdir()
    with pytest.raises(NotReadyError, match="cannot be listed"):
        inbox.look()


def test_looking_changes_nothing_in_the_inbox(make_inbox, drop, tmp_path):
    inbox, path = make_inbox(settle_s=0), drop(FIRST)
    before = (path.stat(), (tmp_path / "inbox").stat().st_mtime_ns)
    inbox.look()
    assert before == (path.stat(), (tmp_path / "inbox").stat().st_mtime_ns)
