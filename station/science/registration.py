"""Where a scanner stands, from points and planes known in its frame and outside: an SOP with covariance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from station.errors import ConfigError
from station.quantities import Floats, Ints, Shared
from station.science.shared import GLOBAL, Basis

UNKNOWN = ("turn_east", "turn_north", "turn_up", "shift_east", "shift_north", "shift_up")
ROUNDS = 100
UNSEEN = 1e-9  # redundancy of an observation that nothing checks
STILL_M = 1e-7  # what a step moves the features when the estimate stands
SINGULAR = 1e-8  # of the normal matrix: the weakest motion is held 10,000 times less than the strongest


@dataclass(frozen=True)
class Features:
    """Points and planes: where the scan has them, where they are.

    A row is a point in the scan and the point it is; or, with a `normal` (not nought), a point in the scan
    that lies on the plane through `reference_m` across that normal. `sigma_m` is of a coordinate, or across
    the plane; `scan_covariance_m2` what the scan's points add to that, where it is known of each.
    """

    names: tuple[str, ...]
    scan_m: Floats  # (n, 3) scanner's frame
    reference_m: Floats  # (n, 3)
    normal: Floats  # (n, 3) unit length, or nought for a point
    sigma_m: Floats  # (n,)
    scan_covariance_m2: Floats | None = None  # (n, 3, 3) scanner's frame

    @property
    def is_plane(self) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        """Tell which rows (n,) only say that a point lies on a plane."""
        return np.asarray(np.any(self.normal != 0, axis=1))


@dataclass(frozen=True)
class Registration:
    """An SOP, and how sure it is.

    `covariance` (6, 6) is of `UNKNOWN`: small turns about east, north and up at the scanner [rad,
    counter-clockwise], and shifts [m]. It is scaled by `reference_variance`, which is 1 where the features
    fit as well as their sigmas say. `left_m` (n,) is how far each feature stays from its place,
    `standardised` (n,) the largest of its residuals over their own sigma: beyond 3.3 it is suspect.
    """

    sop: Floats  # (4, 4)
    covariance: Floats
    reference_variance: float
    observations: int
    left_m: Floats
    standardised: Floats


def solve(features: Features, start: Floats | None = None) -> Registration:
    """Register by least squares, from an SOP (4, 4) to start with, or from three points or more without.

    Weights are the inverse of the features' covariance. The reference variance scales the inverse normal
    matrix, so that a second pass with sigmas scaled by its root gives 1. It takes the features' errors as
    independent. Raises ConfigError where the features do not
    say where the scanner stands, or nothing is left to tell how well.
    Source: Hartzell et al. (2015), section 2.2; EQUATIONS 2.11.
    """
    count = np.where(features.is_plane, 1, 3).sum()
    if count <= len(UNKNOWN):
        raise ConfigError(
            f"{count} observations for {len(UNKNOWN)} unknowns leave nothing to tell how sure the SOP is:"
            " a point gives three, a point on a plane one; add some"
        )
    sop = _from_points(features) if start is None else start.copy()
    for _ in range(ROUNDS):
        _, design, misfit = _observe(features, sop)
        arm_m = _arms(features)
        inverse = _inverse(design, arm_m)
        step = inverse @ (design.T @ misfit)
        sop[:3, :3] = Rotation.from_rotvec(step[:3]).as_matrix() @ sop[:3, :3]
        sop[:3, 3] += step[3:]
        if np.all(np.abs(step) * arm_m < STILL_M):
            break
    else:
        raise ConfigError("the registration does not settle: start from an SOP that is nearer")
    row, design, misfit = _observe(features, sop)
    variance = reference_variance(misfit, len(UNKNOWN))
    free = 1 - np.einsum("ij,jk,ik->i", design, inverse, design)  # redundancy: what a blunder leaves to see
    told = np.where(free > UNSEEN, np.abs(misfit) / np.sqrt(variance * np.maximum(free, UNSEEN)), 0.0)
    standardised = np.zeros(len(features.names))
    np.maximum.at(standardised, row, told)
    apart_m = _apart(features, sop)
    across_m = np.abs(np.einsum("ni,ni->n", features.normal, apart_m))
    left_m = np.where(features.is_plane, across_m, np.linalg.norm(apart_m, axis=1))
    return Registration(sop, variance * inverse, variance, len(row), left_m, standardised)


def _apart(features: Features, sop: Floats) -> Floats:
    """What lacks from the scan's points to their references (n, 3) [m]."""
    return np.asarray(features.reference_m - sop[:3, 3] - features.scan_m @ sop[:3, :3].T)


