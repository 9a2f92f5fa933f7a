"""Series of two stores, or of two times, compared as a whole."""

from __future__ import annotations

import station

WHEN_WRITTEN = ("date_created", "history")


def without_dates(dataset):
    """Return a dataset without the attributes that say when its file was written."""
    return dataset.assign_attrs(dict.fromkeys(WHEN_WRITTEN, ""))


def open_with_processing(folder):
    """Return `series.nc` and `processing.nc` as one dataset."""
    ds = station.open(folder)
    return ds.assign(ds.station.processing.data_vars)
