"""The weather log, with the faults of sensors, loggers and transfers."""

from datetime import UTC, datetime

import numpy as np
import pytest

from station.errors import NotReadyError, ScanError
from station.quantities import Air, WeatherLog
from station.readers import weather
from station.readers.weather import interpolate_air
from station.sections.inputs import WeatherColumns, WeatherSection

REAL = WeatherColumns(temperature_c="TAact_2m_Avg", humidity_pct="RHact_2m_Avg", pressure_hpa="Pact")
PLAIN = WeatherColumns(time="time", temperature_c="t", humidity_pct="rh", pressure_hpa="p")
TOA5 = (
    '"TOA5","hef","CR3000","1","x","y","2","LowFreq"\r\n"TIMESTAMP","RECORD","T","RH","P"\r\n'
    '"TS","RN","C","%","mbar"\r\n"","","Avg","Avg","Smp"\r\n'
)
LOGGER = WeatherColumns(temperature_c="T", humidity_pct="RH", pressure_hpa="P")
START_S = datetime(2024, 10, 1, 5, 0, tzinfo=UTC).timestamp()


def read_weather(path, window_utc_s=None, **settings):
    return weather.read_weather(WeatherSection(file=path, **settings), window_utc_s)


def write_log(tmp_path, text):
    path = tmp_path / "weather.dat"
    path.write_bytes(text.encode())
    return path


def test_real_log(shared_data):
    path = shared_data / "weather/hintereis_toa5_excerpt.dat"
    log = read_weather(path, format="toa5", columns=REAL, utc_offset_h=0)
    assert log.time_utc_s[0] == datetime(2018, 6, 22, 8, 52, tzinfo=UTC).timestamp()
    assert log.temperature_c[0] == -1.382293
    assert log.humidity_pct[0] == 51.77882
    assert log.pressure_hpa[0] == 684.6149
    assert np.all(np.diff(log.time_utc_s) > 0)
    assert 682 < np.nanmin(log.pressure_hpa) < np.nanmax(log.pressure_hpa) < 690
    assert len(log.time_utc_s) == len(path.read_bytes().splitlines()) - 4


def test_faulty_values_become_gaps(tmp_path):
    rows = [
        '"2024-10-01 05:00:00",1,-1.5,50,684.5',
        '"2024-10-01 05:01:00",2,"NAN",50,684.6',
        '"2024-10-01 05:02:00",3,-7999,104,"INF"',
        '"2024-10-01 05:03:00",4,-1.6,50',  # incomplete
        "garbage",
        '"2024-10-01 05:05:00",6,-1.7,50,684.8',
        '"2024-10-01 05:05:00",6,-1.8,50,684.9',  # sent twice
        '"2024-10-01 05:04:00",5,-1.9,50,685.0',  # late
        '"2024-10-01 05:06:00.5",7,-2.0,50,685.1',
    ]
    path = write_log(tmp_path, TOA5 + "\r\n".join(rows) + '\r\n"2024-10-01 05:07:00",8,-2.1,50,68')
    log = read_weather(path, format="toa5", columns=LOGGER, utc_offset_h=0)
    assert list(log.time_utc_s - START_S) == [0, 60, 120, 240, 300, 360.5]
    nan = np.nan
    assert log.temperature_c == pytest.approx([-1.5, nan, nan, -1.9, -1.8, -2.0], nan_ok=True)
    assert log.pressure_hpa == pytest.approx([684.5, 684.6, nan, 685.0, 684.9, 685.1], nan_ok=True)
    assert log.humidity_pct == pytest.approx([50, 50, 100, 50, 50, 50])  # wet sensors read beyond 100


def test_csv_with_time_zones(tmp_path):
    times = ["2024-10-01T06:00:00", "2024-10-01T05:10:00Z", "2024-10-01 07:30+01:00"]
    rows = [f"{time},{number},50,700\n" for number, time in enumerate(times)]
    path = write_log(tmp_path, "time,t,rh,p\n" + "".join(rows))
    log = read_weather(path, format="csv", columns=PLAIN, utc_offset_h=1)
    assert list(log.time_utc_s - START_S) == [0, 600, 5400]
    assert list(log.temperature_c) == [0, 1, 2]


