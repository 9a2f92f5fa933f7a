"""A series that grows: what is added to it is what one made anew holds, and costs what the first cost."""

import dataclasses
import os
from datetime import UTC, datetime

import h5py
import numpy as np
import pytest

from station.archive import areas, layout, made, sources, store
from station.archive import series as building
from station.archive.aggregate import AreaChange
from station.archive.areas import update_areas
from station.archive.join import join_closed
from station.archive.series import build_series
from station.archive.store import Named, rows
from station.quantities import Grid, Shared

SMALL = Grid(west_m=632000.0, north_m=5186000.0, cell_m=10.0, nx=6, ny=5)
TOGETHER = 4  # epochs of a chunk, so that a dozen fill some


class Told:
    """Says of an epoch its hour in centimetres."""

    def area(self, _, row):
        return AreaChange(row.start.hour / 100, 0.02, row.start.hour / 50, 0.03, 0.5)


@pytest.fixture(autouse=True)
def short_chunks(monkeypatch):
    for module in (layout, building, areas):
        monkeypatch.setattr(module, "TIMES_TOGETHER", TOGETHER)


@pytest.fixture
def grown(series):
    """A small store, and what brings it up to its epochs."""
    small = dataclasses.replace(series, grid=SMALL)
    given = {"all": np.ones(SMALL.shape, bool), "none": np.zeros(SMALL.shape, bool)}

    def update():
        build_series(small)
        update_areas(small, given, Told(), lambda: None)

    return small, update


def content(path):
    """Everything in a file: values, types, chunks, attributes, what is virtual of what."""
    with h5py.File(path) as file:
        told = {name: described(one) for name, one in file.items()}
        return told | {"attributes": {k: str(v) for k, v in file.attrs.items() if k != "_NCProperties"}}


def described(one):
    attributes = {k: str(v) for k, v in one.attrs.items() if k not in {"DIMENSION_LIST", "REFERENCE_LIST"}}
    parts = [
        (part.file_name, part.dset_name, part.vspace.get_select_bounds(), part.src_space.get_select_bounds())
        for part in (one.virtual_sources() if one.is_virtual else ())
    ]
    values = one[...].tobytes() if one.shape is not None else None
    return values, one.dtype.str, one.shape, one.chunks, attributes, parts


def contents(series):
    return [content(series.folder / name) for name in ("series.nc", "areas.nc")]


def test_what_is_added_is_what_is_made_anew(grown, epoch):
    series, update = grown
    elsewhere = Shared(("tilt_north", "heading"), ("rad",) * 2, np.ones(2), np.eye(2), np.zeros(2))
    fewer = Shared(("range_bias", "tilt_east"), ("m", "rad"), np.ones(2), np.eye(2) * 3, np.zeros(2))
    steps = [
        *((hour, {}) for hour in (1, 2, 3, 4, 5, 8, 9, 10, 11)),
        (7, {}),  # it came late
        (5, {"scan_id": "again"}),
        (25, {}),
        (30, {"shared": fewer}),
        (31, {}),
        (50, {"shared": elsewhere}),
        (51, {"shared": None}),
        (52, {}),
    ]
    join_after = {25: datetime(2025, 11, 22, 12, tzinfo=UTC), 52: datetime(2025, 12, 4, tzinfo=UTC)}
    for hour, changes in steps:
        store.write_epoch(series, dataclasses.replace(epoch(hour, grid=SMALL), **changes))
        update()
        if hour in join_after:
            assert len(join_closed(series, join_after[hour], lambda: None)) == (hour == 25)
            update()
        told = contents(series)
        (series.folder / made.NOTE).unlink()
        (series.folder / "areas.nc").unlink()
        update()
        assert contents(series) == told, hour
    assert list(Named(series)) == rows(series)
    assert len(Named(series)) == 16


def test_of_a_long_series_only_the_new_epoch_is_opened(grown, epoch, monkeypatch):
    series, update = grown
    opened = []
    read = sources.read_source
    for module in (building, made, areas):
        monkeypatch.setattr(
            module, "read_source", lambda path, *rest: opened.append(path.name) or read(path, *rest)
        )
    monkeypatch.setattr(
        building, "rows", lambda series, found=rows: opened.append("all of them") or found(series)
    )
    for hour in range(1, 14):
        opened.clear()
        written = store.write_epoch(series, epoch(hour, grid=SMALL))
        update()
        if hour > 1:
            assert set(opened) == {written.path.name, "series.nc"}
    opened.clear()
    update()
    assert not opened


def test_a_file_that_is_another_under_its_name_is_read(grown, epoch):
    """As when a person puts back an older copy."""
    series, update = grown
    for hour in (1, 2, 3):
        written = store.write_epoch(series, epoch(hour, grid=SMALL))
        update()
    given = written.path.read_bytes()
    with h5py.File(written.path, "r+") as file:
        file["platform_roll"][0] = 7.0
    changed = written.path.read_bytes()
    for content_now, roll in ((changed, 7.0), (given, 0.12)):
        written.path.unlink()
        written.path.write_bytes(content_now)
        update()
        with h5py.File(series.path) as file:
            assert file["platform_roll"][:].tolist() == [0.12, 0.12, roll]


@pytest.mark.parametrize("note", [b"", b"{}", b'{"of": 1}', None])
def test_without_the_note_the_series_is_made_anew(grown, epoch, note):
    series, update = grown
    store.write_epoch(series, epoch(1, grid=SMALL))
    update()
    before = contents(series)
    path = series.folder / made.NOTE
    if note is None:
        os.utime(series.path)
    else:
        path.write_bytes(note)
    store.write_epoch(series, epoch(2, grid=SMALL))
    update()
    assert contents(series) != before
    assert len(Named(series)) == 2


def test_what_else_a_series_says_is_brought_up_too(grown, epoch):
    series, update = grown
    store.write_epoch(series, epoch(1, grid=SMALL))
    update()
    build_series(dataclasses.replace(series, name="Kesselwandferner"))
    with h5py.File(series.path) as file:
        assert file.attrs["station_name"] == b"Kesselwandferner"


def test_a_store_is_settled_until_a_file_comes_or_goes(grown, epoch):
    series, update = grown
    assert made.settled(series) is None
    for hour in (1, 2):
        written = store.write_epoch(series, epoch(hour, grid=SMALL))
        assert made.settled(series) is None
        update()
        assert list(made.settled(series)) == rows(series)
    os.utime(written.path)
    assert made.settled(series) is None
    update()
    assert len(made.settled(series)) == 2
    written.path.unlink()
    assert made.settled(series) is None


@pytest.mark.slow
def test_what_follows_a_scan_costs_little_more_after_a_year(tmp_path, monkeypatch):
    """Fifteen times as many epochs, about the same CPU; measuring, which does not grow, is apart."""
    from benchmarks import growth

    monkeypatch.undo()
    taken = []
    for epochs in (600, 8760):
        site = growth.station_of(tmp_path / str(epochs), growth.SMALL)
        told = growth.cost(site, growth.fill(site, epochs))
        taken.append(told["publish_s"] + told["show_s"])
    assert taken[1] < 1.35 * taken[0]
