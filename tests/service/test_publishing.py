"""Publishing follows storing and never blocks it."""

import json
import logging
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import station
from station.config import read_site
from station.inbox.journal import Journal
from station.operations.batch import process_scans
from station.processing import epoch_recorder
from station.processing.epoch_recorder import page_folder
from station.processing.reference_tasks import build_reference_version
from station.processing.scan_tasks import ScanHistory, process_new
from station.processing.scans.scan_files import scan_file
from station.processing.store_tasks import update_series
from station.products import gallery
from station.products.overview import read_overview
from station.service.publishing import PublishResult, publish
from station.simulation.station import simulate, small

pytestmark = pytest.mark.integration


def test_unwritable_page_does_not_stop_storing(tmp_path, caplog):
    simulate(tmp_path, replace(small(hours=2), avalanche_m=0.0))
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
    publish(site, None, lambda: None)
    body = (page_folder(site) / "data.js").read_text()
    data = json.loads(body.removeprefix("window.STATION=").removesuffix(";\n"))
    assert len(data["maps"]) == 2
    assert all(seconds > 0 for seconds in data["health"]["seconds"])
    assert {path.suffix for path in (site.station.data / "geotiff").iterdir()} == {".tif", ".qml"}


def test_previews_come_from_memory_and_their_failure_loses_no_epoch(tmp_path, monkeypatch):
    simulate(tmp_path, replace(small(hours=2), avalanche_m=0.0))
    path = tmp_path / "site.toml"
    path.write_text(path.read_text() + "\n[products]\nchange_limit_m = 0.2\nquicklook_width_px = 500\n")
    site = read_site(path)
    site.station.data.mkdir()
    scans = [scan_file(site, path) for path in sorted(site.scans.inbox.glob("*.laz"))]
    build_reference_version(site, scans, "1", lambda: None)
    with monkeypatch.context() as broken:
        broken.setattr(epoch_recorder.OverviewBuilder, "add", lambda *_: 1 / 0)
        broken.setattr(epoch_recorder.EpochSummer, "add", lambda *_: 1 / 0)
        without_overview = process_new(site, scans[0], ScanHistory(), lambda: None)
    with_overview = process_new(site, scans[1], ScanHistory(), lambda: None)
    kept = [path.name for path in (site.station.data / ".block_sums").iterdir()]
    assert kept == [f"{Path(with_overview.epoch).name}.npz"]
    assert (without_overview.overview, without_overview.verdict) == (None, with_overview.verdict)
    update_series(site, lambda: None)
    Journal(site.station.data / "journal.sqlite").close()

    read = []
    monkeypatch.setattr(
        gallery, "read_overview", lambda row, *_, **__: read.append(row) or read_overview(row, *_, **__)
    )
    images = []
    for result in (with_overview, None):
        shutil.rmtree(page_folder(site) / "maps", ignore_errors=True)
        assert publish(site, result, lambda: None) == PublishResult("", "")
        newest = sorted((page_folder(site) / "maps").glob(f"{Path(with_overview.epoch).stem}_*.webp"))
        images.append([np.asarray(Image.open(path), dtype=float) for path in newest])
    assert [Path(row.epoch_file).name for row in read] == [
        Path(result.epoch).name for result in (without_overview, with_overview, without_overview)
    ]
    assert len(images[0]) == 1
    for actual, expected in zip(*images, strict=True):
        assert np.abs(actual - expected).mean() < 0.01  # of 255
