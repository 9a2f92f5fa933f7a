"""Curves of the page: change of each block of about 10 m over time with its sigma, in tiles.

Three tiers of tiles have the values: `latest` is rewritten with each scan, `recent` with every eighth,
`older` once a day, as `levels`, where the station keeps them. `places` has what no scan changes, renewed each
month. Times are thinned as the maps are.
The systematic errors of an area are propagated in the browser: from the Jacobian of its blocks, the mean
covariance of the retained epochs in `systematic`, and how the sigma of an epoch differs from it. Errors that
two epochs with a map have in common follow from their size in the mean of a tile and the correlation in
`pairs`. Source: equations.md, 6.2.
"""

from __future__ import annotations

import base64
import hashlib
import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from station.archive.derived.boxes import DAY_S
from station.archive.netcdf_layout import Series
from station.products.viewer.block_codes import (
    FORMAT,
    QUANTUM_M,
    SIGMA_MIN_M,
    SIGMA_STEP,
    BlockCodes,
    CurveEpoch,
)
from station.products.viewer.level_curves import RATE_QUANTUM_M, LevelCodes
from station.products.viewer.pair_correlations import write_pairs
from station.products.viewer.tiles import (
    Array,
    TileFolder,
    byte_planes,
    replace_file,
    tile_script,
    zigzag_differences,
)
from station.quantities import Bools, Floats, SharedParameters
from station.queries.block_sums import Sums
from station.queries.blocks import BlockQueries
from station.science.uncertainty.jacobian import HeightJacobian

TILE_BLOCKS = {"latest": 12, "recent": 5, "older": 5, "levels": 5, "places": 5}  # along each side of a tile
LATEST = 8  # epochs before they go to the recent tier
RECENT_DAYS = 2  # before the last one, of which all epochs are in the recent tier
MAX_RECENT, MAX_OLDER = 132, 110  # epochs of a curve
MAX_BASE = 24  # epochs whose covariance is averaged
SAMPLE_BLOCKS = 1000  # whose mean variance is the unit of the covariance of an epoch, about
CODE_BYTES = {"change": 3, "random": 2, "systematic": 2, "coverage": 1}  # of a value, by name
LEVEL_BYTES = CODE_BYTES | {"rate": 3, "rate_random": 2, "rate_systematic": 2}  # of a level


def curve_tiers(start_s: Floats, retained: Sequence[int]) -> dict[str, list[int]]:
    """Return the epochs of each tier, as indices of their times (n,) [s], ascending.

    All epochs of the last days, and before them those `retained`.
    """
    day = start_s // DAY_S
    last, before = (
        np.flatnonzero(day == day[-1]),
        np.flatnonzero((day >= day[-1] - RECENT_DAYS) & (day < day[-1])),
    )
    full = len(last) // LATEST * LATEST
    older = [index for index in retained if day[index] < day[-1] - RECENT_DAYS]
    return {
        "older": older[-MAX_OLDER:],
        "recent": _thin([*before.tolist(), *last[:full].tolist()], MAX_RECENT),
        "latest": last[full:].tolist(),
    }


