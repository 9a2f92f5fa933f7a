"""From a folder of scans of each format to the series, by the lines of docs/how-to/your-own-files.md."""

import contextlib
import gzip
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import laspy
import numpy as np
import pytest
import xarray as xr
from readers.formats import test_formats as written
from support import tiny_station
from support.programs import tool

from station import open as open_series

pytestmark = pytest.mark.integration

COUNT, CELL_M, SIZE = 40_000, 0.5, 10.0
WEST_M, SOUTH_M = 600_000.0, 5_100_000.0
SITE = """
[station]
id = "formats"
data = "data"
[scans]
inbox = "inbox"
frame = "map"
settle_s = 0
{scans}
[map]
crs = "EPSG:32632"
[grid]
bounds_m = {{ west = 600000, south = 5100000, east = 600010, north = 5100010 }}
cell_m = 0.5
[adjustment]
method = "none"
[reference]
scans = 100
"""


class Ground(written.Points):
    """Echoes of a wavy ground on the map; only the last returns are ground."""

    def __init__(self):
        super().__init__(COUNT)
        random = np.random.default_rng(7)
        x_m, y_m = random.uniform(0.01, SIZE - 0.01, (2, COUNT))
        z_m = 1500 + 0.2 * np.sin(x_m) + 0.1 * y_m + random.normal(0, 0.005, COUNT)
        z_m[~self.is_last] += 0.8  # what is in the way: it must not count
        self.xyz_m = np.stack([WEST_M + x_m, SOUTH_M + y_m, z_m])
        self.xyz_m = np.round(self.xyz_m, 3) + 0.0003  # no point is on the edge of a cell


def las(path, points):
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = [0.0001] * 3, [WEST_M, SOUTH_M, 0.0]
    scan = laspy.LasData(header)
    scan.x, scan.y, scan.z = points.xyz_m
    scan.gps_time, scan.intensity = points.time_s, points.intensity
    scan.return_number, scan.number_of_returns = points.return_number, points.number_of_returns
    scan.write(path)
    return path


def packed(path, points):
    plain = las(path / "plain.laz", points)
    (path / "a.laz.gz").write_bytes(gzip.compress(plain.read_bytes()))
    plain.unlink()
    return path / "a.laz.gz"


def foreign(path, points):
    return las(path / "plain.laz", points).rename(path / "a.rxp")


def copc(path, points):
    copclib = pytest.importorskip("copclib")
    config = copclib.CopcConfigWriter(
        6, copclib.Vector3(*[0.0001] * 3), copclib.Vector3(WEST_M, SOUTH_M, 0.0)
    )
    low_m, high_m = points.xyz_m.min(axis=1) - 0.001, points.xyz_m.max(axis=1) + 0.001
    config.las_header.min, config.las_header.max = copclib.Vector3(*low_m), copclib.Vector3(*high_m)
    writer = copclib.FileWriter(str(path / "a.copc.laz"), config)
    order = np.random.default_rng(1).permutation(COUNT)  # by level, not by time
    for key, indices in (
        ((0, 0, 0, 0), order[:500]),
        ((1, 0, 0, 0), order[500:9000]),
        ((1, 1, 0, 0), order[9000:]),
    ):
        node = copclib.Points(writer.copc_config.las_header)
        for index in indices.tolist():
            point = node.CreatePoint()
            point.x, point.y, point.z = points.xyz_m[:, index].tolist()
            point.gps_time, point.intensity = float(points.time_s[index]), int(points.intensity[index])
            point.return_number = int(points.return_number[index])
            point.number_of_returns = int(points.number_of_returns[index])
            node.AddPoint(point)
        writer.AddNode(copclib.VoxelKey(*key), node)
    writer.Close()
    return path / "a.copc.laz"


def cloudcompare(path, points, name, *options):
    """Let CloudCompare read a PLY file and save it in a format of its own; it keeps scalar fields."""
    program, plyfile = tool("CloudCompare"), pytest.importorskip("plyfile")
    fields = {
        "time": points.time_s,
        "intensity": points.intensity,
        "return_number": points.return_number,
        "number_of_returns": points.number_of_returns,
    }
    columns = [*points.xyz_m, *(np.asarray(values, np.float32) for values in fields.values())]
    records = np.rec.fromarrays(columns, names=["x", "y", "z", *(f"scalar_{field}" for field in fields)])
    source = path.parent / "source.ply"
    plyfile.PlyData([plyfile.PlyElement.describe(np.asarray(records), "vertex")]).write(str(source))
    subprocess.run(
        [program, "-SILENT", "-NO_TIMESTAMP", "-AUTO_SAVE", "OFF", "-C_EXPORT_FMT", *options,
         "-O", "-GLOBAL_SHIFT", "AUTO", source, "-SAVE_CLOUDS", "FILE", path / name],
        check=True, capture_output=True, timeout=60, env={**os.environ, "QT_QPA_PLATFORM": "offscreen"},
    )  # fmt: skip
    return path / name


