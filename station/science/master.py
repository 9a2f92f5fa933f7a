"""The surface that change is measured from: made of many scans, made better by more."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from station.quantities import Bools, Floats, Floats32, Habits, Reference, Shared
from station.science import ground
from station.science.grid import Stack
from station.science.terrain import MARGIN_ROWS, bands, smooth, smooth_gradient

PROVISIONAL_CELLS = 1.0  # one sigma of the smoothing before residuals are taken
UNCHANGED_SIGMAS = 3.0  # of a mean over many scans, on ground that stays
STEADY = 3.0  # times its modelled variance from scan to scan, which ground found stable may show

Position = tuple[float, float, float]


def master(
    stack: Stack,
    base: Reference | None,
    unknown: list[Shared | None],
    position_m: Position | None,
    version: str,
    scan_ids: tuple[str, ...],
    habits: Habits,
) -> Reference:
    """Return the surface that change is measured from, from scans laid on `base`.

    Without a base, their plain means are smoothed: such a mean stands for where its points happen to lie on
    the slope (EQUATIONS 4.10), which residuals cannot mend from cell to cell; what smoothing takes from the
    terrain they can. What a scan's points share is taken as independent from scan to scan, so that the mean
    of n scans has an nth of their mean covariance.
    """
    mean_m = stack.mean_residual()
    if base is None:
        datum_m = float(np.round(position_m[2])) if position_m else 0.0
        elevation_m = np.where(np.isfinite(mean_m), smooth(mean_m, PROVISIONAL_CELLS), np.nan) + datum_m
    else:
        elevation_m = base.elevation_m + mean_m
    told = [one for one in unknown if one is not None]
    common = None
    if told:
        total = told[0]
        for one in told[1:]:
            total = total + one
        common = replace(
            total,
            estimate=np.zeros(len(total.names)),
            covariance=total.covariance / len(told) ** 2,
            noise_variance=total.noise_variance / len(told) ** 2,
        )
    factor, stable = np.ones(stack.grid.shape, np.float32), np.zeros(stack.grid.shape, bool)
    if position_m is not None:
        factor, stable = _as_scans_show(stack, position_m, elevation_m)
    roughness_m2 = stack.roughness()
    return Reference(
        grid=stack.grid,
        version=version,
        elevation_m=elevation_m,
        random_variance_m2=stack.random_variance(roughness_m2) * factor,
        roughness_m2=roughness_m2,
        shared=common,
        scan_ids=scan_ids,
        intensity=stack.intensity(),
        variance_factor=factor,
        stable=stable,
        habits=habits,
        seen=stack.seen(),
    )


def improved(base: Reference, stack: Stack, position_m: Position, version: str, habits: Habits) -> Reference:
    """Return a reference whose stable ground is the mean of more scans, laid on it and adjusted to it.

    Elsewhere it stays as it is: it is what change counts from. What scans show of cells is learned anew.
    """
    mean_m, mean_m2 = stack.mean_residual(), stack.random_variance(stack.roughness())
    factor, steady = _as_scans_show(stack, position_m, base.elevation_m)
    mean_m2 *= factor
    still = np.abs(mean_m) < UNCHANGED_SIGMAS * np.sqrt(mean_m2 + base.random_variance_m2)
    stable = steady & still
    elevation_m = base.elevation_m + np.where(stable, mean_m, 0.0)
    return replace(
        base,
        version=version,
        elevation_m=elevation_m,
        random_variance_m2=np.where(stable, mean_m2, base.random_variance_m2).astype(np.float32),
        variance_factor=factor,
        stable=stable,
        habits=habits,
        seen=stack.seen(),
    )


def _as_scans_show(stack: Stack, position_m: Position, elevation_m: Floats) -> tuple[Floats32, Bools]:
    """How much more cells vary from scan to scan than modelled, and which are stable (ny, nx)."""
    grid = stack.grid
    alike, steep = np.empty(grid.shape, np.int32), np.empty(grid.shape, bool)
    for rows in bands(grid.ny):
        around = slice(max(rows.start - MARGIN_ROWS, 0), rows.stop + MARGIN_ROWS)
        inner = slice(rows.start - around.start, rows.stop - around.start)
        east, north = smooth_gradient(elevation_m[around] - position_m[2], grid.cell_m, rows=inner)
        tan_slope = np.hypot(east, north)
        away_m = np.hypot(grid.x_m[None, :] - position_m[0], grid.y_m[rows, None] - position_m[1])
        alike[rows], steep[rows] = ground.classes(away_m, tan_slope), tan_slope > ground.STABLE_FLATTEST
    factor = stack.variance_factor(alike)
    return factor, np.isfinite(elevation_m) & steep & (factor < STEADY)
