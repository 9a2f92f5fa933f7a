"""Growth of `series.nc`: appending equals rebuilding, and an epoch costs the same however long the series."""

import dataclasses
import os
from datetime import UTC, datetime

import h5py
import numpy as np
import pytest

from station.archive import areas, epochs, netcdf_layout
from station.archive.areas import AreaChange, update_areas
from station.archive.atomic_files import atomic_write
from station.archive.derived import fingerprints
from station.archive.series import epoch_reader, manifest, virtual
from station.archive.series.compaction import compact
from station.archive.series.index import SeriesIndex, list_epochs
from station.archive.series.virtual import build_series
from station.quantities import Grid, SharedParameters

SMALL_GRID = Grid(west_m=632000.0, north_m=5186000.0, cell_m=10.0, nx=6, ny=5)
TIMES_PER_CHUNK = 4  # so that a dozen epochs fill some chunks


class HourAggregator:
    """Returns the hour of an epoch in centimetres as its change."""

    def area(self, _, epoch):
        return AreaChange(epoch.start.hour / 100, 0.02, epoch.start.hour / 50, 0.03, 0.5)


@pytest.fixture(autouse=True)
def short_chunks(monkeypatch):
    for module in (netcdf_layout, virtual, areas):
        monkeypatch.setattr(module, "TIMES_PER_CHUNK", TIMES_PER_CHUNK)


@pytest.fixture
def rng():
    return np.random.default_rng(24)


@pytest.fixture
def growing(series):
    """A store on a small grid, and a function that updates series.nc and areas.nc."""
    small = dataclasses.replace(series, grid=SMALL_GRID)
    masks = {"all": np.ones(SMALL_GRID.shape, bool), "none": np.zeros(SMALL_GRID.shape, bool)}

    def update():
        build_series(small)
        update_areas(small, masks, HourAggregator(), lambda: None)

    return small, update


WHEN_WRITTEN = {"_NCProperties", "date_created", "history"}


def file_contents(path):
    """Return values, types, chunks, attributes and virtual sources of all variables of a file."""
    with h5py.File(path) as file:
        attributes = {key: str(value) for key, value in file.attrs.items() if key not in WHEN_WRITTEN}
        return {name: describe(dataset) for name, dataset in file.items()} | {"attributes": attributes}


def describe(dataset):
    attributes = {
        key: str(value)
        for key, value in dataset.attrs.items()
        if key not in {"DIMENSION_LIST", "REFERENCE_LIST"}
    }
    sources = [
        (
            source.file_name,
            source.dset_name,
            source.vspace.get_select_bounds(),
            source.src_space.get_select_bounds(),
        )
        for source in (dataset.virtual_sources() if dataset.is_virtual else ())
    ]
    values = dataset[...].tobytes() if dataset.shape is not None else None
    return values, dataset.dtype.str, dataset.shape, dataset.chunks, attributes, sources


def contents(series):
    return [file_contents(series.folder / name) for name in ("series.nc", "processing.nc", "areas.nc")]


def rebuild(series, update):
    (series.folder / manifest.MANIFEST).unlink()
    (series.folder / "areas.nc").unlink()
    update()


def parameters(names, units, covariance):
    return SharedParameters(names, units, np.ones(len(names)), covariance, np.zeros(len(names)))


@pytest.mark.integration
def test_appending_equals_rebuilding(growing, epoch):
    """After epochs in order, late ones, revisions, other shared parameters, and compaction."""
    series, update = growing
    relocated = parameters(("tilt_north", "heading"), ("rad", "rad"), np.eye(2))
    fewer = parameters(("range_bias", "tilt_east"), ("m", "rad"), 3 * np.eye(2))
    steps = [
        *((hour, {}) for hour in (1, 2, 3, 4, 5, 8, 9, 10, 11)),
        (7, {}),  # arrives late
        (5, {"scan_id": "again"}),  # a second revision
        (25, {}),
        (30, {"shared": fewer}),
        (31, {}),
        (50, {"shared": relocated}),
        (51, {"shared": None}),
        (52, {}),
    ]
    compact_after = {25: datetime(2025, 11, 22, 12, tzinfo=UTC), 52: datetime(2025, 12, 4, tzinfo=UTC)}
    for hour, changes in steps:
        epochs.write_epoch(series, dataclasses.replace(epoch(hour, grid=SMALL_GRID), **changes))
        update()
        if hour in compact_after:
            assert len(compact(series, compact_after[hour], lambda: None)) == (hour == 25)
            update()
        appended = contents(series)
        rebuild(series, update)
        assert contents(series) == appended, hour
    assert list(SeriesIndex(series)) == list_epochs(series)
    assert len(SeriesIndex(series)) == 16


