"""One shot: polar and Cartesian coordinates, Jacobian, beam width, incidence and footprint."""

from __future__ import annotations

import math

import numpy as np

from station.quantities import Floats

Vector = tuple[float, float, float]
CENTRE: Vector = (0.0, 0.0, 0.0)
ELLIPSE = -2 * math.log(1 - 0.683)  # 2.2977, the 68.3 % quantile of χ² in two dimensions


def vertex(origin_m: Floats, range_m: Floats, direction: Floats) -> Floats:
    """Hit points (n, 3) [m] of beams with the given origins and directions (n, 3), at the given ranges.

    Source: Voordendag et al. (2023), Eq. 4, as in the maker's library.
    """
    return np.asarray(origin_m + np.asarray(range_m)[..., None] * direction)


def cartesian(
    range_m: Floats, elevation_rad: Floats, azimuth_rad: Floats, origin_m: Vector = CENTRE
) -> Floats:
    """Coordinates (n, 3) in the scanner's frame [m]; elevation counts from the horizontal plane.

    `origin_m` is where the beam leaves the head: forward, left, up. It rotates with the head.
    Source: Hartzell et al. (2015), Eq. 1; Ozendi et al. (2016), Eq. 1; neither has a beam origin.
    """
    cos_e = np.cos(elevation_rad)
    direction = np.stack(
        [cos_e * np.cos(azimuth_rad), cos_e * np.sin(azimuth_rad), np.sin(elevation_rad)], axis=-1
    )
    return vertex(_rotate_with_head(origin_m, azimuth_rad), range_m, direction)


def _rotate_with_head(origin_m: Vector, azimuth_rad: Floats) -> Floats:
    """Return the beam origin (n, 3) [m] at the head's azimuths (n,), in the scanner's frame."""
    forward_m, left_m, up_m = origin_m
    sin_a, cos_a = np.sin(azimuth_rad), np.cos(azimuth_rad)
    return np.stack(
        [forward_m * cos_a - left_m * sin_a, forward_m * sin_a + left_m * cos_a, up_m + 0.0 * sin_a], axis=-1
    )


def polar(xyz_m: Floats, origin_m: Vector = CENTRE) -> tuple[Floats, Floats, Floats]:
    """Range [m], elevation [rad] and azimuth [rad] of the beams that hit points (n, 3).

    `origin_m` as in `cartesian`; no beam hits a point closer to the axis than the beam's own lateral offset.
    Source: Ozendi et al. (2016), Eq. 2-4, with atan2 where the paper's arctangent loses the quadrant.
    """
    forward_m, left_m, up_m = origin_m
    x_m, y_m, z_m = np.moveaxis(xyz_m, -1, 0)
    distance_m = np.hypot(x_m, y_m)
    forward_distance_m = np.sqrt(np.maximum(distance_m**2 - left_m**2, 0.0))
    azimuth_rad = np.arctan2(y_m, x_m) - np.arctan2(left_m, forward_distance_m)
    horizontal_m, rise_m = forward_distance_m - forward_m, z_m - up_m
    return (
        np.hypot(horizontal_m, rise_m),
        np.arctan2(rise_m, horizontal_m),
        (azimuth_rad + math.pi) % (2 * math.pi) - math.pi if left_m else azimuth_rad,
    )


def polar_jacobian(
    range_m: Floats, elevation_rad: Floats, azimuth_rad: Floats, origin_m: Vector = CENTRE
) -> Floats:
    """Derivative (n, 3, 3) of (x, y, z) by (range, elevation, azimuth) [1, m/rad, m/rad].

    `origin_m` as in `cartesian`: it rotates with the azimuth too.
    Source: Hartzell et al. (2015), Eq. 10; Ozendi et al. (2016), Eq. 7; columns are range, vertical,
    horizontal.
    """
    sin_e, cos_e = np.sin(elevation_rad), np.cos(elevation_rad)
    sin_a, cos_a = np.sin(azimuth_rad), np.cos(azimuth_rad)
    zero = 0.0 * sin_e
    beam_origin = _rotate_with_head(origin_m, azimuth_rad)
    return np.stack(
        [
            np.stack(
                [cos_e * cos_a, -range_m * sin_e * cos_a, -range_m * cos_e * sin_a - beam_origin[..., 1]],
                axis=-1,
            ),
            np.stack(
                [cos_e * sin_a, -range_m * sin_e * sin_a, range_m * cos_e * cos_a + beam_origin[..., 0]],
                axis=-1,
            ),
            np.stack([sin_e, range_m * cos_e, zero], axis=-1),
        ],
        axis=-2,
    )


