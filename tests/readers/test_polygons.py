"""Polygons from GeoJSON: cell masks compared with plane geometry, and invalid files."""

import json
import math

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from station.errors import ConfigError
from station.quantities import Grid
from station.readers.polygons import cells_inside, mended_outlines, read_polygons, to_geojson

CRS = "EPSG:32632"
EAST, NORTH = 632000.0, 5186000.0
GRID = Grid(EAST, NORTH, 1.0, 500, 400)


def ring(*corners):
    """A closed ring of corners (east, south) relative to the north-west corner of the grid [m]."""
    vertices = [[EAST + east, NORTH - south] for east, south in corners]
    return [*vertices, vertices[0]]


def square(west, north, size):
    return ring((west, north), (west, north + size), (west + size, north + size), (west + size, north))


def polygon(*rings):
    return {"type": "Polygon", "coordinates": list(rings)}


def feature(geometry, **members):
    return {"type": "Feature", "properties": {}, "geometry": geometry} | members


def collection(*features, **members):
    return {"type": "FeatureCollection", "features": list(features)} | members


@pytest.fixture
def read(tmp_path):
    def read(content, crs=CRS):
        path = tmp_path / "areas.geojson"
        path.write_text(content if isinstance(content, str) else json.dumps(content), encoding="utf-8")
        return read_polygons(path, crs)

    return read


def test_names_and_order(read):
    polygons = read(
        collection(
            feature(polygon(square(0, 0, 10)), properties={"name": "Süd ", "id": 5}),
            feature(polygon(square(20, 0, 10)), properties={"name": None, "id": 7}),
            feature(polygon(square(40, 0, 10)), properties=None, id="gate"),
            feature(polygon(square(60, 0, 10)), properties={"name": ""}),
            feature(polygon(square(80, 0, 10)), properties={"Name": "Nord", "ID": 8}),
        )
    )
    assert list(polygons) == ["Süd", "7", "gate", "area_4", "Nord"]
    assert [geometry.area for geometry in polygons.values()] == [100.0] * 5


@pytest.mark.parametrize(
    "wrap", [lambda geometry: geometry, feature, lambda geometry: collection(feature(geometry))]
)
def test_geometry_feature_and_collection(read, wrap):
    assert read(wrap(polygon(square(0, 0, 10))))["area_1"].area == 100.0


def test_heights_and_byte_order_mark_are_ignored(read):
    outline = [[*corner, 2800.0] for corner in square(0, 0, 10)]
    assert not read("\ufeff" + json.dumps(polygon(outline)))["area_1"].has_z


def test_equivalent_names_of_the_crs(read):
    named = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::32632"}}
    assert read(collection(feature(polygon(square(0, 0, 10))), crs=named), "EPSG:32632+3855")
    assert read(collection(feature(polygon(square(0, 0, 10))), crs=None))


def test_small_coordinates_without_a_crs_are_metres(read):
    local = {"type": "Polygon", "coordinates": [[[0, 0], [50, 0], [50, 50], [0, 0]]]}
    assert read(local, None)["area_1"].area == 1250.0


DEGREES = {"type": "Polygon", "coordinates": [[[10.7, 46.7], [10.8, 46.7], [10.8, 46.8], [10.7, 46.7]]]}
BOW_TIE = polygon(ring((0, 0), (10, 10), (10, 0), (0, 10)))
CRS84 = {"type": "name", "properties": {"name": "urn:ogc:def:crs:OGC:1.3:CRS84"}}
ZONE_33 = {"type": "name", "properties": {"name": "EPSG:32633"}}
GOOD = feature(polygon(square(0, 0, 10)), properties={"name": "gate"})


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "areas.geojson: not valid GeoJSON"),
        ("[]", "the top level is not an object"),
        ({"type": "Topology"}, "its type is 'Topology'"),
        ({"type": "FeatureCollection"}, "is not a GeoJSON of polygons"),
        (collection(), "contains no feature"),
        (collection(5), "feature 1: is not a GeoJSON feature"),
        (collection(GOOD, feature(None)), r"feature 2 \(area_2\): is without geometry"),
        (collection(feature({"type": "Point", "coordinates": [1, 2]})), "is Point; expected Polygon or"),
        (collection(feature({"type": "GeometryCollection", "geometries": []})), "is GeometryCollection"),
        (feature(polygon()), "has no vertices"),
        (feature({"type": "Polygon"}), r"feature 1 \(area_1\): is damaged"),
        (feature(polygon([[EAST, NORTH], ["a", 1], [2, 2], [EAST, NORTH]])), "is damaged"),
        (feature(polygon([[EAST, NORTH], [math.nan, 1], [2, 2], [EAST, NORTH]])), "is damaged"),
        (feature(polygon(square(0, 0, 10)[:-1])), "do not form a closed"),
        (feature(BOW_TIE, id="bow"), r"feature 1 \(bow\): Self-intersection.*repair its outline"),
        (collection(GOOD, GOOD), r"feature 2 \(gate\): another feature has this name"),
        (collection(GOOD, feature(DEGREES)), r"feature 2 .*look like degrees, others of the file do not"),
        (collection(feature(polygon(square(1e30, 0, 1e30))), crs=ZONE_33), "not in the area of its CRS"),
        (collection(GOOD, crs={"type": "link", "properties": {"href": "x"}}), "not understood"),
        (collection(GOOD, crs="nowhere"), "not understood"),
    ],
)
def test_invalid_files_are_explained(read, content, message):
    with pytest.raises(ConfigError, match=message):
        read(content)


