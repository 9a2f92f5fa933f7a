"""What the series keeps once per scan, and the series of areas, as plain columns."""

from __future__ import annotations

from dataclasses import dataclass

import h5py
import netCDF4
import numpy as np
from isal.igzip_lib import IsalError

from station.archive.areas import AREA_VARIABLES
from station.archive.layout import Series, strings
from station.archive.tiles import column
from station.archive.variables import FILL, VERDICTS
from station.errors import StoreError
from station.quantities import Floats

NUMBERS = (
    "platform_roll", "platform_pitch", "air_temperature", "air_pressure", "point_total", "coverage",
    "stable_median", "stable_nmad", "stable_z_std",
)  # fmt: skip
WORDS = ("scan_id", "epoch_file", "verdict_reason", "reference_version")


@dataclass(frozen=True)
class Record:
    """All epochs in the order of time."""

    start_s: Floats  # (t,) seconds since 1970, of the scan's beginning
    verdict: list[str]
    numbers: dict[str, Floats]  # (t,) NaN where missing
    words: dict[str, list[str]]

    def __len__(self) -> int:
        """Return how many epochs there are."""
        return len(self.start_s)


@dataclass(frozen=True)
class AreaRecord:
    """One area over time; all (t,)."""

    name: str
    size_m2: float
    start_s: Floats
    columns: dict[str, Floats]


def read_record(series: Series) -> Record:
    """Read it from `series.nc`; raise StoreError where that cannot be."""
    try:
        with h5py.File(series.path, "r") as file:
            numbers = {name: np.asarray(file[name][:], dtype=np.float64) for name in NUMBERS}
            return Record(
                start_s=np.asarray(file["time_bnds"][:, 0], dtype=np.float64),
                verdict=[VERDICTS[one] for one in file["verdict"][:].tolist()],
                numbers={name: np.where(one < FILL / 2, one, np.nan) for name, one in numbers.items()},
                words={name: strings(column(file[name])) for name in WORDS},
            )
    except (OSError, RuntimeError, KeyError, IndexError, ValueError, IsalError) as error:  # type: ignore[misc] # the stub has no class
        raise StoreError(f"{series.path}: cannot be read: {error}") from error


def read_areas(series: Series) -> list[AreaRecord]:
    """Read all areas from `areas.nc`; none where there is no such file, or one of an older version."""
    path = series.folder / "areas.nc"
    if not path.is_file():
        return []
    try:
        with netCDF4.Dataset(path) as file:
            start_s = np.asarray(file["time_bnds"][:, 0], dtype=np.float64)
            names = [str(name) for name in file["area_name"][:]]
            size_m2 = _column(file["area_size"])
            over_time = [row.name for row in AREA_VARIABLES if row.dims == ("time", "area")]
            if not set(over_time) <= set(file.variables):
                return []
            columns = {name: _column(file[name]) for name in over_time}
    except (OSError, RuntimeError, KeyError, IndexError) as error:
        raise StoreError(f"{path}: cannot be read: {error}") from error
    return [
        AreaRecord(name, float(size_m2[i]), start_s, {key: column[:, i] for key, column in columns.items()})
        for i, name in enumerate(names)
    ]


def _column(variable: netCDF4.Variable) -> Floats:  # type: ignore[type-arg]
    return np.asarray(np.ma.filled(variable[:].astype(np.float64), np.nan))
