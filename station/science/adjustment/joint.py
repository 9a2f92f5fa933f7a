"""Joint least-squares adjustment of one scan: pose, tilt by line, refraction and range, with covariance.

Stable ground, the inclination log, the weather and the prior are observations of the same unknowns. So is
moving ground, as far as its change since the reference is smooth or a trend. How large that change is, is
integrated over: millimetres are likely on a calm day, decimetres after snowfall.
Source: equations.md, 6.3; adjustment.md, 5.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from station.quantities import Bools, Floats, Ints, Reals, SharedParameters
from station.science.adjustment.ground_change import (
    STABLE,
    THIN_SNOW,
    GroundChange,
    ThinSnow,
    ground_change,
)
from station.science.adjustment.ground_response import (
    ResponseDesign,
    StableResponse,
    beam_motion,
    response_design,
)
from station.science.adjustment.leverage import fit_leverage
from station.science.adjustment.normal_equations import (
    LineInclination,
    NormalEquations,
    Posterior,
    ReducedNormals,
    StatePrior,
)
from station.science.adjustment.patches import CHI2_MEDIAN, GroundClass, Patches
from station.science.adjustment.solution import Solution
from station.science.uncertainty.jacobian import HeightJacobian, sight_tilt_of
from station.science.uncertainty.parameters import GLOBAL, ParameterLayout
from station.science.uncertainty.propagation import expand_rows

MAX_ITERATIONS = 16  # most scans need five to seven
CONVERGED_M = 0.0003  # stop when an iteration changes the residuals by less (root mean square)
# Rejection starts once the residual variance is known; before that, moving ground would get whole scan lines
# rejected.
WARMUP_ITERATIONS = 2
MIN_WEIGHT = 0.1  # a patch of smaller weight counts as rejected
TUKEY = 4.685  # 95 % efficient for normal errors
EXCESS_BOUNDS_M = (0.002, 0.02)  # of the excess sigma of stable patches over the random errors of cells
MAX_MOVING_EXCESS_M = 1.0  # upper bound for moving patches
MAX_GROUP_SIZE = 40.0  # patches that share one error
HEADING_CLOCKWISE = np.array([1.0, 1.0, -1.0])  # against a rotation about up


@dataclass(frozen=True)
class Adjustment:
    """Adjusted scanner state relative to the SOP: globals, tilt by line group, refraction, cross tilt.

    `change_size_m` is the size of the change of moving ground, from its mean and one sigma about it.
    `stable_weights` (patches,) are the robust weights of the stable patches, 0 to 1. `leverage_m2` holds the
    leverage variances of moving and stable cells (see `leverage`). `mean_sigma_m` is the uncertainty of the
    mean height of moving ground that comes from the state. `shared` are the state and its covariance by
    knots. `redundancy` (p,) is the share of the prior variance of a parameter that the scan has removed: 0 if
    its value is the prior's, 1 if the observations alone determine it. `log` is the inclination log that was
    used, and `predicted_log_rad` (lines,) is what the adjustment predicts for it, without the errors of the
    sensor. `unapplied_rad` (3,) is the estimated rotation about east, north and up that the points lack, as a
    mean over the lines. `stable_response` is by how much stable ground rose otherwise than modelled.
    """

    params: ParameterLayout
    estimate: Floats  # (u,)
    posterior: Posterior
    change_size_m: float
    stable_weights: Floats
    leverage_m2: tuple[float, float]
    mean_sigma_m: float
    shared: SharedParameters
    redundancy: Floats
    log: LineInclination | None
    predicted_log_rad: Floats
    unapplied_rad: Floats
    stable_response: StableResponse | None = None

    def effect(self, jacobian: HeightJacobian) -> Reals:
        """Return the effect of the estimated state on heights (n,) [m], to be subtracted from them."""
        first, last = len(GLOBAL), len(GLOBAL) + self.params.line_groups
        knots = jacobian.refraction_interpolation()
        estimate = self.estimate.astype(jacobian.sight_tilt.dtype)
        refraction, cross_tilt_rad = np.split(estimate[last:], 2)
        return np.asarray(
            estimate[:first] @ jacobian.pose
            + estimate[first:last][jacobian.line] * jacobian.sight_tilt
            + knots.interpolate(refraction) * jacobian.refraction
            + knots.interpolate(cross_tilt_rad) * jacobian.cross_tilt
        )

    @property
    def rejected_share(self) -> float:
        """Share of the stable patches that were rejected; zero without stable patches."""
        return float(np.mean(self.stable_weights < MIN_WEIGHT)) if len(self.stable_weights) else 0.0

    @property
    def covariance(self) -> Floats:
        """Posterior covariance (u, u) of the estimate."""
        return self.posterior.line_covariance()

    @property
    def sigma(self) -> Floats:
        """Posterior sigma of each parameter by knots (p,)."""
        return np.asarray(np.sqrt(np.diag(self.shared.covariance)))


def tilt_effect(jacobian: HeightJacobian, applied_rad: Floats) -> Reals:
    """Return the effect on heights (n,) [m] of rotating lines about east, north and up (3, lines) [rad]."""
    east, north, up = applied_rad.astype(jacobian.sight_tilt.dtype).take(jacobian.line, axis=1)
    return np.asarray(jacobian.pose[0] * east + jacobian.pose[1] * north - jacobian.pose[2] * up)


def adjust_scan(
    patches: Patches,
    applied_rad: Floats,
    prior: StatePrior,
    log: LineInclination | None,
    thin_snow: ThinSnow = THIN_SNOW,
    reference: SharedParameters | None = None,
    wider: Callable[[Floats], tuple[StatePrior, LineInclination | None] | None] = lambda _: None,
) -> Adjustment:
    """Return the scanner's state estimated from patches, inclination log and prior.

    `applied_rad` (3, lines) is the tilt already applied to the points, as a rotation about east, north and
    up. `thin_snow` may lie on stable ground. Rough ground responds to a motion of the beams against those of
    the `reference` by a little more or less than modelled, which is estimated too.
    `wider(estimate)` returns prior and log for a second estimate if the state (p,) is not one that the prior
    expects, else None. Hold-out patches are not used. Source: adjustment.md, 5; equations.md, 6.8.
    """
    params = patches.jacobian.params
    patches = patches.take(patches.ground_class <= GroundClass.STABLE)
    moving = patches.ground_class == GroundClass.MOVING
    misclosure_m = patches.residual_m + tilt_effect(patches.jacobian, applied_rad)
    change = ground_change(patches, moving, thin_snow)
    estimation = _estimate(patches, change, misclosure_m, prior, log, reference)
    second = wider(estimation.solution.estimate[: len(params.names)])
    if second is not None:
        prior, log = second
        estimation = _estimate(patches, change, misclosure_m, prior, log, reference)
    equations, reduced = estimation.equations, estimation.reduced
    mixture = estimation.solution.mixture()
    posterior = Posterior(
        params,
        reduced.line_tilt,
        reduced.coupling,
        mixture.factor,
        mixture.change_bias,
        equations.mean_jtj(len(params.names)),
        change.polar_mean(patches, mixture.estimate[equations.size :] / mixture.size_m),
    )
    leverage_m2 = fit_leverage(patches, estimation.weight, equations, posterior)
    state, predicted_log_rad = _state_and_log(params, mixture.estimate, reduced, log)
    shared = posterior.to_shared_parameters(state)
    return Adjustment(
        params,
        state,
        posterior,
        float(np.hypot(mixture.size_m, estimation.mean_change_m)),
        estimation.robust_weight[~moving],
        leverage_m2,
        _mean_sigma(patches, moving, posterior),
        shared,
        np.clip(1 - np.diag(shared.covariance) / np.diag(prior.knot_covariance), 0.0, 1.0),  # of the prior
        log,
        predicted_log_rad,
        state[:3] * HEADING_CLOCKWISE - applied_rad.mean(axis=1),
        estimation.stable_response(params, mixture.estimate),
    )


@dataclass(frozen=True)
class _Estimation:
    """What the iterations end with: the last solution, its equations, and the weights (n,) of the patches."""

    equations: NormalEquations
    reduced: ReducedNormals
    solution: Solution
    responses: ResponseDesign | None
    weight: Floats  # [1 / m²]
    robust_weight: Floats  # 0 to 1
    mean_change_m: float  # of moving ground

    def stable_response(self, params: ParameterLayout, estimate: Floats) -> StableResponse | None:
        """Return the response of stable ground that belongs to the unknowns (m,); None if not estimated."""
        if self.responses is None:
            return None
        last = self.equations.size
        first = last - self.responses.effect_m.shape[1]
        return self.responses.stable_response(params, estimate[first:last])


def _estimate(
    patches: Patches,
    change: GroundChange,
    misclosure_m: Floats,
    prior: StatePrior,
    log: LineInclination | None,
    reference: SharedParameters | None,
) -> _Estimation:
    """Return the estimate by iteration.

    Residual variances, rejection and the size of change depend on it, and the response of ground on how far
    the beams have moved.
    """
    equations = NormalEquations(patches.jacobian, change.design, misclosure_m, prior, log)
    excess_m2 = np.full(len(patches), EXCESS_BOUNDS_M[0] ** 2)
    robust_weight = np.ones(len(patches))
    residual_m = misclosure_m
    solution: Solution | None = None
    responses: ResponseDesign | None = None
    for iteration in range(MAX_ITERATIONS):
        if iteration == WARMUP_ITERATIONS and solution is not None:
            motion = beam_motion(patches.jacobian.params, solution.estimate, reference)
            responses = response_design(patches, motion, equations.state_effect(motion))
            equations = NormalEquations(
                patches.jacobian, change.design, misclosure_m, prior, log, responses.effect_m
            )
        previous, previous_m = solution, residual_m
        weight = robust_weight / (patches.variance_m2 + excess_m2)
        reduced = equations.reduce(weight)
        solution = Solution(reduced, equations.size, change, previous.model if previous else None)
        change = change.updated(solution.change_m, solution.heave_variance_m2)
        residual_m = misclosure_m - equations.effect(
            solution.estimate, reduced.back_substitute(solution.estimate)
        )
        excess_m2 = _residual_variance(patches, residual_m, change.kind)
        if iteration >= WARMUP_ITERATIONS:
            robust_weight = _tukey_weight(residual_m / np.sqrt(patches.variance_m2 + excess_m2))
            update_m = np.linalg.norm(residual_m - previous_m)
            same_model = (
                previous is not None
                and previous.model == solution.model
                and iteration > WARMUP_ITERATIONS + 1
            )
            if same_model and update_m <= CONVERGED_M * np.sqrt(len(residual_m)):
                break
    assert solution is not None  # noqa: S101 - the loop runs at least once
    return _Estimation(equations, reduced, solution, responses, weight, robust_weight, change.mean_change_m)


def _tukey_weight(ratio: Floats) -> Floats:
    """Return the weights (n,) of residuals over their sigma by Tukey's biweight, 0 to 1."""
    return np.where(np.abs(ratio) < TUKEY, (1 - (ratio / TUKEY) ** 2) ** 2, 0.0)


