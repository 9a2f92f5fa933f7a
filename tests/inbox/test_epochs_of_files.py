"""Scans in folders below the inbox, and several files that are one epoch."""

import hashlib
import os

import pytest

from station.config import read_site
from station.errors import ConfigError
from station.inbox.file_hash import distinct_files, sha256_files
from station.inbox.inbox import Inbox
from station.inbox.journal import Journal
from station.inbox.journal_reader import State
from station.inbox.listing import ScanListing
from station.sections.inputs import InclinationSection, RegistrationSection

EPOCH = '[epoch]\nname = "%Y-%m-%d"\nwait_s = 600\n{files}'
DAY = "2026-11-21"


class Clock:
    def __init__(self):
        self.s = 1_000_000.0


@pytest.fixture
def folder(write_site):
    """Return a function that writes the site file of an inbox with folders."""

    def make(name, more=""):
        path = write_site(settle_s=0.0, more=more)
        path.write_text(path.read_text().replace('inbox = "inbox"', f'inbox = "inbox"\nname = "{name}"'))
        return path

    return make


@pytest.fixture
def read(folder):
    return lambda name, more="": read_site(folder(name, more))


@pytest.fixture
def drop(tmp_path):
    def put(name, content="scan", time_s=None):
        path = tmp_path / "inbox" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(content)
        if time_s is not None:
            os.utime(path, (time_s, time_s))
        return path

    return put


@pytest.fixture
def poll(read, tmp_path):
    """Return a function that polls an inbox whose files are epochs, and its clock."""
    clock = Clock()
    with Journal(tmp_path / "data" / "journal.sqlite") as journal:
        inboxes = {}

        def poll(files="", name="%Y-%m-%d/*"):
            if files not in inboxes:
                site = read(name, EPOCH.format(files=files))
                inboxes[files] = Inbox(site, journal, (".laz",), monotonic_s=lambda: clock.s)
            return inboxes[files].poll()

        (tmp_path / "data").mkdir(exist_ok=True)
        yield poll, clock, journal


@pytest.fixture(autouse=True)
def _data_folder(tmp_path):
    (tmp_path / "data").mkdir(exist_ok=True)


def test_scans_lie_at_the_depth_of_the_pattern(read, drop, tmp_path):
    site = read("%Y-%m-%d/*_%H%M%S")
    for name in (f"{DAY}/a_010000.laz", f"{DAY}/deeper/a_020000.laz", "a_030000.laz", f"{DAY}/.a_040000.laz"):
        drop(name)
    drop(".hidden/a_050000.laz")
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "a_060000.laz").touch()
    (tmp_path / "inbox" / "2026-11-22").symlink_to(tmp_path / "elsewhere")
    listing = ScanListing(site, site.scans.inbox, (".laz",))
    assert list(listing.scans) == [f"{DAY}/a_010000.laz"]
    assert listing.scan(f"{DAY}/a_010000.laz").path == site.scans.inbox / DAY / "a_010000.laz"


def test_links_odd_names_and_folders_like_scans_are_rejected_one_by_one(poll, drop, tmp_path):
    poll, _, journal = poll
    drop(f"{DAY}/a.laz")
    (tmp_path / "inbox" / DAY / "link.laz").symlink_to(tmp_path / "inbox" / DAY / "a.laz")
    (tmp_path / "inbox" / DAY / "folder.laz").mkdir()
    drop("21 November /a.laz")
    drop("21 November/a.laz")
    drop("november/b.laz")
    state = poll("files = 1")
    assert state.first.paths == [tmp_path / "inbox" / DAY / "a.laz"]
    reasons = {row.name: row.reason for row in journal.rows(State.SET_ASIDE)}
    assert "is a link" in reasons[f"{DAY}/link.laz"]
    assert "is a folder" in reasons[f"{DAY}/folder.laz"]
    assert "a space at its end" in reasons["21 November a.laz"]
    assert "does not match scans.name" in reasons["21 November/a.laz"]
    assert "does not match scans.name = '%Y-%m-%d/*'" in reasons["november/b.laz"]
    assert "link.laz: is a link" in (tmp_path / "data/set_aside" / DAY / "link.laz.txt").read_text()


def test_an_unreadable_folder_hides_no_other(read, drop, monkeypatch):
    site = read("%Y-%m-%d/*")
    drop(f"{DAY}/a.laz")
    secret = drop("2026-11-22/a.laz").parent
    scandir = os.scandir

    def deny(path):
        if path == secret:
            raise PermissionError(13, "Permission denied")
        return scandir(path)

    monkeypatch.setattr("station.inbox.listing.os.scandir", deny)
    assert list(ScanListing(site, site.scans.inbox, (".laz",)).scans) == [f"{DAY}/a.laz"]


def test_an_epoch_is_complete_with_its_files_or_after_a_pause(poll, drop):
    poll, clock, journal = poll
    drop(f"{DAY}/a.laz")
    state = poll("files = 2")
    assert (state.first, state.next_s) == (None, 600.0)
    assert journal.entry(DAY).waiting_reason == "the other files of its epoch, of which 1 of 2 are there"
    clock.s += 599
    drop(f"{DAY}/b.laz", "another")
    state = poll("files = 2")
    assert [part.name for part in state.first.parts] == [f"{DAY}/a.laz", f"{DAY}/b.laz"]
    assert (state.first.name, state.first.size, state.new) == (DAY, 11, 0)


