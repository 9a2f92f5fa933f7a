"""Flags: intervals marked as unusable by a person, in a file that may be incomplete."""

import pytest

from station.errors import ConfigError
from station.readers.flags import read_flags, reasons_for

HOUR_S = 3600.0
NOON_S = 1_767_268_800.0  # 2026-01-01 12:00 UTC


@pytest.fixture
def flags(tmp_path):
    def write(text):
        path = tmp_path / "flags.csv"
        path.write_text(text)
        return read_flags(path)

    return write


def test_times_are_utc_unless_a_zone_is_given(flags):
    rows = flags(
        'from,to,reason\n2026-01-01T12:00,2026-01-01T13:00:00Z,"rime, on the window"\n\n'
        "# a remark\n2026-01-01T14:00+01:00,2026-01-01T14:30+01:00,crane\n"
    )  # fmt: skip
    assert [(flag.from_utc_s - NOON_S, flag.to_utc_s - NOON_S) for flag in rows] == [
        (0, HOUR_S),
        (HOUR_S, 1.5 * HOUR_S),
    ]
    assert [flag.reason for flag in rows] == ["rime, on the window", "crane"]


def test_scan_is_flagged_if_it_overlaps_an_interval(flags):
    rows = flags(
        "from,to,reason\n2026-01-01 12:00,2026-01-01 13:00,rime\n2026-01-01 12:30,2026-01-01 14:00,crane\n"
    )
    assert reasons_for(rows, NOON_S - 900, NOON_S - 1) == ""
    assert reasons_for(rows, NOON_S - 900, NOON_S) == "rime"
    assert reasons_for(rows, NOON_S + 2000, NOON_S + 2900) == "rime; crane"
    assert reasons_for(rows, NOON_S + HOUR_S + 1, NOON_S + HOUR_S + 2) == "crane"


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("2026-01-01,2026-13-01,rime", "line 2"),
        ("2026-01-02,2026-01-01,rime", "ends before it begins"),
        ("2026-01-01,2026-01-02,", "no reason"),
        ("2026-01-01,2026-01-02", "not a row from,to,reason"),
    ],
)
def test_invalid_row_is_rejected(flags, row, message):
    with pytest.raises(ConfigError, match=message):
        flags(f"from,to,reason\n{row}\n")


def test_incomplete_last_row_is_ignored(flags):
    complete = "from,to,reason\n2026-01-01,2026-01-02,rime\n"
    assert len(flags(complete + "2026-02-01,2026-0")) == 1
    assert len(flags(complete + "2026-02-01,2026-02-02,crane")) == 2


def test_other_columns_are_rejected(flags):
    with pytest.raises(ConfigError, match="must begin with"):
        flags("begin,end,why\n")
    assert flags("") == []
