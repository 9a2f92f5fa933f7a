"""`station check` names what lies in an inbox unread, and the lines that let it in."""

import pytest

from station.operations.inbox_contents import inbox_findings
from station.sections.inputs import EpochSection


@pytest.fixture
def findings(make_site):
    site = make_site()

    def find(*names):
        for name in names:
            path = site.scans.inbox / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch()
        return [message for _, message in inbox_findings(site)]

    return find


def with_pattern(site, pattern):
    return site.model_copy(update={"scans": site.scans.model_copy(update={"name": pattern})})


def test_an_inbox_with_scans_only_has_no_findings(findings):
    assert findings("250715_090000.laz", "250715_090000.png", "notes.txt", ".hidden.rxp") == []


def test_formats_that_need_a_command_are_named_with_their_lines(findings):
    (message,) = findings(*[f"2507{day:02d}_090000.rxp" for day in range(1, 32)])
    assert message.startswith('31 .rxp files are not read: [scans] suffix = ".rxp" and convert = ["pdal"')


def test_text_files_without_other_scans_may_be_scans(findings):
    (message,) = findings("250715_090000.csv", "250715_100000.csv")
    assert '2 .csv files are not read: [scans] suffix = ".csv"' in message
    assert findings("250715_090000.laz") == []


@pytest.mark.parametrize(
    ("names", "pattern"),
    [
        (("2025-07-15/250715_090000.laz", "2025-07-16/250716_090000.laz"), "*/%y%m%d_%H%M%S"),
        (("ScanPos001.SCNPOS/scans/250715_100000.laz",), "*/*/%y%m%d_%H%M%S"),
        (("2025-07-15/ScanPos001.laz", "2025-07-16/ScanPos001.laz"), "%Y-%m-%d/*"),
        (("20250715_hut.PROJ/ScanPos001.SCNPOS/scans/a.laz",), "*%Y%m%d*/*/*/*"),
    ],
)
def test_a_pattern_with_folders_is_proposed(findings, make_site, names, pattern):
    (message,) = findings(*names)
    assert f"such as {names[0]}, are not read: they are looked for in the inbox itself" in message
    assert f'name = "{pattern}" would' in message
    assert list(inbox_findings(with_pattern(make_site(), pattern))) == []


def test_scans_elsewhere_than_in_the_folders_of_the_pattern_are_named(make_site):
    site = with_pattern(make_site(), "%Y-%m-%d/*")
    (site.scans.inbox / "250715_090000.laz").touch()
    ((_, message),) = inbox_findings(site)
    assert "1 scans, such as 250715_090000.laz, are not read: they are looked for in folders of" in message


def test_files_with_the_same_start_may_be_one_epoch(findings, make_site):
    (message,) = findings("250715_090000.laz", "250715_090000.las", "250715_100000.laz")
    assert 'have the same start: such files are one epoch with [epoch] name = "%Y%m%d_%H%M%S"' in message
    site = make_site()
    epoch = EpochSection(name="%Y%m%d_%H%M%S")
    assert list(inbox_findings(site.model_copy(update={"epoch": epoch}))) == []


@pytest.mark.parametrize(
    ("name", "pattern"),
    [
        ("20250715_090000.laz", "%Y%m%d_%H%M%S"),
        ("ScanPos012_250715_090000.laz", "*%y%m%d_%H%M%S"),
        ("hut_2025-07-15_09-00-00.laz", "*%Y-%m-%d_%H-%M-%S"),
        ("20250715_0900_scan.laz", "*%Y%m%d_%H%M*"),
        ("Hut scan 2025-07-15 09-00-00.laz", "*%Y-%m-%d %H-%M-%S"),
    ],
)
def test_a_pattern_for_other_names_is_proposed(findings, name, pattern):
    (message,) = findings(name)
    assert f'do not match name = "%y%m%d_%H%M%S": name = "{pattern}" would' in message


def test_names_without_a_time_are_named(findings):
    (message,) = findings("scan1.laz")
    assert "the start of scan1 must be in it" in message