def _thin(indices: list[int], count: int) -> list[int]:
    """Return every nth of some indices, the newest included; at most `count`."""
    step = max(1, -(-len(indices) // count))
    return indices[::-step][::-1]


def update_curves(
    series: Series,
    folder: Path,
    tiers: Mapping[str, Sequence[CurveEpoch]],
    progress: Callable[[], None],
) -> dict[str, object]:
    """Update the tiles in `folder` to the epochs of each tier, and return their description.

    All epochs have one reference. Raises StoreError if something cannot be read or written.
    """
    epochs, queries = [epoch for tier in tiers.values() for epoch in tier], BlockQueries(series)
    codes = BlockCodes(series, folder / ".curves", queries, epochs[-1].ref)
    tiles, known = _Tiles(series, folder, queries, codes), codes.keep(epochs, progress)
    wanted = {
        name: [epoch for epoch in tier if epoch.ref.epoch_file in known] for name, tier in tiers.items()
    }
    on_disk, keys = tiles.read_keys(), dict[str, str]()
    # The mean covariance is renewed each month, and as a short series grows.
    month = f"{datetime.fromtimestamp(epochs[-1].start_s, UTC):%Y-%m}"
    keys["places"] = tiles.key([month, str(len(known).bit_length())])
    if on_disk.get("places") != keys["places"]:
        tiles.write_places([epoch for tier in wanted.values() for epoch in tier])
        progress()
    for name, tier in wanted.items():
        keys[name] = tiles.key([epoch.ref.epoch_file for epoch in tier])
        if on_disk.get(name) != keys[name]:
            tiles.write_curves(name, [(epoch.start_s, epoch.is_usable, codes.read(epoch)) for epoch in tier])
            progress()
    levels = LevelCodes(series, codes.cache / "levels", codes.version, codes.surface.known, queries.cells)
    days = levels.keep(progress)
    keys["levels"] = tiles.key(days)
    if on_disk.get("levels") != keys["levels"]:
        readable = {name: day for name in days if (day := levels.read(name)) is not None}
        tiles.write_curves("levels", [(time_s, True, day) for time_s, day in readable.values()])
        keys["levels"] = tiles.key(list(readable))
        progress()
    with_map = [epoch for tier in wanted.values() for epoch in tier if epoch.has_map]
    keys["pairs"] = tiles.key([epoch.ref.epoch_file for epoch in with_map])
    if on_disk.get("pairs") != keys["pairs"]:
        write_pairs(folder, codes, with_map)
    if on_disk.get("places") != keys["places"]:
        os.sync()  # before the keys that say that the tiles are there
    if on_disk != keys:
        tiles.write_keys(keys)
    filled = {
        "places",
        "pairs",
        *(name for name, tier in wanted.items() if tier),
        *(["levels"] if days else []),
    }
    return tiles.description() | {"versions": {name: key[:8] for name, key in keys.items() if name in filled}}


def _mean_shared(
    queries: BlockQueries, epochs: list[CurveEpoch], jacobian: HeightJacobian
) -> SharedParameters | None:
    """Return the shared parameters with the mean covariance of epochs spread over those given.

    Each counts in units of its mean variance of height, so that an uncertain epoch does not determine how the
    errors of the others are correlated. None if no epoch has systematic errors.
    """
    chosen = np.unique(np.linspace(0, len(epochs) - 1, min(len(epochs), MAX_BASE)).astype(int))
    known = [
        shared
        for shared in (queries.shared(epochs[index].ref) for index in chosen.tolist())
        if shared is not None
    ]
    known = [shared for shared in known if shared.names == known[-1].names]
    sample = jacobian.take(slice(None, None, max(len(jacobian) // SAMPLE_BLOCKS, 1)))
    variance_m2 = np.array([sample.variance(shared).mean() for shared in known])
    weights = np.divide(1, variance_m2, out=np.zeros(len(known)), where=variance_m2 > 0)
    if not weights.any():
        return None
    covariance, line_tilt_variance = (
        np.average([getattr(shared, name) for shared in known], axis=0, weights=weights)
        for name in ("covariance", "line_tilt_variance")
    )
    return replace(known[-1], covariance=covariance, line_tilt_variance=line_tilt_variance)


class _Grouping:
    """Blocks (n,) of a grid of blocks, grouped in square tiles."""

    def __init__(self, known: Bools, size: int) -> None:
        row, column = np.nonzero(known)
        self.columns = -(-known.shape[1] // size)
        self.rows = -(-known.shape[0] // size)
        tile = row // size * self.columns + column // size
        self.order = np.argsort(tile, kind="stable")
        self.local = (row % size * size + column % size)[self.order].astype(np.uint8)
        numbers, first = np.unique(tile[self.order], return_index=True)
        # Number, first and end of each tile in the order.
        self.tiles = list(
            zip(numbers.tolist(), first.tolist(), [*first[1:].tolist(), len(tile)], strict=True)
        )

    def name(self, number: int) -> str:
        """Return the name of a tile: its row and column."""
        row, column = divmod(number, self.columns)
        return f"{row}_{column}"


class _Tiles:
    """The tiles of one version of the reference."""

    def __init__(self, series: Series, folder: Path, queries: BlockQueries, codes: BlockCodes) -> None:
        self._series, self._folder, self._queries, self._codes = series, folder, queries, codes
        self.surface = codes.surface
        self._groupings = {size: _Grouping(self.surface.known, size) for size in set(TILE_BLOCKS.values())}

    def key(self, names: list[str]) -> str:
        """Return a text that changes with what a tier is made of."""
        return hashlib.sha256(json.dumps([FORMAT, self._codes.version, *names]).encode()).hexdigest()

    def read_keys(self) -> dict[str, str]:
        """Return the keys of the tiers on disk; none if they are missing or damaged."""
        try:
            keys = json.loads((self._folder / ".curves" / "keys.json").read_text())
        except (OSError, ValueError):
            return {}
        return keys if isinstance(keys, dict) else {}

    def write_keys(self, keys: dict[str, str]) -> None:
        """Write the keys of the tiers on disk."""
        replace_file(self._folder / ".curves" / "keys.json", json.dumps(keys).encode())

    def write_curves(self, tier: str, times: Sequence[tuple[float, bool, Sums]]) -> None:
        """Write the tiles of a tier: of each time [s], whether it is usable and its codes."""
        size = TILE_BLOCKS[tier]
        folder, grouping = TileFolder(self._folder / tier), self._groupings[size]
        if times:
            unknown = np.zeros(len(grouping.tiles), np.uint16)
            common = np.array([epoch.get(f"common_{size}", unknown) for _, _, epoch in times])
            codes = [codes for _, _, codes in times]
            planes = np.concatenate(
                [
                    byte_planes(encoded(codes, name)[:, grouping.order], count)
                    for name, count in (LEVEL_BYTES if tier == "levels" else CODE_BYTES).items()
                ]
            )
            time_s = np.array([round(second) for second, _, _ in times], np.int64)
            heads = [
                byte_planes(np.diff(time_s, prepend=0), 4).tobytes(),
                np.array([is_usable for _, is_usable, _ in times], np.uint8).tobytes(),
            ]
            errors = byte_planes(common, 2)
            for position, (number, first, end) in enumerate(grouping.tiles):
                shared, values = errors[:, :, position].tobytes(), planes[:, :, first:end].tobytes()
                data = b"".join([grouping.local[first:end].tobytes(), *heads, shared, values])
                folder.write(grouping.name(number), {"times": len(times), "blocks": end - first}, data)
        folder.delete_others()

    def write_places(self, epochs: list[CurveEpoch]) -> None:
        """Write what no scan changes: heights, geometry and Jacobian of blocks, and the mean covariance."""
        surface, grouping = self.surface, self._groupings[TILE_BLOCKS["places"]]
        jacobian = surface.jacobian
        base = None if jacobian is None else _mean_shared(self._queries, epochs, jacobian)
        reference_m2 = surface.random_m2 / np.maximum(self._queries.cells**2, 1)
        rows = [
            surface.points[2],
            surface.observation.range_m,
            np.degrees(np.arccos(surface.observation.cos_incidence)),
            np.sqrt(reference_m2),
            self._codes.near_ratio,
        ]
        if jacobian is not None and base is not None:
            rows += [*jacobian.pose, jacobian.sight_tilt, jacobian.refraction, jacobian.cross_tilt]
            rows += [jacobian.knot_position]
        values = np.array(rows, np.float64)[:, grouping.order].astype("<f4")
        folder = TileFolder(self._folder / "places")
        for number, first, end in grouping.tiles:
            data = grouping.local[first:end].tobytes() + values[:, first:end].tobytes()
            folder.write(grouping.name(number), {"blocks": end - first, "values": len(values)}, data)
        folder.delete_others()
        _write_systematic(self._folder / "systematic.js", jacobian, base)

    def description(self) -> dict[str, object]:
        """Return what a browser must know to read the tiles."""
        grid, position_m = self._series.grid, self._codes.newest_blocks.cells.scanner[:3]
        is_known = bool(np.isfinite(position_m).all())
        grouping = self._groupings[TILE_BLOCKS["places"]]
        has_tile = np.zeros(grouping.rows * grouping.columns, bool)
        has_tile[[number for number, _, _ in grouping.tiles]] = True
        return {
            "west_m": grid.west_m,
            "north_m": grid.north_m,
            "block_m": self._queries.cells * grid.cell_m,
            "tile_blocks": TILE_BLOCKS,
            "tiles": base64.b64encode(np.packbits(has_tile).tobytes()).decode(),
            "columns": grouping.columns,
            "quantum_m": QUANTUM_M,
            "rate_quantum_m": RATE_QUANTUM_M,
            "sigma_min_m": SIGMA_MIN_M,
            "sigma_step": SIGMA_STEP,
            "full": self._codes.max_coverage,
            "scanner_m": [round(value, 3) for value in position_m] if is_known else None,
        }


def encoded(codes: list[Sums], name: str) -> Array:
    """Return the codes (t, n) of a quantity as non-negative steps from epoch to epoch, as a tile has them.

    Where a block was not observed, the code is that of the epoch before.
    """
    values = np.array([epoch[name] for epoch in codes], np.int32)
    if name != "coverage":
        for previous, row, epoch in zip(values, values[1:], codes[1:], strict=False):
            np.copyto(row, previous, where=epoch["coverage"] == 0)
    return zigzag_differences(values)


def _write_systematic(path: Path, jacobian: HeightJacobian | None, base: SharedParameters | None) -> None:
    """Write the mean covariance of the shared parameters, scaled to units of their sigma."""
    head, data = {"parameters": 0}, b""
    if jacobian is not None and base is not None:
        params = jacobian.params
        lower = base.covariance[np.tril_indices(len(base.names))]
        head = {
            "parameters": len(base.names),
            "intervals": params.knot_intervals,
            "tilt_knots": params.sight_tilt_knots,
            "refraction_knots": params.refraction_knots,
        }
        data = np.concatenate([lower, base.line_tilt_variance]).astype("<f4").tobytes()
    replace_file(path, tile_script("systematic", head, data))
