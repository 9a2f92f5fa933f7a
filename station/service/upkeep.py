"""What is done with the store as a whole: each function runs in a child process, as those of `tasks`."""

from __future__ import annotations

from datetime import UTC, datetime

from station.archive import join, store
from station.archive.aggregate import Aggregates
from station.archive.areas import update_areas
from station.archive.reference import settle_reference
from station.archive.series import build_series
from station.config import Site
from station.errors import StoreError
from station.service.tasks import Progress, areas_of, series_of

# Of the series: each costs 7 ms with every scan; and past the limit of open files some readers return wrong
# data.
MOST_SOURCES = 150


def publish(site: Site, progress: Progress) -> None:
    """Build `series.nc` anew over the epochs that exist, and `areas.nc` after it.

    Epochs are joined first where they are too many files.
    """
    series = series_of(site)
    settle_reference(series)
    if max(len(store.sources(series.path)), len(store.epochs(series))) > MOST_SOURCES:
        join.join_closed(series, datetime.now(UTC), progress)
    build_series(series)
    progress()
    try:
        update_areas(series, areas_of(site), Aggregates(series), progress)
    except (OSError, RuntimeError) as error:
        raise StoreError(f"{series.folder}: an epoch is damaged: {error}") from error


def join_epochs(site: Site, progress: Progress) -> int:
    """Join closed days and months; return how many files that made."""
    series = series_of(site)
    return join.join_closed(series, datetime.now(UTC), progress) if store.rows(series) else 0


def sweep_store(site: Site, progress: Progress) -> list[str]:
    """Delete what the series has not named for two days; return what went, relative to the data folder."""
    progress()
    series = series_of(site)
    return [str(path.relative_to(series.folder)) for path in join.sweep(series, datetime.now(UTC))]
