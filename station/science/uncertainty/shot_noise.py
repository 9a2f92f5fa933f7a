"""Random height error of a single shot, term by term.

Geometry enters through three numbers: range, cosine of incidence, cosine of the terrain's slope. Errors that
shots have in common are in `jacobian` and `propagation`.
"""

from __future__ import annotations

import math

import numpy as np

from station.quantities import Floats, Scanner
from station.science.geometry.beam import footprint_axes, sigma_beam_angle, sigma_resolution
from station.science.geometry.observation import Observation

# Tilt jitter between scan lines, faster than the log can resolve; equations.md, 6.4, "white per line".
LINE_JITTER_RAD = math.radians(0.0008)
TILT_VOORDENDAG_RAD = math.radians(0.008)  # Voordendag et al. (2023), section 3.2.1
SIGMA_ATMOSPHERE_VOORDENDAG_M = 0.01  # constant adopted by the paper, section 3.2.3


def range_variance(cos_incidence: Floats, cos_slope: Floats, sigma_range_m: float) -> Floats:
    """Variance of a surface's height from the range noise of one shot [m²].

    A range error moves the point along the beam; its vertical effect on a plane is cos α / cos γ of it.
    Source: equations.md, 6.1 (range bias, per unit), as Voordendag et al. (2023), Eq. 12.
    """
    return np.asarray((sigma_range_m * cos_incidence / cos_slope) ** 2)


def angle_variance(range_m: Floats, cos_incidence: Floats, cos_slope: Floats, sigma_rad: float) -> Floats:
    """Variance of a surface's height from the angle noise of one shot, equal in both angles [m²].

    The Jacobian of Hartzell et al. (2015), Eq. 9-10, against a plane: R σ sin α / cos γ.
    """
    return np.asarray((range_m * sigma_rad / cos_slope) ** 2 * (1 - cos_incidence**2))


def sigma_angle(scanner: Scanner) -> float:
    """Random uncertainty of one angle of one shot [rad]: position in the beam, encoder step, line jitter.

    The beam's width counts as an angle (Hartzell et al. 2015, Eq. 7), not again as a range (Eq. 8): on a
    plane both are the same effect, see equations.md, 3.4.
    """
    return math.hypot(
        sigma_beam_angle(scanner.beam_divergence_rad),
        sigma_resolution(scanner.angle_resolution_rad),
        LINE_JITTER_RAD,
    )


def shot_variance(range_m: Floats, cos_incidence: Floats, cos_slope: Floats, scanner: Scanner) -> Floats:
    """Random variance of the surface height from one shot (n,) [m²].

    Source: equations.md, 6.1: the covariance of the point, projected on the vertical through the terrain.
    """
    return range_variance(cos_incidence, cos_slope, scanner.range_sigma_m) + angle_variance(
        range_m, cos_incidence, cos_slope, sigma_angle(scanner)
    )


def sigma_instrument(range_m: Floats, sigma_tilt_rad: float = TILT_VOORDENDAG_RAD) -> Floats:
    """Height uncertainty from the unknown tilt [m].

    Source: Voordendag et al. (2023), Eq. 5.
    """
    return range_m * math.sin(sigma_tilt_rad)


def sigma_atmosphere(range_error_m: Floats | float, cos_incidence: Floats, cos_slope: Floats) -> Floats:
    """Height uncertainty from a range error along the beam [m].

    Source: Voordendag et al. (2023), Eq. 12.
    """
    return np.asarray(range_error_m * cos_incidence / cos_slope)


def sigma_geometry(
    range_m: Floats, cos_incidence: Floats, cos_slope: Floats, sin_rise: Floats, divergence_rad: float
) -> Floats:
    """Height uncertainty from the footprint: a third of its vertical extent [m].

    `sin_rise` is the sine of the beam's elevation angle. The vertical part of the unit vector of the beam
    projected into the surface is (sin_rise + cos α cos γ) / sin α. Incidence is clipped at 87°.
    Source: Voordendag et al. (2023), Eq. 18.
    """
    cos_incidence = np.maximum(cos_incidence, math.cos(math.radians(87.0)))
    sin_incidence = np.sqrt(np.maximum(1 - cos_incidence**2, 1e-12))
    major_m, _ = footprint_axes(range_m, np.arccos(cos_incidence), divergence_rad)
    vertical = np.abs(sin_rise + cos_incidence * cos_slope) / sin_incidence
    return np.asarray(major_m * np.minimum(vertical, 1.0) / 3)


def shot_variance_voordendag(
    range_m: Floats, cos_incidence: Floats, cos_slope: Floats, sin_rise: Floats, scanner: Scanner
) -> Floats:
    """Squared σ_point of the published budget (n,) [m²], to be divided by the points of a cell (Eq. 2).

    It treats the tilt as independent between shots, which understates σ of an area mean 40 times.
    Source: Voordendag et al. (2023), Eq. 1.
    """
    return np.asarray(
        sigma_instrument(range_m) ** 2
        + sigma_geometry(range_m, cos_incidence, cos_slope, sin_rise, scanner.beam_divergence_rad) ** 2
        + SIGMA_ATMOSPHERE_VOORDENDAG_M**2
    )


def sigma_total_voordendag(sigma_cell_m: Floats, sigma_registration_m: float) -> Floats:
    """Total uncertainty of the published budget [m]: a bound, not a standard deviation.

    Source: Voordendag et al. (2023), Eq. 3.
    """
    return sigma_cell_m + sigma_registration_m


def height_variance(observation: Observation, scanner: Scanner, *, published: bool) -> Floats:
    """Random variance of one shot's height (n,) [m²], by the corrected or the published budget."""
    geometry = observation.range_m, observation.cos_incidence, observation.cos_slope
    if published:
        sin_rise = observation.offset_m[2] / observation.range_m
        return shot_variance_voordendag(*geometry, sin_rise, scanner)
    return shot_variance(*geometry, scanner)
