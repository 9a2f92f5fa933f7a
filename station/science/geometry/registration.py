"""Registration: SOP with covariance from points and planes known in the scan and outside."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from station.errors import ConfigError
from station.quantities import Floats, Ints

POSE = ("turn_east", "turn_north", "turn_up", "shift_east", "shift_north", "shift_up")
MAX_ITERATIONS = 100
MIN_REDUNDANCY = 1e-9  # redundancy of an uncontrolled observation
CONVERGED_M = 1e-7  # displacement of the features by the last step
SINGULAR = 1e-8  # eigenvalue ratio: the weakest motion is 10,000 times less certain than the strongest


@dataclass(frozen=True)
class Features:
    """Points and planes for a registration: coordinates in the scan and outside.

    A row is a point in the scan and its reference point; or, with a non-zero `normal`, a point in the scan
    that lies on the plane through `reference_m` with that normal. `sigma_m` is of a coordinate, or across the
    plane; `scan_covariance_m2` is the covariance that the scan's points add to it, if known.
    """

    names: tuple[str, ...]
    scan_m: Floats  # (n, 3) scanner's frame
    reference_m: Floats  # (n, 3)
    normal: Floats  # (n, 3) unit length, or zero for a point
    sigma_m: Floats  # (n,)
    scan_covariance_m2: Floats | None = None  # (n, 3, 3) scanner's frame

    @property
    def is_plane(self) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        """True for rows (n,) that constrain a point to a plane."""
        return np.asarray(np.any(self.normal != 0, axis=1))


@dataclass(frozen=True)
class Registration:
    """An SOP with its covariance and the residuals of the features.

    `covariance` (6, 6) is of `POSE`: small rotations about east, north and up at the scanner [rad,
    counter-clockwise], and shifts [m]. It is scaled by `reference_variance`, which is 1 if the features fit
    as well as their sigmas predict. `residual_m` (n,) is the distance of each feature from its reference,
    `standardised_residual` (n,) the largest of its standardised residuals: above 3.3 the feature is suspect.
    """

    sop: Floats  # (4, 4)
    covariance: Floats
    reference_variance: float
    observations: int
    residual_m: Floats
    standardised_residual: Floats


def solve(features: Features, start: Floats | None = None) -> Registration:
    """Return the least-squares registration, from an initial SOP (4, 4) or, without one, from three points.

    Weights are the inverse of the features' covariance. The reference variance scales the inverse normal
    matrix, so that a second pass with sigmas scaled by its root gives 1. The features' errors are taken as
    independent. Raises ConfigError if the features do not determine the pose, or leave no redundancy.
    Source: Hartzell et al. (2015), section 2.2; equations.md, 2.11.
    """
    count = np.where(features.is_plane, 1, 3).sum()
    if count <= len(POSE):
        raise ConfigError(
            f"{count} observations for {len(POSE)} unknowns leave no redundancy to estimate uncertainty:"
            " a point gives three, a point on a plane one; add features"
        )
    sop = _from_points(features) if start is None else start.copy()
    for _ in range(MAX_ITERATIONS):
        _, design, misclosure = _observe(features, sop)
        arm_m = _lever_arms(features)
        inverse = _inverse(design, arm_m)
        step = inverse @ (design.T @ misclosure)
        sop[:3, :3] = Rotation.from_rotvec(step[:3]).as_matrix() @ sop[:3, :3]
        sop[:3, 3] += step[3:]
        if np.all(np.abs(step) * arm_m < CONVERGED_M):
            break
    else:
        raise ConfigError("the registration does not converge: start from a closer SOP")
    row, design, misclosure = _observe(features, sop)
    variance = reference_variance(misclosure, len(POSE))
    redundancy = 1 - np.einsum("ij,jk,ik->i", design, inverse, design)  # of each observation, 0-1
    sigma = np.sqrt(variance * np.maximum(redundancy, MIN_REDUNDANCY))
    standardised = np.where(redundancy > MIN_REDUNDANCY, np.abs(misclosure) / sigma, 0.0)
    largest = np.zeros(len(features.names))
    np.maximum.at(largest, row, standardised)
    misclosure_m = _misclosure(features, sop)
    across_m = np.abs(np.einsum("ni,ni->n", features.normal, misclosure_m))
    residual_m = np.where(features.is_plane, across_m, np.linalg.norm(misclosure_m, axis=1))
    return Registration(sop, variance * inverse, variance, len(row), residual_m, largest)


def _misclosure(features: Features, sop: Floats) -> Floats:
    """Return the misclosure (n, 3) [m]: references minus transformed points of the scan."""
    return np.asarray(features.reference_m - sop[:3, 3] - features.scan_m @ sop[:3, :3].T)


def _observe(features: Features, sop: Floats) -> tuple[Ints, Floats, Floats]:
    """Return the feature of each observation (m,), its Jacobian (m, 6) and its misclosure (m,).

    The last two are in sigmas; the three observations of a point are decorrelated.
    """
    jacobian = pose_jacobian(features.scan_m @ sop[:3, :3].T)
    misclosure_m = _misclosure(features, sop)
    covariance_m2 = features.sigma_m[:, None, None] ** 2 * np.eye(3)
    if features.scan_covariance_m2 is not None:
        covariance_m2 = covariance_m2 + sop[:3, :3] @ features.scan_covariance_m2 @ sop[:3, :3].T
    point, plane = np.flatnonzero(~features.is_plane), np.flatnonzero(features.is_plane)
    whitening = np.linalg.inv(np.linalg.cholesky(covariance_m2[point]))
    normal = features.normal[plane]
    normal /= np.sqrt(np.einsum("ni,nij,nj->n", normal, covariance_m2[plane], normal))[:, None]
    return (
        np.concatenate([np.repeat(point, 3), plane]),
        np.concatenate(
            [(whitening @ jacobian[point]).reshape(-1, 6), np.einsum("ni,nij->nj", normal, jacobian[plane])]
        ),
        np.concatenate(
            [
                np.einsum("nij,nj->ni", whitening, misclosure_m[point]).ravel(),
                np.sum(normal * misclosure_m[plane], axis=1),
            ]
        ),
    )


def _lever_arms(features: Features) -> Floats:
    """Return the displacement of the features by one unit of each unknown (6,) [m]."""
    distance_m = float(np.sqrt(np.mean(np.sum(features.scan_m**2, axis=1))))
    return np.array([distance_m] * 3 + [1.0] * 3)


def _inverse(weighted: Floats, arm_m: Floats) -> Floats:
    """Return the inverse normal matrix (6, 6) of weighted observations (m, 6); ConfigError if singular."""
    scaled = weighted / arm_m
    eigenvalues, motions = np.linalg.eigh(scaled.T @ scaled)
    if eigenvalues[0] < SINGULAR * eigenvalues[-1]:
        weakest = motions[:, 0]
        names = [name for name, share in zip(POSE, np.abs(weakest), strict=True) if share > 0.3]
        raise ConfigError(
            f"the features do not determine {' and '.join(names)}: points on one line leave the rotation"
            " about it open, parallel planes the shifts along them; add features elsewhere or at other angles"
        )
    return np.asarray((motions / eigenvalues) @ motions.T / np.outer(arm_m, arm_m))


def _from_points(features: Features) -> Floats:
    """Return the SOP (4, 4) that fits the points alone."""
    points = ~features.is_plane
    weight = 1 / features.sigma_m[points] ** 2
    if len(weight) < 3:
        raise ConfigError(
            f"{len(weight)} points: without three that are not on one line, an initial SOP is needed"
        )
    reference_m, scan_m = (
        coordinates[points] - np.average(coordinates[points], axis=0, weights=weight)
        for coordinates in (features.reference_m, features.scan_m)
    )
    spread = np.linalg.svd(scan_m, compute_uv=False)
    if spread[1] < np.sqrt(SINGULAR) * spread[0]:
        raise ConfigError(
            "all points lie on one line, which leaves the rotation about it open: add one off the line"
        )
    rotation = Rotation.align_vectors(reference_m, scan_m, weights=weight)[0].as_matrix()
    sop = np.eye(4)
    sop[:3, :3] = rotation
    sop[:3, 3] = np.average(
        features.reference_m[points] - features.scan_m[points] @ rotation.T, axis=0, weights=weight
    )
    return sop


def reference_variance(weighted: Floats, unknowns: int) -> float:
    """Variance of weighted residuals (m,) per degree of freedom [1].

    Source: Hartzell et al. (2015), section 2.2: s0² = vᵀ W v / (n - u).
    """
    return float(weighted @ weighted / (len(weighted) - unknowns))


def pose_jacobian(offset_m: Floats) -> Floats:
    """Jacobian (n, 3, 6) of points with respect to `POSE`; `offset_m` (n, 3) from the scanner, in map axes.

    It is that of the paper's rotation by omega, phi, kappa at zero angles, and of its translation.
    Source: Hartzell et al. (2015), Eq. 2, differentiated.
    """
    x_m, y_m, z_m = offset_m.T
    zero = np.zeros_like(x_m)
    rotations = np.stack([zero, z_m, -y_m, -z_m, zero, x_m, y_m, -x_m, zero], axis=-1).reshape(-1, 3, 3)
    return np.concatenate([rotations, np.broadcast_to(np.eye(3), rotations.shape)], axis=-1)
