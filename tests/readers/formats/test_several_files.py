"""Files of one scan are read as one."""

import numpy as np
import pytest

from station.quantities import AzimuthTrack, Shots
from station.readers.formats.several_files import SeveralFiles, as_one
from station.readers.scan import ScanHeader


class Tile:
    """An open file with times and azimuths, and two blocks of shots."""

    def __init__(self, path, time_s, azimuth_rad, *, low_m=(0.0, 0.0, 0.0)):
        self.path, self.time_s, self.azimuth_rad = path, np.asarray(time_s), np.asarray(azimuth_rad)
        high_m = (low_m[0] + 1, low_m[1] + 1, low_m[2] + 1)
        has_time = len(self.time_s) > 0
        self.header = ScanHeader(10, low_m, high_m, has_time, False, None)

    def blocks(self, *_, **__):
        for number in range(2):
            yield Shots(np.full((3, 5), float(number)), None)

    def time_range_s(self):
        return (self.time_s.min(), self.time_s.max()) if len(self.time_s) else None

    def azimuth_track(self):
        return AzimuthTrack(self.time_s, self.azimuth_rad) if len(self.time_s) else None


def halves(*, turns=1.0):
    time_s = np.arange(0.0, 100.0)
    azimuth_rad = turns * 2 * np.pi * time_s / 100
    return Tile("a", time_s[:50], azimuth_rad[:50]), Tile("b", time_s[50:], azimuth_rad[50:] - 2 * np.pi)


def test_counts_boxes_and_blocks_are_those_of_all_files():
    one, other = halves()
    other.header = ScanHeader(7, (-5.0, 0.0, 0.0), (0.0, 9.0, 0.0), True, False, None)
    scan = SeveralFiles([one, other])
    assert (scan.header.point_count, scan.header.low_m, scan.header.high_m) == (
        17, (-5.0, 0.0, 0.0), (1.0, 9.0, 1.0),
    )  # fmt: skip
    assert sum(map(len, scan.blocks())) == 20
    assert scan.time_range_s() == (0.0, 99.0)
    assert as_one([one]) is one


def test_the_azimuth_continues_from_file_to_file_in_any_order():
    one, other = halves()
    track = SeveralFiles([other, one]).azimuth_track()
    np.testing.assert_array_equal(track.time_s, np.arange(0.0, 100.0))
    assert np.diff(track.azimuth_rad) == pytest.approx(2 * np.pi / 100)


def test_files_without_times_or_of_several_turns_have_no_track():
    one, other = halves(turns=1.5)
    assert SeveralFiles([one, other]).azimuth_track() is None
    scan = SeveralFiles([one, Tile("b", [], [])])
    assert (scan.azimuth_track(), scan.time_range_s()) == (None, None)
    assert not scan.header.has_time
