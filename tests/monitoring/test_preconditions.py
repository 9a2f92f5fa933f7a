"""Preconditions of processing: free disk space, free inodes, a plausible clock."""

from __future__ import annotations

import os
import time

import pytest

from station.errors import StoreError
from station.monitoring import preconditions
from station.monitoring.preconditions import clock_problem, require_disk_space


class FileSystem:
    """A result of os.statvfs."""

    f_frsize, f_bavail, f_files, f_favail, f_flag = 4096, 10_000_000, 1000, 1000, 0

    def __init__(self, **changes):
        self.__dict__.update(changes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"f_bavail": 1000}, "4 MB free, 16 MB needed"),
        ({"f_favail": 3}, "inodes"),
        ({"f_flag": os.ST_RDONLY}, "read-only"),
    ],
)
def test_lack_of_space_or_inodes_is_an_error(make_site, monkeypatch, changes, message):
    site = make_site()
    require_disk_space(site)
    monkeypatch.setattr(preconditions.os, "statvfs", lambda _: FileSystem(**changes))
    with pytest.raises(StoreError, match=message):
        require_disk_space(site)


def test_file_system_without_inode_count_is_accepted(make_site, monkeypatch):
    """Btrfs reports zero inodes, of which zero are free."""
    site = make_site()
    monkeypatch.setattr(preconditions.os, "statvfs", lambda _: FileSystem(f_files=0, f_favail=0))
    require_disk_space(site)


@pytest.mark.parametrize(
    ("now_s", "message"),
    [(0.0, "1970-01-01"), (1_577_836_799.0, "2019-12-31"), (1_700_000_000.0, "was written at")],
)
def test_implausible_clock_is_reported(tmp_path, now_s, message):
    (tmp_path / "journal.sqlite").touch()
    assert message in clock_problem(tmp_path, now_s)


def test_plausible_clock_is_accepted(tmp_path):
    (tmp_path / "journal.sqlite").touch()
    assert clock_problem(tmp_path, time.time()) is None
