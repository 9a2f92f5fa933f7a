"""A day in at most 10 kB: what arrived, what became of it, how areas changed."""

from __future__ import annotations

import os
import re
from datetime import UTC, date, datetime

import numpy as np
import pytest

from station.archive.variables import FILL
from station.errors import StoreError
from station.service.area_series import read_curves
from station.service.digest import MOST_BYTES, digest, newest_digest, write_digest, yesterday
from station.service.journal import Journal
from station.service.worker import Worker

DAY = date(2026, 11, 20)
DAY_S = datetime(2026, 11, 20, tzinfo=UTC).timestamp()


@pytest.fixture
def site(make_site):
    return make_site()


def fill(site, arrivals):
    """Let scans come: (hour of the day, verdict or "set aside", reason)."""
    clock = {}
    with Journal(site.station.data / "journal.sqlite", now_s=lambda: clock["s"]) as journal:
        for number, (hour, verdict, reason) in enumerate(arrivals):
            clock["s"], name = DAY_S + 3600 * hour, f"{number}.laz"
            journal.seen([(name, 1, 1, "")])
            if verdict == "set aside":
                journal.set_aside(name, reason)
            else:
                journal.stored(
                    name, sha256=name, verdict=verdict, epoch=name, start_utc_s=clock["s"], revision=1,
                    reason=reason, figures={"sigma_median_m": 0.04, "stable_z_std": 1.0 + number / 10},
                )  # fmt: skip


def test_what_came_that_day_and_no_other(site):
    fill(site, [(-1, "good", ""), (0, "good", ""), (5, "degraded", "fog"), (6, "set aside", "cut off"),
                (23.9, "degraded", "fog"), (24.1, "good", "")])  # fmt: skip
    told = digest(site, DAY).splitlines()
    assert told[0] == "test (test), 2026-11-20 UTC"
    assert told[1] == "arrived 4: 2 degraded, 1 good, 1 set aside, 0 waiting"
    assert told[2:4] == ["not good 2x: fog", "aside 1x: cut off"]
    assert "stable ground scatters by 1.20 sigma (median; 1.1 to 1.4)" in told
    assert "all: 5 stored, 1 set aside, 0 waiting" in told


def test_areas_change_from_the_last_scan_before_the_day(site, write_series):
    """3-4-5: 0.3 and 0.4 m at one sigma make 0.5 of a difference, 0.98 at 95 %."""
    fill(site, [(1, "good", "")])
    change_m = np.array([[9.0, 0], [1.0, 0], [5.0, 0], [3.5, FILL], [8.0, 0]])
    sigma_m = np.array([[9.0, 1], [0.3, 1], [9.0, 1], [0.4, FILL], [9.0, 1]])
    write_series(DAY_S + 3600.0 * np.array([-5, -1, 3, 23, 25]), change_m, sigma_m, ["tongue", "Hütte"])
    told = digest(site, DAY)
    assert "tongue: +2.500 ± 0.980, +3.500 ± 0.784" in told
    assert "Hütte: +0.000 ± 2.772" in told  # not seen at 23 h: its change at 3 h


def test_unusable_epochs_are_left_out(site, write_series):
    change_m = np.array([[1.0], [50.0], [2.0]])
    write_series(DAY_S + 3600.0 * np.array([1, 2, 3]), change_m, np.ones((3, 1)), ["a"], np.array([0, 2, 1]))
    (curve,) = read_curves(site, -np.inf)
    assert curve.change_m.tolist() == [1.0, 2.0]
    (late,) = read_curves(site, DAY_S + 2.5 * 3600)
    assert late.change_m.tolist() == [2.0]
    (site.station.data / "areas.nc").write_bytes(b"no such format")
    with pytest.raises(StoreError, match="cannot be read"):
        read_curves(site, 0.0)


def test_it_is_never_more_than_10_kb(site, write_series):
    names = [f"area {number} {'ö' * 60}" for number in range(300)]
    many = np.ones((2, 300))
    write_series(DAY_S + 3600.0 * np.array([-1, 1]), many, many, names)
    fill(site, [(hour / 100, "set aside", f"{hour} {'ü' * 400}") for hour in range(200)])
    told = digest(site, DAY)
    assert MOST_BYTES * 0.9 < len(told.encode()) <= MOST_BYTES == 10_000
    lines = told.splitlines()
    left_out = int(re.fullmatch(r"\.\.\. and (\d+) more lines", lines[-1]).group(1))
    areas = [line for line in lines if line.startswith("area ")]
    assert len(areas) + left_out == 300
    assert "aside: 190 more reasons" in lines


def test_it_is_written_once_by_the_housekeeping(site, monkeypatch):
    monkeypatch.setattr("station.service.worker.yesterday", lambda _: DAY)
    fill(site, [(1, "good", "")])
    data = site.station.data
    assert newest_digest(data) is None
    with Journal(data / "journal.sqlite") as journal:
        worker = Worker(site, journal)
        worker.join_closed()
        path = data / "digest" / "2026-11-20.txt"
        assert path.read_text(encoding="utf-8") == digest(site, DAY)
        os.utime(path, (1, 1))
        worker.join_closed()
    assert path.stat().st_mtime == 1
    assert not write_digest(site, DAY, lambda: None)
    assert newest_digest(data) == path


def test_a_digest_that_fails_stops_nothing(site, monkeypatch, caplog):
    monkeypatch.setattr("station.service.worker.yesterday", lambda _: DAY)
    (site.station.data / "digest").write_text("in the way")
    with Journal(site.station.data / "journal.sqlite") as journal:
        Worker(site, journal).join_closed()
    assert "digest=failed" in caplog.text


def test_yesterday_is_of_utc():
    assert yesterday(DAY_S + 86400 + 1) == DAY
    assert yesterday(DAY_S + 86400 - 1) == date(2026, 11, 19)
