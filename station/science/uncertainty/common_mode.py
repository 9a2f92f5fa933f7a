"""Cross-covariance of the errors that two scans have in common, caused by the change of moving ground.

The adjustment models the change of moving ground as smooth and of limited size; the part that the model
misses biases the scanner's state. Two scans after the same change are biased in the same way, and the common
bias cancels in their difference. Let the change have the prior covariance P⁻¹, and let N be the normal matrix
of all unknowns. The part of the state's covariance that comes from the change is A = T P Tᵀ, where T is the
block of N⁻¹ between state and change.
"""

from __future__ import annotations

import math

import numpy as np
from scipy import linalg

from station.quantities import Floats, Reals, SharedParameters

# The modes hold at least 97 % of the effect of A on a 100 m box where little ground is stable. Where much
# ground is stable A is close to zero, and they hold at least two thirds. What they omit widens sigma.
MODES = 32
SECTOR_RAD = math.radians(15.0)
RING_M = 500.0
RINGS = 12  # the last one also holds everything farther away
SECTORS = round(2 * math.pi / SECTOR_RAD) * RINGS
RIDGE = 1e-9  # regularises parameters that have no effect on any height


def dominant_modes(factor: Floats, mean_jtj: Floats) -> Floats:
    """Return parameter errors M (p, MODES) so that M Mᵀ approximates Fᵀ F of a factor F (k, p).

    They are the modes with the largest effect on heights; `mean_jtj` (p, p) is the mean of JᵀJ.
    """
    scale = np.sqrt(np.diag(mean_jtj))
    scale[scale == 0.0] = 1.0
    normalised = mean_jtj / np.outer(scale, scale)
    normalised[np.diag_indices_from(normalised)] += RIDGE
    cholesky = linalg.cholesky(normalised, lower=True, check_finite=False).T * scale
    height_modes = cholesky @ factor.T  # one mode per row, scaled by its effect on heights
    count = min(MODES, len(height_modes))
    eigenvalues, eigenvectors = linalg.eigh(
        height_modes @ height_modes.T, subset_by_index=(len(height_modes) - count, len(height_modes) - 1)
    )
    errors = np.zeros((len(height_modes), MODES))
    significant = eigenvalues > eigenvalues[-1] * 1e-12
    errors[:, :count][:, significant] = (
        factor.T @ (height_modes.T @ eigenvectors[:, significant]) / np.sqrt(eigenvalues[significant])
    )
    return errors


def polar_mean(azimuth_rad: Reals, range_m: Reals, change: Floats) -> Floats:
    """Return the mean change by azimuth sector and range ring (SECTORS,); zero in empty sectors."""
    sector = (azimuth_rad % (2 * math.pi) / SECTOR_RAD).astype(np.int64) % (SECTORS // RINGS)
    ring = np.minimum(range_m / RING_M, RINGS - 1).astype(np.int64)
    cell = sector * RINGS + ring
    count = np.bincount(cell, minlength=SECTORS)
    return np.asarray(np.bincount(cell, change, SECTORS) / np.maximum(count, 1))


def pattern_correlation(first: Floats, second: Floats) -> float:
    """Return the correlation of two patterns: 1 for equal, 0 for unrelated, -1 for opposite ones.

    It is twice their product over the sum of their squares, so a difference in amplitude lowers it too. Both
    means are removed first: two snowfalls of the same depth need not have the same pattern.
    """
    pair = np.stack([first, second])[:, (first != 0) | (second != 0)]
    if not pair.size:
        return 0.0
    pair -= pair.mean(axis=1, keepdims=True)
    power = float(np.sum(pair**2))
    return 2 * float(pair[0] @ pair[1]) / power if power > 0 else 0.0


def cross_covariance(first: SharedParameters, second: SharedParameters) -> Floats | None:
    """Return the cross-covariance (p, p) of the parameter errors of two scans, or None if it is unknown.

    Both scans refer to the same reference. The correlation of their estimated changes scales the result. For
    the same change, the errors are taken to be as strongly correlated as their magnitudes allow: the modes of
    one scan are rotated onto those of the other (Procrustes), each parameter in units of its sigma.
    """
    if first.change_errors is None or second.change_errors is None or first.names != second.names:
        return None
    correlation = pattern_correlation(first.change_errors.polar_change, second.change_errors.polar_change)
    sigma = np.sqrt(np.diag(first.covariance) + np.diag(second.covariance))[:, None]
    sigma[sigma == 0.0] = 1.0
    u, _, vt = linalg.svd((first.change_errors.modes / sigma).T @ (second.change_errors.modes / sigma))
    return np.asarray(correlation * (first.change_errors.modes @ u) @ (vt @ second.change_errors.modes.T))
