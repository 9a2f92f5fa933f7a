"""Air and tilt of an epoch, from logs of all dialects by the lines of the site file that the docs give."""

import json

import netCDF4
import numpy as np
import pytest
from readers.test_weather_dialects import LOGS
from support import tiny_station

from station.config import read_site
from station.processing import scan_tasks
from station.processing.scans.epoch_inputs import load_scan_inputs
from station.processing.scans.open_scans import open_scan_for
from station.processing.scans.scan_files import scan_file

SCAN = tiny_station.scan_name(0)
CSV = "time,t,rh,p\n"
COLUMNS = {"time": "time", "temperature_c": "t", "humidity_pct": "rh", "pressure_hpa": "p"}
# The scan lasts from 0:00:00 to 0:01:00: its air is that of 0:00:30, .525 of the way between these rows.
BEFORE, AFTER = "2025-07-15T01:50+02:00,-2.55,49.95,683.45\n", "2025-07-15T00:10Z,-0.55,51.95,685.45\n"
FILES = {
    **{kind: (settings | {"file": "log.txt"}, {"log.txt": text}) for kind, (settings, text) in LOGS.items()},
    "the newest row first": (
        {"file": "log.txt", "format": "csv", "columns": COLUMNS},
        {"log.txt": CSV + AFTER + BEFORE},
    ),
    "daily files": (
        {"file": "log_*.csv", "format": "csv", "columns": COLUMNS},
        {"log_14.csv": CSV + BEFORE, "log_15.csv": CSV + AFTER},
    ),
    "a file for each quantity": (
        {"file": "produkt_*.txt", "format": "dwd"},
        {
            "produkt_tu.txt": "STATIONS_ID;MESS_DATUM;QN_9;TT_TU;RF_TU;eor\n3;2025071500;3;-1.5;51;eor\n",
            "produkt_p.txt": "STATIONS_ID;MESS_DATUM;QN_8;   P;  P0;eor\n3;2025071500;3;1015.0;684.5;eor\n",
        },
    ),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tiny_station.build(tmp_path_factory.mktemp("weather") / "station", hours=1)
    (folder / "inbox").rmdir()
    (folder / tiny_station.PENDING).rename(folder / "inbox")
    return folder


def as_toml(value):
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {as_toml(item)}" for key, item in value.items()) + " }"
    return json.dumps(value)


def edited_site(folder, data, weather=None):
    """Return the site with other lines for the weather, and the scan."""
    text = (folder / "site.toml").read_text().replace('data = "data"', f"data = {as_toml(str(data))}")
    if weather is not None:
        start = text.index("[weather]")
        lines = ["[weather]", *(f"{key} = {as_toml(value)}" for key, value in weather.items()), "\n"]
        text = text[:start] + "\n".join(lines) + text[text.index("\n[", start) + 1 :]
    (folder / "other.toml").write_text(text)
    site = read_site(folder / "other.toml")
    return site, scan_file(site, folder / "inbox" / f"{SCAN}.laz")


def inputs_of(site, scan):
    with open_scan_for(site, scan) as opened:
        return load_scan_inputs(site, opened, save_tilt_offset=False)


@pytest.mark.parametrize("kind", FILES)
def test_the_air_of_a_scan_is_that_of_the_log(kind, folder, tmp_path):
    settings, files = FILES[kind]
    for name, text in files.items():
        (folder / name).write_text(text, encoding="utf-8")
    inputs = inputs_of(*edited_site(folder, tmp_path, settings))
    assert not [warning for warning in inputs.warnings if "weather" in warning]
    assert inputs.air.temperature_c == pytest.approx(-1.5, abs=0.001)  # .6 s between the rows
    assert inputs.air.humidity_pct == pytest.approx(51.0, abs=0.001)
    assert inputs.air.pressure_hpa == pytest.approx(684.5, abs=0.05)  # Davis has hundredths of inHg


DIALECTS = {
    "delimiter and decimals of German programs": ("Time;Roll;Pitch", "{:.4f};{:.6f};{:.6f}", (1, 1), True),
    "tabs and units": ("Time[s]\tRoll[deg]\tPitch[deg]", "{:.4f}\t{:.6f}\t{:.6f}", (1, 1), False),
    "no names": ("", "{:.4f} {:.6f} {:.6f}", (1, 1), False),
    "other units": ("Time (ms),Roll (rad),Pitch (rad)", "{:.1f},{:.10f},{:.10f}", (1000, np.pi / 180), False),
}


@pytest.mark.parametrize("kind", DIALECTS)
def test_the_tilt_of_a_scan_is_that_of_the_log(kind, folder, tmp_path):
    names, row, (time_factor, tilt_factor), has_comma = DIALECTS[kind]
    path = folder / "inbox" / f"{SCAN}-incl.txt"
    content = path.read_bytes()
    site, scan = edited_site(folder, tmp_path)
    expected = inputs_of(site, scan)
    rows = np.loadtxt(path, delimiter=",", skiprows=1) * [time_factor, tilt_factor, tilt_factor]
    text = "\n".join([*([names] if names else []), *(row.format(*values) for values in rows), ""])
    path.write_text(text.replace(".", ",") if has_comma else text)
    try:
        actual = inputs_of(site, scan)
    finally:
        path.write_bytes(content)
    assert actual.warnings == expected.warnings
    assert np.ptp(expected.pose.tilt.roll_rad) > 1e-6
    for name in ("time_s", "roll_rad", "pitch_rad"):
        values = (getattr(inputs.pose.tilt, name) for inputs in (actual, expected))
        np.testing.assert_allclose(*values, rtol=0, atol=1e-8, err_msg=name)


@pytest.mark.parametrize("kind", ["davis", "geosphere", "hobo", "lufft"])
def test_air_and_tilt_are_stored_with_the_epoch(kind, folder, tmp_path):
    """Tilt in the mean of the log's rows; the scan was simulated with a roll of 2.1 degree."""
    settings, files = FILES[kind]
    (folder / "log.txt").write_text(files["log.txt"], encoding="utf-8")
    result = scan_tasks.process(*edited_site(folder, tmp_path, settings), lambda: None)
    _, *tilt_deg = np.loadtxt(folder / "inbox" / f"{SCAN}-incl.txt", delimiter=",", skiprows=1).T
    with netCDF4.Dataset(tmp_path / result.epoch) as file:
        assert float(file["air_temperature"][0]) == pytest.approx(-1.5, abs=1e-3)
        assert float(file["air_pressure"][0]) == pytest.approx(684.5, abs=0.02)  # hundredths of inHg
        assert float(file["relative_humidity"][0]) == 51.0
        stored_deg = [float(file[f"platform_{axis}"][0]) for axis in ("roll", "pitch")]
    assert stored_deg == pytest.approx(np.mean(tilt_deg, axis=1), abs=0.005)
