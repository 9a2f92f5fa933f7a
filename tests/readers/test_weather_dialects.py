"""Weather logs as loggers and services write them; the expected values are worked by hand."""

import io
from datetime import UTC, datetime

import numpy as np
import pytest
from pydantic import ValidationError

from station.errors import NotReadyError, ScanError
from station.readers.weather import read_weather
from station.readers.weather_dialects import recognise_dialect
from station.sections.inputs import WeatherSection

# Each: lines of the site file, and the file. All say: 15 July 2025, 00:10 and 00:20 UTC; at first -1.5 °C,
# 684.5 hPa and 51 %.
DAVIS = (
    "\t\tTemp\tHi\tLow\tOut\tDew\t\t\n"
    "Date\tTime\tOut\tTemp\tTemp\tHum\tPt.\tBar  \n"
    "15/07/25\t 0:10\t29.3\t30.1\t28.0\t51\t13.1\t20.213\n"
    "15/07/25\t 0:20\t---\t30.1\t28.0\t50\t13.1\t20.216\n"
)
LOGS = {
    "smet": (
        {"format": "smet"},
        ("SMET 1.1 ASCII\n[HEADER]\nstation_id = weissfluhjoch\nnodata = -999\ntz = 1\n"
        "fields = timestamp TA RH VW P\n[DATA]\n"
        "2025-07-15T01:10:00 271.65 0.51 3.2 68450\n2025-07-15T01:20:00 -999 0.50 3.1 68460\n"),
    ),
    "smet with units of its own": (
        {"format": "smet"},
        ("SMET 1.1 ASCII\n[HEADER]\nnodata = -999\ntz = 0\nfields = timestamp TA RH P\n"
        "units_offset = 0 273.15 0 0\nunits_multiplier = 1 1 0.01 100\n[DATA]\n"
        "2025-07-15T00:10:00 -1.5 51 684.5\n2025-07-15T00:20:00 -999 50 684.6\n"),
    ),
    "dwd": (
        {"format": "dwd"},
        ("STATIONS_ID;MESS_DATUM;  QN;PP_10;TT_10;TM5_10;RF_10;TD_10;eor\r\n"
        "          3;202507150010;    3;  684.5;  -1.5;  -1.0;  51.0;  -1.6;eor\r\n"
        "          3;202507150020;    3;  684.6;  -999;  -1.0;  50.0;  -1.6;eor\r\n"),
    ),
    "meteoswiss": (
        {"format": "meteoswiss"},
        ("station_abbr;reference_timestamp;tre200s0;ure200s0;tde200s0;prestas0;pp0qnhs0;gre000z0\n"
        "JUN;15.07.2025 00:10;-1.5;51;-6.7;684.5;1015;0\nJUN;15.07.2025 00:20;;50;-6.7;684.6;1015;0\n"),
    ),
    "meteoswiss as it was": (
        {"format": "meteoswiss"},
        ("Station/Location;Date;tre200s0;rre150z0;ure200s0;prestas0\n"
        "JUN;202507150010;-1.5;0;51;684.5\nJUN;202507150020;-;0;50;684.6\n"),
    ),
    "geosphere": (
        {"format": "geosphere"},
        ("time,station,tl,rf,p\n2025-07-15T00:10+00:00,11343,-1.5,51.0,684.5\n"
        "2025-07-15T00:20+00:00,11343,,50.0,684.6\n"),
    ),
    "davis": (
        {"format": "davis", "time_format": "%d/%m/%y %H:%M",
         "units": {"temperature_c": "F", "pressure_hpa": "inHg"}},
        DAVIS,
    ),
    "hobo": (
        {"format": "hobo"},
        ('"Plot Title: hut"\n'
        '"#","Date Time, GMT+02:00","Temp, °C (LGR S/N: 1, SEN S/N: 2)","RH, % (LGR S/N: 1, SEN S/N: 2)",'
        '"Abs Pres, kPa (LGR S/N: 1, SEN S/N: 3)"\n'
        '1,"07/15/25 02:10:00 AM",-1.5,51,68.45\n2,"07/15/25 02:20:00 AM",,50,68.46\n'),
    ),
    "lufft": (
        {"format": "lufft", "zone": "Europe/Vienna"},
        ("Date time ; Temperature [°C] ; Abs. air pressure [hPa] ; Relative humidity [%] ; Dew point [°C]\n"
        "15.07.2025 02:10:00 ; -1,5 ; 684,5 ; 51,0 ; 2,2\n15.07.2025 02:20:00 ; ; 684,6 ; 50,0 ; 2,2\n"),
    ),
    "csv with a preamble, a units row and decimal commas": (
        {"format": "csv", "time_format": "%d.%m.%Y %H:%M", "zone": "Europe/Zurich",
         "columns": {"time": ["Datum", "Zeit"], "temperature_c": "T", "humidity_pct": "rF",
                     "pressure_hpa": "p"}},
        ("Station: Hütte\nExport vom 16.07.2025\n\nDatum;Zeit;T;rF;p\n;;°F;%;kPa\n"
        "15.07.2025;02:10;29,3;51;68,45\n15.07.2025;02:20;;50;68,46\n"),
    ),
    "csv without a header, in seconds since 1970": (
        {"format": "csv", "time_format": "unix", "names": ["time", "-", "t", "rh", "p"],
         "units": {"humidity_pct": "fraction", "pressure_hpa": "Pa"},
         "columns": {"time": "time", "temperature_c": "t", "humidity_pct": "rh", "pressure_hpa": "p"}},
        "1752538200 7 -1.5 0.51 68450\n1752538800 7 x 0.50 68460\n",
    ),
    "csv with units behind the names": (
        {"format": "csv", "columns": {"time": "Time[s]", "temperature_c": "Air", "humidity_pct": "RH",
                                      "pressure_hpa": "P"}},
        "Time[s],Air [degF],RH (%),P [Pa]\n2025-07-15T00:10Z,29.3,51,68450\n2025-07-15T00:20Z,,50,68460\n",
    ),
}  # fmt: skip
FIRST_S = datetime(2025, 7, 15, 0, 10, tzinfo=UTC).timestamp()


