"""Epochs, the series over them, the reference: written, read back, replaced, killed, out of room."""

import multiprocessing
import os
import resource
import signal
import time
from dataclasses import replace
from datetime import UTC, datetime

import netCDF4
import numpy as np
import pytest
import xarray as xr

import station
from station.archive import reference, store
from station.archive.join import join_closed
from station.archive.series import build_series
from station.errors import StoreError
from station.quantities import Habits, Reference, Shared


def build(series, epoch, hours):
    for hour in hours:
        store.write_epoch(series, epoch(hour))
    return build_series(series)


def test_an_epoch_comes_back_to_the_stored_digit(series, epoch):
    written = store.write_epoch(series, epoch(5, terms=True))
    assert written.path.relative_to(series.folder).as_posix() == "epochs/2025/11/21/hef_20251121T050000Z.nc"
    given = epoch(5).measurement
    with xr.open_dataset(written.path) as told:
        assert float(told.time[0].astype("datetime64[s]").astype(int)) == epoch(5).start_s + 450
        for name, values in (
            ("elevation", given.laid("elevation_m")[0]),
            ("elevation_change", given.laid("change_m")[0]),
            ("elevation_change_uncertainty", given.laid("uncertainty_m")[0]),
        ):
            assert np.array_equal(np.isnan(told[name][0]), np.isnan(values))
            assert np.nanmax(np.abs(told[name][0] - values)) <= 0.5 / 1024 + 1e-4
            steps = 16384 if name.endswith("uncertainty") else 1024
            assert np.nanmax(np.abs(told[name][0].astype("f8") * steps % 1)) == 0
        assert told.point_count[0].sum() == given.count.sum()
        assert told.scan_id.values[0] == "251121_050000"
        assert told.sop_id.values[0] == "sop-1"
        assert float(told.air_temperature[0]) == -3.5
        assert np.isnan(told.relative_humidity[0])
        assert told.shared_parameter_covariance.values[0].diagonal() == pytest.approx([1e-10, 2e-10, 1.6e-5])
        assert "sigma_geometry" in told
        assert "sigma_instrument" not in told


def test_the_series_is_in_the_order_of_time_and_holds_the_newest_revision(series, epoch):
    build(series, epoch, [7, 3, 5])
    again = store.write_epoch(series, epoch(5, value=9.0))
    assert again.revision == 2
    build_series(series)
    with station.open(series.folder) as told:
        assert np.all(np.diff(told.time.values.astype(np.int64)) > 0)
        assert told.elevation_change[:, 3, 3].values == pytest.approx([0.03, 9.0, 0.07], abs=1e-3)
        assert [str(name) for name in told.epoch_file.values] == [
            "hef_20251121T030000Z.nc",
            "hef_20251121T050000Z_r2.nc",
            "hef_20251121T070000Z.nc",
        ]
        assert np.isnan(told.elevation_change[0, 3, -1])


def test_an_epoch_before_there_is_a_reference(series, epoch):
    """Its change is empty altogether, alone and beside one that has some."""
    store.write_epoch(series, epoch(1, value=np.nan))
    build_series(series)
    with station.open(series.folder) as told:
        assert np.isnan(told.elevation_change.values).all()
        assert np.isfinite(told.elevation.values).any()
    store.write_epoch(series, epoch(2))
    build_series(series)
    with station.open(series.folder) as told:
        assert told.elevation_change[:, 3, 3].values == pytest.approx([np.nan, 0.02], abs=1e-3, nan_ok=True)


def test_nothing_stored_is_said(series):
    with pytest.raises(StoreError, match="no series yet"):
        station.open(series.folder)
    with pytest.raises(StoreError, match="nothing is stored"):
        build_series(series)


def test_a_damaged_epoch_is_named(series, epoch):
    build(series, epoch, [1, 2])
    broken = store.epochs(series)[0].path
    broken.write_bytes(broken.read_bytes()[:3000])
    with pytest.raises(StoreError, match=broken.name):
        build_series(series)


def test_empty_chunks_are_not_written(series, epoch):
    import h5py

    written = store.write_epoch(series, epoch(1))
    with h5py.File(written.path) as file:
        assert file["elevation_change"].id.get_num_chunks() == 2  # of four: the east is empty
        assert file["elevation_change"].chunks == (1, 128, 128)


def test_a_power_cut_between_the_names_of_a_reference_is_mended(series):
    for version in ("1", "2"):
        elevation = np.full(series.grid.shape, 2900.0 + float(version))
        given = Reference.given(series.grid, version, elevation, elevation > 0)
        reference.write_reference(series, given)
    named = series.folder / "reference.nc"
    for kept in ("1", None):
        named.unlink()
        if kept:
            os.link(series.folder / f"reference_{kept}.nc", named)
            os.utime(named, ns=(1, 1))
        reference.settle_reference(series)
        assert reference.read_reference(series).version == "2"
    written_ns = named.stat().st_ctime_ns
    reference.settle_reference(series)
    assert named.stat().st_ctime_ns == written_ns


