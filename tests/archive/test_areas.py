"""The series of areas: made from the epochs, kept, appended to, made anew; and read by others."""

import dataclasses
from datetime import UTC, datetime

import h5py
import numpy as np
import pytest
import xarray as xr

from station.archive import store
from station.archive.aggregate import AreaChange
from station.archive.areas import update_areas
from station.archive.join import join_closed
from station.archive.series import build_series
from station.errors import StoreError


class Told:
    """Says of an epoch its hour in centimetres, and remembers what it was asked."""

    def __init__(self):
        self.asked = []

    def area(self, cells, row):
        self.asked.append((row.epoch_file, int(cells.sum())))
        return AreaChange(row.start.hour / 100, 0.02, row.start.hour / 50, 0.03, 0.5)


@pytest.fixture
def told():
    return Told()


@pytest.fixture
def areas(series):
    tongue, gate = np.zeros((2, *series.grid.shape), bool)
    tongue[10:20, 30:50] = True
    gate[100, 100] = True
    return {"Zunge Süd": tongue, "gate": gate}


@pytest.fixture
def update(series, areas, told):
    def update(given=None, by=told):
        if store.epochs(series):
            build_series(series)
        return update_areas(series, areas if given is None else given, by, lambda: None)

    return update


def write(series, epoch, *hours):
    return [store.write_epoch(series, epoch(hour)) for hour in hours]


def opened(path):
    with xr.open_dataset(path) as file:
        return file.load()


def test_xarray_opens_it_with_names_times_and_numbers(series, epoch, update):
    write(series, epoch, 1, 2, 3)
    file = opened(update())
    assert file.mean_change.dims == ("time", "area")
    assert file.time.values[0] == np.datetime64("2025-11-21T01:07:30")
    assert file.area_name.values.tolist() == ["Zunge Süd", "gate"]
    assert file.area_size.values.tolist() == [200 * 100.0, 100.0]
    assert file.mean_change.values.tolist() == [[0.01, 0.01], [0.02, 0.02], [0.03, 0.03]]
    assert file.volume_change.values[:, 0] == pytest.approx([200.0, 400.0, 600.0])
    assert file.mean_change_uncertainty.values == pytest.approx(0.02)
    assert file.volume_change_uncertainty.values[0] == pytest.approx([400.0, 2.0])
    assert (file.coverage == 0.5).all()
    assert file.median_change.values[:, 0].tolist() == [0.02, 0.04, 0.06]
    assert file.median_change_uncertainty.values == pytest.approx(0.03)
    assert file.mean_change_low.values[0] == pytest.approx(0.01 - 1.96 * 0.02, abs=1e-6)  # 95 % of a normal
    assert file.mean_change_high.values[0] == pytest.approx(0.01 + 1.96 * 0.02, abs=1e-6)
    assert file.median_change_high.values[1] == pytest.approx(0.04 + 1.96 * 0.03, abs=1e-5)
    assert file.volume_change_low.values[0] == pytest.approx([200 - 1.96 * 400, 1 - 1.96 * 2], abs=0.05)
    assert file.mean_change.set_xindex("area_name").sel(area_name="gate").values[1] == 0.02
    assert file.epoch_file.values[2] == "hef_20251121T030000Z.nc"
    assert file.reference_version.values.tolist() == ["1"] * 3


def test_nothing_to_do_without_areas_or_epochs(series, epoch, update, told):
    assert update() is None
    write(series, epoch, 1)
    assert update({}) is None
    assert not (series.folder / "areas.nc").exists()
    assert not told.asked


def test_twice_changes_nothing(series, epoch, update, told):
    write(series, epoch, 1, 2)
    before = update().stat()
    asked = len(told.asked)
    after = update().stat()
    assert (after.st_ino, after.st_mtime_ns, len(told.asked)) == (before.st_ino, before.st_mtime_ns, asked)


def test_only_what_is_new_is_computed_and_the_rest_kept(series, epoch, update, told):
    write(series, epoch, 1, 4)
    first = opened(update())
    told.asked.clear()
    write(series, epoch, 2)  # it came late
    file = opened(update())
    assert told.asked == [("hef_20251121T020000Z.nc", 200), ("hef_20251121T020000Z.nc", 1)]
    assert file.mean_change.values[:, 0].tolist() == [0.01, 0.02, 0.04]
    assert file.isel(time=[0, 2]).equals(first)


