"""The air of a scan, from the logs of all dialects by the lines of the site file that the docs give."""

import json

import pytest
from readers.test_weather_dialects import LOGS
from support import tiny_station

from station.config import read_site
from station.processing.scans.epoch_inputs import load_scan_inputs
from station.processing.scans.open_scans import open_scan_for
from station.processing.scans.scan_files import scan_file


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


@pytest.mark.parametrize("kind", LOGS)
def test_the_air_of_a_scan_is_that_of_the_log(kind, folder):
    """The scan begins ten minutes before the first row, the only one without a gap."""
    settings, text = LOGS[kind]
    (folder / "log.txt").write_text(text, encoding="utf-8")
    site_text = (folder / "site.toml").read_text()
    start = site_text.index("[weather]")
    lines = ["[weather]", 'file = "log.txt"', *(f"{key} = {as_toml(v)}" for key, v in settings.items()), "\n"]
    (folder / "other.toml").write_text(
        site_text[:start] + "\n".join(lines) + site_text[site_text.index("\n[", start) + 1 :]
    )
    site = read_site(folder / "other.toml")
    scan = scan_file(site, folder / "inbox" / f"{tiny_station.scan_name(0)}.laz")
    with open_scan_for(site, scan) as opened:
        inputs = load_scan_inputs(site, opened, save_tilt_offset=False)
    assert not [warning for warning in inputs.warnings if "weather" in warning]
    assert inputs.air.temperature_c == pytest.approx(-1.5, abs=1e-9)
    assert inputs.air.humidity_pct == pytest.approx(51.0, abs=1e-9)
    assert inputs.air.pressure_hpa == pytest.approx(684.5, abs=0.05)
