"""Registration from points and planes: against a known pose and its scatter, and rejected input."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from station.errors import ConfigError
from station.quantities import Grid
from station.science.geometry import pose, registration
from station.science.geometry.registration import Features, reference_variance, solve
from station.science.uncertainty import jacobian, parameters, propagation

TRUE = np.eye(4)
TRUE[:3, :3] = Rotation.from_euler("xyz", [2.1, -33.0, 105.0], degrees=True).as_matrix()
TRUE[:3, 3] = (635_000.0, 5_185_000.0, 3_000.0)


def scene(seed, points=6, planes=30, sigma_m=0.02, scale=1.0, sop=TRUE):
    """Return points and planes 50 to 500 m from a scanner, `scale` times as noisy as their sigma."""
    rng = np.random.default_rng(seed)
    count = points + planes
    positions = np.random.default_rng(1)
    azimuth, height = positions.uniform(0, 2 * np.pi, count), positions.uniform(-80, 120, count)
    distance = positions.uniform(50, 500, count)
    offset = np.stack([distance * np.cos(azimuth), distance * np.sin(azimuth), height], axis=-1)
    reference = offset + sop[:3, 3]
    normal = positions.normal(size=(count, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    normal[:points] = 0.0
    scan = (offset + scale * sigma_m * rng.normal(size=(count, 3))) @ sop[:3, :3]
    within = np.cross(normal, positions.normal(size=(count, 3)))  # anywhere on the plane
    return Features(
        tuple(f"f{i}" for i in range(count)), scan, reference + 3 * within, normal, np.full(count, sigma_m)
    )


def errors(registered, sop=TRUE):
    """Return the six unknowns by which a registration differs from the truth."""
    rotation = Rotation.from_matrix(registered.sop[:3, :3] @ sop[:3, :3].T).as_rotvec()
    return np.concatenate([rotation, registered.sop[:3, 3] - sop[:3, 3]])


@pytest.mark.parametrize("start", [None, "near", "far"])
def test_pose_is_recovered_from_any_start(start):
    if start is not None:
        scale = 1 if start == "near" else 3
        rotation = Rotation.from_rotvec(scale * np.array([0.2, -0.3, 0.5])).as_matrix()
        start = TRUE.copy()
        start[:3, :3] = rotation @ start[:3, :3]
        start[:3, 3] += 20
    registered = solve(scene(3, scale=1e-6), start)
    assert errors(registered) == pytest.approx(np.zeros(6), abs=1e-6)


def test_planes_alone_need_an_initial_sop():
    features = scene(3, points=0, planes=12, scale=1e-6)
    with pytest.raises(ConfigError, match=r"0 points: without three .* an initial SOP is needed"):
        solve(features)
    near = TRUE.copy()
    near[:3, :3] = Rotation.from_rotvec([0.02, -0.01, 0.03]).as_matrix() @ near[:3, :3]
    assert errors(solve(features, near)) == pytest.approx(np.zeros(6), abs=1e-6)


def test_registration_equals_scipy_least_squares():
    """The same weighted residuals, minimised by scipy with the paper's omega, phi, kappa."""
    features = scene(4, scale=1.7)
    registered = solve(features)
    centre = features.reference_m.mean(axis=0)

    def residuals(unknowns):
        on_map = features.scan_m @ pose.rotation(*unknowns[:3]).T + unknowns[3:] + centre
        misclosure = (features.reference_m - on_map) / features.sigma_m[:, None]
        plane = features.is_plane
        return np.concatenate(
            [misclosure[~plane].ravel(), np.sum(misclosure * features.normal, axis=1)[plane]]
        )

    start = np.concatenate([np.radians([2.0, -33.1, 105.2]), TRUE[:3, 3] - centre + 0.3])
    expected = least_squares(
        residuals, start, x_scale=[1e-3] * 3 + [1] * 3, xtol=1e-15, ftol=1e-15, gtol=1e-12
    )
    assert registered.sop[:3, :3] == pytest.approx(pose.rotation(*expected.x[:3]), abs=1e-8)
    assert registered.sop[:3, 3] == pytest.approx(expected.x[3:] + centre, abs=1e-6)
    assert registered.reference_variance == pytest.approx(
        2 * expected.cost / (len(expected.fun) - 6), rel=1e-6
    )
    shifts = registered.reference_variance * np.linalg.inv(expected.jac.T @ expected.jac)[3:, 3:]
    assert registered.covariance[3:, 3:] == pytest.approx(shifts, rel=1e-3, abs=1e-7)


@pytest.mark.integration
def test_covariance_equals_the_scatter_of_registrations():
    """Covariance and share within its 95 % ellipsoid (χ² of six: 12.59), from 400 registrations."""
    registrations = [solve(scene(seed, scale=2.0), TRUE) for seed in range(400)]
    scatter = np.array([errors(registered) for registered in registrations])
    stated = np.mean([registered.covariance for registered in registrations], axis=0)
    sigma = np.sqrt(np.diag(stated))
    assert np.std(scatter, axis=0) / sigma == pytest.approx(np.ones(6), abs=0.1)
    assert np.corrcoef(scatter.T) == pytest.approx(stated / np.outer(sigma, sigma), abs=0.15)
    assert np.mean([registered.reference_variance for registered in registrations]) == pytest.approx(
        4.0, rel=0.03
    )
    mahalanobis = [e @ np.linalg.solve(stated, e) for e in scatter]
    assert np.mean(np.array(mahalanobis) < 12.592) == pytest.approx(0.95, abs=0.035)


