"""The mirror: renewed with new epochs, in the background; its faults are reported and stop nothing."""

import json
import time

import pytest
from support.epochs import make_epoch

from station.archive.epochs import write_epoch
from station.archive.series.virtual import build_series
from station.config import read_site
from station.errors import ConfigError
from station.inbox.journal import Journal
from station.monitoring.status import queue_status
from station.processing.site_files import series_for
from station.service.host import Host
from station.service.mirror import BackgroundMirror, update_mirror
from station.service.worker import Worker

MIRROR = """
[mirror]
folder = "served"
url = "https://data.example.org/hef"
formats = ["references", "ncml", "erddap"]
"""


def store(site, *hours):
    for hour in hours:
        series = series_for(site)
        write_epoch(series, make_epoch(hour, grid=series.grid))
        build_series(series)


@pytest.fixture
def site(write_site):
    site = read_site(write_site(more=MIRROR))
    store(site, 1, 2)
    Journal(site.station.data / "journal.sqlite").close()
    return site


def renew(site):
    return update_mirror(site, lambda: None)


def test_the_files_of_the_mirror_follow_the_epochs(site):
    assert renew(site) == ""
    folder = site.path.parent / "served"
    assert sorted(path.name for path in folder.iterdir()) == [
        "test.ncml", "test.xml", "test_20251121.json",
    ]  # fmt: skip
    first = folder / "test_20251121.json"
    refs = json.loads(first.read_text())["refs"]
    assert refs["elevation_change/1.0.0"][0] == (
        "https://data.example.org/hef/epochs/2025/11/21/test_20251121T020000Z.nc"
    )
    inode = first.stat().st_ino
    store(site, 26)
    assert renew(site) == ""
    assert first.stat().st_ino == inode
    assert (folder / "test_20251122.json").exists()
    assert (folder / "test.ncml").read_text().count("ncoords=") == 3
    assert not [path for path in folder.iterdir() if path.name.startswith(".")]


def test_a_fault_of_one_format_is_told_and_the_others_are_renewed(site):
    (site.path.parent / "served").mkdir()
    (site.path.parent / "served" / "test.ncml").write_text("mine")
    assert renew(site).startswith("ncml: ")
    assert "exists and is no export of a station" in renew(site)
    assert (site.path.parent / "served" / "test.xml").exists()


def test_a_folder_that_cannot_be_written_is_a_fault_and_no_error(site):
    (site.path.parent / "served").write_text("a file")
    fault = renew(site)
    assert fault.count("File exists") == 3


class Mirror:
    """Finishes at once with the faults that it is given."""

    def __init__(self, *faults):
        self.faults, self.started = list(faults), 0

    def start(self):
        self.started += 1
        return True

    def result(self):
        return self.faults.pop(0) if self.faults else None

    def close(self):
        pass


def test_the_service_tells_a_fault_once_and_shows_it_until_it_is_gone(site, caplog):
    caplog.set_level("INFO")
    with Journal(site.station.data / "journal.sqlite") as journal:
        worker = Worker(site, journal)
        worker._mirror.close()
        worker._mirror = mirror = Mirror("disk full", "disk full")
        worker.update_mirror()
        worker.update_mirror()
        assert mirror.started == 1  # nothing was stored since
        assert caplog.text.count("mirror=failed") == 1
        assert "the mirror is not up to date: disk full" in queue_status(site)["faults"]
        mirror.faults = [""]
        worker.update_mirror()
        assert "mirror=renewed" in caplog.text
        assert not [fault for fault in queue_status(site)["faults"] if "mirror" in fault]
        worker.close()


def test_without_a_mirror_nothing_is_started(write_site):
    plain = read_site(write_site())
    with Journal(plain.station.data / "journal.sqlite") as journal:
        worker = Worker(plain, journal)
        store(plain, 1)
        worker.update_mirror()
        assert worker._mirror.result() is None
        assert worker._mirror.start()  # none was running
        worker.close()


def test_a_mirror_in_the_inbox_is_refused(write_site):
    with pytest.raises(ConfigError, match=r"mirror\.folder: .* must not be in the inbox"):
        read_site(write_site(more=MIRROR.replace("served", "inbox/served")))


@pytest.mark.integration
def test_the_mirror_is_renewed_in_a_process_of_its_own(site):
    mirror = BackgroundMirror(replace_memory(site), Host())
    assert mirror.start()
    assert not mirror.start()  # while it runs
    deadline_s = time.monotonic() + 60
    while (fault := mirror.result()) is None:
        assert time.monotonic() < deadline_s
        time.sleep(0.05)
    assert fault == ""
    assert (site.path.parent / "served" / "test_20251121.json").exists()
    mirror.close()


def replace_memory(site):
    """Return the site with the memory that a small task needs."""
    return site.model_copy(update={"service": site.service.model_copy(update={"memory_gb": 2.0})})
