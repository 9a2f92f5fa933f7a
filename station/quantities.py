"""The words of the science: frozen dataclasses of arrays, with the unit in every name.

Angles are radians, lengths metres, temperatures °C, pressures hPa. `(n,)` counts shots, `(ny, nx)` cells
with row 0 in the north.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import IntFlag
from math import radians
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]
Reals = NDArray[np.floating[Any]]  # of either precision
Ints = NDArray[np.int64]
Ints32 = NDArray[np.int32]
Numbers = TypeVar("Numbers", Ints, Ints32)
Bools = NDArray[np.bool_]


UPRIGHT = (0.0, 0.0, 1.0)


@dataclass(frozen=True)
class Shots:
    """A block of laser echoes, in the frame of the scan (scanner's own or map).

    `time_s` is in the scan's own time base, the one its inclination log uses; None where the scan has none.
    """

    xyz_m: Floats  # (3, n)
    time_s: Floats | None  # (n,)
    intensity: Floats | None = None  # (n,) how bright, 0-1; None where the scan does not tell

    def __len__(self) -> int:
        """Return how many echoes there are."""
        return len(self.xyz_m[0])


@dataclass(frozen=True)
class Scanner:
    """What the instrument's maker and the papers say of it."""

    model: str
    wavelength_um: float
    beam_divergence_rad: float  # full angle at 1/e²
    exit_diameter_m: float
    range_sigma_m: float  # of one shot
    angle_resolution_rad: float  # full width of one encoder step
    inclination_sigma_rad: float  # of one sample of the inclination log
    inclination_range_rad: float  # farthest lean its sensor tells, either way
    range_max_m: float
    beam_origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0)  # forward, left, up from the frame's origin


@dataclass(frozen=True)
class InclinationLog:
    """The lean of the scanner as its sensor wrote it, about 1 Hz, uncleaned.

    Roll turns about the scanner's x axis, pitch about its y axis.
    """

    time_s: Floats  # (k,) in the scan's time base
    roll_rad: Floats  # (k,)
    pitch_rad: Floats  # (k,)


@dataclass(frozen=True)
class HeadTrack:
    """Where the scanner's head looked when: azimuth about the scanner's z axis, counter-clockwise from x."""

    time_s: Floats  # (k,) increasing
    azimuth_rad: Floats  # (k,) unwrapped


@dataclass(frozen=True)
class Tilt:
    """The lean to apply to each shot, by time in the scan's time base."""

    time_s: Floats  # (k,) increasing
    roll_rad: Floats  # (k,)
    pitch_rad: Floats  # (k,)


@dataclass(frozen=True)
class Air:
    """The air at the scanner."""

    temperature_c: float
    pressure_hpa: float
    humidity_pct: float


@dataclass(frozen=True)
class WeatherLog:
    """The station's weather record; NaN where a value is missing."""

    time_utc_s: Floats  # (k,) seconds since 1970, increasing
    temperature_c: Floats  # (k,)
    pressure_hpa: Floats  # (k,)
    humidity_pct: Floats  # (k,)


@dataclass(frozen=True)
class Grid:
    """A fixed raster, pixel-exact: `west_m` and `north_m` are outer edges, rows run from north to south."""

    west_m: float
    north_m: float
    cell_m: float
    nx: int
    ny: int

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return (self.ny, self.nx)

    @property
    def x_m(self) -> Floats:
        """Eastings of the cell centres (nx,)."""
        return np.asarray(self.west_m + (np.arange(self.nx) + 0.5) * self.cell_m, dtype=np.float64)

    @property
    def y_m(self) -> Floats:
        """Northings of the cell centres (ny,), descending."""
        return np.asarray(self.north_m - (np.arange(self.ny) + 0.5) * self.cell_m, dtype=np.float64)

    def row_and_column(self, cell: Numbers) -> tuple[Numbers, Numbers]:
        """Row and column of cells (n,) of the flattened grid; `np.divmod` takes six times as long."""
        row = cell // self.nx
        return row, cell - row * self.nx