def test_the_reference_comes_back_and_its_versions_stay(series):
    elevation = np.full(series.grid.shape, 2900.125)
    elevation[:5] = np.nan
    variance = np.where(np.isnan(elevation), np.nan, 0.0004).astype(np.float32)
    steep = elevation > 2900.0
    seen = np.where(steep, 0.875, np.nan).astype(np.float32)
    common = Shared(("tilt_east",), ("rad",), np.zeros(1), np.array([[3e-11]]), np.array([2e-12]))
    for version in ("1", "2"):
        given = Reference.given(series.grid, version, elevation, steep)
        made = replace(
            given,
            random_variance_m2=variance,
            roughness_m2=variance,
            shared=common,
            scan_ids=("a", "b"),
            habits=Habits(tilt_rad=0.0002),
            seen=seen,
        )
        reference.write_reference(series, made)
    told = reference.read_reference(series)
    assert told.version == "2"
    assert told.scan_ids == ("a", "b")
    assert np.array_equal(told.elevation_m, elevation, equal_nan=True)
    assert told.random_variance_m2 == pytest.approx(variance, rel=0.01, nan_ok=True)
    assert told.shared.covariance[0, 0] == 3e-11
    assert told.shared.noise_variance[0] == 2e-12
    assert told.habits == Habits(tilt_rad=0.0002)
    assert np.array_equal(told.stable, steep)
    assert np.array_equal(told.seen, seen, equal_nan=True)
    assert reference.read_habits(series) == told.habits
    assert (series.folder / "reference_1.nc").is_file()


def out_of_room(task, written):
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        task()
        written.send("written")
    except StoreError as error:
        written.send(str(error))


def said_without_room(task):
    here, there = multiprocessing.Pipe()
    child = multiprocessing.get_context("fork").Process(target=out_of_room, args=(task, there))
    child.start()
    said = here.recv() if here.poll(30) else "nothing"
    child.join()
    return said


def noisy(epoch, hour):
    rng = np.random.default_rng(hour)
    made = epoch(hour)
    made.measurement.change_m[:] = rng.normal(size=len(made.measurement.cells))
    return made


def test_no_room_for_an_epoch_leaves_nothing_behind(series, epoch):
    made = noisy(epoch, 1)
    assert "cannot be written" in said_without_room(lambda: store.write_epoch(series, made))
    assert not [path for path in series.folder.rglob("*") if path.is_file()]


@pytest.mark.parametrize("task", ["series", "join", "reference"])
def test_no_room_leaves_what_there_was(series, epoch, task):
    store.write_epoch(series, noisy(epoch, 1))
    build_series(series)
    store.write_epoch(series, noisy(epoch, 2))
    bumpy = np.random.default_rng(0).normal(size=series.grid.shape)
    made = Reference.given(series.grid, "1", bumpy)
    tasks = {
        "series": lambda: build_series(series),
        "join": lambda: join_closed(series, datetime(2026, 2, 1, tzinfo=UTC), lambda: None),
        "reference": lambda: reference.write_reference(series, made),
    }
    before = {path: path.read_bytes() for path in series.folder.rglob("*") if path.is_file()}
    assert "cannot be written" in said_without_room(tasks[task])
    assert {path: path.read_bytes() for path in series.folder.rglob("*") if path.is_file()} == before


def test_what_a_killed_writer_left_is_in_nobodys_way(series, epoch):
    left = store.epoch_folder(series, datetime.fromtimestamp(epoch(1).start_s, UTC))
    left.mkdir(parents=True)
    part = left / f".hef_20251121T010000Z.nc.{os.getpid()}.part"
    part.write_bytes(b"half")
    assert store.write_epoch(series, epoch(1)).path.is_file()
    assert not part.exists()


def keep_writing(series, epoch):
    for hour in range(10_000):
        store.write_epoch(series, epoch(hour))
        build_series(series)
        if hour % 3 == 2:
            join_closed(series, datetime(2030, 1, 1, tzinfo=UTC), lambda: None)


def test_kill_at_any_moment_leaves_a_whole_series(series, epoch):
    fork = multiprocessing.get_context("fork")
    rng = np.random.default_rng(20251121)
    begun_s = time.monotonic()
    build(series, epoch, [0])
    pace_s = time.monotonic() - begun_s  # of this machine, today
    for _ in range(30):
        child = fork.Process(target=keep_writing, args=(series, epoch))
        child.start()
        time.sleep(rng.uniform(0.1, 3.0) * pace_s)
        os.kill(child.pid, signal.SIGKILL)
        child.join()
        with station.open(series.folder) as told:
            hours = (told.time.values.astype("datetime64[s]").astype(np.int64) - 450 - 1_763_683_200) / 3600
            assert np.all(np.diff(hours) > 0)
            assert told.elevation_change[:, 139, 74].values == pytest.approx(hours / 100, abs=1e-3)
    assert sum(1 for _ in series.folder.glob("**/*.nc")) > 10
    for one in store.rows(series):
        with netCDF4.Dataset(one.path) as file:
            hour = (one.time_s - 450 - 1_763_683_200) / 3600
            assert file["elevation_change"][one.index, 139, 74] == pytest.approx(hour / 100, abs=1e-3)
