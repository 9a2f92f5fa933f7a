"""Days and months as one file each, without the series changing a value."""

import dataclasses
import os
from datetime import UTC, datetime, timedelta

import h5py
import numpy as np
import pytest
import xarray as xr

import station
from station.archive import store
from station.archive.join import count_closed, join_closed, now_of, sweep
from station.archive.series import build_series
from station.archive.store import rows, sources
from station.errors import StoreError
from station.quantities import ChangeErrors, Shared

DAY_AFTER = datetime(2025, 11, 23, 12, tzinfo=UTC)
MONTH_AFTER = datetime(2026, 1, 5, tzinfo=UTC)


def join(series, now, progress=lambda: None):
    made = join_closed(series, now, progress)
    build_series(series)
    return len(made)


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
    assert join(filled, datetime(2025, 11, 22, 12, tzinfo=UTC)) == 1
    kinds = [row.path.relative_to(filled.folder).parts[0] for row in rows(filled)]
    assert kinds == ["days", "days", "days", "epochs", "epochs"]
    assert join(filled, DAY_AFTER) == 1
    assert len({row.path for row in rows(filled)}) == 2
    assert values(filled).identical(before)
    assert join(filled, MONTH_AFTER) == 1
    assert len({row.path for row in rows(filled)}) == 1
    assert values(filled).identical(before)
    assert join(filled, MONTH_AFTER) == 0


def test_a_late_scan_makes_a_new_revision_of_its_day(filled, epoch):
    join(filled, DAY_AFTER)
    store.write_epoch(filled, epoch(7))
    build_series(filled)
    assert values(filled).sizes["time"] == 6
    assert join(filled, DAY_AFTER) == 1
    names = sorted({row.path.name for row in rows(filled)})
    assert names == ["hef_20251121_r2.nc", "hef_20251122_r1.nc"]
    assert np.all(np.diff(values(filled).time.values.astype(np.int64)) > 0)


def test_a_day_that_lies_beside_its_month_is_left_for_the_month(filled, epoch):
    """Where the month cannot be joined, for a scan from another place, it must not be made anew each time."""
    join(filled, MONTH_AFTER)
    store.write_epoch(filled, epoch(5, value=0.5))
    elsewhere = Shared(("heading",), ("rad",), np.zeros(1), np.eye(1), np.zeros(1))
    store.write_epoch(filled, dataclasses.replace(epoch(25), shared=elsewhere))
    build_series(filled)
    before = values(filled)
    made = [join(filled, MONTH_AFTER) for _ in range(4)]
    assert made == [1, 0, 0, 0]
    assert values(filled).identical(before)


def test_parts_go_only_after_the_grace(filled):
    before = values(filled)
    now = datetime.now(UTC)
    join(filled, MONTH_AFTER)
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


def test_a_file_that_the_series_still_names_never_goes(filled):
    """Where the disk was full after a join, the old series serves on."""
    before = filled.path.read_bytes()
    join(filled, DAY_AFTER)
    filled.path.write_bytes(before)
    assert sweep(filled, datetime.now(UTC) + timedelta(hours=49)) == []
    assert values(filled).sizes["time"] == 5


def test_the_grace_begins_when_the_series_names_a_file_no_longer(filled):
    before = filled.path.read_bytes()
    join(filled, DAY_AFTER)
    filled.path.write_bytes(before)
    long_ago = (datetime.now(UTC) - timedelta(days=9)).timestamp()
    for path in filled.folder.glob("**/*.nc"):
        os.utime(path, (long_ago, long_ago))
    build_series(filled)
    assert sweep(filled, datetime.now(UTC) + timedelta(hours=47)) == []
    assert len(sweep(filled, datetime.now(UTC) + timedelta(hours=49))) == 5


def test_what_is_measured_again_after_the_sweep_wins(filled, epoch):
    join(filled, DAY_AFTER)
    sweep(filled, datetime.now(UTC) + timedelta(hours=49))
    again = store.write_epoch(filled, epoch(5, value=9.0))
    assert again.path.name == "hef_20251121T050000Z_r2.nc"
    build_series(filled)
    assert values(filled).elevation_change[:3, 3, 3].values == pytest.approx([0.01, 9.0, 0.09], abs=1e-3)


def test_a_joined_file_never_changes_under_its_name(filled, epoch):
    for hour in (7, 8):
        join(filled, DAY_AFTER)
        sweep(filled, datetime.now(UTC) + timedelta(hours=49))
        store.write_epoch(filled, epoch(hour))
    held = {path.name: path.read_bytes() for path in filled.folder.glob("days/**/*.nc")}
    join(filled, DAY_AFTER)
    assert "hef_20251121_r3.nc" in {path.name for path in sources(filled.path)}
    for path in filled.folder.glob("days/**/*.nc"):
        assert held.get(path.name, path.read_bytes()) == path.read_bytes()