@pytest.mark.parametrize(
    ("crs", "declared"),
    [
        ("EPSG:4326", None),
        ("EPSG:4326", CRS84),
        ("EPSG:32633", ZONE_33),
        ("EPSG:3857", {"properties": {"name": "EPSG:3857"}}),
    ],
)
def test_other_coordinate_systems_are_reprojected(read, crs, declared):
    """A GeoJSON without a CRS is in degrees of WGS84 (RFC 7946). Expected: GDAL's own transformation."""
    warp = pytest.importorskip("rasterio.warp")
    on_map = polygon(square(100, 100, 300))
    elsewhere = warp.transform_geom(CRS, crs, on_map, precision=12)
    (area,) = read(collection(feature(elsewhere), crs=declared)).values()
    np.testing.assert_allclose(
        shapely.get_coordinates(area),
        shapely.get_coordinates(shapely.from_geojson(json.dumps(on_map))),
        atol=1e-5,
    )


@pytest.mark.parametrize("suffix", [".gpkg", ".shp"])
@pytest.mark.parametrize("crs", ["EPSG:32632", "EPSG:4326", "EPSG:25832"])
def test_geopackage_and_shapefile(tmp_path, suffix, crs):
    pyogrio = pytest.importorskip("pyogrio")
    warp = pytest.importorskip("rasterio.warp")
    shapes = {"Süd": polygon(square(100, 100, 300)), "Nord": polygon(square(0, 0, 10))}
    elsewhere = [
        shapely.from_geojson(json.dumps(warp.transform_geom(CRS, crs, shape))) for shape in shapes.values()
    ]
    path = tmp_path / f"areas{suffix}"
    pyogrio.raw.write(
        path,
        shapely.to_wkb(elsewhere),
        [np.array(list(shapes), object)],
        ["Name"],
        geometry_type="Polygon",
        crs=crs,
        encoding="UTF-8",
    )
    areas = read_polygons(path, CRS)
    assert list(areas) == list(shapes)
    assert [area.area for area in areas.values()] == pytest.approx([90_000, 100], rel=1e-6)
    assert areas["Nord"].bounds == pytest.approx((EAST, NORTH - 10, EAST + 10, NORTH), abs=1e-4)
    (tmp_path / "copy").write_text(to_geojson(areas, CRS))
    copied = read_polygons(tmp_path / "copy", CRS)
    assert {name: area.wkb for name, area in copied.items()} == {
        name: area.wkb for name, area in areas.items()
    }
    path.write_bytes(path.read_bytes()[:90])
    with pytest.raises(ConfigError):
        read_polygons(path, CRS)


@pytest.mark.filterwarnings("ignore:Non closed ring")
def test_an_open_ring_of_a_shapefile_is_refused(tmp_path):
    """GDAL reads a ring whose last vertex is not its first; GEOS does not."""
    pyogrio = pytest.importorskip("pyogrio")
    path = tmp_path / "areas.shp"
    pyogrio.raw.write(
        path,
        shapely.to_wkb([shapely.box(0, 0, 10, 10)]),
        [np.array(["a"], object)],
        ["name"],
        geometry_type="Polygon",
        crs=CRS,
    )
    content = bytearray(path.read_bytes())
    content[-16:-8] = np.float64(5).tobytes()  # x of the last vertex
    path.write_bytes(content)
    with pytest.raises(ConfigError, match=r"feature 1 \(a\): is damaged"):
        read_polygons(path, CRS)


