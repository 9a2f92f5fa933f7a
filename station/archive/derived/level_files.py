"""`levels/`: level and rate of each cell, one immutable file for each day and month, and the filter's state.

The name of a file ends in a part of the hash of everything that it was computed from. A file that is
out of date is therefore not looked for, and never changed.
"""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import netCDF4
import numpy as np

from station.archive.atomic_files import atomic_write
from station.archive.derived.fingerprints import fingerprints_path, is_intact, write_fingerprints
from station.archive.discovery import time_coverage
from station.archive.netcdf_layout import Series, create_file, create_variable, encode_text
from station.archive.raster_io import Array, LazyRaster, rounded, write_rasters
from station.archive.schema import BY_NAME, FILL, RASTER, Variable

FOLDER, STATE_FOLDER = "levels", ".levels"
DAY_DIGITS = len("20261121")
KEY_DIGITS = 8  # of the hash in the name of a file
KEY_ATTRIBUTE = "sources_sha256"
_ONE_SIGMA = "one standard deviation of a single cell"
_RANDOM = f"{_ONE_SIGMA}; the part that is independent between cells"
_SYSTEMATIC = f"{_ONE_SIGMA}; the part that cells have in common, which a mean does not reduce"


def _pair(name: str, units: str, long_name: str, digits: int) -> tuple[Variable, ...]:
    """Return a quantity with its random and systematic uncertainty."""
    random, systematic = f"{name}_random_uncertainty", f"{name}_systematic_uncertainty"
    return (
        Variable(
            name, RASTER, "f4", long_name, units, digits=digits, ancillary=(random, systematic, "coverage")
        ),
        Variable(
            random, RASTER, "f4", f"random uncertainty of the {name}", units, digits=digits, comment=_RANDOM
        ),
        Variable(
            systematic,
            RASTER,
            "f4",
            f"systematic uncertainty of the {name}",
            units,
            digits=digits,
            comment=_SYSTEMATIC,
        ),
    )


LEVEL_VARIABLES = (
    *_pair("level", "m", "elevation above the reference surface at the end, filtered over time", 4),
    *_pair("rate", "m d-1", "rate of the level", 4),
    Variable(
        "coverage",
        RASTER,
        "f4",
        "share of the epochs that observed the cell",
        "1",
        digits=2,
        comment="0 where the level is extrapolated",
    ),
)
LEVEL_NAMES = tuple(variable.name for variable in LEVEL_VARIABLES)
RATE_COMMENTS = {
    "day": "mean since the end of the day before, with snowfall, without steps such as avalanches",
    "month": "mean since the end of the month before, steps included",
}
EPOCH_COUNT = Variable("epoch_count", ("time",), "f8", "number of epochs of the period", "1")


@dataclass(frozen=True)
class LevelPeriod:
    """A day or month of levels: times [s since 1970], and what it is computed from."""

    name: str  # "20261121" or "202611"
    key: str  # hash of what it is computed from, the days before it included
    version: str  # of the reference
    start_s: float  # of the first epoch
    end_s: float  # of the last epoch
    time_s: float  # of the level: the middle of the last epoch
    epoch_count: int

    @property
    def noun(self) -> str:
        """What it is: a day or a month."""
        return "day" if len(self.name) == DAY_DIGITS else "month"


def level_path(series: Series, period: LevelPeriod) -> Path:
    """Return the file of a period."""
    name = f"{series.station_id}_{period.name}_{period.key[:KEY_DIGITS]}.nc"
    return series.folder / FOLDER / period.name[:4] / name


def level_files(series: Series) -> list[Path]:
    """Return all files of levels, in order of their names."""
    return sorted((series.folder / FOLDER).glob(f"*/{series.station_id}_*.nc"))


def is_day(path: Path) -> bool:
    """Return True if a file is that of a day, not of a month."""
    return len(path.stem.split("_")[-2]) == DAY_DIGITS


def is_current(series: Series, period: LevelPeriod) -> bool:
    """Return True if the file of a period exists and is complete; its name says what it was computed from."""
    path = level_path(series, period)
    return path.is_file() and fingerprints_path(path).is_file()


