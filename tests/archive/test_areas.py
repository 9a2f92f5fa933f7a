"""`areas.nc`: computed from the epochs, extended, recomputed if the areas change, rebuilt if damaged."""

import dataclasses
from datetime import UTC, datetime

import h5py
import numpy as np
import pytest
import shapely
import xarray as xr

from station.archive import epochs
from station.archive.areas import AreaChange, area_polygons, update_areas
from station.archive.series.compaction import compact
from station.archive.series.virtual import build_series
from station.errors import StoreError


class HourAggregator:
    """Returns the hour of an epoch in centimetres as its change; records file and cells of each call."""

    def __init__(self):
        self.calls = []

    def area(self, cells, epoch):
        self.calls.append((epoch.epoch_file, int(cells.sum())))
        return AreaChange(epoch.start.hour / 100, 0.02, epoch.start.hour / 50, 0.03, 0.5)


@pytest.fixture
def aggregator():
    return HourAggregator()


@pytest.fixture
def areas(series):
    tongue, gate = np.zeros((2, *series.grid.shape), bool)
    tongue[10:20, 30:50] = True
    gate[100, 100] = True
    return {"Zunge Süd": tongue, "gate": gate}


@pytest.fixture
def update(series, areas, aggregator):
    def update(masks=areas, by=aggregator):
        if epochs.epoch_files(series):
            build_series(series)
        return update_areas(series, masks, by, lambda: None)

    return update


def write(series, epoch, *hours):
    return [epochs.write_epoch(series, epoch(hour)) for hour in hours]


def read(path):
    with xr.open_dataset(path) as file:
        return file.load()


def test_xarray_reads_names_times_changes_and_confidence_bounds(series, epoch, update):
    write(series, epoch, 1, 2, 3)
    file = read(update())
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


def test_no_file_is_written_without_areas_or_epochs(series, epoch, update, aggregator):
    assert update() is None
    write(series, epoch, 1)
    assert update({}) is None
    assert not (series.folder / "areas.nc").exists()
    assert not aggregator.calls


def test_a_second_update_changes_nothing(series, epoch, update, aggregator):
    write(series, epoch, 1, 2)
    first = update().stat()
    aggregator.calls.clear()
    second = update().stat()
    assert (second.st_ino, second.st_mtime_ns) == (first.st_ino, first.st_mtime_ns)
    assert not aggregator.calls


def test_only_new_epochs_are_computed(series, epoch, update, aggregator):
    write(series, epoch, 1, 4)
    first = read(update())
    aggregator.calls.clear()
    write(series, epoch, 2)  # arrives late
    file = read(update())
    assert aggregator.calls == [("hef_20251121T020000Z.nc", 200), ("hef_20251121T020000Z.nc", 1)]
    assert file.mean_change.values[:, 0].tolist() == [0.01, 0.02, 0.04]
    assert file.isel(time=[0, 2]).equals(first)


@pytest.mark.integration
def test_a_new_revision_replaces_its_epoch_and_a_deleted_epoch_is_removed(series, epoch, update, aggregator):
    written = write(series, epoch, 1, 2, 3)
    update()
    aggregator.calls.clear()
    write(series, epoch, 2)
    written[2].path.unlink()
    file = read(update())
    assert {name for name, _ in aggregator.calls} == {"hef_20251121T020000Z_r2.nc"}
    assert file.epoch_file.values.tolist() == ["hef_20251121T010000Z.nc", "hef_20251121T020000Z_r2.nc"]
    written[0].path.unlink()
    assert read(update()).sizes["time"] == 1


@pytest.mark.integration
def test_compaction_recomputes_nothing(series, epoch, update, aggregator):
    write(series, epoch, 1, 2, 26)
    expected = read(update())
    aggregator.calls.clear()
    compact(series, datetime(2026, 2, 1, tzinfo=UTC), lambda: None)
    build_series(series)
    assert read(update()).equals(expected)
    assert not aggregator.calls
    (series.folder / "areas.nc").unlink()
    assert read(update()).equals(expected)
    assert len(aggregator.calls) == 6


@pytest.mark.parametrize(
    "change",
    ["cells", *(pytest.param(name, marks=pytest.mark.integration) for name in ("name", "order", "more"))],
)
def test_changed_areas_are_computed_again(series, epoch, update, areas, aggregator, change):
    write(series, epoch, 1, 2)
    update()
    aggregator.calls.clear()
    tongue, gate = areas.values()
    shifted = np.roll(gate, 1)
    other = {
        "cells": {"Zunge Süd": tongue, "gate": shifted},
        "name": {"Zunge": tongue, "gate": gate},
        "order": {"gate": gate, "Zunge Süd": tongue},
        "more": {**areas, "shifted": shifted},
    }[change]
    assert read(update(other)).sizes["area"] == len(other)
    assert len(aggregator.calls) == 2 * len(other)


