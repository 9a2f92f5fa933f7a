"""Zarr stores of the series, read by xarray and zarr."""

import dataclasses

import netCDF4
import numpy as np
import pytest
import xarray as xr
import zarr
from support.epochs import make_epoch

import station
from station.archive import epochs
from station.archive.series.virtual import build_series
from station.errors import StationError
from station.products.area_tables import Span
from station.products.exports.formats import FORMATS
from station.products.exports.selection import pending, select, split

ALWAYS = Span.parse(None, None)
ZARR = FORMATS["zarr"]


@pytest.fixture(scope="module")
def filled(base_store):
    for hour in range(5):
        result = make_epoch(hour, terms=hour > 1)
        epochs.write_epoch(base_store, dataclasses.replace(result, verdict_reason="Schnee über Fels"))
    build_series(base_store)
    return base_store


def write(selection, out, every=None, advance=lambda _: None):
    parts = pending(selection, split(selection, out, ".zarr", every), ZARR.read_fingerprint)
    return list(ZARR.write(selection, parts, lambda _: None, advance))


@pytest.mark.parametrize("chunks", [None, "2,50,60"])
def test_every_variable_has_the_bits_of_the_series(stored, tmp_path, chunks):
    (path,) = write(select(stored, ALWAYS, chunks=chunks), tmp_path / "all.zarr")
    group = zarr.open_group(path, mode="r")
    with netCDF4.Dataset(stored.path) as file:
        file.set_auto_maskandscale(False)
        names = set(file.variables) - {"elevation_outside_reference"}
        assert set(group.array_keys()) == names | {"elevation"}
        for name, variable in ((name, file[name]) for name in names):
            actual = group[name][...]
            if variable.dtype == "S1":
                assert list(actual) == list(variable[...])
            else:
                assert np.asarray(actual).tobytes() == variable[...].tobytes(), name


def test_xarray_reads_it_like_the_series(stored, tmp_path):
    (path,) = write(select(stored, ALWAYS), tmp_path / "all.zarr")
    with xr.open_zarr(path, chunks=None) as actual, xr.open_dataset(stored.path) as expected:
        assert actual.sizes == {**expected.sizes}
        np.testing.assert_array_equal(actual.time, expected.time)
        np.testing.assert_array_equal(actual.elevation_change, expected.elevation_change)
        with station.open(stored.path) as opened:
            np.testing.assert_array_equal(actual.elevation, opened.elevation)
        assert np.isnan(actual.elevation_change[0, 0, -1])
        assert actual.elevation_change.attrs["grid_mapping"] == "crs"
        assert actual.quality.attrs["flag_masks"] == expected.quality.attrs["flag_masks"].tolist()
        assert list(actual.verdict_reason.values) == ["Schnee über Fels"] * 5


@pytest.mark.integration
def test_a_killed_export_continues_after_its_last_block(stored, tmp_path):
    done = []

    def kill(amount):
        done.append(amount)
        if len(done) == 3:
            raise KeyboardInterrupt

    selection, out = select(stored, ALWAYS), tmp_path / "all.zarr"
    with pytest.raises(KeyboardInterrupt):
        write(selection, out, advance=kill)
    assert not out.exists()
    beside = tmp_path / ".all.zarr.part"
    third = next(path for path in sorted(beside.rglob("c/0/0/0")) if path.parts[-5] == "elevation")
    inode = third.stat().st_ino
    (path,) = write(selection, out)
    assert (out / third.relative_to(beside)).stat().st_ino == inode  # not written again
    assert not beside.exists()
    assert not list(out.rglob("*.nc")) + list(out.rglob("*progress*"))
    with xr.open_zarr(path, chunks=None) as actual, station.open(stored.path) as expected:
        for name in ("elevation", "elevation_change", "quality"):
            np.testing.assert_array_equal(actual[name], expected[name])


@pytest.mark.integration
def test_a_changed_series_replaces_the_store(stored, epoch, tmp_path):
    out = tmp_path / "days"
    (path,) = write(select(stored, ALWAYS), out, "1D")
    assert write(select(stored, ALWAYS), out, "1D") == []
    epochs.write_epoch(stored, epoch(5))
    build_series(stored)
    assert write(select(stored, ALWAYS), out, "1D") == [path]
    assert zarr.open_group(path, mode="r")["time"].shape == (6,)
    assert [path.name for path in out.iterdir()] == ["hef_20251121.zarr"]


def test_a_foreign_folder_is_not_replaced(stored, tmp_path):
    (tmp_path / "mine.zarr").mkdir()
    with pytest.raises(StationError, match=r"mine\.zarr: exists and is no export"):
        write(select(stored, ALWAYS), tmp_path / "mine.zarr")
