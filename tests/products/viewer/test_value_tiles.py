"""Tiles of values: those of the store, to an eighth of sigma, at every level."""

import base64
import json
import re
import zlib
from dataclasses import replace

import numpy as np
import pytest

from station.archive.derived.computed_rasters import CHANGE, RANDOM, TOTAL
from station.archive.schema import FILL
from station.archive.series.index import SeriesIndex
from station.products.overview import BaseMap, OverviewBuilder, base_map, read_overview
from station.products.viewer import value_tiles
from station.quantities import Grid

SHAPE = (700, 900)  # cells; a pixel has 2 × 2
ROWS, COLUMNS = slice(20, 640), slice(100, 880)


@pytest.fixture(scope="module")
def base():
    shade = np.full((310, 390), 0.5, np.float32)
    shade[:130, :130] = np.nan  # nothing known in the first tile of cells
    return BaseMap("1", 2, ROWS, COLUMNS, shade, Grid(1000.0, 5000.0, 2.0, 390, 310))


@pytest.fixture(scope="module")
def rasters():
    """Change with a fall of 30 m, sigma between 3 mm and 3 m, and gaps."""
    rng = np.random.default_rng(7)
    random_m, shared_m = 10.0 ** rng.uniform(-2.5, 0.3, SHAPE), 0.02
    change_m = random_m * rng.normal(size=SHAPE)
    change_m[300:400, 300:500] -= 30
    total_m = np.hypot(random_m, shared_m)
    gaps = rng.uniform(size=SHAPE) < 0.3
    gaps[:280, :380] = True
    return {
        name: np.where(gaps, FILL, values).astype(np.float32)
        for name, values in {CHANGE: change_m, TOTAL: total_m, RANDOM: random_m}.items()
    }


