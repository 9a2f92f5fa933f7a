"""RiSCAN PRO projects: a real one, and what may be missing in others."""

from datetime import UTC, datetime

import numpy as np
import pytest

from station.errors import ConfigError
from station.readers.formats.riscan import read_project

SOP = "1 0 0 10  0 1 0 20  0 0 1 1.5  0 0 0 1"
POSITION = """
<scanposition name="{name}" kind="PositionX" {states}>
  <ppm_air_pressure>1000</ppm_air_pressure><ppm_air_temperature>12</ppm_air_temperature>
  <ppm_moisture_pressure>8.42</ppm_moisture_pressure>
  <singlescans>
    <scan name="{first}_old" states="deleted"><instrument>VZ-400</instrument></scan>
    <scan name="250701_120000"><instrument>VZ-2000i</instrument>
      <geometryinfo><maxpolar length="3"> 426.6 2.27 6.29 </maxpolar></geometryinfo></scan>
    <scan name="250702_120000"><instrument>VZ-2000i</instrument></scan>
  </singlescans>
  <sop name="SOP" kind="SOP"><matrix rows="4" cols="4"> {sop} </matrix></sop>
</scanposition>
"""


def write_project(folder, positions, pop="1 0 0 0  0 1 0 0  0 0 1 0  0 0 0 1"):
    path = folder / "project.rsp"
    path.write_text(
        f'<?xml version="1.0"?><project name="hut"><pop><matrix>{pop}</matrix></pop>'
        f"<scanpositions>{positions}</scanpositions></project>"
    )
    return path


def test_a_real_project(shared_data):
    project = read_project(shared_data / "riegl/project.rsp")
    first, second = project.positions
    assert (first.name, second.name) == ("SP01", "SP02")
    assert (first.instrument, first.first_scan) == ("VZ-1000", "151120_150227")
    assert first.start_utc == datetime(2015, 11, 20, 15, 2, 27, tzinfo=UTC)
    first_row = [0.99203538996098432, 4.7632160018149184e-05, 0.12595944901488946, -3.1470172510255578]
    np.testing.assert_allclose(first.sop[0], first_row, rtol=1e-9)
    assert project.pop[2, 3] == 3143447.4201939853
    assert (first.air.temperature_c, first.air.pressure_hpa) == (12.0, 1000.0)
    assert first.air.humidity_pct == pytest.approx(60.0, abs=0.2)  # RiSCAN's default


def test_deleted_scans_and_positions_do_not_count(tmp_path):
    kept = POSITION.format(name="SP1", states="", first="240101_000000", sop=SOP)
    deleted = POSITION.format(name="SP2", states='states="deleted"', first="240101_000000", sop=SOP)
    (position,) = read_project(write_project(tmp_path, kept + deleted)).positions
    assert (position.name, position.first_scan, position.instrument) == (
        "SP1",
        "250701_120000",
        "VZ-2000i",
    )
    assert position.extent_m == 426.6


def test_an_identity_is_no_pop_and_a_folder_is_a_project(tmp_path):
    write_project(tmp_path, POSITION.format(name="SP1", states="", first="240101_000000", sop=SOP))
    assert read_project(tmp_path).pop is None


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("<project><scanpositions/></project>", "not a RiSCAN project with scan positions"),
        ("<html><body/></html>", "not a RiSCAN project"),
        ("\x00\x01", "not a RiSCAN project"),
        ("<project><scanpositions><scanposition name='a'/></scanpositions></project>", "a has no SOP"),
        (
            (
                "<project><scanpositions><scanposition name='a'><sop><matrix>1 2 3</matrix></sop>"
                "</scanposition></scanpositions></project>"
            ),
            r"has rows of \[3\]",
        ),
    ],
)
def test_other_files_are_refused(tmp_path, text, reason):
    path = tmp_path / "project.rsp"
    path.write_text(text)
    with pytest.raises(ConfigError, match=reason):
        read_project(path)
    with pytest.raises(ConfigError, match="cannot be read"):
        read_project(tmp_path / "none.rsp")


@pytest.mark.parametrize(
    ("old", "new"),
    [("12</ppm", "nan</ppm"), ("1000", "1e999"), ("12</ppm", "-243.12</ppm"), ("8.42", "-1")],
)
def test_an_impossible_atmosphere_is_none(old, new, tmp_path):
    text = POSITION.format(name="SP1", states="", first="240101_000000", sop=SOP)
    (position,) = read_project(write_project(tmp_path, text.replace(old, new, 1))).positions
    assert position.air is None


def test_numbers_and_dates_that_are_none_are_not_used(tmp_path):
    text = POSITION.format(name="SP1", states="", first="240101_000000", sop=SOP)
    for name in ("250701_120000", "250702_120000"):
        text = text.replace(name, name.replace("2507", "2599"))
    (position,) = read_project(write_project(tmp_path, text.replace("426.6", "x"))).positions
    assert (position.extent_m, position.start_utc) == (0.0, None)
