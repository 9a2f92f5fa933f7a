"""The inbox returns each scan once, complete, in order of time, and the reason why the others wait."""

from __future__ import annotations

import errno
import fcntl
import math
import os
import shutil
import socket
import sys
from datetime import UTC, datetime, timedelta

import pytest

from station.errors import NotReadyError
from station.inbox import inbox as inbox_module
from station.inbox.inbox import Inbox
from station.inbox.journal import Journal
from station.inbox.journal_reader import State
from station.inbox.listing import safe_name

FIRST, SECOND = "261121_010000.laz", "261121_020000.laz"
LOG = """
[inclination]
required = {required}
wait_s = 900
"""


class Clock:
    """Monotonic and wall clock, advanced by the test."""

    def __init__(self):
        self.monotonic_s, self.now_s = 50.0, 1_800_000_000.0

    def advance(self, seconds):
        self.monotonic_s += seconds
        self.now_s += seconds


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def journal(tmp_path, clock):
    (tmp_path / "data").mkdir(exist_ok=True)
    with Journal(tmp_path / "data" / "journal.sqlite", now_s=lambda: clock.now_s) as journal:
        yield journal


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


def store(journal, name):
    journal.record_stored(name, sha256="0", verdict="good", epoch="e", start_utc_s=0.0, revision=1)


def test_thousands_of_odd_names_delay_no_scan(make_site, monkeypatch, caplog):
    monkeypatch.setattr(inbox_module, "MAX_REJECTED", 20)
    site = make_site(settle_s=0.0)
    for number in range(50):
        (site.scans.inbox / f"odd?name {number}.laz").touch()
    (site.scans.inbox / "261121_010000.laz").write_text("scan")
    with Journal(site.station.data / "journal.sqlite") as journal:
        inbox = Inbox(site, journal, (".laz",))
        states = [inbox.poll() for _ in range(3)]
        assert [state.first.name for state in states] == ["261121_010000.laz"] * 3
        assert [state.next_s for state in states] == [0.0, 0.0, math.inf]
        assert journal.counts()[State.SET_ASIDE] == 50
    assert len(caplog.records) == 10 + 1 + 10 + 1 + 10  # of each poll ten, and how many more
    assert len(list((site.station.data / "set_aside").iterdir())) == 50


def test_scan_is_ready_when_unchanged_for_settle_s(make_inbox, drop, clock, journal):
    inbox, path = make_inbox(), drop(FIRST)
    state = inbox.poll()
    assert (state.first, state.new, state.next_s) == (None, 1, 60.0)
    assert "to be stable" in journal.entry(FIRST).waiting_reason
    clock.advance(59)
    assert inbox.poll().first is None
    drop(FIRST, "more bytes")
    clock.advance(2)
    assert inbox.poll().first is None
    clock.advance(60)
    state = inbox.poll()
    assert (state.first.path, state.first.size, state.first.log) == (path, 10, None)
    assert (state.queued, state.new) == (1, 0)


def test_settling_ignores_the_wall_clock(make_inbox, drop, clock):
    inbox = make_inbox()
    drop(FIRST)
    inbox.poll()
    clock.now_s += 86400
    assert inbox.poll().first is None
    clock.now_s -= 10 * 86400
    clock.monotonic_s += 60
    assert inbox.poll().first.name == FIRST


def test_scans_are_ordered_by_the_time_in_their_names(make_inbox, drop, journal, clock):
    inbox = make_inbox(settle_s=0)
    for name in ("zz.laz", SECOND, "a_without_time.laz", FIRST, "251231_235959.LAZ"):
        drop(name)
    order = []
    for _ in range(5):
        scan = inbox.poll().first
        order.append(scan.name)
        journal.set_aside(scan.name, "done")
    assert order == ["251231_235959.LAZ", FIRST, SECOND, "a_without_time.laz", "zz.laz"]
    clock.advance(1)
    last = inbox.poll()
    assert (last.first, last.queued, last.next_s) == (None, 0, math.inf)


LIVE = "270115_073000.laz"  # half an hour before the clock of these tests
BACKLOG = 2_000  # scans


def backlog(drop, count=3):
    for number in range(count):
        drop(f"2611{1 + number // 24:02d}_{number % 24:02d}0000.laz", "x" * (10 + number))


