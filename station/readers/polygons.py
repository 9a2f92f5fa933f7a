"""Named polygons on the map, from GeoJSON."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from pyproj.exceptions import CRSError

from station.errors import ConfigError
from station.quantities import Bools, Grid
from station.science.pose import horizontal_crs, is_same_map

TILE = 64  # rows and columns of cells that are looked at together
KINDS = ("Polygon", "MultiPolygon")


def read_polygons(path: Path, crs: str | None) -> dict[str, shapely.Geometry]:
    """Read the polygons of a GeoJSON file by name, in the order of the file, in the coordinates of the map.

    A polygon's name is its property `name`, else `id`, else `area_1` by its place in the file. A file that
    names no CRS is taken as on the map. Raises ConfigError, with file and feature, where that is another map,
    where coordinates are degrees, something is damaged, a polygon crosses itself, two have one name, or there
    is none.
    """
    told = _json(path)
    projected = crs is not None and horizontal_crs(crs).is_projected
    if crs is not None:
        _check_crs(path, told.get("crs"), crs)
    found: dict[str, shapely.Geometry] = {}
    for number, feature in enumerate(_features(path, told), start=1):
        name = _name(feature, number)
        where = f"{path}: feature {number} ({name})"
        if name in found:
            raise ConfigError(f"{where}: another feature has this name: rename one")
        found[name] = _polygon(where, feature.get("geometry"))
        west, south, east, north = found[name].bounds
        if projected and max(-west, east) <= 180 and max(-south, north) <= 90:
            raise ConfigError(f"{where}: its coordinates look like degrees; {_advice(path, crs)}")
    if not found:
        raise ConfigError(f"{path}: holds no feature: draw a polygon, or leave the file out")
    return found


def mask(geometry: shapely.Geometry, grid: Grid) -> Bools:
    """Tell which cells of a grid have their centre inside a polygon (ny, nx); one on its edge is outside."""
    inside = np.zeros(grid.shape, dtype=np.bool_)
    west, south, east, north = geometry.bounds
    columns = np.flatnonzero((grid.x_m > west) & (grid.x_m < east))
    rows = np.flatnonzero((grid.y_m > south) & (grid.y_m < north))
    if not columns.size or not rows.size:
        return inside
    bottom, right = int(rows[-1]) + 1, int(columns[-1]) + 1
    tops, lefts = (
        place.ravel()
        for place in np.meshgrid(
            np.arange(rows[0], bottom, TILE), np.arange(columns[0], right, TILE), indexing="ij"
        )
    )
    bottoms, rights = np.minimum(tops + TILE, bottom), np.minimum(lefts + TILE, right)
    eastings, northings = (
        grid.west_m + np.array([lefts, rights]) * grid.cell_m,
        grid.north_m - np.array([bottoms, tops]) * grid.cell_m,
    )
    tiles = shapely.box(eastings[0], northings[0], eastings[1], northings[1])
    shapely.prepare(geometry)
    whole = shapely.contains(geometry, tiles)
    touched = shapely.intersects(geometry, tiles)
    for at in np.flatnonzero(touched):
        place = slice(tops[at], bottoms[at]), slice(lefts[at], rights[at])
        inside[place] = whole[at] or shapely.contains_xy(
            geometry, grid.x_m[None, place[1]], grid.y_m[place[0], None]
        )
    return inside


def _json(path: Path) -> dict[str, Any]:
    try:
        told = json.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:  # of the text's encoding, or its depth, too
        raise ConfigError(f"{path}: not valid GeoJSON: {error}") from error
    if not isinstance(told, dict):
        raise ConfigError(f"{path}: not valid GeoJSON: an object is missing")
    return told


def _check_crs(path: Path, told: object, crs: str) -> None:
    """Refuse a file that names another map than `crs`."""
    if told is None:
        return
    try:
        named = horizontal_crs(told["properties"]["name"])  # type: ignore[index]
    except (KeyError, TypeError, AttributeError, CRSError) as error:
        raise ConfigError(f"{path}: crs {told} is not understood; {_advice(path, crs)}") from error
    if not is_same_map(named, horizontal_crs(crs)):
        raise ConfigError(f"{path}: is in {named.name}, map.crs is {crs}; {_advice(path, crs)}")


def _advice(path: Path, crs: str | None) -> str:
    return f"bring it to the map: ogr2ogr -t_srs {crs} on_the_map.geojson {path.name}"


def _features(path: Path, told: dict[str, Any]) -> list[dict[str, Any]]:
    kind = told.get("type")
    if kind in KINDS:
        return [{"geometry": told}]
    if kind == "Feature":
        return [told]
    features = told.get("features")
    if kind != "FeatureCollection" or not isinstance(features, list):
        raise ConfigError(f"{path}: is no GeoJSON of polygons: its type is {kind!r}")
    for number, feature in enumerate(features, start=1):
        if not isinstance(feature, dict) or feature.get("type") != "Feature":
            raise ConfigError(f"{path}: feature {number}: is none")
    return features


def _name(feature: dict[str, Any], number: int) -> str:
    properties = feature.get("properties") or {}
    given = [properties.get("name"), properties.get("id")] if isinstance(properties, dict) else []
    names = [str(one).strip() for one in (*given, feature.get("id")) if one is not None]
    return next((name for name in names if name), f"area_{number}")


def _polygon(where: str, geometry: object) -> shapely.Geometry:
    kind = geometry.get("type") if isinstance(geometry, dict) else None
    if kind not in KINDS:
        raise ConfigError(f"{where}: is {kind or 'without geometry'}; wanted are {' and '.join(KINDS)}")
    try:
        polygon = shapely.force_2d(shapely.from_geojson(json.dumps(geometry)))
    except shapely.GEOSException as error:
        raise ConfigError(f"{where}: is damaged: {error}") from error
    if polygon.is_empty:
        raise ConfigError(f"{where}: has no corners")
    if not polygon.is_valid:
        raise ConfigError(f"{where}: {shapely.is_valid_reason(polygon)}: mend its outline")
    return polygon
