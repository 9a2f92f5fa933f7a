"""Write an epoch, never lose one; say what is stored; open the series."""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import netCDF4
import numpy as np
import xarray as xr

from station.archive.layout import Series, define, lay_out, put_raster, text, written_whole
from station.archive.variables import BY_NAME, TERMS, VARIABLES, VERDICTS
from station.errors import StoreError
from station.quantities import Measurement, Shared

STAMP = "%Y%m%dT%H%M%SZ"
_EPOCH_NAME = re.compile(r"_(\d{8}T\d{6}Z)(?:_r(\d+))?\.nc$")


@dataclass(frozen=True)
class Epoch:
    """One scan, measured.

    `numbers` are by the name of a variable over time; `provenance` is by the name of a text variable.
    """

    start_s: float  # seconds since 1970
    end_s: float
    scan_id: str
    measurement: Measurement
    shared: Shared | None
    verdict: str
    verdict_reason: str
    numbers: dict[str, float]
    provenance: dict[str, str]


@dataclass(frozen=True)
class Stored:
    """An epoch file: when its scan began, and which revision of that it is."""

    path: Path
    start: datetime
    revision: int


def write_epoch(series: Series, epoch: Epoch) -> Stored:
    """Write an epoch beside the series; raise StoreError where it cannot, and leave nothing then.

    A second epoch of the same start is a new revision; no file is ever changed.
    """
    start = datetime.fromtimestamp(epoch.start_s, UTC)
    revision = 1 + max((one.revision for one in revisions(series, start)), default=0)
    tail = f"_r{revision}" if revision > 1 else ""
    path = epoch_folder(series, start) / f"{series.station_id}_{start.strftime(STAMP)}{tail}.nc"
    with written_whole(path) as beside, netCDF4.Dataset(beside, "w", clobber=False) as file:
        _write(file, series, epoch, path.name)
    return Stored(path, start, revision)


def epoch_folder(series: Series, start: datetime) -> Path:
    """Return the folder of the epochs of a day."""
    return series.folder / "epochs" / start.strftime("%Y") / start.strftime("%m") / start.strftime("%d")


def revisions(series: Series, start: datetime) -> list[Stored]:
    """Return the epoch files of one start, oldest first."""
    pattern = f"{series.station_id}_{start.strftime(STAMP)}*.nc"
    found = (stored(path) for path in epoch_folder(series, start).glob(pattern))
    return sorted((one for one in found if one), key=lambda one: one.revision)


def epochs(series: Series) -> list[Stored]:
    """Return all epoch files, by start and revision."""
    found = (stored(path) for path in (series.folder / "epochs").glob("*/*/*/*.nc"))
    return sorted((one for one in found if one), key=lambda one: (one.start, one.revision))


def stored(path: Path) -> Stored | None:
    """Read start and revision off the name of an epoch file; None for another file."""
    told = _EPOCH_NAME.search(path.name)
    if told is None or path.name.startswith("."):
        return None
    start = datetime.strptime(told[1], STAMP).replace(tzinfo=UTC)
    return Stored(path, start, int(told[2] or 1))


def said(path: Path) -> dict[str, str]:
    """Return what an epoch file says of its origin: its text variables; raise StoreError if unreadable."""
    try:
        with netCDF4.Dataset(path) as file:
            return {
                row.name: str(file[row.name][0])
                for row in VARIABLES
                if row.dtype == "S1" and row.name in file.variables
            } | {"verdict": VERDICTS[int(file["verdict"][0])]}
    except (OSError, RuntimeError) as error:
        raise StoreError(f"{path}: cannot be read: {error}") from error


def open_series(site_or_folder: str | Path) -> xr.Dataset:
    """Return the whole series of a site file or data folder, lazily; raise StoreError where there is none."""
    place = Path(site_or_folder)
    if place.is_file() and place.suffix == ".toml":
        from station.config import read_site  # noqa: PLC0415 - a folder needs no pydantic

        place = read_site(place).station.data
    path = place / "series.nc"
    if not path.is_file():
        raise StoreError(f"{path}: no series yet; has a scan been processed? (station status)")
    return xr.open_dataset(path, engine="netcdf4", decode_timedelta=False)


def _write(file: netCDF4.Dataset, series: Series, epoch: Epoch, name: str) -> None:
    shared = epoch.shared
    parameters = (shared.names, shared.units) if shared is not None else ((), ())
    title = f"Elevation change at {series.name or series.station_id}, one scan"
    lay_out(file, series, title, 1, parameters)
    file["time"][0] = (epoch.start_s + epoch.end_s) / 2
    file["time_bnds"][0] = (epoch.start_s, epoch.end_s)
    measured = epoch.measurement
    rasters: dict[str, np.ndarray[Any, Any]] = {
        "elevation": measured.surface.elevation_m,
        "elevation_change": measured.surface.change_m,
        "elevation_change_uncertainty": measured.uncertainty_m,
        "elevation_change_random_uncertainty": measured.random_uncertainty_m,
        "elevation_spread": measured.surface.spread_m,
        "point_count": measured.surface.count,
        "quality": measured.quality,
        **{term: measured.terms[term] for term in TERMS if term in measured.terms},
    }
    for raster, values in rasters.items():
        put_raster(define(file, BY_NAME[raster], series), 0, values)
    if shared is not None:
        define(file, BY_NAME["shared_parameter"], series)[0] = shared.estimate
        define(file, BY_NAME["shared_parameter_covariance"], series)[0] = shared.covariance
    _write_words(file, series, epoch, name)


def _write_words(file: netCDF4.Dataset, series: Series, epoch: Epoch, name: str) -> None:
    """Write what there is one of per scan: numbers and texts."""
    words = {
        "scan_id": epoch.scan_id,
        "verdict_reason": epoch.verdict_reason,
        "epoch_file": name,
        **epoch.provenance,
    }
    for row in VARIABLES:
        if row.dims == ("time",):
            value = VERDICTS.index(epoch.verdict) if row.name == "verdict" else epoch.numbers.get(row.name)
            variable = define(file, row, series)
            variable[0] = value if value is not None and np.isfinite(value) else np.ma.masked
        elif row.dtype == "S1":
            define(file, row, series)[0] = text([words.get(row.name, "")], row.dims[1])[0]
