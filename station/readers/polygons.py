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
from station.readers.regular_file import read_text
from station.science.geometry.pose import horizontal_crs, is_same_map

TILE_CELLS = 64  # rows and columns of cells that are tested together
KINDS = ("Polygon", "MultiPolygon")


def read_polygons(path: Path, crs: str | None) -> dict[str, shapely.Geometry]:
    """Read the polygons of a GeoJSON file by name, in file order, in map coordinates.

    A polygon's name is its property `name`, else `id`, in any case of letters, else `area_1` by its position
    in the file. A file that declares no CRS is taken to be in map coordinates. Raises ConfigError, with file
    and feature, if the CRS is not that of the map, the coordinates are degrees, something is damaged, a
    polygon intersects itself, two have the same name, or there is none.
    """
    document = _read_json(path)
    projected = crs is not None and horizontal_crs(crs).is_projected
    if crs is not None:
        _check_crs(path, document.get("crs"), crs)
    polygons: dict[str, shapely.Geometry] = {}
    for number, feature in enumerate(_features(path, document), start=1):
        name = _name(feature, number)
        location = f"{path}: feature {number} ({name})"
        if name in polygons:
            raise ConfigError(f"{location}: another feature has this name: rename one")
        polygons[name] = _polygon(location, feature.get("geometry"))
        west, south, east, north = polygons[name].bounds
        if projected and max(-west, east) <= 180 and max(-south, north) <= 90:
            raise ConfigError(
                f"{location}: its coordinates look like degrees; {_reprojection_hint(path, crs)}"
            )
    if not polygons:
        raise ConfigError(f"{path}: contains no feature: draw a polygon, or leave the file out")
    return polygons


def cells_inside(geometry: shapely.Geometry, grid: Grid) -> Bools:
    """Return True for cells whose centre is inside a polygon (ny, nx); a centre on the edge is outside."""
    inside = np.zeros(grid.shape, dtype=np.bool_)
    west, south, east, north = geometry.bounds
    columns = np.flatnonzero((grid.x_m > west) & (grid.x_m < east))
    rows = np.flatnonzero((grid.y_m > south) & (grid.y_m < north))
    if not columns.size or not rows.size:
        return inside
    row_end, column_end = int(rows[-1]) + 1, int(columns[-1]) + 1
    row_starts, column_starts = (
        window.ravel()
        for window in np.meshgrid(
            np.arange(rows[0], row_end, TILE_CELLS),
            np.arange(columns[0], column_end, TILE_CELLS),
            indexing="ij",
        )
    )
    row_ends, column_ends = (
        np.minimum(row_starts + TILE_CELLS, row_end),
        np.minimum(column_starts + TILE_CELLS, column_end),
    )
    eastings, northings = (
        grid.west_m + np.array([column_starts, column_ends]) * grid.cell_m,
        grid.north_m - np.array([row_ends, row_starts]) * grid.cell_m,
    )
    tiles = shapely.box(eastings[0], northings[0], eastings[1], northings[1])
    shapely.prepare(geometry)
    contained = shapely.contains(geometry, tiles)
    intersecting = shapely.intersects(geometry, tiles)
    for index in np.flatnonzero(intersecting):
        window = slice(row_starts[index], row_ends[index]), slice(column_starts[index], column_ends[index])
        inside[window] = contained[index] or shapely.contains_xy(
            geometry, grid.x_m[None, window[1]], grid.y_m[window[0], None]
        )
    return inside


def _read_json(path: Path) -> dict[str, Any]:
    try:
        document = json.loads(read_text(path))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:  # also for a wrong encoding or too deep nesting
        raise ConfigError(f"{path}: not valid GeoJSON: {error}") from error
    if not isinstance(document, dict):
        raise ConfigError(f"{path}: not valid GeoJSON: the top level is not an object")
    return document


def _check_crs(path: Path, declared: object, crs: str) -> None:
    """Raise ConfigError if the file declares a CRS other than `crs`."""
    if declared is None:
        return
    try:
        declared_crs = horizontal_crs(declared["properties"]["name"])  # type: ignore[index]
    except (KeyError, TypeError, AttributeError, CRSError) as error:
        raise ConfigError(
            f"{path}: crs {declared} is not understood; {_reprojection_hint(path, crs)}"
        ) from error
    if not is_same_map(declared_crs, horizontal_crs(crs)):
        raise ConfigError(
            f"{path}: is in {declared_crs.name}, map.crs is {crs}; {_reprojection_hint(path, crs)}"
        )


def _reprojection_hint(path: Path, crs: str | None) -> str:
    return f"reproject it: ogr2ogr -t_srs {crs} on_the_map.geojson {path.name}"


def _features(path: Path, document: dict[str, Any]) -> list[dict[str, Any]]:
    kind = document.get("type")
    if kind in KINDS:
        return [{"geometry": document}]
    if kind == "Feature":
        return [document]
    features = document.get("features")
    if kind != "FeatureCollection" or not isinstance(features, list):
        raise ConfigError(f"{path}: is not a GeoJSON of polygons: its type is {kind!r}")
    for number, feature in enumerate(features, start=1):
        if not isinstance(feature, dict) or feature.get("type") != "Feature":
            raise ConfigError(f"{path}: feature {number}: is not a GeoJSON feature")
    return features


def _name(feature: dict[str, Any], number: int) -> str:
    properties = feature.get("properties")
    by_key = {key.lower(): value for key, value in properties.items()} if isinstance(properties, dict) else {}
    candidates = by_key.get("name"), by_key.get("id")
    names = [str(value).strip() for value in (*candidates, feature.get("id")) if value is not None]
    return next((name for name in names if name), f"area_{number}")


def _polygon(location: str, geometry: object) -> shapely.Geometry:
    kind = geometry.get("type") if isinstance(geometry, dict) else None
    if kind not in KINDS:
        raise ConfigError(f"{location}: is {kind or 'without geometry'}; expected {' or '.join(KINDS)}")
    try:
        polygon = shapely.force_2d(shapely.from_geojson(json.dumps(geometry)))
    except shapely.GEOSException as error:
        raise ConfigError(f"{location}: is damaged: {error}") from error
    if polygon.is_empty:
        raise ConfigError(f"{location}: has no vertices")
    if not polygon.is_valid:
        raise ConfigError(f"{location}: {shapely.is_valid_reason(polygon)}: repair its outline")
    return polygon
