"""Damage to files of the store that opening them does not show."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest

from station.archive import epochs
from station.archive.series.virtual import build_series
from station.processing import integrity
from station.scan_names import scan_id

OBJECT_HEADER = b"OHDR"  # signature in HDF5, one for each variable


@pytest.fixture
def site(series, monkeypatch):
    monkeypatch.setattr(integrity, "series_for", lambda _: series)
    return SimpleNamespace()


@pytest.mark.integration
def test_a_damaged_description_of_any_variable_is_found(series, epoch, site):
    path = epochs.write_epoch(series, epoch(1)).path
    content = path.read_bytes()
    assert integrity.unreadable_files(site, lambda: None) == ()
    first = content.index(OBJECT_HEADER)  # the file itself
    headers, at = [], first
    while (at := content.find(OBJECT_HEADER, at + 1)) > 0:
        headers.append(at)
    assert len(headers) > 40
    for at in headers:
        damaged = bytearray(content)
        damaged[at + 12] ^= 0xFF
        path.write_bytes(damaged)
        assert integrity.unreadable_files(site, lambda: None) == (str(path.relative_to(series.folder)),), at


@pytest.mark.parametrize("is_epoch_damaged", [False, True])
def test_damage_of_the_series_is_reported_also_without_an_intact_epoch(series, epoch, site, is_epoch_damaged):
    path = epochs.write_epoch(series, epoch(1)).path
    build_series(series)
    with series.path.open("r+b") as file:
        file.seek(100)
        file.write(b"x")
    checksums = {}
    if is_epoch_damaged:
        checksums = {str(path.relative_to(series.folder)): "of other bytes"}
    findings = integrity.check_store(site, [], checksums, lambda: None)
    damaged = [text for level, _, text in findings if level == "fault" and "processing.nc is damaged" in text]
    assert damaged


@pytest.mark.parametrize("is_archived", [False, True])
def test_a_lost_journal_gets_the_names_of_scans_that_are_too_long_for_the_store(
    series, epoch, make_site, monkeypatch, is_archived
):
    monkeypatch.setattr(integrity, "series_for", lambda _: series)
    long = f"{'Hintereisferner' * 5}.PROJ/ScanPos001.SCNPOS/scans"
    names = [f"{long}/251121_{hour:02d}0000.las" for hour in (1, 2)] + ["a/b/c/251121_030000.laz"]
    site = make_site(more='[retention]\narchive = "archive"\n')
    scans = site.scans.model_copy(update={"name": "*/*/*/%y%m%d_%H%M%S"})
    site = site.model_copy(update={"scans": scans})
    folder = site.retention.archive / "2025/11" if is_archived else site.scans.inbox
    for hour, name in enumerate(names, start=1):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"scan")
        epochs.write_epoch(series, replace(epoch(hour), scan_id=scan_id(name)))
    build_series(series)
    rows = integrity.unjournaled_epochs(site, {}, lambda: None)
    assert sorted(row.name for row in rows) == sorted(names)
