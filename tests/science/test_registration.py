"""SOPs from points and planes: against a known pose, their scatter, and what is refused."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from station.errors import ConfigError
from station.quantities import Grid
from station.science import pose, registration, shared
from station.science.registration import Features, reference_variance, solve

TRUE = np.eye(4)
TRUE[:3, :3] = Rotation.from_euler("xyz", [2.1, -33.0, 105.0], degrees=True).as_matrix()
TRUE[:3, 3] = (635_000.0, 5_185_000.0, 3_000.0)


def scene(seed, points=6, planes=30, sigma_m=0.02, scale=1.0, sop=TRUE):
    """Points and planes round a scanner at 50 to 500 m, `scale` times as noisy as they say."""
    rng = np.random.default_rng(seed)
    count = points + planes
    layout = np.random.default_rng(1)
    azimuth, height = layout.uniform(0, 2 * np.pi, count), layout.uniform(-80, 120, count)
    distance = layout.uniform(50, 500, count)
    offset = np.stack([distance * np.cos(azimuth), distance * np.sin(azimuth), height], axis=-1)
    reference = offset + sop[:3, 3]
    normal = layout.normal(size=(count, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    normal[:points] = 0.0
    scan = (offset + scale * sigma_m * rng.normal(size=(count, 3))) @ sop[:3, :3]
    within = np.cross(normal, layout.normal(size=(count, 3)))  # anywhere on the plane
    return Features(
        tuple(f"f{i}" for i in range(count)), scan, reference + 3 * within, normal, np.full(count, sigma_m)
    )


def errors(found, sop=TRUE):
    """The six unknowns by which a solution differs from the truth."""
    turn = Rotation.from_matrix(found.sop[:3, :3] @ sop[:3, :3].T).as_rotvec()
    return np.concatenate([turn, found.sop[:3, 3] - sop[:3, 3]])


@pytest.mark.parametrize("start", [None, "near", "far"])
def test_the_pose_is_found(start):
    if start is not None:
        off = Rotation.from_rotvec(np.array([0.2, -0.3, 0.5]) * (1 if start == "near" else 3)).as_matrix()
        start = TRUE.copy()
        start[:3, :3] = off @ start[:3, :3]
        start[:3, 3] += 20
    found = solve(scene(3, scale=1e-6), start)
    assert errors(found) == pytest.approx(np.zeros(6), abs=1e-6)


def test_planes_alone_need_a_start():
    features = scene(3, points=0, planes=12, scale=1e-6)
    with pytest.raises(ConfigError, match=r"0 points: without three .* an SOP to start from"):
        solve(features)
    near = TRUE.copy()
    near[:3, :3] = Rotation.from_rotvec([0.02, -0.01, 0.03]).as_matrix() @ near[:3, :3]
    assert errors(solve(features, near)) == pytest.approx(np.zeros(6), abs=1e-6)


def test_against_another_solver():
    """The same weighted misfits, given to scipy as a black box with the paper's omega, phi, kappa."""
    features = scene(4, scale=1.7)
    found = solve(features)
    about = features.reference_m.mean(axis=0)

    def misfits(unknown):
        on_map = features.scan_m @ pose.rotation(*unknown[:3]).T + unknown[3:] + about
        apart = (features.reference_m - on_map) / features.sigma_m[:, None]
        plane = features.is_plane
        return np.concatenate([apart[~plane].ravel(), np.sum(apart * features.normal, axis=1)[plane]])

    begin = np.concatenate([np.radians([2.0, -33.1, 105.2]), TRUE[:3, 3] - about + 0.3])
    other = least_squares(misfits, begin, x_scale=[1e-3] * 3 + [1] * 3, xtol=1e-15, ftol=1e-15, gtol=1e-12)
    assert found.sop[:3, :3] == pytest.approx(pose.rotation(*other.x[:3]), abs=1e-8)
    assert found.sop[:3, 3] == pytest.approx(other.x[3:] + about, abs=1e-6)
    assert found.reference_variance == pytest.approx(2 * other.cost / (len(other.fun) - 6), rel=1e-6)
    shifts = found.reference_variance * np.linalg.inv(other.jac.T @ other.jac)[3:, 3:]
    assert found.covariance[3:, 3:] == pytest.approx(shifts, rel=1e-3, abs=1e-7)


def test_covariance_against_scatter():
    """Of 400 registrations: whole covariance, and the share within its ellipsoid (12.59: 95 % of six)."""
    found = [solve(scene(seed, scale=2.0), TRUE) for seed in range(400)]
    drawn = np.array([errors(one) for one in found])
    told = np.mean([one.covariance for one in found], axis=0)
    sigma = np.sqrt(np.diag(told))
    assert np.std(drawn, axis=0) / sigma == pytest.approx(np.ones(6), abs=0.1)
    assert np.corrcoef(drawn.T) == pytest.approx(told / np.outer(sigma, sigma), abs=0.15)
    assert np.mean([one.reference_variance for one in found]) == pytest.approx(4.0, rel=0.03)
    away = [e @ np.linalg.solve(told, e) for e in drawn]
    assert np.mean(np.array(away) < 12.592) == pytest.approx(0.95, abs=0.035)


