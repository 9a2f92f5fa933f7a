"""Epoch files, the series and the reference: round trip, revisions, killed writers, full disks."""

import multiprocessing
import os
import resource
import signal
import time
from dataclasses import replace
from datetime import UTC, datetime

import h5py
import netCDF4
import numpy as np
import pytest
import xarray as xr

import station
from station.archive import epochs, reference_files
from station.archive.series import index
from station.archive.series.compaction import compact
from station.archive.series.virtual import build_series
from station.errors import StoreError
from station.quantities import Reference, SharedParameters, VarianceComponents


def build(series, epoch, hours):
    for hour in hours:
        epochs.write_epoch(series, epoch(hour))
    return build_series(series)


def test_an_epoch_reads_back_to_the_last_bit(series, epoch):
    written = epochs.write_epoch(series, epoch(5, terms=True))
    assert written.path.relative_to(series.folder).as_posix() == "epochs/2025/11/21/hef_20251121T050000Z.nc"
    measurement = epoch(5).measurement
    with xr.open_dataset(written.path) as ds:
        assert float(ds.time[0].astype("datetime64[s]").astype(int)) == epoch(5).start_s + 450
        for name, expected in (
            (
                "elevation_change_systematic_uncertainty",
                measurement.to_rasters("systematic_uncertainty_m")[0],
            ),
            ("elevation_change", measurement.to_rasters("change_m")[0]),
            ("elevation_change_uncertainty", measurement.to_rasters("uncertainty_m")[0]),
        ):
            assert np.array_equal(np.isnan(ds[name][0]), np.isnan(expected))
            assert np.array_equal(ds[name][0], expected, equal_nan=True)
        spread_m = ds.elevation_spread[0].astype("f8")
        assert np.nanmax(np.abs(spread_m * 1024 % 1)) == 0
        assert np.nanmax(np.abs(spread_m - measurement.to_rasters("spread_m")[0])) <= 0.5 / 1024
        assert ds.point_count[0].sum() == measurement.count.sum()
        assert ds.scan_id.values[0] == "251121_050000"
        assert ds.sop_id.values[0] == "sop-1"
        assert float(ds.air_temperature[0]) == -3.5
        assert np.isnan(ds.relative_humidity[0])
        assert ds.shared_parameter_covariance.values[0].diagonal() == pytest.approx([1e-10, 2e-10, 1.6e-5])
        assert "sigma_geometry" in ds
        assert "sigma_instrument" not in ds


def test_the_series_is_sorted_by_time_and_contains_the_newest_revision(series, epoch):
    build(series, epoch, [7, 3, 5])
    assert epochs.write_epoch(series, epoch(5, value=9.0)).revision == 2
    build_series(series)
    with station.open(series.folder) as ds:
        assert np.all(np.diff(ds.time.values.astype(np.int64)) > 0)
        assert ds.elevation_change[:, 3, 3].values == pytest.approx([0.03, 9.0, 0.07], abs=1e-3)
        assert [str(name) for name in ds.epoch_file.values] == [
            "hef_20251121T030000Z.nc",
            "hef_20251121T050000Z_r2.nc",
            "hef_20251121T070000Z.nc",
        ]
        assert np.isnan(ds.elevation_change[0, 3, -1])


def test_the_change_of_an_epoch_without_a_reference_is_missing(series, epoch):
    """In a series of that epoch alone, and together with an epoch that has a reference."""
    epochs.write_epoch(series, epoch(1, value=np.nan))
    build_series(series)
    with station.open(series.folder) as ds:
        assert np.isnan(ds.elevation_change.values).all()
        assert np.isfinite(ds.elevation.values).any()
    epochs.write_epoch(series, epoch(2))
    build_series(series)
    with station.open(series.folder) as ds:
        assert ds.elevation_change[:, 3, 3].values == pytest.approx([np.nan, 0.02], abs=1e-3, nan_ok=True)


