"""Valid scans: every echo is read as written, in bounded memory."""

import os
import tracemalloc

import laspy
import lazrs
import numpy as np
import pytest
from laspy._compression.lazrsbackend import LazrsPointWriter

from station.errors import NotReadyError, ScanError
from station.readers.las import LasScan
from station.readers.scan import WEEK_S

FORMATS = [
    ("s.las", 1, "1.2"),
    ("s.las", 3, "1.3"),
    ("s.las", 6, "1.4"),
    ("s.laz", 1, "1.2"),
    ("s.laz", 3, "1.4"),
    ("s.laz", 6, "1.4"),
    ("s.laz", 8, "1.4"),
]


def read_all(scan, size=50_000):
    blocks = list(scan.blocks(size))
    assert all(0 < len(block) <= size for block in blocks)
    columns = [[*block.xyz_m] for block in blocks]
    times = None if blocks[0].time_s is None else np.concatenate([block.time_s for block in blocks])
    return np.concatenate(columns, axis=1), times


@pytest.mark.parametrize(("name", "point_format", "version"), FORMATS)
def test_echoes_are_read_as_written(write_scan, name, point_format, version):
    points_m = np.random.default_rng(3).uniform(-500, 500, (3, 60_001)).round(3)
    time_s = 32.0 + np.arange(60_001) / 23_000
    scan = LasScan(write_scan(name, points_m, time_s, point_format=point_format, version=version))
    read_m, read_s = read_all(scan)
    assert np.abs(read_m - points_m).max() < 1e-9
    assert np.array_equal(read_s, time_s)
    assert scan.header.point_count == 60_001
    assert scan.header.low_m == pytest.approx(points_m.min(axis=1))
    assert scan.header.high_m == pytest.approx(points_m.max(axis=1))


@pytest.mark.parametrize("size", [1, 7, 999, 5000])
def test_block_size_does_not_change_the_echoes(write_sweep, size):
    scan = LasScan(write_sweep("s.laz", 999))
    assert np.array_equal(read_all(scan, size)[0], read_all(scan)[0])


def test_blocks_are_contiguous_doubles(write_sweep):
    block = next(LasScan(write_sweep("s.laz", 3000)).blocks(1000))
    for column in (*block.xyz_m, block.time_s):
        assert column.dtype == np.float64
        assert column.flags.c_contiguous


def test_format_without_time(write_scan):
    scan = LasScan(write_scan("s.las", np.random.default_rng(0).normal(size=(3, 50)), point_format=0))
    assert not scan.header.has_time
    assert scan.time_range_s() is None
    assert scan.azimuth_track() is None
    assert read_all(scan)[1] is None


def test_time_stamps_that_are_all_zero_are_ignored(write_scan):
    scan = LasScan(write_scan("s.laz", np.random.default_rng(0).normal(size=(3, 50))), range_max_m=100.0)
    assert scan.header.has_time
    assert scan.time_range_s() is None
    assert scan.azimuth_track() is None
    assert read_all(scan)[1] is None


def test_week_seconds_continue_past_the_end_of_the_week(write_scan):
    points_m = np.random.default_rng(0).normal(size=(3, 1000))
    expected_s = WEEK_S - 30.25 + np.arange(1000) / 10.0
    scan = LasScan(write_scan("s.laz", points_m, expected_s % WEEK_S), range_max_m=100.0)
    assert read_all(scan)[1] == pytest.approx(expected_s)
    assert scan.time_range_s() == pytest.approx((expected_s[0], expected_s[-1]))


def test_chunks_of_variable_length(monkeypatch, tmp_path, write_sweep):
    """As in COPC; laspy does not write them by default."""
    source = laspy.read(write_sweep("s.las", 5000))
    original_init = LazrsPointWriter.__init__

    def variable_chunks(self, dest, point_format, parallel):
        original_init(self, dest, point_format, parallel)
        self.parallel, self.vlr = False, lazrs.LazVlr.new_for_compression(6, 0, True)

    monkeypatch.setattr(LazrsPointWriter, "__init__", variable_chunks)
    path = tmp_path / "v.laz"
    with laspy.open(path, "w", header=source.header, laz_backend=laspy.LazBackend.Lazrs) as writer:
        for first, last in ((0, 100), (100, 3000), (3000, 5000)):
            writer.write_points(source.points[first:last])
            writer.point_writer.compressor.finish_current_chunk()
    scan = LasScan(path, range_max_m=1000.0)
    read_m, read_s = read_all(scan, 700)
    assert np.array_equal(read_m, [source.x, source.y, source.z])
    assert np.array_equal(read_s, source.gps_time)
    assert scan.time_range_s() == (source.gps_time[0], source.gps_time[-1])
    track = scan.azimuth_track()
    assert track.azimuth_rad - 0.1 * track.time_s == pytest.approx(
        np.full(len(track.time_s), -2 * np.pi), abs=4e-4
    )


def test_simultaneous_passes_are_independent(write_sweep):
    scan = LasScan(write_sweep("s.laz", 5000), range_max_m=1000.0)
    expected = read_all(scan, 1000)[0]
    blocks = scan.blocks(1000)
    first_block = next(blocks)
    scan.azimuth_track()
    other_blocks = list(blocks)
    assert np.array_equal(
        np.concatenate([block.xyz_m[0] for block in (first_block, *other_blocks)]), expected[0]
    )


@pytest.mark.integration
def test_memory_does_not_grow_with_the_scan(write_sweep):
    scan = LasScan(write_sweep("s.laz", 1_200_000))
    tracemalloc.start()
    count = sum(len(block) for block in scan.blocks())
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert count == 1_200_000
    assert peak < 20e6  # uncompressed the file has 36 MB


