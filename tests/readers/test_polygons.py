"""Polygons on the map: areas against plane geometry, and files that are not what they should be."""

import json
import math

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from station.errors import ConfigError
from station.quantities import Grid
from station.readers.polygons import mask, read_polygons

CRS = "EPSG:32632"
EAST, NORTH = 632000.0, 5186000.0
GRID = Grid(EAST, NORTH, 1.0, 500, 400)


def ring(*corners):
    """A closed outline of corners (east, south) of the grid's north-west corner."""
    placed = [[EAST + east, NORTH - south] for east, south in corners]
    return [*placed, placed[0]]


def square(west, north, size):
    return ring((west, north), (west, north + size), (west + size, north + size), (west + size, north))


def polygon(*rings):
    return {"type": "Polygon", "coordinates": list(rings)}


def feature(geometry, **told):
    return {"type": "Feature", "properties": {}, "geometry": geometry} | told


def collection(*features, **told):
    return {"type": "FeatureCollection", "features": list(features)} | told


@pytest.fixture
def read(tmp_path):
    def read(content, crs=CRS):
        path = tmp_path / "areas.geojson"
        path.write_text(content if isinstance(content, str) else json.dumps(content), encoding="utf-8")
        return read_polygons(path, crs)

    return read


def test_names_and_order(read):
    found = read(
        collection(
            feature(polygon(square(0, 0, 10)), properties={"name": "Süd ", "id": 5}),
            feature(polygon(square(20, 0, 10)), properties={"name": None, "id": 7}),
            feature(polygon(square(40, 0, 10)), properties=None, id="gate"),
            feature(polygon(square(60, 0, 10)), properties={"name": ""}),
        )
    )
    assert list(found) == ["Süd", "7", "gate", "area_4"]
    assert [geometry.area for geometry in found.values()] == [100.0] * 4


@pytest.mark.parametrize("wrap", [lambda one: one, feature, lambda one: collection(feature(one))])
def test_geometry_feature_and_collection(read, wrap):
    assert read(wrap(polygon(square(0, 0, 10))))["area_1"].area == 100.0


def test_heights_and_a_byte_order_mark_do_no_harm(read):
    outline = [[*corner, 2800.0] for corner in square(0, 0, 10)]
    assert not read("\ufeff" + json.dumps(polygon(outline)))["area_1"].has_z


def test_the_map_by_another_of_its_names(read):
    named = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::32632"}}
    assert read(collection(feature(polygon(square(0, 0, 10))), crs=named), "EPSG:32632+3855")
    assert read(collection(feature(polygon(square(0, 0, 10))), crs=None))


def test_small_coordinates_are_no_degrees_where_there_is_no_map(read):
    local = {"type": "Polygon", "coordinates": [[[0, 0], [50, 0], [50, 50], [0, 0]]]}
    assert read(local, None)["area_1"].area == 1250.0