def test_progress_is_told_while_a_file_is_copied(filled):
    told = []
    join(filled, DAY_AFTER, lambda: told.append(1))
    assert len(told) > 5  # epochs


def moved(epoch):
    """The same scan from a scanner that was moved: other azimuths, so other shared parameters."""
    shared = Shared(("tilt_north", "lean_090.0", "range_bias"), ("rad", "rad", "m"), np.arange(3.0),
                    np.arange(9.0).reshape(3, 3) * 1e-6, np.zeros(3),
                    ChangeErrors(np.arange(96.0).reshape(3, 32), np.arange(288.0)))  # fmt: skip
    return dataclasses.replace(epoch, shared=shared)


def test_epochs_before_and_after_a_move_stand_in_one_series_each_with_its_parameters(filled, epoch):
    store.write_epoch(filled, moved(epoch(33)))
    build_series(filled)
    for months in (False, True):
        if months:
            assert join(filled, MONTH_AFTER) == 1  # the day before the move
        told = values(filled)
        names = [str(name) for name in told.parameter_name.values]
        assert sorted(names) == ["lean_090.0", "range_bias", "tilt_east", "tilt_north"]
        covariance = told.shared_parameter_covariance
        at = [names.index(name) for name in ("tilt_north", "lean_090.0", "range_bias")]
        assert covariance[-1, at, at].values == pytest.approx(np.arange(9.0).reshape(3, 3) * 1e-6)
        assert told.shared_parameter[-1, at].values.tolist() == [0.0, 1.0, 2.0]
        assert np.isnan(covariance[-1, names.index("tilt_east")]).all()
        at = [names.index(name) for name in ("tilt_east", "tilt_north", "range_bias")]
        assert covariance[0, at, at].values == pytest.approx(np.diag([1e-10, 2e-10, 1.6e-5]))
        assert np.isnan(covariance[0, names.index("lean_090.0")]).all()
        assert (told.change_errors[0, at].values == np.float32(told.change_pattern[0, 0] * 8e-6)).all()
        at = [names.index(name) for name in ("tilt_north", "lean_090.0", "range_bias")]
        assert (told.change_errors[-1, at].values == np.arange(96.0).reshape(3, 32)).all()
        assert np.isnan(told.change_errors[-1, names.index("tilt_east")]).all()
        assert told.change_pattern[-1].values.tolist() == list(range(288))


def test_epochs_of_an_older_version_join_with_newer_ones(filled):
    """Another chunking, a variable that was not there yet: values stay, what was not there is missing."""
    before = values(filled)
    for one in store.epochs(filled)[:2]:
        with h5py.File(one.path, "r+") as file:
            old = file["elevation"]
            kept, attributes, scales = old[:], dict(old.attrs), [file[dim] for dim in ("time", "y", "x")]
            del file["elevation"], file["stable_nmad"], file["lean_zero"], file["elevation_spread"]
            del file["change_errors"], file["change_pattern"]
            new = file.create_dataset("elevation", data=kept, chunks=(1, 64, 64), maxshape=(None, 140, 150))
            for key in attributes.keys() - {"DIMENSION_LIST"}:
                new.attrs[key] = attributes[key]
            for axis, scale in enumerate(scales):
                new.dims[axis].attach_scale(scale)
    build_series(filled)
    told = values(filled)
    assert np.isnan(told.elevation_spread[:2]).all()
    assert np.isnan(told.change_errors[:2]).all()
    assert np.isnan(told.change_pattern[:2]).all()
    changed = ["elevation_spread", "change_errors", "change_pattern"]
    assert told.drop_vars(changed).identical(before.drop_vars(changed))
    join(filled, DAY_AFTER)
    assert values(filled).identical(told)


def test_a_source_that_is_gone_is_noticed(filled):
    store.epochs(filled)[1].path.unlink()
    with xr.open_dataset(filled.path) as told:
        assert np.isnan(told.elevation_change[1]).all()  # what others would read without a word
    with pytest.raises(StoreError, match="hef_20251121T050000Z"):
        station.open(filled.folder)


def test_amid_a_backlog_a_day_is_joined_when_later_ones_have_come(series, epoch):
    """By the clock of the wall all of it is long over, and would be joined anew with each scan."""
    for hour in (1, 5, 9, 25, 29):
        store.write_epoch(series, epoch(hour))
        build_series(series)
        assert count_closed(series) == 0
    assert join(series, now_of(series)) == 0
    store.write_epoch(series, epoch(31))
    build_series(series)
    assert count_closed(series) == 3
    assert join(series, now_of(series)) == 1
    assert count_closed(series) == 0