def point_covariance(jacobian: Floats, sigma_m_rad_rad: Floats) -> Floats:
    """Covariance (n, 3, 3) of points from independent range, elevation and azimuth errors [m²].

    Source: Hartzell et al. (2015), Eq. 9; Ozendi et al. (2016), Eq. 6; Leslar et al. (2014), Eq. 7 as printed
    inverts the inner matrix.
    """
    scaled = jacobian * np.asarray(sigma_m_rad_rad)[..., None, :]
    return np.asarray(scaled @ np.swapaxes(scaled, -1, -2))


def error_ellipse(covariance_m2: Floats) -> tuple[Floats, Floats, Floats]:
    """Semi-axes [m] of the horizontal ellipse that contains points (n,) with 68.3 %, and its azimuth [rad].

    The azimuth of the major axis is clockwise from north, 0 to π. Unscaled, an ellipse contains 39.35 %.
    Source: Hartzell et al. (2015), text to Fig. 7: sqrt(2.2977 λ), the χ² quantile of two dimensions.
    """
    variance_m2, direction = np.linalg.eigh(covariance_m2[..., :2, :2])
    minor_m, major_m = (np.sqrt(ELLIPSE * np.maximum(variance_m2[..., k], 0.0)) for k in (0, 1))
    azimuth_rad = np.arctan2(direction[..., 0, 1], direction[..., 1, 1]) % math.pi
    return major_m, minor_m, azimuth_rad


def error_ellipsoid(covariance_m2: Floats) -> tuple[Floats, Floats]:
    """Semi-axes (n, 3) [m] of the one-sigma ellipsoid, longest last, and their directions as columns.

    Source: Ozendi et al. (2016), Eq. 8.
    """
    variance_m2, directions = np.linalg.eigh(covariance_m2)
    return np.sqrt(np.maximum(variance_m2, 0.0)), directions


def diameter(range_m: Floats, divergence_rad: float, exit_diameter_m: float) -> Floats:
    """1/e² diameter of the beam across its axis [m].

    Source: Hartzell et al. (2015), Eq. 6.
    """
    return exit_diameter_m + divergence_rad * range_m


def sigma_beam_angle(divergence_rad: float) -> float:
    """Angle uncertainty from the unknown position of the echo within the beam [rad].

    Source: Hartzell et al. (2015), Eq. 7: the 1/e² diameter of a Gaussian beam is four sigma.
    """
    return divergence_rad / 4


def sigma_beam_range(range_m: Floats, divergence_rad: float, incidence_rad: Floats) -> Floats:
    """Range uncertainty from the beam's footprint on an inclined surface [m].

    This is the effect of `sigma_beam_angle` seen along the beam: on a plane, use only one of them. Hartzell
    adds both. The incidence is clipped at 87°, because the tangent diverges.
    Source: Hartzell et al. (2015), Eq. 8.
    """
    clipped_rad = np.minimum(incidence_rad, math.radians(87.0))
    return range_m * sigma_beam_angle(divergence_rad) * np.tan(clipped_rad)


def sigma_resolution(step_rad: float) -> float:
    """Angle uncertainty of an encoder with a finite step [rad].

    Source: Hartzell et al. (2015), section 2.3: a uniform distribution of full width `step_rad`.
    """
    return step_rad / math.sqrt(12)


def cos_incidence(direction: Floats, normal: Floats) -> Floats:
    """Cosine of the angle between beam and surface normal, both (n, 3), of any length; non-negative [1].

    Source: Voordendag et al. (2023), Eq. 13, by magnitude: it is negative for a beam down and a normal up.
    """
    projection = np.abs(np.sum(direction * normal, axis=-1))
    return np.asarray(projection / (np.linalg.norm(direction, axis=-1) * np.linalg.norm(normal, axis=-1)))


def footprint_axes(range_m: Floats, incidence_rad: Floats, divergence_rad: float) -> tuple[Floats, Floats]:
    """Full major and minor axis of the beam's ellipse on the surface [m].

    Source: Voordendag et al. (2023), Eq. 15 and 16.
    """
    sin_b, cos_b = math.sin(divergence_rad), math.cos(divergence_rad)
    major_m = 2 * range_m * np.cos(incidence_rad) * sin_b / (np.cos(2 * incidence_rad) + cos_b)
    return major_m, 2 * range_m * sin_b / (1 + cos_b)


def footprint_area(major_m: Floats, minor_m: Floats) -> Floats:
    """Area of the footprint from its full axes [m²].

    Source: Voordendag et al. (2023), Eq. 17, with the factor 1/4 that full axes require and the paper omits.
    """
    return math.pi / 4 * major_m * minor_m


def point_density(range_m: Floats, cos_inc: Floats, cos_slope: Floats, step_rad: float) -> Floats:
    """Points per horizontal square metre of a scan with equal angle steps [1/m²].

    Source: equations.md, 5.18, geometry of a plane facet.
    """
    return cos_inc / (cos_slope * (range_m * step_rad) ** 2)
