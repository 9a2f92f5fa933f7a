"""A permanently mounted laser scanner as a measuring instrument.

`station.open(site_or_folder)` gives the whole series of a station as one lazy `xarray.Dataset`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

    import xarray as xr

__version__ = "0.1.0"


def open(site_or_folder: str | Path) -> xr.Dataset:  # noqa: A001 - reads well as station.open(...)
    """Return the whole series of a station: one lazy dataset, at any moment, also while it is written.

    Takes a site file or the station's data folder; raises StoreError where there is no series yet.
    """
    from station.archive.store import open_series  # noqa: PLC0415 - importing station stays cheap

    return open_series(site_or_folder)
