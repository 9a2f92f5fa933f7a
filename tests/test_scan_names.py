"""Stems of scan files, and starts in their names."""

from datetime import UTC, datetime
from pathlib import Path

import pytest
from pydantic import ValidationError

from station.scan_names import (
    epoch_name,
    folder_depth,
    name_below,
    resolution_s,
    scan_id,
    scan_stem,
    start_in_name,
)
from station.sections.inputs import EpochSection, ScansSection

START = datetime(2025, 7, 15, 9, 0, 5, tzinfo=UTC)


@pytest.mark.parametrize(
    ("name", "stem"),
    [
        ("250715_090000.laz", "250715_090000"),
        ("a/b/250715_090000.laz.gz", "250715_090000"),
        ("250715_090000.COPC.LAZ", "250715_090000"),
        ("250715_090000.copc.laz.gz", "250715_090000"),
        ("a.b.laz", "a.b"),
        ("250715_090000", "250715_090000"),
    ],
)
def test_stem_is_the_name_without_all_suffixes(name, stem):
    assert scan_stem(name) == stem


@pytest.mark.parametrize(
    ("name", "pattern"),
    [
        ("250715_090005.laz", "%y%m%d_%H%M%S"),
        ("ScanPos001_250715_090005.laz", "*_%y%m%d_%H%M%S"),
        ("ScanPos001_250715_090005.laz", "ScanPos*_%y%m%d_%H%M%S"),
        ("hut 20250715T090005 v2.laz", "*%Y%m%dT%H%M%S*"),
        ("1_20250715_2_090005.laz", "*_%Y%m%d_*_%H%M%S"),
        ("Jul-15-2025_090005.laz", "%b-%d-%Y_%H%M%S"),
        ("a+15Jul25_090005.laz", "*+%d%b%y_%H%M%S"),
        ("250715_110005.laz", "%y%m%d_%H%M%S@Europe/Vienna"),
        ("250715_110005+0200.laz", "%y%m%d_%H%M%S%z@America/New_York"),
        ("/srv/hut/2025-07-15/250715_090005.laz", "*/%y%m%d_%H%M%S"),
        ("2025/07/15/090005.laz", "%Y/%m/%d/%H%M%S"),
        ("ScanPos001.SCNPOS/scans/250715_090005.rxp", "ScanPos*.SCNPOS/scans/%y%m%d_%H%M%S"),
        ("Hu\u0308tte Süd/Höhe 250715_090005.laz", "H\u00fctte Süd/Ho\u0308he %y%m%d_%H%M%S"),
    ],
)
def test_start_is_found_by_patterns_with_wildcards_and_zones(name, pattern):
    assert start_in_name(name, pattern) == START


@pytest.mark.parametrize("name", ["ScanPos001.laz", "Scan_250715_090005.laz", "ScanPos_2507151_090005.laz"])
def test_other_names_have_no_start(name):
    assert start_in_name(name, "ScanPos*_%y%m%d_%H%M%S") is None


def test_summer_time_ends_at_the_hour_that_zones_say():
    pattern = "%y%m%d_%H%M%S@Europe/Vienna"
    starts = [start_in_name(f"251026_0{hour}3000.laz", pattern) for hour in (1, 2, 3)]
    assert [start.hour for start in starts] == [23, 0, 2]  # 02:30 occurs twice: the first is meant


def test_patterns_and_zones_of_the_site_file_are_checked(tmp_path):
    assert ScansSection(inbox=tmp_path, zone="Europe/Vienna").pattern == "%y%m%d_%H%M%S@Europe/Vienna"
    assert ScansSection(inbox=tmp_path, name="*_%y%m%d_%H%M%S").pattern == "*_%y%m%d_%H%M%S"
    for zone in ("Europe/Atlantis", "../etc/passwd", "Europe"):
        with pytest.raises(ValidationError, match="no time zone"):
            ScansSection(inbox=tmp_path, zone=zone)
    assert ScansSection(inbox=tmp_path, suffix="rxp").suffix == ".rxp"
    for suffix in ("", "a/b", "..", ".a.b.c"):
        with pytest.raises(ValidationError, match="no end of a file name"):
            ScansSection(inbox=tmp_path, suffix=suffix)
    with pytest.raises(ValidationError, match="needs suffix"):
        ScansSection(inbox=tmp_path, convert=("pdal", "{in}", "{out}"))
    with pytest.raises(ValidationError, match=r"lacks \{out\}"):
        ScansSection(inbox=tmp_path, suffix=".rxp", convert=("pdal", "{in}"))