@pytest.mark.parametrize(
    ("units", "values", "expected"),
    [
        ("C,%,mbar", (-1.5, 50, 684.5), (-1.5, 50, 684.5)),
        ("Deg C,%RH,hPa", (-1.5, 50, 684.5), (-1.5, 50, 684.5)),
        ("Deg F,%,kPa", (14.0, 50, 68.45), (-10.0, 50, 684.5)),
        ("degF,%,Pa", (-40.0, 50, 68450), (-40.0, 50, 684.5)),
        ("F,0-1,inHg", (212.0 - 180.0, 0.5, 29.9213), (0.0, 50, 1013.25)),
        ("°F,frac,mmHg", (50.0, 0.5, 760), (10.0, 50, 1013.25)),
        ("K,1,mb", (263.15, 0.012, 684.5), (-10.0, 1.2, 684.5)),
        ("Kelvin,%,bar", (263.15, 1.2, 0.6845), (-10.0, 1.2, 684.5)),
        (",,", (-1.5, 50, 684.5), (-1.5, 50, 684.5)),
        ("volt,?,x", (-1.5, 50, 684.5), (-1.5, 50, 684.5)),
    ],
)
def test_units_of_a_toa5_file_are_converted(tmp_path, units, values, expected):
    """32 °F is 0 °C, -40 °F is -40 °C; 29.9213 inHg and 760 mmHg are 1013.25 hPa."""
    unit_row = '"TS","RN",' + ",".join(f'"{unit}"' for unit in units.split(","))
    text = TOA5.replace('"TS","RN","C","%","mbar"', unit_row)
    rows = [f'"2024-10-01 05:0{minute}:00",1,{",".join(map(str, values))}\r\n' for minute in range(3)]
    log = read_weather(
        write_log(tmp_path, text + "".join(rows)), format="toa5", columns=LOGGER, utc_offset_h=0
    )
    actual = log.temperature_c[0], log.humidity_pct[0], log.pressure_hpa[0]
    assert actual == pytest.approx(expected, rel=1e-5, abs=1e-9)


def csv_rows(times):
    return "".join(f"{time},1.5,55,700\n" for time in times)


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ("15.07.2025 00:00", "15.07.2025 00:10"),
        ("2025/07/15 00:00", "2025/07/15 00:10"),
        ("1752537600", "1752538200"),
        ("1752537600.5", "1752538200.5"),
        ("Jul 15 2025", "Jul 16 2025"),
    ],
)
@pytest.mark.parametrize("window", [None, (START_S, START_S + 3600)])
@pytest.mark.parametrize("repeated", [1, 3000])
def test_unreadable_times_are_an_error_that_shows_the_first(tmp_path, first, second, window, repeated):
    path = write_log(tmp_path, "time,t,rh,p\n" + csv_rows([first, second] * repeated))
    with pytest.raises(ScanError, match="no row has a readable time") as error:
        read_weather(path, format="csv", columns=PLAIN, utc_offset_h=0, window_utc_s=window)
    assert repr(first) in str(error.value)
    assert "ISO 8601" in str(error.value)


@pytest.mark.parametrize("window_h", [None, 1.0, 20.0, 39.0])
def test_the_newest_rows_may_come_first(tmp_path, window_h):
    """40 hours of minutes, long enough to be bisected; each row tells its minute."""
    times = [
        f"{datetime.fromtimestamp(START_S + 60 * minute, UTC):%Y-%m-%dT%H:%M:%S}" for minute in range(2400)
    ]
    rows = [f"{time},{minute / 100},55,700\n" for minute, time in enumerate(times)]
    path = write_log(tmp_path, "time,t,rh,p\n" + "".join(reversed(rows)))
    centre_s = START_S + 3600 * (window_h or 0)
    window = None if window_h is None else (centre_s - 600, centre_s + 600)
    log = read_weather(path, window, format="csv", columns=PLAIN, utc_offset_h=0)
    minutes = np.arange(2400) if window_h is None else 60 * window_h + np.arange(-10, 11)
    np.testing.assert_allclose(log.time_utc_s, START_S + 60 * minutes)
    np.testing.assert_allclose(log.temperature_c, minutes / 100)