def test_live_scan_is_measured_ahead_of_a_backlog_once(make_inbox, drop, journal):
    inbox = make_inbox(settle_s=0)
    backlog(drop)
    assert (inbox.poll().first.name, inbox.poll().ahead) == ("261101_000000.laz", False)
    drop(LIVE)
    state = inbox.poll()
    assert (state.first.name, state.ahead, state.queued) == (LIVE, True, 4)
    assert inbox.poll().first.name == "261101_000000.laz"  # one of the backlog in between
    journal.mark_ahead(LIVE)
    journal.record_stored(
        LIVE, sha256="0", verdict="good", epoch="e", start_utc_s=1e9, revision=1, reference="1", ahead=True
    )
    row = journal.entry(LIVE)
    assert (row.state, row.outcome, row.epoch, row.ahead) == (State.WAITING, None, "e", True)
    assert journal.usable() == []  # it is part of no reference
    order = []
    for _ in range(4):
        state = inbox.poll()
        order.append((state.first.name, state.ahead))
        store(journal, state.first.name)
    assert order[0] == ("261101_000000.laz", False)
    assert order[3] == (LIVE, False)
    assert not journal.entry(LIVE).ahead


@pytest.mark.parametrize("case", ["old", "of a copy", "of one start", "second in the queue", "still open"])
def test_scan_takes_its_turn_if_it_is(make_inbox, drop, clock, monkeypatch, case):
    inbox = make_inbox(settle_s=0)
    backlog(drop, 1 if case == "second in the queue" else 3)
    drop(LIVE, "x" * 11 if case == "of a copy" else "scan")
    clock.now_s += 8000 if case == "old" else 0
    if case == "of one start":
        drop(LIVE.replace(".laz", ".las"), "longer")
    if case == "still open":
        monkeypatch.setattr(inbox_module, "_is_open_for_writing", lambda scan: scan.name == LIVE)
    assert (inbox.poll().first.name, inbox.poll().ahead) == ("261101_000000.laz", False)


@pytest.mark.parametrize("differing_byte", [0, 50_000, 99_999])
def test_live_scan_of_the_size_of_others_is_measured_ahead(make_inbox, drop, clock, differing_byte):
    """Without compression all scans have one size: a sample of the bytes shows that it is no copy of them."""
    inbox = make_inbox(settle_s=60)
    content = "x" * 100_000
    for number in range(3):
        drop(f"261101_{number:02d}0000.laz", content)
    inbox.poll()
    drop(LIVE, f"{content[:differing_byte]}y{content[differing_byte + 1 :]}")
    inbox.poll()
    clock.advance(61)
    state = inbox.poll()
    assert (state.first.name, state.ahead) == (LIVE, True)


def test_live_scan_takes_its_turn_while_a_file_of_its_size_changes(make_inbox, drop, clock):
    inbox = make_inbox(settle_s=60)
    backlog(drop)
    drop(LIVE, "the live scan")
    inbox.poll()
    clock.advance(61)
    drop("261105_000000.laz", "a space of 13")  # which may become the same
    assert not inbox.poll().ahead
    clock.advance(61)
    assert inbox.poll().ahead


@pytest.mark.integration
def test_polling_costs_the_same_for_each_scan_of_a_backlog(make_inbox, drop, tmp_path, journal):
    """So long the live scan waits, besides the one that is being processed when it arrives.

    All have the same size, as without compression. Work is counted in calls and returns.
    """
    inbox = make_inbox(settle_s=0)
    for number in range(BACKLOG):
        at = datetime(2025, 1, 1, tzinfo=UTC) + timedelta(hours=number)
        (tmp_path / "inbox" / f"{at:%y%m%d_%H%M%S}.laz").write_bytes(number.to_bytes(100, "big"))
    inbox.poll()
    drop(LIVE, "x" * 100)
    calls = [0]

    def count(*_):
        calls[0] += 1

    sys.setprofile(count)
    try:
        state = inbox.poll()
    finally:
        sys.setprofile(None)
    assert calls[0] < 300 * BACKLOG  # 230 today; two loops in each other would make thousands
    assert (state.first.name, state.ahead, state.queued) == (LIVE, True, BACKLOG + 1)
    assert len(journal.unsettled()) == BACKLOG + 1


