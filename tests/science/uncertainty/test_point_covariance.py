"""Covariance of single points against simulated errors."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from station.quantities import Grid, Scanner
from station.science.geometry import beam
from station.science.uncertainty import parameters, point_covariance, propagation
from station.science.uncertainty.shot_noise import sigma_angle

SCANNER = Scanner("sim", 1.55, 0.3e-3, 0.0, 0.02, math.radians(0.002), 0.0, 0.0, 6000.0)
OFFSET_M = np.array([[400.0, 900.0, -200.0], [150.0, 520.0, 340.0]])
AXIS = Rotation.from_rotvec([0.3, -0.5, 0.1]).apply([0.0, 0.0, 1.0])  # tilted by more than 30°
DRAWS = 40_000


def sample_covariance(points):
    return np.array([np.cov(points[:, i].T) for i in range(points.shape[1])])


def assert_close(actual, expected):
    """Check each element within the sampling error of the draws."""
    size = np.sqrt(np.einsum("nii,njj->nij", expected, expected))
    assert np.abs(actual - expected).max() > 0
    assert np.all(np.abs(actual - expected) < 0.03 * size)


def test_shot_covariance_about_a_tilted_axis():
    """Random draws of the noise of range and of the two angles about the head's axis."""
    rng = np.random.default_rng(3)
    to_head = Rotation.align_vectors([[0, 0, 1.0]], [AXIS])[0]
    range_m, elevation, azimuth = beam.polar(to_head.apply(OFFSET_M))
    draws = rng.standard_normal((3, DRAWS, 2))
    points = beam.cartesian(
        range_m + 0.02 * draws[0],
        elevation + sigma_angle(SCANNER) * draws[1],
        azimuth + sigma_angle(SCANNER) * draws[2],
    )
    drawn = to_head.inv().apply(points.reshape(-1, 3)).reshape(points.shape)
    assert_close(point_covariance.shot_covariance(OFFSET_M, AXIS, SCANNER), sample_covariance(drawn))


def test_shot_covariance_of_a_near_point_with_a_beam_origin_off_the_centre():
    """A beam origin off the centre changes the covariance of a near point by more than 10 %."""
    scanner = replace(SCANNER, beam_origin_m=(0.1, 0.3, 0.2), range_sigma_m=1e-3, angle_resolution_rad=0.02)
    near_m = OFFSET_M / 500
    rng = np.random.default_rng(7)
    to_head = Rotation.align_vectors([[0, 0, 1.0]], [AXIS])[0]
    range_m, elevation, azimuth = beam.polar(to_head.apply(near_m), scanner.beam_origin_m)
    draws = rng.standard_normal((3, DRAWS, 2))
    points = beam.cartesian(
        range_m + 1e-3 * draws[0],
        elevation + sigma_angle(scanner) * draws[1],
        azimuth + sigma_angle(scanner) * draws[2],
        scanner.beam_origin_m,
    )
    drawn = sample_covariance(to_head.inv().apply(points.reshape(-1, 3)).reshape(points.shape))
    assert_close(point_covariance.shot_covariance(near_m, AXIS, scanner), drawn)
    centred = point_covariance.shot_covariance(near_m, AXIS, replace(scanner, beam_origin_m=beam.CENTRE))
    assert np.abs(centred / drawn - 1).max() > 0.1


def test_registered_covariance_equals_the_scatter_of_points():
    """Rotated and shifted by random draws of a registration, and tilted: equations.md, 3.1."""
    rng = np.random.default_rng(4)
    root = rng.normal(size=(6, 6)) * np.array([[4e-5] * 3 + [0.02] * 3]).T
    tilt_rad = math.radians(0.006)
    shot_m2 = point_covariance.shot_covariance(OFFSET_M, np.array([0.0, 0.0, 1.0]), SCANNER)
    draws = rng.standard_normal((DRAWS, 6)) @ root.T
    tilt = tilt_rad * rng.standard_normal((DRAWS, 2)) @ np.eye(2, 3)
    drawn = np.stack(
        [
            Rotation.from_rotvec(draws[:, :3] + tilt).apply(offset_m)
            + draws[:, 3:]
            + rng.multivariate_normal(np.zeros(3), covariance_m2, DRAWS, method="eigh")
            for offset_m, covariance_m2 in zip(OFFSET_M, shot_m2, strict=True)
        ],
        axis=1,
    )
    actual = point_covariance.registered_covariance(shot_m2, OFFSET_M, root @ root.T, tilt_rad)
    assert_close(actual, sample_covariance(drawn))


def test_shared_covariance_equals_that_of_the_registration():
    """Six slopes of equations.md, 6.1, against the Jacobian of the pose."""
    params = parameters.parameter_layout(Grid(100.0, 1200.0, 10.0, 50, 80), (0.0, 0.0, 0.0))
    root = np.random.default_rng(5).normal(size=(6, 6)) * np.array([[4e-5] * 3 + [0.02] * 3]).T
    actual = point_covariance.shared_covariance(
        params, OFFSET_M, propagation.to_shared_parameters(params, root @ root.T)
    )
    expected = point_covariance.registered_covariance(np.zeros((2, 3, 3)), OFFSET_M, root @ root.T, 0.0)
    assert actual == pytest.approx(expected, rel=1e-9, abs=1e-12)


def test_range_bias_moves_points_along_the_beam():
    params = parameters.parameter_layout(Grid(100.0, 1200.0, 10.0, 50, 80), (0.0, 0.0, 0.0))
    posterior = propagation.to_shared_parameters(params, np.zeros((6, 6)))
    posterior.covariance[6, 6] = 0.01**2
    actual = point_covariance.shared_covariance(params, OFFSET_M, posterior)
    beams = OFFSET_M / np.linalg.norm(OFFSET_M, axis=1, keepdims=True)
    assert actual == pytest.approx(1e-4 * np.einsum("ni,nj->nij", beams, beams), abs=1e-12)
    axes, direction = beam.error_ellipsoid(actual)
    assert axes[:, 2] == pytest.approx(0.01)
    assert np.abs(np.sum(direction[:, :, 2] * beams, axis=1)) == pytest.approx(1.0)


def test_error_ellipse_axes_and_azimuth():
    """Major axis of 3 m towards 30°, minor axis of 1 m, both times the square root of 2.2977."""
    rotation = Rotation.from_euler("z", -30, degrees=True).as_matrix()
    covariance = rotation @ np.diag([1.0, 9.0, 4.0]) @ rotation.T
    major_m, minor_m, azimuth = beam.error_ellipse(covariance[None])
    assert (major_m[0], minor_m[0]) == pytest.approx((3 * 1.51581, 1.51581), rel=1e-4)
    assert math.degrees(azimuth[0]) == pytest.approx(30.0)