def _mean_sigma(patches: Patches, moving: Bools, posterior: Posterior) -> float:
    """Return sigma of the mean height of the moving patches [m] by the state's uncertainty; 0 without any."""
    weights = np.where(moving, patches.cell_count, 0.0)
    weights /= max(weights.sum(), 1.0)
    effects = patches.jacobian.aggregate(weights), patches.jacobian.aggregate_by_line(weights)
    unknowns, line_tilt = posterior.covariance_with(*effects)
    variance_m2 = float(effects[0] @ unknowns[: len(effects[0])] + effects[1] @ line_tilt)
    return float(np.sqrt(max(variance_m2, 0.0)))


def _state_and_log(
    params: ParameterLayout, estimate: Floats, reduced: ReducedNormals, log: LineInclination | None
) -> tuple[Floats, Floats]:
    """Return the state by line group (u,), and the predicted log (lines,) [rad], free of errors."""
    state = expand_rows(params, estimate[: len(params.names), None])[:, 0]
    lines = slice(len(GLOBAL), len(GLOBAL) + params.line_groups)
    state[lines] += reduced.back_substitute(estimate)
    predicted_rad = sight_tilt_of(params.line_azimuth_rad) @ state[:2] + state[lines]
    if log is not None and log.reference_tilt is not None:
        predicted_rad += log.reference_tilt.sight_tilt_rad @ estimate[log.reference_columns(params)]
    return np.asarray(state), np.asarray(predicted_rad)


