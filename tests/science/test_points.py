"""The covariance of single points against simulated errors."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from station.quantities import Grid, Scanner
from station.science import beam, points, registration, shared
from station.science.uncertainty import sigma_angle

SCANNER = Scanner("sim", 1.55, 0.3e-3, 0.0, 0.02, math.radians(0.002), 0.0, 0.0, 6000.0)
OFFSET_M = np.array([[400.0, 900.0, -200.0], [150.0, 520.0, 340.0]])
AXIS = Rotation.from_rotvec([0.3, -0.5, 0.1]).apply([0.0, 0.0, 1.0])  # leans by more than 30°
DRAWS = 40_000


def scatter(drawn):
    return np.array([np.cov(drawn[:, i].T) for i in range(drawn.shape[1])])


def close(told, wanted):
    """Within what so many draws tell of each element."""
    size = np.sqrt(np.einsum("nii,njj->nij", wanted, wanted))
    assert np.abs(told - wanted).max() > 0
    assert np.all(np.abs(told - wanted) < 0.03 * size)


def test_a_shot_about_a_leaning_axis():
    """The noise of range and of the two angles about the head's axis, drawn."""
    rng = np.random.default_rng(3)
    to_head = Rotation.align_vectors([[0, 0, 1.0]], [AXIS])[0]
    range_m, elevation, azimuth = beam.polar(to_head.apply(OFFSET_M))
    draws = rng.standard_normal((3, DRAWS, 2))
    moved = beam.cartesian(
        range_m + 0.02 * draws[0],
        elevation + sigma_angle(SCANNER) * draws[1],
        azimuth + sigma_angle(SCANNER) * draws[2],
    )
    drawn = to_head.inv().apply(moved.reshape(-1, 3)).reshape(moved.shape)
    close(points.shot_covariance(OFFSET_M, AXIS, SCANNER), scatter(drawn))


def test_a_near_shot_whose_beam_begins_beside_the_centre():
    """Turned by its angles about the head's axis, a point beside the beam's origin scatters otherwise."""
    scanner = replace(SCANNER, beam_origin_m=(0.1, 0.3, 0.2), range_sigma_m=1e-3, angle_resolution_rad=0.02)
    near_m = OFFSET_M / 500
    rng = np.random.default_rng(7)
    to_head = Rotation.align_vectors([[0, 0, 1.0]], [AXIS])[0]
    range_m, elevation, azimuth = beam.polar(to_head.apply(near_m), scanner.beam_origin_m)
    draws = rng.standard_normal((3, DRAWS, 2))
    moved = beam.cartesian(
        range_m + 1e-3 * draws[0],
        elevation + sigma_angle(scanner) * draws[1],
        azimuth + sigma_angle(scanner) * draws[2],
        scanner.beam_origin_m,
    )
    drawn = scatter(to_head.inv().apply(moved.reshape(-1, 3)).reshape(moved.shape))
    close(points.shot_covariance(near_m, AXIS, scanner), drawn)
    plain = points.shot_covariance(near_m, AXIS, replace(scanner, beam_origin_m=beam.CENTRE))
    assert np.abs(plain / drawn - 1).max() > 0.1


def test_a_registered_point():
    """Turned and shifted by draws of a registration, and leant: EQUATIONS 3.1."""
    rng = np.random.default_rng(4)
    root = rng.normal(size=(6, 6)) * np.array([[4e-5] * 3 + [0.02] * 3]).T
    tilt_rad = math.radians(0.006)
    own_m2 = points.shot_covariance(OFFSET_M, np.array([0.0, 0.0, 1.0]), SCANNER)
    draws = rng.standard_normal((DRAWS, 6)) @ root.T
    lean = tilt_rad * rng.standard_normal((DRAWS, 2)) @ np.eye(2, 3)
    drawn = np.stack(
        [
            Rotation.from_rotvec(draws[:, :3] + lean).apply(one)
            + draws[:, 3:]
            + rng.multivariate_normal(np.zeros(3), of_shot, DRAWS, method="eigh")
            for one, of_shot in zip(OFFSET_M, own_m2, strict=True)
        ],
        axis=1,
    )
    told = points.registered_covariance(own_m2, OFFSET_M, root @ root.T, tilt_rad)
    close(told, scatter(drawn))


def test_what_points_share_is_that_of_their_registration():
    """Two homes of one effect: six slopes of EQUATIONS 6.1, and the Jacobian of the pose."""
    basis = shared.basis(Grid(100.0, 1200.0, 10.0, 50, 80), (0.0, 0.0, 0.0))
    root = np.random.default_rng(5).normal(size=(6, 6)) * np.array([[4e-5] * 3 + [0.02] * 3]).T
    told = points.shared_covariance(basis, OFFSET_M, registration.shared_by(basis, root @ root.T))
    wanted = points.registered_covariance(np.zeros((2, 3, 3)), OFFSET_M, root @ root.T, 0.0)
    assert told == pytest.approx(wanted, rel=1e-9, abs=1e-12)


def test_range_bias_moves_a_point_along_its_beam():
    basis = shared.basis(Grid(100.0, 1200.0, 10.0, 50, 80), (0.0, 0.0, 0.0))
    unknown = registration.shared_by(basis, np.zeros((6, 6)))
    unknown.covariance[6, 6] = 0.01**2
    told = points.shared_covariance(basis, OFFSET_M, unknown)
    beams = OFFSET_M / np.linalg.norm(OFFSET_M, axis=1, keepdims=True)
    assert told == pytest.approx(1e-4 * np.einsum("ni,nj->nij", beams, beams), abs=1e-12)
    axes, direction = beam.error_ellipsoid(told)
    assert axes[:, 2] == pytest.approx(0.01)
    assert np.abs(np.sum(direction[:, :, 2] * beams, axis=1)) == pytest.approx(1.0)


def test_ellipse_lies_as_drawn():
    """Longer axis of 3 m towards 30°, shorter of 1 m, both times the root of 2.2977."""
    turn = Rotation.from_euler("z", -30, degrees=True).as_matrix()
    covariance = turn @ np.diag([1.0, 9.0, 4.0]) @ turn.T
    major_m, minor_m, azimuth = beam.error_ellipse(covariance[None])
    assert (major_m[0], minor_m[0]) == pytest.approx((3 * 1.51581, 1.51581), rel=1e-4)
    assert math.degrees(azimuth[0]) == pytest.approx(30.0)
