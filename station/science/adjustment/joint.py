"""Joint least-squares adjustment of one scan: pose, tilt by line, refraction and range, with covariance.

Stable ground, the inclination log, the weather and the prior are observations of the same unknowns. So is
moving ground, as far as its change since the reference is smooth. The amplitude of that change is chosen by
maximum likelihood: a millimetre on a calm day, decimetres after snowfall.
Source: equations.md, 6.3; adjustment.md, 5.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg, sparse

from station.quantities import Bools, Floats, Reals, SharedParameters
from station.science.adjustment.leverage import fit_leverage
from station.science.adjustment.normal_equations import (
    LineInclination,
    NormalEquations,
    Posterior,
    ReducedNormals,
    ScaledCholesky,
    StatePrior,
    cholesky_inplace,
    log_determinant,
)
from station.science.adjustment.patches import CHI2_MEDIAN, RANGE_BIN_M, GroundClass, Patches
from station.science.uncertainty import common_mode
from station.science.uncertainty.jacobian import HeightJacobian, sight_tilt_of
from station.science.uncertainty.parameters import GLOBAL, TILT_KNOT_RAD, ParameterLayout
from station.science.uncertainty.propagation import expand_rows

MAX_ITERATIONS = 8
CONVERGED_M = 0.0003  # stop when an iteration changes the residuals by less (root mean square)
# Rejection starts once the residual variance is known; before that, moving ground would get whole scan lines
# rejected.
WARMUP_ITERATIONS = 2
MIN_WEIGHT = 0.1  # a patch of smaller weight counts as rejected
TUKEY = 4.685  # 95 % efficient for normal errors
EXCESS_BOUNDS_M = (
    0.002,
    0.02,
)  # bounds of the excess sigma of stable patches over their cells' random errors
MAX_MOVING_EXCESS_M = 1.0  # upper bound for moving patches
MAX_GROUP_SIZE = 40.0  # patches that share one error
CHANGE_AZIMUTH_KNOTS = 4  # sight-tilt knots between two knots of the change
CHANGE_RANGE_BINS = 3  # range bins between two knots of the change
CHANGE_STEPS_M = tuple(float(step) for step in np.geomspace(0.5 / 2**14, 0.5, 15))
MEAN_CHANGE_RATIO = 1.0  # sigma of the mean change of all moving ground, in sigmas of one knot
# Sigma of the change that neighbouring knots share, in sigmas of one knot: no, some or strong correlation.
CORRELATED_CHANGE_RATIOS = (0.0, 3.0, 10.0)
# Log prior odds against each. Smooth errors of the air look like correlated change too, but raise its log
# likelihood by tens at most; a smooth snowfall raises it by hundreds.
MODEL_LOG_PRIORS = (0.0, 12.0, 24.0)
CORRELATION_AZIMUTH_KNOTS, CORRELATION_RANGE_KNOTS = 4.0, 2.5  # correlation lengths, in knots
# Where moving ground rises, stable ground may be under snow too thin to change its intensity.
THIN_SNOW_M = 0.005  # upper bound of sigma; the change of moving ground bounds it too
NO_SNOW_M = 1e-6
MAX_SNOW_SLOPES = tuple(np.tan(np.radians((40.0, 50.0))))  # upper bounds (tan): full snow, some snow


@dataclass(frozen=True)
class Adjustment:
    """Adjusted scanner state relative to the SOP: globals, tilt by line group, refraction, cross tilt.

    `change_step_m` is one sigma of the change of moving ground between its knots. `stable_weights` (patches,)
    are the robust weights of the stable patches, 0 to 1. `leverage_m2` holds the leverage variances of moving
    and stable cells (see `leverage`). `log` is the inclination log that was used, and `predicted_log_rad`
    (lines,) is what the adjustment predicts for it, without the errors of the sensor.
    """

    params: ParameterLayout
    estimate: Floats  # (u,)
    posterior: Posterior
    change_step_m: float
    stable_weights: Floats
    leverage_m2: tuple[float, float]
    log: LineInclination | None
    predicted_log_rad: Floats

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

    def to_shared_parameters(self) -> SharedParameters:
        """Return the estimate and its covariance on knots, for the store."""
        return self.posterior.to_shared_parameters(self.estimate)


def tilt_effect(jacobian: HeightJacobian, applied_rad: Floats) -> Reals:
    """Return the effect on heights (n,) [m] of rotating lines about east, north and up (3, lines) [rad]."""
    east, north, up = applied_rad.astype(jacobian.sight_tilt.dtype).take(jacobian.line, axis=1)
    return np.asarray(jacobian.pose[0] * east + jacobian.pose[1] * north - jacobian.pose[2] * up)


def adjust_scan(
    patches: Patches, applied_rad: Floats, prior: StatePrior, log: LineInclination | None
) -> Adjustment:
    """Return the scanner's state estimated from patches, inclination log and prior.

    `applied_rad` (3, lines) is the tilt already applied to the points, as a rotation about east, north and
    up. Hold-out patches are not used. Source: adjustment.md, 5.
    """
    params = patches.jacobian.params
    patches = patches.take(patches.ground_class <= GroundClass.STABLE)
    moving = patches.ground_class == GroundClass.MOVING
    misclosure_m = patches.residual_m + tilt_effect(patches.jacobian, applied_rad)
    change_design, priors = _change_design(patches, moving)
    equations = NormalEquations(patches.jacobian, change_design, misclosure_m, prior, log)
    excess_m2 = np.full(len(patches), EXCESS_BOUNDS_M[0] ** 2)
    robust_weight = np.ones(len(patches))
    residual_m = misclosure_m
    solution: _Solution | None = None
    for iteration in range(MAX_ITERATIONS):
        previous, previous_m = solution, residual_m
        weight = robust_weight / (patches.variance_m2 + excess_m2)
        reduced = equations.reduce(weight)
        solution = _solve(reduced, equations.size, priors, previous.model if previous else None)
        priors = replace(priors, surface_rises=solution.rise_m(change_design, moving) > 0)
        residual_m = misclosure_m - equations.effect(
            solution.estimate, reduced.back_substitute(solution.estimate)
        )
        excess_m2 = _residual_variance(patches, residual_m, moving)
        if iteration >= WARMUP_ITERATIONS:
            ratio = residual_m / np.sqrt(patches.variance_m2 + excess_m2) / TUKEY
            robust_weight = np.where(np.abs(ratio) < 1, (1 - ratio**2) ** 2, 0.0)
            update_m = np.linalg.norm(residual_m - previous_m)
            same_model = (
                previous is not None
                and previous.model == solution.model
                and iteration > WARMUP_ITERATIONS + 1
            )
            if same_model and update_m <= CONVERGED_M * np.sqrt(len(residual_m)):
                break
    assert solution is not None  # noqa: S101 - the loop runs at least once
    reduced = solution.reduced
    polar_change = _polar_change(
        patches.take(moving), solution.change_m(change_design)[moving] / solution.step_m
    )
    mean_jtj = equations.mean_jtj(len(params.names))
    posterior = Posterior(
        params,
        reduced.line_tilt,
        reduced.coupling,
        solution.factor(),
        solution.precision,
        mean_jtj,
        polar_change,
    )
    leverage_m2 = fit_leverage(patches, weight, equations, posterior)
    state, predicted_log_rad = solution.line_state(params), solution.predicted_log_rad(params, log)
    return Adjustment(
        params, state, posterior, solution.step_m, robust_weight[~moving], leverage_m2, log, predicted_log_rad
    )


@dataclass(frozen=True)
class _ChangePriors:
    """Priors of the change at its knots, for a unit step, one per correlation of neighbouring knots.

    The knots are followed by the depths of thin snow on stable ground, which are free if `surface_rises`.
    A model is a pair of indices: into `CORRELATED_CHANGE_RATIOS` and into `CHANGE_STEPS_M`.
    """

    precision: list[Floats]  # (knots, knots)
    log_determinant: list[float]  # of the covariance
    snow_columns: int  # number of snow depths
    surface_rises: bool = True

    def precision_at(self, model: tuple[int, int]) -> tuple[Floats, float]:
        """Return the precision (k, k) of a model, k = knots + snow_columns, and log |precision⁻¹|."""
        ratio_index, step = model
        step_m, knots = CHANGE_STEPS_M[step], len(self.precision[ratio_index])
        snow_m = min(_step_m(model), THIN_SNOW_M) if self.surface_rises else NO_SNOW_M
        precision = np.zeros((knots + self.snow_columns,) * 2)
        precision[:knots, :knots] = self.precision[ratio_index] / step_m**2
        precision[range(knots, knots + self.snow_columns), range(knots, knots + self.snow_columns)] = (
            1 / snow_m**2
        )
        log_scale = 2 * (knots * np.log(step_m) + self.snow_columns * np.log(snow_m))
        return precision, float(self.log_determinant[ratio_index] + log_scale)


def _step_m(model: tuple[int, int]) -> float:
    """Return one sigma of the change between its knots in a model [m]."""
    ratio_index, step = model
    return CHANGE_STEPS_M[step] * float(np.hypot(1.0, CORRELATED_CHANGE_RATIOS[ratio_index]))


def _change_design(patches: Patches, moving: Bools) -> tuple[sparse.csr_array, _ChangePriors]:
    """Return the design matrix (n, knots) of the smooth change of moving ground, and its priors.

    Knots form a grid in azimuth and range; the change is bilinear between them. The depths of thin snow are
    the last columns.
    """
    u, v = (
        patches.jacobian.knot_position / CHANGE_AZIMUTH_KNOTS,
        (patches.range_bin + 0.5) / CHANGE_RANGE_BINS,
    )
    i, j = u.astype(np.int64), v.astype(np.int64)
    u, v = u - i, v - j
    range_knots = int(j.max(initial=0)) + 2
    corners = [(a, b) for a in (0, 1) for b in (0, 1)]
    columns = np.concatenate([(i + a) * range_knots + j + b for a, b in corners])
    values = np.concatenate(
        [np.where(moving, (u if a else 1 - u) * (v if b else 1 - v), 0) for a, b in corners]
    )
    rows = np.tile(np.arange(len(u)), len(corners))
    nonzero = values > 0
    knots, columns = np.unique(columns[nonzero], return_inverse=True)
    design = sparse.csr_array((values[nonzero], (rows[nonzero], columns)), shape=(len(u), len(knots)))
    snow_design = _thin_snow_design(patches, moving) if len(knots) else sparse.csr_array((len(u), 0))
    azimuth_knot, range_knot = np.divmod(knots, range_knots)
    distance = np.abs(np.subtract.outer(azimuth_knot, azimuth_knot)) / CORRELATION_AZIMUTH_KNOTS
    distance += np.abs(np.subtract.outer(range_knot, range_knot)) / CORRELATION_RANGE_KNOTS
    independent = np.eye(len(knots)) + MEAN_CHANGE_RATIO**2
    factors = [
        ScaledCholesky(independent + ratio**2 * np.exp(-distance)) for ratio in CORRELATED_CHANGE_RATIOS
    ]
    priors = _ChangePriors(
        [factor.inverse() for factor in factors],
        [factor.log_determinant() for factor in factors],
        snow_design.shape[1],
    )
    return sparse.hstack([design, snow_design], format="csr"), priors


def _polar_change(patches: Patches, change: Floats) -> Floats:
    """Return the mean change of patches (n,) by azimuth sector and range ring."""
    azimuth_rad = patches.jacobian.params.start_rad + TILT_KNOT_RAD * patches.jacobian.knot_position
    return common_mode.polar_mean(azimuth_rad, (patches.range_bin + 0.5) * RANGE_BIN_M, change)


def _thin_snow_design(patches: Patches, moving: Bools) -> sparse.csr_array:
    """Return the design matrix (n, 2) of thin snow: stable patches that hold snow, and that hold some."""
    tan_slope = np.hypot(*patches.jacobian.pose[3:5])
    snow_class = np.digitize(tan_slope, MAX_SNOW_SLOPES)
    return sparse.csr_array(np.stack([(snow_class == index) & ~moving for index in range(2)], axis=1) * 1.0)


@dataclass(frozen=True)
class _Solution:
    """Solution of the normal equations with the most likely prior of the change, the last unknowns."""

    reduced: ReducedNormals
    estimate: Floats  # (m,)
    model: tuple[int, int]  # selected prior of the change
    precision: Floats  # (changes, changes) of that prior

    @property
    def step_m(self) -> float:
        """One sigma of the change between its knots [m]."""
        return _step_m(self.model)

    def change_m(self, change_design: sparse.csr_array) -> Floats:
        """Return the estimated change of the patches (n,) [m]."""
        return np.asarray(change_design @ self.estimate[len(self.estimate) - len(self.precision) :])

    def rise_m(self, change_design: sparse.csr_array, moving: Bools) -> float:
        """Return the mean change of the moving patches [m]; zero without any."""
        return float(self.change_m(change_design)[moving].mean()) if moving.any() else 0.0

    def line_state(self, params: ParameterLayout) -> Floats:
        """Return the state by line group (u,)."""
        state = expand_rows(params, self.estimate[: len(params.names), None])[:, 0]
        state[len(GLOBAL) : len(GLOBAL) + params.line_groups] += self.reduced.back_substitute(self.estimate)
        return np.asarray(state)

    def predicted_log_rad(self, params: ParameterLayout, log: LineInclination | None) -> Floats:
        """Return the predicted inclination log (lines,) [rad], without the errors of the sensor."""
        state = self.line_state(params)
        predicted_rad = sight_tilt_of(params.line_azimuth_rad) @ state[:2]
        predicted_rad += state[len(GLOBAL) : len(GLOBAL) + params.line_groups]
        if log is not None and log.reference_tilt is not None:
            predicted_rad += log.reference_tilt.sight_tilt_rad @ self.estimate[log.reference_columns(params)]
        return np.asarray(predicted_rad)

    def factor(self) -> ScaledCholesky:
        """Return the factored normal matrix with the selected prior."""
        normal, first = self.reduced.normal.copy(), len(self.estimate) - len(self.precision)
        normal[first:, first:] += self.precision
        return ScaledCholesky(normal)


def _solve(
    reduced: ReducedNormals, state_size: int, priors: _ChangePriors, previous: tuple[int, int] | None
) -> _Solution:
    """Solve the normal equations; the prior of the change is selected by its likelihood.

    `previous` is the model of the last iteration: only its correlation and the neighbouring ones are tried.
    """
    normal, rhs = reduced.normal, reduced.rhs
    state_factor = ScaledCholesky(normal[:state_size, :state_size])
    half = state_factor.half_solve(normal[:state_size, state_size:])
    change_normal = normal[state_size:, state_size:] - half.T @ half
    change_rhs = rhs[state_size:] - half.T @ state_factor.half_solve(rhs[:state_size, None])[:, 0]
    tried: dict[tuple[int, int], tuple[float, Floats]] = {}

    def log_odds(model: tuple[int, int]) -> float:
        if model not in tried:
            tried[model] = _log_likelihood(change_normal, change_rhs, priors, model)
        return tried[model][0]

    target_m = _step_m(
        previous or (0, len(CHANGE_STEPS_M) // 2)
    )  # start each correlation at the same amplitude
    for ratio_index in range(len(CORRELATED_CHANGE_RATIOS)):
        if previous is None or abs(ratio_index - previous[0]) <= 1:
            candidates_m = [_step_m((ratio_index, step)) for step in range(len(CHANGE_STEPS_M))]
            step = int(np.argmin(np.abs(np.log(np.divide(candidates_m, target_m)))))
            target_m = candidates_m[_hill_climb(log_odds, ratio_index, step)]
    model = max(tried, key=log_odds)
    change_m = tried[model][1]
    estimate = np.concatenate(
        [state_factor.solve(rhs[:state_size] - normal[:state_size, state_size:] @ change_m), change_m]
    )
    return _Solution(reduced, estimate, model, priors.precision_at(model)[0])


def _hill_climb(log_odds: Callable[[tuple[int, int]], float], ratio_index: int, step: int) -> int:
    """Return the index into CHANGE_STEPS_M of a local maximum of the log odds."""
    while True:
        neighbours = [(ratio_index, s) for s in (step - 1, step, step + 1) if 0 <= s < len(CHANGE_STEPS_M)]
        _, best = max(neighbours, key=log_odds)
        if best == step:
            return step
        step = best


def _log_likelihood(
    change_normal: Floats, change_rhs: Floats, priors: _ChangePriors, model: tuple[int, int]
) -> tuple[float, Floats]:
    """Return the log likelihood of a model, and the change (knots,) [m] estimated with it."""
    penalty = MODEL_LOG_PRIORS[model[0]]
    if not len(change_rhs):
        return -penalty, change_rhs
    precision, determinant = priors.precision_at(model)
    cholesky = cholesky_inplace(change_normal + precision)
    change_m = linalg.cho_solve((cholesky, True), change_rhs, check_finite=False)
    half_log_determinant = (log_determinant(cholesky) + determinant) / 2
    return float(change_rhs @ change_m / 2 - half_log_determinant) - penalty, change_m


def _residual_variance(patches: Patches, residual_m: Floats, moving: Bools) -> Floats:
    """Return the residual variance (n,) of patches beyond their cells' random errors [m²].

    Change that is not smooth shifts several patches together; they count as a single observation.
    """
    excess_m2 = np.empty(len(patches))
    for selected, max_m in ((moving, MAX_MOVING_EXCESS_M), (~moving, EXCESS_BOUNDS_M[1])):
        if selected.any():
            single_m2 = _excess_variance(residual_m[selected], patches.variance_m2[selected], max_m)
            sigma_m = np.sqrt(patches.variance_m2[selected] + single_m2)
            excess_m2[selected] = single_m2 * _effective_group_size(
                patches.take(selected), residual_m[selected] / sigma_m
            )
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

    It is the correlation length over line groups times that over range bins, at most `MAX_GROUP_SIZE`.
    """
    table = np.full((patches.jacobian.params.line_groups, int(patches.range_bin.max()) + 1), np.nan)
    table[patches.jacobian.line, patches.range_bin] = np.clip(ratio, -3, 3)
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
