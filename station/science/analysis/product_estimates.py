"""Quantities that the owner of a station asks for, from heights and changes: pure functions, one for each.

Random and systematic errors stay apart: those of cells average out, those that cells share do not.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from station.quantities import Bools, Floats, Ints
from station.science.gridding.significance import significant

WATER_KG_M3 = 1000.0
SIGN_WINDOW_CELLS = 5  # the neighbours that decide whether a cell lost or gained
CLEAR_SIGMAS = 4.0  # beyond, a cell decides itself: noise gets there once in 16,000 cells
CROSSING_SAMPLES = 2  # on either side of a crossing, which it is from
CREST_SAMPLES = 3  # on either side of the highest, which make its parabola
SCATTER_SAMPLES = 10  # on either side, which show how the ground scatters about lines and parabolas


@dataclass(frozen=True)
class Estimate:
    """Values with the random and the systematic part of their variance; NaN if unknown."""

    value: float | Floats = np.nan
    random_variance: float | Floats = np.nan
    systematic_variance: float | Floats = np.nan

    @property
    def variance(self) -> float | Floats:
        """The variance of all errors together."""
        return self.random_variance + self.systematic_variance

    def with_offset(self, offset: float, sigma: float) -> Estimate:
        """Return the estimate plus an offset that is known to one sigma, the same in every epoch."""
        return replace(
            self, value=self.value + offset, systematic_variance=self.systematic_variance + sigma**2
        )

    def scaled(self, factor: float) -> Estimate:
        """Return the estimate times a factor that is exact."""
        return Estimate(
            self.value * factor, self.random_variance * factor**2, self.systematic_variance * factor**2
        )


def water_equivalent(thickness: Estimate, density_kg_m3: float, density_sigma_kg_m3: float) -> Estimate:
    """Return a thickness as metres of water equivalent [m w.e.].

    The error of the density is the same in every epoch. Source: equations.md, 6.15.
    """
    scaled = thickness.scaled(density_kg_m3 / WATER_KG_M3)
    density_variance = (thickness.value**2 + thickness.variance) * (density_sigma_kg_m3 / WATER_KG_M3) ** 2
    return replace(scaled, systematic_variance=scaled.systematic_variance + density_variance)


class SignOfChange(NamedTuple):
    """Which cells gained material, of which this is certain, and the variance of what decides by noise."""

    gained: Bools
    certain: Bools
    random_m2: Floats


def sign_of_change(change_m: Floats, random_m2: Floats, systematic_m2: Floats) -> SignOfChange:
    """Return which cells (ny, nx) gained material, from their changes and both parts of their variance.

    Changes are NaN where not observed. The mean of the neighbours decides, not the cell itself: then its
    noise is as often positive as negative in either class, and sums over a class have no bias, without a
    level of detection. A change far beyond the noise, or without neighbours, decides itself. Source:
    equations.md, 6.16.
    """
    known = np.isfinite(change_m)
    values, own_m2 = np.where(known, change_m, 0.0), np.where(known, random_m2, 0.0)
    count = np.rint(_near(known * 1.0)) - known
    alone = known & ((count == 0) | (np.abs(values) > CLEAR_SIGMAS * np.sqrt(own_m2)))
    number = np.maximum(count, 1.0)
    deciding_m = np.where(alone, values, (_near(values) - values) / number)
    deciding_m2 = np.where(alone, own_m2, np.maximum(_near(own_m2) - own_m2, 0.0) / number**2)
    certain = significant(deciding_m, np.sqrt(deciding_m2 + np.where(known, systematic_m2, 0.0)))
    return SignOfChange(known & (deciding_m > 0), known & certain, deciding_m2)


def _near(values: Floats) -> Floats:
    """Return the sum of values (ny, nx) in the window around each cell."""
    return np.asarray(
        ndimage.uniform_filter(values, SIGN_WINDOW_CELLS, mode="constant") * SIGN_WINDOW_CELLS**2
    )


def thickness_between(height_m: Floats, low_m: Floats, high_m: Floats) -> tuple[Floats, Floats]:
    """Return the thickness (n,) of material between two levels [m], and its derivative by the height.

    The derivative is one where the surface lies between them, zero elsewhere. Source: equations.md, 6.17.
    """
    inside = (height_m > low_m) & (height_m < high_m)
    return np.clip(height_m, low_m, high_m) - low_m, inside.astype(np.float64)


class LinePosition(NamedTuple):
    """A place along a profile: its distance [m], and how far it moves by the height of each sample [m/m]."""

    distance_m: float
    samples: Ints  # (k,) that it is from
    sensitivity: Floats  # (k,)
    relief: Floats  # (k,) likewise by heights that are no error, but that no line or parabola has
    relief_m2: float  # variance of such heights


def crossing(distance_m: Floats, height_m: Floats, noise_m2: Floats, level_m: float) -> LinePosition | None:
    """Return the first place along a profile (n,) where its height crosses a level; None if there is none.

    Heights are NaN where not observed; `noise_m2` (n,) is their random variance. The place is between two of
    the samples on either side, which noise has brought nearer to a straight line than they were measured.
    Source: equations.md, 6.18.
    """
    above, known = height_m > level_m, np.isfinite(height_m)
    for first in np.flatnonzero((above[1:] != above[:-1]) & known[1:] & known[:-1]).tolist():
        samples = _around(known, first - CROSSING_SAMPLES + 1, first + CROSSING_SAMPLES)
        offset_m = distance_m[samples] - distance_m[samples].mean()
        line = 1 / len(samples) + np.outer(offset_m, offset_m) / (offset_m @ offset_m)
        relief_m2, kept = _relief(distance_m, height_m, noise_m2, first, 2 * CROSSING_SAMPLES, 1)
        smoothing = line + kept * (np.eye(len(samples)) - line)
        sign = 1.0 if above[first + 1] else -1.0
        smooth_m = sign * (smoothing @ height_m[samples] - level_m)
        rising = np.flatnonzero((smooth_m[1:] > 0) & (smooth_m[:-1] <= 0))
        if not len(rising):
            continue
        before, step_m = int(rising[0]), np.diff(smooth_m)[rising[0]]
        length_m = distance_m[samples[before + 1]] - distance_m[samples[before]]
        share = -smooth_m[before] / step_m
        between = np.zeros(len(samples))
        between[before : before + 2] = 1 - share, share
        moves = -sign * length_m / step_m * between
        return LinePosition(
            float(distance_m[samples[before]] + share * length_m),
            samples,
            moves @ smoothing,
            moves @ (smoothing - np.eye(len(samples))),
            relief_m2,
        )
    return None


def crest(distance_m: Floats, height_m: Floats, noise_m2: Floats) -> LinePosition | None:
    """Return the place of the crest of a profile (n,); None if its highest sample is at an end or a gap.

    Heights are NaN where not observed; `noise_m2` (n,) is their random variance. It is the summit of the
    parabola through the samples around the highest. Source: equations.md, 6.18.
    """
    known = np.isfinite(height_m)
    if not known.any():
        return None
    highest = int(np.nanargmax(height_m))
    samples = _around(known, highest - CREST_SAMPLES, highest + CREST_SAMPLES)
    if not samples[0] < highest < samples[-1] or len(samples) < 4:
        return None
    origin_m = distance_m[highest]
    fit = np.linalg.pinv(np.vander(distance_m[samples] - origin_m, 3, increasing=True))  # (3, k)
    _, slope, curvature = fit @ height_m[samples]
    if curvature >= 0:
        return None
    sensitivity = (slope * fit[2] / curvature - fit[1]) / (2 * curvature)
    relief_m2, _ = _relief(distance_m, height_m, noise_m2, highest, 2 * CREST_SAMPLES + 1, 2)
    return LinePosition(
        float(origin_m - slope / (2 * curvature)), samples, sensitivity, sensitivity, relief_m2
    )


def _relief(
    distance_m: Floats, height_m: Floats, noise_m2: Floats, place: int, count: int, degree: int
) -> tuple[float, float]:
    """Return the variance of true heights about polynomials [m²], and its share in that of measured ones.

    It is what the scatter around a place exceeds the noise by.
    """
    around = slice(max(place - SCATTER_SAMPLES, 0), place + SCATTER_SAMPLES + 1)
    scatter_m2 = _scatter(distance_m[around], height_m[around], count, degree)
    relief_m2 = max(scatter_m2 - float(np.mean(noise_m2[around][np.isfinite(height_m[around])])), 0.0)
    return relief_m2, relief_m2 / scatter_m2 if relief_m2 > 0 else 0.0


def _scatter(distance_m: Floats, height_m: Floats, count: int, degree: int) -> float:
    """Return the mean variance of heights (n,) about the polynomials through `count` consecutive ones [m²].

    It is 0 if nowhere enough of them are known.
    """
    if len(height_m) < count:
        return 0.0
    windows_m = np.lib.stride_tricks.sliding_window_view(height_m, count)
    windows_m = windows_m[np.isfinite(windows_m).all(axis=1)]
    if not len(windows_m):
        return 0.0
    basis = np.vander(distance_m[:count] - distance_m[0], degree + 1)
    residuals_m = windows_m - windows_m @ (basis @ np.linalg.pinv(basis)).T
    return float(np.mean(residuals_m**2) * count / (count - degree - 1))


def _around(known: Bools, first: int, last: int) -> Ints:
    """Return the known samples from `first` to `last` inclusive, as far as the profile goes."""
    window = np.arange(max(first, 0), min(last + 1, len(known)))
    return window[known[window]]