def flip_bits(path, generator, count=1):
    content = bytearray(path.read_bytes())
    for position in generator.integers(0, len(content), count):
        content[position] ^= 1 << int(generator.integers(0, 8))
    path.write_bytes(content)


def overwrite(path, content):
    path.write_bytes(content)


def replace_by_folder(path):
    path.unlink()
    path.mkdir()


DAMAGES = {
    "empty": lambda path, _: overwrite(path, b""),
    "halved": lambda path, _: overwrite(path, path.read_bytes()[: path.stat().st_size // 2]),
    "garbage": lambda path, _: overwrite(path, b"\x93garbage" * 1000),
    "one bit": flip_bits,
    "many bits": lambda path, generator: flip_bits(path, generator, 100),
    "lost": lambda path, _: path.unlink(),
    "a folder": lambda path, _: replace_by_folder(path),
}


@pytest.mark.parametrize("kind", ["empty", "one bit", "a folder"])
@pytest.mark.integration
def test_damaged_derived_files_are_rebuilt(growing, epoch, rng, kind):
    series, update = growing
    epochs.write_epoch(series, epoch(1, grid=SMALL_GRID))
    update()
    expected = contents(series)
    for name in ("series.nc", "processing.nc", "areas.nc"):
        DAMAGES[kind](series.folder / name, rng)
    update()
    assert contents(series) == expected


@pytest.mark.integration
@pytest.mark.parametrize("name", ["series.nc", "processing.nc", "areas.nc", manifest.MANIFEST, ".areas.json"])
def test_damaged_derived_files_are_rebuilt_with_the_next_epoch(growing, epoch, rng, name):
    series, update = growing
    for hour in range(5):
        epochs.write_epoch(series, epoch(hour, grid=SMALL_GRID))
    update()
    for hour, damage in enumerate(DAMAGES.values(), start=5):
        damage(series.folder / name, rng)
        epochs.write_epoch(series, epoch(hour, grid=SMALL_GRID))
        update()
        actual = contents(series)
        rebuild(series, update)
        assert actual == contents(series)
        assert manifest.is_intact(series)
        assert fingerprints.is_intact(series.folder / "areas.nc")


@pytest.mark.parametrize("name", ["series.nc", "processing.nc"])
@pytest.mark.integration
def test_file_damaged_while_it_was_written_is_rebuilt_with_the_next_epoch(growing, epoch, rng, name):
    """Its fingerprint is that of the damaged file."""
    series, update = growing
    epochs.write_epoch(series, epoch(1, grid=SMALL_GRID))
    update()
    known, _ = manifest.pending_epochs(series)
    DAMAGES["halved"](series.folder / name, rng)
    manifest.write_manifest(series, known)
    assert manifest.is_intact(series)
    epochs.write_epoch(series, epoch(2, grid=SMALL_GRID))
    update()
    assert len(SeriesIndex(series)) == 2


@pytest.mark.integration
def test_any_flipped_bit_is_noticed(growing, epoch, rng):
    series, update = growing
    epochs.write_epoch(series, epoch(1, grid=SMALL_GRID))
    update()
    intact = {
        name: (series.folder / name).read_bytes() for name in ("series.nc", "processing.nc", "areas.nc")
    }
    for _ in range(100):
        for name, content in intact.items():
            flip_bits(series.folder / name, rng)
            assert not (manifest.is_intact(series) and fingerprints.is_intact(series.folder / "areas.nc")), (
                name
            )
            (series.folder / name).write_bytes(content)
    assert manifest.is_intact(series)
    assert fingerprints.is_intact(series.folder / "areas.nc")


@pytest.mark.integration
def test_only_the_new_epoch_of_a_long_series_is_opened(growing, epoch, monkeypatch):
    series, update = growing
    opened = []
    read_source = epoch_reader.read_source
    for module in (virtual, manifest, areas):
        monkeypatch.setattr(
            module, "read_source", lambda path, *rest: opened.append(path.name) or read_source(path, *rest)
        )
    monkeypatch.setattr(
        virtual, "list_epochs", lambda series: opened.append("all epochs") or list_epochs(series)
    )
    for hour in range(1, 14):
        opened.clear()
        written = epochs.write_epoch(series, epoch(hour, grid=SMALL_GRID))
        update()
        if hour > 1:
            assert set(opened) == {written.path.name, "series.nc", "processing.nc"}
    opened.clear()
    update()
    assert not opened


@pytest.mark.integration
def test_a_kill_between_the_two_files_is_repaired(growing, epoch, monkeypatch):
    series, update = growing
    epochs.write_epoch(series, epoch(1, grid=SMALL_GRID))
    update()
    epochs.write_epoch(series, epoch(2, grid=SMALL_GRID))

    def killed(path):
        if path == series.path:
            raise KeyboardInterrupt
        return atomic_write(path)

    with monkeypatch.context() as killing:
        killing.setattr(virtual, "atomic_write", killed)
        with pytest.raises(KeyboardInterrupt):
            build_series(series)
    with h5py.File(series.processing_path) as processing, h5py.File(series.path) as results:
        assert (len(processing["scan_id"]), len(results["scan_id"])) == (2, 1)
    assert not manifest.is_intact(series)
    build_series(series)
    assert manifest.is_intact(series)
    with h5py.File(series.processing_path) as processing, h5py.File(series.path) as results:
        assert (processing["scan_id"][:] == results["scan_id"][:]).all()
        assert len(results["scan_id"]) == 2


@pytest.mark.integration
def test_a_file_replaced_under_its_name_is_read_again(growing, epoch):
    """For example, an operator restores an older copy."""
    series, update = growing
    for hour in (1, 2, 3):
        written = epochs.write_epoch(series, epoch(hour, grid=SMALL_GRID))
        update()
    original = written.path.read_bytes()
    with h5py.File(written.path, "r+") as file:
        file["platform_roll"][0] = 7.0
    modified = written.path.read_bytes()
    for file_bytes, roll in ((modified, 7.0), (original, 0.12)):
        written.path.unlink()
        written.path.write_bytes(file_bytes)
        update()
        with h5py.File(series.processing_path) as file:
            assert file["platform_roll"][:].tolist() == [0.12, 0.12, roll]


@pytest.mark.parametrize(
    "text",
    [
        b"{}",
        None,
        pytest.param(b"", marks=pytest.mark.integration),
        pytest.param(b'{"header_hash": 1}', marks=pytest.mark.integration),
    ],
)
def test_with_an_invalid_manifest_the_series_is_rebuilt(growing, epoch, text):
    series, update = growing
    epochs.write_epoch(series, epoch(1, grid=SMALL_GRID))
    update()
    first = contents(series)
    path = series.folder / manifest.MANIFEST
    if text is None:
        os.utime(series.path)
    else:
        path.write_bytes(text)
    epochs.write_epoch(series, epoch(2, grid=SMALL_GRID))
    update()
    assert contents(series) != first
    assert len(SeriesIndex(series)) == 2


def test_changed_metadata_of_the_station_is_written_to_the_series(growing, epoch):
    series, update = growing
    epochs.write_epoch(series, epoch(1, grid=SMALL_GRID))
    update()
    build_series(dataclasses.replace(series, name="Kesselwandferner"))
    with h5py.File(series.path) as file:
        assert file.attrs["station_name"] == b"Kesselwandferner"


@pytest.mark.integration
def test_the_index_is_current_until_a_file_is_added_or_removed(growing, epoch):
    series, update = growing
    assert manifest.index_if_current(series) is None
    for hour in (1, 2):
        written = epochs.write_epoch(series, epoch(hour, grid=SMALL_GRID))
        assert manifest.index_if_current(series) is None
        update()
        assert list(manifest.index_if_current(series)) == list_epochs(series)
    os.utime(written.path)
    assert manifest.index_if_current(series) is None
    update()
    assert len(manifest.index_if_current(series)) == 2
    written.path.unlink()
    assert manifest.index_if_current(series) is None
