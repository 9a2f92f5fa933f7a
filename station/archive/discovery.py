"""Global attributes by which files are found, cited and combined (ACDD 1.3), in every file of a store.

What people decide comes from `[metadata]` of the site file; extent and times are computed. A grid on another
plane than the map has no extent in degrees, but says how to return to the map.
Source: Attribute Convention for Data Discovery 1.3 (ESIP); equations.md, 4.13.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from datetime import UTC, datetime, timedelta
from functools import lru_cache
from pathlib import Path
from typing import Any

import h5py
import netCDF4
from pyproj import CRS, Transformer

from station._version import __version__
from station.grid_plane import MAP_PLANE, GridPlane
from station.quantities import Grid

NO_HEIGHTS = (math.nan, math.nan)
DENSIFY_POINTS = 21  # of each edge of the grid, which is curved in degrees
PLANE_ORIGIN, PLANE_FACING, PLANE_DIP, PLANE_CRS = (
    f"grid_plane_{name}" for name in ("origin_m", "facing_deg", "dip_deg", "map_crs")
)
_PLANE_COMMENT = (
    "the grid lies on a plane through origin (easting, northing, height of the map), whose outer side faces"
    " the azimuth facing, clockwise from grid north, and that dips by dip (90: vertical). With A = facing and"
    " D = dip, the axes in east, north, up are x (-cos A, sin A, 0), y (-cos D sin A, -cos D cos A, sin D),"
    " and along the normal (sin D sin A, sin D cos A, cos D)"
)
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


def plane_attributes(plane: GridPlane, map_crs: str | None) -> dict[str, Any]:
    """Return the attributes that describe the plane of a grid; none if that is the map."""
    if plane.is_map:
        return {}
    return {
        PLANE_ORIGIN: list(plane.origin_m),
        PLANE_FACING: plane.facing_deg,
        PLANE_DIP: plane.dip_deg,
        **({PLANE_CRS: map_crs} if map_crs is not None else {}),
        "grid_plane_comment": _PLANE_COMMENT,
    }


def read_plane(file: netCDF4.Dataset) -> tuple[GridPlane, str | None]:
    """Return the plane of the grid of a file, and the CRS of the map that its origin refers to."""
    attrs = {name: file.getncattr(name) for name in file.ncattrs() if name.startswith("grid_plane_")}
    if PLANE_FACING not in attrs:
        return MAP_PLANE, None
    east_m, north_m, height_m = (float(value) for value in attrs[PLANE_ORIGIN])
    plane = GridPlane((east_m, north_m, height_m), float(attrs[PLANE_FACING]), float(attrs[PLANE_DIP]))
    return plane, attrs.get(PLANE_CRS)


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
