"""One scan from shots to surface: the whole science on one page."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import median_abs_deviation

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
from station.science.adjustment import Adjustment, LineLog, adjust, prior_of_difference, turned
from station.science.air import AirCorrection, refraction_rise
from station.science.grid import Gridder, slope_sampling_variance
from station.science.patches import Cells, collect
from station.science.pose import Frame, lean
from station.science.shared import Basis, Sensitivities
from station.science.terrain import cell_means, smooth_gradient
from station.science.view import Points, View

BAND_ROWS = 128  # the cells that are looked at together: what a store chunk is high
MARGIN_ROWS = 4  # rows beyond a band that its smoothed gradient looks at
FEW_POINTS = 3
MOVING_MOST = 400_000  # cells of moving ground that an adjustment looks at
FEW_STABLE = 20  # cells, that say nothing of a spread
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


def survey(
    gridder: Gridder, blocks: Iterable[Shots], setup: Setup, pose: Pose, progress: Callable[[], None]
) -> None:
    """Lay every shot of a scan on the grid."""
    for shots in blocks:
        lay(gridder, to_map(shots, pose), setup, shots.intensity)
        progress()


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
        z_m -= refraction_rise(np.hypot(x_m, y_m), pose.air.refraction_coefficient)
    return pose.frame.to_map((x_m, y_m, z_m))


def lay(gridder: Gridder, points: Points, setup: Setup, intensity: Floats | None = None) -> None:
    """Add points on the map to the grid, as residuals to the reference where it is known."""
    inside, column, row = gridder.cells(points[0], points[1])
    x_m, y_m, z_m = (axis[inside] for axis in points)
    cell = gridder.flat(column, row)
    below_m = np.full(len(cell), gridder.datum_m)
    variance_m2 = np.zeros(len(cell))
    if gridder.ground is not None:
        known = gridder.known(cell)
        under_m, east, north = gridder.ground.under(column[known], row[known])
        below_m[known] = under_m
        if setup.position_m is not None:
            view = View.of((x_m[known], y_m[known], z_m[known]), setup.position_m, east, north)
            variance_m2[known] = view.shot_variance(setup.scanner, published=setup.published_budget)
        else:
            variance_m2[known] = setup.scanner.range_sigma_m**2
    gridder.add(cell, z_m - below_m, variance_m2, None if intensity is None else intensity[inside])


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
    habits = reference.habits
    sigma = prior.globals_sigma(habits, weather_known=told.weather_known)
    of, lines = told.of, told.lines
    leans = prior.motion(habits, lines), prior.bending(habits, of), prior.across(habits, of, lines)
    state = prior_of_difference(of, prior.by_line(of, sigma, *leans), reference.shared)
    bands = _cells(gridder, setup, told.of, reference, stable)
    patches = collect(told.of, bands, setup.scanner.range_max_m)
    return adjust(patches, told.assumed_rad, state, told.log)


def _cells(gridder: Gridder, setup: Setup, of: Basis, reference: Reference, stable: Bools) -> Iterator[Cells]:
    """Give the cells of a scan that the reference knows, band by band; of too many moving ones a part."""
    grid = setup.grid
    count = gridder.count.reshape(grid.shape)
    every = 1 + np.count_nonzero(count) // MOVING_MOST
    for band in _bands(grid):
        seen = (count[band] > 0) & np.isfinite(reference.elevation_m[band])
        seen &= stable[band] | (
            np.add.outer(np.arange(*band.indices(grid.ny)), np.arange(grid.nx)) % every == 0
        )
        if not seen.any():
            continue
        view = _view(setup, band, seen, reference.elevation_m)
        unlike = ground.looks_unlike(gridder.intensity(band)[seen], reference.intensity[band][seen])
        row, column = np.nonzero(seen)
        kept_out = ground.withheld(grid.x_m[column], grid.y_m[band][row])
        yield Cells(
            _felt(view, of),
            np.hypot(view.offset_m[0], view.offset_m[1]),
            ground.kinds(stable[band][seen], kept_out, view.tan_slope, unlike),
            gridder.mean_residual(band)[seen],
            _random(gridder.random_variance(band)[seen], count[band][seen], reference, band, seen)
            + reference.random_variance_m2[band][seen],
        )


def corrections(
    gridder: Gridder, setup: Setup, told: Told, reference: Reference, found: Adjustment
) -> Floats32:
    """What the estimated state does to the heights of the cells that the reference knows (ny, nx) [m]."""
    correction_m = np.zeros(setup.grid.shape, np.float32)
    for band in _bands(setup.grid):
        seen = (gridder.count.reshape(setup.grid.shape)[band] > 0) & np.isfinite(reference.elevation_m[band])
        if seen.any():
            felt = _felt(_view(setup, band, seen, reference.elevation_m), told.of)
            correction_m[band][seen] = found.effect(felt) - turned(felt, told.assumed_rad)
    return correction_m


def measure(
    gridder: Gridder,
    setup: Setup,
    unknown: Shared | None,
    reference: Reference | None,
    levelled: tuple[Told, Adjustment, Bools] | None = None,
) -> Measurement:
    """Turn the sums of a scan into surface, change and their uncertainty.

    `unknown` is what all points of the scan share, against the reference where `levelled` says how it was
    adjusted to that and to which stable ground (ny, nx); None where there is nothing to derive it from.
    """
    grid, below = setup.grid, gridder.ground
    mean_m = gridder.mean_residual()
    mean_m[gridder.count.reshape(grid.shape) < setup.min_points] = np.nan
    known = below.known if below is not None else np.zeros(grid.shape, bool)
    change_m = np.where(known, mean_m, np.nan).astype(np.float32)
    elevation_m = mean_m + (
        np.where(known, below.datum_m + cell_means(below.rise_m), gridder.datum_m)
        if below is not None
        else gridder.datum_m
    )
    surface = Surface(
        grid=grid,
        elevation_m=elevation_m,
        change_m=change_m,
        count=gridder.count.reshape(grid.shape),
        spread_m=gridder.spread(),
        random_variance_m2=gridder.random_variance(),
    )
    result = Measurement(
        surface=surface,
        uncertainty_m=np.full(grid.shape, np.nan, np.float32),
        random_uncertainty_m=np.full(grid.shape, np.nan, np.float32),
        quality=np.zeros(grid.shape, np.uint8),
        terms={
            name: np.full(grid.shape, np.nan, np.float32)
            for name in (budget.TERMS if setup.published_budget else (*budget.TERMS, *budget.PUBLISHED))
            if setup.store_terms and setup.position_m is not None
        },
    )
    judge = _Judge(result, setup, unknown, reference, known, gridder.intensity(), levelled)
    for band in _bands(grid):
        judge.judge(band)
    return result


def stable_figures(measured: Measurement) -> dict[str, float]:
    """Return how a scan does on stable ground it was not fitted to: number of cells, median, spread, z."""
    surface = measured.surface
    chosen = (measured.quality & Quality.STABLE_GROUND) > 0
    row, column = np.nonzero(chosen)
    chosen[row, column] = ground.withheld(surface.grid.x_m[column], surface.grid.y_m[row])
    change_m, sigma_m = surface.change_m[chosen], measured.uncertainty_m[chosen]
    figures = {"stable_count": float(len(change_m))}
    if len(change_m) >= FEW_STABLE:
        figures["stable_median"] = float(np.median(change_m))
        figures["stable_nmad"] = float(median_abs_deviation(change_m, scale="normal"))
        figures["stable_z_std"] = float(median_abs_deviation(change_m / sigma_m, scale="normal"))
    return figures


def _bands(grid: Grid) -> Iterator[slice]:
    for first in range(0, grid.ny, BAND_ROWS):
        yield slice(first, min(first + BAND_ROWS, grid.ny))


def _random(
    model_m2: Floats32, count: NDArray[np.int32], reference: Reference, band: slice, seen: Bools
) -> Floats:
    """Random variance of a scan's own cells (n,) [m²]: shots and roughness, as scans have shown it."""
    rough_m2 = reference.roughness_m2[band][seen] / count
    return np.asarray((model_m2 + rough_m2) * reference.variance_factor[band][seen], dtype=np.float64)