DEGREES = {"type": "Polygon", "coordinates": [[[10.7, 46.7], [10.8, 46.7], [10.8, 46.8], [10.7, 46.7]]]}
BOW_TIE = polygon(ring((0, 0), (10, 10), (10, 0), (0, 10)))
CRS84 = {"type": "name", "properties": {"name": "urn:ogc:def:crs:OGC:1.3:CRS84"}}
ZONE_33 = {"type": "name", "properties": {"name": "EPSG:32633"}}
GOOD = feature(polygon(square(0, 0, 10)), properties={"name": "gate"})


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("{", "areas.geojson: not valid GeoJSON"),
        ("[]", "an object is missing"),
        ({"type": "Topology"}, "its type is 'Topology'"),
        ({"type": "FeatureCollection"}, "is no GeoJSON of polygons"),
        (collection(), "holds no feature"),
        (collection(5), "feature 1: is none"),
        (collection(GOOD, feature(None)), r"feature 2 \(area_2\): is without geometry"),
        (collection(feature({"type": "Point", "coordinates": [1, 2]})), "is Point; wanted are Polygon and"),
        (collection(feature({"type": "GeometryCollection", "geometries": []})), "is GeometryCollection"),
        (feature(polygon()), "has no corners"),
        (feature({"type": "Polygon"}), r"feature 1 \(area_1\): is damaged"),
        (feature(polygon([[EAST, NORTH], ["a", 1], [2, 2], [EAST, NORTH]])), "is damaged"),
        (feature(polygon([[EAST, NORTH], [math.nan, 1], [2, 2], [EAST, NORTH]])), "is damaged"),
        (feature(polygon(square(0, 0, 10)[:-1])), "do not form a closed"),
        (feature(BOW_TIE, id="bow"), r"feature 1 \(bow\): Self-intersection.*mend its outline"),
        (collection(GOOD, GOOD), r"feature 2 \(gate\): another feature has this name"),
        (collection(GOOD, feature(DEGREES)), r"feature 2 .*degrees.*ogr2ogr -t_srs EPSG:32632"),
        (collection(GOOD, crs=ZONE_33), "is in WGS 84 / UTM zone 33N, map.crs is EPSG:32632.*ogr2ogr"),
        (collection(feature(DEGREES), crs=CRS84), r"is in WGS 84 \(CRS84\).*ogr2ogr"),
        (collection(GOOD, crs={"type": "link", "properties": {"href": "x"}}), "not understood"),
        (collection(GOOD, crs="nowhere"), "not understood"),
    ],
)
def test_faults_say_where_and_what(read, content, says):
    with pytest.raises(ConfigError, match=says):
        read(content)


def test_a_file_that_is_no_text_or_not_there(tmp_path):
    (tmp_path / "photo.geojson").write_bytes(b"\xff\xd8\xff\xe0")
    with pytest.raises(ConfigError, match="not valid GeoJSON"):
        read_polygons(tmp_path / "photo.geojson", CRS)
    with pytest.raises(ConfigError, match="cannot be read: No such file"):
        read_polygons(tmp_path / "none.geojson", CRS)


def test_square_is_exact_and_in_its_place():
    inside = mask(shapely.Polygon(square(100, 50, 30)), GRID)
    assert inside.sum() == 900
    assert inside[50:80, 100:130].all()


def test_circle_with_a_hole():
    """A ring of 150 m and 60 m has π (150² − 60²) m² of area."""
    middle = shapely.Point(EAST + 250, NORTH - 200)
    ring_shaped = middle.buffer(150, quad_segs=500) - middle.buffer(60, quad_segs=500)
    assert mask(ring_shaped, GRID).sum() == pytest.approx(math.pi * (150**2 - 60**2), rel=2e-3)


def test_parts_that_lie_apart_and_across_the_edge():
    parts = shapely.MultiPolygon(
        [shapely.Polygon(square(-10, -10, 30)), shapely.Polygon(square(490, 390, 50))]
    )
    inside = mask(parts, GRID)
    assert inside[:20, :20].all()
    assert inside[390:, 490:].all()
    assert inside.sum() == 20 * 20 + 10 * 10


def test_beside_the_grid_and_between_two_centres_is_nothing():
    assert not mask(shapely.Polygon(square(600, 0, 50)), GRID).any()
    assert not mask(shapely.Polygon(square(10.6, 10.6, 0.8)), GRID).any()


def crossings(corners, x_m, y_m):
    """Whether each point has an odd number of edges to its east."""
    odd = np.zeros(np.broadcast(x_m, y_m).shape, bool)
    for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if y0 != y1:
            odd ^= ((y0 > y_m) != (y1 > y_m)) & (x_m < x0 + (y_m - y0) * (x1 - x0) / (y1 - y0))
    return odd


@given(st.lists(st.floats(0.05, 1.6), min_size=3, max_size=25), st.floats(0.001, 0.999))
def test_stars_by_counting_edges(radii, shift):
    angle = np.linspace(0, 2 * np.pi, len(radii), endpoint=False) + shift
    radius_m = 150 * np.array(radii)
    corners = np.stack(
        [EAST + 250 + shift + radius_m * np.cos(angle), NORTH - 200 + radius_m * np.sin(angle)], axis=-1
    )
    expected = crossings(corners, GRID.x_m[None, :], GRID.y_m[:, None])
    assert (mask(shapely.Polygon(corners), GRID) == expected).all()
