"""Sound scans: every echo, as it stands in the file, in bounded memory."""

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

FORMS = [
    ("s.las", 1, "1.2"),
    ("s.las", 3, "1.3"),
    ("s.las", 6, "1.4"),
    ("s.laz", 1, "1.2"),
    ("s.laz", 3, "1.4"),
    ("s.laz", 6, "1.4"),
    ("s.laz", 8, "1.4"),
]


def everything(scan, size=50_000):
    blocks = list(scan.blocks(size))
    assert all(len(block) == size for block in blocks[:-1])
    columns = [[*block.xyz_m] for block in blocks]
    times = None if blocks[0].time_s is None else np.concatenate([block.time_s for block in blocks])
    return np.concatenate(columns, axis=1), times


@pytest.mark.parametrize(("name", "point_format", "version"), FORMS)
def test_every_echo_comes_as_it_was_written(write_scan, name, point_format, version):
    points_m = np.random.default_rng(3).uniform(-500, 500, (3, 60_001)).round(3)
    time_s = 32.0 + np.arange(60_001) / 23_000
    scan = LasScan(write_scan(name, points_m, time_s, point_format=point_format, version=version))
    read_m, read_s = everything(scan)
    assert read_m == pytest.approx(points_m, abs=1e-9)
    assert np.array_equal(read_s, time_s)
    assert scan.header.point_count == 60_001
    assert scan.header.low_m == pytest.approx(points_m.min(axis=1))
    assert scan.header.high_m == pytest.approx(points_m.max(axis=1))


@pytest.mark.parametrize("size", [1, 7, 999, 5000])
def test_blocks_of_any_size_hold_the_same(a_sweep, size):
    scan = LasScan(a_sweep("s.laz", 999))
    assert np.array_equal(everything(scan, size)[0], everything(scan)[0])


def test_blocks_are_contiguous_doubles(a_sweep):
    block = next(LasScan(a_sweep("s.laz", 3000)).blocks(1000))
    for column in (*block.xyz_m, block.time_s):
        assert column.dtype == np.float64
        assert column.flags.c_contiguous


def test_a_format_without_time_has_none(write_scan):
    scan = LasScan(write_scan("s.las", np.random.default_rng(0).normal(size=(3, 50)), point_format=0))
    assert not scan.header.has_time
    assert scan.time_range_s() is None
    assert scan.head_track() is None
    assert everything(scan)[1] is None


def test_a_time_field_left_zero_is_no_time(write_scan):
    scan = LasScan(write_scan("s.laz", np.random.default_rng(0).normal(size=(3, 50))), range_max_m=100.0)
    assert scan.header.has_time
    assert scan.time_range_s() is None
    assert scan.head_track() is None
    assert everything(scan)[1] is None


def test_week_seconds_run_on_past_the_end_of_the_week(write_scan):
    points_m = np.random.default_rng(0).normal(size=(3, 1000))
    true_s = WEEK_S - 30.25 + np.arange(1000) / 10.0
    scan = LasScan(write_scan("s.laz", points_m, true_s % WEEK_S), range_max_m=100.0)
    assert everything(scan)[1] == pytest.approx(true_s)
    assert scan.time_range_s() == pytest.approx((true_s[0], true_s[-1]))


def test_chunks_of_any_length_are_read(monkeypatch, tmp_path, a_sweep):
    """As COPC has them; laspy writes none by itself."""
    source = laspy.read(a_sweep("s.las", 5000))
    plain = LazrsPointWriter.__init__

    def variable(self, dest, point_format, parallel):
        plain(self, dest, point_format, parallel)
        self.parallel, self.vlr = False, lazrs.LazVlr.new_for_compression(6, 0, True)

    monkeypatch.setattr(LazrsPointWriter, "__init__", variable)
    path = tmp_path / "v.laz"
    with laspy.open(path, "w", header=source.header, laz_backend=laspy.LazBackend.Lazrs) as writer:
        for first, last in ((0, 100), (100, 3000), (3000, 5000)):
            writer.write_points(source.points[first:last])
            writer.point_writer.compressor.finish_current_chunk()
    scan = LasScan(path, range_max_m=1000.0)
    read_m, read_s = everything(scan, 700)
    assert np.array_equal(read_m, [source.x, source.y, source.z])
    assert np.array_equal(read_s, source.gps_time)
    assert scan.time_range_s() == (source.gps_time[0], source.gps_time[-1])
    track = scan.head_track()
    assert track.azimuth_rad - 0.1 * track.time_s == pytest.approx(
        np.full(len(track.time_s), -2 * np.pi), abs=4e-4
    )


def test_passes_may_overlap(a_sweep):
    scan = LasScan(a_sweep("s.laz", 5000), range_max_m=1000.0)
    alone = everything(scan, 1000)[0]
    blocks = scan.blocks(1000)
    first = next(blocks)
    scan.head_track()
    rest = list(blocks)
    assert np.array_equal(np.concatenate([first.xyz_m[0], *(block.xyz_m[0] for block in rest)]), alone[0])


def test_memory_does_not_grow_with_the_scan(a_sweep):
    scan = LasScan(a_sweep("s.laz", 1_200_000))
    tracemalloc.start()
    count = sum(len(block) for block in scan.blocks())
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert count == 1_200_000
    assert peak < 20e6  # unpacked the file is 36 MB


