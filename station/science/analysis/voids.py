"""Cells of an area that a scan did not observe: interpolation and its variance.

Hartzell et al. (2015) fill the voids of a raster by interpolation and propagate the errors of the cells used
into the volume. The weights below do the same. The paper omits the deviation of the surface in a void from
its neighbours; it is estimated here from the differences of observed cells at that distance.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from station.quantities import Bools, Floats, Ints

MIN_NEIGHBOURS = 3  # observed cells in a window that suffice for a mean


def area_weights(cells: Bools, observed: Bools) -> tuple[Floats, Ints]:
    """Weights of the observed cells in an area mean with interpolated voids, and fill distances (ny, nx).

    A void cell is the mean of the area's observed cells in the smallest window of 3, 5, 9, 17 … cells around
    it that holds enough of them. Its fill distance (ny, nx) is half the width of that window [cells], zero
    elsewhere. The weights sum to one if anything was observed. Source: equations.md, 6.2, for a.
    """
    known = cells & observed
    weights = known.astype(np.float64)
    unfilled, fill_distance = cells & ~observed, np.zeros(cells.shape, np.int64)
    widest, half_width = max(cells.shape), 1
    if not known.any():
        return weights, fill_distance
    while unfilled.any():
        width = 2 * half_width + 1
        count = _window_sum(known.astype(np.float64), width).round()
        filled = unfilled & (count >= (MIN_NEIGHBOURS if half_width < widest else 1))
        share = np.where(filled, 1 / np.maximum(count, 1), 0.0)
        weights += np.where(known, _window_sum(share, width), 0.0)
        fill_distance[filled] = half_width
        unfilled &= ~filled
        half_width *= 2
    return np.asarray(weights / np.count_nonzero(cells)), fill_distance


def void_variance(cells: Bools, fill_distance: Ints, change_m: Floats, random_variance_m2: Floats) -> float:
    """Variance of the mean of an area from the deviation of its void cells from their neighbours' mean [m²].

    `change_m` (ny, nx) is NaN where not observed. The error of an interpolated cell is taken as the
    semivariance of the change at its fill distance, minus noise: fully correlated within a void, independent
    between voids.
    """
    distances = np.unique(fill_distance[fill_distance > 0])
    if not len(distances):
        return 0.0
    inside = np.where(cells, change_m, np.nan)
    semivariance_m2 = np.maximum.accumulate(
        [_semivariance(inside, random_variance_m2, int(distance)) for distance in distances]
    )
    error_m = np.zeros(cells.shape)
    error_m[fill_distance > 0] = np.sqrt(semivariance_m2)[
        np.searchsorted(distances, fill_distance[fill_distance > 0])
    ]
    label, count = ndimage.label(fill_distance > 0)
    void_error_m = np.bincount(label.ravel(), error_m.ravel(), count + 1)[1:]
    return float(np.sum(void_error_m**2) / np.count_nonzero(cells) ** 2)


def _semivariance(change_m: Floats, random_variance_m2: Floats, lag: int) -> float:
    """Half the mean squared difference of cells `lag` cells apart, minus their noise [m²]."""
    total_m2, count = 0.0, 0
    for surface_m, noise_m2 in ((change_m, random_variance_m2), (change_m.T, random_variance_m2.T)):
        difference_m2 = (surface_m[lag:] - surface_m[:-lag]) ** 2 - (noise_m2[lag:] + noise_m2[:-lag])
        total_m2 += float(np.nansum(difference_m2))
        count += int(np.count_nonzero(np.isfinite(difference_m2)))
    if not count:  # no observed pair at this distance: the variance of all observed cells
        return float(np.nanvar(change_m))
    return max(total_m2 / count / 2, 0.0)


def _window_sum(values: Floats, width: int) -> Floats:
    return np.asarray(ndimage.uniform_filter(values, width, mode="constant")) * width**2