TWO_HALVES = {"type": "MultiPolygon", "coordinates": [[square(0, 0, 10)], [square(10, 0, 10)]]}
OVERLAPPING = {"type": "MultiPolygon", "coordinates": [[square(0, 0, 10)], [square(5, 0, 10)]]}
SPIKE = polygon(ring((0, 0), (0, 10), (10, 10), (10, 0), (5, 0), (5, -20), (5, 0)))


@pytest.mark.parametrize(("shape", "area_m2"), [(TWO_HALVES, 200.0), (SPIKE, 100.0)])
def test_outlines_that_touch_are_mended_and_said(read, tmp_path, shape, area_m2):
    assert read(feature(shape, id="a"))["a"].is_valid
    assert read(feature(shape, id="a"))["a"].area == area_m2
    assert cells_inside(read(feature(shape))["area_1"], GRID).sum() == area_m2
    (message,) = mended_outlines(tmp_path / "areas.geojson", CRS)
    assert "feature 1 (area_1)" in message
    assert message.endswith("mended")
    read(GOOD)
    assert mended_outlines(tmp_path / "areas.geojson", CRS) == []


@pytest.mark.parametrize("shape", [BOW_TIE, OVERLAPPING])
def test_outlines_whose_area_would_change_are_refused(read, shape):
    with pytest.raises(ConfigError, match="repair its outline"):
        read(feature(shape))


def test_binary_and_missing_files(tmp_path):
    (tmp_path / "photo.geojson").write_bytes(b"\xff\xd8\xff\xe0")
    with pytest.raises(ConfigError, match="not valid GeoJSON"):
        read_polygons(tmp_path / "photo.geojson", CRS)
    with pytest.raises(ConfigError, match="cannot be read: No such file"):
        read_polygons(tmp_path / "none.geojson", CRS)


def test_square():
    inside = cells_inside(shapely.Polygon(square(100, 50, 30)), GRID)
    assert inside.sum() == 900
    assert inside[50:80, 100:130].all()


def test_ring():
    """The area of a ring of radii 150 m and 60 m is π (150² − 60²) m²."""
    centre = shapely.Point(EAST + 250, NORTH - 200)
    ring_shaped = centre.buffer(150, quad_segs=500) - centre.buffer(60, quad_segs=500)
    assert cells_inside(ring_shaped, GRID).sum() == pytest.approx(math.pi * (150**2 - 60**2), rel=2e-3)


def test_multipolygon_across_the_edge_of_the_grid():
    parts = shapely.MultiPolygon(
        [shapely.Polygon(square(-10, -10, 30)), shapely.Polygon(square(490, 390, 50))]
    )
    inside = cells_inside(parts, GRID)
    assert inside[:20, :20].all()
    assert inside[390:, 490:].all()
    assert inside.sum() == 20 * 20 + 10 * 10


def test_polygons_that_contain_no_cell_centre():
    assert not cells_inside(shapely.Polygon(square(600, 0, 50)), GRID).any()
    assert not cells_inside(shapely.Polygon(square(10.6, 10.6, 0.8)), GRID).any()


def is_inside_by_crossings(corners, x_m, y_m):
    """Return True for points with an odd number of edges to their east."""
    odd = np.zeros(np.broadcast(x_m, y_m).shape, bool)
    for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if y0 != y1:
            odd ^= ((y0 > y_m) != (y1 > y_m)) & (x_m < x0 + (y_m - y0) * (x1 - x0) / (y1 - y0))
    return odd


@given(st.lists(st.floats(0.05, 1.6), min_size=3, max_size=25), st.floats(0.001, 0.999))
@pytest.mark.integration
def test_random_stars_equal_the_crossing_number(radii, shift):
    angle = np.linspace(0, 2 * np.pi, len(radii), endpoint=False) + shift
    radius_m = 150 * np.array(radii)
    corners = np.stack(
        [EAST + 250 + shift + radius_m * np.cos(angle), NORTH - 200 + radius_m * np.sin(angle)], axis=-1
    )
    expected = is_inside_by_crossings(corners, GRID.x_m[None, :], GRID.y_m[:, None])
    assert (cells_inside(shapely.Polygon(corners), GRID) == expected).all()