def test_an_epoch_without_a_reference_has_missing_values(series, epoch, update, aggregator):
    early = dataclasses.replace(epoch(1), provenance={})
    epochs.write_epoch(series, early)
    write(series, epoch, 2)
    file = read(update())
    assert {name for name, _ in aggregator.calls} == {"hef_20251121T020000Z.nc"}
    for name in ("mean_change", "mean_change_uncertainty", "median_change_low", "volume_change", "coverage"):
        assert np.isnan(file[name].values[0]).all()
        assert np.isfinite(file[name].values[1]).all()


def test_unobserved_areas_and_areas_outside_the_grid_have_missing_values(series, epoch, update, areas):
    class Blind:
        def area(self, cells, _epoch):
            assert cells.any()
            return AreaChange(np.nan, np.nan, np.nan, np.nan, 0.0)

    write(series, epoch, 1)
    file = read(update({**areas, "outside": np.zeros(series.grid.shape, bool)}, by=Blind()))
    assert np.isnan(file.mean_change.values).all()
    assert np.isnan(file.volume_change_uncertainty.values).all()
    assert file.coverage.values[0, :2].tolist() == [0.0, 0.0]
    assert np.isnan(file.coverage.values[0, 2])
    assert file.area_size.values[2] == 0


def truncate(path):
    path.write_bytes(path.read_bytes()[:2000])


def empty(path):
    path.write_bytes(b"")


def without_a_variable(path):
    with h5py.File(path, "r+") as file:
        del file["coverage"]


def without_its_hash(path):
    with h5py.File(path, "r+") as file:
        del file.attrs["area_masks_sha256"]


def shortened(path):
    with h5py.File(path, "r+") as file:
        file["coverage"].resize((1, 2))


@pytest.mark.parametrize(
    "damage",
    [
        truncate,
        shortened,
        *(
            pytest.param(damage, marks=pytest.mark.integration)
            for damage in (empty, without_a_variable, without_its_hash)
        ),
    ],
)
def test_a_damaged_file_is_rebuilt(series, epoch, update, damage):
    write(series, epoch, 1, 2)
    path = update()
    expected = read(path)
    damage(path)
    assert read(update()).equals(expected)


@pytest.mark.integration
def test_a_failed_update_leaves_the_old_file(series, epoch, update):
    class Failing:
        def area(self, _cells, _epoch):
            raise StoreError("damaged")

    write(series, epoch, 1)
    path = update()
    original = path.read_bytes()
    write(series, epoch, 2)
    with pytest.raises(StoreError, match="damaged"):
        update(by=Failing())
    assert path.read_bytes() == original
    assert not list(series.folder.glob("**/.*.part"))


def test_progress_is_called_after_each_epoch(series, epoch, areas, aggregator):
    write(series, epoch, 1, 2, 3)
    build_series(series)
    steps = []
    update_areas(series, areas, aggregator, lambda: steps.append(len(aggregator.calls)))
    assert steps == [2, 4, 6]


def test_outlines_are_stored_as_rings(series, epoch, areas, aggregator):
    """The rings are put together here from the arrays, as CF 7.5 defines them."""
    outer, hole = shapely.box(0, 0, 9, 9), shapely.box(2, 2, 3, 4)
    outlines = {"Zunge Süd": shapely.MultiPolygon([outer - hole, shapely.box(20, 0, 21, 1)]), "gate": outer}
    write(series, epoch, 1)
    build_series(series)
    path = update_areas(series, areas, aggregator, lambda: None)
    calls = len(aggregator.calls)
    update_areas(series, areas, aggregator, lambda: None, outlines)
    assert len(aggregator.calls) == calls  # the change is not computed again
    stored = read(path)
    container = stored[stored.mean_change.attrs["geometry"]].attrs
    x, y = (stored[name].values for name in container["node_coordinates"].split())
    ends = np.cumsum(stored[container["part_node_count"]].values)
    rings = [shapely.LinearRing(ring) for ring in np.split(np.stack([x, y], axis=-1), ends[:-1])]
    is_hole = stored[container["interior_ring"]].values.astype(bool)
    assert is_hole.tolist() == [False, True, False, False]
    assert [ring.is_ccw for ring in rings] == (~is_hole).tolist()
    assert [shapely.Polygon(ring).area for ring in rings] == [81, 2, 1, 81]
    assert stored[container["node_count"]].values.tolist() == [15, 5]
    assert all(area_polygons(series)[name].equals(shape) for name, shape in outlines.items())
    assert (stored.attrs["featureType"], stored.area_name.attrs["cf_role"]) == ("timeSeries", "timeseries_id")
    moved = outlines | {"gate": shapely.box(1, 1, 9, 9)}
    update_areas(series, areas, aggregator, lambda: None, moved)
    assert area_polygons(series)["gate"].area == 64
