"""Raw scans are moved or deleted only if their bytes are stored and verified."""

import shutil

import pytest

from station.config import read_site
from station.errors import ConfigError, NotReadyError, ScanError
from station.inbox.file_hash import sha256_file
from station.inbox.journal import Journal
from station.inbox.journal_reader import State
from station.service import retention
from station.service.retention import apply_retention, expired_scans

NAME = "251121_000000.laz"
START_S = 1_763_683_200.0
EPOCH = "epochs/2025/11/21/test_20251121T000000Z.nc"


@pytest.fixture
def station(tmp_path, write_site):
    """A stored scan with its log; of its epoch only the checksum matters."""
    path = write_site(more='[inclination]\n[retention]\nraw = "move"\nkeep_days = 3\narchive = "old"\n')
    (tmp_path / "inbox" / NAME).write_bytes(b"scan")
    (tmp_path / "inbox" / "251121_000000-incl.txt").write_bytes(b"log")
    (tmp_path / "data" / EPOCH).parent.mkdir(parents=True)
    (tmp_path / "data" / EPOCH).write_bytes(b"epoch")
    with Journal(tmp_path / "data" / "journal.sqlite") as journal:
        journal.record_stored(
            NAME,
            sha256=sha256_file(tmp_path / "inbox" / NAME),
            log_sha256=sha256_file(tmp_path / "inbox" / "251121_000000-incl.txt"),
            verdict="good",
            epoch=EPOCH,
            start_utc_s=START_S,
            revision=1,
            epoch_sha256=sha256_file(tmp_path / "data" / EPOCH),
        )
        yield read_site(path), journal


def apply_to_scan(site, journal):
    """Return the action taken; raise the reason as an error if the scan was kept."""
    ((name, action, reason),) = apply_retention(
        site, [journal.entry(NAME)], journal.checksums(), lambda: None
    )
    assert name == NAME
    if reason:
        raise {"kept": ScanError, "waits": NotReadyError}[action](reason)
    return action


def file_contents(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_scan_and_log_are_moved_to_the_archive(station):
    site, journal = station
    assert apply_to_scan(site, journal) == "moved"
    assert file_contents(site.scans.inbox) == {}
    assert file_contents(site.retention.archive) == {
        f"2025/11/{NAME}": b"scan",
        "2025/11/251121_000000-incl.txt": b"log",
    }


def test_scan_and_log_are_deleted(station, write_site):
    site, journal = station
    site = read_site(write_site(more='[inclination]\n[retention]\nraw = "delete"\n'))
    assert apply_to_scan(site, journal) == "deleted"
    assert file_contents(site.scans.inbox) == {}


@pytest.mark.parametrize(
    ("damaged", "message"),
    [
        ("scan", "not the one that was stored"),
        ("log", "not the one it was measured with"),
        ("epoch", "missing or damaged"),
        ("no epoch", "missing or damaged"),
        ("no checksum", "missing or damaged"),
        ("archive", "holds other bytes"),
    ],
)
def test_unverified_scan_is_kept(station, damaged, message):
    site, journal = station
    if damaged == "scan":
        (site.scans.inbox / NAME).write_bytes(b"others")
    elif damaged == "log":
        (site.scans.inbox / "251121_000000-incl.txt").write_bytes(b"others")
    elif damaged == "epoch":
        (site.station.data / EPOCH).write_bytes(b"epocH")
    elif damaged == "no epoch":
        (site.station.data / EPOCH).unlink()
    elif damaged == "no checksum":
        journal.drop_checksums([EPOCH])
    else:
        (site.retention.archive / "2025" / "11").mkdir(parents=True)
        (site.retention.archive / "2025" / "11" / NAME).write_bytes(b"another scan")
    before = file_contents(site.scans.inbox)
    with pytest.raises(ScanError, match=message):
        apply_to_scan(site, journal)
    assert file_contents(site.scans.inbox) == before


def test_corrupted_copy_keeps_the_original(station, monkeypatch):
    site, journal = station

    def corrupting_copy(path, target, **_):
        target.write_bytes(path.read_bytes()[:-1] + b"?")

    monkeypatch.setattr(shutil, "copyfile", corrupting_copy)
    before = file_contents(site.scans.inbox)
    with pytest.raises(ScanError, match="disk failing"):
        apply_to_scan(site, journal)
    assert file_contents(site.scans.inbox) == before
    assert file_contents(site.retention.archive) == {}


def test_interrupted_move_is_completed(station):
    """The process was killed between copy and deletion."""
    site, journal = station
    folder = site.retention.archive / "2025" / "11"
    folder.mkdir(parents=True)
    shutil.copy(site.scans.inbox / NAME, folder / NAME)
    assert apply_to_scan(site, journal) == "moved"


def test_read_only_inbox_is_reported_with_a_remedy(station, monkeypatch):
    site, journal = station
    monkeypatch.setattr("os.access", lambda *_: False)
    with pytest.raises(NotReadyError, match="ReadWritePaths="):
        apply_to_scan(site, journal)


def test_compacted_file_is_hashed_once(station, monkeypatch):
    """A month on a large grid is 20 GB; a scan that is kept does not block the others."""
    site, journal = station
    names = ["251121_000001.laz", "251121_000002.laz", NAME]
    for name in names[:2]:
        (site.scans.inbox / name).write_bytes(name.encode())
        journal.record_stored(
            name,
            sha256=sha256_file(site.scans.inbox / name),
            verdict="good",
            epoch=EPOCH,
            start_utc_s=START_S,
            revision=1,
        )
    (site.scans.inbox / names[0]).write_bytes(b"others")
    read = []
    monkeypatch.setattr(retention, "sha256_file", lambda path: read.append(path.name) or sha256_file(path))
    entries = [journal.entry(name) for name in names]
    actions = apply_retention(site, entries, journal.checksums(), lambda: None)
    assert [(name, action) for name, action, _ in actions] == list(
        zip(names, ("kept", "moved", "moved"), strict=True)
    )
    assert read.count(EPOCH.rpartition("/")[2]) == 1


def test_expiry_by_age_action_and_reservation(station, write_site):
    site, journal = station
    store = {"sha256": "bb", "verdict": "good", "epoch": "epochs/b.nc", "revision": 1}
    journal.record_stored("b.laz", start_utc_s=START_S + 3.5 * 86_400, **store)
    stored = journal.rows(State.STORED)
    assert expired_scans(site, stored, set(), START_S + 3 * 86_400 - 1) == []
    now_s = START_S + 3 * 86_400 + 1
    assert expired_scans(site, stored, {NAME}, now_s) == [NAME]  # moved scans can still be read
    delete = read_site(write_site(more='[retention]\nraw = "delete"\nkeep_days = 3\n'))
    assert expired_scans(delete, stored, {NAME}, now_s) == []
    assert expired_scans(delete, stored, set(), now_s) == [NAME]
    assert expired_scans(read_site(write_site()), stored, set(), now_s) == []
    journal.requeue([NAME])
    assert expired_scans(site, journal.rows(), set(), now_s) == []


def test_clock_far_ahead_expires_nothing(station):
    site, journal = station
    assert expired_scans(site, journal.rows(), set(), START_S + 1e9) == []


def test_moving_requires_an_archive_folder(write_site):
    with pytest.raises(ConfigError, match="needs archive"):
        read_site(write_site(more='[retention]\nraw = "move"\n'))
