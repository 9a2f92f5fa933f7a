"""Response of rough ground to a motion of the beams: further unknowns of an adjustment.

If the beams move, rough ground rises or falls by a little more or less than its mean surface would. How much
is not known of any station in advance; the residuals of a scan show it in part.
Source: equations.md, 6.8.
"""

from __future__ import annotations

import math

import numpy as np
from scipy import sparse

from station.quantities import Floats, SharedParameters
from station.science.adjustment.patches import GroundClass, Patches
from station.science.uncertainty.jacobian import sight_tilt_of
from station.science.uncertainty.parameters import ParameterLayout, interpolate_to_lines

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
    knots = params.knot_slices[0]
    sight_tilt_rad = sight_tilt_of(params.line_azimuth_rad) @ motion[:2]
    sight_tilt_rad += interpolate_to_lines(params, motion[knots, None])[:, 0]
    excess = max(1.0, float(np.abs(sight_tilt_rad).max()) / MAX_RESPONSE_TILT_RAD)
    motion[:2] /= excess
    motion[knots] /= excess
    return motion


def response_design(patches: Patches, motion_m: Floats) -> sparse.csr_array:
    """Return the effect (n, k) of one sigma of each response to the motion of the beams on patches [m].

    `motion_m` (n,) is what the motion does to their heights. Moving and stable ground each have a response in
    common, and one in every sector of azimuth. All stable ground has the mean error: its response depends
    little on the sampling ratio.
    """
    moving = patches.ground_class == GroundClass.MOVING
    share = np.minimum(RESPONSE_ERROR * patches.sampling_ratio, MAX_RESPONSE_ERROR)
    if not moving.all():
        share[~moving] = np.average(share[~moving], weights=1 / patches.variance_m2[~moving])
    azimuth_rad = patches.jacobian.params.line_azimuth_rad
    sector = ((azimuth_rad - azimuth_rad[0]) / RESPONSE_SECTOR_RAD).astype(np.int64)[patches.jacobian.line]
    kind = np.where(moving, 0, 1)
    of_sector = 2 + np.unique(2 * sector + kind, return_inverse=True)[1]
    effect_m = share * motion_m
    own = math.sqrt(1 - COMMON_RESPONSE_ERROR**2)
    values_m = np.concatenate([COMMON_RESPONSE_ERROR * effect_m, own * effect_m])
    row = np.arange(len(patches))
    shape = len(patches), 2 + len(np.unique(of_sector))
    return sparse.csr_array((values_m, (np.tile(row, 2), np.concatenate([kind, of_sector]))), shape=shape)
