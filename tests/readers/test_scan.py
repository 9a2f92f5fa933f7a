"""Choice of the reader by suffix, and the start time and time base of a scan."""

import logging
from datetime import UTC, datetime, timedelta
from importlib.metadata import EntryPoint

import numpy as np
import pytest

from station.errors import NotReadyError, ScanError
from station.readers import scan
from station.readers.scan import (
    TimeBase,
    detect_time_base,
    gps_seconds,
    gps_to_utc,
    open_scan,
    reject_future,
    utc_interval,
)
from station.scan_names import start_in_name

NAMED = "%y%m%d_%H%M%S"
START = datetime(2024, 10, 1, 12, 0, 0, tzinfo=UTC)
# from date(1) and the 18 s of IERS Bulletin C: 1727784000 - 315964800 + 18
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
def test_gps_time_includes_leap_seconds(when, gps_s):
    assert gps_seconds(when) == gps_s
    assert gps_to_utc(gps_s) == when


def test_implausible_dates_are_rejected():
    with pytest.raises(ScanError, match="check the clocks"):
        gps_seconds(datetime(1990, 1, 1, tzinfo=UTC))
    with pytest.raises(ScanError, match="corrupt"):
        gps_to_utc(1e20)


@pytest.mark.parametrize(
    ("first_s", "start", "standard", "expected"),
    [
        (0.0, START, False, TimeBase.SCANNER),
        (91.8, START, False, TimeBase.SCANNER),
        (91.8, START, True, TimeBase.SCANNER),  # many writers set this flag regardless of the time base
        (91.8, None, True, TimeBase.SCANNER),
        (START_WEEK_S + 3, START, False, TimeBase.WEEK),
        (START_WEEK_S + 3, START, True, TimeBase.WEEK),
        (START_WEEK_S - 86_400, START, False, TimeBase.SCANNER),
        (START_STANDARD_S + 3, START, True, TimeBase.STANDARD),
        (START_STANDARD_S + 3, START, False, TimeBase.STANDARD),
        (START_STANDARD_S + 3, None, False, TimeBase.STANDARD),
        (START_STANDARD_S - 30 * 86_400, START, False, TimeBase.STANDARD),  # clocks a month apart
        (-2e7, None, True, TimeBase.STANDARD),  # before September 2011
    ],
)
def test_time_base_is_detected(first_s, start, standard, expected):
    assert detect_time_base(first_s, first_s + 900, start, standard=standard) is expected


def test_time_stamps_that_are_all_zero():
    assert detect_time_base(0.0, 0.0, START, standard=True) is TimeBase.NONE


def test_week_seconds_at_the_end_of_the_week():
    sunday = datetime(2024, 10, 5, 23, 59, 45, tzinfo=UTC)  # the GPS week began 18 s before midnight
    assert detect_time_base(3.2, 900.0, sunday, standard=False) is TimeBase.WEEK
    assert (
        detect_time_base(604_799.0, 605_700.0, sunday - timedelta(seconds=4), standard=False) is TimeBase.WEEK
    )


def times(first_s, count=100):
    return first_s + np.arange(count) * 9.0


def write_timed_scan(write_scan, name, first_s, **options):
    points_m = np.random.default_rng(0).normal(size=(3, 100))
    return write_scan(name, points_m, None if first_s is None else times(first_s), **options)


@pytest.mark.parametrize(
    ("first_s", "expected", "duration_s"),
    [
        (None, TimeBase.NONE, 0.0),
        (40.0, TimeBase.SCANNER, 891.0),
        (START_WEEK_S, TimeBase.WEEK, 891.0),
        (START_STANDARD_S, TimeBase.STANDARD, 891.0),
    ],
)
def test_start_is_from_the_name_and_duration_from_the_time_stamps(write_scan, first_s, expected, duration_s):
    with open_scan(write_timed_scan(write_scan, "241001_120000.laz", first_s)) as reader:
        start, end, time_base = utc_interval(reader, NAMED)
    assert (start, time_base) == (START, expected)
    assert (end - start).total_seconds() == pytest.approx(duration_s)


def test_start_from_absolute_time_stamps(write_scan):
    with open_scan(write_timed_scan(write_scan, "flight.laz", START_STANDARD_S, standard=True)) as reader:
        assert utc_interval(reader, NAMED)[0] == START


@pytest.mark.parametrize(("name", "pattern"), [("2024-10-01", "%Y-%m-%d"), ("241001_12", "%y%m%d_%H")])
def test_names_of_a_day_or_an_hour_leave_the_rest_to_gps_times(write_scan, name, pattern):
    path = write_timed_scan(write_scan, f"{name}.laz", START_STANDARD_S + 120, standard=True)
    with open_scan(path) as reader:
        assert utc_interval(reader, pattern)[0] == START + timedelta(seconds=120)
        with pytest.raises(ScanError, match="check the scanner's clock"):
            utc_interval(reader, "%Y-%m-%d", "2024-09-30.laz")
    with open_scan(write_timed_scan(write_scan, f"{name}.laz", 40.0)) as reader:
        assert utc_interval(reader, pattern, f"{name}.laz")[0] == start_in_name(name, pattern)


