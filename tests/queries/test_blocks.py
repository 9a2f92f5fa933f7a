"""Files of blocks: σ against the propagation over all their cells, and how the files grow."""

import shutil
from contextlib import ExitStack
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from support.epochs import START_S, random_epoch
from support.series import copied
from support.shared_parameters import SCANNER, random_shared

import station
from station.archive import epochs
from station.archive.derived.computed_rasters import CHANGE, RANDOM
from station.archive.derived.fingerprints import is_intact, write_fingerprints
from station.archive.netcdf_layout import Series
from station.archive.reference_files import write_reference
from station.archive.schema import FILL
from station.archive.series.index import SeriesIndex, list_epochs
from station.archive.series.virtual import build_series
from station.quantities import Grid, Quality, Reference
from station.queries import block_sums
from station.queries.block_sums import (
    FOLDER,
    EpochSummer,
    block_levels,
    keep_epoch_sums,
    precise_levels,
)
from station.queries.blocks import BlockQueries, update_boxes

GRID = Grid(
    west_m=632_000.0, north_m=5_186_000.0, cell_m=2.0, nx=130, ny=90
)  # the boxes at the edges are cut
HOURS = (1, 5, 20, 26, 30)
REFERENCE_M = 0.01
RANDOM_M = 0.05


def make_epoch(hour, *, verdict="good"):
    unseen = np.zeros(GRID.shape, bool)
    unseen[60:, :40] = True
    return random_epoch(
        hour,
        GRID,
        np.full(GRID.shape, RANDOM_M),
        unseen=unseen,
        quality=np.where(GRID.x_m[None, :] < 632_100, int(Quality.STABLE_GROUND), 0),
        scatter_m=0.05,
        shared=random_shared(hour, GRID),
        verdict=verdict,
        scalars=SCANNER,
        provenance={"adjustment": "joint", "reference_version": "1"},
    )


def reference():
    """Rough terrain with a slope of 20 to 40 %."""
    x_m, y_m = GRID.x_m[None, :] - GRID.west_m, GRID.y_m[:, None] - GRID.north_m
    elevation_m = 2800 + 0.3 * x_m - 0.2 * y_m + 4 * np.sin(x_m / 15) * np.cos(y_m / 20)
    surface = Reference.from_elevation(GRID, "1", elevation_m)
    return replace(surface, random_variance_m2=np.full(GRID.shape, REFERENCE_M**2, np.float32))


