"""Tiles of the curves: their values are those of the store, and only what changed is written."""

import base64
import json
import re
import zlib

import numpy as np
import pytest

from station.archive.series.index import SeriesIndex
from station.products.viewer.block_curves import CurveEpoch, sigma_code, update_curves
from station.queries.aggregates import Aggregates


@pytest.fixture
def curve_epochs(series):
    index = SeriesIndex(series)
    return [CurveEpoch(index[i], float(index.start_s[i]), i != 3) for i in range(len(index))]


def read_tile(path):
    name, head, data = json.loads(re.fullmatch(r"STATION_TILE\((.*)\);\n", path.read_text())[1].join("[]"))
    assert name == f"{path.parent.name}/{path.stem}"
    return head, np.frombuffer(zlib.decompress(base64.b64decode(data)), np.uint8)


def unsigned(planes):
    return sum(plane.astype(np.int64) << 8 * k for k, plane in enumerate(planes))


def decode(path):
    """Times [s], usable (t,), and values (t, n) by name, of the blocks numbered row by row in the tile."""
    head, data = read_tile(path)
    times, blocks = head["times"], head["blocks"]
    local, data = data[:blocks], data[blocks:]
    time_s = np.cumsum(unsigned(data[: 4 * times].reshape(4, times)))
    usable, planes = data[4 * times : 5 * times], data[7 * times :].reshape(8, times, blocks)
    values = {}
    for name, rows in {"change": (0, 3), "random": (3, 5), "systematic": (5, 7), "coverage": (7, 8)}.items():
        zigzag = unsigned(planes[slice(*rows)])
        values[name] = np.cumsum((zigzag >> 1) ^ -(zigzag & 1), axis=0)
    return local, time_s, usable, values


def test_a_tile_has_the_changes_and_sigmas_of_the_store(series, curve_epochs, tmp_path):
    about = update_curves(series, tmp_path, curve_epochs, 0.0, lambda: None)
    aggregates, grid = Aggregates(series), series.grid
    local, time_s, usable, values = decode(tmp_path / "recent" / "1_2.js")  # cells are blocks of 10 m here
    np.testing.assert_array_equal(time_s, [round(epoch.start_s) for epoch in curve_epochs])
    assert usable.tolist() == [1, 1, 1, 0, 1, 1]
    assert about["block_m"] == grid.cell_m
    compared = 0
    for place, number in enumerate(local.tolist()):
        cells = np.zeros(grid.shape, bool)
        cells[1 * 5 + number // 5, 2 * 5 + number % 5] = True
        for time, epoch in enumerate(curve_epochs):
            stored = aggregates.area(cells, epoch.ref)
            assert (values["coverage"][time, place] > 0) == np.isfinite(stored.mean_m)
            if np.isfinite(stored.mean_m):
                compared += 1
                assert values["change"][time, place] * 0.0005 == pytest.approx(stored.mean_m, abs=0.00026)
                sigma_m = 1e-5 * np.exp((values["random"][time, place] - 1) * 0.02)
                assert sigma_m == pytest.approx(stored.mean_sigma_m, rel=0.011)
    assert compared > 100


def test_old_and_recent_epochs_are_in_their_tiers(series, curve_epochs, tmp_path):
    boundary_s = curve_epochs[4].start_s
    about = update_curves(series, tmp_path, curve_epochs, boundary_s, lambda: None)
    assert set(about["versions"]) == {"places", "older", "recent"}
    _, older_s, _, _ = decode(tmp_path / "older" / "1_2.js")
    _, recent_s, _, _ = decode(tmp_path / "recent" / "1_2.js")
    np.testing.assert_array_equal(older_s, [round(epoch.start_s) for epoch in curve_epochs[:4]])
    np.testing.assert_array_equal(recent_s, [round(epoch.start_s) for epoch in curve_epochs[4:]])


def inodes(folder):
    return {path.name: path.stat().st_ino for path in folder.iterdir()}


def test_a_new_epoch_rewrites_the_recent_tier_only(series, curve_epochs, tmp_path):
    boundary_s = curve_epochs[2].start_s
    update_curves(series, tmp_path, curve_epochs[:5], boundary_s, lambda: None)
    before = {tier: inodes(tmp_path / tier) for tier in ("places", "older", "recent")}
    update_curves(series, tmp_path, curve_epochs[:5], boundary_s, lambda: None)
    assert {tier: inodes(tmp_path / tier) for tier in before} == before
    update_curves(series, tmp_path, curve_epochs, boundary_s, lambda: None)
    assert inodes(tmp_path / "older") == before["older"]
    assert inodes(tmp_path / "places") == before["places"]
    assert decode(tmp_path / "recent" / "1_2.js")[1][-1] == round(curve_epochs[-1].start_s)
    assert inodes(tmp_path / "recent").keys() == before["recent"].keys()  # no temporary file remains


def test_a_damaged_cache_is_read_from_the_store_again(series, curve_epochs, tmp_path):
    update_curves(series, tmp_path, curve_epochs[:5], 0.0, lambda: None)
    for path in (tmp_path / ".curves").rglob("*.npz"):
        path.write_bytes(path.read_bytes()[:100])
    update_curves(series, tmp_path, curve_epochs, 0.0, lambda: None)
    fresh = tmp_path / "fresh"
    update_curves(series, fresh, curve_epochs, 0.0, lambda: None)
    assert (tmp_path / "recent" / "1_2.js").read_bytes() == (fresh / "recent" / "1_2.js").read_bytes()


def test_codes_of_sigmas_are_within_one_percent():
    sigma_m = np.geomspace(1e-5, 10, 1001)
    decoded_m = 1e-5 * np.exp((sigma_code(sigma_m) - 1) * 0.02)
    assert 0.009 < np.max(np.abs(decoded_m / sigma_m - 1)) < 0.0102
    assert sigma_code(np.zeros(1)).tolist() == [0]


@pytest.mark.parametrize("noise_m", [0.005, 0.05])
def test_a_tap_of_250_epochs_is_within_30_kb(noise_m):
    from station.products.viewer import block_curves
    from station.products.viewer.tiles import byte_planes, tile_script, zigzag_differences

    rng, size = np.random.default_rng(1), 0
    for count in (block_curves.MAX_RECENT, block_curves.MAX_OLDER):
        shape = count, block_curves.TILE_BLOCKS**2
        cells = rng.poisson(60, shape)
        codes = {
            "change": np.round(rng.normal(-0.002 * np.arange(count)[:, None], noise_m, shape) / 0.0005),
            "random": sigma_code(noise_m * np.sqrt(60 / cells) * rng.normal(1, 0.02, shape)),
            "systematic": sigma_code(0.02 * rng.normal(1, 0.1, (count, 1)) * np.ones(shape)),
            "coverage": np.minimum(cells, 100),
        }
        planes = [
            byte_planes(zigzag_differences(codes[name]), size)
            for name, size in block_curves.CODE_BYTES.items()
        ]
        heads = rng.integers(0, 256, (count, 3)).astype(np.uint8).tobytes() + bytes(4 * count)
        size += len(tile_script("recent/10_10", {}, heads + np.concatenate(planes).tobytes()))
    places = rng.normal(size=(19, 25)).astype("<f4").tobytes()
    size += len(tile_script("places/10_10", {}, places))
    assert 10_000 < size <= 30_000