def _felt(view: View, of: Basis) -> Sensitivities:
    return shared.sensitivities(of, view.offset_m, view.east_gradient, view.north_gradient)


@dataclass(frozen=True)
class _Judge:
    """Fills correction, uncertainty, terms and quality of a measurement, band by band."""

    result: Measurement
    setup: Setup
    unknown: Shared | None
    reference: Reference | None
    known: Bools
    intensity: Floats32
    levelled: tuple[Told, Adjustment, Bools] | None

    def judge(self, band: slice) -> None:
        """Fill a band of rows."""
        surface, setup, reference = self.result.surface, self.setup, self.reference
        seen = np.isfinite(surface.elevation_m[band])
        if not seen.any():
            return
        count = surface.count[band][seen].astype(np.float64)
        measured = self.known[band][seen]
        flags = np.where(count < FEW_POINTS, Quality.FEW_POINTS, 0)
        flags |= np.where(measured, 0, Quality.OUTSIDE_REFERENCE)
        random_m2 = surface.random_variance_m2[band][seen].astype(np.float64)
        if setup.position_m is None:
            spread_m2 = np.nan_to_num(surface.spread_m[band][seen].astype(np.float64)) ** 2
            random_m2 = np.maximum(spread_m2, setup.scanner.range_sigma_m**2) / count
            shared_m2, terms = np.zeros_like(count), dict[str, Floats]()
        else:
            better_m = None if reference is None else reference.elevation_m
            view = _view(setup, band, seen, surface.elevation_m, better_m)
            flags |= np.where(view.cos_incidence < HIGH_INCIDENCE_COS, Quality.HIGH_INCIDENCE, 0)
            sampling_m2 = slope_sampling_variance(setup.grid.cell_m, view.tan_slope, count)
            sampling_m2[measured] = 0.0
            own_m2 = view.shot_variance(setup.scanner, published=setup.published_budget)
            random_m2 = np.where(measured, random_m2, own_m2 / count + sampling_m2)
            shared_m2, terms = self._shared_and_terms(band, seen, view, count, sampling_m2)
            flags |= self._stable(band, seen, view)
        if reference is not None and not setup.published_budget:
            model_m2 = surface.random_variance_m2[band][seen]
            own_m2 = _random(model_m2, surface.count[band][seen], reference, band, seen)
            before_m2 = reference.random_variance_m2[band][seen]
            random_m2 = np.where(measured, own_m2 + before_m2, random_m2)
        sigma_m = np.sqrt(random_m2 + shared_m2)
        if setup.published_budget:
            sigma_m = uncertainty.sigma_total_voordendag(sigma_m, setup.registration_sigma_m)
        significant = change.significant(surface.change_m[band][seen], sigma_m)
        self.result.uncertainty_m[band][seen] = sigma_m
        self.result.random_uncertainty_m[band][seen] = np.sqrt(random_m2)
        self.result.quality[band][seen] = flags | np.where(significant, Quality.CHANGE_SIGNIFICANT, 0)
        for name, values in terms.items():
            self.result.terms[name][band][seen] = values

    def _shared_and_terms(
        self, band: slice, seen: Bools, view: View, count: Floats, sampling_m2: Floats
    ) -> tuple[Floats, dict[str, Floats]]:
        """Take the adjustment off; return what cells share with others (n,) [m²], and terms asked for [m]."""
        setup, unknown, surface = self.setup, self.unknown, self.result.surface
        shared_m2, terms = np.zeros_like(count), dict[str, Floats]()
        if setup.store_terms and setup.published_budget:
            terms = budget.terms_voordendag(view, count, setup.scanner, setup.registration_sigma_m)
        if setup.position_m is None or unknown is None:
            return shared_m2, terms
        felt = _felt(view, shared.basis(setup.grid, setup.position_m, setup.axis))
        if self.levelled is not None:
            told, found, _ = self.levelled
            correction_m = found.effect(felt) - turned(felt, told.assumed_rad)
            surface.elevation_m[band][seen] -= correction_m
            surface.change_m[band][seen] -= correction_m.astype(np.float32)
        if setup.published_budget:
            return shared_m2, terms
        if setup.store_terms:
            terms = budget.terms(view, count, sampling_m2, felt, unknown, setup.scanner)
            terms |= budget.published(view, count, setup.scanner)
        before = self.reference.shared if self.reference is not None and self.levelled is None else None
        return felt.variance(shared.against(unknown, before)), terms

    def _stable(self, band: slice, seen: Bools, view: View) -> Ints:
        """Flag the stable ground that looks as it did."""
        if self.levelled is None or self.reference is None:
            return np.zeros(len(view.range_m), np.int64)
        unlike = ground.looks_unlike(self.intensity[band][seen], self.reference.intensity[band][seen])
        stable = self.levelled[2][band][seen] & self.known[band][seen] & ~unlike
        return np.where(stable, Quality.STABLE_GROUND, 0)


def _view(
    setup: Setup, band: slice, seen: Bools, elevation_m: Floats, better_m: Floats | None = None
) -> View:
    """See the chosen cells of a band of a surface (ny, nx), with its smoothed gradients.

    `better_m` (ny, nx) is taken where it is known.
    """
    assert setup.position_m is not None  # noqa: S101 - the callers' case
    first = max(band.start - MARGIN_ROWS, 0)
    rows = slice(first, band.stop + MARGIN_ROWS)
    around = elevation_m[rows]
    if better_m is not None:
        around = np.where(np.isfinite(better_m[rows]), better_m[rows], around)
    around = around - setup.position_m[2]
    east, north = (
        np.nan_to_num(g[band.start - first :][: seen.shape[0]][seen].astype(np.float64))
        for g in smooth_gradient(around, setup.grid.cell_m)
    )
    row, column = np.nonzero(seen)
    height_m = around[band.start - first :][: seen.shape[0]][seen] + setup.position_m[2]
    points = setup.grid.x_m[column], setup.grid.y_m[band][row], height_m
    return View.of(points, setup.position_m, east, north)
