"""Scan times across the GPS week roll-over, in local time, in the future, and re-sent scans."""

from __future__ import annotations

import shutil
import time
from datetime import UTC, datetime, timedelta

import harness
import laspy
import netCDF4
import numpy as np
import pytest

from station.config import read_site
from station.inbox.journal_reader import State
from station.processing import scan_tasks
from station.processing.scans.scan_files import scan_file
from station.readers.scan import gps_seconds

pytestmark = pytest.mark.integration
WEEK_S = 604_800


def drop_shifted_scan(station, name, first_s):
    """Put scan 0 and its log into the inbox under another name; return the path.

    Their times then begin at `first_s` [s of the GPS week]; None keeps the times of the scanner.
    """
    scan = laspy.read(station.folder / harness.PENDING / f"{harness.scan_name(0)}.laz")
    scan.header.generating_software = name  # the same bytes under two names would be processed once
    scanner_time_s = np.asarray(scan.gps_time)
    folder = station.folder / harness.PENDING
    rows = (folder / f"{harness.scan_name(0)}-incl.txt").read_text().splitlines()
    log = [row.split(",") for row in rows[1:]]
    if first_s is not None:
        shift_s = first_s - scanner_time_s.min()
        scan.gps_time = (scanner_time_s + shift_s) % WEEK_S
        for row in log:
            row[0] = f"{(float(row[0]) + shift_s) % WEEK_S:.3f}"
    scan.write(station.inbox / f"{name}.laz")
    text = "\n".join([rows[0], *(",".join(row) for row in log), ""])
    (station.inbox / f"{name}-incl.txt").write_text(text)
    return station.inbox / f"{name}.laz"


def process_scan(station, path):
    """Return the result of a scan, its elevations [m] and its duration [s]."""
    site = read_site(station.folder / "site.toml")
    result = scan_tasks.process(site, scan_file(site, path), lambda: None)
    with netCDF4.Dataset(station.data / result.epoch) as file:
        elevation_m = np.ma.filled(file["elevation_outside_reference"][0], np.nan)
        return result, elevation_m, np.diff(file["time_bnds"][0]).item()


@pytest.mark.parametrize("after_rollover_s", [-12.0, 1.0, 3.0])
def test_scan_across_the_gps_week_rollover(make_station, after_rollover_s):
    """Scans that begin before and just after the roll-over equal the scan in times of the scanner."""
    station = make_station()
    rollover = datetime(2025, 7, 19, 23, 59, 42, tzinfo=UTC)  # GPS time is 18 leap seconds ahead
    start = rollover + timedelta(seconds=after_rollover_s)
    assert (gps_seconds(start) - after_rollover_s) % WEEK_S == 0
    name = f"{start:%y%m%d_%H%M%S}"
    station.drop(0)  # the scan of the SOP
    path = drop_shifted_scan(station, name, None)
    expected, elevation_m, duration_s = process_scan(station, path)
    assert expected.reason.startswith("weather missing")
    shutil.rmtree(station.data)
    path = drop_shifted_scan(station, name, after_rollover_s % WEEK_S)
    result, actual_m, actual_s = process_scan(station, path)
    assert (result.verdict, result.reason) == (expected.verdict, expected.reason)
    assert result.start_utc_s == start.timestamp()
    assert actual_s == pytest.approx(duration_s, abs=1e-3)
    np.testing.assert_allclose(actual_m, elevation_m, atol=2e-3)  # the store rounds to 1 mm


def test_file_name_in_local_time_is_rejected_with_a_hint(make_station):
    """The GPS time is 12:00 UTC, the name has 14:00, local summer time."""
    station = make_station()
    noon = datetime(2025, 7, 15, 12, tzinfo=UTC)
    path = drop_shifted_scan(station, "250715_140000", None)
    scan = laspy.read(path)
    scan.gps_time = np.asarray(scan.gps_time) - np.min(scan.gps_time) + gps_seconds(noon) - 1e9
    scan.write(path)
    station.start()
    station.wait_until(lambda: station.state(path.name) is State.SET_ASIDE)
    station.end()
    assert "local time (UTC+2 h)" in (station.data / "set_aside" / f"{path.name}.txt").read_text()


def test_scan_from_the_future_is_deferred_until_its_time(make_station):
    station = make_station()
    station.clock = station.folder / "clock"
    station.clock.write_text("0")
    ahead = datetime.now(UTC) + timedelta(hours=30)
    path = drop_shifted_scan(station, f"{ahead:%y%m%d_%H%M%S}", None)
    station.drop(0)
    station.start()
    station.wait_until(lambda: station.state(f"{harness.scan_name(0)}.laz") is State.STORED)
    station.wait_until(lambda: station.state(path.name) is State.LATER)
    assert "ahead of this computer's clock" in station.rows()[path.name].waiting_reason
    with netCDF4.Dataset(station.data / "series.nc") as file:
        assert file["time"][-1] < time.time()
    station.clock.write_text(str(30 * 3600))
    station.wait_until(lambda: station.state(path.name) is State.STORED)
    station.end()


@pytest.mark.slow
def test_resent_scan_becomes_a_new_revision(make_station, undisturbed):
    """The series has the re-sent scan once; the first bytes, sent again, become a third revision."""
    station = make_station()
    station.drop(0, 1)
    station.start()
    station.wait_until(lambda: station.is_done(0, 1) and (station.data / "reference.nc").exists())
    station.drop(2)
    station.wait_until(lambda: station.is_done(0, 1, 2))
    name = f"{harness.scan_name(2)}.laz"
    sound = (station.inbox / name).read_bytes()
    first = station.rows()[name]
    scan = laspy.read(station.inbox / name)
    scan.points = scan.points[scan.gps_time < np.median(scan.gps_time)]
    scan.write(station.inbox / f".{name}")
    (station.inbox / f".{name}").replace(station.inbox / name)
    station.wait_until(lambda: station.is_done() and station.rows()[name].sha256 != first.sha256)
    assert station.rows()[name].revision == first.revision + 1
    with netCDF4.Dataset(station.data / "processing.nc") as file:
        assert [str(scan) for scan in file["scan_id"][:]] == [harness.scan_name(hour) for hour in range(3)]
        assert file["point_total"][2] == len(scan.points)
    (station.inbox / f".{name}").write_bytes(sound)
    (station.inbox / f".{name}").replace(station.inbox / name)
    station.wait_until(lambda: station.is_done() and station.rows()[name].sha256 == first.sha256)
    station.end()
    point_totals = []
    for data in (station.data, undisturbed().data):
        with netCDF4.Dataset(data / "processing.nc") as file:
            point_totals.append(float(file["point_total"][2]))
    assert point_totals[0] == point_totals[1]
    with (
        netCDF4.Dataset(station.data / "series.nc") as file,
        netCDF4.Dataset(undisturbed().data / "series.nc") as expected,
    ):
        np.testing.assert_array_equal(file["elevation_change"][2], expected["elevation_change"][2])
