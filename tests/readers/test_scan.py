"""Which reader, and when a scan was made."""

import logging
from datetime import UTC, datetime, timedelta
from importlib.metadata import EntryPoint

import numpy as np
import pytest

from station.errors import NotReadyError, ScanError
from station.readers import scan
from station.readers.scan import (
    TimeKind,
    gps_seconds,
    gps_to_utc,
    open_scan,
    require_begun,
    time_kind,
    utc_interval,
)

NAMED = "%y%m%d_%H%M%S"
START = datetime(2024, 10, 1, 12, 0, 0, tzinfo=UTC)
# worked out by date(1) and the 18 s of IERS Bulletin C: 1727784000 - 315964800 + 18
START_GPS_S = 1_411_819_218.0
START_WEEK_S = 216_018.0  # a Tuesday noon: 2.5 days and the leap seconds
START_STANDARD_S = 411_819_218.0


@pytest.mark.parametrize(
    ("when", "gps_s"),
    [
        (START, START_GPS_S),
        (datetime(2011, 9, 14, 1, 46, 25, tzinfo=UTC), 1e9),  # the zero of adjusted standard GPS time
        (datetime(2016, 12, 31, 23, 59, 59, tzinfo=UTC), 1_167_264_016.0),  # the last leap second
        (datetime(2017, 1, 1, tzinfo=UTC), 1_167_264_018.0),
    ],
)
def test_gps_time_counts_leap_seconds(when, gps_s):
    assert gps_seconds(when) == gps_s
    assert gps_to_utc(gps_s) == when


def test_no_date_before_there_were_scanners():
    with pytest.raises(ScanError, match="check the clocks"):
        gps_seconds(datetime(1990, 1, 1, tzinfo=UTC))
    with pytest.raises(ScanError, match="corrupt"):
        gps_to_utc(1e20)


@pytest.mark.parametrize(
    ("first_s", "start", "standard", "kind"),
    [
        (0.0, START, False, TimeKind.SCANNER),
        (91.8, START, False, TimeKind.SCANNER),
        (91.8, START, True, TimeKind.SCANNER),  # the flag of many writers, whatever they write
        (91.8, None, True, TimeKind.SCANNER),
        (START_WEEK_S + 3, START, False, TimeKind.WEEK),
        (START_WEEK_S + 3, START, True, TimeKind.WEEK),
        (START_WEEK_S - 86_400, START, False, TimeKind.SCANNER),
        (START_STANDARD_S + 3, START, True, TimeKind.STANDARD),
        (START_STANDARD_S + 3, START, False, TimeKind.STANDARD),
        (START_STANDARD_S + 3, None, False, TimeKind.STANDARD),
        (START_STANDARD_S - 30 * 86_400, START, False, TimeKind.STANDARD),  # clocks a month apart
        (-2e7, None, True, TimeKind.STANDARD),  # before September 2011
    ],
)
def test_the_kind_of_time_is_seen_in_the_numbers(first_s, start, standard, kind):
    assert time_kind(first_s, first_s + 900, start, standard=standard) is kind


def test_stamps_all_zero_are_none():
    assert time_kind(0.0, 0.0, START, standard=True) is TimeKind.NONE


def test_a_week_that_ends_is_still_the_week():
    sunday = datetime(2024, 10, 5, 23, 59, 45, tzinfo=UTC)  # the GPS week began 18 s before midnight
    assert time_kind(3.2, 900.0, sunday, standard=False) is TimeKind.WEEK
    assert time_kind(604_799.0, 605_700.0, sunday - timedelta(seconds=4), standard=False) is TimeKind.WEEK


def times(first_s, count=100):
    return first_s + np.arange(count) * 9.0


def made(write_scan, name, first_s, **how):
    points_m = np.random.default_rng(0).normal(size=(3, 100))
    return write_scan(name, points_m, None if first_s is None else times(first_s), **how)


@pytest.mark.parametrize(
    ("first_s", "kind", "lasts_s"),
    [
        (None, TimeKind.NONE, 0.0),
        (40.0, TimeKind.SCANNER, 891.0),
        (START_WEEK_S, TimeKind.WEEK, 891.0),
        (START_STANDARD_S, TimeKind.STANDARD, 891.0),
    ],
)
def test_the_name_tells_the_start_and_the_stamps_the_end(write_scan, first_s, kind, lasts_s):
    with open_scan(made(write_scan, "241001_120000.laz", first_s)) as reader:
        start, end, found = utc_interval(reader, NAMED)
    assert (start, found) == (START, kind)
    assert (end - start).total_seconds() == pytest.approx(lasts_s)