def _observe(features: Features, sop: Floats) -> tuple[Ints, Floats, Floats]:
    """Which feature each observation is of (m,), its derivative by the unknowns (m, 6), its misfit (m,).

    Both in sigmas, the three of a point freed of their correlation.
    """
    jacobian = pose_jacobian(features.scan_m @ sop[:3, :3].T)
    apart_m = _apart(features, sop)
    covariance_m2 = features.sigma_m[:, None, None] ** 2 * np.eye(3)
    if features.scan_covariance_m2 is not None:
        covariance_m2 = covariance_m2 + sop[:3, :3] @ features.scan_covariance_m2 @ sop[:3, :3].T
    point, plane = np.flatnonzero(~features.is_plane), np.flatnonzero(features.is_plane)
    freed = np.linalg.inv(np.linalg.cholesky(covariance_m2[point]))
    across = features.normal[plane]
    across /= np.sqrt(np.einsum("ni,nij,nj->n", across, covariance_m2[plane], across))[:, None]
    return (
        np.concatenate([np.repeat(point, 3), plane]),
        np.concatenate(
            [(freed @ jacobian[point]).reshape(-1, 6), np.einsum("ni,nij->nj", across, jacobian[plane])]
        ),
        np.concatenate(
            [np.einsum("nij,nj->ni", freed, apart_m[point]).ravel(), np.sum(across * apart_m[plane], axis=1)]
        ),
    )


def _arms(features: Features) -> Floats:
    """How far a unit of each unknown moves the features (6,) [m]."""
    distance_m = float(np.sqrt(np.mean(np.sum(features.scan_m**2, axis=1))))
    return np.array([distance_m] * 3 + [1.0] * 3)


def _inverse(weighted: Floats, arm_m: Floats) -> Floats:
    """Inverse normal matrix (6, 6) of weighted observations (m, 6); ConfigError where it has none."""
    scaled = weighted / arm_m
    held, motion = np.linalg.eigh(scaled.T @ scaled)
    if held[0] < SINGULAR * held[-1]:
        free = motion[:, 0]
        names = [name for name, share in zip(UNKNOWN, np.abs(free), strict=True) if share > 0.3]
        raise ConfigError(
            f"the features do not say {' with '.join(names)}: points on one line leave the turn about it"
            " open, planes that face one way the shifts across; add some elsewhere and facing elsewhere"
        )
    return np.asarray((motion / held) @ motion.T / np.outer(arm_m, arm_m))


def _from_points(features: Features) -> Floats:
    """Return the SOP (4, 4) that fits the points alone."""
    points = ~features.is_plane
    weight = 1 / features.sigma_m[points] ** 2
    if len(weight) < 3:
        raise ConfigError(
            f"{len(weight)} points: without three that are not on a line there must be an SOP to start from"
        )
    there, here = (
        each[points] - np.average(each[points], axis=0, weights=weight)
        for each in (features.reference_m, features.scan_m)
    )
    spread = np.linalg.svd(here, compute_uv=False)
    if spread[1] < np.sqrt(SINGULAR) * spread[0]:
        raise ConfigError(
            "all points lie on one line, which leaves the turn about it open: add one beside it"
        )
    turn = Rotation.align_vectors(there, here, weights=weight)[0].as_matrix()
    sop = np.eye(4)
    sop[:3, :3] = turn
    sop[:3, 3] = np.average(
        features.reference_m[points] - features.scan_m[points] @ turn.T, axis=0, weights=weight
    )
    return sop


def reference_variance(weighted: Floats, unknowns: int) -> float:
    """Variance of residuals over their sigmas (m,), by the observations in excess [1].

    Source: Hartzell et al. (2015), section 2.2: s0² = vᵀ W v / (n - u).
    """
    return float(weighted @ weighted / (len(weighted) - unknowns))


def pose_jacobian(offset_m: Floats) -> Floats:
    """Derivative (n, 3, 6) of points by `UNKNOWN`; `offset_m` (n, 3) is from the scanner, axes as outside.

    It is that of the paper's rotation by omega, phi, kappa where these are nought, and translation.
    Source: Hartzell et al. (2015), Eq. 2, differentiated.
    """
    x_m, y_m, z_m = offset_m.T
    zero = np.zeros_like(x_m)
    turn = np.stack([zero, z_m, -y_m, -z_m, zero, x_m, y_m, -x_m, zero], axis=-1).reshape(-1, 3, 3)
    return np.concatenate([turn, np.broadcast_to(np.eye(3), turn.shape)], axis=-1)


def shared_by(basis: Basis, covariance: Floats) -> Shared:
    """What all points of a scan share by its registration (6, 6), on the parameters of a station."""
    sign = np.array([1.0, 1.0, -1.0, 1.0, 1.0, 1.0])  # a heading counts clockwise
    whole = np.zeros((len(basis.names), len(basis.names)))
    whole[: len(sign), : len(sign)] = covariance * np.outer(sign, sign)
    none = np.zeros(len(basis.names))
    assert GLOBAL[2][0] == "heading"  # noqa: S101 - the order of the parameters
    return Shared(basis.names, basis.units, none, whole, none)
