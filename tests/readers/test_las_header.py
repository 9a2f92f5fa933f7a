"""Corrupt and hostile scans: rejected with a reason, quickly, in little memory."""

import random
import shutil
import struct
import tracemalloc

import laspy
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from station.errors import InconclusiveError, NotReadyError, ScanError
from station.readers import las
from station.readers.las import LasScan

# byte offsets in the header: LAS 1.4 R15, table 3
VERSION_MINOR, HEADER_BYTES, POINTS_OFFSET, VLR_COUNT, POINT_FORMAT, RECORD_BYTES, LEGACY_COUNT, RETURN_1 = (
    25, 94, 96, 100, 104, 105, 107, 111)  # fmt: skip
SCALE_X, OFFSET_X, MAX_X, MIN_X, EVLR_OFFSET, EVLR_COUNT, COUNT = 131, 155, 179, 187, 235, 243, 247


def count_points(path, range_max_m=None):
    return sum(len(block) for block in LasScan(path, range_max_m=range_max_m).blocks())


def patched(path, offset, code, value):
    raw = bytearray(path.read_bytes())
    struct.pack_into(code, raw, offset, value)
    path.write_bytes(raw)
    return path


HOSTILE = {
    "1.2-no-points.las": r"header counts 1,065 points, the file holds 0",
    "bad_vlr_count.las": r"variable length record 3 of 3 runs into the points",
    "garbage_nVariableLength.las": r"no room for 1,069,128,089 variable length records",
    "gps-time-nan.las": r"time stamp is not a number",
    "no-points.las": r"holds no points",
    "simple-laszip-compressor-version-1.2r0.laz": r"LASzip 1\.2 .* rewrite it",
    "spurious.las": r"x = -124\.069 .* leaves the header's -123\.075 to -123\.063",
}
VALID = {  # last or only returns, without noise, counted with laspy
    "1.2-empty-geotiff-vlrs.las": 42,
    "autzen-bmx-2010.las": 829,
    "autzen-bmx-2023.las": 687,
    "bad-geotiff-keys.las": 10,
    "extrabytes.las": 901,
    "lots_of_vlr.las": 1,
    "simple.laz": 901,
    "warsaw_small.las": 2177,
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_files_are_rejected_in_little_memory(shared_data, name):
    tracemalloc.start()
    with pytest.raises(ScanError, match=HOSTILE[name]):
        count_points(shared_data / "las_samples" / name)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 5e6


@pytest.mark.parametrize("name", VALID)
def test_unusual_files_are_read(shared_data, name):
    assert count_points(shared_data / "las_samples" / name) == VALID[name]


def test_every_sample_file_is_tested(shared_data):
    assert {path.name for path in (shared_data / "las_samples").iterdir()} == {*HOSTILE, *VALID}


@pytest.mark.parametrize(
    ("name", "point_format", "version"),
    [("s.las", 1, "1.2"), ("s.las", 6, "1.4"), ("s.laz", 1, "1.2"), ("s.laz", 6, "1.4")],
)
def test_truncated_scan_is_rejected(write_sweep, name, point_format, version):
    path = write_sweep(name, 3000, point_format=point_format, version=version)
    complete = path.read_bytes()
    record = struct.unpack_from("<H", complete, RECORD_BYTES)[0]
    cuts = {0, 3, 100, 226, 300, 400, len(complete) - 1, len(complete) - record, len(complete) - 100 * record}
    cuts |= {int(fraction * len(complete)) for fraction in np.linspace(0.02, 0.98, 25)}
    for cut in sorted(cuts):
        path.write_bytes(complete[:cut])
        with pytest.raises(ScanError, match=r"cut off|empty|begin with LASF|chunk table|corrupt"):
            count_points(path)


@pytest.mark.parametrize("name", ["s.las", "s.laz"])
def test_scan_still_being_written_is_rejected(tmp_path, write_sweep, name):
    source = laspy.read(write_sweep("source.las", 120_000))
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales = source.header.scales
    with (tmp_path / name).open("wb+") as file:
        writer = laspy.LasWriter(file, header, do_compress=name.endswith("z"), closefd=False)
        writer.write_points(source.points)
        file.flush()
        shutil.copy(tmp_path / name, tmp_path / f"copy_{name}")
        writer.close()
    with pytest.raises(ScanError, match="being written"):
        count_points(tmp_path / f"copy_{name}")
    assert count_points(tmp_path / name) == 120_000


@pytest.mark.parametrize("by_return", [1, 0.5, 0])
@pytest.mark.parametrize("count", [1000, 130_000])
@pytest.mark.parametrize(("name", "point_format"), [("s.las", 6), ("s.laz", 6), ("s.las", 3)])
def test_wrong_point_count_is_rejected(write_sweep, name, point_format, count, by_return):
    path = write_sweep(name, count, point_format=point_format)
    patched(path, COUNT, "<Q", count // 2)
    patched(path, COUNT + 8, "<Q", int(count * by_return))
    if point_format < 6:
        patched(path, LEGACY_COUNT, "<I", count // 2)
    with pytest.raises(ScanError, match=r"header counts|contradicts|chunk"):
        count_points(path)


@pytest.mark.parametrize(
    ("offset", "code", "value", "reason"),
    [
        (VERSION_MINOR, "<B", 9, "version 1.9"),
        (HEADER_BYTES, "<H", 3, "corrupt header"),
        (HEADER_BYTES, "<H", 60_000, "corrupt header"),
        (POINTS_OFFSET, "<I", 2**32 - 1, "cut off"),
        (POINTS_OFFSET, "<I", 0, "corrupt header"),
        (VLR_COUNT, "<I", 2**32 - 1, "no room for 4,294,967,295"),
        (VLR_COUNT, "<I", 0, "LASzip VLR"),
        (POINT_FORMAT, "<B", 0x80 + 11, "point format 11"),
        (RECORD_BYTES, "<H", 29, "29 bytes a point"),
        (RECORD_BYTES, "<H", 65_535, "65535 bytes a point"),
        (RECORD_BYTES, "<H", 38, "do not add up to a point"),
        (LEGACY_COUNT, "<I", 7, "legacy"),
        (COUNT, "<Q", 0, "holds no points"),
        (COUNT, "<Q", 2**63, "is not what 1 chunks hold"),
        (SCALE_X, "<d", float("nan"), "not a finite number"),
        (SCALE_X, "<d", 0.0, "scale"),
        (SCALE_X, "<d", 1e300, "scale"),
        (OFFSET_X, "<d", float("inf"), "not a finite number"),
        (OFFSET_X, "<d", 1e300, "beyond any map"),
        (MAX_X, "<d", -1e6, "ends before it begins"),
        (MAX_X, "<d", -200.0, "leaves the header's"),
        (EVLR_COUNT, "<I", 1, "corrupt header"),
    ],
)
def test_invalid_header_values_are_rejected(write_sweep, offset, code, value, reason):
    path = patched(write_sweep("s.laz", 2000), offset, code, value)
    with pytest.raises(ScanError, match=reason):
        count_points(path)


def test_layer_of_gigabytes_is_rejected(write_sweep):
    path = write_sweep("s.laz", 2000)
    points_offset = struct.unpack_from("<I", path.read_bytes(), POINTS_OFFSET)[0]
    tracemalloc.start()
    with pytest.raises(ScanError, match="corrupt in chunk 1 of 1"):
        count_points(patched(path, points_offset + 8 + 30 + 4, "<I", 2**32 - 1))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 5e6


def test_chunk_table_of_billions_is_rejected(write_sweep):
    path = write_sweep("s.laz", 2000)
    raw = path.read_bytes()
    table_offset = struct.unpack_from("<q", raw, struct.unpack_from("<I", raw, POINTS_OFFSET)[0])[0]
    with pytest.raises(ScanError, match="4,294,967,295 chunks"):
        count_points(patched(path, table_offset + 4, "<I", 2**32 - 1))


def test_chunks_of_gigabytes_are_rejected(write_sweep):
    path = write_sweep("s.laz", 2000)
    with pytest.raises(ScanError, match="chunks of 4,294,967,120 points"):
        count_points(patched(path, 375 + 54 + 12, "<I", 2**32 - 176))


def test_time_stamps_more_than_a_day_apart_are_rejected(write_scan):
    points_m, time_s = np.random.default_rng(0).normal(size=(3, 100)), np.arange(100.0)
    time_s[37] = 1e7
    path = write_scan("s.laz", points_m, time_s)
    assert count_points(path) == 100  # flights may be merged
    with pytest.raises(ScanError, match="more than a day apart"):
        count_points(path, range_max_m=100.0)


@pytest.mark.integration
@settings(max_examples=250, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32), name=st.sampled_from(["s.las", "s.laz", "old.laz"]), head=st.booleans())
def test_flipped_bits_are_rejected_or_harmless(tmp_path, seed, name, head, valid_files):
    """Either rejected with a reason, or finite echoes within the header's box, at most the counted number.

    A flipped bit may mark a point as noise, as withheld, or as an earlier return, which is not used.
    """
    raw = bytearray(valid_files[name])
    rng = random.Random(seed)  # noqa: S311 - no secret
    for _ in range(rng.choice([1, 1, 1, 8])):
        raw[rng.randrange(520 if head else len(raw))] ^= 1 << rng.randrange(8)
    path = tmp_path / f"flipped_{name}"
    path.write_bytes(raw)
    try:
        scan = LasScan(path, range_max_m=1000.0)
        blocks = list(scan.blocks(500))
        scan.azimuth_track()
    except ScanError:
        return
    assert 0 < sum(len(block) for block in blocks) <= scan.header.point_count
    for block in filter(len, blocks):
        assert block.time_s is None or np.isfinite(block.time_s).all()
        for axis, values in enumerate(block.xyz_m):
            assert values.min() >= scan.header.low_m[axis] - 1
            assert values.max() <= scan.header.high_m[axis] + 1


@pytest.fixture
def valid_files(write_sweep):
    """Bytes of valid files by name."""
    paths = {
        "s.las": write_sweep("a.las", 1500),
        "s.laz": write_sweep("a.laz", 1500),
        "old.laz": write_sweep("b.laz", 1500, point_format=3, version="1.2"),
    }
    return {name: path.read_bytes() for name, path in paths.items()}


class PanicException(BaseException):
    pass


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (PanicException("index out of bounds"), ScanError),
        (
            PanicException(
                'ThreadPoolBuildError { kind: IOError(Os { code: 11, kind: WouldBlock, message: "" }) }'
            ),
            InconclusiveError,
        ),
        (PanicException("called `Result::unwrap()`: Os { code: 22, kind: InvalidInput }"), ScanError),
        (RuntimeError("can't start new thread"), InconclusiveError),
        (MemoryError(), InconclusiveError),
        (ValueError("not implemented"), ScanError),
        (OSError(22, "Invalid argument"), ScanError),
        (OSError(5, "Input/output error"), NotReadyError),
        (OSError(11, "Resource temporarily unavailable"), NotReadyError),
        (KeyboardInterrupt(), KeyboardInterrupt),
    ],
)
def test_errors_of_the_decoder_are_translated(monkeypatch, write_sweep, error, expected):
    scan = LasScan(write_sweep("s.laz", 1000))

    def fail(*_):
        raise error

    monkeypatch.setattr(las.lazrs, "LasZipDecompressor", fail)
    with pytest.raises(expected):
        next(scan.blocks())
