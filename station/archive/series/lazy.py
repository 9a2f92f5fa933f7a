"""The whole series as one lazy xarray dataset."""

from __future__ import annotations

from pathlib import Path

import xarray as xr

from station.archive.series.index import data_folder, source_files
from station.errors import StoreError


def open_series(site_or_folder: str | Path) -> xr.Dataset:
    """Return the whole series of a site file or data folder as a lazy dataset.

    The service may write at the same time: it replaces `series.nc` as a whole and never changes the files
    that it refers to. Raises StoreError if there is no series, or if a source file is missing, which would
    read as no data.
    """
    path = data_folder(site_or_folder) / "series.nc"
    if not path.is_file():
        raise StoreError(f"{path}: no series yet; has a scan been processed? (station status)")
    missing = sorted(str(source) for source in source_files(path) if not source.is_file())
    if missing:
        raise StoreError(
            f"{path}: {len(missing)} of its source files are missing, the first is {missing[0]}: restore them"
        )
    return xr.open_dataset(path, engine="netcdf4", decode_timedelta=False)