def rdbx(path, points):
    """Write what the stand-in for RIEGL's library reads: it has the published interface, over arrays."""
    with (path / "a.rdbx").open("wb") as file:
        np.savez(file, **vars(points) | {"reflectance_db": np.log10(1 + points.intensity)})
    return path / "a.rdbx"


RDBLIB = """
from types import SimpleNamespace
import contextlib
import numpy as np
from readers.formats.test_formats import FakeRdb

@contextlib.contextmanager
def rdb_open(path):
    yield FakeRdb(SimpleNamespace(**np.load(path)))
"""
COPY = [sys.executable, "-c", "import shutil, sys; shutil.copy(*sys.argv[1:3])", "{in}", "{out}"]
FORMATS = {  # that need no line in the site file
    "las": lambda path, points: las(path / "a.las", points),
    "laz": lambda path, points: las(path / "a.laz", points),
    "copc": copc,
    "laz.gz": packed,
    "e57": lambda path, points: written.e57_file(path / "a.e57", points),
    "ply": lambda path, points: written.ply_file(path / "a.ply", points),
    "pcd": written.FULL["compressed pcd"],
    "rdbx": rdbx,
    "named text": written.FULL["xyz"],
    "RiSCAN text": written.FULL["RiSCAN text"],
    "cloudcompare ply": lambda path, points: cloudcompare(
        path, points, "a.ply", "PLY", "-PLY_EXPORT_FMT", "BINARY_LE"
    ),
    "cloudcompare text": lambda path, points: cloudcompare(
        path, points, "a.asc", "ASC", "-PREC", "6", "-SEP", "SEMICOLON", "-ADD_HEADER", "-ADD_PTS_COUNT"
    ),
}
WITH_LINES = {
    "text": (
        lambda path, points: written.text_file(path / "a.csv", points, delimiter=",", fields="xyzitnc"),
        (
            'suffix = ".csv"\n'
            'columns = ["x", "y", "z", "intensity", "time", "return_number", "number_of_returns"]'
        ),
    ),
    "convert": (foreign, f'suffix = ".rxp"\nconvert = {json.dumps(COPY)}'),
}


def station(*arguments, **env):
    return subprocess.run([sys.executable, "-m", "station", *map(str, arguments)], env=os.environ | env,
                          capture_output=True, text=True, check=False, timeout=600)  # fmt: skip


def processed(folder, lines, formats):
    """Return the epoch files of a station by format, one scan an hour; None where no library writes it."""
    points, scans, epochs = Ground(), [], {}
    (folder / "inbox").mkdir()
    for hour, (kind, write) in enumerate(formats.items()):
        epochs[kind] = None
        with contextlib.suppress(pytest.skip.Exception):
            scan = write(folder / "inbox", points)
            scans.append(scan.rename(scan.with_name(f"250715_{hour:02d}0000{scan.name[1:]}")))
            epochs[kind] = f"*T{hour:02d}0000Z.nc"
    (folder / "site.toml").write_text(SITE.format(scans=lines))
    (folder / "rdblib" / "riegl").mkdir(parents=True)
    (folder / "rdblib" / "riegl" / "__init__.py").touch()
    (folder / "rdblib" / "riegl" / "rdb.py").write_text(RDBLIB)
    path = f"{folder / 'rdblib'}{os.pathsep}{Path(__file__).parent}"
    result = station("process", folder / "site.toml", *scans, PYTHONPATH=path)
    assert result.returncode == 0, result.stdout + result.stderr
    assert not list((folder / "data").glob("converting-*"))
    return {kind: name and next((folder / "data" / "epochs").rglob(name)) for kind, name in epochs.items()}


@pytest.fixture(scope="module")
def epochs(tmp_path_factory):
    found = processed(tmp_path_factory.mktemp("formats"), "", FORMATS)
    for kind, (write, lines) in WITH_LINES.items():
        found |= processed(tmp_path_factory.mktemp("formats"), lines, {kind: write})
    return found