def test_a_new_revision_replaces_and_what_is_gone_goes(series, epoch, update, told):
    written = write(series, epoch, 1, 2, 3)
    update()
    told.asked.clear()
    write(series, epoch, 2)
    written[2].path.unlink()
    file = opened(update())
    assert {name for name, _ in told.asked} == {"hef_20251121T020000Z_r2.nc"}
    assert file.epoch_file.values.tolist() == ["hef_20251121T010000Z.nc", "hef_20251121T020000Z_r2.nc"]
    written[0].path.unlink()
    assert opened(update()).sizes["time"] == 1


def test_joining_days_computes_nothing(series, epoch, update, told):
    write(series, epoch, 1, 2, 26)
    before = opened(update())
    told.asked.clear()
    join_closed(series, datetime(2026, 2, 1, tzinfo=UTC), lambda: None)
    build_series(series)
    assert opened(update()).equals(before)
    (series.folder / "areas.nc").unlink()
    assert opened(update()).equals(before)
    assert len(told.asked) == 6


@pytest.mark.parametrize("change", ["cells", "name", "order", "more"])
def test_other_areas_are_computed_anew(series, epoch, update, areas, told, change):
    write(series, epoch, 1, 2)
    update()
    told.asked.clear()
    tongue, gate = areas.values()
    moved = np.roll(gate, 1)
    other = {
        "cells": {"Zunge Süd": tongue, "gate": moved},
        "name": {"Zunge": tongue, "gate": gate},
        "order": {"gate": gate, "Zunge Süd": tongue},
        "more": {**areas, "moved": moved},
    }[change]
    assert opened(update(other)).sizes["area"] == len(other)
    assert len(told.asked) == 2 * len(other)


def test_before_there_was_a_reference_all_is_missing(series, epoch, update, told):
    early = dataclasses.replace(epoch(1), provenance={})
    store.write_epoch(series, early)
    write(series, epoch, 2)
    file = opened(update())
    assert {name for name, _ in told.asked} == {"hef_20251121T020000Z.nc"}
    for name in ("mean_change", "mean_change_uncertainty", "median_change_low", "volume_change", "coverage"):
        assert np.isnan(file[name].values[0]).all()
        assert np.isfinite(file[name].values[1]).all()


def test_unseen_areas_and_areas_beside_the_grid(series, epoch, update, areas):
    class Blind:
        def area(self, cells, _row):
            assert cells.any()
            return AreaChange(np.nan, np.nan, np.nan, np.nan, 0.0)

    write(series, epoch, 1)
    file = opened(update({**areas, "beside": np.zeros(series.grid.shape, bool)}, by=Blind()))
    assert np.isnan(file.mean_change.values).all()
    assert np.isnan(file.volume_change_uncertainty.values).all()
    assert file.coverage.values[0, :2].tolist() == [0.0, 0.0]
    assert np.isnan(file.coverage.values[0, 2])
    assert file.area_size.values[2] == 0


def cut(path):
    path.write_bytes(path.read_bytes()[:2000])


def empty(path):
    path.write_bytes(b"")


def without_a_variable(path):
    with h5py.File(path, "r+") as file:
        del file["coverage"]


def without_its_mark(path):
    with h5py.File(path, "r+") as file:
        del file.attrs["area_masks_sha256"]


def shortened(path):
    with h5py.File(path, "r+") as file:
        file["coverage"].resize((1, 2))


@pytest.mark.parametrize("damage", [cut, empty, without_a_variable, without_its_mark, shortened])
def test_a_damaged_file_is_made_anew(series, epoch, update, damage):
    write(series, epoch, 1, 2)
    path = update()
    before = opened(path)
    damage(path)
    assert opened(update()).equals(before)


def test_an_aggregator_that_fails_leaves_the_old_file(series, epoch, update):
    class Failing:
        def area(self, _cells, _row):
            raise StoreError("damaged")

    write(series, epoch, 1)
    path = update()
    before = path.read_bytes()
    write(series, epoch, 2)
    with pytest.raises(StoreError, match="damaged"):
        update(by=Failing())
    assert path.read_bytes() == before
    assert not list(series.folder.glob("**/.*.part"))


def test_progress_after_each_epoch(series, epoch, areas, told):
    write(series, epoch, 1, 2, 3)
    build_series(series)
    steps = []
    update_areas(series, areas, told, lambda: steps.append(len(told.asked)))
    assert steps == [2, 4, 6]
