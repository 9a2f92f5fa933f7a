"""The crossing of a height by a profile, sample by sample, with numerical derivatives."""

import numpy as np


def crossing(distance_m, heights_m, noise_m2, level_m):
    """Return the place, its weights by heights and by relief, and the variance of the relief.

    Of a profile (n,) that climbs. Heights around the first crossing are as far from the line through four of
    them as they were measured, times the share of what four heights scatter that is no noise.
    """
    known = np.isfinite(heights_m)
    first = int(np.flatnonzero(heights_m > level_m)[0]) - 1
    samples = np.array([k for k in range(first - 1, first + 3) if known[k]])
    around = range(max(first - 10, 0), min(first + 11, len(heights_m)))
    fits = [np.polyfit(range(4), heights_m[k : k + 4], 1, full=True)[1] for k in around[:-3]
            if np.isfinite(heights_m[k : k + 4]).all()]  # fmt: skip
    scatter_m2 = np.mean(fits) / 2  # four samples less two unknowns
    relief_m2 = max(scatter_m2 - np.mean([noise_m2[k] for k in around if known[k]]), 0.0)
    kept, at_m = relief_m2 / scatter_m2, distance_m[samples]

    def smooth(heights):
        line = np.polyval(np.polyfit(at_m, heights, 1), at_m)
        return line + kept * (heights - line)

    def place_m(smoothed):
        return np.interp(level_m, smoothed, at_m)

    near_m, step = heights_m[samples], 1e-4
    weights, relief = np.zeros((2, len(heights_m)))
    for sample, lift in zip(samples, step * np.eye(len(samples)), strict=True):
        low, high = (place_m(smooth(near_m + sign * lift)) for sign in (-1, 1))
        weights[sample] = (high - low) / (2 * step)
        low, high = (place_m(smooth(near_m) + sign * lift) for sign in (-1, 1))
        relief[sample] = weights[sample] - (high - low) / (2 * step)
    return place_m(smooth(near_m)), weights, relief, relief_m2
