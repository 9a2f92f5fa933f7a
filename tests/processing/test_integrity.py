"""Damage to files of the store that opening them does not show."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from station.archive import epochs
from station.archive.series.virtual import build_series
from station.processing import integrity

OBJECT_HEADER = b"OHDR"  # signature in HDF5, one for each variable


@pytest.fixture
def site(series, monkeypatch):
    monkeypatch.setattr(integrity, "series_for", lambda _: series)
    return SimpleNamespace()


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
