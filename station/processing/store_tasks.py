"""Tasks on the store as a whole; they run in a worker process, as those of `scan_tasks`."""

from __future__ import annotations

import os
from collections.abc import Mapping
from contextlib import suppress
from datetime import UTC, datetime
from itertools import count
from pathlib import Path
from typing import NamedTuple

from station.archive import epochs
from station.archive.areas import update_areas
from station.archive.derived.level_files import damaged_levels, delete_levels
from station.archive.derived.product_files import product_path
from station.archive.reference_files import repair_reference_link
from station.archive.series import compaction
from station.archive.series.manifest import source_count
from station.archive.series.virtual import build_series
from station.config import Site
from station.errors import StoreError
from station.inbox.file_hash import sha256_file
from station.inbox.lock import is_locked
from station.processing.site_files import load_area_polygons, load_areas, load_products, series_for
from station.processing.workers.worker_process import Progress
from station.queries.aggregates import Aggregates
from station.queries.blocks import BlockQueries, update_boxes
from station.queries.events import EventQueries
from station.queries.levels import update_levels
from station.queries.site_products.product_queries import update_products
from station.sections.product import ProductSection, SurfaceTime

Checksums = dict[str, str]  # SHA-256 by file, relative to the data folder

# Source files of the series: beyond the limit of open files some readers return wrong data.
MAX_SOURCES = 250
MAX_STORE_TASK_S = 12 * 3600.0  # verifying terabytes takes hours; a task beyond this is in an endless loop
LOWEST_PRIORITY = 19  # nice value
MAX_UNCOMPACTED = 48  # of closed days, before they are compacted during a backlog
MAX_COMPUTED = 100  # entries of derived files and searches for events, for which the next scan waits


class SeriesUpdate(NamedTuple):
    """What an update of the series between two scans leaves to do."""

    compactable: int  # epochs
    is_behind: bool  # derived files lack so many epochs that the background completes them


class _TooManyError(Exception):
    """Derived files lack more epochs than the next scan can wait for."""


def update_series(site: Site, progress: Progress) -> int:
    """Update `series.nc` and the files derived from the epochs; return the number of compactable epochs.

    If there are too many source files, epochs are compacted first.
    """
    _update_virtual(site, progress)
    _update_derived(site, progress)
    return compaction.count_compactable(series_for(site))


def update_between_scans(site: Site, progress: Progress) -> SeriesUpdate:
    """Do as `update_series`, but leave derived files that lack many epochs to `renew_derived`.

    Otherwise scans would wait for hours when a file of a year is computed again.
    """
    computed = count(1)

    def limited() -> None:
        progress()
        if next(computed) > MAX_COMPUTED:
            raise _TooManyError

    _update_virtual(site, progress)
    is_behind = False
    try:
        _update_derived(site, limited)
    except _TooManyError:
        is_behind = True
    return SeriesUpdate(compaction.count_compactable(series_for(site)), is_behind)


def renew_derived(site: Site, progress: Progress) -> str:
    """Bring the files derived from the epochs up to date; return why they could not be, or ''."""
    try:
        _update_derived(site, progress)
    except StoreError as error:
        return str(error)
    return ""


def _update_virtual(site: Site, progress: Progress) -> None:
    """Update `series.nc`."""
    series = series_for(site)
    repair_reference_link(series)
    if source_count(series) > MAX_SOURCES:
        compaction.compact(series, compaction.latest_start(series), progress)
    build_series(series)
    progress()


def _update_derived(site: Site, progress: Progress) -> None:
    """Update the files of areas, products, events and blocks; `progress` is called for each epoch."""
    series = series_for(site)
    try:
        update_areas(series, load_areas(site), Aggregates(series), progress, load_area_polygons(site))
        products, _ = load_products(site)  # what is wrong with the others is reported with the input files
        update_products(series, products, [section.key for section in site.product], progress)
        blocks = BlockQueries(series)
        needed = EventQueries(series, blocks, site.scans.expected_every_s).update(progress)
        update_boxes(series, blocks, progress, needed)
    except (OSError, RuntimeError) as error:
        raise StoreError(f"{series.folder}: an epoch is damaged: {error}") from error


def renew_products(site: Site) -> list[str]:
    """Bring the files of products up to date, unless a service does; return why some have no values."""
    products, faults = load_products(site)
    if not is_locked(site.station.data):
        try:
            keys = [section.key for section in site.product]
            update_products(series_for(site), products, keys, lambda: None)
        except StoreError as error:
            faults.append(str(error))
    faults += [
        f"product {product.section.name}: {_why_empty(product.section)}"
        for product in products
        if not product_path(site.station.data, product.section.key).is_file()
    ]
    return faults


def _why_empty(section: ProductSection) -> str:
    """Return why a product has no values yet."""
    if not isinstance(section.surface, SurfaceTime):
        return "no scan has been measured against the reference yet"
    span = f"{section.surface.from_:%Y-%m-%d %H:%M} to {section.surface.to:%Y-%m-%d %H:%M} UTC"
    return f"its surface is that of {span}, which is not over, or has no usable scan"


def update_stored_levels(site: Site, verify: bool, progress: Progress) -> int:  # noqa: FBT001 - a task
    """Bring the files of levels up to date; return the number of files written.

    With `verify`, damaged ones are replaced. Raises StoreError if an epoch is damaged.
    """
    series = series_for(site)
    for path in damaged_levels(series) if verify else ():
        delete_levels(path)
    try:
        return update_levels(series, progress)
    except (OSError, RuntimeError) as error:
        raise StoreError(f"{series.folder}: an epoch is damaged: {error}") from error


def renew_levels(site: Site, progress: Progress) -> str:
    """Bring the files of levels up to date; return why they could not be, or ''."""
    try:
        update_stored_levels(site, False, progress)
    except StoreError as error:
        return str(error)
    return ""


def compact_epochs(
    site: Site, checksums: Mapping[str, str], now_s: float | None, progress: Progress
) -> Checksums:
    """Compact the days and months that are closed at `now_s`; return the checksums of the files written.

    `checksums` are those of the files of the store. Without `now_s`, as in a backlog, the newest epoch
    decides which are closed. Raises StoreError if a file to be compacted fails its checksum.
    """
    series = series_for(site)

    def verify(path: Path) -> None:
        progress()
        name = str(path.relative_to(series.folder))
        if name in checksums and sha256_file(path) != checksums[name]:
            raise StoreError(f"{path}: damaged: its checksum does not match")

    now = compaction.latest_start(series) if now_s is None else datetime.fromtimestamp(now_s, UTC)
    written = compaction.compact(series, now, progress, verify) if epochs.list_files(series) else []
    new_checksums = {}
    for path in written:
        progress()
        new_checksums[str(path.relative_to(series.folder))] = sha256_file(path)
    return new_checksums


def compact_low_priority(
    site: Site, checksums: Mapping[str, str], now_s: float | None, progress: Progress
) -> Checksums:
    """Do as `compact_epochs` at low priority, so that scans processed meanwhile come first."""
    with suppress(OSError):  # without permission it runs at normal priority
        os.nice(LOWEST_PRIORITY)
    return compact_epochs(site, checksums, now_s, progress)


def delete_expired(site: Site, now_s: float, progress: Progress) -> list[str]:
    """Delete files unused by the series for two days; return them, relative to the data folder."""
    progress()
    series = series_for(site)
    expired = compaction.delete_expired(series, datetime.fromtimestamp(now_s, UTC))
    return [str(path.relative_to(series.folder)) for path in expired]
