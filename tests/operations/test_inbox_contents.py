"""`station check` names what lies in an inbox unread, and the lines that let it in."""

import pytest

from station.operations.inbox_contents import inbox_findings


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


def test_an_inbox_with_scans_only_has_no_findings(findings):
    assert findings("250715_090000.laz", "250715_090000.png", "notes.txt", ".hidden.rxp") == []


def test_formats_that_need_a_command_are_named_with_their_lines(findings):
    (message,) = findings(*[f"2507{day:02d}_090000.rxp" for day in range(1, 32)])
    assert message.startswith('31 .rxp files are not read: [scans] suffix = ".rxp" and convert = ["pdal"')


def test_text_files_without_other_scans_may_be_scans(findings):
    (message,) = findings("250715_090000.csv", "250715_100000.csv")
    assert '2 .csv files are not read: [scans] suffix = ".csv"' in message
    assert findings("250715_090000.laz") == []


def test_scans_in_folders_below_are_named(findings):
    (message,) = findings("2025-07-15/250715_090000.laz", "ScanPos001.SCNPOS/scans/250715_100000.laz")
    assert "2 scans lie in folders below it, such as 2025-07-15/250715_090000.laz" in message


@pytest.mark.parametrize(
    ("name", "pattern"),
    [
        ("20250715_090000.laz", "%Y%m%d_%H%M%S"),
        ("ScanPos012_250715_090000.laz", "*%y%m%d_%H%M%S"),
        ("hut_2025-07-15_09-00-00.laz", "*%Y-%m-%d_%H-%M-%S"),
        ("20250715_0900_scan.laz", "*%Y%m%d_%H%M*"),
    ],
)
def test_a_pattern_for_other_names_is_proposed(findings, name, pattern):
    (message,) = findings(name)
    assert f'do not match name = "%y%m%d_%H%M%S": name = "{pattern}" would' in message


def test_names_without_a_time_are_named(findings):
    (message,) = findings("scan1.laz")
    assert "the start of scan1 must be in it" in message
