"""Response of rough ground to a motion of the beams: unknowns that an adjustment estimates last.

If the beams move, rough ground rises or falls by a little more or less than its mean surface would. How much
is not known of any station in advance; the residuals of a scan show it in part.
Source: equations.md, 6.8.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from station.quantities import Bools, Floats, SharedParameters
from station.science.adjustment.normal_equations import NormalEquations, ReducedNormals, ScaledCholesky
from station.science.adjustment.patches import Patches
from station.science.adjustment.solution import Solution
from station.science.uncertainty.jacobian import sight_tilt_of
from station.science.uncertainty.parameters import GLOBAL, ParameterLayout, interpolate_to_lines

RESPONSE_ERROR = 0.2  # of the response of a patch, over its sampling ratio
MAX_RESPONSE_ERROR = 0.05
COMMON_RESPONSE_ERROR = 0.65  # share of it that all ground of a kind has in common; the rest is by sector
RESPONSE_SECTOR_RAD = math.radians(12.0)
MAX_RESPONSE_TILT_RAD = math.radians(0.01)  # beyond, shots are taken to jump as often as they slide


def beam_motion(params: ParameterLayout, estimate: Floats, reference: SharedParameters | None) -> Floats:
    """Return by how much the beams moved against those of the reference, as a state by knots (p,)."""
    motion = np.where(params.moves_beam, estimate[: len(params.names)], 0.0)
    if reference is not None and reference.names == params.names:
        motion -= np.where(params.moves_beam, reference.estimate, 0.0)
    knots = slice(len(GLOBAL), len(GLOBAL) + params.sight_tilt_knots)
    sight_tilt_rad = sight_tilt_of(params.line_azimuth_rad) @ motion[:2]
    sight_tilt_rad += interpolate_to_lines(params, motion[knots, None])[:, 0]
    excess = max(1.0, float(np.abs(sight_tilt_rad).max()) / MAX_RESPONSE_TILT_RAD)
    motion[:2] /= excess
    motion[knots] /= excess
    return motion


def response_errors(patches: Patches, moving: Bools, motion_m: Floats) -> Floats:
    """Return independent errors (k, n) of the response of patches to the motion of the beams [m].

    `motion_m` (n,) is what the motion does to their heights. Moving and stable ground each have an error in
    common, and one in every sector of azimuth. All stable ground has the mean error: its response depends
    little on the sampling ratio.
    """
    share = np.minimum(RESPONSE_ERROR * patches.sampling_ratio, MAX_RESPONSE_ERROR)
    if not moving.all():
        share[~moving] = np.average(share[~moving], weights=1 / patches.variance_m2[~moving])
    azimuth_rad = patches.jacobian.params.line_azimuth_rad
    sector = ((azimuth_rad - azimuth_rad[0]) / RESPONSE_SECTOR_RAD).astype(np.int64)[patches.jacobian.line]
    kind = np.where(moving, 0, 1)
    of_kind = np.arange(2)[:, None] == kind
    key = 2 * sector + kind
    of_sector = np.unique(key)[:, None] == key
    own = math.sqrt(1 - COMMON_RESPONSE_ERROR**2)
    return np.asarray(np.concatenate([COMMON_RESPONSE_ERROR * of_kind, own * of_sector]) * share * motion_m)


def estimate_responses(
    equations: NormalEquations,
    of_errors: Sequence[ReducedNormals],
    solution: Solution,
    weight: Floats,
    error_m: Floats,
    residual_m: Floats,
) -> tuple[Floats, ScaledCholesky]:
    """Return the responses (k,) that residuals (n,) show, in units of their errors, and their normal matrix.

    `of_errors` are the equations of each of the errors (k, n), `weight` (n,) those of the patches [1/m²]. The
    change of the ground is that of the most likely model.
    """
    factor, weighted_per_m, fitted_m = solution.factor, weight * error_m, np.empty_like(error_m)
    for row, errors in enumerate(of_errors):
        shift = factor.solve(errors.rhs)
        fitted_m[row] = equations.effect(shift, errors.back_substitute(shift))
    normal = ScaledCholesky(np.eye(len(error_m)) + weighted_per_m @ (error_m - fitted_m).T)
    return normal.solve(weighted_per_m @ residual_m), normal
