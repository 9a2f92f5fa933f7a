"""Maps of values for the page: change and sigma of an epoch, heights and sigma of the reference, in tiles.

Level 0 has the cells of the grid; the levels after it have means of more and more cells, down to a few tiles
for the whole map. A change is rounded to an eighth of its sigma or less, a sigma to 4 %. Cells that were not
observed are left out by a mask.
"""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from station.archive.derived.computed_rasters import CHANGE, TOTAL, open_raster
from station.archive.epochs import EpochRef
from station.archive.netcdf_layout import Series
from station.archive.raster_io import Array
from station.archive.reference_files import reference_path
from station.archive.schema import FILL
from station.errors import StoreError
from station.products.overview import BAND_ROWS, BaseMap, Overview
from station.products.viewer.tiles import byte_planes, replace_file, tile_script, zigzag_differences
from station.quantities import Bools, Floats32

TILE = 256  # values along each side of a tile
STEP = 4  # from one level of means to the next
TOP = 512  # values along the longer side of the last level
SIGMA_MIN_M, SIGMA_STEP = 5e-4, 0.08  # code of a sigma: 1 + ln(sigma / minimum) / step, in one byte
MAX_CODE = 255
SHARE = 255  # code of a value of which all cells were observed
HEIGHT_STEPS = 32  # of a height, in a length of a value
VALUES, HEIGHTS = "values", "ground"  # folders
CELLS = "0"  # the level of cells
DELETE_GRACE_S = 3600.0  # an open page may still read a map that is no longer kept

# Sigma [m] of each code, and the step of a change [m]: a power of two, at most a quarter of the sigma.
SIGMA_M = SIGMA_MIN_M * np.exp((np.arange(MAX_CODE + 1) - 1) * SIGMA_STEP)
CHANGE_STEP_M = (2.0 ** np.floor(np.log2(SIGMA_M / 4))).astype(np.float32)


def sigma_codes(sigma_m: Floats32) -> Array:
    """Return codes (n,) of sigmas [m], to 4 %; those beyond the codes are clipped."""
    code = np.log(np.maximum(sigma_m, SIGMA_MIN_M) * np.float32(1 / SIGMA_MIN_M)) / np.float32(SIGMA_STEP)
    return np.asarray(np.minimum(np.rint(code) + 1, MAX_CODE).astype(np.uint8))


def value_tile(
    name: str, seen: Bools, change_m: Floats32, sigma_m: Floats32, share: Floats32 | None = None
) -> bytes:
    """Return a tile of changes and sigmas (r, c) [m] where they were observed, and of observed shares."""
    where = np.flatnonzero(seen)
    sigmas = sigma_codes(sigma_m.ravel()[where])
    steps = np.rint(change_m.ravel()[where] / CHANGE_STEP_M[sigmas]).astype(np.int32)
    parts = [sigmas.tobytes()]
    if share is not None:
        parts.append(np.ceil(share.ravel()[where] * SHARE).astype(np.uint8).tobytes())
    return _masked_tile(name, seen, steps, parts, {"share": int(share is not None)})


def height_tile(name: str, height_m: Floats32, sigma_m: Floats32, step_m: float) -> bytes:
    """Return a tile of heights (r, c) [m], NaN where unknown, rounded to steps, and their random sigmas."""
    known = np.isfinite(height_m)
    steps = np.rint(height_m[known] / step_m).astype(np.int32)
    sigmas = sigma_codes(np.nan_to_num(sigma_m[known]))
    return _masked_tile(name, known, steps, [sigmas.tobytes()], {"step": step_m})


