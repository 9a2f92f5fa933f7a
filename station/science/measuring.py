"""The cells of a scan, measured: height, change, how sure they are, and what to know of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from station.quantities import (
    MEASURED,
    Floats,
    Floats32,
    Grid,
    Ints,
    Ints32,
    Measurement,
    Quality,
    Reals,
    Setup,
    Shared,
)
from station.science import budget, change, ground, shared, uncertainty
from station.science.grid import Gridder, Sums, slope_sampling_variance
from station.science.outlook import HIGH_INCIDENCE_COS, Outlook, Sector, Trait
from station.science.shared import Sensitivities
from station.science.terrain import MARGIN_ROWS, gradient_in
from station.science.view import View

BAND_ROWS = 64  # looked at together for the cells beyond the reference
TOGETHER = 50_000  # of these that are judged together
FEW_POINTS = 3
KEPT_M = 2.0**-10  # of an elevation, which a float32 holds exactly up to 16 km; the store keeps as much


def measured(gridder: Gridder, outlook: Outlook | None, judge: Judge) -> Measurement:
    """Measure the cells of a scan, in the memory of its sums."""
    setup = judge.setup
    names = budget.TERMS if setup.published_budget else (*budget.TERMS, *budget.PUBLISHED)
    in_place, beside = gridder.memory()
    made = _Made(
        in_place.view(MEASURED),
        beside.view(np.float32),
        np.zeros(gridder.taken, np.uint8),
        {
            name: np.full(gridder.taken, np.nan, np.float32)
            for name in names
            if setup.store_terms and setup.position_m is not None
        },
        setup.min_points,
    )
    if outlook is not None:
        for first, whole in outlook.sectors():
            sums = gridder.sums(first, first + len(whole))
            made.clear(first + np.flatnonzero(sums.count == 0))
            seen = np.flatnonzero(sums.count > 0)  # by numbers: to choose by a mask takes four times as long
            if not len(seen):
                continue
            sector, sums, number = whole.some(seen), sums.some(seen), first + seen
            made.put(number, sums, judge.known(number, sector, sums, outlook))
    for fringe in _fringes(gridder, setup, outlook):
        sums = gridder.at(fringe.number)
        made.put(fringe.number, sums, judge.beyond(fringe, sums, gridder.datum_m))
    return Measurement(
        setup.grid, gridder.number, gridder.count, made.cells, made.change_m, made.quality, made.terms
    )


@dataclass(frozen=True)
class _Fringe:
    """Cells (n,) beyond what a reference knows, each with the slope that the scan gives it."""

    number: Ints32
    cell: Ints32
    east_gradient: Floats
    north_gradient: Floats

    @classmethod
    def of(cls, parts: list[_Fringe]) -> _Fringe:
        """Take some together."""
        return cls(*(np.concatenate([getattr(part, one.name) for part in parts]) for one in fields(cls)))

    def split(self) -> Iterator[_Fringe]:
        """Give as many at a time as are judged together."""
        for first in range(0, len(self.cell), TOGETHER):
            yield _Fringe(*(getattr(self, one.name)[first : first + TOGETHER] for one in fields(self)))


def _fringes(gridder: Gridder, setup: Setup, outlook: Outlook | None) -> Iterator[_Fringe]:
    """Give the cells beyond the reference, so many at a time that what is worked out stays in the cache."""
    beyond = gridder.beyond()
    heights = _Heights(gridder, outlook, beyond, setup.min_points)
    parts: list[_Fringe] = []
    for top in range(0, setup.grid.ny, BAND_ROWS):
        rows = slice(top, min(top + BAND_ROWS, setup.grid.ny))
        parts.append(_fringe(gridder, setup, heights, rows, _in_rows(beyond, rows, setup.grid)))
        if sum(len(part.cell) for part in parts) > TOGETHER or rows.stop == setup.grid.ny:
            yield from _Fringe.of(parts).split()
            parts = []


def _in_rows(cell: Ints32, rows: slice, grid: Grid) -> Ints32:
    """Return those of rising cells that lie in some rows."""
    edges = np.array([rows.start * grid.nx, rows.stop * grid.nx], cell.dtype)  # else all cells are converted
    first, end = np.searchsorted(cell, edges)
    return cell[first:end]


def _fringe(gridder: Gridder, setup: Setup, heights: _Heights, rows: slice, cell: Ints32) -> _Fringe:
    """Return the cells (n,) of some rows that no reference knows, and their slopes."""
    east, north = np.zeros((2, len(cell)))
    if setup.position_m is not None:
        around_m, inner = heights.around(rows)
        if len(cell):
            row, column = setup.grid.row_and_column(cell)
            row += inner.start - rows.start
            gradient = gradient_in(around_m, setup.grid.cell_m, row, column)
            east, north = (np.nan_to_num(one.astype(np.float64)) for one in gradient)
    return _Fringe(gridder.number.reshape(-1).take(cell), cell, east, north)


class _Heights:
    """Heights above one datum row by row, read from the sums of cells before these give way."""

    def __init__(self, gridder: Gridder, outlook: Outlook | None, beyond: Ints32, min_points: int) -> None:
        """Take the cells `beyond` (n,) the reference, rising."""
        self._gridder, self._outlook, self._beyond, self._min_points = gridder, outlook, beyond, min_points
        self._above_m = 0.0 if outlook is None else gridder.datum_m - outlook.datum_m  # the reference's datum
        self._rows = slice(0, 0)
        self._height_m = np.empty((0, gridder.grid.nx), np.float32)

    def around(self, rows: slice) -> tuple[Floats32, slice]:
        """Return heights of some rows and those next to them (r, nx), NaN where empty; which are the rows.

        Each time farther south: sums of what was asked for are not looked at again.
        """
        wanted = slice(max(rows.start - MARGIN_ROWS, 0), min(rows.stop + MARGIN_ROWS, self._gridder.grid.ny))
        held_m = self._height_m[wanted.start - self._rows.start :]
        self._height_m = np.concatenate([held_m, self._read(slice(self._rows.stop, wanted.stop))])
        self._rows = wanted
        return self._height_m, slice(rows.start - wanted.start, rows.stop - wanted.start)

    def _read(self, rows: slice) -> Floats32:
        gridder, grid = self._gridder, self._gridder.grid
        numbers = gridder.number[rows]
        if self._outlook is None:
            height_m = np.full(numbers.shape, np.nan, np.float32)
        else:
            # What it knows of cells is better. All others become a number of all bits, which is NaN.
            others = numbers.view(np.uint32) >= np.uint32(gridder.known)
            bits = np.negative(others.view(np.int8), dtype=np.int32)
            bits |= self._outlook.rise_m[rows].view(np.int32)
            height_m = bits.view(np.float32)
        cell = _in_rows(self._beyond, rows, grid) - rows.start * grid.nx
        sums = gridder.at(numbers.reshape(-1).take(cell))
        enough = sums.count >= self._min_points
        height_m.reshape(-1)[cell] = np.where(enough, sums.mean_residual() + self._above_m, np.nan)
        return height_m


@dataclass(frozen=True)
class _Judged:
    """Cells of a scan, (n,) each."""

    elevation_m: Reals
    change_m: Reals
    sigma_m: Reals
    random_m: Reals
    flags: NDArray[np.uint8]
    terms: dict[str, Floats]


def _as_one(cells: NDArray[np.void]) -> NDArray[np.void]:
    """View the values of a cell as one, which moves twice as fast."""
    return cells.view(f"V{MEASURED.itemsize}")


@dataclass(frozen=True)
class _Made:
    """Where the columns of a measurement come to be; `cells` and `change_m` in the memory of its sums."""

    cells: NDArray[np.void]
    change_m: Floats32
    quality: NDArray[np.uint8]
    terms: dict[str, Floats32]
    min_points: int

    def clear(self, number: Ints) -> None:
        """Say that cells (m,) hold nothing."""
        nothing = np.array((np.nan,) * 4, MEASURED)
        _as_one(self.cells)[number] = _as_one(nothing)
        self.change_m[number] = np.nan

    def put(self, number: Ints | Ints32, sums: Sums, told: _Judged) -> None:
        """Lay down cells (m,); of those with too few points no more than the spread."""
        enough = sums.count >= self.min_points
        few = np.flatnonzero(~enough)
        cells = np.empty(len(number), MEASURED)
        kept_m = np.rint(told.elevation_m * (1 / KEPT_M)).astype(np.float32)
        kept_m *= KEPT_M
        for name, values in (
            ("elevation_m", kept_m),
            ("uncertainty_m", told.sigma_m),
            ("random_uncertainty_m", told.random_m),
        ):
            cells[name] = values
            cells[name][few] = np.nan
        cells["spread_m"] = sums.spread()
        _as_one(self.cells)[number] = _as_one(cells)
        self.change_m[number] = np.where(enough, told.change_m, np.nan)
        self.quality[number] = np.where(enough, told.flags, 0)
        for name, values in told.terms.items():
            self.terms[name][number[enough]] = values[enough]


@dataclass(frozen=True)
class Judge:
    """Takes the adjustment off the cells of a scan and says how sure they are.

    `unknown` is what all points share of their difference from the reference, `own` the same of the scan
    alone, None where nothing tells; `correction` gives what to take off heights, None without an adjustment.
    """

    setup: Setup
    unknown: Shared | None
    own: Shared | None
    correction: Callable[[Sensitivities], Reals] | None

    def known(self, number: Ints, sector: Sector, sums: Sums, outlook: Outlook) -> _Judged:
        """Judge cells (n,) that the reference knows, some of a sector."""
        count = sums.count.astype(np.float32)
        random_m2 = sector.scatter_m2 / count + sector.before_m2
        shared_m2, correction_m, terms = np.zeros_like(count), np.zeros_like(count), dict[str, Floats]()
        if outlook.of is not None:
            felt = outlook.felt(sector)
            shared_m2, correction_m = self._shared(felt)
            if self.setup.store_terms:
                view = outlook.view(sector)
                terms = self._terms(felt, view, sums.count.astype(np.float64), np.zeros(len(sector)))
        sigma_m = self._total(random_m2 + shared_m2)
        change_m = sums.mean_residual().astype(np.float32) - correction_m
        flags = Quality.FEW_POINTS * (sums.count < FEW_POINTS).view(np.uint8)
        flags |= Quality.HIGH_INCIDENCE * sector.having(Trait.GRAZED).view(np.uint8)
        flags |= Quality.CHANGE_SIGNIFICANT * change.significant(change_m, sigma_m).view(np.uint8)
        if self.correction is not None:
            unlike = ground.looks_unlike(sums.intensity(), outlook.intensity(number))
            flags |= Quality.STABLE_GROUND * (sector.having(Trait.STABLE) & ~unlike).view(np.uint8)
        elevation_m = outlook.datum_m + (sector.height_m.astype(np.float64) + change_m)
        return _Judged(elevation_m, change_m, sigma_m, np.sqrt(random_m2), flags, terms)

    def beyond(self, fringe: _Fringe, sums: Sums, datum_m: float) -> _Judged:
        """Judge cells (n,) beyond the reference, whose sums are above a datum."""
        setup = self.setup
        count, height_m = sums.count.astype(np.float64), sums.mean_residual() + datum_m
        flags = Quality.FEW_POINTS * (sums.count < FEW_POINTS).view(np.uint8)
        flags |= np.uint8(Quality.OUTSIDE_REFERENCE)
        nothing_m = np.full(len(count), np.nan)
        if setup.position_m is None:
            spread_m2 = np.nan_to_num(sums.spread().astype(np.float64)) ** 2
            random_m2 = np.maximum(spread_m2, setup.scanner.range_sigma_m**2) / count
            sigma_m = self._total(random_m2)
            return _Judged(height_m, nothing_m, sigma_m, np.sqrt(random_m2), flags, {})
        row, column = setup.grid.row_and_column(fringe.cell)
        points = setup.grid.x_m[column], setup.grid.y_m[row], height_m
        view = View.of(points, setup.position_m, fringe.east_gradient, fringe.north_gradient)
        flags |= Quality.HIGH_INCIDENCE * (view.cos_incidence < HIGH_INCIDENCE_COS).view(np.uint8)
        sampling_m2 = slope_sampling_variance(setup.grid.cell_m, view.tan_slope, count)
        random_m2 = view.shot_variance(setup.scanner, published=setup.published_budget) / count + sampling_m2
        of = shared.basis(setup.grid, setup.position_m, setup.axis)
        east_m, north_m, up_m = (axis_m.astype(np.float32) for axis_m in view.offset_m)
        slopes = (slope.astype(np.float32) for slope in (view.east_gradient, view.north_gradient))
        felt = shared.sensitivities(of, (east_m, north_m, up_m), *slopes)
        shared_m2, correction_m = self._shared(felt)
        terms = self._terms(felt, view, count, sampling_m2) if setup.store_terms else {}
        sigma_m = self._total(random_m2 + shared_m2)
        return _Judged(height_m - correction_m, nothing_m, sigma_m, np.sqrt(random_m2), flags, terms)

    def _total(self, variance_m2: Reals) -> Reals:
        """Sigma of cells [m]."""
        if self.setup.published_budget:
            return uncertainty.sigma_total_voordendag(np.sqrt(variance_m2), self.setup.registration_sigma_m)
        return np.sqrt(variance_m2)

    def _shared(self, felt: Sensitivities) -> tuple[Reals, Reals]:
        """Return what cells share with others [m²], and what is to be taken off their heights [m]."""
        nothing = np.zeros_like(felt.lean)
        if self.unknown is None:
            return nothing, nothing
        correction_m = nothing if self.correction is None else self.correction(felt)
        if self.setup.published_budget:
            return nothing, correction_m
        return felt.variance(self.unknown), correction_m

    def _terms(
        self, felt: Sensitivities, view: View, count: Floats, sampling_m2: Floats
    ) -> dict[str, Floats]:
        """Split the budget, as the site asks [m]."""
        setup = self.setup
        if setup.published_budget:
            return budget.terms_voordendag(view, count, setup.scanner, setup.registration_sigma_m)
        if self.own is None:
            return {}
        terms = budget.terms(view, count, sampling_m2, felt, self.own, setup.scanner)
        return terms | budget.published(view, count, setup.scanner)
