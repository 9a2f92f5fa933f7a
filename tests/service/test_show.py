"""What is shown follows what is stored, and never stands in its way."""

import json
import logging
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

import station
from station.config import read_site
from station.products import gallery
from station.products.look import look_at
from station.service import pictures
from station.service.journal import Journal
from station.service.once import process_scans
from station.service.pictures import page_folder
from station.service.places import arrival_of
from station.service.references import build_reference
from station.service.show import Shown, show
from station.service.tasks import Past, attend
from station.service.upkeep import publish
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


def test_pictures_come_from_memory_and_a_fault_there_costs_no_epoch(tmp_path, monkeypatch):
    simulate(tmp_path, replace(tiny(hours=2), avalanche_m=0.0))
    path = tmp_path / "site.toml"
    path.write_text(path.read_text() + "\n[products]\nchange_limit_m = 0.2\nquicklook_width_px = 500\n")
    site = read_site(path)
    site.station.data.mkdir()
    scans = [arrival_of(site, one) for one in sorted(site.scans.inbox.glob("*.laz"))]
    build_reference(site, scans, "1", lambda: None)
    with monkeypatch.context() as broken:
        broken.setattr(pictures.Looking, "add", lambda *_: 1 / 0)
        blind = attend(site, scans[0], Past(), lambda: None)
    seen = attend(site, scans[1], Past(), lambda: None)
    assert (blind.look, blind.verdict) == (None, seen.verdict)
    publish(site, lambda: None)
    Journal(site.station.data / "journal.sqlite").close()

    read = []
    monkeypatch.setattr(gallery, "look_at", lambda row, *_, **__: read.append(row) or look_at(row, *_, **__))
    drawn = []
    for outcome in (seen, None):
        shutil.rmtree(page_folder(site) / "maps", ignore_errors=True)
        assert show(site, outcome, lambda: None) == Shown("", "")
        newest = sorted((page_folder(site) / "maps").glob(f"{Path(seen.epoch).stem}_*.webp"))
        drawn.append([np.asarray(Image.open(one), dtype=float) for one in newest])
    assert [Path(row.epoch_file).name for row in read] == [
        Path(one.epoch).name for one in (blind, seen, blind)
    ]
    assert len(drawn[0]) == 3
    for one, other in zip(*drawn, strict=True):
        assert np.abs(one - other).mean() < 0.01  # of 255
