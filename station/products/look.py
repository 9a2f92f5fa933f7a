"""An epoch as a picture needs it: as many cells as there are pixels, by means and not by leaving out."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from station.archive.aggregate import Aggregates
from station.archive.layout import Series
from station.archive.rasters import Array, Raster
from station.archive.store import Row
from station.archive.variables import FILL
from station.quantities import Bools, Floats32, Grid
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

Bands = Callable[[slice], Iterable[Array]]  # gives some rows (r, nx) of each of some rasters


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
    count, total = _pass(surface, _Sums(rows, columns, factor, 1))
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


def look_at(row: Row, base: Base, *, points: bool = False) -> Look:
    """See the change of a stored epoch, and how many points its cells have where that is asked for.

    Raises StoreError where the file cannot be read. Inflating it takes nearly all the time.
    """
    looking = Looking(base, points=points)
    _pass(_stored(row.path, row.index, *looking.names), looking.sums)
    return looking.look()


class Looking:
    """A look at an epoch that comes to be as the epoch comes by, some rows of its rasters at a time.

    A pixel's sigma is that of its mean: what cells share is taken as one within a pixel and does not average
    out.
    """

    def __init__(self, base: Base, *, points: bool = False) -> None:
        """Begin; with `points` to tell how many points cells have."""
        self._base = base
        self.names = (CHANGE, SIGMA, RANDOM, *((POINTS,) if points else ()))
        self.sums = _Sums(base.rows, base.columns, base.factor, len(self.names), counted=int(points))

    def add(self, rows: slice, band: Mapping[str, Array]) -> None:
        """Take some rows (r, nx) of the rasters as a file holds them, fill included."""
        self.sums.add(rows.start, (band[name] for name in self.names))

    def look(self) -> Look:
        """See what has come by."""
        count, total, sigma_m2, random_m2, *points = self.sums.totals
        with np.errstate(invalid="ignore", divide="ignore"):
            shared_m2 = np.maximum(sigma_m2 - random_m2, 0) / count
            change_m, sigma_m = total / count, np.sqrt(random_m2 / count**2 + shared_m2)
        cells = self._base.factor**2
        mean_points = [np.where(one > 0, one / cells, np.nan).astype(np.float32) for one in points]
        return Look(self._base, change_m, sigma_m, *mean_points)


def look_between(row: Row, other: Row, base: Base, series: Series) -> Look:
    """Read what changed from another epoch to one, with its sigma.

    What both do not know of one reference surface cancels cell by cell; of what the points of each share,
    what both have wrong does. Raises StoreError where a file cannot be read.
    """
    where = base.rows, base.columns, base.factor
    path = series.folder / f"reference_{base.version}.nc"
    known, height_m, before_m2 = _pass(
        _stored(path, None, "reference_elevation", "reference_random_uncertainty"), _Sums(*where, 2)
    )
    own_m2, change_m = np.zeros(base.shade.shape, np.float32), []
    with np.errstate(invalid="ignore", divide="ignore"):
        for one in (row, other):
            count, total_m, random_m2 = _pass(_stored(one.path, one.index, CHANGE, RANDOM), _Sums(*where, 2))
            change_m.append(total_m / count)
            own_m2 += np.maximum(random_m2 / count - before_m2 / known, 0) / count
        surface_m = height_m / known
    difference_m = change_m[0] - change_m[1]
    seen = np.isfinite(difference_m)
    sigma_m = np.full(seen.shape, np.nan, np.float32)
    shared_m2 = Aggregates(series).shared_between(row, other, base.grid, surface_m, seen)
    sigma_m[seen] = np.sqrt(own_m2[seen] + shared_m2)
    return Look(base, difference_m, sigma_m)


def _stored(path: Path, index: int | None, *names: str) -> Bands:
    rasters = [Raster(path, name, index=index) for name in names]
    return lambda rows: (raster[rows] for raster in rasters)


class _Sums:
    """Sums over blocks of cells, of rasters that come by band by band, as high as they like.

    `totals`: of ones where the first raster has a value, of that, of the others' squares; of the `counted`
    last ones of what they count.
    """

    def __init__(self, rows: slice, columns: slice, factor: int, rasters: int, *, counted: int = 0) -> None:
        self.rows, self._columns, self.factor, self._counted = rows, columns, factor, counted
        shape = (rows.stop - rows.start) // factor, (columns.stop - columns.start) // factor
        self.totals: list[Floats32] = [np.zeros(shape, np.float32) for _ in range(1 + rasters)]

    def add(self, top: int, band: Iterable[Array]) -> None:
        """Add some rows (r, nx) of each raster, the first of which is the grid's `top`."""
        begin, end = (max(edge - top, 0) for edge in (self.rows.start, self.rows.stop))
        first, *others = (_single(values[begin:end, self._columns]) for values in band)
        seen = first < FILL / 2
        last = len(others) - self._counted
        squares = ((values * seen) ** 2 for values in others[:last])
        pixel, skipped = divmod(top + begin - self.rows.start, self.factor)
        for total, values in zip(
            self.totals, (_single(seen), first * seen, *squares, *others[last:]), strict=True
        ):
            blocks = _blocks(values, skipped, self.factor)
            total[pixel : pixel + len(blocks)] += blocks


def _pass(bands: Bands, sums: _Sums) -> list[Floats32]:
    """Return the sums of rasters once all of them have come by."""
    height = max(1, BAND_ROWS // sums.factor) * sums.factor
    for top in range(sums.rows.start, sums.rows.stop, height):
        sums.add(top, bands(slice(top, min(top + height, sums.rows.stop))))
    return sums.totals


def _blocks(values: Floats32, skipped: int, factor: int) -> Floats32:
    """Sum over blocks of cells, of the first of which some rows were skipped.

    Adding every nth row is three times as fast as reshaping.
    """
    rows = np.zeros((-(-(skipped + len(values)) // factor), values.shape[1]), np.float32)
    for first in range(min(factor, len(values))):
        every = values[first::factor]
        at = (skipped + first) // factor
        rows[at : at + len(every)] += every
    total = rows[:, ::factor].copy()
    for first in range(1, factor):
        total += rows[:, first::factor]
    return np.asarray(total)


def _single(values: Array) -> Floats32:
    """Return values in single precision."""
    return values.astype(np.float32, copy=False)


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
