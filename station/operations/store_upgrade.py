"""A store brought to this version of the program, and back to what it was before.

The store before an upgrade is kept in a folder of the data folder. NetCDF files are never changed in place,
so hard links keep them: they take space only for what is replaced later.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

from station._version import __version__
from station.archive.epochs import list_files
from station.archive.netcdf_layout import Series
from station.config import Site
from station.errors import StoreError
from station.inbox.journal import Journal
from station.inbox.journal_reader import JournalReader
from station.inbox.lock import IDENTITY, LOCK, exclusive_lock
from station.processing.integrity import verify_checksums
from station.processing.site_files import series_for
from station.processing.store_tasks import update_series

BEFORE = "before_upgrade_to_"  # and the version
AFTER = "after_upgrade_"  # and a time: what an upgrade and the scans after it had made
JOURNAL = "journal.sqlite"
NOT_KEPT = {"page", LOCK, IDENTITY}  # made again, or the same for ever
LINKED = {".nc", ".npy"}  # replaced as a whole, never written to


def upgrade(site: Site, report: Callable[[str], None]) -> None:
    """Keep the store as it is, and bring its journal and the files derived from its epochs to this version.

    Raises NotReadyError if a process uses the store, StoreError if a file is damaged or cannot be written.
    """
    series = series_for(site)
    _require_epochs(series)
    with exclusive_lock(series.folder):
        with JournalReader(series.folder / JOURNAL) as journal:
            damaged = verify_checksums(site, journal.checksums(), lambda: None).damaged
        if damaged:
            raise StoreError(
                f"{series.folder}: damaged: {', '.join(damaged)}: start the service, which processes their"
                " scans again, and upgrade after that; nothing was changed"
            )
        kept = _keep(series.folder)
        Journal(series.folder / JOURNAL).close()  # opened to write, it gets what older journals lack
        update_series(site, lambda: None)
    report(f"{series.folder}: now of version {__version__}; the values of its epochs are as they were")
    report(f"the store before is in {kept}: restore it by station upgrade --back, or delete it")


def take_back(site: Site, report: Callable[[str], None]) -> None:
    """Restore the store as it was before the last upgrade; what was made since is put aside, not deleted.

    If interrupted, it can be started again. Raises NotReadyError if a process uses the store, StoreError if
    there is nothing to restore, or a file cannot be written.
    """
    series = series_for(site)
    kept = next(series.folder.glob(f"{BEFORE}*"), None)
    if kept is None:
        raise StoreError(f"{series.folder}: has no {BEFORE}…: station upgrade did not upgrade this store")
    with exclusive_lock(series.folder):
        aside = series.folder / f"{AFTER}{datetime.now(UTC):%Y%m%dT%H%M%S.%fZ}"
        try:
            aside.mkdir()
            for entry in _entries(series.folder):
                entry.rename(aside / entry.name)
            _copy(kept, series.folder)
        except OSError as error:
            raise StoreError(
                f"{series.folder}: cannot be restored: {error}: start the command again"
            ) from error
    report(f"{series.folder}: as before the upgrade; now install the version that wrote it")
    report(f"what was made since is in {aside}; scans that arrived since are new to the older version")


def _require_epochs(series: Series) -> None:
    if not series.folder.is_dir() or not list_files(series):
        raise StoreError(f"{series.folder}: nothing is stored yet, so there is nothing to upgrade")


def _keep(data: Path) -> Path:
    """Keep the files of a data folder as they were before this version; return the folder with them.

    A second upgrade to the same version keeps what the first kept; what was before an earlier version is
    deleted.
    """
    kept, unfinished = data / f"{BEFORE}{__version__}", data / f".{BEFORE}{__version__}"
    if kept.is_dir():
        return kept
    try:
        shutil.rmtree(unfinished, ignore_errors=True)
        unfinished.mkdir()
        _copy(data, unfinished)
        for earlier in data.glob(f"{BEFORE}*"):
            shutil.rmtree(earlier)
        unfinished.rename(kept)
    except OSError as error:
        raise StoreError(f"{kept}: cannot be written: {error}; nothing was changed") from error
    return kept


def _copy(source: Path, target: Path) -> None:
    """Copy what an upgrade may change from one folder to another."""
    for entry in _entries(source):
        if entry.is_dir():
            shutil.copytree(entry, target / entry.name, copy_function=_link_or_copy)
        else:
            _link_or_copy(entry, target / entry.name)


def _entries(folder: Path) -> list[Path]:
    """Return files and folders of a data folder that an upgrade may change."""
    return [
        entry
        for entry in sorted(folder.iterdir())
        if entry.name not in NOT_KEPT and not entry.name.lstrip(".").startswith((BEFORE, AFTER))
    ]


def _link_or_copy(source: str | Path, target: str | Path) -> None:
    if Path(source).suffix in LINKED:
        os.link(source, target)
    else:
        shutil.copy2(source, target)
