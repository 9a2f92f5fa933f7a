"""Series of two stores, or of two times, compared as a whole; copies that a test may change."""

from __future__ import annotations

import shutil
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import station
from station.archive.series.lazy import open_virtual

WHEN_WRITTEN = ("date_created", "history")


def copied(series, folder):
    """Return a store with copies of the files of another."""
    return replace(series, folder=shutil.copytree(series.folder, folder, dirs_exist_ok=True))


def without_dates(dataset):
    """Return a dataset without the attributes that say when its file was written."""
    return dataset.assign_attrs(dict.fromkeys(WHEN_WRITTEN, ""))


@contextmanager
def open_with_processing(folder):
    """Yield `series.nc` and `processing.nc` as one dataset."""
    with station.open(folder) as ds, open_virtual(Path(folder) / "processing.nc") as processing:
        yield ds.assign(processing.data_vars)
