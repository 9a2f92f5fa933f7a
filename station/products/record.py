"""What the series keeps once per scan, and the series of areas, as plain columns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import h5py
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
            return Record(
                start_s=np.asarray(file["time_bnds"][:, 0], dtype=np.float64),
                verdict=[VERDICTS[one] for one in file["verdict"][:].tolist()],
                numbers={name: _known(file[name][:]) for name in NUMBERS},
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
        with h5py.File(path, "r") as file:
            over_time = [row.name for row in AREA_VARIABLES if row.dims == ("time", "area")]
            if not set(over_time) <= set(file):
                return []
            start_s = np.asarray(file["time_bnds"][:, 0], dtype=np.float64)
            names = [name.tobytes().rstrip(b"\0").decode() for name in file["area_name"][:]]
            size_m2 = file["area_size"][:]
            columns = {name: _known(column(file[name])) for name in over_time}
    except (OSError, RuntimeError, KeyError, IndexError, ValueError, IsalError) as error:  # type: ignore[misc] # the stub has no class
        raise StoreError(f"{path}: cannot be read: {error}") from error
    return [
        AreaRecord(name, float(size_m2[i]), start_s, {key: one[:, i] for key, one in columns.items()})
        for i, name in enumerate(names)
    ]


def _known(values: np.ndarray[Any, Any]) -> Floats:
    """Return values, NaN where they are missing."""
    told = values.astype(np.float64)
    return np.where(told < FILL / 2, told, np.nan)
