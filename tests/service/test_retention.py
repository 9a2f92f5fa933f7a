"""Raw scans are let go only when their very bytes are stored and proved."""

import shutil

import pytest

from station.config import read_site
from station.errors import ConfigError, NotReadyError, ScanError
from station.service import retention
from station.service.content import sha256_of
from station.service.journal import Journal, State
from station.service.retention import due_to_go, retire

NAME = "251121_000000.laz"
START_S = 1_763_683_200.0
EPOCH = "epochs/2025/11/21/test_20251121T000000Z.nc"


@pytest.fixture
def station(tmp_path, write_site):
    """A stored scan with its log, and an epoch of which only the checksum matters."""
    path = write_site(more='[inclination]\n[retention]\nraw = "move"\nkeep_days = 3\narchive = "old"\n')
    (tmp_path / "inbox" / NAME).write_bytes(b"scan")
    (tmp_path / "inbox" / "251121_000000-incl.txt").write_bytes(b"log")
    (tmp_path / "data" / EPOCH).parent.mkdir(parents=True)
    (tmp_path / "data" / EPOCH).write_bytes(b"epoch")
    with Journal(tmp_path / "data" / "journal.sqlite") as journal:
        journal.stored(
            NAME,
            sha256=sha256_of(tmp_path / "inbox" / NAME),
            log_sha256=sha256_of(tmp_path / "inbox" / "251121_000000-incl.txt"),
            verdict="good",
            epoch=EPOCH,
            start_utc_s=START_S,
            revision=1,
            epoch_sha256=sha256_of(tmp_path / "data" / EPOCH),
        )
        yield read_site(path), journal


def let_go(site, journal):
    """What was done with the scan; raises what it says where that is nothing."""
    ((name, done, why),) = retire(site, [journal.entry(NAME)], journal.files(), lambda: None)
    assert name == NAME
    if why:
        raise {"kept": ScanError, "waits": NotReadyError}[done](why)
    return done


def everything(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_scan_and_its_log_are_moved(station):
    site, journal = station
    assert let_go(site, journal) == "moved"
    assert everything(site.scans.inbox) == {}
    assert everything(site.retention.archive) == {
        f"2025/11/{NAME}": b"scan",
        "2025/11/251121_000000-incl.txt": b"log",
    }


def test_or_deleted(station, write_site):
    site, journal = station
    site = read_site(write_site(more='[inclination]\n[retention]\nraw = "delete"\n'))
    assert let_go(site, journal) == "deleted"
    assert everything(site.scans.inbox) == {}


@pytest.mark.parametrize(
    ("what", "says"),
    [
        ("scan", "not the one that was stored"),
        ("log", "not the one it was measured with"),
        ("epoch", "missing or damaged"),
        ("no epoch", "missing or damaged"),
        ("no checksum", "missing or damaged"),
        ("archive", "holds other bytes"),
    ],
)
def test_nothing_goes_that_is_not_proved(station, what, says):
    site, journal = station
    if what == "scan":
        (site.scans.inbox / NAME).write_bytes(b"others")
    elif what == "log":
        (site.scans.inbox / "251121_000000-incl.txt").write_bytes(b"others")
    elif what == "epoch":
        (site.station.data / EPOCH).write_bytes(b"epocH")
    elif what == "no epoch":
        (site.station.data / EPOCH).unlink()
    elif what == "no checksum":
        journal.forget_files([EPOCH])
    else:
        (site.retention.archive / "2025" / "11").mkdir(parents=True)
        (site.retention.archive / "2025" / "11" / NAME).write_bytes(b"another scan")
    before = everything(site.scans.inbox)
    with pytest.raises(ScanError, match=says):
        let_go(site, journal)
    assert everything(site.scans.inbox) == before


def test_a_copy_that_reads_otherwise_is_not_trusted(station, monkeypatch):
    site, journal = station

    def rot(path, place, **_):
        place.write_bytes(path.read_bytes()[:-1] + b"?")

    monkeypatch.setattr(shutil, "copyfile", rot)
    before = everything(site.scans.inbox)
    with pytest.raises(ScanError, match="disk failing"):
        let_go(site, journal)
    assert everything(site.scans.inbox) == before
    assert everything(site.retention.archive) == {}


def test_what_was_half_done_is_done(station):
    """Killed between the copy and the deletion."""
    site, journal = station
    folder = site.retention.archive / "2025" / "11"
    folder.mkdir(parents=True)
    shutil.copy(site.scans.inbox / NAME, folder / NAME)
    assert let_go(site, journal) == "moved"


def test_an_inbox_that_may_not_be_written_says_what_to_do(station, monkeypatch):
    site, journal = station
    monkeypatch.setattr("os.access", lambda *_: False)
    with pytest.raises(NotReadyError, match="ReadWritePaths="):
        let_go(site, journal)


def test_a_file_that_holds_many_epochs_is_read_once(station, monkeypatch):
    """A month on a large grid is 20 GB; one scan that is kept does not keep the others."""
    site, journal = station
    names = ["251121_000001.laz", "251121_000002.laz", NAME]
    for name in names[:2]:
        (site.scans.inbox / name).write_bytes(name.encode())
        journal.stored(
            name,
            sha256=sha256_of(site.scans.inbox / name),
            verdict="good",
            epoch=EPOCH,
            start_utc_s=START_S,
            revision=1,
        )
    (site.scans.inbox / names[0]).write_bytes(b"others")
    read = []
    monkeypatch.setattr(retention, "sha256_of", lambda path: read.append(path.name) or sha256_of(path))
    entries = [journal.entry(name) for name in names]
    told = retire(site, entries, journal.files(), lambda: None)
    assert [(name, done) for name, done, _ in told] == list(
        zip(names, ("kept", "moved", "moved"), strict=True)
    )
    assert read.count(EPOCH.rpartition("/")[2]) == 1


def test_when_a_scan_is_due_to_go(station, write_site, monkeypatch):
    site, journal = station
    store = {"sha256": "bb", "verdict": "good", "epoch": "epochs/b.nc", "revision": 1}
    journal.stored("b.laz", start_utc_s=START_S + 3.5 * 86_400, **store)
    stored = journal.rows(State.STORED)
    monkeypatch.setattr("time.time", lambda: START_S + 3 * 86_400 - 1)
    assert due_to_go(site, stored, set()) == []
    monkeypatch.setattr("time.time", lambda: START_S + 3 * 86_400 + 1)
    assert due_to_go(site, stored, {NAME}) == [NAME]  # what is moved can still be read
    delete = read_site(write_site(more='[retention]\nraw = "delete"\nkeep_days = 3\n'))
    assert due_to_go(delete, stored, {NAME}) == []
    assert due_to_go(delete, stored, set()) == [NAME]
    assert due_to_go(read_site(write_site()), stored, set()) == []
    journal.again([NAME])
    assert due_to_go(site, journal.rows(), set()) == []


def test_a_clock_far_ahead_lets_nothing_go(station, monkeypatch):
    site, journal = station
    monkeypatch.setattr("time.time", lambda: START_S + 1e9)
    assert due_to_go(site, journal.rows(), set()) == []


def test_moving_needs_a_place(write_site):
    with pytest.raises(ConfigError, match="needs archive"):
        read_site(write_site(more='[retention]\nraw = "move"\n'))
