"""Leverage of a cell's noise on the adjustment.

A patch of cells with random variance V and weight W has the leverage s = V W: the estimate absorbs this share
of the patch's noise, and the correction then removes it from the same cells. The noise and the error of the
state are therefore negatively correlated in any linear product of adjusted cells, and its variance is
Σ a² σ² + gᵀ C g - 2 Σ a s J C g.
"""

from __future__ import annotations

import numpy as np

from station.quantities import Bools, Floats, Ints
from station.science.adjustment.normal_equations import NormalEquations, Posterior
from station.science.adjustment.patches import GroundClass, Patches

LEVERAGE_BOUNDS_M2 = (1e-9, 1e4)  # bounds of the fitted variance
BISECTIONS = 45


def fit_leverage(
    patches: Patches, weight: Floats, equations: NormalEquations, posterior: Posterior
) -> tuple[float, float]:
    """Return the leverage variance of moving and of stable cells [m²].

    A cell with random variance v has the leverage v / (v + leverage variance). On moving ground the estimated
    change absorbs most of the noise, so the leverage variance is large. It is fitted so that the mean of all
    cells of a ground class has the covariance with the estimate that follows from the patches.
    """
    moving, stable = (
        _bisect_slack(
            patches,
            patches.ground_class == ground_class,
            weight / patches.sampling_step[ground_class],
            equations,
            posterior,
        )
        for ground_class in (GroundClass.MOVING, GroundClass.STABLE)
    )
    return moving, stable


def _bisect_slack(
    patches: Patches, selected: Bools, weight: Floats, equations: NormalEquations, posterior: Posterior
) -> float:
    low, high = LEVERAGE_BOUNDS_M2
    if not selected.any():
        return high
    mean = np.where(selected, patches.cell_count, 0.0) / patches.cell_count[selected].sum()
    unknowns, line_tilt_rad = posterior.covariance_with(
        patches.jacobian.aggregate(mean), patches.jacobian.aggregate_by_line(mean)
    )
    full_effect_m2 = equations.effect(unknowns, line_tilt_rad)
    unknowns[len(patches.jacobian.params.names) :] = 0.0  # drop what change and responses absorb
    state_effect_m2 = equations.effect(unknowns, line_tilt_rad)
    target_m2 = mean @ (patches.variance_m2 * weight * full_effect_m2)
    cell_m2 = patches.variance_m2 * patches.cell_count
    for _ in range(BISECTIONS):
        middle = float(np.sqrt(low * high))
        if mean @ (cell_m2 / (cell_m2 + middle) * state_effect_m2) > target_m2:
            low = middle
        else:
            high = middle
    return low


def leverage(
    scan_m2: Floats, random_m2: Floats, ground_class: Ints, leverage_m2: tuple[float, float]
) -> Floats:
    """Return the leverage (n,) of each cell: the share of its noise absorbed by the adjustment of its scan.

    `scan_m2` is the part of the random variance `random_m2` that is the scan's; in a difference, `random_m2`
    also contains the reference's. Cells that are neither moving nor stable have zero leverage.
    """
    moving, stable = (scan_m2 / (random_m2 + added_m2) for added_m2 in leverage_m2)
    return np.asarray(
        np.select(
            [ground_class == GroundClass.MOVING, ground_class == GroundClass.STABLE], [moving, stable], 0.0
        )
    )