@pytest.fixture(scope="module", autouse=True)
def ten_metres():
    """Blocks of 5 × 5 cells, as on a larger grid of such cells."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(block_sums, "MOST_SMALL_BLOCKS", 500)
        yield


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    series = Series(tmp_path_factory.mktemp("store"), "hef", GRID, "EPSG:32632")
    write_reference(series, reference())
    for hour in HOURS:
        epochs.write_epoch(series, make_epoch(hour))
    build_series(series)
    update_boxes(series, BlockQueries(series), lambda: None)
    return series


@pytest.fixture
def stored(base, tmp_path):
    return copied(base, tmp_path / "store")


def read(series, name):
    with xr.open_dataset(series.folder / name) as ds:
        return ds.load()


def box_mask(row, column, cells):
    mask = np.zeros(GRID.shape, bool)
    mask[row * cells : (row + 1) * cells, column * cells : (column + 1) * cells] = True
    return mask


@pytest.mark.parametrize("index", [0, 4])
def test_boxes_have_the_sigma_of_the_mean_of_their_cells(base, index):
    boxes, changes = read(base, "boxes.nc"), station.open(base.folder).elevation_change[index].values
    assert (boxes.sizes["y"], boxes.sizes["x"]) == (2, 3)
    assert (boxes.x[1] - boxes.x[0], boxes.y[0] - boxes.y[1]) == (100, 100)
    for row in range(2):
        for column in range(3):
            mask, box = box_mask(row, column, 50), boxes.isel(time=index, y=row, x=column)
            observed = np.isfinite(changes[mask])
            assert box.elevation_change == pytest.approx(np.nanmean(changes[mask]), abs=1e-4)
            assert box.coverage == pytest.approx(observed.sum() / 2500, abs=1e-3)
            exact_m = station.variance(base.folder, mask, index) ** 0.5
            assert exact_m > 2 * RANDOM_M / np.sqrt(observed.sum())  # shared errors dominate
            assert box.elevation_change_uncertainty == pytest.approx(exact_m, rel=0.01)
            assert box.elevation_change_random_uncertainty == pytest.approx(
                RANDOM_M / np.sqrt(observed.sum()), rel=0.02
            )


def days(series):
    """Return the files in `blocks/` and what they contain."""
    paths = sorted((series.folder / "blocks").glob("*/*.nc"))
    with ExitStack() as stack:
        return paths, [stack.enter_context(xr.open_dataset(path)).load() for path in paths]


@pytest.mark.parametrize("index", [0, 4])
def test_a_block_of_an_epoch_has_the_sigma_of_the_mean_of_its_cells(base, index):
    blocks = xr.concat(days(base)[1], "time", data_vars="minimal", join="exact").isel(time=index)
    changes = station.open(base.folder).elevation_change[index].values
    assert (blocks.x[1] - blocks.x[0], blocks.y[0] - blocks.y[1]) == (10, 10)
    for row, column in ((0, 0), (3, 4), (10, 20), (17, 25), (11, 12)):
        mask, block = box_mask(row, column, 5), blocks.isel(y=row, x=column)
        assert block.elevation_change == pytest.approx(np.nanmean(changes[mask]), abs=1e-4)
        count = np.isfinite(changes[mask]).sum()
        assert block.coverage == pytest.approx(count / 25, abs=1e-3)
        exact_m = station.variance(base.folder, mask, index) ** 0.5
        assert exact_m > 1.3 * RANDOM_M / np.sqrt(count)  # shared errors count
        assert block.elevation_change_uncertainty == pytest.approx(exact_m, rel=0.01)
        assert block.elevation_change_random_uncertainty == pytest.approx(RANDOM_M / np.sqrt(count), rel=0.02)
    assert np.isnan(blocks.elevation_change[15, 3])
    assert blocks.coverage[15, 3].isnull()


def test_blocks_are_ten_metres_or_less_on_a_small_grid_with_fine_cells(monkeypatch):
    monkeypatch.setattr(block_sums, "MOST_SMALL_BLOCKS", 50_000)

    def block_m(cell_m, width_m, height_m):
        grid = Grid(0.0, 0.0, cell_m, round(width_m / cell_m), round(height_m / cell_m))
        return block_sums.cells_per_block(grid) * cell_m

    assert [block_m(cell_m, 4800, 3000) for cell_m in (5, 10, 20)] == [10, 10, 20]
    assert block_m(5, 300, 250) == 10
    assert (block_m(0.5, 220, 130), block_m(1, 160, 130), block_m(2, 260, 240)) == (1, 2, 4)
    assert (block_m(1, 1000, 1000), block_m(1, 4800, 3000)) == (5, 10)


def test_times_are_those_of_the_series(base):
    boxes, daily = read(base, "boxes.nc"), read(base, "daily.nc")
    with station.open(base.folder) as ds:
        assert (boxes.time == ds.time).all()
        assert (boxes.time_bnds.values == ds.time_bnds.values).all()
        assert np.concatenate([day.time for day in days(base)[1]]).tolist() == ds.time.values.tolist()
    assert (daily.time.values == np.array(["2025-11-21T12"], "M8[ns]")).all()  # the next day is not over
    assert daily.time_bnds.values[0, 1] == np.datetime64("2025-11-22")


@pytest.mark.integration
def test_a_daily_mean_has_the_sigma_of_three_epochs(base):
    """Var(mean) = Σᵢⱼ covᵢⱼ / n², each covᵢⱼ from the variance of the difference of two epochs."""
    daily = read(base, "daily.nc").isel(time=0)
    with station.open(base.folder) as ds:
        changes = ds.elevation_change[:3].values
    for row, column in ((3, 4), (10, 20), (14, 11)):
        mask, block = box_mask(row, column, 5), daily.isel(y=row, x=column)
        expected_m = np.mean([np.nanmean(change[mask]) for change in changes])
        assert block.elevation_change == pytest.approx(expected_m, abs=1e-4)
        assert block.epoch_count == 3
        common = mask & np.isfinite(changes).all(axis=0)
        variances = [station.variance(base.folder, mask, index) for index in range(3)]
        covariances = [
            (
                station.variance(base.folder, common, first)
                + station.variance(base.folder, common, second)
                - station.variance(base.folder, common, first, second)
            )
            / 2
            for first, second in ((0, 1), (0, 2), (1, 2))
        ]
        exact_m = np.sqrt(sum(variances) + 2 * sum(covariances)) / 3
        assert block.elevation_change_uncertainty == pytest.approx(exact_m, rel=0.03)
    assert np.isnan(daily.elevation_change[15, 3])
    assert daily.epoch_count[15, 3] == 0


@pytest.mark.integration
def test_only_new_epochs_are_computed_and_the_result_is_that_of_a_new_file(stored, monkeypatch):
    computed = []
    for name in ("boxes", "single"):
        monkeypatch.setattr(BlockQueries, name, recorded(getattr(BlockQueries, name), computed))
    old_days = days(stored)[0]
    update_boxes(stored, BlockQueries(stored), lambda: None)
    assert computed == []
    added = [epochs.write_epoch(stored, make_epoch(hour)).path.name for hour in (49, 3)]  # the second is late
    replaced = epochs.write_epoch(stored, make_epoch(20, verdict="unusable")).path.name
    build_series(stored)
    licensed = replace(stored, metadata=(("license", "CC-BY-4.0"),))
    update_boxes(licensed, BlockQueries(licensed), lambda: None)
    assert sorted(computed) == sorted(2 * [*added, replaced])
    new_days, contents = days(stored)
    assert [path.name[4:12] for path in new_days] == ["20251121", "20251122", "20251123"]
    assert len(old_days) == 2
    assert set(old_days) & set(new_days) == {old_days[1]}
    assert [len(day.time) for day in contents] == [4, 2, 1]
    grown = [read(stored, name) for name in ("boxes.nc", "daily.nc")]
    assert grown[0].attrs["license"] == "CC-BY-4.0"
    assert grown[0].sources.values.tolist() == [epoch.epoch_file for epoch in SeriesIndex(stored)]
    assert grown[1].epoch_count.max(("y", "x")).values.tolist() == [3, 2]  # unusable epochs do not count
    for name in ("boxes.nc", "daily.nc"):
        (stored.folder / name).unlink()
    shutil.rmtree(stored.folder / "blocks")
    update_boxes(stored, BlockQueries(stored), lambda: None)
    for name, old in zip(("boxes.nc", "daily.nc"), grown, strict=True):
        xr.testing.assert_equal(read(stored, name), old)
    paths, rebuilt = days(stored)
    assert paths == new_days
    for day, old in zip(rebuilt, contents, strict=True):
        xr.testing.assert_equal(day, old)


def recorded(method, computed):
    def compute(self, epoch):
        computed.append(epoch.epoch_file)
        return method(self, epoch)

    return compute


def test_an_interrupted_update_of_many_epochs_continues(stored, base, monkeypatch):
    monkeypatch.setattr("station.archive.derived.boxes.ENTRIES_KEPT", 2)
    (stored.folder / "boxes.nc").unlink()
    computed = []

    class Interrupted(BlockQueries):
        def boxes(self, epoch):
            computed.append(epoch)
            if len(computed) == 4:
                raise KeyboardInterrupt
            return super().boxes(epoch)

    with pytest.raises(KeyboardInterrupt):
        update_boxes(stored, Interrupted(stored), lambda: None)
    assert len(read(stored, "boxes.nc").time) == 2
    update_boxes(stored, Interrupted(stored), lambda: None)
    assert len(computed) == 4 + 3
    xr.testing.assert_identical(read(stored, "boxes.nc").drop_attrs(), read(base, "boxes.nc").drop_attrs())


@pytest.mark.integration
def test_a_damaged_file_of_a_day_is_not_copied_from(stored):
    """The first day gets a late epoch; the file of the second day stays as it is until it is deleted."""
    paths, _ = days(stored)
    for path in paths:
        content = bytearray(path.read_bytes())
        content[len(content) // 2] ^= 1
        path.write_bytes(content)
    epochs.write_epoch(stored, make_epoch(3))
    build_series(stored)
    update_boxes(stored, BlockQueries(stored), lambda: None)
    new_paths = sorted((stored.folder / "blocks").glob("*/*.nc"))
    assert [is_intact(path) for path in new_paths] == [True, False]
    new_paths[1].unlink()
    update_boxes(stored, BlockQueries(stored), lambda: None)
    assert [is_intact(path) for path in days(stored)[0]] == [True, True]
    assert len(list((stored.folder / "blocks/2025").iterdir())) == 4  # with their fingerprints


def keep(series, epoch, rows_at_once=7):
    """Write an epoch and keep the sums of its blocks, some rows at a time, as a worker process does."""
    summer = EpochSummer(series.grid)

    def add(rows, rasters):
        for first in range(rows.start, rows.stop, rows_at_once):
            part = slice(first, min(first + rows_at_once, rows.stop))
            within = slice(part.start - rows.start, part.stop - rows.start)
            summer.add(part, {name: raster[within] for name, raster in rasters.items()})

    path = epochs.write_epoch(series, epoch, on_rows=add).path
    keep_epoch_sums(series, path, summer)
    return path


def test_sums_kept_while_an_epoch_is_written_have_the_bits_of_the_stored_rasters(stored, monkeypatch):
    path = keep(stored, make_epoch(31))
    ref = list_epochs(stored)[-1]
    kept = stored.folder / FOLDER / f"{path.name}.npz"
    with monkeypatch.context() as no_raster:
        no_raster.setattr(block_sums, "open_raster", None)
        expected = BlockQueries(stored).boxes(ref)
    content = bytearray(kept.read_bytes())
    content[len(content) // 2] ^= 1
    for damaged in (bytes(content), bytes(content)[:100], b""):
        kept.write_bytes(damaged)
        for name, values in BlockQueries(stored).boxes(ref).items():
            assert values.tobytes() == expected[name].tobytes()


def test_precise_means_of_blocks_have_the_least_variance():
    """σ of cells differs tenfold: the weights of least squares, 1/σ², and how such means scatter."""
    rng = np.random.default_rng(3)
    sigma_m = np.where(rng.uniform(size=GRID.shape) < 0.4, 0.3, 0.03).astype(np.float32)
    reference = {"known": np.full((18, 26), 25.0), "random_m2": np.full((18, 26), 0.0)}
    levels, plain = [], []
    for _ in range(200):
        change_m = np.where(rng.uniform(size=GRID.shape) < 0.8, sigma_m * rng.normal(size=GRID.shape), FILL)
        summer = EpochSummer(GRID)
        summer.add(
            slice(0, GRID.ny), {CHANGE: change_m, RANDOM: sigma_m, "quality": np.zeros(GRID.shape, int)}
        )
        levels.append(precise_levels(summer.sums(), reference))
        plain.append(block_levels(summer.sums(), reference))
    seen = change_m[:5, :5] < FILL
    weights = seen / sigma_m[:5, :5] ** 2.0
    assert levels[-1].change_m[0, 0] == pytest.approx(np.sum(weights * change_m[:5, :5]) / weights.sum())
    assert levels[-1].random_m2[0, 0] == pytest.approx(1 / weights.sum())
    assert plain[-1].change_m[0, 0] == pytest.approx(change_m[:5, :5][seen].mean())
    for means in (levels, plain):
        z = np.array([level.change_m / np.sqrt(level.random_m2) for level in means])
        assert np.std(z) == pytest.approx(1.0, abs=0.02)
    assert np.median(levels[-1].random_m2) < 0.2 * np.median(plain[-1].random_m2)


@pytest.mark.parametrize("levels_of", [block_levels, precise_levels])
def test_a_block_of_which_only_the_best_cells_are_seen_has_a_random_variance(levels_of):
    """Two cells of 1 cm, of the scan and its reference alike, are seen, two of 1 m are not."""
    ones = np.ones((1, 1))
    cell_m2 = 2 * 0.01**2
    epoch = {"count": 2 * ones, "change_m": 0 * ones, "random_m2": 2 * cell_m2 * ones}
    epoch |= {"weight": 2 / cell_m2 * ones, "weighted_change_m": 0 * ones}
    reference = {"known": 4 * ones, "random_m2": (2 * 0.01**2 + 2 * 1.0**2) * ones}
    assert levels_of(epoch, reference).random_m2[0, 0] == pytest.approx(0.01**2 / 2)  # of the scan alone


def test_kept_sums_of_another_file_of_that_name_are_not_used(stored):
    path = keep(stored, make_epoch(31))
    coverage = BlockQueries(stored).boxes(list_epochs(stored)[-1])["coverage"]
    path.unlink()
    epochs.write_epoch(stored, replace(make_epoch(32), start_s=START_S + 31 * 3600.0))
    assert (BlockQueries(stored).boxes(list_epochs(stored)[-1])["coverage"] != coverage).any()


@pytest.mark.integration
def test_sums_are_kept_until_their_day_is_in_the_daily_means(stored):
    for hour in (32, 33, 50):
        keep(stored, make_epoch(hour))
        build_series(stored)
        update_boxes(stored, BlockQueries(stored), lambda: None)
    names = [path.name for path in (stored.folder / FOLDER).glob("hef_*")]
    assert names == ["hef_20251123T020000Z.nc.npz"]
    grown = [read(stored, name) for name in ("boxes.nc", "daily.nc")]
    for name in ("boxes.nc", "daily.nc"):
        (stored.folder / name).unlink()
    shutil.rmtree(stored.folder / FOLDER)
    update_boxes(stored, BlockQueries(stored), lambda: None)
    for name, old in zip(("boxes.nc", "daily.nc"), grown, strict=True):
        xr.testing.assert_equal(read(stored, name), old)


@pytest.mark.parametrize(
    ("with_parameters", "expected"), [((False, True, True), 2), ((True, True, False), 1)]
)
def test_a_daily_mean_is_of_epochs_with_the_same_shared_parameters(tmp_path, with_parameters, expected):
    """Otherwise the systematic error of some epochs would be missing."""
    series = Series(tmp_path, "hef", GRID, "EPSG:32632")
    write_reference(series, reference())
    for hour, known in zip((1, 5, 20), with_parameters, strict=True):
        epoch = make_epoch(hour)
        epochs.write_epoch(series, epoch if known else replace(epoch, shared=None, scalars={}))
    rasters = BlockQueries(series).daily_mean(list_epochs(series))
    assert rasters["epoch_count"].max() == expected
    has_systematic = np.nanmax(
        rasters["elevation_change_uncertainty"] - rasters["elevation_change_random_uncertainty"]
    )
    assert (has_systematic > 1e-3) == (expected == 2)


def test_a_damaged_file_is_computed_again(stored):
    path = stored.folder / "boxes.nc"
    expected, content = read(stored, "boxes.nc"), bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    assert not is_intact(path)
    update_boxes(stored, BlockQueries(stored), lambda: None)
    assert is_intact(path)
    xr.testing.assert_equal(read(stored, "boxes.nc"), expected)


def test_a_file_damaged_while_it_was_written_is_computed_again(stored):
    """Its fingerprint is that of the damaged file, and the checksum of a variable's description fails."""
    path = stored.folder / "boxes.nc"
    expected, content = read(stored, "boxes.nc"), bytearray(path.read_bytes())
    content[content.index(b"uncertainty of the elevation change")] ^= 1
    path.write_bytes(content)
    write_fingerprints(path, path)
    assert is_intact(path)
    update_boxes(stored, BlockQueries(stored), lambda: None)
    xr.testing.assert_equal(read(stored, "boxes.nc"), expected)
