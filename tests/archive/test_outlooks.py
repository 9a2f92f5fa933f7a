"""What the scanner looks at, kept as a file: the same as made, and never in the way."""

import resource

import numpy as np
import pytest

from station.archive import outlooks
from station.archive.layout import Series
from station.archive.outlooks import KEPT, kept_outlook
from station.archive.reference import open_reference, path_of, write_reference
from station.errors import StoreError
from station.quantities import Grid, Reference, Scanner
from station.science.outlook import look

GRID = Grid(west_m=0.0, north_m=900.0, cell_m=10.0, nx=60, ny=300)
PLACE = ((300.0, -200.0, 150.0), (0.0, 0.0, 1.0))
VZ6000 = Scanner("vz", 1.064, 0.12e-3, 0.0, 0.010, *np.radians((0.0005, 0.008, 10.0)), 6000.0)


@pytest.fixture
def series(tmp_path):
    series = Series(folder=tmp_path, station_id="test", grid=GRID, crs=None)
    rng = np.random.default_rng(2)
    height_m = np.where(rng.uniform(size=GRID.shape) < 0.7, rng.normal(0, 3, GRID.shape), np.nan)
    write_reference(series, Reference.given(GRID, "1", height_m))
    return series


def made(series, calls):
    reference = open_reference(series, "1")

    def one():
        calls.append(1)
        return look(reference, np.zeros(GRID.shape, bool), VZ6000, PLACE[0])

    return lambda made_with="a": kept_outlook(series, reference, PLACE, made_with, one)


def files(series):
    return sorted(series.folder.glob(".outlook-*"))


def same(one, other):
    assert np.array_equal(one.ground().rise_m, other.ground().rise_m)
    assert np.array_equal(one.ground().number, other.ground().number)
    for (first, told), (wanted_first, wanted) in zip(one.sectors(), other.sectors(), strict=True):
        assert first == wanted_first
        for name in vars(wanted):
            assert np.array_equal(getattr(told, name), getattr(wanted, name), equal_nan=True), name
    for name, values in other.cells.items():
        assert np.array_equal(one.cells[name][::7], values[::7], equal_nan=True)
    assert np.array_equal(one.number[100:170], other.number[100:170])


def test_what_is_kept_is_what_was_made_and_is_made_once(series):
    calls = []
    get = made(series, calls)
    kept = get()
    same(get(), look(open_reference(series, "1"), np.zeros(GRID.shape, bool), VZ6000, PLACE[0]))
    same(kept, get())
    assert len(calls) == 1
    assert len(files(series)) == 1


@pytest.mark.parametrize("name", ["DENSE", "CELLS"])
def test_arrays_in_another_order_are_another_outlook(series, monkeypatch, name):
    calls = []
    get = made(series, calls)
    get()
    turned = dict(reversed(getattr(outlooks, name).items()))
    monkeypatch.setattr(outlooks, name, turned)
    same(get(), look(open_reference(series, "1"), np.zeros(GRID.shape, bool), VZ6000, PLACE[0]))
    assert len(calls) == 2


def test_other_settings_or_another_reference_are_another_outlook_and_few_are_kept(series):
    calls = []
    get = made(series, calls)
    get("a"), get("b"), get("a")
    assert len(calls) == 2
    write_reference(series, Reference.given(GRID, "1", np.ones(GRID.shape)))
    changed = made(series, calls)("a")
    assert (changed.number[:] >= 0).all()
    assert len(calls) == 3
    assert len(files(series)) == KEPT


@pytest.mark.parametrize("place", [0.01, 0.3, 0.7, 0.95])
def test_a_damaged_one_is_told_deleted_and_made_anew(series, place):
    calls = []
    get = made(series, calls)
    whole = look(open_reference(series, "1"), np.zeros(GRID.shape, bool), VZ6000, PLACE[0])
    get()
    (path,) = files(series)
    held = bytearray(path.read_bytes())
    held[int(place * len(held))] ^= 16
    path.write_bytes(held)
    with pytest.raises(StoreError, match="made anew"):
        same(get(), whole)
    assert files(series) == []
    get()
    assert len(calls) == 2
    (path,) = files(series)
    path.write_bytes(held[: int(place * len(held))])
    with pytest.raises(StoreError, match="made anew"):
        same(get(), whole)
    assert files(series) == []


def test_one_that_another_process_lets_go_stays_readable(series):
    kept = made(series, [])()
    files(series)[0].unlink()
    same(kept, look(open_reference(series, "1"), np.zeros(GRID.shape, bool), VZ6000, PLACE[0]))


def test_where_there_is_no_room_it_is_made_each_time(series):
    """However far its file gets."""
    calls = []
    get = made(series, calls)
    wanted = get()
    (kept,) = files(series)
    whole = kept.stat().st_size
    kept.unlink()
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    for size in (0, 2000, *range(whole // 8, whole, whole // 8), whole - 1):
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
        try:
            found = get()
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
        same(found, wanted)
        assert files(series) == []
    assert len(calls) == 12
    assert path_of(series, "1").is_file()
