"""Overviews of an epoch: its rasters averaged, not subsampled, to the resolution of an image."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from station.archive.derived.computed_rasters import CHANGE, RANDOM, TOTAL, open_raster
from station.archive.epochs import EpochRef
from station.archive.netcdf_layout import Series
from station.archive.raster_io import Array
from station.archive.schema import FILL
from station.quantities import Bools, Floats32, Grid
from station.queries.aggregates import Aggregates
from station.science.gridding.significance import significant

BAND_ROWS = 128  # per chunk of a file
SUN = (-0.55, 0.55, 0.63)  # east, north, up: from the north-west, as is usual for maps
VERTICAL_EXAGGERATION = 1.5  # of the hillshade
POINTS = "point_count"

BandReader = Callable[[slice], Iterable[Array]]  # returns some rows (r, nx) of each raster


@dataclass(frozen=True)
class BaseMap:
    """What all maps of a reference version share: the part of the grid they show, and its hillshade."""

    version: str
    factor: int  # cells per pixel along each axis
    rows: slice  # of the grid's cells, whole pixels
    columns: slice
    hillshade: Floats32  # (ny, nx) brightness of the terrain, 0-1; NaN where unknown
    grid: Grid  # of the pixels


@dataclass(frozen=True)
class Overview:
    """An epoch in pixels (ny, nx): means over their cells, with the sigma of these means [m]."""

    base: BaseMap
    change_m: Floats32  # NaN where not observed
    sigma_m: Floats32
    points: Floats32 | None = None  # per cell, NaN where not observed; None if not requested
    count: Floats32 | None = None  # cells observed; None for a difference of two epochs
    random_m2: Floats32 | None = None  # random variance of the mean

    @property
    def observed(self) -> Bools:
        """True where there is a change (ny, nx)."""
        return np.isfinite(self.change_m)

    @property
    def is_significant(self) -> Bools:
        """True where the change is significant at 95 % (ny, nx)."""
        return significant(self.change_m, self.sigma_m)


def base_map(series: Series, version: str, pixels: int) -> BaseMap:
    """Return the base map of a reference version, with about `pixels` pixels along its longer side.

    It shows the part of the grid where the surface is known. Raises StoreError if the file is missing.
    """
    path = series.folder / f"reference_{version}.nc"
    grid = series.grid
    surface = _band_reader(path, None, "reference_elevation")
    rows, columns = _known_extent(surface, grid)
    longer = max(rows.stop - rows.start, columns.stop - columns.start)
    factor = max(1, longer // pixels)
    rows, columns = (_whole_pixels(part, factor, n) for part, n in ((rows, grid.ny), (columns, grid.nx)))
    count, total = _accumulate(surface, _BlockSums(rows, columns, factor, 1))
    with np.errstate(invalid="ignore"):
        elevation_m = total / count
    part = Grid(
        grid.west_m + columns.start * grid.cell_m,
        grid.north_m - rows.start * grid.cell_m,
        grid.cell_m * factor,
        elevation_m.shape[1],
        elevation_m.shape[0],
        grid.plane,
    )
    return BaseMap(version, factor, rows, columns, _hillshade(elevation_m, part.cell_m), part)


def read_overview(epoch: EpochRef, base: BaseMap, *, points: bool = False) -> Overview:
    """Return the overview of a stored epoch, including the points per cell if `points`.

    Raises StoreError if the file cannot be read. Inflating it takes nearly all the time.
    """
    builder = OverviewBuilder(base, points=points)
    _accumulate(_band_reader(epoch.path, epoch.index, *builder.names), builder.sums)
    return builder.build()


class OverviewBuilder:
    """Builds the overview of an epoch while it is read or written, some rows of its rasters at a time.

    The sigma of a pixel is that of its mean: systematic errors are fully correlated within a pixel and do not
    average out.
    """

    def __init__(self, base: BaseMap, *, points: bool = False) -> None:
        """Start an empty overview; with `points`, it includes the points per cell."""
        self._base = base
        self.names = (CHANGE, TOTAL, RANDOM, *((POINTS,) if points else ()))
        self.sums = _BlockSums(
            base.rows, base.columns, base.factor, len(self.names), count_rasters=int(points)
        )

    def add(self, rows: slice, band: Mapping[str, Array]) -> None:
        """Add some rows (r, nx) of the rasters as stored, fill values included."""
        self.sums.add(rows.start, (band[name] for name in self.names))

    def build(self) -> Overview:
        """Return the overview of the rows added so far."""
        count, total, sigma_m2, random_m2, *points = self.sums.totals
        with np.errstate(invalid="ignore", divide="ignore"):
            shared_m2 = np.maximum(sigma_m2 - random_m2, 0) / count
            random_m2 = random_m2 / count**2
            change_m, sigma_m = total / count, np.sqrt(random_m2 + shared_m2)
        cells = self._base.factor**2
        mean_points = None
        if points:
            mean_points = np.where(points[0] > 0, points[0] / cells, np.nan).astype(np.float32)
        return Overview(self._base, change_m, sigma_m, mean_points, count, random_m2)


def difference_overview(epoch: EpochRef, other: EpochRef, base: BaseMap, series: Series) -> Overview:
    """Return the overview of an epoch minus another, with its sigma [m].

    The random error of a common reference surface cancels cell by cell; of the systematic errors, the part
    common to both epochs cancels. Raises StoreError if a file cannot be read.
    """
    window = base.rows, base.columns, base.factor
    path = series.folder / f"reference_{base.version}.nc"
    known, height_m, reference_m2 = _accumulate(
        _band_reader(path, None, "reference_elevation", "reference_random_uncertainty"),
        _BlockSums(*window, 2),
    )
    independent_m2, change_m = np.zeros(base.hillshade.shape, np.float32), []
    with np.errstate(invalid="ignore", divide="ignore"):
        for ref in (epoch, other):
            count, total_m, random_m2 = _accumulate(
                _band_reader(ref.path, ref.index, CHANGE, RANDOM), _BlockSums(*window, 2)
            )
            change_m.append(total_m / count)
            independent_m2 += np.maximum(random_m2 / count - reference_m2 / known, 0) / count
        surface_m = height_m / known
    difference_m = change_m[0] - change_m[1]
    observed = np.isfinite(difference_m)
    sigma_m = np.full(observed.shape, np.nan, np.float32)
    shared_m2 = Aggregates(series).shared_variance_between(epoch, other, base.grid, surface_m, observed)
    sigma_m[observed] = np.sqrt(independent_m2[observed] + shared_m2)
    return Overview(base, difference_m, sigma_m)


def _band_reader(path: Path, index: int | None, *names: str) -> BandReader:
    rasters = [open_raster(path, name, index) for name in names]
    return lambda rows: (raster[rows] for raster in rasters)


class _BlockSums:
    """Sums over blocks of cells, of rasters that are added in bands of any height.

    `totals`: the number of values of the first raster, their sum, and the sums of squares of the other
    rasters; of the last `count_rasters`, the plain sums.
    """

    def __init__(
        self, rows: slice, columns: slice, factor: int, rasters: int, *, count_rasters: int = 0
    ) -> None:
        self.rows, self._columns, self.factor, self._count_rasters = rows, columns, factor, count_rasters
        shape = (rows.stop - rows.start) // factor, (columns.stop - columns.start) // factor
        self.totals: list[Floats32] = [np.zeros(shape, np.float32) for _ in range(1 + rasters)]

    def add(self, top: int, band: Iterable[Array]) -> None:
        """Add some rows (r, nx) of each raster, starting at row `top` of the grid."""
        begin, end = (max(edge - top, 0) for edge in (self.rows.start, self.rows.stop))
        first, *others = (_to_float32(values[begin:end, self._columns]) for values in band)
        observed = first < FILL / 2
        squared_count = len(others) - self._count_rasters
        squares = ((values * observed) ** 2 for values in others[:squared_count])
        pixel, skipped = divmod(top + begin - self.rows.start, self.factor)
        for total, values in zip(
            self.totals,
            (_to_float32(observed), first * observed, *squares, *others[squared_count:]),
            strict=True,
        ):
            blocks = _block_sums(values, skipped, self.factor)
            total[pixel : pixel + len(blocks)] += blocks


def _accumulate(bands: BandReader, sums: _BlockSums) -> list[Floats32]:
    """Return the sums over all bands of the rasters."""
    height = max(1, BAND_ROWS // sums.factor) * sums.factor
    for top in range(sums.rows.start, sums.rows.stop, height):
        sums.add(top, bands(slice(top, min(top + height, sums.rows.stop))))
    return sums.totals


def _block_sums(values: Floats32, skipped: int, factor: int) -> Floats32:
    """Return the sums over blocks of cells; the first block lacks its first `skipped` rows.

    Adding every nth row is three times as fast as reshaping.
    """
    rows = np.zeros((-(-(skipped + len(values)) // factor), values.shape[1]), np.float32)
    for first in range(min(factor, len(values))):
        strided = values[first::factor]
        block = (skipped + first) // factor
        rows[block : block + len(strided)] += strided
    total = rows[:, ::factor].copy()
    for first in range(1, factor):
        total += rows[:, first::factor]
    return np.asarray(total)


def _to_float32(values: Array) -> Floats32:
    """Return values in single precision."""
    return values.astype(np.float32, copy=False)


def _known_extent(surface: BandReader, grid: Grid) -> tuple[slice, slice]:
    """Return the rows and columns of the grid that enclose the known part of the surface."""
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


def _whole_pixels(part: slice, factor: int, size: int) -> slice:
    """Return a range widened or, at the border of the grid, cut to whole pixels."""
    pixels = min(-(-(part.stop - part.start) // factor), size // factor)
    start = min(part.start, size - pixels * factor)
    return slice(start, start + pixels * factor)


def _hillshade(elevation_m: Floats32, cell_m: float) -> Floats32:
    """Return the hillshade of a surface, 0 to 1 (ny, nx); flat where a neighbour is unknown."""
    if min(elevation_m.shape) < 2:
        return np.where(np.isfinite(elevation_m), np.float32(0.63), np.float32(np.nan))
    north, east = np.gradient(elevation_m, cell_m)
    east, north = (VERTICAL_EXAGGERATION * np.nan_to_num(part) for part in (east, -north))
    bright = (SUN[2] - east * SUN[0] - north * SUN[1]) / np.sqrt(1 + east**2 + north**2)
    return np.where(np.isfinite(elevation_m), np.clip(bright, 0, 1), np.nan).astype(np.float32)
