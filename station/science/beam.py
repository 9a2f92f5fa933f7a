"""One shot: polar and Cartesian, its Jacobian, beam width, incidence and footprint."""

from __future__ import annotations

import math

import numpy as np

from station.quantities import Floats

ELLIPSE = -2 * math.log(1 - 0.683)  # 2.2977, the χ² of two dimensions within which 68.3 % lie


def cartesian(range_m: Floats, elevation_rad: Floats, azimuth_rad: Floats) -> Floats:
    """Coordinates (n, 3) in the scanner's frame [m]; elevation counts from the horizontal plane.

    Source: Hartzell et al. (2015), Eq. 1.
    """
    horizontal_m = range_m * np.cos(elevation_rad)
    return np.stack(
        [
            horizontal_m * np.cos(azimuth_rad),
            horizontal_m * np.sin(azimuth_rad),
            range_m * np.sin(elevation_rad),
        ],
        axis=-1,
    )


def polar(xyz_m: Floats) -> tuple[Floats, Floats, Floats]:
    """Range [m], elevation [rad] and azimuth [rad] of points (n, 3).

    Source: Ozendi et al. (2016), Eq. 2-4, with atan2 where the paper's arctangent loses the quadrant.
    """
    x_m, y_m, z_m = np.moveaxis(xyz_m, -1, 0)
    horizontal_m = np.hypot(x_m, y_m)
    return np.hypot(horizontal_m, z_m), np.arctan2(z_m, horizontal_m), np.arctan2(y_m, x_m)


def polar_jacobian(range_m: Floats, elevation_rad: Floats, azimuth_rad: Floats) -> Floats:
    """Derivative (n, 3, 3) of (x, y, z) by (range, elevation, azimuth) [1, m/rad, m/rad].

    Source: Hartzell et al. (2015), Eq. 10; the order of columns is range, vertical, horizontal.
    """
    sin_e, cos_e = np.sin(elevation_rad), np.cos(elevation_rad)
    sin_a, cos_a = np.sin(azimuth_rad), np.cos(azimuth_rad)
    zero = 0.0 * sin_e
    return np.stack(
        [
            np.stack([cos_e * cos_a, -range_m * sin_e * cos_a, -range_m * cos_e * sin_a], axis=-1),
            np.stack([cos_e * sin_a, -range_m * sin_e * sin_a, range_m * cos_e * cos_a], axis=-1),
            np.stack([sin_e, range_m * cos_e, zero], axis=-1),
        ],
        axis=-2,
    )


def point_covariance(jacobian: Floats, sigma_m_rad_rad: Floats) -> Floats:
    """Covariance (n, 3, 3) of points from independent range, elevation and azimuth errors [m²].

    Source: Hartzell et al. (2015), Eq. 9; Leslar et al. (2014), Eq. 7 as printed inverts the inner matrix.
    """
    scaled = jacobian * np.asarray(sigma_m_rad_rad)[..., None, :]
    return np.asarray(scaled @ np.swapaxes(scaled, -1, -2))


def error_ellipse(covariance_m2: Floats) -> tuple[Floats, Floats, Floats]:
    """Semi-axes [m] of the horizontal ellipse that holds points (n,) with 68.3 %, and its azimuth [rad].

    The azimuth, of the longer, is clockwise from north, 0 to π. Unscaled, an ellipse holds 39.35 %.
    Source: Hartzell et al. (2015), text to Fig. 7: sqrt(2.2977 λ), the χ² quantile of two dimensions.
    """
    variance_m2, direction = np.linalg.eigh(covariance_m2[..., :2, :2])
    minor_m, major_m = (np.sqrt(ELLIPSE * np.maximum(variance_m2[..., k], 0.0)) for k in (0, 1))
    azimuth_rad = np.arctan2(direction[..., 0, 1], direction[..., 1, 1]) % math.pi
    return major_m, minor_m, azimuth_rad


def error_ellipsoid(covariance_m2: Floats) -> tuple[Floats, Floats]:
    """Semi-axes (n, 3) [m] of the ellipsoid of one sigma, the longest last, and their directions as columns.

    Source: Ozendi et al. (2016), Eq. 8.
    """
    variance_m2, direction = np.linalg.eigh(covariance_m2)
    return np.sqrt(np.maximum(variance_m2, 0.0)), direction


def diameter(range_m: Floats, divergence_rad: float, exit_diameter_m: float) -> Floats:
    """1/e² diameter of the beam across its axis [m].

    Source: Hartzell et al. (2015), Eq. 6.
    """
    return exit_diameter_m + divergence_rad * range_m


def sigma_beam_angle(divergence_rad: float) -> float:
    """Angle uncertainty from not knowing where in the beam the echo came from [rad].

    Source: Hartzell et al. (2015), Eq. 7: the 1/e² diameter of a Gaussian beam is four sigma.
    """
    return divergence_rad / 4


def sigma_beam_range(range_m: Floats, divergence_rad: float, incidence_rad: Floats) -> Floats:
    """Range uncertainty from the beam's footprint on an inclined surface [m].

    It is the same effect as `sigma_beam_angle` seen along the beam: on a plane, take one of them. Hartzell
    adds both. The incidence is clipped at 87°, where the tangent runs away.
    Source: Hartzell et al. (2015), Eq. 8.
    """
    clipped_rad = np.minimum(incidence_rad, math.radians(87.0))
    return range_m * sigma_beam_angle(divergence_rad) * np.tan(clipped_rad)


def sigma_resolution(step_rad: float) -> float:
    """Angle uncertainty of an encoder that counts in steps [rad].

    Source: Hartzell et al. (2015), section 2.3: a uniform distribution of full width `step_rad`.
    """
    return step_rad / math.sqrt(12)


def cos_incidence(direction: Floats, normal: Floats) -> Floats:
    """Cosine of the angle between beam and surface normal, both (n, 3), of any length; never negative [1].

    Source: Voordendag et al. (2023), Eq. 13, by magnitude: beam down and normal up would give a minus.
    """
    across = np.abs(np.sum(direction * normal, axis=-1))
    return np.asarray(across / (np.linalg.norm(direction, axis=-1) * np.linalg.norm(normal, axis=-1)))


def footprint_axes(range_m: Floats, incidence_rad: Floats, divergence_rad: float) -> tuple[Floats, Floats]:
    """Full major and minor axis of the beam's ellipse on the surface [m].

    Source: Voordendag et al. (2023), Eq. 15 and 16.
    """
    sin_b, cos_b = math.sin(divergence_rad), math.cos(divergence_rad)
    major_m = 2 * range_m * np.cos(incidence_rad) * sin_b / (np.cos(2 * incidence_rad) + cos_b)
    return major_m, 2 * range_m * sin_b / (1 + cos_b)


def footprint_area(major_m: Floats, minor_m: Floats) -> Floats:
    """Area of the footprint from its full axes [m²].

    Source: Voordendag et al. (2023), Eq. 17, with the factor 1/4 that full axes need and the paper lacks.
    """
    return math.pi / 4 * major_m * minor_m


def point_density(range_m: Floats, cos_inc: Floats, cos_slope: Floats, step_rad: float) -> Floats:
    """Points per horizontal square metre of a scan with equal angle steps [1/m²].

    Source: EQUATIONS 5.18, geometry of a plane facet.
    """
    return cos_inc / (cos_slope * (range_m * step_rad) ** 2)