def test_reference_waits_for_scans_in_the_queue_but_not_for_one_that_stays_open(
    make_inbox, drop, clock, journal, monkeypatch
):
    monkeypatch.setattr(inbox_module, "_is_open_for_writing", lambda scan: scan.name == FIRST)
    inbox = make_inbox(settle_s=0)
    drop(FIRST)
    drop(SECOND)
    for _ in range(8):
        assert inbox.poll().first.name == SECOND
        clock.advance(3600)
    assert journal.entry(FIRST).waiting_reason == "another process to close it"
    assert journal.unsettled() == {SECOND: None}


def test_finished_scan_is_ready_again_only_after_a_change(make_inbox, drop, journal):
    inbox, path = make_inbox(settle_s=0), drop(FIRST)
    inbox.poll()
    journal.set_aside(FIRST, "cut off")
    assert inbox.poll().first is None
    os.utime(path, ns=(1, 1))
    assert inbox.poll().first.name == FIRST
    journal.set_aside(FIRST, "cut off")
    drop(FIRST, "another scan")
    assert inbox.poll().first.name == FIRST
    assert journal.entry(FIRST).state is State.WAITING


def test_requeued_scan_precedes_later_scans(make_inbox, drop, clock, journal):
    """Results that build on the first scans must not depend on when these were requeued."""
    inbox = make_inbox()
    drop(FIRST)
    inbox.poll()
    clock.advance(60)
    store(journal, inbox.poll().first.name)
    drop(SECOND)
    for restarted in (inbox, make_inbox()):
        restarted.poll()
        clock.advance(60)
        assert restarted.poll().first.name == SECOND
        journal.requeue([FIRST])
        assert restarted.poll().first.name == FIRST
        store(journal, FIRST)


def test_deferred_scan_waits_for_its_retry(make_inbox, drop, clock, journal):
    inbox = make_inbox(settle_s=0)
    drop(FIRST)
    drop(SECOND)
    inbox.poll()
    journal.defer(FIRST, "the weather log is incomplete")
    state = inbox.poll()
    assert (state.first.name, state.next_s) == (SECOND, 30.0)
    assert journal.entry(FIRST).waiting_reason == "the weather log is incomplete"
    clock.advance(31)
    assert inbox.poll().first.name == FIRST


def test_deferred_scan_is_ready_when_the_clock_was_set_back(make_inbox, drop, clock, journal):
    inbox = make_inbox(settle_s=0)
    drop(FIRST)
    inbox.poll()
    journal.defer(FIRST, "not yet")
    clock.now_s -= 365 * 86400
    assert inbox.poll().first.name == FIRST


def test_scan_waits_for_its_log(make_inbox, drop, clock, journal):
    inbox = make_inbox(more=LOG.format(required="true"))
    drop(FIRST)
    inbox.poll()
    clock.advance(300)
    state = inbox.poll()
    assert (state.first, state.next_s) == (None, 600.0)
    assert journal.entry(FIRST).waiting_reason == "its inclination log 261121_010000-incl.txt"
    drop("261121_010000-incl.txt", "")
    assert inbox.poll().first is None
    log = drop("261121_010000-incl.txt", "Time,Roll,Pitch")
    assert inbox.poll().next_s == 60.0
    clock.advance(60)
    assert inbox.poll().first.log == log


@pytest.mark.parametrize(("required", "after_s"), [("true", 900), ("false", 60)])
def test_scan_is_ready_without_its_log_after_wait_s(make_inbox, drop, clock, required, after_s):
    inbox = make_inbox(more=LOG.format(required=required))
    drop(FIRST)
    inbox.poll()
    clock.advance(after_s - 1)
    assert inbox.poll().first is None
    clock.advance(1)
    assert inbox.poll().first.log is None


def test_link_is_not_accepted_as_log(make_inbox, drop, tmp_path):
    inbox = make_inbox(settle_s=0, more=LOG.format(required="false"))
    drop(FIRST)
    (tmp_path / "inbox" / "261121_010000-incl.txt").symlink_to("/etc/passwd")
    assert inbox.poll().first.log is None


