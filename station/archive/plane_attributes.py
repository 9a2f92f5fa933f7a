"""What files say of the plane that a grid lies on: its coordinates, and how to return from them to the map.

Source: equations.md, 4.13.
"""

from __future__ import annotations

from typing import Any

import netCDF4

from station.grid_plane import MAP_PLANE, GridPlane

ORIGIN, FACING, DIP = "grid_plane_origin_m", "grid_plane_facing_deg", "grid_plane_dip_deg"
MAP_CRS = "grid_plane_map_crs"
AXES = {
    "x": "distance from the origin of the plane, horizontal",
    "y": "distance from the origin, up the plane",
}
ALONG_NORMAL = "heights are distances from the plane of the grid along its normal, positive outward"
_COMMENT = (
    "the grid lies on a plane through origin (easting, northing, height of the map), whose outer side faces"
    " the azimuth facing, clockwise from grid north, and that dips by dip (90: vertical). With A = facing and"
    " D = dip, the axes in east, north, up are x (-cos A, sin A, 0), y (-cos D sin A, -cos D cos A, sin D),"
    " and along the normal (sin D sin A, sin D cos A, cos D)"
)


def plane_attributes(plane: GridPlane, map_crs: str | None) -> dict[str, Any]:
    """Return the global attributes that describe the plane of a grid; none for the map itself."""
    if plane.is_map:
        return {}
    crs = {} if map_crs is None else {MAP_CRS: map_crs}
    return {
        ORIGIN: list(plane.origin_m),
        FACING: plane.facing_deg,
        DIP: plane.dip_deg,
        **crs,
        "grid_plane_comment": _COMMENT,
    }


def read_plane(file: netCDF4.Dataset) -> tuple[GridPlane, str | None]:
    """Return the plane of the grid of a file, and the CRS of the map that its origin refers to."""
    attrs = file.ncattrs()
    if FACING not in attrs:
        return MAP_PLANE, None
    east_m, north_m, height_m = (float(value) for value in file.getncattr(ORIGIN))
    plane = GridPlane((east_m, north_m, height_m), float(file.getncattr(FACING)), float(file.getncattr(DIP)))
    return plane, str(file.getncattr(MAP_CRS)) if MAP_CRS in attrs else None


def axis_attributes(axis: str, plane: GridPlane, what: str = "") -> dict[str, str]:
    """Return name and unit of coordinates along x or y of a grid, of `what` if it is not the cells."""
    if not plane.is_map:
        return {"long_name": f"{AXES[axis]}{what}", "units": "m"}
    return {
        "standard_name": f"projection_{axis}_coordinate",
        "long_name": ("easting" if axis == "x" else "northing") + what,
        "units": "m",
    }