def test_an_empty_store_is_reported(series):
    with pytest.raises(StoreError, match="no series yet"):
        station.open(series.folder)
    with pytest.raises(StoreError, match="nothing is stored"):
        build_series(series)


def test_a_damaged_epoch_file_is_named_in_the_error(series, epoch):
    build(series, epoch, [1, 2])
    damaged = epochs.epoch_files(series)[0].path
    damaged.write_bytes(damaged.read_bytes()[:3000])
    with pytest.raises(StoreError, match=damaged.name):
        build_series(series)


def test_empty_chunks_are_not_written(series, epoch):
    written = epochs.write_epoch(series, epoch(1))
    with h5py.File(written.path) as file:
        assert file["elevation_change"].id.get_num_chunks() == 2  # of four: the eastern half is empty
        assert file["elevation_change"].chunks == (1, 128, 128)


def test_a_reference_link_interrupted_by_a_power_cut_is_repaired(series):
    for version in ("1", "2"):
        elevation = np.full(series.grid.shape, 2900.0 + float(version))
        reference = Reference.from_elevation(series.grid, version, elevation, elevation > 0)
        reference_files.write_reference(series, reference)
    link = series.folder / "reference.nc"
    for linked_version in ("1", None):
        link.unlink()
        if linked_version:
            os.link(series.folder / f"reference_{linked_version}.nc", link)
            os.utime(link, ns=(1, 1))
        reference_files.repair_reference_link(series)
        assert reference_files.read_reference(series).version == "2"
    linked_ns = link.stat().st_ctime_ns
    reference_files.repair_reference_link(series)
    assert link.stat().st_ctime_ns == linked_ns


def test_the_reference_reads_back_and_its_older_versions_remain(series):
    elevation = np.full(series.grid.shape, 2900.125)
    elevation[:5] = np.nan
    variance = np.where(np.isnan(elevation), np.nan, 0.0004).astype(np.float32)
    steep = elevation > 2900.0
    visibility = np.where(steep, 0.875, np.nan).astype(np.float32)
    point_count = np.where(steep, 2.375, np.nan).astype(np.float16)
    shared = SharedParameters(("tilt_east",), ("rad",), np.zeros(1), np.array([[3e-11]]), np.array([2e-12]))
    for version in ("1", "2"):
        reference = replace(
            Reference.from_elevation(series.grid, version, elevation, steep),
            random_variance_m2=variance,
            roughness_m2=variance,
            shared=shared,
            scan_ids=("a", "b"),
            components=VarianceComponents(tilt_rad=0.0002),
            visibility=visibility,
            point_count=point_count,
            sop_scan_count=1,
        )
        reference_files.write_reference(series, reference)
    actual = reference_files.read_reference(series)
    assert actual.version == "2"
    assert actual.scan_ids == ("a", "b")
    assert actual.sop_scan_count == 1
    assert np.array_equal(actual.elevation_m, elevation, equal_nan=True)
    assert actual.random_variance_m2 == pytest.approx(variance, rel=0.01, nan_ok=True)
    assert actual.shared.covariance[0, 0] == 3e-11
    assert actual.shared.line_tilt_variance[0] == 2e-12
    assert actual.components == VarianceComponents(tilt_rad=0.0002)
    assert np.array_equal(actual.stable, steep)
    assert np.array_equal(actual.visibility, visibility, equal_nan=True)
    assert actual.point_count == pytest.approx(point_count, abs=0.005, nan_ok=True)
    assert reference_files.read_variance_components(series) == actual.components
    assert (series.folder / "reference_1.nc").is_file()


def test_a_reference_of_an_early_version_does_not_tell_the_usual_numbers_of_points(series):
    reference = Reference.from_elevation(series.grid, "1", np.full(series.grid.shape, 2900.0))
    reference_files.write_reference(series, reference)
    with h5py.File(series.folder / "reference_1.nc", "r+") as file:
        del file["reference_point_count"]
    assert np.isnan(reference_files.read_reference(series, "1").point_count).all()


