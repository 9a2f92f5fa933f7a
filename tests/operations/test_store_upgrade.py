"""The upgrade of a store that an older version of the program wrote, and the way back."""

import hashlib
import tarfile
from pathlib import Path

import netCDF4
import numpy as np
import pytest

import station
from station._version import __version__
from station.config import read_site
from station.errors import NotReadyError, StoreError
from station.inbox.journal_reader import JournalReader
from station.inbox.lock import exclusive_lock
from station.operations import store_upgrade
from station.operations.batch import process_scans

# A station of three scans, of which the program of 24 November 2026 processed the first two.
OLD_STORE = Path(__file__).with_name("store_of_2026-11-24.tar.xz")
IGNORE = [].append
RASTERS = ("elevation_change", "elevation", "elevation_change_uncertainty", "quality")


@pytest.fixture
def site(tmp_path):
    with tarfile.open(OLD_STORE) as archive:
        archive.extractall(tmp_path, filter="data")
    return read_site(tmp_path / "station" / "site.toml")


def hashes(folder):
    """Return the hash of each file of a data folder by its path, but those that an upgrade leaves alone."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in folder.rglob("*")
        if path.is_file() and path.relative_to(folder).parts[0] not in {"page", "service.lock", ".store_id"}
    }


def stored_rasters(data):
    """Return the rasters of the newest revisions, read from the files of the older version."""
    rasters = {}
    for name in RASTERS:
        values = []
        for newest in ("T000000Z_r2.nc", "T010000Z.nc"):
            (path,) = data.glob(f"epochs/2025/07/15/*{newest}")
            with netCDF4.Dataset(path) as file:
                values.append(np.ma.filled(file[name][0].astype(np.float64), np.nan))
        rasters[name] = np.array(values)
    return rasters


def fail(*_):
    raise OSError(28, "No space left on device")


@pytest.mark.integration
def test_every_value_is_kept_and_new_scans_continue_the_series(site, capsys):
    data = site.station.data
    expected, before = stored_rasters(data), hashes(data)
    store_upgrade.upgrade(site, print)
    store_upgrade.upgrade(site, print)  # as after an interruption
    assert f"version {__version__}" in capsys.readouterr().out
    assert hashes(data / f"before_upgrade_to_{__version__}") == before
    assert {name: value for name, value in hashes(data).items() if name.startswith("epochs")} == {
        name: value for name, value in before.items() if name.startswith("epochs")
    }
    assert process_scans(site, sorted(site.scans.inbox.glob("*.laz"))[-1:], IGNORE) == 0
    with station.open(data) as ds:
        assert ds.sizes["time"] == 3
        for name in RASTERS:
            values = ds[name][:2].values.astype(np.float64)
            seen = np.isfinite(expected[name]) & (expected["quality"] > 0)
            np.testing.assert_array_equal(values[seen], expected[name][seen], err_msg=name)
            assert np.count_nonzero(seen) > 100


@pytest.mark.integration
def test_the_way_back_restores_every_file_and_loses_nothing(site, monkeypatch):
    data, scans = site.station.data, sorted(site.scans.inbox.glob("*.laz"))
    before = hashes(data)
    store_upgrade.upgrade(site, print)
    process_scans(site, scans[-1:], IGNORE)
    upgraded = {name: value for name, value in hashes(data).items() if "before_upgrade" not in name}
    with monkeypatch.context() as full_disk:
        full_disk.setattr(store_upgrade, "_copy", fail)
        with pytest.raises(StoreError, match="start the command again"):
            store_upgrade.take_back(site, print)
    store_upgrade.take_back(site, print)
    asides = [hashes(folder) for folder in data.glob("after_upgrade_*")]
    assert upgraded in asides
    kept = ("before_upgrade", "after_upgrade")
    assert {name: value for name, value in hashes(data).items() if not name.startswith(kept)} == before
    with JournalReader(data / "journal.sqlite") as journal:
        assert journal.entry(scans[-1].name) is None  # so that the older version processes it


def test_a_damaged_store_or_one_in_use_is_not_touched(site):
    data = site.station.data
    with exclusive_lock(data), pytest.raises(NotReadyError, match="in use by another station process"):
        store_upgrade.upgrade(site, print)
    with pytest.raises(StoreError, match="did not upgrade this store"):
        store_upgrade.take_back(site, print)
    path = next(data.glob("epochs/*/*/*/*T010000Z.nc"))
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    before = hashes(data)
    with pytest.raises(StoreError, match=r"damaged: epochs/2025/07/15/.*T010000Z\.nc"):
        store_upgrade.upgrade(site, print)
    assert hashes(data) == before


def test_a_full_disk_changes_nothing(site, monkeypatch):
    before = hashes(site.station.data)
    monkeypatch.setattr(store_upgrade.os, "link", fail)
    with pytest.raises(StoreError, match="No space left on device; nothing was changed"):
        store_upgrade.upgrade(site, print)
    kept = {name: value for name, value in hashes(site.station.data).items() if "before_upgrade" not in name}
    assert kept == before
