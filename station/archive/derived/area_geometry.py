"""Outlines of areas in a NetCDF file, as a geometry container of CF 7.5."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import Any

import netCDF4
import numpy as np
import shapely
from shapely.geometry.polygon import orient

from station.archive.netcdf_layout import Series, axis_attributes, create_crs

CONTAINER = "area_outline"
POLYGONS_ATTRIBUTE = "area_outlines_sha256"
_NODES = "area_node_x area_node_y"


def polygons_hash(polygons: Mapping[str, shapely.Geometry]) -> str:
    """Return a hash of the outlines of areas, in their order."""
    return hashlib.sha256(b"".join(shapely.to_wkb(polygon) for polygon in polygons.values())).hexdigest()


def write_polygons(file: netCDF4.Dataset, series: Series, polygons: Mapping[str, shapely.Geometry]) -> None:
    """Write the outlines of areas along the existing dimension `area`.

    Outer rings run counterclockwise, holes clockwise.
    """
    rings = [_rings(polygon) for polygon in polygons.values()]
    nodes = np.concatenate([ring for area in rings for ring, _ in area])
    file.createDimension("area_node", len(nodes))
    file.createDimension("area_ring", sum(map(len, rings)))
    if series.crs is not None:
        create_crs(file, series)
        file["crs"].delncattr("GeoTransform")  # there is no raster
    container = file.createVariable(CONTAINER, "i4", ())
    container.setncatts(
        {
            "long_name": "outlines of the areas",
            "geometry_type": "polygon",
            "node_count": "area_node_count",
            "node_coordinates": _NODES,
            "part_node_count": "area_ring_node_count",
            "interior_ring": "area_ring_is_hole",
            **({"grid_mapping": "crs"} if series.crs is not None else {}),
        }
    )
    all_rings = [ring for area in rings for ring in area]
    area_counts = [sum(len(ring) for ring, _ in area) for area in rings]
    for name, dim, values, long_name in (
        ("area_node_count", "area", area_counts, "nodes of the area"),
        ("area_ring_node_count", "area_ring", [len(ring) for ring, _ in all_rings], "nodes of the ring"),
        ("area_ring_is_hole", "area_ring", [is_hole for _, is_hole in all_rings], "1 if the ring is a hole"),
    ):  # fmt: skip
        variable = file.createVariable(name, "i4", (dim,))
        variable.long_name = long_name
        variable[:] = values
    for column, axis in enumerate("xy"):
        node = file.createVariable(f"area_node_{axis}", "f8", ("area_node",))
        node.setncatts(axis_attributes(axis, series.grid.plane, " of the outline") | {"axis": axis.upper()})
        node[:] = nodes[:, column]
    file.setncattr(POLYGONS_ATTRIBUTE, polygons_hash(polygons))


def _rings(geometry: shapely.Geometry) -> list[tuple[np.ndarray[Any, Any], int]]:
    """Return the closed rings (n, 2) of a polygon or multipolygon, and 1 for a hole, else 0."""
    rings = []
    for part in shapely.get_parts(geometry):
        oriented = orient(part)
        rings.append((shapely.get_coordinates(oriented.exterior), 0))
        rings += [(shapely.get_coordinates(hole), 1) for hole in oriented.interiors]
    return rings


def read_polygons(file: netCDF4.Dataset) -> list[shapely.Geometry]:
    """Return the outlines that `write_polygons` wrote, in the order of the areas; none if there are none."""
    if CONTAINER not in file.variables:
        return []
    nodes = np.stack([np.ma.getdata(file[name][:]) for name in _NODES.split()], axis=-1)
    ring_ends = np.cumsum(np.ma.getdata(file["area_ring_node_count"][:]))
    area_ends = np.cumsum(np.ma.getdata(file["area_node_count"][:]))
    polygons: list[shapely.Geometry] = []
    parts: list[tuple[np.ndarray[Any, Any], list[np.ndarray[Any, Any]]]] = []
    for ring, end, is_hole in zip(
        np.split(nodes, ring_ends[:-1]), ring_ends, np.ma.getdata(file["area_ring_is_hole"][:]), strict=True
    ):
        if is_hole:
            parts[-1][1].append(ring)
        else:
            parts.append((ring, []))
        if end in area_ends:
            polygons.append(shapely.MultiPolygon(parts) if len(parts) > 1 else shapely.Polygon(*parts[0]))
            parts = []
    return polygons
