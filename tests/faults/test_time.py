"""Times that are late, early, of another week, another zone, or of the future take their place or none."""

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
from station.readers.scan import gps_seconds
from station.service import tasks
from station.service.journal import State
from station.service.once import arrival_of

WEEK_S = 604_800


def timed(station, name, first_s):
    """Put scan 0 and its log into the inbox under another name, their seconds counted from `first_s`.

    These are seconds of the GPS week then; None: the scanner's, as they are.
    """
    scan = laspy.read(station.folder / harness.LATER / f"{harness.stem(0)}.laz")
    scan.header.generating_software = name  # the same bytes under two names would be done once
    own_s = np.asarray(scan.gps_time)
    rows = (station.folder / harness.LATER / f"{harness.stem(0)}-incl.txt").read_text().splitlines()
    log = [row.split(",") for row in rows[1:]]
    if first_s is not None:
        shift_s = first_s - own_s.min()
        scan.gps_time = (own_s + shift_s) % WEEK_S
        for row in log:
            row[0] = f"{(float(row[0]) + shift_s) % WEEK_S:.3f}"
    scan.write(station.inbox / f"{name}.laz")
    told = "\n".join([rows[0], *(",".join(row) for row in log), ""])
    (station.inbox / f"{name}-incl.txt").write_text(told)
    return station.inbox / f"{name}.laz"


def measured(station, path):
    """Return what a scan comes to: its outcome and its elevations."""
    site = read_site(station.folder / "site.toml")
    outcome = tasks.process(site, arrival_of(site, path), lambda: None)
    with netCDF4.Dataset(station.data / outcome.epoch) as file:
        return outcome, np.ma.filled(file["elevation"][0], np.nan), np.diff(file["time_bnds"][0]).item()


@pytest.mark.parametrize("into_s", [-12.0, 1.0, 3.0])
def test_a_scan_across_the_end_of_the_gps_week(make, into_s):
    """Before and just after the roll-over, with a log that begins before: as with the scanner's seconds."""
    station = make()
    start = datetime(2025, 7, 19, 23, 59, 42, tzinfo=UTC) + timedelta(seconds=into_s)  # 18 leap seconds
    assert (gps_seconds(start) - into_s) % WEEK_S == 0
    name = f"{start:%y%m%d_%H%M%S}"
    station.drop(0)  # the scan of the SOP
    wanted, elevation_m, lasts_s = measured(station, timed(station, name, None))
    assert wanted.reason.startswith("weather missing")
    shutil.rmtree(station.data)
    outcome, again_m, again_s = measured(station, timed(station, name, into_s % WEEK_S))
    assert (outcome.verdict, outcome.reason) == (wanted.verdict, wanted.reason)
    assert outcome.start_utc_s == start.timestamp()
    assert again_s == pytest.approx(lasts_s, abs=1e-3)
    np.testing.assert_allclose(again_m, elevation_m, atol=2e-3)  # of which 1 mm is the store's


def test_a_name_in_local_time_is_set_aside_with_a_hint(make):
    """GPS time says 12:00 UTC, the name 14:00, as a clock in summer time does."""
    station = make()
    noon = datetime(2025, 7, 15, 12, tzinfo=UTC)
    path = timed(station, "250715_140000", None)
    scan = laspy.read(path)
    scan.gps_time = np.asarray(scan.gps_time) - np.min(scan.gps_time) + gps_seconds(noon) - 1e9
    scan.write(path)
    station.start()
    station.await_(lambda: station.state(path.name) is State.SET_ASIDE)
    station.end()
    assert "local time (UTC+2 h)" in (station.data / "set_aside" / f"{path.name}.txt").read_text()


def test_a_scan_from_the_future_is_held_back_until_its_time(make):
    station = make()
    station.clock = station.folder / "clock"
    station.clock.write_text("0")
    ahead = datetime.now(UTC) + timedelta(hours=30)
    path = timed(station, f"{ahead:%y%m%d_%H%M%S}", None)
    station.drop(0)
    station.start()
    station.await_(lambda: station.state(f"{harness.stem(0)}.laz") is State.STORED)
    station.await_(lambda: station.state(path.name) is State.LATER)
    assert "ahead of this computer's clock" in station.rows()[path.name].waits_for
    with netCDF4.Dataset(station.data / "series.nc") as file:
        assert file["time"][-1] < time.time()
    station.clock.write_text(str(30 * 3600))
    station.await_(lambda: station.state(path.name) is State.STORED)
    station.end()


@pytest.mark.slow
def test_other_bytes_under_the_same_name_take_the_place_of_the_first(make, quiet):
    """A re-sent scan makes a new revision, the series shows it once; the first bytes again make a third."""
    station = make()
    station.drop(0, 1)
    station.start()
    station.await_(lambda: station.is_done(0, 1) and (station.data / "reference.nc").exists())
    station.drop(2)
    station.await_(lambda: station.is_done(0, 1, 2))
    name = f"{harness.stem(2)}.laz"
    sound = (station.inbox / name).read_bytes()
    first = station.rows()[name]
    scan = laspy.read(station.inbox / name)
    scan.points = scan.points[scan.gps_time < np.median(scan.gps_time)]
    scan.write(station.inbox / f".{name}")
    (station.inbox / f".{name}").replace(station.inbox / name)
    station.await_(lambda: station.is_done() and station.rows()[name].sha256 != first.sha256)
    assert station.rows()[name].revision == first.revision + 1
    with netCDF4.Dataset(station.data / "series.nc") as file:
        assert [str(scan) for scan in file["scan_id"][:]] == [harness.stem(hour) for hour in range(3)]
        assert file["point_total"][2] == len(scan.points)
    (station.inbox / f".{name}").write_bytes(sound)
    (station.inbox / f".{name}").replace(station.inbox / name)
    station.await_(lambda: station.is_done() and station.rows()[name].sha256 == first.sha256)
    station.end()
    with (
        netCDF4.Dataset(station.data / "series.nc") as file,
        netCDF4.Dataset(quiet().data / "series.nc") as q,
    ):
        assert file["point_total"][2] == q["point_total"][2]
        np.testing.assert_array_equal(file["elevation"][2], q["elevation"][2])
