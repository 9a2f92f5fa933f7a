"""What the scanner looks at: the cells that a reference knows, and all that no scan changes of them.

A station stands still: how a cell lies, how it is seen and how sure one shot of it is stay the same from
scan to scan. So they are worked out once, and laid in the order in which the head comes by.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from enum import IntFlag
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from station.quantities import UPRIGHT, Bools, Floats32, Grid, Ints, Ints32, Reals, Reference, Scanner
from station.science import ground, shared, terrain
from station.science.shared import LEAN_PER_REFRACTION, Basis, Sensitivities
from station.science.terrain import MARGIN_ROWS, Ground, smooth_gradient
from station.science.view import View

MOVING_MOST = 400_000  # cells of moving ground that an adjustment looks at
STABLE_MOST = 800_000  # the same of stable ground, in whole rows; so many tell all there is to tell
TOGETHER = 50_000  # cells of a sector where nobody knows the head
STRETCH_M = 200.0  # of range, whose cells are counted together
COUNTED_MOST = 500_000  # cells that are counted of what scans usually see; of more a part
HIGH_INCIDENCE_COS = float(np.cos(np.radians(80.0)))

SINGLES = [
    "height_m",
    "east_gradient",
    "north_gradient",
    "passed",
    "shot_m2",
    "scatter_m2",
    "before_m2",
    "intensity",
    "usual",
]
CELLS = {  # of an outlook
    "cell": np.int32,
    **dict.fromkeys(SINGLES, np.float32),
    "place": np.int32,
    "trait": np.uint8,
}
COUNTED = ("usual", "place")  # of these, that are of the cells that are counted

Position = tuple[float, float, float]
Array = NDArray[Any]


class Trait(IntFlag):
    """What a cell is, as long as it looks as it did."""

    STABLE = 1
    WITHHELD = 2  # of stable ground, from every fit
    SMOOTH = 4  # flat enough to change as its neighbours do
    GRAZED = 8  # the beam comes in at more than 80°


@dataclass(frozen=True)
class Sector:
    """Known cells (n,) between two knots of the lean, by number."""

    cell: Ints32  # in the flattened grid
    height_m: Floats32  # mean of the reference over the cell, above its datum
    east_gradient: Floats32
    north_gradient: Floats32
    passed: Floats32  # knots of the lean before it, in fractions
    scatter_m2: Floats32  # random variance of one shot and of roughness, as scans have shown it
    before_m2: Floats32  # random variance of the reference
    trait: NDArray[np.uint8]

    def __len__(self) -> int:
        """Return how many cells there are."""
        return len(self.cell)

    def some(self, chosen: Ints) -> Sector:
        """Return the chosen cells."""
        return Sector(*(getattr(self, one.name).take(chosen) for one in fields(self)))

    def having(self, trait: Trait) -> Bools:
        """Tell which cells have a trait."""
        return np.asarray((self.trait & np.uint8(trait)) > 0)


@dataclass(frozen=True)
class Outlook:
    """A reference as seen from one place. No place: on the map, by others' registration.

    `rise_m` and `number` (ny, nx) are those of `terrain.Ground`, above `datum_m`. `cells` are, by number, the
    fields of `Sector` (n,), `shot_m2`, the random variance of one shot, and `intensity`. Of these `bounds`
    part the sectors, each into the cells that an adjustment looks at and the others: of very many a part
    tells all there is to tell. So it does of those that are `counted`: `usual`, the share of the reference's
    scans that saw the cell, and `place`, in which of `places`. Arrays may be read only as they are sliced.
    """

    reference: Reference
    of: Basis | None
    position_m: Position | None
    datum_m: float
    rise_m: Floats32
    number: Ints32
    bounds: Ints  # (2 sectors + 1,)
    one_in: tuple[int, int]  # of so many cells an adjustment looks at one: of moving ones, of stable ones
    cells: Mapping[str, Array]

    @property
    def grid(self) -> Grid:
        """The grid it lies on."""
        return self.reference.grid

    @property
    def places(self) -> tuple[int, int]:
        """How many sectors of the head's azimuth and stretches of range cells are counted by."""
        assert self.of is not None  # noqa: S101 - the callers' case
        assert self.position_m is not None  # noqa: S101 - the callers' case
        return self.of.intervals // LEAN_PER_REFRACTION, _stretches(self.grid, self.position_m)

    @property
    def counted(self) -> slice:
        """Which cells are counted of what scans usually see."""
        return counted(int(self.bounds[-1]))

    def ground(self) -> Ground:
        """Return the reference as shots look it up."""
        return Ground(self.grid, self.datum_m, np.asarray(self.rise_m), self.number)

    def sectors(self, *, looked_at: bool = False) -> Iterator[tuple[int, Sector]]:
        """Give the sectors that have cells, or only those cells that an adjustment looks at.

        Each with the number of its first cell.
        """
        last = 1 if looked_at else 2
        for first, end in zip(self.bounds[:-1:2].tolist(), self.bounds[last::2].tolist(), strict=True):
            if end > first:
                yield first, Sector(**{one.name: self.cells[one.name][first:end] for one in fields(Sector)})

    def intensity(self, number: Ints) -> Floats32:
        """Brightness of the reference in cells (n,) of a sector, by rising number."""
        first, last = number[0], number[-1]
        return np.asarray(self.cells["intensity"][first : last + 1].take(number - first))

    def having(self, *traits: Trait) -> Ints:
        """Return the numbers (m,) of the cells that have all these traits."""
        wanted = np.uint8(sum(traits))
        return np.flatnonzero((self.cells["trait"][:] & wanted) == wanted)

    def offset_m(self, cell: Ints32, height_m: Floats32) -> tuple[Floats32, Floats32, Floats32]:
        """Way from the scanner to cells (n,) of such a height, eastward, northward and up [m]."""
        assert self.position_m is not None  # noqa: S101 - the callers' case
        row, column = self.grid.row_and_column(cell)
        return (
            self._east_m.take(column),
            self._north_m.take(row),
            height_m + np.float32(self.datum_m - self.position_m[2]),
        )

    def felt(self, sector: Sector) -> Sensitivities:
        """Effect of unit errors of the scanner's state on the heights of cells."""
        assert self.of is not None  # noqa: S101 - the callers' case
        return shared.sensitivities(
            self.of,
            self.offset_m(sector.cell, sector.height_m),
            sector.east_gradient,
            sector.north_gradient,
            sector.passed,
        )

    def view(self, sector: Sector) -> View:
        """How cells are seen."""
        x_m, y_m, z_m = (axis.astype(np.float64) for axis in self.offset_m(sector.cell, sector.height_m))
        east, north = (one.astype(np.float64) for one in (sector.east_gradient, sector.north_gradient))
        return View.of((x_m, y_m, z_m), (0.0, 0.0, 0.0), east, north)

    @cached_property
    def _east_m(self) -> Floats32:
        assert self.position_m is not None  # noqa: S101 - the callers' case
        return (self.grid.x_m - self.position_m[0]).astype(np.float32)

    @cached_property
    def _north_m(self) -> Floats32:
        assert self.position_m is not None  # noqa: S101 - the callers' case
        return (self.grid.y_m - self.position_m[1]).astype(np.float32)


