"""How alike the errors of two scans are: those that the change of the moving ground makes.

An adjustment takes the change of moving ground for smooth and of some size, and what it takes wrongly goes
into the scanner's state. Two scans after the same change take it alike, and what both have wrong is not in
their difference. With the change c of covariance P⁻¹ beforehand and N the normal matrix of all unknowns, the
part of the state's covariance that comes from the change is A = T P Tᵀ, T = (N⁻¹) between state and change.
"""

from __future__ import annotations

import math

import numpy as np
from scipy import linalg

from station.quantities import Floats, Reals, Shared

# Of what a box of 100 m feels of A they hold 97 % and more where little ground is stable, two thirds and more
# where much is and A is next to nothing; what they lack makes sigma wider.
MODES = 32
SECTOR_RAD = math.radians(15.0)
RING_M = 500.0
RINGS = 12  # the last holds what is farther, too
SECTORS = round(2 * math.pi / SECTOR_RAD) * RINGS
RIDGE = 1e-9  # of a parameter that no height shows


def modes(factor: Floats, heights: Floats) -> Floats:
    """Return errors of parameters (p, MODES) whose products sum up to nearly FᵀF, of a factor F (k, p).

    Those that move heights most; `heights` (p, p) are products of the effects of parameters on heights.
    """
    scale = np.sqrt(np.diag(heights))
    scale[scale == 0.0] = 1.0
    like = heights / np.outer(scale, scale)
    like[np.diag_indices_from(like)] += RIDGE
    root = linalg.cholesky(like, lower=True, check_finite=False).T * scale
    felt = root @ factor.T  # a row each of what heights feel
    count = min(MODES, len(felt))
    size, direction = linalg.eigh(felt @ felt.T, subset_by_index=(len(felt) - count, len(felt) - 1))
    found = np.zeros((len(felt), MODES))
    there = size > size[-1] * 1e-12
    found[:, :count][:, there] = factor.T @ (felt.T @ direction[:, there]) / np.sqrt(size[there])
    return found


def pattern(azimuth_rad: Reals, range_m: Reals, change: Floats) -> Floats:
    """Mean of a change (n,) by sector round the scanner (SECTORS,); nought where nothing lies."""
    sector = (azimuth_rad % (2 * math.pi) / SECTOR_RAD).astype(np.int64) % (SECTORS // RINGS)
    ring = np.minimum(range_m / RING_M, RINGS - 1).astype(np.int64)
    at = sector * RINGS + ring
    count = np.bincount(at, minlength=SECTORS)
    return np.asarray(np.bincount(at, change, SECTORS) / np.maximum(count, 1))


def likeness(one: Floats, other: Floats) -> float:
    """Tell how alike two patterns are: 1 the same, 0 nothing in common, -1 opposite.

    Twice their product over the sum of their squares: half as large is not alike in full. The mean does not
    count: as large a snowfall need not lie where the one before lay.
    """
    both = np.stack([one, other])[:, (one != 0) | (other != 0)]
    if not both.size:
        return 0.0
    both -= both.mean(axis=1, keepdims=True)
    size = float(np.sum(both**2))
    return 2 * float(both[0] @ both[1]) / size if size > 0 else 0.0


def common_errors(one: Shared, other: Shared) -> Floats | None:
    """Covariance (p, p) between the errors of the parameters of two scans; None where none is known.

    Both against the same reference. How far the change since then was the same is seen in what they found of
    it. Their errors by one change are taken to be as alike as their sizes allow: the modes of the one are
    turned into those of the other (Procrustes), each parameter measured by its sigma.
    """
    if one.change is None or other.change is None or one.names != other.names:
        return None
    alike = likeness(one.change.pattern, other.change.pattern)
    sigma = np.sqrt(np.diag(one.covariance) + np.diag(other.covariance))[:, None]
    sigma[sigma == 0.0] = 1.0
    left, _, right = linalg.svd((one.change.modes / sigma).T @ (other.change.modes / sigma))
    return np.asarray(alike * (one.change.modes @ left) @ (right @ other.change.modes.T))
