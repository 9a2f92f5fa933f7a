"""How much the change of two scans is alike, as the page reads it."""

from types import SimpleNamespace

import numpy as np
import pytest

from station.products.viewer.block_codes import CurveEpoch
from station.products.viewer.pair_correlations import write_pairs
from station.products.viewer.tiles import tile_script
from station.science.uncertainty.common_mode import SECTORS

WAVE = np.sin(np.arange(SECTORS))
PATTERNS = {"a": WAVE, "b": 1 + WAVE, "c": -WAVE, "d": 3 * WAVE, "e": None}
# Twice the product over the sum of squares, means removed: 2 * 3 / (1 + 9) for three times as much.
EXPECTED = {("a", "b"): 1.0, ("a", "c"): -1.0, ("b", "d"): 0.6, ("c", "d"): -0.6, ("d", "e"): 0.0}


@pytest.fixture
def write(tmp_path, monkeypatch):
    """A function that writes the pairs of epochs, and returns what a browser gets and which were read."""

    def write(names):
        read, written = [], []

        def pattern(epoch):
            read.append(epoch.ref.epoch_file)
            return PATTERNS[epoch.ref.epoch_file]

        def script(name, head, data):
            written.append((head, data))
            return tile_script(name, head, data)

        monkeypatch.setattr("station.products.viewer.pair_correlations.tile_script", script)
        epochs = [CurveEpoch(SimpleNamespace(epoch_file=name), 3600.0 * ord(name), True) for name in names]
        write_pairs(tmp_path, SimpleNamespace(cache=tmp_path, pattern=pattern), epochs)
        assert (tmp_path / "pairs.js").is_file()
        return *written[0], read

    return write


def correlation(head, data, first, second):
    low, high = sorted((first, second))
    return data[4 * head["times"] + high * (high - 1) // 2 + low] / head["full"] - 1


def test_pairs_have_the_correlation_of_their_change(write):
    head, data, read = write("cadbe")  # in any order
    assert sorted(read) == list("abcde")
    times = np.frombuffer(data[: 4 * head["times"]], np.uint8).reshape(4, -1).astype(np.int64)
    time_s = np.cumsum(sum(plane << 8 * k for k, plane in enumerate(times)))
    np.testing.assert_array_equal(time_s, [3600 * ord(name) for name in "abcde"])
    for pair, expected in EXPECTED.items():
        actual = correlation(head, data, *("abcde".index(name) for name in pair))
        assert actual == pytest.approx(expected, abs=0.01)


def test_only_a_new_scan_is_read(write, tmp_path):
    write("abc")
    head, data, read = write("bcd")
    assert read == ["d"]
    assert correlation(head, data, 0, 2) == pytest.approx(0.6, abs=0.01)
    assert correlation(head, data, 0, 1) == pytest.approx(-1.0, abs=0.01)
    (tmp_path / "pairs.bin").write_bytes(b"damaged")
    head, again, read = write("bcd")
    assert sorted(read) == list("bcd")
    assert again == data