def look(
    reference: Reference,
    stable: Bools,
    scanner: Scanner,
    position_m: Position | None,
    axis: Position = UPRIGHT,
    *,
    published: bool = False,
) -> Outlook:
    """Look at a reference from a place; `stable` (ny, nx) is ground known for it.

    `published`: shots as sure as Voordendag et al. (2023) state them, and no roughness.
    """
    grid = reference.grid
    of = shared.basis(grid, position_m, axis) if position_m else None
    below = terrain.ground(reference)
    count, first = int(below.number.max()) + 1, 0
    cells = {name: np.empty(count, dtype) for name, dtype in CELLS.items()}
    for rows in terrain.bands(grid.ny):
        told = _cells(reference, rows, below, stable[rows], scanner, of, position_m, published=published)
        end = first + len(told["cell"])
        for name, values in told.items():
            cells[name][first:end] = values
        first = end
    stable_ones = (cells["trait"] & np.uint8(Trait.STABLE)) > 0
    looked_at, one_in = _looked_at(grid, cells["cell"], stable_ones)
    if of is None:  # any parts will do that are small
        part, parts = np.arange(count, dtype=np.int32) // TOGETHER, count // TOGETHER + 1
    else:
        part, parts = cells["passed"].astype(np.int32), of.intervals
    place = 2 * part + ~looked_at
    order = np.argsort(place, kind="stable")
    bounds = np.searchsorted(place[order], np.arange(2 * parts + 1))
    for name in cells:  # one after the other: together they are the most that a scan needs
        cells[name] = cells[name][order[counted(count)] if name in COUNTED else order]
    number = np.full(grid.shape, -1, np.int32)
    number.reshape(-1)[cells["cell"]] = np.arange(count)
    return Outlook(reference, of, position_m, below.datum_m, below.rise_m, number, bounds, one_in, cells)