def test_a_wildcard_does_not_reach_beyond_a_folder():
    assert start_in_name("a/b/250715_090005.laz", "*/%y%m%d_%H%M%S") == START  # the innermost folder
    assert start_in_name("2025-07-15/b/a.laz", "%Y-%m-%d*/*") is None


@pytest.mark.parametrize(
    ("pattern", "seconds"),
    [("%y%m%d_%H%M%S", 60), ("%y%m%d_%H*", 3600), ("%Y-%m-%d/*@Europe/Vienna", 86_400)],
)
def test_resolution_is_that_of_the_finest_field(pattern, seconds):
    assert resolution_s(pattern) == seconds


def test_names_with_folders_are_unique_without_suffixes():
    assert scan_id("2025-07-15/ScanPos001.laz.gz") == "2025-07-15/ScanPos001"
    assert scan_id("250715_090000.copc.laz") == "250715_090000"
    assert folder_depth("%Y-%m-%d/*@Europe/Vienna") == 1
    assert name_below(Path("/srv/hut/2025-07-15/a.laz"), "%Y-%m-%d/*") == "2025-07-15/a.laz"


def test_names_too_long_for_the_store_stay_apart_in_64_bytes():
    for letter in ("x", "ä", "雪"):
        folders = [f"{letter * 40}{number}.PROJ/ScanPos001.SCNPOS/scans" for number in range(1000)]
        names = [f"{folder}/250715_0900{second:02d}.laz" for folder in folders for second in (0, 1)]
        identifiers = {scan_id(name) for name in names}
        assert len(identifiers) == len(names)
        assert max(len(identifier.encode()) for identifier in identifiers) <= 64
        assert {identifier[-13:] for identifier in identifiers} == {"250715_090000", "250715_090001"}
    assert scan_id("x" * 64 + ".laz") == "x" * 64  # as it is, to the last byte
    assert scan_id("x" * 65 + ".laz") != scan_id("x" * 66 + ".laz")


def test_epochs_are_those_of_the_zone():
    late = datetime(2025, 7, 14, 22, 30, tzinfo=UTC)
    assert epoch_name(late, "%Y-%m-%d@Europe/Vienna") == "2025-07-15"
    assert epoch_name(late, "%Y-%m-%d@UTC") == "2025-07-14"


@pytest.mark.parametrize(
    ("name", "pattern", "window_s", "expected"),
    [
        ("250715_095959.laz", "%Y%m%d_%H%M", 600, "20250715_0950"),
        ("250715_100000.laz", "%Y%m%d_%H%M", 600, "20250715_1000"),
        ("250715_235959.laz", "%Y%m%d_%H", 3 * 3600, "20250715_21"),
        ("250715_000000.laz", "%Y-%m-%d", 86_400, "2025-07-15"),
        ("250715_101730.laz", "%Y%m%d_%H%M%S", 15, "20250715_101730"),
        ("250715_215900.laz", "%Y%m%d_%H@Europe/Vienna", 4 * 3600, "20250715_20"),  # 23:59 there
        ("250715_220100.laz", "%Y%m%d_%H@Europe/Vienna", 4 * 3600, "20250716_00"),
    ],
)
def test_windows_of_an_epoch_are_counted_from_midnight(name, pattern, window_s, expected):
    start = start_in_name(name, "%y%m%d_%H%M%S")
    assert epoch_name(start, pattern, window_s) == expected
    assert start_in_name(expected, pattern) <= start


@pytest.mark.parametrize(
    ("values", "fault"),
    [
        ({"name": "%Y%m%d_%H%M", "window_s": 700}, "must divide a day"),
        ({"name": "%Y%m%d_%H", "window_s": 600}, "tell all windows of a day apart"),
        ({"name": "%Y%m%d_%H", "window_s": 0}, "greater than or equal to 1"),
    ],
)
def test_windows_that_cannot_be_are_refused(values, fault):
    with pytest.raises(ValidationError, match=fault):
        EpochSection(**values)