def read_tile(path):
    """Change, sigma [m] and share (r, c) of a tile, NaN where there is none; or heights [m]."""
    _, head, data = json.loads(re.fullmatch(r"STATION_TILE\((.*)\);\n", path.read_text())[1].join("[]"))
    data = np.frombuffer(zlib.decompress(base64.b64decode(data)), np.uint8)
    shape = head["rows"], head["columns"]
    size = shape[0] * shape[1]
    first = -(-size // 8)
    seen = np.unpackbits(data[:first], count=size).astype(bool)
    n = np.count_nonzero(seen)
    other, planes = data[first : len(data) - head["planes"] * n], data[len(data) - head["planes"] * n :]
    zigzag = sum(plane.astype(np.int64) << 8 * k for k, plane in enumerate(planes.reshape(-1, n)))
    steps = np.cumsum((zigzag >> 1) ^ -(zigzag & 1))

    def raster(values):
        whole = np.full(size, np.nan)
        whole[seen] = values
        return whole.reshape(shape)

    if "step" in head:
        return raster(steps * head["step"]), raster(0.0005 * np.exp((other.astype(float) - 1) * 0.08))
    code = other[:n].astype(float)
    sigma_m = 0.0005 * np.exp((code - 1) * 0.08)
    change_m = steps * 2.0 ** np.floor(np.log2(sigma_m / 4))
    return raster(change_m), raster(sigma_m), raster(other[n:] / 255) if head["share"] else None


def assemble(folder, shape, column=0):
    """A level put together from its tiles."""
    whole = np.full(shape, np.nan)
    for path in folder.iterdir():
        top, left = (256 * int(number) for number in path.stem.split("_"))
        part = read_tile(path)
        values = part[column] if isinstance(part, tuple) else part
        whole[top : top + values.shape[0], left : left + values.shape[1]] = values
    return whole


@pytest.mark.parametrize("height", [128, 100])
def test_cells_are_those_that_were_written_however_many_rows_come_at_once(base, rasters, tmp_path, height):
    tiles = value_tiles.CellTiles(base)
    for top in range(0, SHAPE[0], height):
        rows = slice(top, min(top + height, SHAPE[0]))
        tiles.add(rows, {name: values[rows] for name, values in rasters.items()})
    value_tiles.write_cells(tmp_path, "x.nc", tiles)
    folder = tmp_path / "values" / "x" / "0"
    assert {path.stem for path in folder.iterdir()} == {
        f"{row}_{column}" for row in range(3) for column in range(4)
    } - {"0_0"}
    change_m, sigma_m = (assemble(folder, (620, 780), column) for column in (0, 1))
    stored, total = (rasters[name][ROWS, COLUMNS].astype(float) for name in (CHANGE, TOTAL))
    expected = np.where(stored < 1e30, stored, np.nan)
    np.testing.assert_array_equal(np.isfinite(change_m), np.isfinite(expected))
    seen = np.isfinite(expected)
    error = np.abs(change_m - expected)[seen] / total[seen]
    assert 0.08 < error.max() < 0.131  # an eighth, of a sigma to 4 %
    assert 0.035 < np.abs(sigma_m[seen] / total[seen] - 1).max() < 0.0411


@pytest.mark.integration
def test_means_have_the_sigma_of_the_mean_of_their_cells(base, rasters, tmp_path):
    builder = OverviewBuilder(base)
    builder.add(slice(0, SHAPE[0]), rasters)
    value_tiles.write_means(tmp_path, "x.nc", builder.build())
    levels = value_tiles.levels(base)
    assert [level.shape for level in levels] == [(620, 780), (310, 390)]
    sizes = (2,)
    for number, size in enumerate(sizes, 1):
        folder, shape = tmp_path / "values" / "x" / str(number), levels[number].shape
        change_m, sigma_m, share = (assemble(folder, shape, column) for column in range(3))
        blocks = {
            name: np.where(values < 1e30, values.astype(float), np.nan)[ROWS, COLUMNS]
            .reshape(620 // size, size, 780 // size, size).swapaxes(1, 2).reshape(*shape, -1)
            for name, values in rasters.items()
        }  # fmt: skip
        count = np.isfinite(blocks[CHANGE]).sum(axis=-1)
        seen = count > 0
        mean = np.nansum(blocks[CHANGE], axis=-1)[seen] / count[seen]
        random2 = np.nansum(blocks[RANDOM] ** 2, axis=-1)[seen] / count[seen] ** 2
        sigma = np.sqrt(random2 + 0.02**2)  # the systematic part of 2 cm is common to the cells
        np.testing.assert_array_equal(np.isfinite(change_m), seen)
        assert np.abs(change_m[seen] - mean).max() < 0.131 * sigma.max()
        assert np.all(np.abs(change_m[seen] - mean) < 0.131 * sigma + 1e-5)
        assert sigma_m[seen] == pytest.approx(sigma, rel=0.042)
        assert share[seen] == pytest.approx(count[seen] / size**2, abs=1 / 255)


def test_levels_become_coarser_until_the_map_is_small(base):
    large = replace(base, factor=4, hillshade=np.zeros((1000, 1250), np.float32))
    levels = value_tiles.levels(replace(large, grid=replace(base.grid, cell_m=4.0)))
    assert [level.value_m for level in levels] == [1, 4, 16]
    assert [level.shape for level in levels] == [(4000, 5000), (1000, 1250), (250, 313)]


def test_values_and_heights_of_a_small_store(series, small, tmp_path):
    epoch, base = SeriesIndex(series)[2], base_map(series, "1", 600)
    value_tiles.write_means(tmp_path, epoch.epoch_file, read_overview(epoch, base))
    value_tiles.write_heights(series, tmp_path, base)
    assert value_tiles.has_values(tmp_path, epoch.epoch_file, base, cells=False)
    cells = small.make_epoch(2).measurement.to_rasters("change_m", "uncertainty_m")
    change_m, sigma_m = (np.asarray(values)[base.rows, base.columns] for values in cells)
    folder = tmp_path / "values" / epoch.epoch_file.removesuffix(".nc") / "0"
    tile_m = assemble(folder, base.grid.shape)
    seen = np.isfinite(change_m)
    np.testing.assert_array_equal(np.isfinite(tile_m), seen)
    assert np.all(np.abs(tile_m - change_m)[seen] < 0.3 * sigma_m[seen])  # the store rounds, too
    height_m = small.make_reference().elevation_m[base.rows, base.columns]
    read_m, sigma_m = (assemble(tmp_path / "ground" / "1" / "0", base.grid.shape, k) for k in (0, 1))
    assert sigma_m[np.isfinite(height_m)] == pytest.approx(0.005, rel=0.041)
    assert np.nanmax(np.abs(read_m - height_m)) <= 10 / 32 / 2 + 1e-3
    np.testing.assert_array_equal(np.isfinite(read_m), np.isfinite(height_m))


def test_old_values_go_after_an_hour(series, tmp_path, monkeypatch):
    epoch, base = SeriesIndex(series)[2], base_map(series, "1", 600)
    value_tiles.write_means(tmp_path, epoch.epoch_file, read_overview(epoch, base))
    (tmp_path / "heights" / "1").mkdir(parents=True)  # of an older page, in another form
    value_tiles.delete_old_values(tmp_path, [], [])
    assert not (tmp_path / "heights").exists()
    assert value_tiles.has_values(tmp_path, epoch.epoch_file, base, cells=False)
    monkeypatch.setattr(value_tiles, "DELETE_GRACE_S", -1.0)
    value_tiles.delete_old_values(tmp_path, [epoch.epoch_file], [])
    assert value_tiles.has_values(tmp_path, epoch.epoch_file, base, cells=False)
    value_tiles.delete_old_values(tmp_path, [], [])
    assert list((tmp_path / "values").iterdir()) == []
