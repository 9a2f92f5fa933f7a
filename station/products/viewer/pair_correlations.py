"""How much the errors of any two epochs with a map are alike: the correlation of their change.

What is known is kept beside the tiles, so that a new epoch is only compared with those before.
"""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from station.products.viewer.block_codes import BlockCodes, CurveEpoch, save_codes
from station.products.viewer.tiles import Array, byte_planes, replace_file, tile_script
from station.science.uncertainty.common_mode import SECTORS, pattern_correlation

MAX_PAIRED = 150  # newest epochs
FULL = 127  # code of a correlation of 1, above the code of 0, which is as large


def write_pairs(folder: Path, codes: BlockCodes, epochs: Sequence[CurveEpoch]) -> None:
    """Write the correlations of epochs, in time order; raise StoreError if that fails."""
    epochs = sorted(epochs, key=lambda epoch: epoch.start_s)[-MAX_PAIRED:]
    names = [epoch.ref.epoch_file for epoch in epochs]
    path = codes.cache / "pairs.bin"
    kept_names, kept_patterns, kept = _load(path)
    old = [kept_names.index(name) if name in kept_names else -1 for name in names]
    patterns, correlation = np.zeros((len(names), SECTORS)), np.zeros((len(names), len(names)))
    for row, epoch in enumerate(epochs):
        pattern = codes.pattern(epoch) if old[row] < 0 else kept_patterns[old[row]]
        patterns[row] = 0 if pattern is None else pattern
        for column in range(row):
            is_kept = old[row] >= 0 and old[column] >= 0
            correlation[row, column] = (
                kept[max(old[row], old[column]), min(old[row], old[column])]
                if is_kept
                else pattern_correlation(patterns[row], patterns[column])
            )
    save_codes(path, {"names": np.array(names), "patterns": patterns, "correlation": correlation})
    time_s = np.array([round(epoch.start_s) for epoch in epochs], np.int64)
    steps = byte_planes(np.diff(time_s, prepend=0), 4).tobytes()
    triangle = correlation[np.tril_indices(len(names), -1)]
    data = steps + np.rint(FULL * (1 + triangle)).astype(np.uint8).tobytes()
    replace_file(folder / "pairs.js", tile_script("pairs", {"times": len(names), "full": FULL}, data))


def _load(path: Path) -> tuple[list[str], Array, Array]:
    """Return names, patterns and correlations of the epochs compared so far; none if damaged."""
    with suppress(OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile), np.load(path) as file:
        return file["names"].tolist(), file["patterns"], file["correlation"]
    return [], np.zeros((0, SECTORS)), np.zeros((0, 0))
