"""Compaction into files of days and months: no value of the series changes, no epoch is lost."""

import dataclasses
import os
from datetime import UTC, datetime, timedelta

import h5py
import numpy as np
import pytest
import xarray as xr
from support.epochs import GRID, make_epoch, write_surface
from support.series import copied, open_with_processing, without_dates

import station
from station.archive import epochs
from station.archive.netcdf_layout import Series
from station.archive.series.compaction import compact, count_compactable, delete_expired, latest_start
from station.archive.series.index import list_epochs, source_files
from station.archive.series.virtual import build_series
from station.errors import StoreError
from station.quantities import ChangeErrors, SharedParameters

DAY_AFTER = datetime(2025, 11, 23, 12, tzinfo=UTC)
MONTH_AFTER = datetime(2026, 1, 5, tzinfo=UTC)


def compact_and_build(series, now, progress=lambda: None):
    written = compact(series, now, progress)
    build_series(series)
    return len(written)


def values(series):
    with open_with_processing(series.folder) as dataset:
        return without_dates(dataset.load())


@pytest.fixture(scope="module")
def base_store(tmp_path_factory):
    series = Series(tmp_path_factory.mktemp("base"), "hef", GRID, "EPSG:32632")
    write_surface(series)
    for hour in (1, 5, 9, 25, 30):  # two days
        epochs.write_epoch(series, make_epoch(hour))
    build_series(series)
    return series


@pytest.fixture
def filled(base_store, tmp_path):
    """A store of five epochs that a test may change."""
    return copied(base_store, tmp_path / "store")


@pytest.mark.integration
def test_compaction_changes_no_value_and_reduces_the_number_of_files(filled):
    expected = values(filled)
    assert compact_and_build(filled, datetime(2025, 11, 22, 12, tzinfo=UTC)) == 1
    kinds = [epoch.path.relative_to(filled.folder).parts[0] for epoch in list_epochs(filled)]
    assert kinds == ["days", "days", "days", "epochs", "epochs"]
    assert compact_and_build(filled, DAY_AFTER) == 1
    assert len({epoch.path for epoch in list_epochs(filled)}) == 2
    assert values(filled).identical(expected)
    assert compact_and_build(filled, MONTH_AFTER) == 1
    assert len({epoch.path for epoch in list_epochs(filled)}) == 1
    assert values(filled).identical(expected)
    assert compact_and_build(filled, MONTH_AFTER) == 0


@pytest.mark.integration
def test_a_late_scan_causes_a_new_revision_of_its_day(filled, epoch):
    compact_and_build(filled, DAY_AFTER)
    epochs.write_epoch(filled, epoch(7))
    build_series(filled)
    assert values(filled).sizes["time"] == 6
    assert compact_and_build(filled, DAY_AFTER) == 1
    names = sorted({epoch.path.name for epoch in list_epochs(filled)})
    assert names == ["hef_20251121_r2.nc", "hef_20251122_r1.nc"]
    assert np.all(np.diff(values(filled).time.values.astype(np.int64)) > 0)


@pytest.mark.integration
def test_a_day_with_a_late_scan_is_not_rewritten_each_time_if_its_month_cannot_be(filled, epoch):
    """The month cannot be compacted, because the scanner was relocated during it."""
    compact_and_build(filled, MONTH_AFTER)
    epochs.write_epoch(filled, epoch(5, value=0.5))
    relocated = SharedParameters(("heading",), ("rad",), np.zeros(1), np.eye(1), np.zeros(1))
    epochs.write_epoch(filled, dataclasses.replace(epoch(25), shared=relocated))
    build_series(filled)
    expected = values(filled)
    assert [compact_and_build(filled, MONTH_AFTER) for _ in range(4)] == [1, 0, 0, 0]
    assert values(filled).identical(expected)


@pytest.mark.integration
def test_replaced_files_are_deleted_only_after_the_grace_period(filled):
    expected = values(filled)
    now = datetime.now(UTC)
    compact_and_build(filled, MONTH_AFTER)
    assert delete_expired(filled, now) == []
    assert delete_expired(filled, now + timedelta(hours=47)) == []
    deleted = delete_expired(filled, now + timedelta(hours=49))
    assert len([path for path in deleted if "epochs" in path.parts]) == 5
    assert len(deleted) == 7
    assert values(filled).identical(expected)