def run_with_full_disk(task, conn):
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        task()
        conn.send("written")
    except StoreError as error:
        conn.send(str(error))


def message_with_full_disk(task):
    """Return the message of the StoreError that a task raises in a process that may write 20 kB per file."""
    parent_conn, child_conn = multiprocessing.Pipe()
    child = multiprocessing.get_context("fork").Process(target=run_with_full_disk, args=(task, child_conn))
    child.start()
    message = parent_conn.recv() if parent_conn.poll(30) else "no answer"
    child.join()
    return message


def noisy(epoch, hour):
    rng = np.random.default_rng(hour)
    result = epoch(hour)
    result.measurement.change_m[:] = rng.normal(size=len(result.measurement.cells))
    return result


def files_in(series):
    return {path: path.read_bytes() for path in series.folder.rglob("*") if path.is_file()}


def test_an_epoch_that_does_not_fit_the_disk_leaves_no_file(series, epoch):
    too_large = noisy(epoch, 1)
    assert "cannot be written" in message_with_full_disk(lambda: epochs.write_epoch(series, too_large))
    assert not files_in(series)


@pytest.mark.parametrize("task", ["series", "compaction", "reference"])
@pytest.mark.integration
def test_a_full_disk_leaves_all_files_unchanged(series, epoch, task):
    epochs.write_epoch(series, noisy(epoch, 1))
    build_series(series)
    epochs.write_epoch(series, noisy(epoch, 2))
    rough_m = np.random.default_rng(0).normal(size=series.grid.shape)
    reference = Reference.from_elevation(series.grid, "1", rough_m)
    tasks = {
        "series": lambda: build_series(series),
        "compaction": lambda: compact(series, datetime(2026, 2, 1, tzinfo=UTC), lambda: None),
        "reference": lambda: reference_files.write_reference(series, reference),
    }
    original = files_in(series)
    assert "cannot be written" in message_with_full_disk(tasks[task])
    assert files_in(series) == original


def test_a_temporary_file_of_a_killed_process_with_the_same_id_is_replaced(series, epoch):
    folder = epochs.epoch_folder(series, datetime.fromtimestamp(epoch(1).start_s, UTC))
    folder.mkdir(parents=True)
    tmp_path = folder / f".hef_20251121T010000Z.nc.{os.getpid()}.part"
    tmp_path.write_bytes(b"half")
    assert epochs.write_epoch(series, epoch(1)).path.is_file()
    assert not tmp_path.exists()


def keep_writing(series, epoch):
    for hour in range(10_000):
        epochs.write_epoch(series, epoch(hour))
        build_series(series)
        if hour % 3 == 2:
            compact(series, datetime(2030, 1, 1, tzinfo=UTC), lambda: None)


@pytest.mark.integration
def test_a_writer_killed_at_any_moment_leaves_a_readable_series(series, epoch):
    fork = multiprocessing.get_context("fork")
    rng = np.random.default_rng(20251121)
    started_s = time.monotonic()
    build(series, epoch, [0])
    duration_s = time.monotonic() - started_s  # of one epoch on this machine
    for _ in range(30):
        child = fork.Process(target=keep_writing, args=(series, epoch))
        child.start()
        time.sleep(rng.uniform(0.1, 3.0) * duration_s)
        os.kill(child.pid, signal.SIGKILL)
        child.join()
        with station.open(series.folder) as ds:
            hours = (ds.time.values.astype("datetime64[s]").astype(np.int64) - 450 - 1_763_683_200) / 3600
            assert np.all(np.diff(hours) > 0)
            assert ds.elevation_change[:, 139, 74].values == pytest.approx(hours / 100, abs=1e-3)
    assert sum(1 for _ in series.folder.glob("**/*.nc")) > 10
    for ref in index.list_epochs(series):
        with netCDF4.Dataset(ref.path) as file:
            hour = (ref.time_s - 450 - 1_763_683_200) / 3600
            assert file["elevation_change"][ref.index, 139, 74] == pytest.approx(hour / 100, abs=1e-3)