@pytest.mark.parametrize(
    ("name", "count"),
    [("few_chunks.laz", 60_000), ("many_chunks.laz", 1_050_000), ("s.las", 60_000)],
)
def test_the_head_is_followed(a_sweep, name, count):
    """Azimuth and time fit each other: in a millisecond the head turns 0.1 mrad."""
    track = LasScan(a_sweep(name, count), range_max_m=1000.0).head_track()
    assert np.all(np.diff(track.time_s) > 0)
    assert track.time_s[0] < 40.1
    assert track.time_s[-1] > 40.0 + 0.95 * count / 2000
    apart = track.azimuth_rad - 0.1 * track.time_s
    assert apart == pytest.approx(np.full(len(apart), round(apart[0] / (2 * np.pi)) * 2 * np.pi), abs=4e-4)


def test_no_head_is_followed_on_a_map(a_sweep):
    assert LasScan(a_sweep("s.laz", 1000)).head_track() is None


def test_an_echo_out_of_range_is_refused(a_sweep):
    path = a_sweep("s.laz", 1000)
    assert sum(len(block) for block in LasScan(path, range_max_m=900.1).blocks()) == 1000
    with pytest.raises(ScanError, match=r"an echo (8\d\d|900) m away, beyond scanner\.range_max_m = 850"):
        list(LasScan(path, range_max_m=850.0).blocks())


def test_map_coordinates_are_not_taken_for_the_scanners(write_scan):
    corner_m = np.array([[635_000.0], [5_180_000.0], [2500.0]])
    points_m = corner_m + np.random.default_rng(0).uniform(0, 500, (3, 50))
    with pytest.raises(ScanError, match=r'scans\.frame = "map"'):
        LasScan(write_scan("s.laz", points_m), range_max_m=6000.0)


def test_a_file_replaced_while_it_is_read_waits(a_sweep):
    path = a_sweep("s.laz", 1000)
    scan = LasScan(path)
    os.utime(path, (1, 1))
    with pytest.raises(NotReadyError, match="changed"):
        next(scan.blocks())


def test_a_lost_file_waits(a_sweep):
    path = a_sweep("s.laz", 1000)
    scan = LasScan(path)
    path.unlink()
    with pytest.raises(NotReadyError, match="No such file"):
        next(scan.blocks())
    with pytest.raises(NotReadyError):
        LasScan(path)


def test_a_riegl_export_is_read_as_its_bytes_say(shared_data):
    """Decoded here by the offsets of LAS 1.2, point format 1 with 6 extra bytes."""
    path = shared_data / "las_samples/1.2-empty-geotiff-vlrs.las"
    rows = np.frombuffer(path.read_bytes()[8398:], np.uint8).reshape(43, 34)
    whole = rows[:, :12].copy().view("<i4").T
    points_m = whole * 0.00025 + np.array([[34.81025], [-28.986], [60.2725]])
    read_m, read_s = everything(LasScan(path))
    assert read_m == pytest.approx(points_m, abs=1e-12)
    assert np.array_equal(read_s, rows[:, 20:28].copy().view("<f8")[:, 0])
    assert 32 < read_s.min() < read_s.max() < 40


def test_a_real_scan_is_read_to_its_last_echo(shared_data):
    scan = LasScan(shared_data / "tls/vz400i_forest.laz", range_max_m=16.0)
    read_m, read_s = everything(scan)
    assert read_m.shape == (3, 1_046_843)
    assert read_s is None
    assert read_m.min(axis=1) == pytest.approx((-7.588, -8.358, -1.819))  # the box in its header
    assert read_m.max(axis=1) == pytest.approx((10.097, 12.563, 13.478))


def test_a_real_flight_is_read_to_its_last_echo(shared_data):
    path = shared_data / "als/coromandel_points.laz"
    scan = LasScan(path)
    read_m, read_s = everything(scan)
    whole = laspy.read(path)
    assert read_m.shape == (3, 584_348)
    assert np.array_equal(read_m, [whole.x, whole.y, whole.z])
    assert np.array_equal(read_s, whole.gps_time)
    assert scan.header.standard_time
    assert scan.header.crs_wkt.startswith("COMPOUNDCRS")
    assert "NZGD2000" in scan.header.crs_wkt


@pytest.mark.parametrize("word", [b"laspy", b"odd_owner", b"odd_words", b"odd_unit"])
def test_odd_letters_in_what_nobody_needs_are_no_fault(write_scan, tmp_path, word):
    points_m = np.random.default_rng(0).normal(size=(3, 50))
    scan = laspy.read(write_scan("s.las", points_m))
    scan.header.vlrs.append(laspy.VLR(user_id="odd_owner", record_id=5, description="odd_words"))
    scan.add_extra_dim(laspy.ExtraBytesParams("Deviation", "uint16", description="odd_unit"))
    scan.write(tmp_path / "odd.las")
    raw = (tmp_path / "odd.las").read_bytes()
    (tmp_path / "odd.las").write_bytes(raw.replace(word, "ü".encode("latin-1") + word[1:], 1))
    assert everything(LasScan(tmp_path / "odd.las"))[0] == pytest.approx(points_m, abs=6e-4)
