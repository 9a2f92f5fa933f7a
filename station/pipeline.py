"""One scan from shots to surface: the whole science on one page."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from station.quantities import (
    Bools,
    Floats,
    Floats32,
    Grid,
    Ints,
    Measurement,
    Quality,
    Reference,
    Scanner,
    Shared,
    Shots,
    Surface,
    Tilt,
)
from station.science import budget, change, ground, prior, shared, uncertainty
from station.science.adjustment import Adjustment, adjust, turned
from station.science.air import AirCorrection, refraction_rise
from station.science.grid import Gridder, slope_sampling_variance
from station.science.normals import LineLog
from station.science.patches import Cells, collect
from station.science.pose import Frame, lean
from station.science.shared import Basis, Sensitivities
from station.science.terrain import smooth_gradient
from station.science.view import Points, View

NORMAL_MAD = 0.6744897501960817  # of a normal distribution with a standard deviation of one
BAND_ROWS = 64  # the cells that are looked at together: half of what a store chunk is high
MARGIN_ROWS = 4  # rows beyond a band that its smoothed gradient looks at
FEW_POINTS = 3
MOVING_MOST = 400_000  # cells of moving ground that an adjustment looks at
STABLE_MOST = 800_000  # the same of stable ground, in whole rows; so many tell all there is to tell
FEW_STABLE = 20  # cells, that say nothing of a spread
KEPT_M = 2.0**-10  # of an elevation, which a float32 holds exactly up to 16 km; the store keeps as much
HIGH_INCIDENCE_COS = float(np.cos(np.radians(80.0)))


@dataclass(frozen=True)
class Setup:
    """What stays the same from scan to scan.

    `position_m` is the scanner's place on the map, None where a map-frame scan does not tell it; `axis` the
    direction (east, north, up) its head turns about.
    """

    scanner: Scanner
    grid: Grid
    position_m: tuple[float, float, float] | None
    axis: tuple[float, float, float] = shared.UPRIGHT
    min_points: int = 1
    published_budget: bool = False  # Voordendag et al. (2023) instead of the corrected form
    registration_sigma_m: float = 0.0  # of the published budget
    store_terms: bool = False


@dataclass(frozen=True)
class Pose:
    """How the scanner stood: the way to the map, and the lean on top of it. No frame: already on the map."""

    frame: Frame | None
    tilt: Tilt | None
    air: AirCorrection | None


def gridder_for(setup: Setup, reference: Reference | None) -> Gridder:
    """Return an empty grid that measures from a reference, if there is one."""
    return Gridder(setup.grid, reference, setup.position_m[2] if setup.position_m else 0.0)


def survey(gridder: Gridder, blocks: Iterable[Shots], pose: Pose, progress: Callable[[], None]) -> None:
    """Lay every shot of a scan on the grid."""
    for shots in blocks:
        lay(gridder, to_map(shots, pose), shots.intensity)
        progress()
    gridder.complete()


def to_map(shots: Shots, pose: Pose) -> Points:
    """Easting, northing and height of shots [m]: lean, SOP, air, map."""
    points = shots.x_m, shots.y_m, shots.z_m
    if pose.frame is None:
        return points
    if pose.tilt is not None:
        time_s = np.zeros(len(shots)) if shots.time_s is None else shots.time_s
        points = lean(points, time_s, pose.tilt)
    x_m, y_m, z_m = (
        row[0] * points[0] + row[1] * points[1] + row[2] * points[2] for row in pose.frame.to_local[:3, :3]
    )
    if pose.air is not None:
        scale = pose.air.range_scale(z_m)
        x_m, y_m, z_m = x_m * scale, y_m * scale, z_m * scale
        z_m -= refraction_rise(np.sqrt(x_m**2 + y_m**2), pose.air.refraction_coefficient)
    return pose.frame.to_map((x_m, y_m, z_m))


def lay(gridder: Gridder, points: Points, intensity: Floats | None = None) -> None:
    """Add points on the map to the grid, as residuals to the reference where it is known."""
    inside, column, row = gridder.cells(points[0], points[1])
    cell = gridder.flat(column, row)
    residual_m = points[2][inside] - gridder.below(cell, column, row)
    gridder.add(cell, residual_m, None if intensity is None else intensity[inside])


@dataclass(frozen=True)
class Told:
    """What is known of a scan's scanner beside its shots: how it was turned, what log and weather say.

    `assumed_rad` (3, lines) is the lean its points were turned by, about east, north and up.
    """

    of: Basis
    lines: prior.Lines
    assumed_rad: Floats
    log: LineLog | None
    weather_known: bool


def level(gridder: Gridder, setup: Setup, told: Told, reference: Reference, stable: Bools) -> Adjustment:
    """Estimate the state of the scanner from a scan on its grid; `stable` (ny, nx) is ground known for it."""
    state = prior.beforehand(told.of, told.lines, reference.habits, weather_known=told.weather_known)
    bands = _cells(gridder, setup, told.of, reference, stable)
    patches = collect(told.of, bands, setup.scanner.range_max_m)
    return adjust(patches, told.assumed_rad, state.against(reference.shared), told.log)


def _cells(gridder: Gridder, setup: Setup, of: Basis, reference: Reference, stable: Bools) -> Iterator[Cells]:
    """Give the cells of a scan that the reference knows, band by band; of too many a part."""
    grid = setup.grid
    there = gridder.seen()
    step = 1 + int(np.count_nonzero(there & stable)) // STABLE_MOST
    every = 1 + int(np.count_nonzero(there)) // (step * MOVING_MOST)
    for band in _bands(grid, step):
        row = np.arange(*band.indices(grid.ny)) // step
        seen = np.equal.outer(-row % every, np.arange(grid.nx) % every)
        seen |= stable[band]
        seen &= there[band] & np.isfinite(reference.elevation_m[band])
        if not seen.any():
            continue
        sums = gridder.sums(band)
        view = _view(setup, band, seen, *_around(reference.elevation_m, band))
        unlike = ground.looks_unlike(sums.intensity()[seen], reference.intensity[band][seen])
        row, column = np.nonzero(seen)
        kept_out = ground.withheld(grid.x_m[column], grid.y_m[band][row])
        yield Cells(
            _felt(view, of),
            np.hypot(view.offset_m[0], view.offset_m[1]),
            ground.kinds(stable[band][seen], kept_out, view.tan_slope, unlike),
            sums.mean_residual()[seen],
            _random(
                view.shot_variance(setup.scanner, published=False), sums.count[seen], reference, band, seen
            )
            + reference.random_variance_m2[band][seen],
            (step * every, step),
        )


def on_reference(
    gridder: Gridder, setup: Setup, reference: Reference, levelled: tuple[Told, Adjustment] | None
) -> tuple[Floats32, Floats32]:
    """Random variance of a shot [m²] and what the estimated state does to heights [m], both (ny, nx).

    In the cells that the reference knows, else nought.
    """
    variance_m2, correction_m = (np.zeros(setup.grid.shape, np.float32) for _ in range(2))
    for band in _bands(setup.grid):
        seen = (gridder.sums(band).count > 0) & np.isfinite(reference.elevation_m[band])
        if not seen.any():
            continue
        if setup.position_m is None:
            variance_m2[band][seen] = setup.scanner.range_sigma_m**2
            continue
        view = _view(setup, band, seen, *_around(reference.elevation_m, band))
        variance_m2[band][seen] = view.shot_variance(setup.scanner, published=setup.published_budget)
        if levelled is not None:
            told, found = levelled
            felt = _felt(view, told.of)
            correction_m[band][seen] = found.effect(felt) - turned(felt, told.assumed_rad)
    return variance_m2, correction_m


def measure(
    gridder: Gridder,
    setup: Setup,
    unknown: Shared | None,
    reference: Reference | None,
    levelled: tuple[Told, Adjustment, Bools] | None = None,
) -> Measurement:
    """Turn the sums of a scan into surface, change and their uncertainty, in the memory of the sums.

    `unknown` is what all points of the scan share, against the reference where `levelled` says how it was
    adjusted to that and to which stable ground (ny, nx); None where there is nothing to derive it from.
    """
    grid, memory = setup.grid, gridder.memory()
    elevation_m, change_m, spread_m, uncertainty_m, random_m, _ = np.moveaxis(memory, -1, 0)
    count = memory.view(np.int32)[..., 5]
    quality = np.zeros(grid.shape, np.uint8)
    terms = {
        name: np.full(grid.shape, np.nan, np.float32)
        for name in (budget.TERMS if setup.published_budget else (*budget.TERMS, *budget.PUBLISHED))
        if setup.store_terms and setup.position_m is not None
    }
    judge = _Judge(setup, unknown, reference, levelled)
    above_m = np.empty((0, grid.nx))
    for rows in _bands(grid):
        band = _Band.of(gridder, rows, above_m, setup.min_points)
        above_m = band.above_next_m
        told = judge.judge(band)
        whole = np.full((*band.seen.shape, 6), np.nan, np.float32)
        whole[band.seen] = np.stack(
            [
                np.rint(told.elevation_m / KEPT_M) * KEPT_M,
                told.change_m,
                np.zeros_like(told.change_m),
                told.sigma_m,
                told.random_m,
                np.zeros_like(told.change_m),
            ],
            axis=-1,
        )
        whole[..., 2] = band.spread_m
        whole.view(np.int32)[..., 5] = band.count
        memory[rows] = whole
        quality[rows][band.seen] = told.flags
        for name, values in told.terms.items():
            terms[name][rows][band.seen] = values
    surface = Surface(grid, elevation_m, change_m, count, spread_m)
    return Measurement(surface, uncertainty_m, random_m, quality, terms)


def stable_figures(measured: Measurement) -> dict[str, float]:
    """Return how a scan does on stable ground it was not fitted to: number of cells, median, spread, z."""
    surface = measured.surface
    row, column = np.nonzero(measured.flagged(Quality.STABLE_GROUND))
    unused = ground.withheld(surface.grid.x_m[column], surface.grid.y_m[row])
    row, column = row[unused], column[unused]
    change_m, sigma_m = surface.change_m[row, column], measured.uncertainty_m[row, column]
    figures = {"stable_count": float(len(change_m))}
    if len(change_m) >= FEW_STABLE:
        figures["stable_median"] = float(np.median(change_m))
        figures["stable_nmad"] = _spread(change_m)
        figures["stable_z_std"] = _spread(change_m / sigma_m)
    return figures


def _bands(grid: Grid, step: int = 1) -> Iterator[slice]:
    """Give bands of so many rows, every `step`th."""
    high = max(BAND_ROWS // step, 1) * step
    for first in range(0, grid.ny, high):
        yield slice(first, min(first + high, grid.ny), step)


def _spread(values: Floats32) -> float:
    """Median absolute deviation, as the standard deviation of a normal distribution."""
    return float(np.median(np.abs(values - np.median(values))) / NORMAL_MAD)


def _random(
    shot_m2: Floats, count: NDArray[np.int32], reference: Reference, band: slice, seen: Bools
) -> Floats:
    """Random variance of a scan's own cells (n,) [m²]: shots and roughness, as scans have shown it.

    Source: Hartzell et al. (2015), Eq. 12, of a shot at the middle of the cell.
    """
    scatter_m2 = (shot_m2 + reference.roughness_m2[band][seen]) / count
    return np.asarray(scatter_m2 * reference.variance_factor[band][seen], dtype=np.float64)


def _felt(view: View, of: Basis) -> Sensitivities:
    return shared.sensitivities(of, view.offset_m, view.east_gradient, view.north_gradient)


@dataclass(frozen=True)
class _Band:
    """Some rows of a scan on the grid, and what is around them."""

    rows: slice
    count: NDArray[np.int32]  # (r, nx)
    spread_m: Floats32  # (r, nx)
    intensity: Floats32  # (r, nx)
    known: Bools  # (r, nx) to the reference
    residual_m: Floats  # (r, nx) NaN where nothing is seen
    around_m: Floats  # (more, nx) heights, also of the rows beyond that smoothing looks at
    first: int  # row of these that is the first of the band

    @classmethod
    def of(cls, gridder: Gridder, rows: slice, above_m: Floats, min_points: int) -> _Band:
        """Take rows off the sums; those above, whose sums have given way, are told."""
        ahead = slice(rows.start, min(rows.stop + MARGIN_ROWS, gridder.grid.ny))
        sums, height = gridder.sums(ahead), rows.stop - rows.start
        residual_m = sums.mean_residual()
        residual_m[sums.count < min_points] = np.nan
        known, below_m = gridder.below_cells(ahead)
        return cls(
            rows,
            sums.count[:height],
            sums.spread()[:height],
            sums.intensity()[:height],
            known[:height],
            residual_m[:height],
            np.concatenate([above_m, residual_m + below_m]),
            len(above_m),
        )

    @property
    def height_m(self) -> Floats:
        """Heights (r, nx)."""
        return self.around_m[self.first :][: len(self.count)]

    @property
    def above_next_m(self) -> Floats:
        """Heights of the rows above the next band."""
        return self.height_m[-MARGIN_ROWS:]

    @property
    def seen(self) -> Bools:
        """Cells (r, nx) that have a height."""
        return np.isfinite(self.residual_m)


@dataclass(frozen=True)
class _Judged:
    """The seen cells of a band, (n,) each."""

    elevation_m: Floats
    change_m: Floats
    sigma_m: Floats
    random_m: Floats
    flags: Ints
    terms: dict[str, Floats]


@dataclass(frozen=True)
class _Judge:
    """Takes the adjustment off a scan and says how sure its cells are, band by band."""

    setup: Setup
    unknown: Shared | None
    reference: Reference | None
    levelled: tuple[Told, Adjustment, Bools] | None

    def judge(self, band: _Band) -> _Judged:
        """Return height, change, uncertainty, terms and quality of the seen cells of a band."""
        setup, reference, seen = self.setup, self.reference, band.seen
        count = band.count[seen].astype(np.float64)
        measured = band.known[seen]
        flags = np.where(count < FEW_POINTS, Quality.FEW_POINTS, 0)
        flags |= np.where(measured, 0, Quality.OUTSIDE_REFERENCE)
        shared_m2, correction_m, terms = np.zeros_like(count), np.zeros_like(count), dict[str, Floats]()
        if setup.position_m is None:
            shot_m2 = np.full(len(count), setup.scanner.range_sigma_m**2)
            random_m2 = (
                np.maximum(np.nan_to_num(band.spread_m[seen].astype(np.float64)) ** 2, shot_m2) / count
            )
        else:
            view = self._view(band)
            flags |= np.where(view.cos_incidence < HIGH_INCIDENCE_COS, Quality.HIGH_INCIDENCE, 0)
            sampling_m2 = slope_sampling_variance(setup.grid.cell_m, view.tan_slope, count)
            sampling_m2[measured] = 0.0
            shot_m2 = view.shot_variance(setup.scanner, published=setup.published_budget)
            random_m2 = shot_m2 / count + sampling_m2
            shared_m2, correction_m, terms = self._shared(view, count, sampling_m2)
            flags |= self._stable(band)
        if reference is not None and not setup.published_budget:
            own_m2 = _random(shot_m2, band.count[seen], reference, band.rows, seen)
            before_m2 = reference.random_variance_m2[band.rows][seen]
            random_m2 = np.where(measured, own_m2 + before_m2, random_m2)
        sigma_m = np.sqrt(random_m2 + shared_m2)
        if setup.published_budget:
            sigma_m = uncertainty.sigma_total_voordendag(sigma_m, setup.registration_sigma_m)
        change_m = np.where(measured, band.residual_m[seen] - correction_m, np.nan)
        flags |= np.where(change.significant(change_m, sigma_m), Quality.CHANGE_SIGNIFICANT, 0)
        elevation_m = band.height_m[seen] - correction_m
        return _Judged(elevation_m, change_m, sigma_m, np.sqrt(random_m2), flags, terms)

    def _view(self, band: _Band) -> View:
        """See the cells of a band on the reference where that is known, else on what the scan found."""
        around_m = band.around_m
        if self.reference is not None:
            start = band.rows.start - band.first
            better_m = self.reference.elevation_m[start : start + len(around_m)]
            around_m = np.where(np.isfinite(better_m), better_m, around_m)
        return _view(self.setup, band.rows, band.seen, around_m, band.first)

    def _shared(
        self, view: View, count: Floats, sampling_m2: Floats
    ) -> tuple[Floats, Floats, dict[str, Floats]]:
        """Return what cells share with others [m²], what the adjustment takes off [m], and terms [m]."""
        setup, unknown = self.setup, self.unknown
        shared_m2, correction_m, terms = np.zeros_like(count), np.zeros_like(count), dict[str, Floats]()
        if setup.store_terms and setup.published_budget:
            terms = budget.terms_voordendag(view, count, setup.scanner, setup.registration_sigma_m)
        if setup.position_m is None or unknown is None:
            return shared_m2, correction_m, terms
        felt = _felt(view, shared.basis(setup.grid, setup.position_m, setup.axis))
        if self.levelled is not None:
            told, found, _ = self.levelled
            correction_m = found.effect(felt) - turned(felt, told.assumed_rad)
        if setup.published_budget:
            return shared_m2, correction_m, terms
        if setup.store_terms:
            terms = budget.terms(view, count, sampling_m2, felt, unknown, setup.scanner)
            terms |= budget.published(view, count, setup.scanner)
        before = self.reference.shared if self.reference is not None and self.levelled is None else None
        return felt.variance(shared.against(unknown, before)), correction_m, terms

    def _stable(self, band: _Band) -> Ints:
        """Flag the stable ground that looks as it did."""
        seen, rows = band.seen, band.rows
        if self.levelled is None or self.reference is None:
            return np.zeros(np.count_nonzero(seen), np.int64)
        unlike = ground.looks_unlike(band.intensity[seen], self.reference.intensity[rows][seen])
        stable = self.levelled[2][rows][seen] & band.known[seen] & ~unlike
        return np.where(stable, Quality.STABLE_GROUND, 0)


def _around(elevation_m: Floats, rows: slice) -> tuple[Floats, int]:
    """Return some rows of a surface (ny, nx) with those that smoothing looks at, and which is the first."""
    first = max(rows.start - MARGIN_ROWS, 0)
    return elevation_m[first : rows.stop + MARGIN_ROWS], rows.start - first


def _view(setup: Setup, rows: slice, seen: Bools, around_m: Floats, first: int) -> View:
    """See the chosen cells (r, nx) of some rows, with the smoothed gradients of the surface around them.

    Of `around_m` (more, nx) row `first` is the first of these.
    """
    assert setup.position_m is not None  # noqa: S101 - the callers' case
    inner = slice(first, first + rows.stop - rows.start, rows.step)
    around_m = around_m - setup.position_m[2]
    east, north = (
        np.nan_to_num(g[seen].astype(np.float64))
        for g in smooth_gradient(around_m, setup.grid.cell_m, rows=inner)
    )
    row, column = np.nonzero(seen)
    height_m = around_m[inner][seen] + setup.position_m[2]
    points = setup.grid.x_m[column], setup.grid.y_m[rows][row], height_m
    return View.of(points, setup.position_m, east, north)
