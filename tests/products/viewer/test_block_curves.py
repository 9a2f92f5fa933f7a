"""Tiles of the curves: their values are those of the store, and only what changed is written."""

import base64
import json
import re
import zlib
from types import SimpleNamespace

import numpy as np
import pytest

from station.archive.series.index import SeriesIndex
from station.products.viewer import block_curves
from station.products.viewer.block_codes import CurveEpoch, sigma_code
from station.products.viewer.block_curves import curve_tiers, update_curves
from station.quantities import SharedParameters
from station.queries.aggregates import Aggregates
from station.science.uncertainty.jacobian import height_jacobian
from station.science.uncertainty.parameters import ParameterLayout


@pytest.fixture
def curve_epochs(series):
    index = SeriesIndex(series)
    return [CurveEpoch(index[i], float(index.start_s[i]), i != 3) for i in range(len(index))]


def tiers(epochs, *, older=0, recent=0):
    """The first epochs as older and recent ones, the others as the latest."""
    return {
        "older": epochs[:older],
        "recent": epochs[older : older + recent],
        "latest": epochs[older + recent :],
    }


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


@pytest.mark.integration
def test_a_tile_has_the_changes_and_sigmas_of_the_store(series, curve_epochs, tmp_path):
    about = update_curves(series, tmp_path, tiers(curve_epochs, recent=6), lambda: None)
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
                assert values["change"][time, place] * 0.001 == pytest.approx(stored.mean_m, abs=0.00051)
                sigma_m = 1e-5 * np.exp((values["random"][time, place] - 1) * 0.02)
                assert sigma_m == pytest.approx(stored.mean_sigma_m, rel=0.011)
    assert compared > 100


def test_epochs_are_in_their_tiers(series, curve_epochs, tmp_path):
    about = update_curves(series, tmp_path, tiers(curve_epochs, older=1, recent=3), lambda: None)
    assert set(about["versions"]) == {"places", "pairs", "older", "recent", "latest"}
    times_s = [round(epoch.start_s) for epoch in curve_epochs]
    for name, expected_s in {
        "older/1_2": times_s[:1], "recent/1_2": times_s[1:4], "latest/0_0": times_s[4:],
    }.items():  # fmt: skip
        np.testing.assert_array_equal(decode(tmp_path / f"{name}.js")[1], expected_s)


def test_tiers_have_all_of_three_days_and_then_what_is_retained():
    start_s = np.arange(24 * 100 + 11) * 3600.0  # hourly from midnight; the last day has 11
    kept = [24 * day + 23 for day in range(100)]
    expected = {
        "older": kept[:98],
        "recent": list(range(24 * 98, 24 * 100 + 8)),
        "latest": [24 * 100 + 8, 24 * 100 + 9, 24 * 100 + 10],
    }
    assert curve_tiers(start_s, kept) == expected
    dense = curve_tiers(np.arange(144 * 3) * 600.0, [])
    assert dense["recent"][-1] == 144 * 3 - 1
    assert 100 < len(dense["recent"]) <= 132


def written(folder):
    return {path.name: (path.stat().st_ino, path.stat().st_mtime_ns) for path in folder.iterdir()}


def test_a_new_epoch_rewrites_the_latest_tier_only(series, curve_epochs, tmp_path):
    update_curves(series, tmp_path, tiers(curve_epochs[:5], older=2, recent=2), lambda: None)
    before = {tier: written(tmp_path / tier) for tier in ("places", "older", "recent", "latest")}
    update_curves(series, tmp_path, tiers(curve_epochs[:5], older=2, recent=2), lambda: None)
    assert {tier: written(tmp_path / tier) for tier in before} == before
    update_curves(series, tmp_path, tiers(curve_epochs, older=2, recent=2), lambda: None)
    for tier in ("places", "older", "recent"):
        assert written(tmp_path / tier) == before[tier]
    latest = written(tmp_path / "latest")
    assert latest.keys() == before["latest"].keys()  # no temporary file remains
    assert all(latest[name] != before["latest"][name] for name in latest)


