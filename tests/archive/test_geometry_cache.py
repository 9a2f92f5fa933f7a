"""Cache of the viewing geometry: equal to the computed one, computed once, rebuilt if it is damaged."""

import os
import resource
import shutil

import numpy as np
import pytest

from station.archive.geometry_cache import MANIFEST, MAX_CACHED, PREFIX, cached_viewing_geometry
from station.archive.netcdf_layout import Series
from station.archive.reference_files import open_reference, version_path, write_reference
from station.errors import StoreError
from station.quantities import Grid, Reference, Scanner
from station.science.gridding.viewing_geometry import compute_viewing_geometry

GRID = Grid(west_m=0.0, north_m=900.0, cell_m=10.0, nx=60, ny=100)
POSE = ((300.0, -200.0, 150.0), (0.0, 0.0, 1.0))
VZ6000 = Scanner("vz", 1.064, 0.12e-3, 0.0, 0.010, *np.radians((0.0005, 0.008, 10.0)), 6000.0)


@pytest.fixture
def series(tmp_path):
    series = Series(folder=tmp_path, station_id="test", grid=GRID, crs=None)
    rng = np.random.default_rng(2)
    height_m = np.where(rng.uniform(size=GRID.shape) < 0.7, rng.normal(0, 3, GRID.shape), np.nan)
    write_reference(series, Reference.from_elevation(GRID, "1", height_m))
    return series


def compute(series):
    return compute_viewing_geometry(
        open_reference(series, "1"), np.zeros(GRID.shape, bool), VZ6000, POSE[0], POSE[1]
    )


class Cache:
    """The cache of a series; `computed` counts how often the geometry was computed."""

    def __init__(self, series, geometry=None):
        self.series, self.geometry, self.computed = series, geometry, 0

    def get(self, settings="a"):
        return cached_viewing_geometry(
            self.series, open_reference(self.series, "1"), POSE, settings, self._compute
        )

    def _compute(self):
        self.computed += 1
        return self.geometry or compute(self.series)

    @property
    def folders(self):
        return sorted(self.series.folder.glob(f"{PREFIX}*"))

    @property
    def files(self):
        return sorted(self.folders[0].iterdir())


@pytest.fixture
def cache(series):
    return Cache(series)


def assert_same(actual, expected):
    assert actual.datum_m == expected.datum_m
    assert actual.sampling_step == expected.sampling_step
    for name in ("height_above_datum_m", "cell_index", "sector_bounds"):
        assert np.array_equal(getattr(actual, name), getattr(expected, name), equal_nan=True), name
        assert np.asarray(getattr(actual, name)).dtype == getattr(expected, name).dtype
    assert np.array_equal(actual.cell_index[30:70], expected.cell_index[30:70])
    assert actual.cells.keys() == expected.cells.keys()
    for name, values in expected.cells.items():
        for rows in (slice(None), slice(5, 900), slice(3, None, 7), slice(9, 9)):
            assert np.array_equal(actual.cells[name][rows], values[rows], equal_nan=True), name
        assert actual.cells[name][:].dtype == values.dtype


def test_the_cache_equals_the_computed_geometry_and_is_computed_once(series, cache):
    assert_same(cache.get(), compute(series))
    assert_same(cache.get(), compute(series))
    assert cache.computed == 1
    assert len(cache.folders) == 1
    assert not list(series.folder.glob("**/*.part"))


def test_whole_arrays_are_mapped_read_only_and_slices_are_copies(cache):
    geometry = cache.get()
    whole, part = np.asarray(geometry.cell_index), geometry.cells["height_m"][10:20]
    assert isinstance(whole.base, np.memmap)
    assert not whole.flags.writeable
    part[:] = 7
    assert not (geometry.cells["height_m"][10:20] == 7).any()


def test_other_settings_and_another_reference_have_their_own_cache_and_few_are_kept(series, cache):
    for settings in "aba":
        cache.get(settings)
    assert cache.computed == 2
    write_reference(series, Reference.from_elevation(GRID, "1", np.ones(GRID.shape)))
    assert (np.asarray(cache.get("a").cell_index) >= 0).all()
    assert cache.computed == 3
    assert len(cache.folders) == MAX_CACHED


@pytest.mark.integration
def test_a_flipped_bit_or_a_truncated_file_is_detected_and_the_cache_rebuilt(series):
    expected = compute(series)
    cache = Cache(series, expected)
    cache.get()
    for number, file in enumerate(cache.files):
        content = file.read_bytes()
        index = (0, len(content) // 3, 2 * len(content) // 3, len(content) - 1)[number % 4]
        for damaged in (
            content[:index] + bytes([content[index] ^ 16]) + content[index + 1 :],
            content[:index],
        ):
            file.write_bytes(damaged)
            assert_same(cache.get(), expected)
            assert file.read_bytes() == content
    assert cache.computed == 2 * len(cache.files) + 1
    assert len(cache.folders) == 1


@pytest.mark.parametrize("name", [MANIFEST, "cell_index.npy"])
def test_an_incomplete_cache_is_rebuilt(series, cache, name):
    cache.get()
    (cache.folders[0] / name).unlink()
    assert_same(cache.get(), compute(series))
    assert cache.computed == 2
    assert (cache.folders[0] / name).is_file()


def test_geometry_stays_readable_after_another_process_deleted_its_cache(series, cache):
    geometry = cache.get()
    shutil.rmtree(cache.folders[0])
    assert_same(geometry, compute(series))


def test_two_processes_that_compute_at_the_same_time_leave_one_cache(series, cache):
    other = Cache(series)

    def compute_while_the_other_writes():
        other.get()
        return compute(series)

    geometry = cached_viewing_geometry(
        series, open_reference(series, "1"), POSE, "a", compute_while_the_other_writes
    )
    assert_same(geometry, compute(series))
    assert len(cache.folders) == 1
    assert not list(series.folder.glob("**/*.part"))
    cache.get()
    assert cache.computed == 0


def test_a_folder_left_by_a_killed_process_with_the_same_id_is_replaced(series, cache):
    cache.get()
    folder = cache.folders[0]
    tmp_folder = folder.rename(folder.with_name(f".{folder.name}.{os.getpid()}.part"))
    assert_same(cache.get(), compute(series))
    assert not tmp_folder.exists()


def test_without_disk_space_the_geometry_is_computed_each_time(series, cache):
    """Whichever file is the first that does not fit."""
    expected = compute(series)
    cache.get()
    sizes = sorted({path.stat().st_size for path in cache.files})
    shutil.rmtree(cache.folders[0])
    soft_limit, hard_limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    for limit in (0, *(size - 1 for size in sizes)):
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard_limit))
        try:
            geometry = cache.get()
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft_limit, hard_limit))
        assert_same(geometry, expected)
        assert not list(series.folder.glob(".*"))
    assert cache.computed == len(sizes) + 2
    assert version_path(series, "1").is_file()


def test_a_file_truncated_while_in_use_is_an_error_not_arbitrary_memory(cache):
    geometry = cache.get()
    path = cache.folders[0] / "height_m.npy"
    with path.open("r+b") as file:
        file.truncate(path.stat().st_size - 8)
    with pytest.raises(StoreError, match=r"height_m\.npy: truncated while in use"):
        geometry.cells["height_m"][:]
