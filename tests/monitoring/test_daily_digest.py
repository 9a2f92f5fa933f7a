"""The daily digest: arrivals, verdicts and area changes in at most 10 kB."""

from __future__ import annotations

import os
import re
from datetime import UTC, date, datetime

import numpy as np
import pytest
from support.products import write_melt, write_product

from station.archive.schema import FILL
from station.errors import StoreError
from station.inbox.journal import Journal
from station.monitoring.area_curves import read_curves
from station.monitoring.daily_digest import MAX_BYTES, format_digest, newest_digest, write_digest, yesterday
from station.service.worker import Worker

DAY = date(2026, 11, 20)
DAY_S = datetime(2026, 11, 20, tzinfo=UTC).timestamp()


@pytest.fixture
def site(make_site):
    return make_site()


def fill(site, arrivals):
    """Record scans: (hour of the day, verdict or "set aside", reason)."""
    clock = {}
    with Journal(site.station.data / "journal.sqlite", now_s=lambda: clock["s"]) as journal:
        for index, (hour, verdict, reason) in enumerate(arrivals):
            clock["s"], name = DAY_S + 3600 * hour, f"{index}.laz"
            journal.record_seen([(name, 1, 1, "")])
            if verdict == "set aside":
                journal.set_aside(name, reason)
            else:
                journal.record_stored(
                    name, sha256=name, verdict=verdict, epoch=name, start_utc_s=clock["s"], revision=1,
                    reason=reason, metrics={"sigma_median_m": 0.04, "stable_z_std": 1.0 + index / 10},
                )  # fmt: skip


def test_digest_counts_the_arrivals_of_its_day(site):
    fill(site, [(-1, "good", ""), (0, "good", ""), (5, "degraded", "fog"), (6, "set aside", "cut off"),
                (23.9, "degraded", "fog"), (24.1, "good", "")])  # fmt: skip
    lines = format_digest(site, DAY).splitlines()
    assert lines[0] == "test (test), 2026-11-20 UTC"
    assert lines[1] == "arrived 4: 2 degraded, 1 good, 1 set aside, 0 waiting"
    assert lines[2:4] == ["not good 2x: fog", "set aside 1x: cut off"]
    assert "stable ground scatters by 1.20 sigma (median; 1.1 to 1.4)" in lines
    assert "all: 5 stored, 1 set aside, 0 waiting" in lines


def test_area_change_is_relative_to_the_last_scan_of_the_previous_day(site, write_series):
    """3-4-5: 0.3 and 0.4 m at one sigma make 0.5 of a difference, 0.98 at 95 %."""
    fill(site, [(1, "good", "")])
    change_m = np.array([[9.0, 0], [1.0, 0], [5.0, 0], [3.5, FILL], [8.0, 0]])
    sigma_m = np.array([[9.0, 1], [0.3, 1], [9.0, 1], [0.4, FILL], [9.0, 1]])
    write_series(DAY_S + 3600.0 * np.array([-5, -1, 3, 23, 25]), change_m, sigma_m, ["tongue", "Hütte"])
    text = format_digest(site, DAY)
    assert "tongue: +2.500 ± 0.980, +3.500 ± 0.784" in text
    assert "Hütte: +0.000 ± 2.772" in text  # not observed at 23 h: its change at 3 h


def test_products_have_the_newest_usable_value_of_the_day(site):
    fill(site, [(1, "good", "")])
    hours = np.array([-2.0, 5.0, 20.0, 23.0, 24.5])
    write_melt(site, DAY_S + 3600 * hours, [0.1, 0.2, 0.3, 9.0, 0.4], [0, 0, 1, 2, 0])
    assert format_digest(site, DAY).splitlines()[-1] == (
        "Ice melt, stake: melt, water equivalent 0.300 ±0.196 m at 2026-11-20 20:00"
    )


def test_quantities_of_a_plane_have_the_words_of_its_page(make_site):
    site = make_site(more="[grid.plane]\norigin_m = [0, 0, 0]\nfacing_deg = 180\ndip_deg = 90\n")
    fill(site, [(1, "good", "")])
    write_product(site, "point", "elevation", DAY_S + np.array([3600.0]), [0.25])
    assert "Rock, stake: distance out of the plane 0.250 ±0.196 m" in format_digest(site, DAY)


def test_unusable_epochs_are_excluded(site, write_series):
    change_m = np.array([[1.0], [50.0], [2.0]])
    write_series(DAY_S + 3600.0 * np.array([1, 2, 3]), change_m, np.ones((3, 1)), ["a"], np.array([0, 2, 1]))
    (curve,) = read_curves(site, -np.inf)
    assert curve.change_m.tolist() == [1.0, 2.0]
    (late,) = read_curves(site, DAY_S + 2.5 * 3600)
    assert late.change_m.tolist() == [2.0]
    (site.station.data / "areas.nc").write_bytes(b"no such format")
    with pytest.raises(StoreError, match="cannot be read"):
        read_curves(site, 0.0)


def test_digest_has_at_most_10_kb(site, write_series):
    names = [f"area {index} {'ö' * 60}" for index in range(300)]
    ones = np.ones((2, 300))
    write_series(DAY_S + 3600.0 * np.array([-1, 1]), ones, ones, names)
    fill(site, [(hour / 100, "set aside", f"{hour} {'ü' * 400}") for hour in range(200)])
    text = format_digest(site, DAY)
    assert MAX_BYTES * 0.9 < len(text.encode()) <= MAX_BYTES == 10_000
    lines = text.splitlines()
    omitted = int(re.fullmatch(r"\.\.\. and (\d+) more lines", lines[-1]).group(1))
    areas = [line for line in lines if line.startswith("area ")]
    assert len(areas) + omitted == 300
    assert "set aside: 190 more reasons" in lines


@pytest.mark.integration
def test_housekeeping_writes_the_digest_once(site, monkeypatch):
    monkeypatch.setattr("station.service.worker.yesterday", lambda _: DAY)
    fill(site, [(1, "good", "")])
    data = site.station.data
    assert newest_digest(data) is None
    with Journal(data / "journal.sqlite") as journal:
        worker = Worker(site, journal)
        worker.compact()
        path = data / "digest" / "2026-11-20.txt"
        assert path.read_text(encoding="utf-8") == format_digest(site, DAY)
        os.utime(path, (1, 1))
        worker.compact()
    assert path.stat().st_mtime == 1
    assert not write_digest(site, DAY, lambda: None)
    assert newest_digest(data) == path


@pytest.mark.integration
def test_failed_digest_is_logged(site, monkeypatch, caplog):
    monkeypatch.setattr("station.service.worker.yesterday", lambda _: DAY)
    (site.station.data / "digest").write_text("in the way")
    with Journal(site.station.data / "journal.sqlite") as journal:
        Worker(site, journal).compact()
    assert "digest=failed" in caplog.text


def test_yesterday_is_in_utc():
    assert yesterday(DAY_S + 86400 + 1) == DAY
    assert yesterday(DAY_S + 86400 - 1) == date(2026, 11, 19)