def write_levels(
    series: Series, period: LevelPeriod, get_rows: Callable[[slice], Mapping[str, Array]]
) -> Path:
    """Write the file of a period and return its path.

    `get_rows` returns some rows (r, nx) of each variable of `LEVEL_VARIABLES`, as `encoded` returns them.
    Raises StoreError if it cannot be written.
    """
    path = level_path(series, period)
    title = f"Level and rate of the surface at {series.name or series.station_id}, {period.name}"
    with atomic_write(path) as tmp_path:
        with netCDF4.Dataset(tmp_path, "w", clobber=False) as file:
            create_level_file(file, series, title, 1, period.noun)
            file.setncatts(time_coverage(period.start_s, period.end_s) | {KEY_ATTRIBUTE: period.key})
            file["time"][0], file["time_bnds"][0] = period.time_s, (period.start_s, period.end_s)
            file["epoch_count"][0] = period.epoch_count
            file["reference_version"][0] = encode_text([period.version], "text")[0]
        write_rasters(tmp_path, LEVEL_VARIABLES, lambda rows: _ordered(get_rows(rows)))
        write_fingerprints(path, tmp_path)
    return path


def create_level_file(file: netCDF4.Dataset, series: Series, title: str, times: int, noun: str) -> None:
    """Write everything into a new file of days or months (`noun`) but its values."""
    create_file(file, series, title, times)
    file["time"].long_name = f"middle of the last epoch of the {noun}"
    for spec in (EPOCH_COUNT, BY_NAME["reference_version"], *LEVEL_VARIABLES):
        create_variable(file, spec, series, times)
    file["rate"].comment = RATE_COMMENTS[noun]


def _ordered(rasters: Mapping[str, Array]) -> list[Array]:
    return [rasters[name] for name in LEVEL_NAMES]


def encoded(rasters: Mapping[str, Array]) -> dict[str, Array]:
    """Return rasters of `LEVEL_VARIABLES` as they are stored: rounded, with the fill value for NaN."""
    return {spec.name: rounded(spec, np.asarray(rasters[spec.name], np.float32)) for spec in LEVEL_VARIABLES}


def decoded(values: Array) -> Array:
    """Return stored values with NaN for the fill value."""
    return np.where(values == np.float32(FILL), np.float32(np.nan), values)


def level_raster(path: Path, name: str) -> LazyRaster:
    """Return a raster of a file of levels, read on access; raise StoreError if it cannot be read."""
    return LazyRaster(path, name, transform=decoded, index=0)


def delete_other_files(series: Series, periods: Iterable[LevelPeriod]) -> None:
    """Delete the files of levels that are not those of `periods`, with their fingerprints."""
    current = {level_path(series, period) for period in periods}
    for path in level_files(series):
        if path not in current:
            delete_levels(path)


def delete_levels(path: Path) -> None:
    """Delete a file of levels; the service computes it again if it is needed."""
    for file in (path, fingerprints_path(path)):
        with suppress(OSError):
            file.unlink()


def damaged_levels(series: Series) -> list[Path]:
    """Return the files of levels that differ from what was written."""
    return [path for path in level_files(series) if not is_intact(path)]


def write_state(series: Series, period: LevelPeriod, arrays: Mapping[str, Array]) -> None:
    """Keep the state of the filter at the end of a day; skipped without an error if the disk is full."""
    path = _state_path(series, period)
    tmp_path = path.with_name(f".{path.name}.part")
    with suppress(OSError):
        path.parent.mkdir(exist_ok=True)
        with tmp_path.open("wb") as file:
            np.savez(file, allow_pickle=False, **arrays)
        tmp_path.replace(path)


def has_state(series: Series, period: LevelPeriod) -> bool:
    """Return True if the state at the end of a day is kept."""
    return _state_path(series, period).is_file()


def read_state(series: Series, period: LevelPeriod) -> dict[str, Array] | None:
    """Return the state of the filter at the end of a day; None if it is not kept, or damaged."""
    try:
        with _state_path(series, period).open("rb") as opened, np.load(opened) as file:
            return {name: file[name] for name in file.files}  # each has a checksum
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None


def delete_states(series: Series, kept: Iterable[LevelPeriod]) -> None:
    """Delete the states of all days but those `kept`."""
    current = {_state_path(series, period) for period in kept}
    for path in (series.folder / STATE_FOLDER).glob(f"{series.station_id}_*.npz"):
        if path not in current:
            with suppress(OSError):
                path.unlink()


def _state_path(series: Series, period: LevelPeriod) -> Path:
    return series.folder / STATE_FOLDER / f"{series.station_id}_{period.name}_{period.key[:KEY_DIGITS]}.npz"
