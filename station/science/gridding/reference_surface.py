"""The reference that change is measured from: a surface, and the mean of its scans above it in every cell."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from station.quantities import Bools, Floats, Floats32, Reference, SharedParameters, VarianceComponents
from station.science.adjustment import ground_classes
from station.science.geometry.terrain import HALO_ROWS, fit_planes, row_blocks, smooth_gradient
from station.science.gridding.scan_stack import ScanStack
from station.science.uncertainty.parameters import ParameterLayout
from station.science.uncertainty.propagation import restricted_to

REFRACTION_CORRELATION_S = 6 * 3600.0  # of the refraction of the air, from scan to scan
MAX_DEVIATION_SIGMAS = 3.0  # of a mean over many scans, on stable ground
MAX_VARIANCE_FACTOR = 3.0  # empirical over modelled variance from scan to scan, on stable ground

Position = tuple[float, float, float]


def build_surface(
    stack: ScanStack,
    base: Reference | None,
    shared: SharedParameters | None,
    position_m: Position | None,
    version: str,
    scan_ids: tuple[str, ...],
    times_s: Floats,
    components: VarianceComponents,
) -> Reference:
    """Return a reference whose surface follows the scans stacked on `base`, or their plain means without one.

    A plain mean depends on where its points lie on the slope (equations.md, 4.10), which a later pass of
    residuals repairs. Where cells around are missing, a node of its own would give the surface the slope of
    its sampling error, which exceeds that of the terrain: there the surface is a plane through the cells
    around. `shared` are the errors that all its cells share, see `mean_of_scans`; `times_s` (n,) are the
    starts of the scans.
    """
    mean_m = stack.mean_residual()
    if base is None:
        datum_m = float(np.round(position_m[2])) if position_m else 0.0
        elevation_m = fit_planes(mean_m) + datum_m
    else:
        elevation_m = fit_planes(base.elevation_m + mean_m, keep_dense=True)
    roughness_m2 = stack.roughness()
    return Reference(
        grid=stack.grid,
        version=version,
        elevation_m=elevation_m,
        mean_residual_m=np.where(np.isfinite(elevation_m), np.float32(0), np.float32(np.nan)),
        random_variance_m2=stack.random_variance(roughness_m2),
        roughness_m2=roughness_m2,
        shared=shared,
        scan_ids=scan_ids,
        intensity=stack.intensity(),
        variance_factor=np.ones(stack.grid.shape, np.float32),
        stable=np.zeros(stack.grid.shape, bool),
        components=components,
        visibility=stack.visibility(),
        point_count=stack.point_count(),
        time_s=float(np.mean(times_s)),
    )


def mean_of_scans(posteriors: Iterable[SharedParameters | None], times_s: Floats) -> SharedParameters | None:
    """Return the errors of the mean of scans, with zero estimates; None if those of no scan are known.

    Errors shared within a scan are taken as independent between scans, so that the mean of n scans has an nth
    of their mean covariance; but refraction is that of the weather, which lasts for hours. `times_s` (n,) are
    the starts of the scans. Source: equations.md, 6.3.
    """
    known = [posterior for posterior in posteriors if posterior is not None]
    if not known:
        return None
    total = known[0]
    for posterior in known[1:]:
        total = total + posterior
    separation_s = np.abs(np.subtract.outer(times_s, times_s))
    correlated = float(np.mean(np.exp(-separation_s / REFRACTION_CORRELATION_S)))
    share = np.where([name.startswith("refraction") for name in total.names], correlated, 1 / len(known))
    return replace(
        total,
        estimate=np.zeros(len(total.names)),
        covariance=total.covariance / len(known) * np.sqrt(np.outer(share, share)),
        line_tilt_variance=total.line_tilt_variance / len(known) ** 2,
    )


def errors_on_map(reference: Reference, params: ParameterLayout) -> SharedParameters | None:
    """Return the shared parameters of a reference with the covariance of its errors on the map.

    All its scans are placed relative to the one that the SOP was determined from, and have the errors of that
    scan, and of its inclination log, in common. Change does not: they cancel. `params` are those of a scan; a
    reference with others, of a scanner that was relocated since, is returned as it is. Source: equations.md,
    6.20.
    """
    shared, count = reference.shared, len(reference.scan_ids)
    if shared is None or reference.sop_scan_count is None or not count or shared.names != params.names:
        return shared
    others = count - reference.sop_scan_count
    ratio, factors = others * (others + 1) / count, np.ones(len(params.names))
    factors[params.in_log] = max(ratio, 1.0)
    factors[params.moves_unlogged] = max(ratio / 2, 1.0)
    return replace(shared, covariance=shared.covariance * np.sqrt(np.outer(factors, factors)))


def errors_of_sop_scan(
    shared: SharedParameters, reference: Reference, params: ParameterLayout
) -> SharedParameters:
    """Return the error on the map that a scan without adjustment has from the one of the SOP.

    It is as large as that of the scan's own inclination log, which `shared` are the errors of; zero if the
    tilt of the reference counts from no scan. Source: equations.md, 6.20.
    """
    counts = params.in_log & (reference.sop_scan_count is not None)
    return replace(restricted_to(shared, counts), line_tilt_variance=np.zeros(len(counts)))


def centre_reference(
    surface: Reference,
    stack: ScanStack,
    position_m: Position | None,
    components: VarianceComponents,
) -> Reference:
    """Return a reference on `surface` from which its own scans, stacked on it, differ by zero on average.

    The variance is that of the mean of the scans, from their scatter.
    """
    mean_residual_m = stack.scan_mean()
    factor, stable = np.ones(stack.grid.shape, np.float32), np.zeros(stack.grid.shape, bool)
    if position_m is not None:
        factor, stable = _empirical_variance(stack, position_m, surface.elevation_m)
    known = np.isfinite(mean_residual_m)
    return replace(
        surface,
        elevation_m=np.where(known, surface.elevation_m, np.nan),
        mean_residual_m=mean_residual_m,
        random_variance_m2=stack.scan_mean_variance() * factor,
        roughness_m2=stack.roughness(),
        intensity=stack.intensity(),
        variance_factor=factor,
        stable=stable,
        components=components,
        visibility=stack.visibility(),
        point_count=stack.point_count(),
    )


def update_reference(
    base: Reference, stack: ScanStack, position_m: Position, version: str, components: VarianceComponents
) -> Reference:
    """Return a reference whose stable ground is the mean of more scans, stacked on it and adjusted to it.

    Elsewhere its heights stay, because change is measured from them; so does its surface. Variance factor,
    stable ground and visibility are estimated again.
    """
    factor, steady = _empirical_variance(stack, position_m, base.elevation_m)
    mean_m, mean_m2 = stack.scan_mean(), stack.scan_mean_variance() * factor
    sigma_m = np.sqrt(mean_m2 + base.random_variance_m2)
    stable = steady & (np.abs(mean_m - base.mean_residual_m) < MAX_DEVIATION_SIGMAS * sigma_m)
    return replace(
        base,
        version=version,
        mean_residual_m=np.where(stable, mean_m, base.mean_residual_m),
        random_variance_m2=np.where(stable, mean_m2, base.random_variance_m2),
        variance_factor=factor,
        stable=stable,
        components=components,
        visibility=stack.visibility(),
        point_count=stack.point_count(),
    )


def _empirical_variance(
    stack: ScanStack, position_m: Position, elevation_m: Floats
) -> tuple[Floats32, Bools]:
    """Return the variance of cells from scan to scan over the modelled one, and the stable cells (ny, nx)."""
    grid = stack.grid
    classes, steep = np.empty(grid.shape, np.int32), np.empty(grid.shape, bool)
    for rows in row_blocks(grid.ny):
        window = slice(max(rows.start - HALO_ROWS, 0), rows.stop + HALO_ROWS)
        inner = slice(rows.start - window.start, rows.stop - window.start)
        east, north = smooth_gradient(elevation_m[window] - position_m[2], grid.cell_m, rows=inner)
        row, column = np.ogrid[rows.start : rows.stop, : grid.nx]
        range_m = grid.horizontal_range_m(row, column, position_m)
        classes[rows], steep[rows] = (
            ground_classes.noise_class(range_m, np.hypot(east, north)),
            grid.plane.tan_slope(east, north) > ground_classes.MIN_STABLE_SLOPE,
        )
    factor = stack.variance_factor(classes)
    return factor, np.isfinite(elevation_m) & steep & (factor < MAX_VARIANCE_FACTOR)