@dataclass(frozen=True)
class Setup:
    """What stays the same from scan to scan.

    `position_m` is the scanner's place on the map, None where a map-frame scan does not tell it; `axis` the
    direction (east, north, up) its head turns about.
    """

    scanner: Scanner
    grid: Grid
    position_m: tuple[float, float, float] | None
    axis: tuple[float, float, float] = UPRIGHT
    min_points: int = 1
    published_budget: bool = False  # Voordendag et al. (2023) instead of the corrected form
    registration_sigma_m: float = 0.0  # of the published budget
    store_terms: bool = False


@dataclass(frozen=True)
class ChangeErrors:
    """What the change of the moving ground makes wrong in an estimate; scans after like change share it.

    `modes` are errors of the parameters in their own units, one sigma each and independent of each other.
    `pattern` is the change that was found, by sector round the scanner, in sigmas of what was allowed for.
    """

    modes: Floats  # (p, m)
    pattern: Floats  # (s,)


@dataclass(frozen=True)
class Shared:
    """What all points of a scan have in common and nobody knows exactly (EQUATIONS 6.1).

    `estimate` and `covariance` are in the parameters' own units, given by `units`. `noise_variance` is what
    each group of scan lines has of its own beyond the parameter of its place; nought but for the lean.
    `change` is a part of the covariance, that which other scans may have in common with this one.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    estimate: Floats  # (p,)
    covariance: Floats  # (p, p)
    noise_variance: Floats  # (p,)
    change: ChangeErrors | None = None

    def __add__(self, other: Shared) -> Shared:
        """Return what a sum or difference of two independent surfaces leaves unknown."""
        return replace(
            self,
            covariance=self.covariance + other.covariance,
            noise_variance=self.noise_variance + other.noise_variance,
        )


@dataclass(frozen=True)
class Habits:
    """How much a station's scans differ from what is assumed, one sigma each.

    Start values: EQUATIONS 6.4; the tilt of a mount: ADJUSTMENT. A station learns its own.
    """

    tilt_rad: float = radians(0.008)
    heading_rad: float = radians(0.0015)
    translation_m: float = 0.003
    range_bias_m: float = 0.004
    range_scale_ppm: float = 0.8
    refraction: float = 0.08
    refraction_by_azimuth: float = 0.02
    slow_motion_rad: float = radians(0.0018)
    fast_motion_rad: float = radians(0.0010)
    line_motion_rad: float = radians(0.0008)


class Quality(IntFlag):
    """What to know of a cell before using it."""

    FEW_POINTS = 1  # fewer than three
    HIGH_INCIDENCE = 2  # the beam grazes the surface at more than 80°
    OUTSIDE_REFERENCE = 4  # seen, but there is nothing to measure its change from
    STABLE_GROUND = 8
    CHANGE_SIGNIFICANT = 16  # at the 95 % level


LAID_TOGETHER = 32  # rows: so many stay in the cache
MEASURED = np.dtype(
    [
        ("elevation_m", np.float32),
        ("uncertainty_m", np.float32),  # of a single cell, everything included
        ("random_uncertainty_m", np.float32),  # the part of it that averages out
        ("spread_m", np.float32),  # standard deviation of the points in the cell
    ]
)


def _as_it_is(_name: str, column: NDArray[Any]) -> NDArray[Any]:
    return column


@dataclass(frozen=True)
class Measurement:
    """What a scan says of the surface, and how sure that is, cell by cell; all (n,).

    `number` (ny, nx) tells which they are: -1 where the scan saw nothing, and even the reference knows
    nothing. `count` is the number of points; `cells` holds what `MEASURED` names, NaN where the scan saw
    nothing; `terms` the budget of the scan's own heights term by term, where asked for.
    """

    grid: Grid
    number: Ints32
    count: Ints32
    cells: NDArray[np.void]  # of MEASURED
    change_m: Floats32  # mean residual to the reference, NaN where there is none
    quality: NDArray[np.uint8]  # bits of Quality
    terms: dict[str, Floats32]

    @classmethod
    def of(cls, grid: Grid, quality: NDArray[np.uint8], **rasters: NDArray[Any]) -> Measurement:
        """Take rasters (ny, nx), of terms too, in which every cell has its number."""
        number = np.arange(grid.nx * grid.ny, dtype=np.int32).reshape(grid.shape)
        cells = np.empty(number.size, MEASURED)
        for name in MEASURED.names or ():
            cells[name] = rasters.pop(name).ravel()
        columns = {name: one.ravel() for name, one in rasters.items()}
        count, change_m = (columns.pop(name) for name in ("count", "change_m"))
        return cls(grid, number, count, cells, change_m, quality.ravel(), columns)

    def laid(
        self,
        *names: str,
        rows: slice = slice(None),
        made: Callable[[str, NDArray[Any]], NDArray[Any]] = _as_it_is,
    ) -> list[NDArray[Any]]:
        """Lay columns out on some rows of the grid, or all: NaN, or nought, where there is nothing.

        `made` turns the values of a column into what is laid out, NaN or nought for nothing too.
        """
        number = self.number[rows]
        rasters = [np.full(number.shape, made(name, self._nothing(name))) for name in names]
        for first in range(0, len(number), LAID_TOGETHER):
            part = slice(first, first + LAID_TOGETHER)
            there = np.flatnonzero(number[part] >= 0)
            chosen = number[part].reshape(-1)[there]
            cells = self.cells.take(chosen)  # at once: it is the cells that have to be waited for
            for name, raster in zip(names, rasters, strict=True):
                column = self._beside(name)
                values = cells[name] if column is None else column.take(chosen)
                raster[part].reshape(-1)[there] = made(name, values)
        return rasters

    def _nothing(self, name: str) -> NDArray[Any]:
        """Return what stands for nothing in a column (1,)."""
        column = self._beside(name)
        dtype = self.cells.dtype[name] if column is None else column.dtype
        return np.array([np.nan if dtype.kind == "f" else 0], dtype)

    def _beside(self, name: str) -> NDArray[Any] | None:
        """Return a column that is not among the cells."""
        return getattr(self, name) if name in ("count", "change_m", "quality") else self.terms.get(name)


@dataclass(frozen=True)
class Reference:
    """The master surface that change is measured from.

    `elevation_m` holds nodes at the cell centres, NaN where unknown; between them the surface is bilinear.
    """

    grid: Grid
    version: str
    elevation_m: Floats  # (ny, nx)
    random_variance_m2: Floats32  # (ny, nx)
    roughness_m2: Floats32  # (ny, nx) variance of the terrain about the surface within each cell
    shared: Shared | None  # None: given from outside, its shared errors unknown
    scan_ids: tuple[str, ...]
    intensity: Floats32  # (ny, nx) mean brightness, 0-1; NaN where unknown
    variance_factor: Floats32  # (ny, nx) of the cells' random variance as scans show it, against the modelled
    stable: Bools  # (ny, nx) found steep and without change
    habits: Habits  # of the station, as its scans show them
    seen: Floats32  # (ny, nx) share of its scans that saw the cell; NaN where unknown

    @classmethod
    def given(cls, grid: Grid, version: str, elevation_m: Floats, stable: Bools | None = None) -> Reference:
        """Return a surface that comes from outside: exact as far as anybody knows."""
        exact = np.where(np.isfinite(elevation_m), 0.0, np.nan).astype(np.float32)
        return cls(
            grid=grid,
            version=version,
            elevation_m=elevation_m,
            random_variance_m2=exact,
            roughness_m2=exact,
            shared=None,
            scan_ids=(),
            intensity=np.full(grid.shape, np.nan, np.float32),
            variance_factor=np.ones(grid.shape, np.float32),
            stable=np.zeros(grid.shape, bool) if stable is None else stable,
            habits=Habits(),
            seen=np.full(grid.shape, np.nan, np.float32),
        )