def test_temporary_files_and_folders_of_killed_processes_are_deleted(filled):
    file = filled.folder / "epochs/2025/11/21/.hef_20251121T010000Z.nc.123.part"
    file.write_bytes(b"half")
    folder = filled.folder / "..viewing_geometry-0123.123.part"
    folder.mkdir()
    (folder / "cell.npy").write_bytes(b"half")
    assert delete_expired(filled, datetime.now(UTC)) == []
    long_ago = (datetime.now(UTC) - timedelta(days=3)).timestamp()
    for path in (file, folder):
        os.utime(path, (long_ago, long_ago))
    assert set(delete_expired(filled, datetime.now(UTC))) == {file, folder}
    assert not file.exists()
    assert not folder.exists()


@pytest.mark.integration
def test_a_file_that_the_series_refers_to_is_never_deleted(filled):
    """If the disk was full after compaction, the old series remains in use."""
    original = filled.path.read_bytes()
    compact_and_build(filled, DAY_AFTER)
    filled.path.write_bytes(original)
    assert delete_expired(filled, datetime.now(UTC) + timedelta(hours=49)) == []
    assert values(filled).sizes["time"] == 5


@pytest.mark.integration
def test_the_grace_period_starts_when_the_series_no_longer_refers_to_a_file(filled):
    original = filled.path.read_bytes()
    compact_and_build(filled, DAY_AFTER)
    filled.path.write_bytes(original)
    long_ago = (datetime.now(UTC) - timedelta(days=9)).timestamp()
    for path in filled.folder.glob("**/*.nc"):
        os.utime(path, (long_ago, long_ago))
    build_series(filled)
    assert delete_expired(filled, datetime.now(UTC) + timedelta(hours=47)) == []
    assert len(delete_expired(filled, datetime.now(UTC) + timedelta(hours=49))) == 5


@pytest.mark.integration
def test_a_reprocessed_epoch_replaces_the_compacted_one_after_its_file_was_deleted(filled, epoch):
    compact_and_build(filled, DAY_AFTER)
    delete_expired(filled, datetime.now(UTC) + timedelta(hours=49))
    again = epochs.write_epoch(filled, epoch(5, value=9.0))
    assert again.path.name == "hef_20251121T050000Z_r2.nc"
    build_series(filled)
    assert values(filled).elevation_change[:3, 3, 3].values == pytest.approx([0.01, 9.0, 0.09], abs=1e-3)


@pytest.mark.integration
def test_a_compacted_file_never_changes_under_its_name(filled, epoch):
    for hour in (7, 8):
        compact_and_build(filled, DAY_AFTER)
        delete_expired(filled, datetime.now(UTC) + timedelta(hours=49))
        epochs.write_epoch(filled, epoch(hour))
    contents = {path.name: path.read_bytes() for path in filled.folder.glob("days/**/*.nc")}
    compact_and_build(filled, DAY_AFTER)
    assert "hef_20251121_r3.nc" in {path.name for path in source_files(filled.path)}
    for path in filled.folder.glob("days/**/*.nc"):
        assert contents.get(path.name, path.read_bytes()) == path.read_bytes()


@pytest.mark.integration
def test_progress_is_called_while_a_file_is_copied(filled):
    calls = []
    compact_and_build(filled, DAY_AFTER, lambda: calls.append(1))
    assert len(calls) > 5  # epochs


def relocate(epoch):
    """Return the epoch as if the scanner had been relocated: other azimuths, so other shared parameters."""
    shared = SharedParameters(
        ("tilt_north", "sight_tilt_090.0", "range_bias"),
        ("rad", "rad", "m"),
        np.arange(3.0),
        np.arange(9.0).reshape(3, 3) * 1e-6,
        np.zeros(3),
        ChangeErrors(np.arange(96.0).reshape(3, 32), np.arange(288.0)),
    )
    return dataclasses.replace(epoch, shared=shared)


