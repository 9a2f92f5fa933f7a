"""Named polygons on the map, from GeoJSON, GeoPackage or Shapefile, in any coordinate system."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import shapely
from pyproj import CRS, Transformer
from pyproj.exceptions import CRSError

from station.errors import ConfigError
from station.quantities import Bools, Floats, Grid
from station.readers.regular_file import read_text
from station.science.geometry.pose import horizontal_crs, is_same_map

TILE_CELLS = 64  # rows and columns of cells that are tested together
KINDS = ("Polygon", "MultiPolygon")
LAYER_SUFFIXES = (".gpkg", ".shp")  # read with the extra `polygons`
WGS84 = "OGC:CRS84"  # of a GeoJSON that declares none: RFC 7946, 4
MAX_AREA_CHANGE = 1e-6  # of an outline that is mended, relative


class _Feature(NamedTuple):
    """A feature of a file, as it stands there."""

    location: str  # file, number and name
    name: str
    geometry: shapely.Geometry


def read_polygons(path: Path, crs: str | None) -> dict[str, shapely.Geometry]:
    """Read the polygons of a file by name, in file order, in map coordinates.

    A polygon's name is its property `name`, else `id`, in any case of letters, else `area_1` by its position
    in the file. Other coordinate systems are reprojected; a GeoJSON that declares none is in degrees of WGS84
    if it can be, else in map coordinates. An outline that touches itself is mended if the area stays the
    same. Raises ConfigError, with file and feature, if something is damaged, a polygon intersects itself, two
    have the same name, or there is none.
    """
    return {feature.name: _mended(feature)[0] for feature in _features_on_map(path, crs)}


def mended_outlines(path: Path, crs: str | None) -> list[str]:
    """Return a message for each polygon of a file whose outline is mended; raises as `read_polygons`."""
    features = _features_on_map(path, crs)
    return [f"{feature.location}: {fault}; mended" for feature in features if (fault := _mended(feature)[1])]


def to_geojson(polygons: dict[str, shapely.Geometry], crs: str | None) -> str:
    """Return polygons on the map as the text of a GeoJSON that declares the map's CRS."""
    features = [
        {"type": "Feature", "properties": {"name": name}, "geometry": json.loads(shapely.to_geojson(polygon))}
        for name, polygon in polygons.items()
    ]
    declared = {"crs": {"type": "name", "properties": {"name": crs}}} if crs is not None else {}
    return json.dumps({"type": "FeatureCollection", **declared, "features": features})


def _features_on_map(path: Path, crs: str | None) -> list[_Feature]:
    """Return the features of a file in map coordinates, their outlines not checked."""
    is_layer = path.suffix.lower() in LAYER_SUFFIXES
    features, declared = _read_layer(path) if is_layer else _read_geojson(path)
    if not features:
        raise ConfigError(f"{path}: contains no feature: draw a polygon, or leave the file out")
    names = set()
    for feature in features:
        if feature.name in names:
            raise ConfigError(f"{feature.location}: another feature has this name: rename one")
        names.add(feature.name)
    if crs is None:
        return features
    expected = horizontal_crs(crs)
    if declared is None and not is_layer and _are_degrees(features, expected):
        declared = CRS.from_user_input(WGS84)
    if declared is None or is_same_map(declared, expected):
        return features
    transformer = Transformer.from_crs(declared, expected, always_xy=True)
    return [_reprojected(feature, transformer) for feature in features]


def _are_degrees(features: list[_Feature], expected: CRS) -> bool:
    """Return True if all coordinates can be degrees; raise ConfigError if only some of them can."""
    if not expected.is_projected:
        return False
    bounds = [feature.geometry.bounds for feature in features]
    degrees = [max(-west, east) <= 180 and max(-south, north) <= 90 for west, south, east, north in bounds]
    if any(degrees) and not all(degrees):
        location = features[degrees.index(True)].location
        raise ConfigError(f"{location}: its coordinates look like degrees, others of the file do not")
    return all(degrees)