def test_absolute_stamps_stand_in_for_the_name(write_scan):
    with open_scan(made(write_scan, "flight.laz", START_STANDARD_S, standard=True)) as reader:
        assert utc_interval(reader, NAMED)[0] == START


@pytest.mark.parametrize("first_s", [None, 40.0, START_WEEK_S])
def test_an_unknown_start_says_what_to_do(write_scan, first_s):
    with (
        open_scan(made(write_scan, "noon.laz", first_s)) as reader,
        pytest.raises(ScanError, match=r"does not match scans\.name = '%y%m%d_%H%M%S'"),
    ):
        utc_interval(reader, NAMED)


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("241001_140000.laz", r"local time \(UTC\+2 h\)"),
        ("241001_070100.laz", r"local time \(UTC-5 h\)"),
        ("240901_120000.laz", "check the scanner's clock"),
        ("241001_123000.laz", "check the scanner's clock"),
    ],
)
def test_a_name_that_contradicts_gps_is_refused(write_scan, name, hint):
    with (
        open_scan(made(write_scan, name, START_STANDARD_S)) as reader,
        pytest.raises(ScanError, match=hint),
    ):
        utc_interval(reader, NAMED)


def test_a_scan_from_the_future_is_held_back():
    now_s = START.timestamp()
    require_begun(START, now_s)
    require_begun(START + timedelta(minutes=14), now_s)  # clocks differ, and names are rounded
    with pytest.raises(NotReadyError, match=r"begins at 2024-10-01 12:16:00 UTC, 0:16:00 ahead of this"):
        require_begun(START + timedelta(minutes=16), now_s)


def test_time_stamps_that_no_calendar_reaches_are_refused(write_scan):
    points_m, time_s = np.random.default_rng(0).normal(size=(3, 100)), times(40.0)
    time_s[-1] = 1e300
    with (
        open_scan(write_scan("241001_120000.laz", points_m, time_s)) as reader,
        pytest.raises(ScanError, match="no scan lasts so long"),
    ):
        utc_interval(reader, NAMED)


def test_a_zone_in_the_name_is_heeded(write_scan):
    with open_scan(made(write_scan, "241001_140000+0200.laz", 40.0)) as reader:
        assert utc_interval(reader, NAMED + "%z")[0] == START


def test_a_real_flight_dates_itself(shared_data):
    with open_scan(shared_data / "als/coromandel_points.laz") as reader:
        start, end, kind = utc_interval(reader, NAMED)
    assert kind is TimeKind.STANDARD
    assert start.date().isoformat() == "2024-04-27"
    assert 0 < (end - start).total_seconds() < 3600


def test_las_is_built_in(a_sweep):
    assert {".las", ".laz"} <= set(scan.suffixes())
    with open_scan(a_sweep("UPPER.LAZ", 100)) as reader:
        assert reader.header.point_count == 100


def test_an_unknown_suffix_names_the_known(tmp_path):
    with pytest.raises(ScanError, match=r"no reader for '\.rxp': \.las, \.laz"):
        open_scan(tmp_path / "scan.rxp")


class DotReader:
    suffixes = (".dot",)

    def __init__(self, path, *, range_max_m=None):
        raise RuntimeError(f"cannot make sense of {path.name} within {range_max_m}")


@pytest.fixture
def plugged_in(monkeypatch):
    """Plug in by entry point, as an installed package would."""

    def plug(**values):
        entries = [EntryPoint(name, value, "station.readers") for name, value in values.items()]
        monkeypatch.setattr(scan, "entry_points", lambda **_: entries)
        scan._readers.cache_clear()

    yield plug
    scan._readers.cache_clear()


def test_a_broken_plug_in_disables_only_itself(plugged_in, caplog, a_sweep):
    plugged_in(
        absent="no.such.module:Reader",
        hollow="station.errors:ScanError",
        las="station.readers.las:LasScan",
    )
    with caplog.at_level(logging.WARNING):
        assert scan.suffixes() == (".las", ".laz")
    assert "absent" in caplog.text
    assert "hollow" in caplog.text
    assert open_scan(a_sweep("s.las", 10)).header.point_count == 10


def test_what_a_plug_in_throws_is_the_scans_fault(plugged_in, monkeypatch, tmp_path):
    monkeypatch.setattr(scan, "DotReader", DotReader, raising=False)
    plugged_in(dot="station.readers.scan:DotReader")
    with pytest.raises(ScanError, match=r"RuntimeError: cannot make sense of a\.dot within 900"):
        open_scan(tmp_path / "a.dot", range_max_m=900)