@pytest.mark.parametrize(("humidity", "is_fraction"), [("0.55", True), ("1.0", True), ("1.6", False)])
def test_humidity_that_can_only_be_a_fraction_is_an_error(tmp_path, humidity, is_fraction):
    rows = "".join(f"2024-10-01 05:0{n}:00,1.5,{humidity if n else 0.4},700\n" for n in range(5))
    path = write_log(tmp_path, "time,t,rh,p\n" + rows)
    if is_fraction:
        with pytest.raises(
            ScanError, match=r"humidity is at most .*: a fraction of 1\? It must be in percent"
        ):
            read_weather(path, format="csv", columns=PLAIN, utc_offset_h=0)
    else:
        log = read_weather(path, format="csv", columns=PLAIN, utc_offset_h=0)
        assert log.humidity_pct.max() == 1.6


@pytest.mark.parametrize(
    ("text", "format_", "reason"),
    [
        (TOA5.replace('"P"', '"Pact"'), "toa5", "has no column P; it has TIMESTAMP, RECORD, T, RH, Pact"),
        ("time,t\n", "toa5", 'is it weather.format = "csv"'),
        ("", "csv", "has no column TIMESTAMP, T, P, RH"),
        (TOA5 + '"2024-10-01 05:00:00",1,-1.5,50,68.45\r\n', "toa5", "wrong columns or units"),
    ],
)
def test_invalid_log_is_rejected(tmp_path, text, format_, reason):
    with pytest.raises(ScanError, match=reason):
        read_weather(write_log(tmp_path, text), format=format_, columns=LOGGER, utc_offset_h=0)


def test_log_without_rows_is_empty(tmp_path):
    log = read_weather(write_log(tmp_path, TOA5), format="toa5", columns=LOGGER, utc_offset_h=0)
    assert len(log.time_utc_s) == 0
    assert interpolate_air(log, START_S, 3600) is None


def test_missing_log_is_not_ready(tmp_path):
    with pytest.raises(NotReadyError, match="No such file"):
        read_weather(tmp_path / "none.dat", format="csv", columns=PLAIN, utc_offset_h=0)


@pytest.fixture(scope="module")
def long_log(tmp_path_factory):
    """Sixty days of minutes, with damaged rows, a gap and a row with a wrong time."""
    rows = [
        f"{datetime.fromtimestamp(START_S + 60 * minute, UTC):%Y-%m-%dT%H:%M:%S},{minute / 1e4},50,700\n"
        for minute in range(86_400)
    ]
    rows[43_000:43_400] = [" damaged \n"] * 15
    rows[30_000] = "2031-01-01T00:00:00,1,50,700\n"
    path = tmp_path_factory.mktemp("weather") / "long.csv"
    path.write_text("time,t,rh,p\n" + "".join(rows))
    return path


@pytest.mark.parametrize(
    "minute", [0, 1, 700, 29_999, 30_001, 42_990, 43_410, 43_600, 86_000, 86_399, 99_999]
)
def test_time_window_of_a_long_log(long_log, minute):
    window = (START_S + 60 * (minute - 60), START_S + 60 * (minute + 60))
    log = read_weather(long_log, format="csv", columns=PLAIN, utc_offset_h=0, window_utc_s=window)
    minutes = [
        row
        for row in range(max(minute - 60, 0), min(minute + 61, 86_400))
        if row != 30_000 and not 43_000 <= row < 43_400
    ]
    assert list((log.time_utc_s - START_S) / 60) == minutes


def log_of(*rows):
    return WeatherLog(*np.array(rows, dtype=np.float64).T)


def test_air_is_interpolated_between_complete_samples():
    log = log_of((0, -1, 680, 20), (500, np.nan, 999, 99), (1000, -3, 690, 40))
    assert interpolate_air(log, 250, 3600) == Air(-1.5, 682.5, 25.0)


@pytest.mark.parametrize(
    ("time_s", "temperature_c"), [(-50, -1), (90, -1), (910, -3), (1099, -3), (500, None)]
)
def test_air_is_not_older_than_allowed(time_s, temperature_c):
    air = interpolate_air(log_of((0, -1, 680, 20), (1000, -3, 690, 40)), time_s, 100)
    assert (air and air.temperature_c) == temperature_c