@pytest.mark.parametrize("first_s", [None, 40.0, START_WEEK_S])
def test_unknown_start_is_explained(write_scan, first_s):
    with (
        open_scan(write_timed_scan(write_scan, "noon.laz", first_s)) as reader,
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
def test_name_that_contradicts_gps_time_is_rejected(write_scan, name, hint):
    with (
        open_scan(write_timed_scan(write_scan, name, START_STANDARD_S)) as reader,
        pytest.raises(ScanError, match=hint),
    ):
        utc_interval(reader, NAMED)


@pytest.mark.parametrize("hour", [0, 1])
def test_gps_time_tells_which_of_two_hours_a_name_means(hour):
    """On 27 October 2024 it was twice 2:05 in Vienna, an hour before and after the end of summer time."""
    gps_s = START_STANDARD_S + timedelta(days=25, hours=12 + hour, minutes=5).total_seconds()
    start = scan.scan_start("241027_020500.laz", f"{NAMED}@Europe/Vienna", (gps_s, gps_s + 60))
    assert start == datetime(2024, 10, 27, hour, 5, tzinfo=UTC)


def test_scan_from_the_future_is_not_ready():
    now_s = START.timestamp()
    reject_future(START, now_s)
    reject_future(START + timedelta(minutes=14), now_s)  # clocks differ, names are rounded
    with pytest.raises(NotReadyError, match=r"begins at 2024-10-01 12:16:00 UTC, 0:16:00 ahead of this"):
        reject_future(START + timedelta(minutes=16), now_s)


def test_time_stamps_beyond_any_calendar_are_rejected(write_scan):
    points_m, time_s = np.random.default_rng(0).normal(size=(3, 100)), times(40.0)
    time_s[-1] = 1e300
    with (
        open_scan(write_scan("241001_120000.laz", points_m, time_s)) as reader,
        pytest.raises(ScanError, match="no scan lasts so long"),
    ):
        utc_interval(reader, NAMED)


def test_time_zone_in_the_name(write_scan):
    with open_scan(write_timed_scan(write_scan, "241001_140000+0200.laz", 40.0)) as reader:
        assert utc_interval(reader, NAMED + "%z")[0] == START


def test_real_airborne_scan_has_absolute_time(shared_data):
    with open_scan(shared_data / "als/coromandel_points.laz") as reader:
        start, end, time_base = utc_interval(reader, NAMED)
    assert time_base is TimeBase.STANDARD
    assert start.date().isoformat() == "2024-04-27"
    assert 0 < (end - start).total_seconds() < 3600


def test_las_reader_is_built_in(write_sweep):
    assert {".las", ".laz"} <= set(scan.suffixes())
    with open_scan(write_sweep("UPPER.LAZ", 100)) as reader:
        assert reader.header.point_count == 100


def test_unknown_suffix_lists_the_known_ones(tmp_path):
    with pytest.raises(ScanError, match=r"no reader for .\.rxp.: .*\.las, \.laz, "):
        open_scan(tmp_path / "scan.rxp")


class DotReader:
    suffixes = (".dot",)

    def __init__(self, path, *, range_max_m=None):
        raise RuntimeError(f"cannot make sense of {path.name} within {range_max_m}")


@pytest.fixture
def register_readers(monkeypatch):
    """Return a function that registers readers as entry points, as an installed package would."""

    def register(**values):
        entries = [EntryPoint(name, value, "station.readers") for name, value in values.items()]
        monkeypatch.setattr(scan, "entry_points", lambda **_: entries)
        scan._readers.cache_clear()

    yield register
    scan._readers.cache_clear()


def test_broken_plug_in_disables_only_itself(register_readers, caplog, write_sweep):
    register_readers(
        absent="no.such.module:Reader",
        invalid="station.errors:ScanError",
        las="station.readers.las:LasScan",
    )
    with caplog.at_level(logging.WARNING):
        assert scan.suffixes() == (".las", ".las.gz", ".laz", ".laz.gz")
    assert "absent" in caplog.text
    assert "invalid" in caplog.text
    assert open_scan(write_sweep("s.las", 10)).header.point_count == 10


def test_errors_of_a_plug_in_become_scan_errors(register_readers, monkeypatch, tmp_path):
    monkeypatch.setattr(scan, "DotReader", DotReader, raising=False)
    register_readers(dot="station.readers.scan:DotReader")
    with pytest.raises(ScanError, match=r"RuntimeError: cannot make sense of a\.dot within 900"):
        open_scan(tmp_path / "a.dot", range_max_m=900)
