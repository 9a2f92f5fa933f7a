"""Global attributes by which files are found, cited and combined (ACDD 1.3), in every file of a store.

What people decide comes from `[metadata]` of the site file; extent and times are computed.
Source: Attribute Convention for Data Discovery 1.3 (ESIP).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from datetime import UTC, datetime, timedelta
from functools import lru_cache
from pathlib import Path

import h5py
from pyproj import CRS, Transformer

from station._version import __version__
from station.quantities import Grid

NO_HEIGHTS = (math.nan, math.nan)
DENSIFY_POINTS = 21  # of each edge of the grid, which is curved in degrees
_STAMP = "%Y-%m-%dT%H:%M:%SZ"


def descriptive_attributes(name: str, institution: str, metadata: Mapping[str, str]) -> dict[str, str]:
    """Return what describes the station: general statements, and what `metadata` says instead or besides."""
    created = datetime.now(UTC).strftime(_STAMP)
    return {
        "summary": f"Change of the surface at {name} against a reference surface, and its standard"
        " uncertainty, from the scans of a permanently mounted terrestrial laser scanner.",
        "keywords": "elevation change, terrestrial laser scanning, measurement uncertainty",
        "source": "terrestrial laser scanner, permanently mounted",
        "institution": institution or "not given",
        "processing_level": "gridded scans, adjusted to a reference surface",
        "standard_name_vocabulary": "CF Standard Name Table v86",
        "cdm_data_type": "Grid",
        "date_created": created,
        "history": f"{created} written by station {__version__}",
        **metadata,
    }


@lru_cache(maxsize=8)
def extent(grid: Grid, crs: str | None) -> dict[str, str | float]:
    """Return the attributes of a grid's extent in degrees; none without a CRS."""
    if crs is None:
        return {}
    east_m, south_m = grid.west_m + grid.nx * grid.cell_m, grid.north_m - grid.ny * grid.cell_m
    to_degrees = Transformer.from_crs(CRS.from_user_input(crs).to_2d(), "EPSG:4326", always_xy=True)
    lon_min, lat_min, lon_max, lat_max = to_degrees.transform_bounds(
        grid.west_m, south_m, east_m, grid.north_m, densify_pts=DENSIFY_POINTS
    )
    x_m = [grid.west_m, east_m, east_m, grid.west_m, grid.west_m]
    y_m = [south_m, south_m, grid.north_m, grid.north_m, south_m]
    lon, lat = to_degrees.transform(x_m, y_m)
    ring = ", ".join(f"{y:.6f} {x:.6f}" for x, y in zip(lon, lat, strict=True))
    return {
        "geospatial_bounds": f"POLYGON (({ring}))",
        "geospatial_bounds_crs": "EPSG:4326",
        "geospatial_lat_min": round(lat_min, 6),
        "geospatial_lat_max": round(lat_max, 6),
        "geospatial_lat_units": "degrees_north",
        "geospatial_lon_min": round(lon_min, 6),
        "geospatial_lon_max": round(lon_max, 6),
        "geospatial_lon_units": "degrees_east",
        "geospatial_vertical_positive": "up",
        "geospatial_vertical_units": "m",
    }


def read_heights(reference: Path) -> tuple[float, float]:
    """Return the smallest and the largest height [m] that the file of a reference states; NaN without."""
    try:
        with h5py.File(reference, "r") as file:
            low_m, high_m = (file.attrs[f"geospatial_vertical_{end}"].item() for end in ("min", "max"))
    except (OSError, RuntimeError, KeyError):
        return NO_HEIGHTS
    return float(low_m), float(high_m)


def time_coverage(start_s: float, end_s: float) -> dict[str, str]:
    """Return the attributes of the time from the start of the first to the end of the last scan."""
    start, end = (datetime.fromtimestamp(round(time_s), UTC) for time_s in (start_s, end_s))
    return {
        "time_coverage_start": start.strftime(_STAMP),
        "time_coverage_end": end.strftime(_STAMP),
        "time_coverage_duration": _iso_duration(end - start),
    }


def _iso_duration(duration: timedelta) -> str:
    """Return a duration in the notation of ISO 8601."""
    hours, seconds = divmod(duration.seconds, 3600)
    return f"P{duration.days}DT{hours}H{seconds // 60}M{seconds % 60}S"
