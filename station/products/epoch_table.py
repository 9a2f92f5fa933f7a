"""The epochs of the series, and the series of areas, as tables of plain columns."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import h5py
import numpy as np

from station.archive.areas import AREA_VARIABLES
from station.archive.chunk_codec import read_column
from station.archive.netcdf_layout import Series, decode_text
from station.archive.read_errors import read_errors
from station.archive.schema import FILL, VERDICTS
from station.archive.series.index import processing_file
from station.quantities import Floats

SCALAR_VARIABLES = (
    "platform_roll", "platform_pitch", "air_temperature", "air_pressure", "point_total", "coverage",
    "stable_median", "stable_nmad", "stable_z_std",
)  # fmt: skip
TEXT_VARIABLES = ("scan_id", "epoch_file", "verdict_reason", "reference_version")


@dataclass(frozen=True)
class EpochTable:
    """Values of all epochs, in time order."""

    start_s: Floats  # (t,) seconds since 1970, start of the scan
    end_s: Floats
    verdict: list[str]
    scalars: dict[str, Floats]  # (t,) NaN where missing
    texts: dict[str, list[str]]

    def __len__(self) -> int:
        """Return the number of epochs."""
        return len(self.start_s)


@dataclass(frozen=True)
class AreaSeries:
    """One area over time; all (t,)."""

    name: str
    size_m2: float
    start_s: Floats
    end_s: Floats
    columns: dict[str, Floats]


def read_epoch_table(series: Series) -> EpochTable:
    """Return the epoch table of `processing.nc`; raise StoreError if it cannot be read."""
    path = processing_file(series)
    with read_errors(path), h5py.File(path, "r") as file:
        bounds_s = np.asarray(file["time_bnds"][:], dtype=np.float64)
        return EpochTable(
            start_s=bounds_s[:, 0],
            end_s=bounds_s[:, 1],
            verdict=[VERDICTS[code] for code in file["verdict"][:].tolist()],
            scalars={name: _nan_where_missing(file[name][:]) for name in SCALAR_VARIABLES},
            texts={name: decode_text(read_column(file[name])) for name in TEXT_VARIABLES},
        )


def read_area_series(series: Series) -> list[AreaSeries]:
    """Return the series of all areas of `areas.nc`; none if the file is missing or of an older version."""
    path = series.folder / "areas.nc"
    if not path.is_file():
        return []
    with read_errors(path), h5py.File(path, "r") as file:
        over_time = [variable.name for variable in AREA_VARIABLES if variable.dims == ("time", "area")]
        if not set(over_time) <= set(file):
            return []
        start_s, end_s = np.asarray(file["time_bnds"][:], dtype=np.float64).T
        names = [name.tobytes().rstrip(b"\0").decode() for name in file["area_name"][:]]
        size_m2 = file["area_size"][:]
        columns = {name: _nan_where_missing(read_column(file[name])) for name in over_time}
    return [
        AreaSeries(
            name,
            float(size_m2[index]),
            start_s,
            end_s,
            {key: values[:, index] for key, values in columns.items()},
        )
        for index, name in enumerate(names)
    ]


def csv_times(start_s: float, end_s: float) -> dict[str, str]:
    """Return the times of a scan for a CSV table, by column; the middle is the `time` of NetCDF files."""
    times_s = {"time_utc": (start_s + end_s) / 2, "start_utc": start_s, "end_utc": end_s}
    return {
        name: datetime.fromtimestamp(round(time_s, 3), UTC)
        .isoformat(timespec="milliseconds")
        .replace("+00:00", "Z")
        for name, time_s in times_s.items()
    }


def _nan_where_missing(values: np.ndarray[Any, Any]) -> Floats:
    """Return values with NaN where they are missing."""
    numbers = values.astype(np.float64)
    return np.where(numbers < FILL / 2, numbers, np.nan)
