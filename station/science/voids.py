"""Cells of an area that a scan did not see: interpolated, with what that leaves unknown.

Hartzell et al. (2015) fill the voids of a raster by interpolation and carry the errors of the cells it is
made from into the volume. So does this, by weights. What the ground did in a void beyond what its
neighbours tell is not in the paper; here it is taken from how much the seen cells differ at that distance.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from station.quantities import Bools, Floats, Ints

ENOUGH = 3  # seen cells in a window, for their mean to stand for its middle


def area_weights(cells: Bools, seen: Bools) -> tuple[Floats, Ints]:
    """Weights (ny, nx) of the seen cells in the mean over an area whose voids are interpolated, and reaches.

    A void cell is the mean of the area's seen cells in the smallest window of 3, 5, 9, 17 … cells about it
    that holds enough of them; its reach (ny, nx) is half that window's width, nought elsewhere. The weights
    add up to one where anything was seen. Source: EQUATIONS 6.2, for a.
    """
    known = cells & seen
    weights = known.astype(np.float64)
    left, reach = cells & ~seen, np.zeros(cells.shape, np.int64)
    widest, half = max(cells.shape), 1
    if not known.any():
        return weights, reach
    while left.any():
        width = 2 * half + 1
        count = _window_sum(known.astype(np.float64), width).round()
        found = left & (count >= (ENOUGH if half < widest else 1))
        share = np.where(found, 1 / np.maximum(count, 1), 0.0)
        weights += np.where(known, _window_sum(share, width), 0.0)
        reach[found] = half
        left &= ~found
        half *= 2
    return np.asarray(weights / np.count_nonzero(cells)), reach


def void_variance(cells: Bools, reach: Ints, change_m: Floats, random_variance_m2: Floats) -> float:
    """Variance of the mean over an area from what its void cells did beyond their neighbours' mean [m²].

    `change_m` (ny, nx) is NaN where not seen. A cell interpolated from a distance is wrong by about the
    semivariance of the change at that distance, less what is noise; within one void by the same amount
    throughout, from void to void independently.
    """
    halves = np.unique(reach[reach > 0])
    if not len(halves):
        return 0.0
    inside = np.where(cells, change_m, np.nan)
    semivariance_m2 = np.maximum.accumulate(
        [_semivariance(inside, random_variance_m2, int(half)) for half in halves]
    )
    error_m = np.zeros(cells.shape)
    error_m[reach > 0] = np.sqrt(semivariance_m2)[np.searchsorted(halves, reach[reach > 0])]
    label, count = ndimage.label(reach > 0)
    of_voids_m = np.bincount(label.ravel(), error_m.ravel(), count + 1)[1:]
    return float(np.sum(of_voids_m**2) / np.count_nonzero(cells) ** 2)


def _semivariance(change_m: Floats, random_variance_m2: Floats, lag: int) -> float:
    """Half the mean square of what cells so many apart differ by, less their noise [m²]."""
    total_m2, count = 0.0, 0
    for surface_m, noise_m2 in ((change_m, random_variance_m2), (change_m.T, random_variance_m2.T)):
        apart_m2 = (surface_m[lag:] - surface_m[:-lag]) ** 2 - (noise_m2[lag:] + noise_m2[:-lag])
        total_m2 += float(np.nansum(apart_m2))
        count += int(np.count_nonzero(np.isfinite(apart_m2)))
    if not count:  # nothing is seen so far apart: as much as all that is seen varies
        return float(np.nanvar(change_m))
    return max(total_m2 / count / 2, 0.0)


def _window_sum(values: Floats, width: int) -> Floats:
    return np.asarray(ndimage.uniform_filter(values, width, mode="constant")) * width**2
