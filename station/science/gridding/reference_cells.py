"""Cells of a reference as the scanner sees them: their geometry and variances, and their classes.

The classes tell which cells are stable, bare or too rough, and so which of them an adjustment uses.
"""

from __future__ import annotations

import math
from enum import IntFlag
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from station.quantities import Bools, Floats32, Grid, Ints, Reals, Reference, Scanner
from station.science.adjustment import ground_classes
from station.science.geometry.observation import Observation
from station.science.geometry.terrain import HALO_ROWS, BilinearSurface, smooth_gradient
from station.science.uncertainty import shot_noise, variance_factors
from station.science.uncertainty.parameters import TILT_KNOTS_PER_REFRACTION, ParameterLayout

MAX_MOVING_CELLS = 400_000  # cells of moving ground that an adjustment uses
MAX_STABLE_CELLS = 800_000  # the same of stable ground, in whole rows; more add no information
BLOCK_CELLS = 50_000  # of passes over all cells, and of sectors if the scanner's position is unknown
MAX_BRIGHTNESS_CELLS = 100_000  # cells whose brightness is compared; of more, a sample
VISIBILITY_BIN_M = 200.0  # range bin in which cells are counted for visibility
MAX_VISIBILITY_CELLS = 500_000  # cells counted for visibility; of more, a sample
MIN_ENCLOSED_SHARE = 0.3  # of the even cells of a kind; if fewer are, those at gaps are used too
MAX_MOVING_RATIO, MAX_STABLE_RATIO = 0.5, 0.7  # sampling ratio of cells that an adjustment uses
HIGH_INCIDENCE_COS = float(np.cos(np.radians(80.0)))

FLOAT_ARRAYS = [
    "height_m",
    "mean_residual_m",
    "east_gradient",
    "north_gradient",
    "knot_position",
    "shot_m2",
    "point_variance_m2",
    "reference_variance_m2",
    "intensity",
    "visibility",
]
CELL_ARRAYS = {  # per cell, by name
    "cell": np.int32,
    **dict.fromkeys(FLOAT_ARRAYS, np.float32),
    "point_count": np.float16,
    "visibility_bin": np.int32,
    "cell_class": np.uint8,
    "noise_class": np.uint8,
}
VISIBILITY_ARRAYS = ("visibility", "visibility_bin")  # for the `sampled` cells only

Position = tuple[float, float, float]
Array = NDArray[Any]


class CellClass(IntFlag):
    """Classes of a cell, as long as its intensity has not changed."""

    STABLE = 1
    HOLDOUT = 2  # if stable: excluded from every fit
    SMOOTH = 4  # flat enough to change like its neighbours
    GRAZING = 8  # incidence above 80°
    STEEP = 16  # above 50°: sheds its snow
    ENCLOSED = 32  # all cells around it are known
    EVEN = 64  # of so little roughness that a tilt of the scanner has the expected effect
    BARE = 128  # not known to be stable, but as bright as stable ground: rock, not ice or snow


