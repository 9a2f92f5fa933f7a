"""Areas on the page: their curves, and the newest value of each with its 95 % interval."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from station.archive.netcdf_layout import Series
from station.products.epoch_table import AreaSeries, EpochTable, read_area_series
from station.science.gridding.significance import SIGNIFICANT_SIGMAS


@dataclass(frozen=True)
class AreaValue:
    """The newest usable change of an area; each half-width is that of the 95 % interval."""

    name: str
    start_s: float | None  # of the scan; None: not measured yet, and the values are NaN
    mean_m: float
    mean_half_m: float
    volume_m3: float
    volume_half_m3: float
    coverage: float


def usable_area_series(series: Series, table: EpochTable) -> list[AreaSeries]:
    """Return the series of all areas, with gaps at epochs whose change and sigma are unusable."""
    return [mask_unusable(area, table) for area in read_area_series(series)]


def mask_unusable(area: AreaSeries, table: EpochTable) -> AreaSeries:
    """Return the series of an area with gaps at epochs whose change and sigma are unusable."""
    unusable_s = table.start_s[[verdict == "unusable" for verdict in table.verdict]]
    gaps = np.isin(area.start_s, unusable_s)
    return replace(
        area, columns={name: np.where(gaps, np.nan, values) for name, values in area.columns.items()}
    )


def newest_value(area: AreaSeries) -> AreaValue:
    """Return the newest value of an area that is known."""
    known = np.flatnonzero(np.isfinite(area.columns["mean_change"]))
    if not len(known):
        return AreaValue(area.name, None, *5 * (float("nan"),))
    mean_m, mean_sigma_m, volume_m3, volume_sigma_m3, coverage = (
        float(area.columns[name][known[-1]])
        for name in (
            "mean_change",
            "mean_change_uncertainty",
            "volume_change",
            "volume_change_uncertainty",
            "coverage",
        )
    )
    return AreaValue(
        area.name,
        float(area.start_s[known[-1]]),
        mean_m,
        SIGNIFICANT_SIGMAS * mean_sigma_m,
        volume_m3,
        SIGNIFICANT_SIGMAS * volume_sigma_m3,
        coverage,
    )
