"""Days and months as one file each, without the series changing a value."""

import os
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

import station
from station.archive import store
from station.archive.join import join_closed, sweep
from station.archive.series import build_series, rows

DAY_AFTER = datetime(2025, 11, 23, 12, tzinfo=UTC)
MONTH_AFTER = datetime(2026, 1, 5, tzinfo=UTC)


def values(series):
    with station.open(series.folder) as told:
        return told.load()


@pytest.fixture
def filled(series, epoch):
    for hour in (1, 5, 9, 25, 30):  # two days
        store.write_epoch(series, epoch(hour))
    build_series(series)
    return series


def test_joining_changes_no_value_and_names_fewer_files(filled):
    before = values(filled)
    assert join_closed(filled, datetime(2025, 11, 22, 12, tzinfo=UTC), lambda: None) == 1
    kinds = [row.path.relative_to(filled.folder).parts[0] for row in rows(filled)]
    assert kinds == ["days", "days", "days", "epochs", "epochs"]
    assert join_closed(filled, DAY_AFTER, lambda: None) == 1
    assert len({row.path for row in rows(filled)}) == 2
    assert values(filled).identical(before)
    assert join_closed(filled, MONTH_AFTER, lambda: None) == 1
    assert len({row.path for row in rows(filled)}) == 1
    assert values(filled).identical(before)
    assert join_closed(filled, MONTH_AFTER, lambda: None) == 0


def test_a_late_scan_makes_a_new_revision_of_its_day(filled, epoch):
    join_closed(filled, DAY_AFTER, lambda: None)
    store.write_epoch(filled, epoch(7))
    build_series(filled)
    assert values(filled).sizes["time"] == 6
    assert join_closed(filled, DAY_AFTER, lambda: None) == 1
    names = sorted({row.path.name for row in rows(filled)})
    assert names == ["hef_20251121_r2.nc", "hef_20251122_r1.nc"]
    assert np.all(np.diff(values(filled).time.values.astype(np.int64)) > 0)


def test_parts_go_only_after_the_grace(filled):
    before = values(filled)
    now = datetime.now(UTC)
    join_closed(filled, MONTH_AFTER, lambda: None)
    assert sweep(filled, now) == []
    assert sweep(filled, now + timedelta(hours=47)) == []
    gone = sweep(filled, now + timedelta(hours=49))
    assert len([path for path in gone if "epochs" in path.parts]) == 5
    assert len(gone) == 7
    assert values(filled).identical(before)


def test_left_over_parts_go(filled):
    part = filled.folder / "epochs/2025/11/21/.hef_20251121T010000Z.nc.123.part"
    part.write_bytes(b"half")
    assert sweep(filled, datetime.now(UTC)) == []
    long_ago = (datetime.now(UTC) - timedelta(days=3)).timestamp()
    os.utime(part, (long_ago, long_ago))
    assert sweep(filled, datetime.now(UTC)) == [part]
