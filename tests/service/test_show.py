"""What is shown follows what is stored, and never stands in its way."""

import json
import logging
from dataclasses import replace

import station
from station.config import read_site
from station.service.once import process_scans
from station.service.pictures import page_folder
from station.service.show import show
from station.simulation.station import simulate, tiny


def test_a_page_that_cannot_be_written_keeps_no_scan_from_the_store(tmp_path, caplog):
    simulate(tmp_path, replace(tiny(hours=2), avalanche_m=0.0))
    path = tmp_path / "site.toml"
    path.write_text(path.read_text() + "\n[products]\ngeotiff = true\nquicklook_width_px = 500\n")
    site = read_site(path)
    site.station.data.mkdir()
    page_folder(site).write_text("in the way")
    scans = sorted(site.scans.inbox.glob("*.laz"))
    with caplog.at_level(logging.WARNING, "station"):
        assert process_scans(site, scans, lambda _: None) == 0
    assert "page=failed" in caplog.text
    with station.open(site.station.data) as series:
        assert series.sizes["time"] == 2

    page_folder(site).unlink()
    show(site, None, lambda: None)
    body = (page_folder(site) / "data.js").read_text()
    data = json.loads(body.removeprefix("window.STATION=").removesuffix(";\n"))
    assert len(data["maps"]) == 2
    assert all(seconds > 0 for seconds in data["health"]["seconds"])
    assert {path.suffix for path in (site.station.data / "geotiff").iterdir()} == {".tif", ".qml"}
