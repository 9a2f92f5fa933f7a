"""Scans of other formats than LAS, each written by another library, against the arrays in them."""

import gzip
import struct
import sys
import types
from contextlib import contextmanager
from datetime import UTC, datetime

import numpy as np
import pytest
from readers.conftest import TURN_RAD_S, sweep

from station.errors import NotReadyError, ScanError
from station.readers.formats.conversion import open_site_scan, scan_suffixes
from station.readers.scan import open_scan, suffixes, utc_interval
from station.sections.inputs import ScansSection

COUNT = 3000
RANGE_MAX_M = 1000.0
DB_TO_INTENSITY = np.log(10) / 10


class Points:
    """Echoes with all that a scan can have; every third shot has two returns, and a few are noise."""

    def __init__(self, count=COUNT):
        self.xyz_m, self.time_s = sweep(count)
        index = np.arange(count)
        self.number_of_returns = np.where(index % 3 < 2, 2, 1)
        self.return_number = np.where(index % 3 == 1, 2, 1)
        self.intensity = (index * 17) % 60_000
        self.reflectance_db = -20.0 + (index % 240) / 10

    @property
    def is_last(self):
        return self.return_number == self.number_of_returns


def e57_file(path, points, *, spherical=False, pose=None, times=True, scans=1, start_s=1.43e9):
    """Write an E57 file with the library's nodes, because its writer knows no time stamps."""
    pye57 = pytest.importorskip("pye57")
    lib = pye57.libe57
    with pye57.E57(str(path), mode="w") as file:
        image = file.image_file
        for _ in range(scans):
            scan = lib.StructureNode(image)
            scan.set("guid", lib.StringNode(image, "{1}"))
            limits = lib.StructureNode(image)
            limits.set("intensityMinimum", lib.FloatNode(image, 0.0))
            limits.set("intensityMaximum", lib.FloatNode(image, 65535.0))
            scan.set("intensityLimits", limits)
            start = lib.StructureNode(image)
            start.set("dateTimeValue", lib.FloatNode(image, start_s))
            scan.set("acquisitionStart", start)
            if pose is not None:
                node = lib.StructureNode(image)
                for name, keys, values in (("rotation", "wxyz", pose[0]), ("translation", "xyz", pose[1])):
                    part = lib.StructureNode(image)
                    for key, value in zip(keys, values, strict=True):
                        part.set(key, lib.FloatNode(image, float(value)))
                    node.set(name, part)
                scan.set("pose", node)
            x_m, y_m, z_m = points.xyz_m
            columns = {"cartesianX": x_m, "cartesianY": y_m, "cartesianZ": z_m}
            if spherical:
                range_m = np.sqrt(x_m**2 + y_m**2 + z_m**2)
                columns = {
                    "sphericalRange": range_m,
                    "sphericalAzimuth": np.arctan2(y_m, x_m),
                    "sphericalElevation": np.arcsin(z_m / range_m),
                }
            columns["intensity"] = points.intensity.astype(float)
            if times:
                columns["timeStamp"] = points.time_s
            columns = {name: np.ascontiguousarray(values, dtype="f8") for name, values in columns.items()}
            integers = {
                "returnIndex": points.return_number - 1,
                "returnCount": points.number_of_returns,
                "sphericalInvalidState" if spherical else "cartesianInvalidState": np.zeros(len(x_m)),
            }
            prototype, buffers = lib.StructureNode(image), lib.VectorSourceDestBuffer()
            for name, values in columns.items():
                prototype.set(name, lib.FloatNode(image, 0.0, lib.FloatPrecision.E57_DOUBLE))
                buffers.append(lib.SourceDestBuffer(image, name, values, len(values), True, True))
            integers = {name: np.ascontiguousarray(values, dtype="i2") for name, values in integers.items()}
            for name, values in integers.items():
                prototype.set(name, lib.IntegerNode(image, 0, 0, 10))
                buffers.append(lib.SourceDestBuffer(image, name, values, len(values), True, True))
            vector = lib.CompressedVectorNode(image, prototype, lib.VectorNode(image, True))
            scan.set("points", vector)
            file.data3d.append(scan)
            writer = vector.writer(buffers)
            writer.write(len(x_m))
            writer.close()
    return path


