"""The inclination that points carry: the last reading of the sensor with each point, as PDAL writes it."""

import laspy
import numpy as np
import pytest
from readers.conftest import sweep

from station.readers.formats.point_inclination import PointInclination, tilt_field
from station.readers.scan import open_scan

COUNT, RATE_HZ, FIRST_S = 60_000, 2000.0, 40.0
RANGE_MAX_M = 1000.0


def sensor(seed=3):
    """Return times [s], roll and pitch [°] of readings about a second apart, in steps of 0.001°."""
    random = np.random.default_rng(seed)
    time_s = FIRST_S - 1.5 + np.cumsum(random.uniform(0.9, 1.1, 32))
    tilt_deg = np.array([[-0.286], [31.2]]) + np.cumsum(
        random.choice([-0.003, 0.002, 0.004], (2, 32)), axis=1
    )
    return time_s, *np.round(tilt_deg, 3)


def points():
    """Return echoes, their times and the reading that stands with each of them."""
    points_m, time_s = sweep(COUNT, first_s=FIRST_S, rate_hz=RATE_HZ)
    reading_s, roll_deg, pitch_deg = sensor()
    last = np.clip(np.searchsorted(reading_s, time_s, side="right") - 1, 0, None)
    return points_m, time_s, roll_deg[last], pitch_deg[last]


def las_file(path, *, kind="float32", names=("Roll", "Pitch"), point_format=6, order=slice(None)):
    points_m, time_s, roll_deg, pitch_deg = points()
    header = laspy.LasHeader(point_format=point_format, version="1.4")
    header.scales, header.offsets = [0.001] * 3, [0.0] * 3
    header.add_extra_dim(laspy.ExtraBytesParams("Amplitude", "float32"))
    for name in names:
        scaled = {"scales": np.array([0.001]), "offsets": np.array([0.0])} if kind == "int32" else {}
        header.add_extra_dim(laspy.ExtraBytesParams(name, kind, **scaled))
    scan = laspy.LasData(header)
    scan.x, scan.y, scan.z = points_m[:, order]
    scan.gps_time, scan.intensity = time_s[order], np.arange(COUNT) % 60_000
    for name, tilt_deg in zip(names, (roll_deg, pitch_deg), strict=True):
        scan[name] = tilt_deg[order]
    scan.write(path)
    return path


def text_file(path):
    points_m, time_s, roll_deg, pitch_deg = points()
    header = "//X Y Z Time Roll[deg] Pitch[deg]"
    np.savetxt(path, np.stack([*points_m, time_s, roll_deg, pitch_deg]).T, "%.6f", header=header, comments="")
    return path


def ply_file(path):
    plyfile = pytest.importorskip("plyfile")
    points_m, time_s, roll_deg, pitch_deg = points()
    columns = [*points_m, time_s, np.radians(roll_deg), np.radians(pitch_deg)]
    records = np.rec.fromarrays(
        columns, names=["x", "y", "z", "gps_time", "scalar_roll_rad", "scalar_pitch_rad"]
    )
    plyfile.PlyData([plyfile.PlyElement.describe(np.asarray(records), "vertex")]).write(str(path))
    return path


FILES = {
    "pdal": ("a.laz", las_file),
    "pdal las": ("a.las", las_file),
    "not layered": ("a.laz", lambda path: las_file(path, point_format=1)),
    "whole numbers": ("a.laz", lambda path: las_file(path, kind="int32")),
    "text": ("a.xyz", text_file),
    "ply": ("a.ply", ply_file),
}


@pytest.mark.parametrize("kind", FILES)
def test_readings_are_found_where_they_change(tmp_path, kind):
    name, write = FILES[kind]
    reading_s, roll_deg, pitch_deg = sensor()
    inside = (reading_s > FIRST_S) & (reading_s < FIRST_S + COUNT / RATE_HZ)
    with open_scan(write(tmp_path / name), range_max_m=RANGE_MAX_M) as scan:
        assert scan.header.has_inclination
        log = scan.inclination()
    # the reading before the first point is that of the first row
    assert len(log.time_s) == 1 + inside.sum() > 28
    delay_s = log.time_s[1:] - reading_s[inside]
    assert delay_s.min() >= 0
    assert delay_s.max() <= 0.1 + 1 / RATE_HZ
    rows = np.flatnonzero(inside)
    rows = np.concatenate([[rows[0] - 1], rows])
    assert np.degrees(log.roll_rad) == pytest.approx(roll_deg[rows], abs=2e-6)
    assert np.degrees(log.pitch_rad) == pytest.approx(pitch_deg[rows], abs=2e-6)


def test_points_in_any_order_carry_the_same_log(tmp_path):
    order = np.random.default_rng(5).permutation(COUNT)
    logs = []
    for name, options in (("a.laz", {}), ("b.laz", {"order": order})):
        with open_scan(las_file(tmp_path / name, **options), range_max_m=RANGE_MAX_M) as scan:
            logs.append(scan.inclination())
    assert len(logs[0].time_s) == len(logs[1].time_s)
    assert np.abs(logs[0].time_s - logs[1].time_s).max() <= 0.1
    assert np.array_equal(logs[0].roll_rad, logs[1].roll_rad)


def test_a_sensor_that_stops_leaves_a_gap():
    collected = PointInclination()
    time_s = np.arange(0, 100, 0.01)
    roll_rad = np.where(time_s < 50, np.floor(time_s), 50.0) * 1e-5
    for block in np.split(np.arange(10_000), 10):
        collected.add(time_s[block], roll_rad[block], np.zeros(1000))
    assert collected.log().time_s == pytest.approx(np.arange(51.0), abs=0.1)


@pytest.mark.parametrize(
    "names", [("Amplitude2", "Pitch"), ("roll_rate", "pitch_rate"), ("Rolling", "Pitch")]
)
def test_other_fields_are_no_inclination(tmp_path, names):
    with open_scan(las_file(tmp_path / "a.laz", names=names), range_max_m=RANGE_MAX_M) as scan:
        assert scan.inclination() is None
        assert not scan.header.has_inclination


@pytest.mark.parametrize(
    ("name", "description", "expected"),
    [
        ("Roll", "", ("roll", np.pi / 180)),
        ("PITCH", "Pitch in degrees", ("pitch", np.pi / 180)),
        ("roll_deg", "", ("roll", np.pi / 180)),
        ("Pitch[rad]", "", ("pitch", 1.0)),
        ("roll (mrad)", "", ("roll", 1e-3)),
        ("Roll [mdeg]", "", ("roll", np.pi / 180e3)),
        ("roll", "roll of the scanner [rad]", ("roll", 1.0)),
        ("Roll_RMS", "", None),
        ("pitcher", "", None),
        ("payroll", "", None),
    ],
)
def test_names_and_units(name, description, expected):
    actual = tilt_field(name, description)
    assert actual == (expected if expected is None else (expected[0], pytest.approx(expected[1])))