def _residual_variance(patches: Patches, residual_m: Floats, kind: Ints) -> Floats:
    """Return the residual variance (n,) of patches beyond their cells' random errors [m²], by kind of ground.

    Change that is not smooth shifts several patches together; they count as a single observation. It is that
    of one kind: where ice melts, rock beside it does not show by how much ice differs from a trend.
    """
    excess_m2 = np.empty(len(patches))
    for index in range(STABLE + 1):
        selected, max_m = kind == index, EXCESS_BOUNDS_M[1] if index == STABLE else MAX_MOVING_EXCESS_M
        if selected.any():
            single_m2 = _excess_variance(residual_m[selected], patches.variance_m2[selected], max_m)
            ratio = residual_m[selected] / np.sqrt(patches.variance_m2[selected] + single_m2)
            excess_m2[selected] = single_m2 * _effective_group_size(patches.take(selected), ratio)
    return excess_m2


def _excess_variance(residual_m: Floats, variance_m2: Floats, max_m: float) -> float:
    """Return the variance of residuals beyond their random errors [m²], robustly from the median.

    Bisection finds the lower of the two middle values; `np.median` would average them, which changes
    elevations by up to 13 mm.
    """
    low, high = EXCESS_BOUNDS_M[0] ** 2, max_m**2
    deviation_m2 = residual_m**2 / CHI2_MEDIAN - variance_m2
    for _ in range(30):
        middle = float(np.sqrt(low * high))
        if np.count_nonzero(deviation_m2 > middle) > len(deviation_m2) / 2:
            low = middle
        else:
            high = middle
    return low


def _effective_group_size(patches: Patches, ratio: Floats) -> float:
    """Return the number of patches that share one error.

    It is the correlation length over line groups times that over range bins, at most `MAX_GROUP_SIZE`; a
    deposit, whose patches err alike, does not count.
    """
    table = np.full((patches.jacobian.params.line_groups, int(patches.range_bin.max()) + 1), np.nan)
    table[patches.jacobian.line, patches.range_bin] = ratio * _tukey_weight(ratio)
    return min(_correlation_length(table, 20) * _correlation_length(table.T, 3), MAX_GROUP_SIZE)


def _correlation_length(table: Floats, max_lag: int) -> float:
    """Return the integral correlation length of the rows of a table, both sides, down to 0.05."""
    power = float(np.nanmean(table**2))
    total = 1.0
    if power == 0.0:
        return total
    for lag in range(1, min(max_lag, len(table) - 1) + 1):
        pairs = table[lag:] * table[:-lag]
        correlation = float(np.nanmean(pairs) / power) if np.isfinite(pairs).any() else 0.0
        if correlation < 0.05:
            break
        total += 2 * correlation
    return total