@pytest.mark.integration
def test_epochs_before_and_after_a_relocation_keep_their_parameters_in_one_series(filled, epoch):
    epochs.write_epoch(filled, relocate(epoch(33)))
    build_series(filled)
    for compacted in (False, True):
        if compacted:
            assert compact_and_build(filled, MONTH_AFTER) == 1  # the day before the relocation
        ds = values(filled)
        names = [str(name) for name in ds.parameter_name.values]
        assert sorted(names) == ["range_bias", "sight_tilt_090.0", "tilt_east", "tilt_north"]
        covariance = ds.shared_parameter_covariance
        index = [names.index(name) for name in ("tilt_north", "sight_tilt_090.0", "range_bias")]
        assert covariance[-1, index, index].values == pytest.approx(np.arange(9.0).reshape(3, 3) * 1e-6)
        assert ds.shared_parameter[-1, index].values.tolist() == [0.0, 1.0, 2.0]
        assert np.isnan(covariance[-1, names.index("tilt_east")]).all()
        index = [names.index(name) for name in ("tilt_east", "tilt_north", "range_bias")]
        assert covariance[0, index, index].values == pytest.approx(np.diag([1e-10, 2e-10, 1.6e-5]))
        assert np.isnan(covariance[0, names.index("sight_tilt_090.0")]).all()
        assert (ds.change_errors[0, index].values == np.float32(ds.change_pattern[0, 0] * 8e-6)).all()
        index = [names.index(name) for name in ("tilt_north", "sight_tilt_090.0", "range_bias")]
        assert (ds.change_errors[-1, index].values == np.arange(96.0).reshape(3, 32)).all()
        assert np.isnan(ds.change_errors[-1, names.index("tilt_east")]).all()
        assert ds.change_pattern[-1].values.tolist() == list(range(288))


@pytest.mark.integration
def test_epochs_of_an_older_version_are_compacted_with_newer_ones(filled):
    """With another chunking and without newer variables: values are kept, absent variables are missing."""
    expected = values(filled)
    for epoch_file in epochs.epoch_files(filled)[:2]:
        with h5py.File(epoch_file.path, "r+") as file:
            name = "elevation_change"
            old = file[name]
            data, attributes, scales = old[:], dict(old.attrs), [file[dim] for dim in ("time", "y", "x")]
            del (
                file["elevation_change"],
                file["stable_nmad"],
                file["sop_tilt_offset"],
                file["elevation_spread"],
            )
            del file["change_errors"], file["change_pattern"]
            new = file.create_dataset(
                "elevation_change", data=data, chunks=(1, 64, 64), maxshape=(None, 140, 150)
            )
            for key in attributes.keys() - {"DIMENSION_LIST"}:
                new.attrs[key] = attributes[key]
            for axis, scale in enumerate(scales):
                new.dims[axis].attach_scale(scale)
    build_series(filled)
    actual = values(filled)
    absent = ["elevation_spread", "change_errors", "change_pattern"]
    for name in absent:
        assert np.isnan(actual[name][:2]).all()
    assert actual.drop_vars(absent).identical(expected.drop_vars(absent))
    compact_and_build(filled, DAY_AFTER)
    assert values(filled).identical(actual)


def test_a_missing_source_file_is_reported(filled):
    epochs.epoch_files(filled)[1].path.unlink()
    with xr.open_dataset(filled.path, decode_times=False) as ds:
        assert (ds.elevation_change[1] == np.float32(1e30)).all()  # HDF5 gives no error
    with pytest.raises(StoreError, match="hef_20251121T050000Z"):
        station.open(filled.folder)


@pytest.mark.integration
def test_during_a_backlog_a_day_is_compacted_after_scans_of_later_days(series, epoch):
    """By the clock, every day has ended long ago and would be compacted again after each scan."""
    for hour in (1, 5, 9, 25, 29):
        epochs.write_epoch(series, epoch(hour))
        build_series(series)
        assert count_compactable(series) == 0
    assert compact_and_build(series, latest_start(series)) == 0
    epochs.write_epoch(series, epoch(31))
    build_series(series)
    assert count_compactable(series) == 3
    assert compact_and_build(series, latest_start(series)) == 1
    assert count_compactable(series) == 0