def test_irregular_files_are_set_aside(make_inbox, drop, journal, tmp_path):
    inbox, folder = make_inbox(settle_s=0), tmp_path / "inbox"
    (folder / "link.laz").symlink_to("/etc/passwd")
    (folder / "dangling.laz").symlink_to("missing")
    os.mkfifo(folder / "pipe.laz")
    (folder / "folder.laz").mkdir()
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(os.path.relpath(folder / "socket.laz"))
    drop(FIRST)
    assert inbox.poll().first.name == FIRST
    reasons = {row.name: row.reason.split(":")[0] for row in journal.rows(State.SET_ASIDE)}
    assert reasons == {
        "dangling.laz": "is a link",
        "folder.laz": "is a folder",
        "link.laz": "is a link",
        "pipe.laz": "is a pipe",
        "socket.laz": "is a socket",
    }
    assert "is a link" in (tmp_path / "data" / "set_aside" / "link.laz.txt").read_text()
    assert inbox.poll().new == 0
    shutil.copyfile(folder / FIRST, folder / "regular")
    (folder / "regular").replace(folder / "link.laz")
    assert inbox.poll().queued == 2


@pytest.mark.parametrize(
    "name",
    [
        "a\nb.laz",
        " a.laz",
        "\x1b[31m.laz",
        "a\u202eb.laz",  # right to left from there on
        "a\u200bb.laz",  # no width
        "ä" * 60 + ".laz",  # 124 bytes, which `<name>.txt` and a suffix may make too many
        "?[ab]*.laz",
        os.fsdecode(b"\xff\xfe.laz"),
        "-rf.laz",
        "x" * 250 + ".laz",
    ],
)
def test_unsafe_names_are_set_aside_under_a_printable_name(make_inbox, drop, journal, name):
    inbox = make_inbox(settle_s=0)
    drop(name)
    assert inbox.poll().first is None
    (row,) = journal.rows()
    assert row.state is State.SET_ASIDE
    assert row.name == safe_name(name)
    assert row.name.isascii()
    assert row.name.isprintable()
    assert "rename" in row.reason
    state = inbox.poll()
    assert (state.first, state.new) == (None, 0)


@pytest.mark.parametrize(
    "name", ["Höhe 12 m 1.laz", "Ho\u0308he.laz", "Écrins (2).laz", "Норд_1.laz", "氷河.laz"]
)
def test_names_of_any_language_are_queued_as_they_are(make_inbox, drop, journal, name):
    inbox = make_inbox(settle_s=0)
    drop(name)
    assert inbox.poll().first.path.name == name
    assert [(row.state, row.name) for row in journal.rows(State.WAITING)] == [(State.WAITING, name)]


def test_other_files_and_incomplete_transfers_are_ignored(make_inbox, drop, journal):
    inbox = make_inbox(settle_s=0)
    for name in ("notes.txt", ".261121_010000.laz", ".261121_010000.laz.Xy12", "261121_010000.laz.part"):
        drop(name)
    assert inbox.poll().first is None
    assert journal.rows() == []


def test_scan_open_for_writing_is_not_ready(make_inbox, drop, tmp_path):
    inbox, probe = make_inbox(settle_s=0), drop("probe")
    with probe.open() as file:
        try:
            fcntl.fcntl(file, fcntl.F_SETLEASE, fcntl.F_RDLCK)
            fcntl.fcntl(file, fcntl.F_SETLEASE, fcntl.F_UNLCK)
        except OSError as error:
            pytest.skip(f"no leases on {tmp_path}: {errno.errorcode[error.errno]}")
    path = drop(FIRST)
    with path.open("a"):
        state = inbox.poll()
        assert state.first is None
        assert state.next_s <= 5.0
    assert inbox.poll().first.name == FIRST


def test_scan_removed_while_waiting_is_dropped(make_inbox, drop, journal):
    inbox, path = make_inbox(), drop(FIRST)
    inbox.poll()
    path.unlink()
    assert inbox.poll().first is None
    assert journal.rows() == []


def test_missing_inbox_raises_not_ready(make_inbox, tmp_path):
    inbox = make_inbox()
    (tmp_path / "inbox").rmdir()
    with pytest.raises(NotReadyError, match="cannot be listed"):
        inbox.poll()


def test_polling_leaves_the_inbox_unchanged(make_inbox, drop, tmp_path):
    inbox, path = make_inbox(settle_s=0), drop(FIRST)
    before = (path.stat(), (tmp_path / "inbox").stat().st_mtime_ns)
    inbox.poll()
    assert before == (path.stat(), (tmp_path / "inbox").stat().st_mtime_ns)