@pytest.mark.parametrize("kind", LOGS)
@pytest.mark.parametrize("encoding", ["utf-8", "cp1252", "utf-8-sig"])
def test_dialects_give_time_temperature_pressure_and_humidity(kind, encoding, tmp_path):
    settings, text = LOGS[kind]
    path = tmp_path / "weather.txt"
    path.write_bytes(text.encode(encoding))
    section = WeatherSection.model_validate({"file": path, **settings})
    for window in (None, (FIRST_S - 60, FIRST_S + 660)):
        log = read_weather(section, window)
        assert log.time_utc_s.tolist() == [FIRST_S, FIRST_S + 600]
        np.testing.assert_allclose(log.temperature_c, [-1.5, np.nan], atol=1e-9)
        np.testing.assert_allclose(log.pressure_hpa, [684.5, 684.6], atol=0.05)
        np.testing.assert_allclose(log.humidity_pct, [51, 50], atol=1e-9)


@pytest.mark.parametrize("kind", [kind for kind in LOGS if "header" not in kind and "preamble" not in kind])
def test_dialects_are_recognised_by_their_header(kind):
    settings, text = LOGS[kind]
    assert recognise_dialect(io.BytesIO(text.encode())) == settings["format"]


@pytest.mark.parametrize(
    ("text", "dialect"),
    [
        ('"TOA5","hut","CR1000"\n"TIMESTAMP","RECORD","T"\n', "toa5"),
        ("STATIONS_ID;MESS_DATUM;QN_9;TT_TU;RF_TU;eor\n", "dwd"),  # hourly files lack the pressure
        ('"Plot Title: hut"\n"#","Date Time, GMT+02:00","Temp, °C"\n', "hobo"),
        ("Time,Roll,Pitch\n0.5,1.25,-0.5\n", ""),
        ("1 0 0 5\n0 1 0 6\n0 0 1 7\n0 0 0 1\n", ""),
        ("\0\1time\0" * 3000, ""),
        ("", ""),
    ],
)
def test_other_headers(text, dialect):
    assert recognise_dialect(io.BytesIO(text.encode())) == dialect


def test_hours_of_the_dwd_are_not_taken_for_minutes(tmp_path):
    (tmp_path / "t.txt").write_text(
        "STATIONS_ID;MESS_DATUM;QN_9;TT_TU;RF_TU;eor\n3;2025071511;3;-1.5;51;eor\n3;2025071512;3;-1.4;50;eor\n"
    )
    (tmp_path / "p.txt").write_text(
        "STATIONS_ID;MESS_DATUM;QN_8;   P;  P0;eor\n3;2025071511;3;1015.0;684.5;eor\n"
        "3;2025071512;3;1015.0;684.6;eor\n"
    )
    log = read_weather(WeatherSection(file=tmp_path / "*.txt", format="dwd"))
    assert (log.time_utc_s - FIRST_S).tolist() == [39_000.0, 42_600.0]  # 11 and 12 h
    assert log.temperature_c.tolist() == [-1.5, -1.4]
    assert log.pressure_hpa.tolist() == [684.5, 684.6]


