"""An epoch as a picture needs it: as many cells as there are pixels, by means and not by leaving out."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from station.archive.aggregate import Aggregates
from station.archive.layout import Series
from station.archive.rasters import Raster
from station.archive.store import COLUMNS, Row
from station.archive.variables import FILL
from station.quantities import Bools, Floats32, Grid, Measurement
from station.science.change import significant

BAND_ROWS = 128  # that a file holds together
SUN = (-0.55, 0.55, 0.63)  # east, north, up: from the north-west, as maps have it
STEEPER = 1.5  # that the terrain is shown
CHANGE, SIGMA, RANDOM = (
    "elevation_change",
    "elevation_change_uncertainty",
    "elevation_change_random_uncertainty",
)
POINTS = "point_count"

Bands = Callable[[slice], Iterable[np.ndarray[Any, Any]]]  # gives some rows (r, nx) of each of some rasters


@dataclass(frozen=True)
class Base:
    """What all pictures of a reference have in common: the part of the grid they show, and its terrain."""

    version: str
    factor: int  # cells along a pixel's side
    rows: slice  # of the grid's cells, whole pixels
    columns: slice
    shade: Floats32  # (ny, nx) brightness of the terrain, 0-1; NaN where unknown
    grid: Grid  # of the pixels


@dataclass(frozen=True)
class Look:
    """An epoch in pixels (ny, nx): means over their cells, with one sigma of these means."""

    base: Base
    change_m: Floats32  # NaN where not seen
    sigma_m: Floats32
    points: Floats32 | None = None  # per cell, NaN where not seen; None where not asked for

    @property
    def seen(self) -> Bools:
        """Where there is a change."""
        return np.isfinite(self.change_m)

    @property
    def is_significant(self) -> Bools:
        """Where the change is more than its sigma explains, at 95 %."""
        return significant(self.change_m, self.sigma_m)


def base_of(series: Series, version: str, pixels: int) -> Base:
    """Prepare pictures of a reference's version, of about so many pixels along their longer side.

    They show the part of the grid where the surface is known. Raises StoreError where it is not there.
    """
    path = series.folder / f"reference_{version}.nc"
    grid = series.grid
    surface = _stored(path, None, "reference_elevation")
    rows, columns = _known(surface, grid)
    longer = max(rows.stop - rows.start, columns.stop - columns.start)
    factor = max(1, longer // pixels)
    rows, columns = (_whole(part, factor, n) for part, n in ((rows, grid.ny), (columns, grid.nx)))
    count, total = _sums(surface, rows, columns, factor)
    with np.errstate(invalid="ignore"):
        elevation_m = total / count
    part = Grid(
        grid.west_m + columns.start * grid.cell_m,
        grid.north_m - rows.start * grid.cell_m,
        grid.cell_m * factor,
        elevation_m.shape[1],
        elevation_m.shape[0],
    )
    return Base(version, factor, rows, columns, _shade(elevation_m, part.cell_m), part)


def look_at(epoch: Row | Measurement, base: Base, *, points: bool = False) -> Look:
    """See the change of an epoch, and how many points its cells have where that is asked for.

    It is read from the store, or taken as it was just measured: to inflate it takes five times as long. A
    pixel's sigma is that of its mean: what cells share does not average out. Raises StoreError where the file
    cannot be read.
    """
    counted = (POINTS,) if points else ()
    if base.factor == 1:
        cells = _bands(epoch, CHANGE, SIGMA, *counted)(base.rows)
        change_m, sigma_m, *total = (_cells(values, base.columns) for values in cells)
    else:
        change_m, sigma_m, *total = _means(epoch, base, *counted)
    mean_points = [np.where(one > 0, one / base.factor**2, np.nan).astype(np.float32) for one in total]
    return Look(base, change_m, sigma_m, *mean_points)


def look_between(row: Row, other: Row, base: Base, series: Series) -> Look:
    """Read what changed from another epoch to one, with its sigma.

    What both do not know of one reference surface cancels cell by cell; of what the points of each share,
    what both have wrong does. Raises StoreError where a file cannot be read.
    """
    where = base.rows, base.columns, base.factor
    path = series.folder / f"reference_{base.version}.nc"
    known, height_m, before_m2 = _sums(
        _stored(path, None, "reference_elevation", "reference_random_uncertainty"), *where
    )
    own_m2, change_m = np.zeros(base.shade.shape, np.float32), []
    with np.errstate(invalid="ignore", divide="ignore"):
        for one in (row, other):
            count, total_m, random_m2 = _sums(_bands(one, CHANGE, RANDOM), *where)
            change_m.append(total_m / count)
            own_m2 += np.maximum(random_m2 / count - before_m2 / known, 0) / count
        surface_m = height_m / known
    difference_m = change_m[0] - change_m[1]
    seen = np.isfinite(difference_m)
    sigma_m = np.full(seen.shape, np.nan, np.float32)
    shared_m2 = Aggregates(series).shared_between(row, other, base.grid, surface_m, seen)
    sigma_m[seen] = np.sqrt(own_m2[seen] + shared_m2)
    return Look(base, difference_m, sigma_m)


def _bands(epoch: Row | Measurement, *names: str) -> Bands:
    if isinstance(epoch, Row):
        return _stored(epoch.path, epoch.index, *names)
    return lambda rows: epoch.laid(*(COLUMNS[name] for name in names), rows=rows)


def _stored(path: Path, index: int | None, *names: str) -> Bands:
    rasters = [Raster(path, name, index=index) for name in names]
    return lambda rows: (raster[rows] for raster in rasters)


def _means(epoch: Row | Measurement, base: Base, *counted: str) -> tuple[Floats32, ...]:
    """Mean change of blocks of cells and its sigma: what they share is taken as one within a block.

    And the sums of rasters that count something.
    """
    bands, where = _bands(epoch, CHANGE, SIGMA, RANDOM, *counted), (base.rows, base.columns, base.factor)
    count, total, sigma_m2, random_m2, *totals = _sums(bands, *where, len(counted))
    with np.errstate(invalid="ignore", divide="ignore"):
        shared_m2 = np.maximum(sigma_m2 - random_m2, 0) / count
        return total / count, np.sqrt(random_m2 / count**2 + shared_m2), *totals


def _sums(bands: Bands, rows: slice, columns: slice, factor: int, counted: int = 0) -> list[Floats32]:
    """Sums over blocks of cells: of ones where the first raster has a value, of that, of the others' squares.

    Of the `counted` last ones it is what they count. Band by band; of what is stored, inflating it takes
    nearly all the time.
    """
    told = []
    height = max(1, BAND_ROWS // factor) * factor
    for top in range(rows.start, rows.stop, height):
        part = bands(slice(top, min(top + height, rows.stop)))
        first, *others = (_filled(values, columns) for values in part)
        seen = first < FILL / 2
        first *= seen
        last = len(others) - counted
        squares = ((values * seen) ** 2 for values in others[:last])
        summed = seen.astype(np.float32), first, *squares, *others[last:]
        told.append([_blocks(values, factor) for values in summed])
    return [np.concatenate(parts) for parts in zip(*told, strict=True)]


def _blocks(values: Floats32, factor: int) -> Floats32:
    """Sum over blocks of cells; adding every nth row is three times as fast as reshaping."""
    rows = values[::factor].copy()
    for first in range(1, factor):
        rows += values[first::factor]
    total = rows[:, ::factor].copy()
    for first in range(1, factor):
        total += rows[:, first::factor]
    return np.asarray(total)


def _filled(values: np.ndarray[Any, Any], columns: slice) -> Floats32:
    """Return some columns as they stand in a file, with the fill where they have no value."""
    part = values[:, columns].astype(np.float32)
    return np.fmin(part, np.float32(FILL), out=part)


def _cells(raster: np.ndarray[Any, Any], columns: slice) -> Floats32:
    """Return some columns, NaN where they have no value."""
    values = _filled(raster, columns)
    values[values > FILL / 2] = np.nan
    return values


def _known(surface: Bands, grid: Grid) -> tuple[slice, slice]:
    """Rows and columns of the grid between which the surface is known somewhere."""
    rows, columns = np.zeros(grid.ny, bool), np.zeros(grid.nx, bool)
    for top in range(0, grid.ny, BAND_ROWS):
        (values,) = surface(slice(top, min(top + BAND_ROWS, grid.ny)))
        known = values < FILL / 2
        rows[top : top + BAND_ROWS] = known.any(axis=1)
        columns |= known.any(axis=0)
    if not rows.any():
        return slice(0, grid.ny), slice(0, grid.nx)
    first, last = (np.flatnonzero(part)[[0, -1]] for part in (rows, columns))
    return slice(int(first[0]), int(first[1]) + 1), slice(int(last[0]), int(last[1]) + 1)


def _whole(part: slice, factor: int, size: int) -> slice:
    """Widen or, at the border of the grid, cut a range to whole pixels."""
    pixels = min(-(-(part.stop - part.start) // factor), size // factor)
    start = min(part.start, size - pixels * factor)
    return slice(start, start + pixels * factor)


def _shade(elevation_m: Floats32, cell_m: float) -> Floats32:
    """Brightness of a surface in the sun, 0 to 1; level where a neighbour is unknown."""
    if min(elevation_m.shape) < 2:
        return np.where(np.isfinite(elevation_m), np.float32(0.63), np.float32(np.nan))
    north, east = np.gradient(elevation_m, cell_m)
    east, north = (STEEPER * np.nan_to_num(part) for part in (east, -north))
    bright = (SUN[2] - east * SUN[0] - north * SUN[1]) / np.sqrt(1 + east**2 + north**2)
    return np.where(np.isfinite(elevation_m), np.clip(bright, 0, 1), np.nan).astype(np.float32)