def test_p15_reference_variance():
    """H: s0² of about 3 scales C threefold; with sigmas scaled by its root a second pass gives 1."""
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


def test_a_blunder_stands_out():
    features = scene(5)
    features.scan_m[20] += features.normal[20] @ TRUE[:3, :3] * 0.4
    found = solve(features)
    assert found.standardised.argmax() == 20
    assert found.standardised[20] > 3.3
    assert found.left_m[20] == pytest.approx(0.4, abs=0.1)
    planes = np.concatenate([solve(scene(seed)).standardised[6:] for seed in range(40)])
    assert np.sqrt(np.mean(planes**2)) == pytest.approx(1.0, abs=0.05)


def test_weights_are_those_of_the_scans_points():
    """Targets with a noise that is long across the beam: found better, and as sure as is said."""
    clean = scene(0, points=12, planes=24, scale=0.0)
    basis = np.random.default_rng(9).normal(size=(36, 3, 3))
    root = np.linalg.qr(basis)[0] * np.array([0.002, 0.02, 0.10])
    found, blind, told = [], [], []
    for seed in range(200):
        noise = np.einsum("nij,nj->ni", root, np.random.default_rng(seed).normal(size=(36, 3)))
        noisy = replace(clean, scan_m=clean.scan_m + noise, sigma_m=np.full(36, 1e-3))
        blind.append(errors(solve(noisy, TRUE)))
        one = solve(replace(noisy, scan_covariance_m2=root @ np.swapaxes(root, 1, 2)), TRUE)
        found.append(errors(one))
        told.append(np.sqrt(np.diag(one.covariance)))
    assert np.std(found, axis=0) / np.mean(told, axis=0) == pytest.approx(np.ones(6), abs=0.15)
    assert (np.std(blind, axis=0) > 1.5 * np.std(found, axis=0)).all()


def test_pose_jacobian_against_moved_points():
    offset = np.array([[300.0, -200.0, 50.0], [10.0, 400.0, -90.0]])
    told = registration.pose_jacobian(offset)
    for unknown in range(6):
        step = 1e-6 * np.eye(6)[unknown]
        moved = offset @ pose.rotation(*step[:3]).T + step[3:]
        assert told[:, :, unknown] == pytest.approx((moved - offset) / 1e-6, abs=1e-3)


def test_heights_feel_a_registration_as_its_points_do():
    """The way by the station's parameters (EQUATIONS 6.1) and by the points' Jacobian: one variance."""
    grid = Grid(100.0, 900.0, 10.0, 40, 40)
    basis = shared.basis(grid, (0.0, 0.0, 0.0))
    root = np.random.default_rng(0).normal(size=(6, 6)) * np.array([[1e-4] * 3 + [0.02] * 3]).T
    offset = np.array([[300.0, 600.0, -50.0], [150.0, 520.0, 40.0], [480.0, 880.0, 5.0]])
    east, north = np.array([0.2, -0.4, 0.0]), np.array([0.1, 0.3, -0.6])
    felt = shared.sensitivities(basis, tuple(offset.T), east, north)
    vertical = np.stack([-east, -north, np.ones(3)], axis=-1)
    effect = np.einsum("ni,nij->nj", vertical, registration.pose_jacobian(offset)) @ root
    told = felt.variance(registration.shared_by(basis, root @ root.T))
    assert told == pytest.approx(np.sum(effect**2, axis=1))


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


def test_what_does_not_say_where_the_scanner_stands():
    line = np.outer(np.linspace(20, 300, 5), [0.6, 0.8, 0.1])
    with pytest.raises(ConfigError, match="all points lie on one line"):
        solve(points_only(line))
    with pytest.raises(ConfigError, match="do not say"):
        solve(points_only(line + np.array([3.0, 0, 0])), TRUE)
    with pytest.raises(ConfigError, match="6 observations for 6 unknowns"):
        solve(points_only([[10, 20, 30], [40, -10, 2]]), TRUE)
    with pytest.raises(ConfigError, match="2 points"):
        solve(Features(*[np.concatenate([np.asarray(getattr(points_only([[9, 2, 3], [4, 9, 2]]), name)),
                                         np.asarray(getattr(scene(1, 0, 8), name))])
                         for name in ("names", "scan_m", "reference_m", "normal", "sigma_m")]))  # fmt: skip
    level = scene(1, points=0, planes=20)
    level.normal[:] = [0.0, 0.0, 1.0]
    with pytest.raises(ConfigError, match=r"do not say (shift|turn_up).*planes that face one way"):
        solve(level, TRUE)
