"""One scan from shots to surface: the whole science on one page."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from station.quantities import (
    Bools,
    Floats,
    Grid,
    Measurement,
    Quality,
    Reference,
    Scanner,
    Shared,
    Shots,
    Surface,
    Tilt,
)
from station.science import change, shared, uncertainty
from station.science.air import AirCorrection, refraction_rise
from station.science.grid import Gridder, Stack, slope_sampling_variance
from station.science.pose import Frame, lean
from station.science.terrain import cell_means, smooth, smooth_gradient

BAND_ROWS = 128  # the cells that are looked at together: what a store chunk is high
MARGIN_ROWS = 4  # rows beyond a band that its smoothed gradient looks at
FEW_POINTS = 3
PROVISIONAL_CELLS = 1.0  # one sigma of the smoothing before residuals are taken
HIGH_INCIDENCE_COS = float(np.cos(np.radians(80.0)))

Points = tuple[Floats, Floats, Floats]


@dataclass(frozen=True)
class Setup:
    """What stays the same from scan to scan.

    `position_m` is the scanner's place on the map, None where a map-frame scan does not tell it.
    """

    scanner: Scanner
    grid: Grid
    position_m: tuple[float, float, float] | None
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
        lay(gridder, to_map(shots, pose), setup)
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


def lay(gridder: Gridder, points: Points, setup: Setup) -> None:
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
            variance_m2[known] = view.shot_variance(setup)
        else:
            variance_m2[known] = setup.scanner.range_sigma_m**2
    gridder.add(cell, z_m - below_m, variance_m2)


@dataclass(frozen=True)
class View:
    """How shots or cells (n,) are seen from the scanner."""

    offset_m: Points
    east_gradient: Floats
    north_gradient: Floats
    range_m: Floats
    cos_incidence: Floats
    cos_slope: Floats

    @classmethod
    def of(cls, points: Points, position_m: tuple[float, float, float], east: Floats, north: Floats) -> View:
        """See map points with the given terrain gradients from a position."""
        x_m, y_m, z_m = (axis - origin for axis, origin in zip(points, position_m, strict=True))
        range_m = np.maximum(np.sqrt(x_m**2 + y_m**2 + z_m**2), 1e-3)
        cos_slope = 1 / np.sqrt(1 + east**2 + north**2)
        cos_incidence = np.abs(z_m - east * x_m - north * y_m) * cos_slope / range_m
        return cls((x_m, y_m, z_m), east, north, range_m, np.minimum(cos_incidence, 1.0), cos_slope)

    @property
    def tan_slope(self) -> Floats:
        """Steepness of the terrain (n,) [1]."""
        return np.hypot(self.east_gradient, self.north_gradient)

    def shot_variance(self, setup: Setup) -> Floats:
        """Random variance of one shot's height [m²], by the budget the site asks for."""
        seen = self.range_m, self.cos_incidence, self.cos_slope
        if setup.published_budget:
            sin_rise = self.offset_m[2] / self.range_m
            return uncertainty.shot_variance_voordendag(*seen, sin_rise, setup.scanner)
        return uncertainty.shot_variance(*seen, setup.scanner)


def measure(
    gridder: Gridder, setup: Setup, unknown: Shared | None, reference: Reference | None
) -> Measurement:
    """Turn the sums of a scan into surface, change and their uncertainty.

    `unknown` is what all points of the scan share; None where there is nothing to derive it from.
    """
    grid, ground = setup.grid, gridder.ground
    mean_m = gridder.mean_residual()
    mean_m[gridder.count.reshape(grid.shape) < setup.min_points] = np.nan
    known = ground.known if ground is not None else np.zeros(grid.shape, bool)
    change_m = np.where(known, mean_m, np.nan).astype(np.float32)
    elevation_m = mean_m + (
        np.where(known, ground.datum_m + cell_means(ground.rise_m), gridder.datum_m)
        if ground is not None
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
            for name in ("sigma_instrument", "sigma_atmosphere", "sigma_geometry")
            if setup.store_terms and setup.position_m is not None
        },
    )
    for band in _bands(grid):
        _judge(result, band, setup, unknown, reference, known)
    return result