@pytest.mark.parametrize("kind", [*FORMATS, *WITH_LINES])
def test_counts_are_exact_and_means_to_the_storage_quantum(kind, epochs):
    if epochs[kind] is None:
        pytest.skip("the library that writes it is not installed")
    points = Ground()
    column, row = ((points.xyz_m[:2] - [[WEST_M], [SOUTH_M]]) / CELL_M).astype(int)
    shape = round(SIZE / CELL_M), round(SIZE / CELL_M)
    cell = ((shape[0] - 1 - row) * shape[1] + column)[points.is_last]
    count = np.bincount(cell, minlength=shape[0] * shape[1]).reshape(shape)
    height_m = np.bincount(cell, points.xyz_m[2, points.is_last] - 1500, shape[0] * shape[1])
    mean_m = 1500 + height_m.reshape(shape) / count
    with xr.open_dataset(epochs[kind]) as epoch:
        stored = epoch.isel(time=0) if "time" in epoch.dims else epoch
        np.testing.assert_array_equal(stored["point_count"], count)
        total_m, systematic_m = (
            stored[f"elevation_change{part}_uncertainty"].to_numpy() for part in ("", "_systematic")
        )
        rounding_m = np.sqrt(total_m**2 - systematic_m**2) / 8 * (1 + 1 / 32) + 2**-13
        height_error_m = np.abs(stored["elevation_outside_reference"].to_numpy() - mean_m)
        single_precision = kind in {"pcd", "cloudcompare ply", "cloudcompare text"}
        assert (height_error_m <= rounding_m + single_precision * 1e-4).all()
        assert float(stored["point_total"]) == COUNT


def test_scans_without_scan_lines_are_measured_like_others(tmp_path):
    """The same echoes in any order, as a scanner without scan lines gives them, are the same series."""
    plyfile = pytest.importorskip("plyfile")
    folder = tiny_station.build(tmp_path / "laz", method="joint", hours=3)
    (folder / "inbox").rmdir()
    (folder / tiny_station.PENDING).rename(folder / "inbox")
    text = re.sub(r"\[inclination\]\n(?:[^\[\n].*\n|\n)*", "", (folder / "site.toml").read_text())
    assert 'frame = "scanner"' in text
    text = re.sub(r"point_time = .*\n", "", text)
    text = text.replace('frame = "scanner"', 'point_time = "none"\nframe = "scanner"')
    (folder / "site.toml").write_text(text)
    shuffled = shutil.copytree(folder, tmp_path / "ply")
    for path in (shuffled / "inbox").glob("*.laz"):
        las = laspy.read(path)
        order = np.random.default_rng(4).permutation(len(las.points))
        fields = {"x": las.x, "y": las.y, "z": las.z, "timestamp": las.gps_time, "intensity": las.intensity}
        columns = {name: np.asarray(values)[order] for name, values in fields.items()}
        records = np.rec.fromarrays(list(columns.values()), names=list(columns))
        element = plyfile.PlyElement.describe(np.asarray(records), "vertex")
        plyfile.PlyData([element]).write(str(path.with_suffix(".ply")))
        path.unlink()
    for site, suffix in ((folder, ".laz"), (shuffled, ".ply")):
        result = station("process", site / "site.toml", *sorted((site / "inbox").glob(f"*{suffix}")))
        assert result.returncode == 0, result.stdout + result.stderr
    expected, actual = (open_series(site / "data") for site in (folder, shuffled))
    assert np.isfinite(expected["elevation_change"]).any()
    for name in (
        "point_count",
        "elevation",
        "elevation_change",
        "elevation_change_uncertainty",
    ):
        np.testing.assert_array_equal(actual[name], expected[name], name)


def with_inclination_in_points(scan, log):
    """Write the last reading of a log into the extra bytes of each point, as PDAL does from RXP."""
    las = laspy.read(scan)
    time_s, *tilt_deg = np.loadtxt(log, delimiter=",", skiprows=1).T
    last = np.clip(np.searchsorted(time_s, las.gps_time, side="right") - 1, 0, None)
    las.add_extra_dims([laspy.ExtraBytesParams(axis, "float32") for axis in ("Roll", "Pitch")])
    las["Roll"], las["Pitch"] = (column[last] for column in tilt_deg)
    las.write(scan)
    log.unlink()


def test_inclination_in_the_points_is_used_like_a_log_file(tmp_path):
    """A log file tells each reading's own time, points within 0.1 s: change is the same within 0.1 sigma."""
    series = {}
    for name in ("file", "points"):
        folder = tiny_station.build(tmp_path / name, method="joint", hours=3)
        (folder / "inbox").rmdir()
        (folder / tiny_station.PENDING).rename(folder / "inbox")
        for scan in sorted((folder / "inbox").glob("*.laz")) if name == "points" else ():
            with_inclination_in_points(scan, scan.with_name(f"{scan.stem}-incl.txt"))
        result = station("process", folder / "site.toml", *sorted((folder / "inbox").glob("*.laz")))
        assert result.returncode == 0, result.stdout + result.stderr
        assert "log missing" not in result.stderr
        series[name] = open_series(folder / "data")
        assert (series[name]["verdict"] == 0).all()  # good, which it is not without a log
    expected, actual = (one["elevation_change"].to_numpy() for one in series.values())
    z = (actual - expected) / series["file"]["elevation_change_uncertainty"].to_numpy()
    known = np.isfinite(z)
    assert np.count_nonzero(known) > 0.95 * np.count_nonzero(np.isfinite(expected)) > 100
    assert np.sqrt(np.mean(z[known] ** 2)) < 0.1
    assert np.abs(z[known]).max() > 0
