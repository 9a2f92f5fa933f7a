"""What is done with the store as a whole: each function runs in a child process, as those of `tasks`."""

from __future__ import annotations

import os
from collections.abc import Mapping
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path

from station.archive import join, store
from station.archive.aggregate import Aggregates
from station.archive.areas import update_areas
from station.archive.reference import settle_reference
from station.archive.series import build_series
from station.config import Site
from station.errors import StoreError
from station.service.content import sha256_of
from station.service.tasks import Progress, areas_of, series_of

Checksums = dict[str, str]  # SHA-256 by file, relative to the data folder

# Of the series: past the limit of open files some readers return wrong data.
MOST_SOURCES = 250
LEAST_URGENT = 19  # of a process, to the kernel
OPEN_EPOCHS = 48  # of closed days, that lie by themselves before they are joined amid a backlog


def publish(site: Site, progress: Progress) -> int:
    """Bring `series.nc` up to the epochs that exist, and `areas.nc` after it.

    Epochs are joined first where they are too many files. Returns how many epochs lie by themselves that
    could be joined.
    """
    series = series_of(site)
    settle_reference(series)
    if len(store.sources(series.path)) > MOST_SOURCES:
        join.join_closed(series, join.now_of(series), progress)
    build_series(series)
    progress()
    try:
        update_areas(series, areas_of(site), Aggregates(series), progress)
    except (OSError, RuntimeError) as error:
        raise StoreError(f"{series.folder}: an epoch is damaged: {error}") from error
    return join.count_closed(series)


def join_epochs(
    site: Site, known: Mapping[str, str], progress: Progress, *, in_backlog: bool = False
) -> Checksums:
    """Join closed days and months; return the checksums of the files that made.

    `known` are those of the store's files. `in_backlog`: what is closed in the time of the series. Raises
    StoreError where a file that is to be joined does not match.
    """
    series = series_of(site)

    def prove(path: Path) -> None:
        progress()
        name = str(path.relative_to(series.folder))
        if name in known and sha256_of(path) != known[name]:
            raise StoreError(f"{path}: damaged: its checksum is another")

    now = join.now_of(series) if in_backlog else datetime.now(UTC)
    made = join.join_closed(series, now, progress, prove) if store.listing(series) else []
    found = {}
    for path in made:
        progress()
        found[str(path.relative_to(series.folder))] = sha256_of(path)
    return found


def join_beside(
    site: Site,
    known: Mapping[str, str],
    in_backlog: bool,  # noqa: FBT001 - a task has no keywords
    progress: Progress,
) -> Checksums:
    """Do as `join_epochs`, and let the scans that are taken meanwhile go first."""
    with suppress(OSError):  # where that is forbidden it is as urgent as they are
        os.nice(LEAST_URGENT)
    return join_epochs(site, known, progress, in_backlog=in_backlog)


def sweep_store(site: Site, progress: Progress) -> list[str]:
    """Delete what the series has not named for two days; return what went, relative to the data folder."""
    progress()
    series = series_of(site)
    return [str(path.relative_to(series.folder)) for path in join.sweep(series, datetime.now(UTC))]