def _reprojected(feature: _Feature, transformer: Transformer) -> _Feature:
    def transform(xy: Floats) -> Floats:
        return np.stack(transformer.transform(xy[:, 0], xy[:, 1]), axis=-1)

    geometry = shapely.transform(feature.geometry, transform)
    if not np.isfinite(shapely.get_coordinates(geometry)).all():
        raise ConfigError(f"{feature.location}: is not in the area of its CRS or of that of the map")
    return feature._replace(geometry=geometry)


def _mended(feature: _Feature) -> tuple[shapely.Geometry, str]:
    """Return a valid polygon and what was wrong with it, '' if nothing.

    Raises ConfigError if mending it would change its area: then it is not known what was meant.
    """
    polygon = feature.geometry
    if polygon.is_valid:
        return polygon, ""
    fault = shapely.is_valid_reason(polygon)
    parts = shapely.get_parts(shapely.make_valid(polygon, method="structure", keep_collapsed=False))
    mended = shapely.union_all([part for part in parts if part.geom_type in KINDS])
    if abs(mended.area - polygon.area) > MAX_AREA_CHANGE * polygon.area or mended.is_empty:
        raise ConfigError(f"{feature.location}: {fault}: repair its outline")
    return mended, fault


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


def _read_geojson(path: Path) -> tuple[list[_Feature], CRS | None]:
    """Return the features of a GeoJSON, and the CRS that it declares, which RFC 7946 no longer allows."""
    document = _read_json(path)
    features = []
    for number, member in enumerate(_features(path, document), start=1):
        name = _name(member.get("properties"), member.get("id"), number)
        location = f"{path}: feature {number} ({name})"
        features.append(_Feature(location, name, _polygon(location, member.get("geometry"))))
    declared = document.get("crs")
    if declared is None:
        return features, None
    try:
        return features, horizontal_crs(declared["properties"]["name"])
    except (KeyError, TypeError, AttributeError, CRSError) as error:
        raise ConfigError(f"{path}: crs {declared} is not understood: name an EPSG code") from error


def _read_layer(path: Path) -> tuple[list[_Feature], CRS | None]:
    """Return the features of a GeoPackage or Shapefile with one layer, and its CRS."""
    try:
        import pyogrio  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise ConfigError(f"{path}: needs a library: pip install 'tls-station[polygons]'") from error
    try:
        layers = [name for name, kind in pyogrio.list_layers(path) if kind is not None]
        if len(layers) != 1:
            raise ConfigError(f"{path}: has layers {', '.join(layers) or '(none)'}: export one of polygons")
        meta, _, geometries, columns = pyogrio.raw.read(path, layer=layers[0], force_2d=True)
        declared = horizontal_crs(meta["crs"]) if meta["crs"] else None
    except (pyogrio.errors.DataSourceError, pyogrio.errors.DataLayerError, CRSError) as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from error
    features = []
    for number, (wkb, values) in enumerate(zip(geometries, zip(*columns, strict=True), strict=True), start=1):
        name = _name(dict(zip(meta["fields"].tolist(), values, strict=True)), None, number)
        location = f"{path}: feature {number} ({name})"
        try:
            geometry = None if wkb is None else shapely.from_wkb(wkb)
        except shapely.GEOSException as error:
            raise ConfigError(f"{location}: is damaged: {error}") from error
        if geometry is None or geometry.geom_type not in KINDS or geometry.is_empty:
            kind = "without geometry" if geometry is None else geometry.geom_type
            raise ConfigError(f"{location}: is {kind}; expected {' or '.join(KINDS)}")
        features.append(_Feature(location, name, geometry))
    return features, declared


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


def _name(properties: object, ident: object, number: int) -> str:
    """Return the name of a feature by its properties, else by its identifier, else by its number."""
    by_key = {key.lower(): value for key, value in properties.items()} if isinstance(properties, dict) else {}
    candidates = by_key.get("name"), by_key.get("id")
    names = [str(value).strip() for value in (*candidates, ident) if value is not None]
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
    return polygon
