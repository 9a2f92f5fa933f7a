"""The mirror: its files follow the epochs, and a fault of one stops no other."""

import json

import pytest
from support.epochs import make_epoch

from station.archive.epochs import write_epoch
from station.archive.series.virtual import build_series
from station.config import read_site
from station.errors import ConfigError
from station.inbox.journal import Journal
from station.processing.site_files import series_for
from station.service.mirror import update_mirror

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


@pytest.mark.integration
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


@pytest.mark.integration
def test_a_fault_of_one_format_is_reported_and_the_others_are_renewed(site):
    (site.path.parent / "served").mkdir()
    (site.path.parent / "served" / "test.ncml").write_text("mine")
    assert renew(site).startswith("ncml: ")
    assert "exists and is no export of a station" in renew(site)
    assert (site.path.parent / "served" / "test.xml").exists()


def test_a_folder_that_cannot_be_written_is_a_fault_and_no_error(site):
    (site.path.parent / "served").write_text("a file")
    fault = renew(site)
    assert fault.count("File exists") == 3


def test_a_mirror_in_the_inbox_is_refused(write_site):
    with pytest.raises(ConfigError, match=r"mirror\.folder: .* must not be in the inbox"):
        read_site(write_site(more=MIRROR.replace("served", "inbox/served")))