def _masked_tile(
    name: str, mask: Bools, steps: Array, parts: list[bytes], head: Mapping[str, object]
) -> bytes:
    """Return a tile: mask, further planes, and the differences of the steps (n,) row by row as planes."""
    differences = zigzag_differences(steps)
    planes = max((int(differences.max(initial=0)).bit_length() + 7) // 8, 1)
    data = b"".join([np.packbits(mask).tobytes(), *parts, byte_planes(differences, planes).tobytes()])
    rows, columns = mask.shape
    return tile_script(name, {"rows": rows, "columns": columns, "planes": planes, **head}, data)


@dataclass(frozen=True)
class Level:
    """A level of the map: its values, and which tiles have any known ground."""

    value_m: float  # side of a value
    shape: tuple[int, int]
    has_tile: Bools  # (rows, columns) of tiles

    @property
    def tiles(self) -> list[tuple[int, int]]:
        """Row and column of each tile."""
        return [(int(row), int(column)) for row, column in zip(*np.nonzero(self.has_tile), strict=True)]


def levels(base: BaseMap) -> list[Level]:
    """Return the levels of a map, finest first: the cells, its pixels, and means of these."""
    known = np.isfinite(base.hillshade)
    cell_m = base.grid.cell_m / base.factor
    sizes = [1] if base.factor > 1 else []
    step = base.factor
    while True:
        sizes.append(step)
        if max(known.shape) * base.factor / step <= TOP:
            break
        step *= STEP
    return [_level(known, base.factor, size, cell_m) for size in sizes]


def _level(known: Bools, factor: int, size: int, cell_m: float) -> Level:
    """Return the level of which a value has `size` × `size` cells, of known pixels of `factor` cells."""
    rows, columns = (-(-count * factor // size) for count in known.shape)
    has_tile = np.zeros((-(-rows // TILE), -(-columns // TILE)), np.bool_)
    for (row, column), _ in np.ndenumerate(has_tile):
        top, left = (k * TILE * size // factor for k in (row, column))
        bottom, right = (-(-(k + 1) * TILE * size // factor) for k in (row, column))
        has_tile[row, column] = known[top:bottom, left:right].any()
    return Level(size * cell_m, (rows, columns), has_tile)


class CellTiles:
    """Tiles of the cells of an epoch, formed while its rasters are written or read in order of their rows."""

    names = (CHANGE, TOTAL)

    def __init__(self, base: BaseMap) -> None:
        self._base, self._level = base, levels(base)[0]
        width = base.columns.stop - base.columns.start
        self._waiting = [np.zeros((TILE, width), np.float32) for _ in self.names]
        self._done = 0  # rows of tiles
        self.tiles: dict[str, bytes] = {}  # scripts by name

    def add(self, rows: slice, band: Mapping[str, Array]) -> None:
        """Add some rows (r, nx) of the rasters as stored, fill values included."""
        start = self._base.rows.start
        first, stop = max(rows.start, start), min(rows.stop, self._base.rows.stop)
        while first < stop:
            top = start + self._done * TILE
            bottom = min(top + TILE, self._base.rows.stop)
            end = min(stop, bottom)
            for waiting, name in zip(self._waiting, self.names, strict=True):
                part = band[name][first - rows.start : end - rows.start, self._base.columns]
                waiting[first - top : end - top] = part
            if end == bottom:
                self._finish_row(bottom - top)
            first = end

    def _finish_row(self, height: int) -> None:
        for column in np.flatnonzero(self._level.has_tile[self._done]).tolist():
            part = np.s_[:height, column * TILE : (column + 1) * TILE]
            change_m, sigma_m = (waiting[part] for waiting in self._waiting)
            name = f"{self._done}_{column}"
            self.tiles[name] = value_tile(f"{CELLS}/{name}", change_m < FILL / 2, change_m, sigma_m)
        self._done += 1


def read_cells(epoch: EpochRef, base: BaseMap) -> CellTiles:
    """Return the tiles of the cells of a stored epoch; raise StoreError if it cannot be read."""
    tiles = CellTiles(base)
    rasters = {name: open_raster(epoch.path, name, epoch.index) for name in tiles.names}
    for top in range(base.rows.start - base.rows.start % BAND_ROWS, base.rows.stop, BAND_ROWS):
        rows = slice(top, min(top + BAND_ROWS, base.rows.stop))
        tiles.add(rows, {name: np.asarray(raster[rows]) for name, raster in rasters.items()})
    return tiles


def has_values(folder: Path, epoch_file: str, base: BaseMap, *, cells: bool) -> bool:
    """Return True if the tiles of an epoch are there: those of its cells, or those of its means."""
    name = CELLS if cells else str(int(base.factor > 1))
    return (_epoch_folder(folder, epoch_file) / name).is_dir()


def write_cells(folder: Path, epoch_file: str, tiles: CellTiles) -> None:
    """Write the tiles of the cells of an epoch; raise StoreError if that fails."""
    _write_level(_epoch_folder(folder, epoch_file) / CELLS, tiles.tiles)


def write_means(folder: Path, epoch_file: str, overview: Overview) -> None:
    """Write the tiles of the means of an epoch; raise StoreError if that fails."""
    base, first = overview.base, int(overview.base.factor > 1)
    count, random_m2 = overview.count, overview.random_m2
    assert count is not None and random_m2 is not None  # noqa: S101, PT018 - of an epoch, not of a difference
    sums = [
        count,
        np.nan_to_num(overview.change_m) * count,
        np.nan_to_num(random_m2) * count**2,
        np.nan_to_num(np.maximum(overview.sigma_m**2 - random_m2, 0)) * count,
    ]
    cells, target, by_level = base.factor**2, _epoch_folder(folder, epoch_file), []
    for number, level in enumerate(levels(base)[first:], first):
        if number > first:
            sums, cells = [_block_sums(values) for values in sums], cells * STEP**2
        count, change, random, shared = sums
        with np.errstate(invalid="ignore", divide="ignore"):
            change_m = change / count
            sigma_m = np.sqrt(random / count**2 + shared / count)
        share = count / cells
        scripts = {}
        for row, column in level.tiles:
            name = f"{row}_{column}"
            parts = (_part(values, row, column) for values in (change_m, sigma_m, share))
            scripts[name] = value_tile(f"{number}/{name}", _part(count, row, column) > 0, *parts)
        by_level.append((target / str(number), scripts))
    for path, scripts in reversed(by_level):  # the finest last: then all are there
        _write_level(path, scripts)


def write_heights(series: Series, folder: Path, base: BaseMap) -> None:
    """Write the tiles of the heights of a reference, unless they are there."""
    target, all_levels = folder / HEIGHTS / base.version, levels(base)
    if (target / str(len(all_levels) - 1)).is_dir():
        return
    path = reference_path(series, base.version)
    elevation, sigma_m = (
        np.asarray(open_raster(path, name, None)[base.rows, base.columns])
        for name in ("reference_elevation", "reference_random_uncertainty")
    )
    known = elevation < FILL / 2
    sums = [
        known.astype(np.float32),
        np.where(known, elevation, np.float32(0)),
        np.where(known & (sigma_m < FILL / 2), sigma_m, np.float32(0)) ** 2,
    ]
    if base.factor > 1:
        _write_height_level(target, 0, all_levels[0], sums, 1)
    step, cells = base.factor, base.factor**2
    for number, level in enumerate(all_levels[int(base.factor > 1) :], int(base.factor > 1)):
        sums = [_block_sums(values, step) for values in sums] if step > 1 else sums
        _write_height_level(target, number, level, sums, cells)
        step, cells = STEP, cells * STEP**2


def _write_height_level(target: Path, number: int, level: Level, sums: list[Floats32], cells: int) -> None:
    """Write a level: mean heights, and the random sigma of the reference in the mean of `cells` cells."""
    with np.errstate(invalid="ignore", divide="ignore"):
        height_m = sums[1] / sums[0]
        sigma_m = np.sqrt(sums[2] / sums[0] / cells)
    step_m = 2.0 ** np.floor(np.log2(level.value_m / HEIGHT_STEPS))
    scripts = {}
    for row, column in level.tiles:
        name = f"{row}_{column}"
        part_m, part_sigma_m = (_part(values, row, column) for values in (height_m, sigma_m))
        scripts[name] = height_tile(f"{number}/{name}", part_m, part_sigma_m, step_m)
    _write_level(target / str(number), scripts)


def delete_cells(folder: Path, epoch_file: str, base: BaseMap) -> None:
    """Delete the tiles of the cells of an epoch of which those of means are kept."""
    if base.factor > 1:
        shutil.rmtree(_epoch_folder(folder, epoch_file) / CELLS, ignore_errors=True)


def delete_old_values(folder: Path, keep: Iterable[str], versions: Iterable[str]) -> None:
    """Delete the tiles of epochs and references that are no longer kept, an hour after they were written."""
    shutil.rmtree(folder / "heights", ignore_errors=True)  # of pages before there were tiles of the ground
    for kind, names in ((VALUES, {Path(name).stem for name in keep}), (HEIGHTS, set(versions))):
        for path in (folder / kind).glob("*"):
            if path.name not in names and time.time() - path.stat().st_mtime > DELETE_GRACE_S:
                shutil.rmtree(path, ignore_errors=True)


def describe_levels(base: BaseMap) -> list[dict[str, Any]]:
    """Return what a browser must know of each level of the map of a reference."""
    return [
        {
            "value_m": level.value_m,
            "rows": level.shape[0],
            "columns": level.shape[1],
            "tiles": ["".join("01"[int(known)] for known in row) for row in level.has_tile],
        }
        for level in levels(base)
    ]


def value_codes() -> dict[str, float]:
    """Return how values are coded, for the browser."""
    return {"tile": TILE, "sigma_min_m": SIGMA_MIN_M, "sigma_step": SIGMA_STEP, "share": SHARE}


def _part(values: Floats32, row: int, column: int) -> Floats32:
    return values[row * TILE : (row + 1) * TILE, column * TILE : (column + 1) * TILE]


def _block_sums(values: Floats32, size: int = STEP) -> Floats32:
    """Return sums over blocks of `size` × `size`; those at the east and south edges may be smaller."""
    rows = np.add.reduceat(values, np.arange(0, values.shape[0], size), axis=0)
    return np.asarray(np.add.reduceat(rows, np.arange(0, values.shape[1], size), axis=1))


def _epoch_folder(folder: Path, epoch_file: str) -> Path:
    return folder / VALUES / Path(epoch_file).stem


def _write_level(target: Path, scripts: Mapping[str, bytes]) -> None:
    """Write the tiles of a level, which appear all at once; those that are there already stay."""
    tmp_folder = target.with_name(f".{target.name}.part")
    try:
        shutil.rmtree(tmp_folder, ignore_errors=True)
        tmp_folder.mkdir(parents=True)
        for name, script in scripts.items():
            replace_file(tmp_folder / f"{name}.js", script)
        if target.is_dir():
            shutil.rmtree(tmp_folder)
        else:
            os.replace(tmp_folder, target)  # noqa: PTH105 - as in tiles.py
    except OSError as error:
        raise StoreError(f"{target}: cannot be written: {error}") from error
