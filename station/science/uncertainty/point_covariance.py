"""Covariance (3, 3) of the position of single points: shot noise, registration and shared errors."""

from __future__ import annotations

import numpy as np

from station.quantities import Floats, Scanner, SharedParameters
from station.science.geometry.beam import point_covariance, polar, polar_jacobian
from station.science.geometry.registration import pose_jacobian
from station.science.uncertainty.jacobian import height_jacobian
from station.science.uncertainty.parameters import ParameterLayout
from station.science.uncertainty.shot_noise import sigma_angle

# Slopes (east, north) whose height variances together determine the covariance of (x, y, z).
SLOPES = ((0.0, 0.0), (1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0), (1.0, 1.0))


def shot_covariance(offset_m: Floats, axis: Floats, scanner: Scanner) -> Floats:
    """Covariance (n, 3, 3) of points from the noise of each shot [m²]: range, beam, encoder, line jitter.

    `offset_m` (n, 3) is from the scanner, `axis` (3,) is the head's axis of rotation, both on map axes. The
    beam's width counts once, as an angle (equations.md, 3.4); beams start at the scanner's beam origin.
    Source: equations.md, 3.1 and 3.3, about the head's axis.
    """
    to_axis = _about(axis)
    origin_m = scanner.beam_origin_m
    jacobian = to_axis @ polar_jacobian(*polar(offset_m @ to_axis, origin_m), origin_m)
    angle_rad = sigma_angle(scanner)
    return point_covariance(jacobian, np.array([scanner.range_sigma_m, angle_rad, angle_rad]))


def _about(axis: Floats) -> Floats:
    """Return a rotation (3, 3) whose third column is the axis."""
    up = axis / np.linalg.norm(axis)
    side = np.cross(np.eye(3)[int(np.argmin(np.abs(up)))], up)
    side /= np.linalg.norm(side)
    return np.stack([side, np.cross(up, side), up], axis=-1)


def registered_covariance(
    shot_covariance_m2: Floats, offset_m: Floats, registration: Floats, sigma_tilt_rad: float
) -> Floats:
    """Covariance (n, 3, 3) of registered points [m²]: shot noise, registration (6, 6) and tilt.

    `offset_m` (n, 3) is from the scanner. The sigma of the tilt is the same in both directions, so that the
    scanner's heading does not matter. The result holds for single points only: registration and tilt are
    shared by all points, which this form does not represent; see `shared_covariance`.
    Source: equations.md, 3.1: Hartzell et al. (2015), Eq. 5, propagated.
    """
    jacobian = pose_jacobian(offset_m)
    pose = registration.copy()
    pose[:2, :2] += np.eye(2) * sigma_tilt_rad**2
    return np.asarray(shot_covariance_m2 + jacobian @ pose @ np.swapaxes(jacobian, -1, -2))


def shared_covariance(params: ParameterLayout, offset_m: Floats, posterior: SharedParameters) -> Floats:
    """Covariance (n, 3, 3) of points from the parameters that all points of a scan share [m²].

    It follows from the height variances on six slopes, so that `height_jacobian` stays the only
    implementation of these effects.
    Source: equations.md, 6.1 and 6.2.
    """
    x_m, y_m, z_m = offset_m.T
    flat, east, west, north, south, both = (
        height_jacobian(
            params, (x_m, y_m, z_m), np.full_like(x_m, g_east), np.full_like(x_m, g_north)
        ).variance(posterior)
        for g_east, g_north in SLOPES
    )
    xx, yy = (east + west) / 2 - flat, (north + south) / 2 - flat
    xz, yz = (west - east) / 4, (south - north) / 4
    xy = (both - flat - xx - yy) / 2 + xz + yz
    return np.stack([xx, xy, xz, xy, yy, yz, xz, yz, flat], axis=-1).reshape(-1, 3, 3)