def cell_arrays(
    reference: Reference,
    rows: slice,
    surface: BilinearSurface,
    stable: Bools,
    scanner: Scanner,
    params: ParameterLayout | None,
    position_m: Position | None,
    *,
    published: bool,
) -> dict[str, Array]:
    """Return the arrays of `ViewingGeometry.cells` for the known cells of some rows."""
    grid, known = reference.grid, surface.cell_index[rows] >= 0
    row, column = np.nonzero(known)
    first = max(rows.start - HALO_ROWS, 0)
    window_m = np.where(
        np.isfinite(reference.elevation_m[first : rows.stop + HALO_ROWS]),
        reference.elevation_m[first : rows.stop + HALO_ROWS] - surface.datum_m,
        np.nan,
    )
    inner = slice(rows.start - first, rows.stop - first)
    gradient = smooth_gradient(window_m, grid.cell_m, rows=inner)
    neighbours_known = ndimage.binary_erosion(np.isfinite(window_m), np.ones((3, 3), bool), border_value=1)
    east, north = (np.nan_to_num(raster[known].astype(np.float64)) for raster in gradient)
    surface_east, surface_north = surface.cell_gradients(rows)  # of what residuals are relative to
    x_m, y_m, height_m = grid.x_m[column], grid.y_m[rows][row], surface.cell_means(rows)[known]
    cell_class = np.where(stable[known], CellClass.STABLE, 0) | np.where(
        ground_classes.is_holdout(x_m, y_m), CellClass.HOLDOUT, 0
    )
    slope = grid.plane.tan_slope(east, north)
    cell_class |= np.where(slope < ground_classes.MAX_MOVING_SLOPE, CellClass.SMOOTH, 0)
    cell_class |= np.where(slope > ground_classes.MIN_BARE_SLOPE, CellClass.STEEP, 0)
    knot_position: Reals = np.zeros(len(row))
    noise_class: Ints = np.zeros(len(row), np.int64)
    visibility_bin: Ints = np.zeros(len(row), np.int64)
    shot_m2 = np.full(len(row), scanner.range_sigma_m**2)
    if params is not None and position_m is not None:
        observation = Observation.from_points(
            (x_m, y_m, window_m[inner][known] + surface.datum_m), position_m, east, north
        )
        knot_position, shot_m2 = (
            params.knot_position(observation.offset_m),
            shot_noise.height_variance(observation, scanner, published=published),
        )
        cell_class |= np.where(observation.cos_incidence < HIGH_INCIDENCE_COS, CellClass.GRAZING, 0)
        roughness_m = np.sqrt(reference.roughness_m2[rows][known] * reference.variance_factor[rows][known])
        ratio = sampling_ratio(roughness_m, grid.cell_m, observation.cos_incidence)
        limit = np.where(stable[known], MAX_STABLE_RATIO, MAX_MOVING_RATIO)
        enclosed = neighbours_known[inner][known]
        cell_class |= np.where(enclosed, CellClass.ENCLOSED, 0) | np.where(ratio < limit, CellClass.EVEN, 0)
        last = np.nextafter(np.float32(params.knot_intervals), np.float32(0))
        knot_position = np.minimum(knot_position.astype(np.float32), last)
        range_m = grid.plane.horizontal_m(observation.offset_m)
        noise_class = variance_factors.noise_class(range_m, ratio, enclosed)
        range_bins = visibility_bins(grid, position_m)
        range_bin = np.minimum((range_m / VISIBILITY_BIN_M).astype(np.int64), range_bins - 1)
        sector = (knot_position / TILT_KNOTS_PER_REFRACTION).astype(np.int64)
        visibility_bin = sector * range_bins + range_bin
    if published:
        point_variance_m2, reference_variance_m2 = shot_m2, np.zeros(len(row), np.float32)
    else:
        point_variance_m2 = (shot_m2 + reference.roughness_m2[rows][known]) * reference.variance_factor[rows][
            known
        ]
        reference_variance_m2 = reference.random_variance_m2[rows][known]
    return {
        "cell": (rows.start + row) * grid.nx + column,
        "height_m": height_m - surface.datum_m,
        "mean_residual_m": reference.mean_residual_m[rows][known],
        "east_gradient": surface_east[known],
        "north_gradient": surface_north[known],
        "knot_position": knot_position,
        "shot_m2": shot_m2,
        "point_variance_m2": point_variance_m2,
        "reference_variance_m2": reference_variance_m2,
        "intensity": reference.intensity[rows][known],
        "visibility": reference.visibility[rows][known],
        "point_count": reference.point_count[rows][known],
        "visibility_bin": visibility_bin,
        "cell_class": cell_class,
        "noise_class": noise_class,
    }