def _bands(grid: Grid) -> Iterator[slice]:
    for first in range(0, grid.ny, BAND_ROWS):
        yield slice(first, min(first + BAND_ROWS, grid.ny))


def _judge(
    result: Measurement,
    band: slice,
    setup: Setup,
    unknown: Shared | None,
    reference: Reference | None,
    known: Bools,
) -> None:
    """Fill uncertainty, terms and quality of a band of rows."""
    surface = result.surface
    seen = np.isfinite(surface.elevation_m[band])
    if not seen.any():
        return
    count = surface.count[band][seen].astype(np.float64)
    measured = known[band][seen]
    flags = np.where(count < FEW_POINTS, Quality.FEW_POINTS, 0)
    flags |= np.where(measured, 0, Quality.OUTSIDE_REFERENCE)
    random_m2 = surface.random_variance_m2[band][seen].astype(np.float64)
    if setup.position_m is None:
        spread_m2 = np.nan_to_num(surface.spread_m[band][seen].astype(np.float64)) ** 2
        random_m2 = np.maximum(spread_m2, setup.scanner.range_sigma_m**2) / count
        shared_m2, terms = np.zeros_like(count), dict[str, Floats]()
    else:
        view = _view(surface, band, seen, setup.position_m)
        flags |= np.where(view.cos_incidence < HIGH_INCIDENCE_COS, Quality.HIGH_INCIDENCE, 0)
        sampling_m2 = slope_sampling_variance(setup.grid.cell_m, view.tan_slope, count)
        sampling_m2[measured] = 0.0
        random_m2 = np.where(measured, random_m2, view.shot_variance(setup) / count + sampling_m2)
        shared_m2, terms = _shared_and_terms(view, count, sampling_m2, setup, unknown, reference)
    if reference is not None and not setup.published_budget:
        rough_m2 = reference.roughness_m2[band][seen] / count
        random_m2 += np.where(measured, reference.random_variance_m2[band][seen] + rough_m2, 0.0)
    sigma_m = np.sqrt(random_m2 + shared_m2)
    if setup.published_budget:
        sigma_m = uncertainty.sigma_total_voordendag(sigma_m, setup.registration_sigma_m)
    significant = change.significant(surface.change_m[band][seen], sigma_m)
    result.uncertainty_m[band][seen] = sigma_m
    result.random_uncertainty_m[band][seen] = np.sqrt(random_m2)
    result.quality[band][seen] = flags | np.where(significant, Quality.CHANGE_SIGNIFICANT, 0)
    for name, values in terms.items():
        result.terms[name][band][seen] = values


def _shared_and_terms(
    view: View,
    count: Floats,
    sampling_m2: Floats,
    setup: Setup,
    unknown: Shared | None,
    reference: Reference | None,
) -> tuple[Floats, dict[str, Floats]]:
    """Return what cells share with others (n,) [m²] and, where asked for, the budget term by term [m]."""
    if setup.published_budget:
        return np.zeros_like(count), _terms_voordendag(view, setup) if setup.store_terms else {}
    if unknown is None or setup.position_m is None:
        return np.zeros_like(count), {}
    of = shared.basis(setup.grid, setup.position_m)
    felt = shared.sensitivities(of, view.offset_m, view.east_gradient, view.north_gradient)
    shared_m2 = felt.variance(_covariance_of_change(unknown, reference))
    return shared_m2, _terms(view, count, sampling_m2, felt, unknown, setup) if setup.store_terms else {}