def test_files_of_a_pattern_are_one_log(tmp_path):
    for day in (14, 15, 16):
        rows = [f"2025-07-{day}T{hour:02d}:10Z,{day}.{hour:02d},50,700\n" for hour in range(24)]
        (tmp_path / f"2025-07-{day}.csv").write_text("time,t,rh,p\n" + "".join(rows))
    columns = {"time": "time", "temperature_c": "t", "humidity_pct": "rh", "pressure_hpa": "p"}
    section = WeatherSection(file=tmp_path / "2025-*.csv", format="csv", columns=columns)
    assert len(read_weather(section).time_utc_s) == 72
    log = read_weather(section, (FIRST_S - 3600, FIRST_S + 3600))
    assert log.temperature_c.tolist() == [14.23, 15.0, 15.01]
    with pytest.raises(NotReadyError, match="no file has such a name"):
        read_weather(section.model_copy(update={"file": tmp_path / "2026*.csv"}))


@pytest.mark.parametrize("window", [None, (FIRST_S - 60, FIRST_S + 660)])
def test_rows_of_several_stations_are_refused_or_selected(tmp_path, window):
    (tmp_path / "all.csv").write_text(
        "Station/Location;Date;tre200s0;ure200s0;prestas0\n"
        "BER;202507150010;18.2;70;950\nJUN;202507150010;-1.5;51;684.5\n"
        "BER;202507150020;18.0;71;950\nJUN;202507150020;-1.4;50;684.6\n"
    )
    section = WeatherSection(file=tmp_path / "all.csv", format="meteoswiss")
    with pytest.raises(ScanError, match=r"rows of 2 stations \(BER, JUN, …\): set weather.station"):
        read_weather(section, window)
    log = read_weather(section.model_copy(update={"station": "JUN"}), window)
    assert log.temperature_c.tolist() == [-1.5, -1.4]
    with pytest.raises(ScanError, match="no row of station ZER has a readable time"):
        read_weather(section.model_copy(update={"station": "ZER"}), window)


def test_a_file_without_any_quantity_or_time_is_named(tmp_path):
    (tmp_path / "a.csv").write_text("time,t,rh,p\n2025-07-15T00:10Z,1,50,700\n")
    (tmp_path / "b.csv").write_text("Zeit;Wind\n15.07.2025;3\n")
    columns = {"time": "time", "temperature_c": "t", "humidity_pct": "rh", "pressure_hpa": "p"}
    with pytest.raises(ScanError, match=r"b.csv: has no column time, t, p, rh; it has Zeit, Wind"):
        read_weather(WeatherSection(file=tmp_path / "*.csv", format="csv", columns=columns))


@pytest.mark.parametrize("kind", LOGS)
def test_damaged_logs_lose_rows_but_never_raise_anything_else(kind, tmp_path):
    settings, text = LOGS[kind]
    content, random = text.encode(), np.random.default_rng(3)
    path = tmp_path / "weather.txt"
    section = WeatherSection.model_validate({"file": path, **settings})
    for _ in range(40):
        broken = bytearray(content)
        for position in random.integers(0, len(content), 5):
            broken[position] = random.integers(0, 256)
        path.write_bytes(bytes(broken[: random.integers(1, len(content))]))
        try:
            log = read_weather(section)
        except ScanError:
            continue
        assert len(log.time_utc_s) <= 2


def test_settings_that_contradict_or_lack_something_are_refused(tmp_path):
    path = tmp_path / "w.csv"
    with pytest.raises(ValidationError, match=r'"csv" needs columns.temperature_c, columns.humidity_pct'):
        WeatherSection(file=path, format="csv")
    with pytest.raises(ValidationError, match=r'"davis" needs time_format, such as "%d/%m/%y'):
        WeatherSection(file=path, format="davis")
    with pytest.raises(ValidationError, match="keep one"):
        WeatherSection(file=path, format="dwd", zone="Europe/Berlin", utc_offset_h=1)
    with pytest.raises(ValidationError, match="no time zone"):
        WeatherSection(file=path, format="dwd", zone="Europe/Atlantis")