def test_reference_variance_scales_the_covariance():
    """Hartzell: s0² of about 3 scales C threefold; with sigmas scaled by its root a second pass gives 1."""
    assert reference_variance(np.array([3.0, -3.0, 1.0, 1.0]), 2) == pytest.approx(10.0)
    features = scene(8, scale=math.sqrt(3))
    first = solve(features)
    scaled = Features(
        features.names,
        features.scan_m,
        features.reference_m,
        features.normal,
        features.sigma_m * math.sqrt(first.reference_variance),
    )
    second = solve(scaled)
    assert 2 < first.reference_variance < 4
    assert second.reference_variance == pytest.approx(1.0)
    assert second.covariance == pytest.approx(first.covariance, rel=1e-6)
    third = Features(*(getattr(features, name) for name in ("names", "scan_m", "reference_m", "normal")), 0.01
                     * features.sigma_m)  # fmt: skip
    assert solve(third).covariance == pytest.approx(first.covariance, rel=1e-6)  # only ratios count


def test_blunder_has_the_largest_standardised_residual():
    features = scene(5)
    features.scan_m[20] += features.normal[20] @ TRUE[:3, :3] * 0.4
    registered = solve(features)
    assert registered.standardised_residual.argmax() == 20
    assert registered.standardised_residual[20] > 3.3
    assert registered.residual_m[20] == pytest.approx(0.4, abs=0.1)
    planes = np.concatenate([solve(scene(seed)).standardised_residual[6:] for seed in range(40)])
    assert np.sqrt(np.mean(planes**2)) == pytest.approx(1.0, abs=0.05)


@pytest.mark.integration
def test_anisotropic_scan_covariance_weights_the_features():
    """Targets noisy across the beam: with their full covariance the scatter shrinks to the stated sigma."""
    clean = scene(0, points=12, planes=24, scale=0.0)
    basis = np.random.default_rng(9).normal(size=(36, 3, 3))
    square_root = np.linalg.qr(basis)[0] * np.array([0.002, 0.02, 0.10])
    weighted, unweighted, stated = [], [], []
    for seed in range(200):
        noise = np.einsum("nij,nj->ni", square_root, np.random.default_rng(seed).normal(size=(36, 3)))
        noisy = replace(clean, scan_m=clean.scan_m + noise, sigma_m=np.full(36, 1e-3))
        unweighted.append(errors(solve(noisy, TRUE)))
        registered = solve(
            replace(noisy, scan_covariance_m2=square_root @ np.swapaxes(square_root, 1, 2)), TRUE
        )
        weighted.append(errors(registered))
        stated.append(np.sqrt(np.diag(registered.covariance)))
    assert np.std(weighted, axis=0) / np.mean(stated, axis=0) == pytest.approx(np.ones(6), abs=0.15)
    assert (np.std(unweighted, axis=0) > 1.5 * np.std(weighted, axis=0)).all()


def test_pose_jacobian_equals_finite_differences():
    offset = np.array([[300.0, -200.0, 50.0], [10.0, 400.0, -90.0]])
    actual = registration.pose_jacobian(offset)
    for column in range(6):
        step = 1e-6 * np.eye(6)[column]
        moved = offset @ pose.rotation(*step[:3]).T + step[3:]
        assert actual[:, :, column] == pytest.approx((moved - offset) / 1e-6, abs=1e-3)


def test_height_variance_of_a_registration_equals_that_of_its_points():
    """Variance by the station's parameters (equations.md, 6.1) and by the Jacobian of the points."""
    grid = Grid(100.0, 900.0, 10.0, 40, 40)
    params = parameters.parameter_layout(grid, (0.0, 0.0, 0.0))
    root = np.random.default_rng(0).normal(size=(6, 6)) * np.array([[1e-4] * 3 + [0.02] * 3]).T
    offset = np.array([[300.0, 600.0, -50.0], [150.0, 520.0, 40.0], [480.0, 880.0, 5.0]])
    east, north = np.array([0.2, -0.4, 0.0]), np.array([0.1, 0.3, -0.6])
    height_jacobian = jacobian.height_jacobian(params, tuple(offset.T), east, north)
    vertical = np.stack([-east, -north, np.ones(3)], axis=-1)
    expected_effect = np.einsum("ni,nij->nj", vertical, registration.pose_jacobian(offset)) @ root
    actual = height_jacobian.variance(propagation.to_shared_parameters(params, root @ root.T))
    assert actual == pytest.approx(np.sum(expected_effect**2, axis=1))


def points_only(scan):
    scan = np.asarray(scan, dtype=float)
    count = len(scan)
    return Features(
        tuple("abcdefgh"[:count]),
        scan,
        scan @ TRUE[:3, :3].T + TRUE[:3, 3],
        np.zeros((count, 3)),
        np.full(count, 0.01),
    )


def test_features_that_do_not_determine_the_pose_are_rejected():
    line = np.outer(np.linspace(20, 300, 5), [0.6, 0.8, 0.1])
    with pytest.raises(ConfigError, match="all points lie on one line"):
        solve(points_only(line))
    with pytest.raises(ConfigError, match="do not determine"):
        solve(points_only(line + np.array([3.0, 0, 0])), TRUE)
    with pytest.raises(ConfigError, match="6 observations for 6 unknowns"):
        solve(points_only([[10, 20, 30], [40, -10, 2]]), TRUE)
    with pytest.raises(ConfigError, match="2 points"):
        solve(Features(*[np.concatenate([np.asarray(getattr(points_only([[9, 2, 3], [4, 9, 2]]), name)),
                                         np.asarray(getattr(scene(1, 0, 8), name))])
                         for name in ("names", "scan_m", "reference_m", "normal", "sigma_m")]))  # fmt: skip
    level = scene(1, points=0, planes=20)
    level.normal[:] = [0.0, 0.0, 1.0]
    with pytest.raises(ConfigError, match=r"do not determine (shift|turn_up).*parallel planes"):
        solve(level, TRUE)