def _view(surface: Surface, band: slice, seen: Bools, position_m: tuple[float, float, float]) -> View:
    """See the cells of a band with the smoothed gradients of their own surface."""
    first = max(band.start - MARGIN_ROWS, 0)
    around = surface.elevation_m[first : band.stop + MARGIN_ROWS] - position_m[2]
    east, north = (
        np.nan_to_num(g[band.start - first :][: seen.shape[0]][seen].astype(np.float64))
        for g in smooth_gradient(around, surface.grid.cell_m)
    )
    row, column = np.nonzero(seen)
    points = surface.grid.x_m[column], surface.grid.y_m[band][row], surface.elevation_m[band][seen]
    return View.of(points, position_m, east, north)


def _covariance_of_change(unknown: Shared, reference: Reference | None) -> Floats:
    """Covariance of what scan and reference do not share with each other."""
    if reference is None or reference.shared is None:
        return unknown.covariance
    return unknown.covariance + reference.shared.covariance


def _terms(
    view: View,
    count: Floats,
    sampling_m2: Floats,
    felt: shared.Sensitivities,
    unknown: Shared,
    setup: Setup,
) -> dict[str, Floats]:
    """Split the budget of a scan's own heights [m]: instrument, atmosphere, geometry.

    Their squares add up to the variance as long as no adjustment has tied the shared parameters together.
    """
    by_air = np.array([name.startswith(("range_scale", "refraction")) for name in unknown.names])
    range_m2 = uncertainty.range_variance(view.cos_incidence, view.cos_slope, setup.scanner.range_sigma_m)
    beam_m2 = uncertainty.angle_variance(
        view.range_m, view.cos_incidence, view.cos_slope, uncertainty.sigma_angle(setup.scanner)
    )
    air_m2, other_m2 = (
        felt.variance(np.where(np.outer(of, of), unknown.covariance, 0.0)) for of in (by_air, ~by_air)
    )
    return {
        "sigma_instrument": np.sqrt(range_m2 / count + other_m2),
        "sigma_atmosphere": np.sqrt(air_m2),
        "sigma_geometry": np.sqrt(beam_m2 / count + sampling_m2),
    }


def _terms_voordendag(view: View, setup: Setup) -> dict[str, Floats]:
    """Split the published budget [m], for one point as in the paper's figures."""
    constant_m = np.full_like(view.range_m, uncertainty.SIGMA_ATMOSPHERE_VOORDENDAG_M)
    return {
        "sigma_instrument": uncertainty.sigma_instrument(view.range_m),
        "sigma_atmosphere": constant_m,
        "sigma_geometry": uncertainty.sigma_geometry(
            view.range_m,
            view.cos_incidence,
            view.cos_slope,
            view.offset_m[2] / view.range_m,
            setup.scanner.beam_divergence_rad,
        ),
    }


def master(
    stack: Stack,
    base: Reference | None,
    unknown: list[Shared | None],
    datum_m: float,
    version: str,
    scan_ids: tuple[str, ...],
) -> Reference:
    """Return the surface that change is measured from, from scans laid on `base`.

    Without a base, their plain means are smoothed: such a mean stands for where its points happen to lie on
    the slope (EQUATIONS 4.10), which residuals cannot mend from cell to cell; what smoothing takes from the
    terrain they can. What a scan's points share is taken as independent from scan to scan, so that the mean
    of n scans has an nth of their mean covariance.
    """
    mean_m = stack.mean_residual()
    if base is None:
        elevation_m = np.where(np.isfinite(mean_m), smooth(mean_m, PROVISIONAL_CELLS), np.nan) + datum_m
    else:
        elevation_m = base.elevation_m + mean_m
    told = [one for one in unknown if one is not None]
    common = None
    if told:
        covariance = sum((one.covariance for one in told), np.zeros_like(told[0].covariance)) / len(told) ** 2
        common = Shared(told[0].names, told[0].units, np.zeros(len(covariance)), covariance)
    return Reference(
        grid=stack.grid,
        version=version,
        elevation_m=elevation_m,
        random_variance_m2=stack.random_variance(),
        roughness_m2=stack.roughness().astype(np.float32),
        shared=common,
        scan_ids=scan_ids,
    )
