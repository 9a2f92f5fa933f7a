"""Response of rough ground to a motion of the beams: further unknowns of an adjustment.

If the beams move, rough ground rises or falls by a little more or less than its mean surface would. How much
is not known of any station in advance; the residuals of a scan show it in part.
Source: equations.md, 6.8.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from station.quantities import Floats, Ints, Reals, SharedParameters
from station.science.adjustment.patches import GroundClass, Patches
from station.science.uncertainty.jacobian import HeightJacobian, sight_tilt_of
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


@dataclass(frozen=True)
class StableResponse:
    """Estimated response of stable ground to a motion of the beams.

    It rises by what the motion does to its mean surface, and by a share of that more.
    """

    share: Floats  # (lines,) by line group
    motion: Floats  # (p,) state by knots by which the beams moved

    def effect(self, jacobian: HeightJacobian) -> Reals:
        """Return the effect on the heights (n,) of stable ground [m]."""
        return np.asarray(self.share[jacobian.line] * jacobian.effect(self.motion))


@dataclass(frozen=True)
class ResponseDesign:
    """Effect (n, k) of one sigma of each response to a motion of the beams on patches [m].

    Moving and stable ground each have a response in common, and one in every sector of azimuth.
    """

    effect_m: sparse.csr_array  # (n, k)
    motion: Floats  # (p,) state by knots by which the beams moved
    stable_share: float  # one sigma of the response of stable ground
    stable_sectors: Ints  # of azimuth, with responses of stable ground: the last unknowns

    def stable_response(self, params: ParameterLayout, estimate: Floats) -> StableResponse:
        """Return the response of stable ground that belongs to the estimated responses (k,)."""
        sector = _sector(params)
        of_sector = np.zeros(int(sector.max()) + 1)
        of_sector[self.stable_sectors] = estimate[len(estimate) - len(self.stable_sectors) :]
        common, own = _error_parts()
        response = common * estimate[GroundClass.STABLE] + own * of_sector[sector]
        return StableResponse(self.stable_share * response, self.motion)


def response_design(patches: Patches, motion: Floats, motion_m: Floats) -> ResponseDesign:
    """Return the responses of patches (n,) to a motion of the beams, a state by knots (p,).

    `motion_m` (n,) is what the motion does to their heights. All stable ground has the mean error: its
    response depends little on the sampling ratio.
    """
    moving = patches.ground_class == GroundClass.MOVING
    share, stable_share = np.minimum(RESPONSE_ERROR * patches.sampling_ratio, MAX_RESPONSE_ERROR), 0.0
    if not moving.all():
        stable_share = float(np.average(share[~moving], weights=1 / patches.variance_m2[~moving]))
        share[~moving] = stable_share
    kind = np.where(moving, GroundClass.MOVING, GroundClass.STABLE)
    sectors = _sector(patches.jacobian.params)
    sector_count = int(sectors.max()) + 1
    code, of_sector = np.unique(kind * sector_count + sectors[patches.jacobian.line], return_inverse=True)
    effect_m = share * motion_m
    values_m = np.concatenate([part * effect_m for part in _error_parts()])
    columns = np.concatenate([kind, 2 + of_sector])
    shape = len(patches), 2 + len(code)
    return ResponseDesign(
        sparse.csr_array((values_m, (np.tile(np.arange(len(patches)), 2), columns)), shape=shape),
        motion,
        stable_share,
        code[code >= sector_count] - sector_count,
    )


def _error_parts() -> tuple[float, float]:
    """Return the parts of the response error, in its sigmas, that all ground of a kind and a sector share."""
    return COMMON_RESPONSE_ERROR, math.sqrt(1 - COMMON_RESPONSE_ERROR**2)


def _sector(params: ParameterLayout) -> Ints:
    """Return the sector of azimuth (lines,) of each line group."""
    azimuth_rad = params.line_azimuth_rad
    return np.asarray(((azimuth_rad - azimuth_rad[0]) / RESPONSE_SECTOR_RAD).astype(np.int64))