def test_a_damaged_cache_is_read_from_the_store_again_and_an_old_one_goes(series, curve_epochs, tmp_path):
    update_curves(series, tmp_path, tiers(curve_epochs[:5]), lambda: None)
    for path in (tmp_path / ".curves").rglob("*.npz"):
        path.write_bytes(path.read_bytes()[:100])
    replaced = tmp_path / ".curves" / "0" / "near.bin"  # of an earlier reference
    replaced.parent.mkdir()
    replaced.write_bytes(bytes(8))
    update_curves(series, tmp_path, tiers(curve_epochs), lambda: None)
    assert not replaced.parent.exists()
    fresh = tmp_path / "fresh"
    update_curves(series, fresh, tiers(curve_epochs), lambda: None)
    assert (tmp_path / "latest" / "0_0.js").read_bytes() == (fresh / "latest" / "0_0.js").read_bytes()


def test_an_uncertain_epoch_does_not_determine_how_errors_are_correlated():
    """One epoch errs by its height, one ten times as much by its tilt, and one not at all."""
    params, (east_m, north_m) = (
        ParameterLayout(0.0, 360, full_circle=True),
        np.mgrid[200:900:100, 300:800:100],
    )
    offset_m = tuple(part.ravel() * 1.0 for part in (east_m, north_m, 0 * east_m))
    jacobian = height_jacobian(params, offset_m, *np.zeros((2, east_m.size)), rock=np.ones(east_m.size, bool))
    up, tilt = (params.names.index(name) for name in ("translation_up", "tilt_east"))
    rms_m = np.sqrt(np.mean(offset_m[1] ** 2))  # of the heights, by one radian about east

    def epoch(parameter, sigma):
        count = len(params.names)
        variance = np.where(np.arange(count) == parameter, sigma**2, 0.0)
        return SharedParameters(params.names, ("1",) * count, 0 * variance, np.diag(variance), 0 * variance)

    epochs = {"a": epoch(up, 0.01), "b": epoch(tilt, 0.1 / rms_m), "c": epoch(up, 0.0)}
    queries = SimpleNamespace(shared=epochs.get)
    mean = block_curves._mean_shared(queries, [SimpleNamespace(ref=name) for name in epochs], jacobian)
    sigma = np.sqrt(np.diag(mean.covariance))
    assert sigma[up] == pytest.approx(sigma[tilt] * rms_m, rel=1e-6)
    assert block_curves._mean_shared(queries, [SimpleNamespace(ref="c")], jacobian) is None


def test_codes_of_sigmas_are_within_one_percent():
    sigma_m = np.geomspace(1e-5, 10, 1001)
    decoded_m = 1e-5 * np.exp((sigma_code(sigma_m) - 1) * 0.02)
    assert 0.009 < np.max(np.abs(decoded_m / sigma_m - 1)) < 0.0102
    assert sigma_code(np.zeros(1)).tolist() == [0]


@pytest.mark.parametrize("noise_m", [0.005, 0.05])
def test_a_tap_of_250_epochs_is_within_30_kb(noise_m):
    from station.products.viewer.tiles import byte_planes, tile_script

    rng, size = np.random.default_rng(1), 0
    counts = {
        "recent": block_curves.MAX_RECENT,
        "older": block_curves.MAX_OLDER,
        "latest": block_curves.LATEST,
    }
    assert sum(counts.values()) == 250
    for tier, count in counts.items():
        shape = count, block_curves.TILE_BLOCKS[tier] ** 2
        cells = rng.poisson(60, shape)
        codes = {
            "change": np.round(rng.normal(-0.002 * np.arange(count)[:, None], noise_m, shape) / 0.001),
            "random": sigma_code(noise_m * np.sqrt(60 / 100) * rng.normal(1, 0.02, shape)),
            "systematic": sigma_code(0.02 * rng.normal(1, 0.1, (count, 1)) * np.ones(shape)),
            "coverage": np.minimum(cells, 100),
        }
        epochs = [{name: values[k].astype(int) for name, values in codes.items()} for k in range(count)]
        planes = [
            byte_planes(block_curves.encoded(epochs, name), width)
            for name, width in block_curves.CODE_BYTES.items()
        ]
        heads = rng.integers(0, 256, (count, 3)).astype(np.uint8).tobytes() + bytes(4 * count)
        size += len(tile_script("recent/10_10", {}, heads + np.concatenate(planes).tobytes()))
    places = rng.normal(size=(20, 25)).astype("<f4").tobytes()
    size += len(tile_script("places/10_10", {}, places))
    assert 10_000 < size <= 30_000
