"""Series of two stores, or of two times, compared as a whole."""

from __future__ import annotations

WHEN_WRITTEN = ("date_created", "history")


def without_dates(dataset):
    """Return a dataset without the attributes that say when its file was written."""
    return dataset.assign_attrs(dict.fromkeys(WHEN_WRITTEN, ""))
