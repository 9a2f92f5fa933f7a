"""An octree as two other programs read it: laspy's CopcReader and copclib."""

import laspy
import numpy as np
import pytest
from pyproj import CRS

from station.products.exports.copc import LEAF_POINTS, write_copc

COUNT = 3 * LEAF_POINTS


def cloud(coordinates):
    """Return a header and records with these integer coordinates (3, n) and distinct extra bytes."""
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = np.full(3, 0.0001), np.array([635_000.0, 5_185_000.0, 2500.0])
    header.add_extra_dims([laspy.ExtraBytesParams("elevation_change", "f4", "above the reference [m]")])
    header.add_crs(CRS.from_epsg(32632))
    records = laspy.ScaleAwarePointRecord.zeros(coordinates.shape[1], header=header)
    records["X"][:], records["Y"][:], records["Z"][:] = coordinates
    records.return_number[:] = records.number_of_returns[:] = 1
    records.gps_time[:] = records["elevation_change"][:] = np.arange(coordinates.shape[1])
    return header, records.array


def write(path, coordinates):
    header, records = cloud(coordinates)
    with path.open("w+b") as file:
        write_copc(file, header, records)
    return records


@pytest.fixture(scope="module")
def terrain(tmp_path_factory):
    rng = np.random.default_rng(4)
    east, north = rng.integers(-20_000_000, 20_000_000, (2, COUNT))
    height = (2_000_000 * np.sin(east / 5e6)).astype(int) + rng.integers(-500, 500, COUNT)
    path = tmp_path_factory.mktemp("copc") / "a.copc.laz"
    return path, write(path, np.stack([east, north, height]))


def test_laspy_finds_every_point_once(terrain):
    path, records = terrain
    with laspy.CopcReader.open(str(path)) as reader:
        found = reader.query().array
        assert reader.header.parse_crs().to_epsg() == 32632
        assert reader.header.number_of_points_by_return[0] == COUNT
        low_m, high_m = np.array([635_000.0, 5_185_000.0]), np.array([635_300.0, 5_185_200.0])
        box = reader.query(bounds=laspy.Bounds(low_m, high_m))
        sizes = [len(reader.query(level=level)) for level in range(3)]
    np.testing.assert_array_equal(found[np.argsort(found["gps_time"])], records)
    east_m, north_m = records["X"] * 0.0001, records["Y"] * 0.0001
    assert len(box) == ((east_m >= 0) & (east_m <= 300) & (north_m >= 0) & (north_m <= 200)).sum()
    assert 0 < sizes[0] < sizes[1] < COUNT  # a viewer sees all of it before it is loaded
    assert len(laspy.read(path).points) == COUNT  # to other programs it is LAZ


def test_copclib_finds_each_point_in_its_node(terrain):
    copclib = pytest.importorskip("copclib")
    path, _ = terrain
    reader = copclib.FileReader(str(path))
    assert reader.ValidateSpatialBounds()
    nodes = reader.GetAllNodes()
    assert sum(node.point_count for node in nodes) == COUNT
    keys = {(node.key.d, node.key.x, node.key.y, node.key.z) for node in nodes}
    assert all((d - 1, x >> 1, y >> 1, z >> 1) in keys for d, x, y, z in keys if d)


@pytest.mark.parametrize(
    "values",
    [[7], [5] * (LEAF_POINTS + 1), [-(2**31), 0, 2**31 - 1]],
    ids=["one point", "more equal points than a leaf has", "the widest cube"],
)
def test_extreme_clouds_are_complete(values, tmp_path):
    write(tmp_path / "a.copc.laz", np.array([values] * 3))
    with laspy.CopcReader.open(str(tmp_path / "a.copc.laz")) as reader:
        assert sorted(reader.query()["Z"].tolist()) == values