def test_every_file_that_comes_begins_the_pause_anew(poll, drop):
    poll, clock, _ = poll
    drop(f"{DAY}/a.laz")
    poll()
    clock.s += 599
    drop(f"{DAY}/b.laz")
    assert poll().first is None
    clock.s += 599
    assert poll().first is None
    clock.s += 1
    assert len(poll().first.parts) == 2


def test_a_late_file_is_a_change_and_a_removed_one_is_none(poll, drop):
    poll, _, journal = poll
    drop(f"{DAY}/a.laz", time_s=1000)
    drop(f"{DAY}/b.laz", time_s=2000)
    scan = poll("files = 2").first
    journal.record_stored(DAY, sha256="0", verdict="good", epoch="e", start_utc_s=0.0, revision=1)
    assert poll("files = 2").first is None
    scan.parts[0].path.unlink()
    assert poll("files = 2").first is None
    assert journal.entry(DAY).state is State.STORED
    drop(f"{DAY}/a.laz", time_s=1000)
    drop(f"{DAY}/c.laz", time_s=1500)
    assert len(poll("files = 2").first.parts) == 3
    assert journal.entry(DAY).state is State.WAITING


def test_each_file_may_have_a_log_and_a_matrix(read, drop):
    site = read("%Y-%m-%d/*", EPOCH.format(files="")).model_copy(
        update={
            "inclination": InclinationSection(),
            "registration": RegistrationSection(suffix=".dat", sigma_m=0.01, sigma_deg=0.001),
        }
    )
    for name in ("a.laz", "a-incl.txt", "a.dat", "b.laz", "b.dat"):
        drop(f"{DAY}/{name}")
    drop(f"{DAY}/b-incl.txt", "")  # nothing in it yet
    listing = ScanListing(site, site.scans.inbox, (".laz", ".dat"))
    first, second = listing.scan(DAY).parts
    assert (first.log.name, first.matrix.name, second.log, second.matrix.name) == (
        "a-incl.txt", "a.dat", None, "b.dat",
    )  # fmt: skip
    before = listing.identity(DAY)
    drop(f"{DAY}/b-incl.txt", "0,0,0")
    assert ScanListing(site, site.scans.inbox, (".laz", ".dat")).identity(DAY) != before


def test_scans_wait_for_their_matrix(read, drop, tmp_path):
    registration = RegistrationSection(suffix=".dat", sigma_m=0.01, sigma_deg=0.001, wait_s=60)
    site = read("%y%m%d_%H%M%S").model_copy(update={"registration": registration})
    clock = Clock()
    with Journal(tmp_path / "data" / "journal.sqlite") as journal:
        inbox = Inbox(site, journal, (".laz",), monotonic_s=lambda: clock.s)
        drop("261121_010000.laz")
        assert inbox.poll().first is None
        assert journal.entry("261121_010000.laz").waiting_reason == "its registration 261121_010000.dat"
        drop("261121_010000.dat")
        assert inbox.poll().first.matrix == tmp_path / "inbox" / "261121_010000.dat"
        (tmp_path / "inbox" / "261121_010000.dat").unlink()
        inbox.poll()
        clock.s += 60
        assert inbox.poll().first.matrix is None


def test_copies_and_names_do_not_change_the_content(drop):
    first, second = drop("a.laz", "one"), drop("b.laz", "two")
    content = sha256_files([first, second])
    assert sha256_files([second, first, drop("copy.laz", "one")]) == content
    assert distinct_files([first, second, drop("copy.laz", "one")]) == [first, second]
    assert sha256_files([drop("copy.laz", "six"), second]) != content
    assert sha256_files([first]) == sha256_files([first, first]) == hashlib.sha256(b"one").hexdigest()


@pytest.mark.parametrize(
    ("name", "more", "message"),
    [
        ("%Y-%m-%d/../*", "", "folders are those below the inbox"),
        ("/%Y-%m-%d", "", "folders are those below the inbox"),
        ("%Y-%m-%d/%y%m%d_%H%M%S", "", r"field of the time stands twice: put \* for one"),
        ("%Y-%m-%d/*", '[epoch]\nname = "%Y.%m.%d"', "letters, digits, _ and - only"),
        ("%Y-%m-%d/*", '[epoch]\nname = "%H%M"', "must state the year"),
        ("%Y-%m-%d/*", '[registration]\nsuffix = ".dat"\nsigma_m = 1\nsigma_deg = 1', 'none with "map"'),
    ],
)
def test_impossible_patterns_are_refused(read, name, more, message):
    with pytest.raises(ConfigError, match=message):
        read(name, more)


def test_files_of_the_same_ten_minutes_are_one_epoch(read, drop):
    site = read("%y%m%d_%H%M%S", '[epoch]\nname = "%Y%m%d_%H%M"\nwindow_s = 600\n')
    names = ["261121_085959.laz", "261121_090000.laz", "261121_090959.laz", "261121_091000.laz"]
    for name in names:
        drop(name)
    scans = ScanListing(site, site.scans.inbox, (".laz",)).scans
    assert scans == {"20261121_0850": names[:1], "20261121_0900": names[1:3], "20261121_0910": names[3:]}