def ply_file(path, points, *, text=False, byte_order="<"):
    plyfile = pytest.importorskip("plyfile")
    fields = {
        "x": points.xyz_m[0], "y": points.xyz_m[1], "z": points.xyz_m[2],
        "scalar_GpsTime": points.time_s, "scalar_Intensity": points.intensity.astype("u2"),
        "scalar_ReturnNumber": points.return_number.astype("u1"),
        "scalar_NumberOfReturns": points.number_of_returns.astype("u1"),
    }  # fmt: skip
    records = np.empty(len(points.time_s), [(name, values.dtype) for name, values in fields.items()])
    for name, values in fields.items():
        records[name] = values
    element = plyfile.PlyElement.describe(records, "vertex")
    faces = plyfile.PlyElement.describe(np.array([([0, 1, 2],)], [("vertex_indices", "i4", (3,))]), "face")
    plyfile.PlyData([element, faces], text=text, byte_order=byte_order).write(str(path))
    return path


def pcd_file(path, points, encoding):
    pypcd4 = pytest.importorskip("pypcd4")
    columns = {
        "x": points.xyz_m[0], "y": points.xyz_m[1], "z": points.xyz_m[2], "timestamp": points.time_s,
        "intensity": points.intensity.astype("f4"), "return_number": points.return_number.astype("u1"),
        "number_of_returns": points.number_of_returns.astype("u1"),
    }  # fmt: skip
    cloud = pypcd4.PointCloud.from_points(
        list(columns.values()), tuple(columns), tuple(values.dtype.type for values in columns.values())
    )
    cloud.save(path, encoding=pypcd4.Encoding[encoding])
    return path


def text_file(path, points, *, delimiter=" ", header="", decimal_comma=False, fields="xyzit"):
    columns = {
        "x": points.xyz_m[0], "y": points.xyz_m[1], "z": points.xyz_m[2], "i": points.intensity,
        "t": points.time_s, "r": points.reflectance_db,
        "n": points.return_number, "c": points.number_of_returns,
    }  # fmt: skip
    table = np.column_stack([columns[field] for field in fields])
    lines = [delimiter.join(f"{value:.6f}" for value in row) for row in table]
    if decimal_comma:
        lines = [line.replace(".", ",") for line in lines]
    path.write_text("\n".join([*([header] if header else []), *lines]) + "\n")
    return path


def read(path, *, range_max_m=RANGE_MAX_M, intensity="auto", size=1000, columns=()):
    with open_scan(path, range_max_m=range_max_m, columns=columns) as scan:
        blocks = list(scan.blocks(size, intensity=intensity))
    xyz_m = np.concatenate([block.xyz_m for block in blocks], axis=1)
    times, values = ([getattr(block, name) for block in blocks] for name in ("time_s", "intensity"))
    return (
        xyz_m,
        None if times[0] is None else np.concatenate(times),
        None if values[0] is None else np.concatenate(values),
    )


