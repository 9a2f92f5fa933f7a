"""The table [weather] of a proposed site file; the names are those that loggers and programs write."""

import tomllib

import pytest

from station.operations.proposals.weather_proposal import weather_lines
from station.readers.weather import read_weather
from station.readers.weather_dialects import recognise_dialect
from station.sections.inputs import WeatherSection

CSV = "Zeit;Temperatur;Feuchte;Luftdruck\n{};-1,5;51;684,5\n"
TOA5 = (
    '"TOA5","hut","CR1000"\n"TIMESTAMP","RECORD","BattV_Min","PTemp_C_Avg","AirTC_Avg","AirTC_Max",{}"RH","BP"\n'
    '"TS","RN","Volts","Deg C","Deg C","Deg C",{}"%","kPa"\n"","","Min","Avg","Avg","Max",{}"Smp","Smp"\n'
    '"2025-07-15 00:10:00",1,12.5,3.1,-1.5,-1.1,{}51,68.45\n'
)


def proposed(path):
    """Return the table [weather] that is proposed for a log, and the lines of the proposal."""
    with path.open("rb") as file:
        lines = weather_lines(path, recognise_dialect(file))
    return tomllib.loads("\n".join(lines)).get("weather"), lines


@pytest.mark.parametrize(
    "text",
    [
        CSV.format("2025-07-15 00:10"),
        CSV.format("15.07.2025 00:10:00"),
        TOA5.format("", "", "", ""),
        (
            "Hut\n\nDate,Time,Air Temp [degF],Dew Pt,Rel. Humidity,Baro (Pa),QNH\n"
            "2025-07-15,00:10,29.3,3,51,68450,1015\n"
        ),
        (
            "timestamp\tOutdoor Temp (°C)\tTemp In\tAbs. pressure (hPa)\tSea level (hPa)\tHumidity (%)\n"
            "2025/07/15 00:10\t-1.5\t20\t684.5\t1015\t51\n"
        ),
    ],
)
def test_columns_are_found_where_their_names_leave_no_doubt(text, tmp_path):
    (tmp_path / "log").write_text(text)
    log = read_weather(WeatherSection.model_validate(proposed(tmp_path / "log")[0]))
    assert log.time_utc_s.tolist() == [1752538200.0]
    actual = [log.temperature_c[0], log.pressure_hpa[0], log.humidity_pct[0]]
    assert actual == pytest.approx([-1.5, 684.5, 51])


@pytest.mark.parametrize(
    ("text", "line"),
    [
        (CSV.format("07/15/2025 00:10"), "# check times (time_format) and units"),
        (CSV.replace("51", "0.51").format("2025-07-15 00:10"), "# check times (time_format) and units"),
        (
            CSV.replace("Feuchte", "Wind").format("2025-07-15 00:10"),
            'temperature_c = "Temperatur", humidity_pct = "…"',
        ),
        (CSV.replace("Zeit", "Datum;UTC").format("2025-07-15;00:10"), '# columns = { time = "Datum"'),
        (TOA5.format('"AirTC2",', '"Deg C",', '"Smp",', "-1.4,"), "# temperature_c: AirTC_Avg or AirTC2"),
    ],
)
def test_columns_and_times_in_doubt_are_left_to_the_user(text, line, tmp_path):
    (tmp_path / "log").write_text(text)
    table, lines = proposed(tmp_path / "log")
    assert table is None
    assert line in "\n".join(lines)


def test_columns_of_the_real_log_at_the_hintereisferner_are_in_doubt(shared_data):
    """It has temperature and humidity at two heights."""
    table, lines = proposed(shared_data / "weather/hintereis_toa5_excerpt.dat")
    assert table is None
    assert 'temperature_c = "…", humidity_pct = "…", pressure_hpa = "Pact" }' in "\n".join(lines)
    assert "# humidity_pct: RHact_1m_Avg or RHact_2m_Avg" in lines


@pytest.mark.parametrize("name", ["Temp\x7f", "Temp\x07;Temp", 'Temp"', "Temp\\u00"])
def test_any_name_of_a_column_leaves_the_site_file_valid(name, tmp_path):
    """TOML allows no control characters, not even in comments."""
    (tmp_path / "log").write_text(CSV.replace("Temperatur", f"{name};{name}2").format("2025-07-15 00:10;3"))
    proposed(tmp_path / "log")


@pytest.mark.parametrize("columns", [1000, 1001])
def test_a_line_of_very_many_columns_is_no_header(columns, tmp_path):
    """Each is tried for each dialect in many ways: a hundred such lines took a minute."""
    more = ";x" * (columns - 4)
    (tmp_path / "log").write_text(f"Zeit;t;rh;p{more}\n2025-07-15 00:10;-1,5;51;684,5{more}\n")
    assert (proposed(tmp_path / "log")[0] is None) == (columns > 1000)
