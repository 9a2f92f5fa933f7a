"""LAS and LAZ scans for the tests of the readers, written with laspy."""

import laspy
import numpy as np
import pytest

TURN_RAD_S = 0.1  # of the head, counter-clockwise
RANGE_M = 900.0


def sweep(count, seed=0, first_s=40.0, rate_hz=2000.0):
    """Echoes x, y, z (3, n) [m] of a rotating head and their times (n,) [s]; azimuth = 0.1 rad/s · time."""
    random = np.random.default_rng(seed)
    time_s = first_s + np.arange(count) / rate_hz
    azimuth_rad = TURN_RAD_S * time_s
    polar_rad = np.radians(60 + 60 * ((np.arange(count) % 333) / 333))
    range_m = random.uniform(200.0, RANGE_M, count)
    horizontal_m = range_m * np.sin(polar_rad)
    points_m = np.stack(
        [horizontal_m * np.cos(azimuth_rad), horizontal_m * np.sin(azimuth_rad), range_m * np.cos(polar_rad)]
    )
    return points_m, time_s


@pytest.fixture
def write_scan(tmp_path):
    """Return a function that writes a scan and returns its path."""

    def write(name, points_m, time_s=None, *, point_format=6, version="1.4", scale=0.001, standard=False):
        header = laspy.LasHeader(point_format=point_format, version=version)
        header.scales, header.offsets = [scale] * 3, np.round(points_m.mean(axis=1))
        header.global_encoding.gps_time_type = laspy.header.GpsTimeType(int(standard))
        scan = laspy.LasData(header)
        scan.x, scan.y, scan.z = points_m
        scan.intensity = np.arange(points_m.shape[1]) % 60_000
        scan.return_number[:] = 1
        scan.number_of_returns[:] = 1
        if time_s is not None:
            scan.gps_time = time_s
        scan.write(tmp_path / name)
        return tmp_path / name

    return write


@pytest.fixture
def write_sweep(write_scan):
    """Return a function that writes `count` echoes of a rotating head and returns the path."""

    def write(name, count, **options):
        points_m, time_s = sweep(count)
        return write_scan(name, points_m, time_s, **options)

    return write
