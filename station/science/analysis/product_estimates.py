"""Quantities that the owner of a station asks for, from heights and changes: pure functions, one for each.

Random and systematic errors stay apart: those of cells average out, those that cells share do not.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from station.quantities import Bools, Floats, Ints

WATER_KG_M3 = 1000.0
SIGN_WINDOW_CELLS = 5  # the neighbours that decide whether a cell lost or gained
CLEAR_SIGMAS = 4.0  # beyond, a cell decides itself: noise gets there once in 16,000 cells
CROSSING_SAMPLES = 2  # on either side of a crossing, which make its line
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


def gained(change_m: Floats, random_m: Floats) -> Bools:
    """Return True for the cells (ny, nx) of an area that gained material; NaN outside it.

    The neighbours decide, not the cell itself: then its noise is as often positive as negative in either
    class, and sums over a class have no bias, without a level of detection. A change far beyond the noise
    decides itself. Source: equations.md, 6.16.
    """
    known = np.isfinite(change_m)
    values = np.where(known, change_m, 0.0)
    neighbours = ndimage.uniform_filter(values, SIGN_WINDOW_CELLS, mode="constant") * SIGN_WINDOW_CELLS**2
    clear = known & (np.abs(values) > CLEAR_SIGMAS * np.where(known, random_m, np.inf))
    return np.asarray(known & (np.where(clear, values, neighbours - values) > 0))


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
    scatter_m2: float  # variance of a height about such a line or parabola, of the samples around

    @property
    def scatter_variance(self) -> float:
        """Variance of the distance that the scatter of the heights causes [m²]."""
        return float(self.scatter_m2 * self.sensitivity @ self.sensitivity)


def crossing(distance_m: Floats, height_m: Floats, level_m: float) -> LinePosition | None:
    """Return the first place along a profile (n,) where its height crosses a level; None if there is none.

    Heights are NaN where not observed. The place is that on the straight line through the samples on either
    side. Source: equations.md, 6.18.
    """
    above, known = height_m > level_m, np.isfinite(height_m)
    for first in np.flatnonzero((above[1:] != above[:-1]) & known[1:] & known[:-1]).tolist():
        samples = _around(known, first - CROSSING_SAMPLES + 1, first + CROSSING_SAMPLES)
        offset_m, h = distance_m[samples] - distance_m[samples].mean(), height_m[samples]
        slope = float(offset_m @ h / (offset_m @ offset_m))
        if slope * (height_m[first + 1] - height_m[first]) > 0:
            shift_m = (level_m - h.mean()) / slope
            sensitivity = -(1 / len(h) + shift_m * offset_m / (offset_m @ offset_m)) / slope
            scatter_m2 = _scatter(distance_m, height_m, first, 2 * CROSSING_SAMPLES, 1)
            return LinePosition(float(distance_m[samples].mean() + shift_m), samples, sensitivity, scatter_m2)
    return None


def crest(distance_m: Floats, height_m: Floats) -> LinePosition | None:
    """Return the place of the crest of a profile (n,); None if its highest sample is at an end or a gap.

    Heights are NaN where not observed. It is the summit of the parabola through the samples around the
    highest. Source: equations.md, 6.18.
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
    scatter_m2 = _scatter(distance_m, height_m, highest, 2 * CREST_SAMPLES + 1, 2)
    return LinePosition(float(origin_m - slope / (2 * curvature)), samples, sensitivity, scatter_m2)


def _scatter(distance_m: Floats, height_m: Floats, place: int, count: int, degree: int) -> float:
    """Return the mean variance of heights about the polynomials through `count` consecutive ones [m²].

    Of the samples around a place; 0 if nowhere enough of them are known.
    """
    around = slice(max(place - SCATTER_SAMPLES, 0), place + SCATTER_SAMPLES + 1)
    if len(height_m[around]) < count:
        return 0.0
    windows_m = np.lib.stride_tricks.sliding_window_view(height_m[around], count)
    windows_m = windows_m[np.isfinite(windows_m).all(axis=1)]
    if not len(windows_m):
        return 0.0
    basis = np.vander(distance_m[around][:count] - distance_m[around][0], degree + 1)
    residuals_m = windows_m - windows_m @ (basis @ np.linalg.pinv(basis)).T
    return float(np.mean(residuals_m**2) * count / (count - degree - 1))


def _around(known: Bools, first: int, last: int) -> Ints:
    """Return the known samples from `first` to `last` inclusive, as far as the profile goes."""
    window = np.arange(max(first, 0), min(last + 1, len(known)))
    return window[known[window]]