FULL = {
    "e57": lambda path, points: e57_file(path / "a.e57", points),
    "spherical e57": lambda path, points: e57_file(path / "a.e57", points, spherical=True),
    "ply": lambda path, points: ply_file(path / "a.ply", points),
    "big-endian ply": lambda path, points: ply_file(path / "a.ply", points, byte_order=">"),
    "text ply": lambda path, points: ply_file(path / "a.ply", points, text=True),
    "binary pcd": lambda path, points: pcd_file(path / "a.pcd", points, "BINARY"),
    "compressed pcd": lambda path, points: pcd_file(path / "a.pcd", points, "BINARY_COMPRESSED"),
    "text pcd": lambda path, points: pcd_file(path / "a.pcd", points, "ASCII"),
    "xyz": lambda path, points: text_file(
        path / "a.xyz", points, fields="xyzitnc",
        header="//X Y Z Intensity GpsTime return_number number_of_returns",
    ),
    "RiSCAN text": lambda path, points: text_file(
        path / "a.asc", points, delimiter=";", decimal_comma=True, fields="xyzitnc",
        header="X[m];Y[m];Z[m];Intensity;Timestamp[s];return number;number of returns",
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", FULL)
def test_points_times_returns_and_intensity_are_those_written(kind, tmp_path):
    points = Points()
    path = FULL[kind](tmp_path, points)
    xyz_m, time_s, intensity = read(path)
    last = points.is_last
    tolerance_m = 1e-6 if "pcd" not in kind else 1e-4
    assert xyz_m.shape == (3, last.sum())
    np.testing.assert_allclose(xyz_m, points.xyz_m[:, last], atol=tolerance_m)
    np.testing.assert_allclose(time_s, points.time_s[last], atol=1e-5)
    np.testing.assert_allclose(intensity, points.intensity[last] / 65535, atol=1e-6)
    for size in (7, 999):
        assert all(
            np.array_equal(a, b)
            for a, b in zip(read(path, size=size), (xyz_m, time_s, intensity), strict=False)
        )


@pytest.mark.parametrize("kind", FULL)
def test_header_and_track_follow_the_head(kind, tmp_path):
    points = Points()
    with open_scan(FULL[kind](tmp_path, points), range_max_m=RANGE_MAX_M) as scan:
        header, track = scan.header, scan.azimuth_track()
        assert scan.time_range_s() == pytest.approx((points.time_s[0], points.time_s[-1]), abs=1e-5)
    assert header.point_count == COUNT
    np.testing.assert_allclose(header.low_m, points.xyz_m.min(axis=1), atol=1e-4)
    turned_rad = track.azimuth_rad - TURN_RAD_S * track.time_s
    np.testing.assert_allclose(turned_rad, np.median(turned_rad), atol=1e-4)


@pytest.mark.parametrize("kind", FULL)
def test_files_that_are_cut_are_refused(kind, tmp_path):
    path = FULL[kind](tmp_path, Points(600))
    content = path.read_bytes()
    is_text = "xyz" in kind or "RiSCAN" in kind
    for end in (0, 3, 40, 200, len(content) // 2, len(content) - 3):
        if kind.endswith("ply") and end == len(content) - 3:
            continue  # the faces
        cut = content[:end]
        path.write_bytes(cut[:-1] if is_text and cut.endswith(b"\n") else cut)
        with pytest.raises(ScanError):
            read(path)


@pytest.mark.parametrize("kind", FULL)
def test_flipped_bytes_raise_or_read_but_never_more_points(kind, tmp_path):
    path = FULL[kind](tmp_path, Points(300))
    content, random = path.read_bytes(), np.random.default_rng(5)
    for _ in range(60):
        broken = bytearray(content)
        for position in random.integers(0, min(len(content), 4000), 3):
            broken[position] = random.integers(0, 256)
        path.write_bytes(bytes(broken))
        try:
            xyz_m, _, _ = read(path)
        except (ScanError, NotReadyError):
            continue
        assert xyz_m.shape[1] <= 600
        assert np.isfinite(xyz_m).all()


def test_pose_of_an_e57_scan_leads_to_the_map_only(tmp_path):
    points, half = Points(), np.sqrt(0.5)
    path = e57_file(tmp_path / "a.e57", points, pose=((half, 0, 0, half), (1000.0, 2000.0, 30.0)))
    xyz_m, _, _ = read(path, range_max_m=None)
    x_m, y_m, z_m = points.xyz_m[:, points.is_last]  # a quarter turn about z: (x, y) becomes (-y, x)
    np.testing.assert_allclose(xyz_m, [1000.0 - y_m, 2000.0 + x_m, 30.0 + z_m], atol=1e-9)
    np.testing.assert_allclose(read(path)[0], points.xyz_m[:, points.is_last], atol=1e-9)


def test_several_scans_of_an_e57_file_are_read_on_the_map_only(tmp_path):
    path = e57_file(tmp_path / "a.e57", Points(), scans=2)
    assert read(path, range_max_m=None)[0].shape[1] == 2 * Points().is_last.sum()
    with pytest.raises(ScanError, match="contains 2 scans"):
        open_scan(path, range_max_m=RANGE_MAX_M)


def test_start_in_an_e57_file_counts_if_the_name_has_none(tmp_path):
    path = e57_file(tmp_path / "a.e57", Points())  # 1.43e9 s after 6 January 1980, less 18 leap seconds
    with open_scan(path, range_max_m=RANGE_MAX_M) as scan:
        start, _, _ = utc_interval(scan, "%y%m%d_%H%M%S")
    assert start == datetime(2025, 4, 29, 22, 13, 2, tzinfo=UTC)


def test_without_the_library_a_scan_waits(tmp_path, monkeypatch):
    (tmp_path / "a.e57").write_bytes(b"ASTM-E57")
    (tmp_path / "a.rdbx").write_bytes(b"RDB")
    monkeypatch.setitem(sys.modules, "pye57", None)
    monkeypatch.setitem(sys.modules, "riegl", None)
    for name, advice in (("a.e57", r"tls-station\[e57\]"), ("a.rdbx", "rdblib")):
        with pytest.raises(NotReadyError, match=advice):
            open_scan(tmp_path / name)


def test_header_counts_that_lie_are_refused(tmp_path):
    path = e57_file(tmp_path / "a.e57", Points(300), times=False)
    content = path.read_bytes()
    assert b'recordCount="300"' in content
    path = ply_file(tmp_path / "a.ply", Points(300))
    path.write_bytes(path.read_bytes().replace(b"vertex 300", b"vertex 3000000000000"))
    with pytest.raises(ScanError, match="cut off: 3,000,000,000,000 points"):
        open_scan(path)
    path = pcd_file(tmp_path / "a.pcd", Points(300), "BINARY_COMPRESSED")
    content = path.read_bytes()
    path.write_bytes(content.replace(b"POINTS 300", b"POINTS 900000000"))
    with pytest.raises(ScanError, match="900,000,000 points need"):
        open_scan(path)
    start = content.index(b"DATA binary_compressed\n") + 23
    sizes = struct.pack("<II", 2**31, struct.unpack("<II", content[start : start + 8])[1])
    path.write_bytes(content[:start] + sizes + content[start + 8 :])
    with pytest.raises(ScanError, match="cut off"):
        open_scan(path)


def test_a_bomb_of_compressed_points_is_refused(tmp_path):
    path = pcd_file(tmp_path / "a.pcd", Points(300), "BINARY_COMPRESSED")
    content = path.read_bytes()
    start = content.index(b"DATA binary_compressed\n") + 23
    size = struct.unpack("<II", content[start : start + 8])[1] // 300 * 50_000_000
    content = content.replace(b"POINTS 300", b"POINTS 50000000")
    start = content.index(b"DATA binary_compressed\n") + 23
    path.write_bytes(content[:start] + struct.pack("<II", 1000, size) + content[start + 8 :])
    with pytest.raises(ScanError, match="1,000 bytes cannot hold"):
        open_scan(path)


def test_organised_clouds_hold_nan_where_there_was_no_echo(tmp_path):
    points = Points(300)
    points.xyz_m[:, ::5] = np.nan
    with open_scan(pcd_file(tmp_path / "a.pcd", points, "BINARY"), range_max_m=RANGE_MAX_M) as scan:
        assert scan.header.point_count == 300
        blocks = list(scan.blocks())
    kept = points.is_last & np.isfinite(points.xyz_m[0])
    assert sum(len(block) for block in blocks) == kept.sum()


@pytest.mark.parametrize(
    ("options", "columns"),
    [
        ({"fields": "xyz"}, ()),
        ({"fields": "xyz", "delimiter": ","}, ()),
        ({"fields": "xyz", "delimiter": ";", "decimal_comma": True}, ()),
        ({"fields": "xyz", "decimal_comma": True}, ()),
        ({"fields": "xyz", "header": str(COUNT)}, ()),
        ({"fields": "xyz", "header": "# exported by a program"}, ()),
        ({"fields": "txyzr"}, ("time", "x", "y", "z", "-")),
        ({"fields": "xyzt", "header": '"X","Y","Z","GPS Time"', "delimiter": ","}, ()),
    ],
)
def test_dialects_of_text(tmp_path, options, columns):
    points = Points()
    xyz_m, time_s, _ = read(text_file(tmp_path / "a.xyz", points, **options), columns=columns)
    np.testing.assert_allclose(xyz_m, points.xyz_m, atol=1e-6)
    assert (time_s is not None) == ("t" in options["fields"])


def test_text_without_names_of_its_columns_is_refused(tmp_path):
    path = text_file(tmp_path / "a.xyz", Points(30), fields="xyzitn")
    with pytest.raises(ScanError, match=r"has 6 columns without names.*scans\.columns"):
        open_scan(path)
    with pytest.raises(ScanError, match="has 6 columns, but 3 names"):
        open_scan(path, columns=("x", "y", "z"))


def test_text_with_the_wrong_count_a_word_or_a_gap_is_refused(tmp_path):
    path = text_file(tmp_path / "a.pts", Points(30), fields="xyz", header="31")
    with pytest.raises(ScanError, match="cut off: 30 of 31 points"):
        open_scan(path)
    for line in ("1.0 2.0\n", "1.0 two 3.0\n", "nan 2.0 3.0\n", "1.0 2.0 3.0 4.0\n", "x" * 10_000 + "\n"):
        path = text_file(tmp_path / "a.xyz", Points(30), fields="xyz")
        path.write_text(path.read_text() + line)
        with pytest.raises(ScanError):
            open_scan(path)


def test_reflectance_in_decibels_is_linear_intensity(tmp_path):
    points = Points()
    path = text_file(tmp_path / "a.xyz", points, fields="xyzir", header="x y z intensity Reflectance[dB]")
    expected = 0.25 * np.exp(points.reflectance_db * DB_TO_INTENSITY)
    np.testing.assert_allclose(read(path)[2], expected, rtol=1e-6)
    np.testing.assert_allclose(read(path, intensity="linear")[2], points.intensity / 65535, atol=1e-6)
    assert read(path, intensity="none")[2] is None


@pytest.mark.parametrize(
    ("values", "full"), [((0.0, 0.9), 1.0), ((0, 250), 255.0), ((3, 4000), 4095.0), ((0, 5000), 65535.0)]
)
def test_scale_of_intensity_does_not_follow_the_scan(tmp_path, values, full):
    points = Points(30)
    points.intensity = np.linspace(*values, 30)
    path = text_file(tmp_path / "a.xyz", points, fields="xyzi")
    np.testing.assert_allclose(read(path)[2], points.intensity / full, atol=1e-6)


def test_pts_intensity_is_signed(tmp_path):
    points = Points(30)
    points.intensity = np.linspace(-2048, 2047, 30)
    np.testing.assert_allclose(
        read(text_file(tmp_path / "a.pts", points, fields="xyzi"))[2], np.linspace(0, 1, 30), atol=1e-6
    )


def test_a_head_that_does_not_turn_steadily_has_no_track(tmp_path):
    points = Points()
    points.time_s = np.random.default_rng(1).permutation(points.time_s)
    path = text_file(tmp_path / "a.xyz", points, fields="xyzt", header="x y z time")
    with open_scan(path, range_max_m=RANGE_MAX_M) as scan:
        assert scan.time_range_s() is not None
        assert scan.azimuth_track() is None


def test_points_that_are_far_or_in_another_frame_are_refused(tmp_path):
    points = Points()
    points.xyz_m[0, 1000] = 5000.0
    points.return_number[1000] = points.number_of_returns[1000] = 1
    with pytest.raises(ScanError, match=r"an echo 5,0\d\d m away"):
        read(ply_file(tmp_path / "a.ply", points))
    points = Points()
    points.xyz_m += np.array([[600_000.0], [5_000_000.0], [0.0]])
    with pytest.raises(ScanError, match=r"scans.frame = \"map\""):
        read(ply_file(tmp_path / "b.ply", points))
    assert read(tmp_path / "b.ply", range_max_m=None)[0].shape[1] == points.is_last.sum()


class FakeRdb:
    """The published interface of RIEGL's library, over arrays; the arrays of a chunk keep their length."""

    def __init__(self, points):
        self._columns = {
            "riegl.id": np.arange(1, len(points.time_s) + 1),
            "riegl.xyz": points.xyz_m.T,
            "riegl.timestamp": points.time_s,
            "riegl.reflectance": points.reflectance_db,
            "riegl.target_index": points.return_number.astype("u1"),
            "riegl.target_count": points.number_of_returns.astype("u1"),
        }
        self.point_attributes = {name: types.SimpleNamespace(name=name) for name in self._columns}
        self._stat = types.SimpleNamespace(point_count_total=len(points.time_s))

    @property
    @contextmanager
    def stat(self):
        yield self._stat

    def select(self, selection="", attributes=None, chunk_size=1000):
        assert selection == ""
        total = len(self._columns["riegl.id"])
        buffers = {
            name: np.empty((chunk_size, *self._columns[name].shape[1:]), self._columns[name].dtype)
            for name in attributes
        }
        for first in range(0, total, chunk_size):
            for name, buffer in buffers.items():
                values = self._columns[name][first : first + chunk_size]
                buffer[: len(values)] = values
            yield buffers


@pytest.fixture
def rdblib(monkeypatch):
    """Return a function that installs a stand-in for RIEGL's library, whose files all hold some points."""

    def install(points):
        @contextmanager
        def rdb_open(path):
            assert isinstance(path, str)
            yield FakeRdb(points)

        module = types.ModuleType("riegl.rdb")
        module.rdb_open = rdb_open
        package = types.ModuleType("riegl")
        package.rdb = module
        monkeypatch.setitem(sys.modules, "riegl", package)
        monkeypatch.setitem(sys.modules, "riegl.rdb", module)

    return install


def test_rdbx_through_the_interface_of_its_library(tmp_path, rdblib):
    points = Points()
    rdblib(points)
    (tmp_path / "a.rdbx").write_bytes(b"RDB")
    xyz_m, time_s, intensity = read(tmp_path / "a.rdbx")
    last = points.is_last
    np.testing.assert_array_equal(xyz_m, points.xyz_m[:, last])
    np.testing.assert_array_equal(time_s, points.time_s[last])
    np.testing.assert_allclose(intensity, 0.25 * np.exp(points.reflectance_db[last] * DB_TO_INTENSITY))


def test_compressed_files_are_read_like_others_and_leave_nothing(tmp_path, write_sweep):
    scans = ScansSection(inbox=tmp_path)
    plain = write_sweep("250715_090000.laz", 5000)
    packed = tmp_path / "250715_090000.laz.gz"
    packed.write_bytes(gzip.compress(plain.read_bytes()))
    work = tmp_path / "data"
    work.mkdir()
    (work / "converting-999999999-left").mkdir()  # by a worker that was killed
    with open_site_scan(packed, scans, range_max_m=RANGE_MAX_M, work_folder=work) as scan:
        assert len(list(work.iterdir())) == 1
        assert utc_interval(scan, "%y%m%d_%H%M%S")[0] == datetime(2025, 7, 15, 9, tzinfo=UTC)
        xyz_m = np.concatenate([block.xyz_m for block in scan.blocks()], axis=1)
    np.testing.assert_array_equal(xyz_m, read(plain)[0])
    assert not list(work.iterdir())
    packed.write_bytes(packed.read_bytes()[:-300])
    with (
        pytest.raises(ScanError, match="cannot be decompressed"),
        open_site_scan(packed, scans, range_max_m=RANGE_MAX_M, work_folder=work),
    ):
        pass
    assert not list(work.iterdir())


def test_a_gzip_bomb_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("station.readers.formats.conversion.MIN_LIMIT_BYTES", 1 << 22)
    bomb = tmp_path / "a.xyz.gz"
    bomb.write_bytes(gzip.compress(bytes(1 << 25)))
    with (
        pytest.raises(ScanError, match="50 times as long"),
        open_site_scan(bomb, ScansSection(inbox=tmp_path), range_max_m=None, work_folder=tmp_path),
    ):
        pass


def test_suffixes_of_logs_are_those_of_scans_only_if_chosen(tmp_path):
    assert {".las", ".laz", ".e57", ".ply", ".pcd", ".xyz", ".rdbx", ".laz.gz"} <= set(suffixes())
    assert not {".csv", ".txt", ".gz"} & set(suffixes())
    scans = ScansSection(inbox=tmp_path, suffix=".CSV")
    assert scan_suffixes(scans) == (".csv",)
    path = text_file(tmp_path / "a.csv", Points(30), fields="xyz", delimiter=",")
    assert read(path)[0].shape == (3, 30)


def test_text_may_state_its_count_before_or_after_the_names(tmp_path):
    """CloudCompare writes the count after the names."""
    for lines in (("//X;Y;Z;Intensity", "3"), ("3", "//X;Y;Z;Intensity")):
        rows = [f"{100 + index};50;2;{index}" for index in range(3)]
        (tmp_path / "a.asc").write_text("\n".join([*lines, *rows, ""]))
        assert read(tmp_path / "a.asc")[0][0].tolist() == [100, 101, 102]
        (tmp_path / "a.asc").write_text("\n".join([*lines, *rows[:2], ""]))
        with pytest.raises(ScanError, match="cut off: 2 of 3 points"):
            read(tmp_path / "a.asc")