@pytest.mark.parametrize(
    ("name", "count"),
    [
        ("few_chunks.laz", 60_000),
        pytest.param("many_chunks.laz", 1_050_000, marks=pytest.mark.integration),
        ("s.las", 60_000),
    ],
)
def test_azimuth_track(write_sweep, name, count):
    """Azimuth follows from time: the head rotates by 0.1 mrad per millisecond."""
    track = LasScan(write_sweep(name, count), range_max_m=1000.0).azimuth_track()
    assert np.all(np.diff(track.time_s) > 0)
    assert track.time_s[0] < 40.1
    assert track.time_s[-1] > 40.0 + 0.95 * count / 2000
    difference = track.azimuth_rad - 0.1 * track.time_s
    assert difference == pytest.approx(
        np.full(len(difference), round(difference[0] / (2 * np.pi)) * 2 * np.pi), abs=4e-4
    )


def test_no_azimuth_track_in_map_coordinates(write_sweep):
    assert LasScan(write_sweep("s.laz", 1000)).azimuth_track() is None


def test_echo_out_of_range_is_rejected(write_sweep):
    path = write_sweep("s.laz", 1000)
    assert sum(len(block) for block in LasScan(path, range_max_m=892.0).blocks()) == 1000
    with pytest.raises(ScanError, match=r"an echo (8\d\d|900) m away, beyond scanner\.range_max_m = 850"):
        list(LasScan(path, range_max_m=850.0).blocks())


def test_map_coordinates_in_the_scanner_frame_are_rejected(write_scan):
    corner_m = np.array([[635_000.0], [5_180_000.0], [2500.0]])
    points_m = corner_m + np.random.default_rng(0).uniform(0, 500, (3, 50))
    with pytest.raises(ScanError, match=r'scans\.frame = "map"'):
        LasScan(write_scan("s.laz", points_m), range_max_m=6000.0)


def test_file_replaced_while_reading_is_not_ready(write_sweep):
    path = write_sweep("s.laz", 1000)
    scan = LasScan(path)
    os.utime(path, (1, 1))
    with pytest.raises(NotReadyError, match="changed"):
        next(scan.blocks())


def test_missing_file_is_not_ready(write_sweep):
    path = write_sweep("s.laz", 1000)
    scan = LasScan(path)
    path.unlink()
    with pytest.raises(NotReadyError, match="No such file"):
        next(scan.blocks())
    with pytest.raises(NotReadyError):
        LasScan(path)


def test_riegl_export_equals_its_raw_bytes(shared_data):
    """Decoded independently: LAS 1.2, point format 1 with 6 extra bytes."""
    path = shared_data / "las_samples/1.2-empty-geotiff-vlrs.las"
    rows = np.frombuffer(path.read_bytes()[8398:], np.uint8).reshape(43, 34)
    rows = rows[(rows[:, 14] & 7) == (rows[:, 14] >> 3 & 7)]  # last returns
    whole = rows[:, :12].copy().view("<i4").T
    points_m = whole * 0.00025 + np.array([[34.81025], [-28.986], [60.2725]])
    read_m, read_s = read_all(LasScan(path))
    assert read_m == pytest.approx(points_m, abs=1e-12)
    assert np.array_equal(read_s, rows[:, 20:28].copy().view("<f8")[:, 0])
    assert 32 < read_s.min() < read_s.max() < 40


def test_real_terrestrial_scan(shared_data):
    scan = LasScan(shared_data / "tls/vz400i_forest.laz", range_max_m=16.0)
    read_m, read_s = read_all(scan)
    echoes = laspy.read(scan.path)
    last = np.asarray(echoes.return_number) == np.asarray(echoes.number_of_returns)
    assert scan.header.point_count == 1_046_843
    assert 900_000 < np.count_nonzero(last) < 1_000_000
    assert np.array_equal(read_m, np.array([echoes.x, echoes.y, echoes.z])[:, last])
    assert read_s is None


def test_real_airborne_scan(shared_data):
    path = shared_data / "als/coromandel_points.laz"
    scan = LasScan(path)
    read_m, read_s = read_all(scan)
    expected = laspy.read(path)
    ground = np.asarray(expected.return_number) == np.asarray(expected.number_of_returns)
    ground &= ~np.isin(expected.classification, (7, 18))
    assert scan.header.point_count == 584_348
    assert 300_000 < np.count_nonzero(ground) < 400_000
    assert np.array_equal(read_m, np.array([expected.x, expected.y, expected.z])[:, ground])
    assert np.array_equal(read_s, expected.gps_time[ground])
    assert scan.header.standard_time
    assert scan.header.crs_wkt.startswith("COMPOUNDCRS")
    assert "NZGD2000" in scan.header.crs_wkt


@pytest.mark.parametrize("text", [b"laspy", b"odd_owner", b"odd_words", b"odd_unit"])
def test_invalid_characters_in_unused_records_are_ignored(write_scan, tmp_path, text):
    points_m = np.random.default_rng(0).normal(size=(3, 50))
    scan = laspy.read(write_scan("s.las", points_m))
    scan.header.vlrs.append(laspy.VLR(user_id="odd_owner", record_id=5, description="odd_words"))
    scan.add_extra_dim(laspy.ExtraBytesParams("Deviation", "uint16", description="odd_unit"))
    scan.write(tmp_path / "odd.las")
    raw = (tmp_path / "odd.las").read_bytes()
    (tmp_path / "odd.las").write_bytes(raw.replace(text, "ü".encode("latin-1") + text[1:], 1))
    assert read_all(LasScan(tmp_path / "odd.las"))[0] == pytest.approx(points_m, abs=6e-4)
