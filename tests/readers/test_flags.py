"""Bad intervals noted by a person, in a file that may be half written."""

import pytest

from station.errors import ConfigError
from station.readers.flags import flag_on, read_flags

HOUR_S = 3600.0
NOON_S = 1_767_268_800.0  # 2026-01-01 12:00 UTC


@pytest.fixture
def flags(tmp_path):
    def write(text):
        path = tmp_path / "flags.csv"
        path.write_text(text)
        return read_flags(path)

    return write


def test_times_are_utc_unless_a_zone_is_written(flags):
    found = flags(
        'from,to,reason\n2026-01-01T12:00,2026-01-01T13:00:00Z,"rime, on the window"\n\n'
        "# a remark\n2026-01-01T14:00+01:00,2026-01-01T14:30+01:00,crane\n"
    )  # fmt: skip
    assert [(one.from_utc_s - NOON_S, one.to_utc_s - NOON_S) for one in found] == [
        (0, HOUR_S),
        (HOUR_S, 1.5 * HOUR_S),
    ]
    assert [one.reason for one in found] == ["rime, on the window", "crane"]


def test_a_scan_is_flagged_where_it_overlaps(flags):
    found = flags(
        "from,to,reason\n2026-01-01 12:00,2026-01-01 13:00,rime\n2026-01-01 12:30,2026-01-01 14:00,crane\n"
    )
    assert flag_on(found, NOON_S - 900, NOON_S - 1) == ""
    assert flag_on(found, NOON_S - 900, NOON_S) == "rime"
    assert flag_on(found, NOON_S + 2000, NOON_S + 2900) == "rime; crane"
    assert flag_on(found, NOON_S + HOUR_S + 1, NOON_S + HOUR_S + 2) == "crane"


@pytest.mark.parametrize(
    ("row", "says"),
    [
        ("2026-01-01,2026-13-01,rime", "line 2"),
        ("2026-01-02,2026-01-01,rime", "ends before it begins"),
        ("2026-01-01,2026-01-02,", "no reason"),
        ("2026-01-01,2026-01-02", "not a row from,to,reason"),
    ],
)
def test_a_row_that_is_none_is_named(flags, row, says):
    with pytest.raises(ConfigError, match=says):
        flags(f"from,to,reason\n{row}\n")


def test_a_last_row_still_being_written_is_left_out_and_a_whole_one_is_not(flags):
    whole = "from,to,reason\n2026-01-01,2026-01-02,rime\n"
    assert len(flags(whole + "2026-02-01,2026-0")) == 1
    assert len(flags(whole + "2026-02-01,2026-02-02,crane")) == 2


def test_another_table_is_no_list_of_flags(flags):
    with pytest.raises(ConfigError, match="must begin with"):
        flags("begin,end,why\n")
    assert flags("") == []