def mark_bare(
    cells: dict[str, Array], grid: Grid, position_m: Position, datum_m: float, wavelength_um: float
) -> None:
    """Add the class `BARE` to cells that are as bright as the stable ground at their range."""

    def brightness(block: slice) -> tuple[Floats32, Reals, Reals]:
        row, column = grid.row_and_column(cells["cell"][block])
        observation = Observation.from_points(
            (grid.x_m[column], grid.y_m[row], cells["height_m"][block] + datum_m),
            position_m,
            cells["east_gradient"][block],
            cells["north_gradient"][block],
        )
        range_m = grid.plane.horizontal_m(observation.offset_m)
        return cells["intensity"][block], range_m, observation.cos_incidence

    count = len(cells["cell"])
    sample = slice(None, count, 1 + count // MAX_BRIGHTNESS_CELLS)
    stable, smooth = (
        (cells["cell_class"][sample] & np.uint8(flag)) > 0 for flag in (CellClass.STABLE, CellClass.SMOOTH)
    )
    rock = ground_classes.rock_brightness(*brightness(sample), stable, smooth & ~stable, wavelength_um)
    for first in range(0, count, BLOCK_CELLS):
        block = slice(first, first + BLOCK_CELLS)
        cell_class = cells["cell_class"][block]
        bare = rock.resembles(*brightness(block)) & ((cell_class & np.uint8(CellClass.STABLE)) == 0)
        cell_class |= np.where(bare, np.uint8(CellClass.BARE), np.uint8(0))


def sampling_ratio(roughness_m: Reals, cell_m: float, cos_incidence: Reals) -> Reals:
    """Return the error of the surface's slope within cells (n,) over the sine of the grazing angle [1].

    When the scanner tilts, its shots move along the ground. On ground of another slope than the surface their
    heights are off by this share of the shift across the line of sight. `roughness_m` is the standard
    deviation of the terrain about the surface, which for a plane is cell × slope / √12.
    Source: equations.md, 4.12.
    """
    return np.asarray(math.sqrt(12) * roughness_m / cell_m / np.maximum(cos_incidence, 1e-3))


def visibility_step(count: int) -> slice:
    """Return the slice of `count` cells that are counted for visibility."""
    return slice(None, count, 1 + count // MAX_VISIBILITY_CELLS)


def visibility_bins(grid: Grid, position_m: Position) -> int:
    """Return the number of range bins from the scanner to the farthest cell of a grid."""
    row, column = np.array([0, 0, -1, -1]), np.array([0, -1, 0, -1])  # of the corners
    return int(grid.horizontal_range_m(row, column, position_m).max() / VISIBILITY_BIN_M) + 1


def _well_sampled(cell_class: Array) -> Bools:
    """Return True for cells (n,) that an adjustment may use.

    Cells at gaps are left out, because there the surface has the slope of a plane only, unless most cells of
    their kind are: moving ground, stable ground, and steep stable ground, which alone is known to be bare.
    """
    stable, steep, even, enclosed = (
        (cell_class & np.uint8(flag)) > 0
        for flag in (CellClass.STABLE, CellClass.STEEP, CellClass.EVEN, CellClass.ENCLOSED)
    )
    usable = even & enclosed
    for kind in (~stable & even, stable & ~steep & even, stable & steep & even):
        if np.count_nonzero(usable & kind) < MIN_ENCLOSED_SHARE * np.count_nonzero(kind):
            usable |= kind
    return usable


def sampled_cells(grid: Grid, cell: Array, cell_class: Array) -> tuple[Bools, tuple[int, int]]:
    """Return the mask (n,) of cells for an adjustment, and the sampling steps of moving and of stable cells.

    If there are too many, stable cells are sampled in whole rows, the others in a regular pattern.
    """
    stable, usable = (cell_class & np.uint8(CellClass.STABLE)) > 0, _well_sampled(cell_class)
    row, column = grid.row_and_column(cell)
    step = 1 + int(np.count_nonzero(stable & usable)) // MAX_STABLE_CELLS
    column_step = 1 + int(np.count_nonzero(usable)) // (step * MAX_MOVING_CELLS)
    used = usable & (row % step == 0) & (stable | ((row // step + column) % column_step == 0))
    return used, (step * column_step, step)
