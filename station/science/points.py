"""What is not known of where a single point lies: its covariance (3, 3), and the ellipse that shows it."""

from __future__ import annotations

import numpy as np

from station.quantities import Floats, Scanner, Shared
from station.science.beam import point_covariance, polar, polar_jacobian
from station.science.registration import pose_jacobian
from station.science.shared import Basis, sensitivities
from station.science.uncertainty import sigma_angle

# Slopes (east, north), the variances of heights across which tell a whole covariance of (x, y, z).
SLOPES = ((0.0, 0.0), (1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0), (1.0, 1.0))


def shot_covariance(offset_m: Floats, axis: Floats, scanner: Scanner) -> Floats:
    """Covariance (n, 3, 3) of points from what each shot has for itself [m²]: range, beam, encoder, jitter.

    `offset_m` (n, 3) is from the scanner, `axis` (3,) what its head turns about, both on the map. The beam's
    width counts once, as an angle (EQUATIONS 3.4); beams begin where the scanner has it.
    Source: EQUATIONS 3.1 and 3.3, about the head's axis.
    """
    upright = _about(axis)
    begin_m = scanner.beam_origin_m
    jacobian = upright @ polar_jacobian(*polar(offset_m @ upright, begin_m), begin_m)
    angle_rad = sigma_angle(scanner)
    return point_covariance(jacobian, np.array([scanner.range_sigma_m, angle_rad, angle_rad]))


def _about(axis: Floats) -> Floats:
    """Return a rotation (3, 3) whose third column is the axis."""
    third = axis / np.linalg.norm(axis)
    first = np.cross(np.eye(3)[int(np.argmin(np.abs(third)))], third)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(third, first), third], axis=-1)


def registered_covariance(
    own_m2: Floats, offset_m: Floats, registration: Floats, sigma_tilt_rad: float
) -> Floats:
    """Covariance (n, 3, 3) of registered points [m²]: the shot's own, registration (6, 6) and lean.

    `offset_m` (n, 3) is from the scanner. The lean is unsure by the same in both directions, so that it does
    not matter which way the scanner looks. Each is right for a point alone; points share the last two, which
    this form does not tell: see `volume.variance` and `shared_covariance`.
    Source: EQUATIONS 3.1: Hartzell et al. (2015), Eq. 5, propagated.
    """
    jacobian = pose_jacobian(offset_m)
    pose = registration.copy()
    pose[:2, :2] += np.eye(2) * sigma_tilt_rad**2
    return np.asarray(own_m2 + jacobian @ pose @ np.swapaxes(jacobian, -1, -2))


def shared_covariance(of: Basis, offset_m: Floats, unknown: Shared) -> Floats:
    """Covariance (n, 3, 3) of points from what all points of a scan share [m²].

    It is told by the variances of their heights across six slopes, each by the one home of those effects.
    Source: EQUATIONS 6.1 and 6.2.
    """
    x_m, y_m, z_m = offset_m.T
    flat, east, west, north, south, both = (
        sensitivities(of, (x_m, y_m, z_m), np.full_like(x_m, g_east), np.full_like(x_m, g_north)).variance(
            unknown
        )
        for g_east, g_north in SLOPES
    )
    xx, yy = (east + west) / 2 - flat, (north + south) / 2 - flat
    xz, yz = (west - east) / 4, (south - north) / 4
    xy = (both - flat - xx - yy) / 2 + xz + yz
    return np.stack([xx, xy, xz, xy, yy, yz, xz, yz, flat], axis=-1).reshape(-1, 3, 3)