def _cells(
    reference: Reference,
    rows: slice,
    below: Ground,
    stable: Bools,
    scanner: Scanner,
    of: Basis | None,
    position_m: Position | None,
    *,
    published: bool,
) -> dict[str, Array]:
    """Return what `Outlook.cells` holds, of the known cells of some rows."""
    grid, known = reference.grid, below.number[rows] >= 0
    row, column = np.nonzero(known)
    first = max(rows.start - MARGIN_ROWS, 0)
    around_m = np.where(
        np.isfinite(reference.elevation_m[first : rows.stop + MARGIN_ROWS]),
        reference.elevation_m[first : rows.stop + MARGIN_ROWS] - below.datum_m,
        np.nan,
    )
    inner = slice(rows.start - first, rows.stop - first)
    gradient = smooth_gradient(around_m, grid.cell_m, rows=inner)
    east, north = (np.nan_to_num(one[known].astype(np.float64)) for one in gradient)
    x_m, y_m, height_m = grid.x_m[column], grid.y_m[rows][row], below.cell_means(rows)[known]
    trait = np.where(stable[known], Trait.STABLE, 0) | np.where(ground.withheld(x_m, y_m), Trait.WITHHELD, 0)
    trait |= np.where(np.hypot(east, north) < ground.MOVING_STEEPEST, Trait.SMOOTH, 0)
    passed: Reals = np.zeros(len(row))
    place: Ints = np.zeros(len(row), np.int64)
    shot_m2 = np.full(len(row), scanner.range_sigma_m**2)
    if of is not None and position_m is not None:
        view = View.of((x_m, y_m, around_m[inner][known] + below.datum_m), position_m, east, north)
        passed, shot_m2 = of.knots_before(view.offset_m), view.shot_variance(scanner, published=published)
        trait |= np.where(view.cos_incidence < HIGH_INCIDENCE_COS, Trait.GRAZED, 0)
        last = np.nextafter(np.float32(of.intervals), np.float32(0))
        passed = np.minimum(passed.astype(np.float32), last)
        stretch = (np.hypot(view.offset_m[0], view.offset_m[1]) / STRETCH_M).astype(np.int64)
        place = (passed / LEAN_PER_REFRACTION).astype(np.int64) * _stretches(grid, position_m) + stretch
    if published:
        scatter_m2, before_m2 = shot_m2, np.zeros(len(row), np.float32)
    else:
        scatter_m2 = (shot_m2 + reference.roughness_m2[rows][known]) * reference.variance_factor[rows][known]
        before_m2 = reference.random_variance_m2[rows][known]
    return {
        "cell": (rows.start + row) * grid.nx + column,
        "height_m": height_m - below.datum_m,
        "east_gradient": east,
        "north_gradient": north,
        "passed": passed,
        "shot_m2": shot_m2,
        "scatter_m2": scatter_m2,
        "before_m2": before_m2,
        "intensity": reference.intensity[rows][known],
        "usual": reference.seen[rows][known],
        "place": place,
        "trait": trait,
    }


def counted(count: int) -> slice:
    """Return which of so many cells are counted."""
    return slice(None, count, 1 + count // COUNTED_MOST)


def _stretches(grid: Grid, position_m: Position) -> int:
    """Return how many stretches of range a grid has, from the scanner to its farthest cell."""
    east_m, north_m = (
        np.abs(axis_m - here_m).max()
        for axis_m, here_m in zip((grid.x_m, grid.y_m), position_m[:2], strict=True)
    )
    return int(math.hypot(east_m, north_m) / STRETCH_M) + 1


def _looked_at(grid: Grid, cell: Array, stable: Bools) -> tuple[Bools, tuple[int, int]]:
    """Choose cells (n,) for an adjustment: of too many stable ones whole rows, of the others a pattern.

    And tell one in how many that is, of the others and of the stable ones.
    """
    row, column = grid.row_and_column(cell)
    step = 1 + int(np.count_nonzero(stable)) // STABLE_MOST
    every = 1 + len(row) // (step * MOVING_MOST)
    chosen = (row % step == 0) & (stable | ((row // step + column) % every == 0))
    return chosen, (step * every, step)
