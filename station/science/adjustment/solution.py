"""Solution of the reduced normal equations, with the size of the ground's change integrated over.

Each model of the change (`ground_change.ChangeModel`) has a likelihood. The most likely one serves while the
adjustment iterates; the result is the mean over all models by their posterior probability, and its covariance
holds their disagreement. Source: Hoeting et al. (1999), Eq. 1 to 4; equations.md, 6.3.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import linalg, special

from station.quantities import Floats
from station.science.adjustment.ground_change import (
    CORRELATED_CHANGE_RATIOS,
    START_MODEL,
    UNLIKELY_LOG_PRIOR,
    ChangeModel,
    GroundChange,
)
from station.science.adjustment.normal_equations import (
    ReducedNormals,
    ScaledCholesky,
    cholesky_inplace,
    log_determinant,
    solve_lower,
)

NEGLIGIBLE_LOG_ODDS = 4.0  # models so much less likely than the best are left out


@dataclass(frozen=True)
class Mixture:
    """Mean of the unknowns (m,) over all models, and the normal matrix with the covariance of the mixture.

    `change_bias` (k, k) times the block of N⁻¹ between change and state is a factor of the part of the
    state's covariance that comes from the change. `size_m` is the mean sigma of the change about its mean.
    """

    estimate: Floats
    factor: ScaledCholesky
    change_bias: Floats
    size_m: float


@dataclass(frozen=True)
class WithoutKnots:
    """Normal equations of the change (s, s) and (s,) without its knots, and the log odds that these add."""

    normal: Floats
    rhs: Floats
    log_odds: float


class Solution:
    """Solution of the reduced normal equations with the most likely model of the change.

    The first `state_size` unknowns are not change. With `previous`, the model of the last iteration, only
    neighbouring correlations are tried.
    """

    def __init__(
        self,
        reduced: ReducedNormals,
        state_size: int,
        change: GroundChange,
        previous: ChangeModel | None = None,
    ) -> None:
        self._reduced, self._change, self._state_size = reduced, change, state_size
        normal, rhs = reduced.normal, reduced.rhs
        self._state_factor = ScaledCholesky(normal[:state_size, :state_size])
        half = self._state_factor.half_solve(normal[:state_size, state_size:])
        self._normal = normal[state_size:, state_size:] - half.T @ half  # of the change, state eliminated
        self._rhs = rhs[state_size:] - half.T @ self._state_factor.half_solve(rhs[:state_size, None])[:, 0]
        self._log_odds: dict[ChangeModel, float] = {}
        self._without_knots: dict[tuple[int, int], WithoutKnots] = {}
        self.model = self._most_likely(previous)

    def log_odds(self, model: ChangeModel) -> float:
        """Return the logarithm of a model's posterior odds, up to a constant."""
        if model not in self._log_odds:
            if not len(self._rhs):
                return self._change.log_prior(model)
            rest = self._eliminate_knots(model.ratio, model.step)
            mean_m, sigma_m = self._change.prior_m(model)
            cholesky = cholesky_inplace(rest.normal + np.diag(1 / sigma_m**2))
            columns = np.zeros((len(sigma_m), 2))
            columns[:, 0], columns[0, 1] = rest.rhs + mean_m / sigma_m**2, 1.0
            half, first = solve_lower(cholesky, columns).T
            half_log_determinant = log_determinant(cholesky) / 2 + np.log(sigma_m).sum()
            squares = half @ half - np.sum((mean_m / sigma_m) ** 2)
            log_odds = rest.log_odds + self._change.log_prior(model) + squares / 2 - half_log_determinant
            if model.mean_sign and self._change.trend_columns:  # the first unknown is the mean
                z = model.mean_sign * first @ half / np.linalg.norm(first)
                log_odds += np.log(2) + max(special.log_ndtr(z), -UNLIKELY_LOG_PRIOR)
            self._log_odds[model] = float(log_odds)
        return self._log_odds[model]

    def _eliminate_knots(self, ratio: int, step: int) -> WithoutKnots:
        """Return the normal equations of the change without knots, for a correlation and step of theirs.

        Models that differ in the sizes of trends have these in common.
        """
        if (ratio, step) not in self._without_knots:
            knots, rest = self._change.knots, self._change.independent
            precision, determinant = self._change.knot_precision(ratio, step)
            cholesky = cholesky_inplace(self._normal[knots, knots] + precision)
            columns = np.column_stack([self._normal[knots, rest], self._rhs[knots]])
            half = solve_lower(cholesky, columns)
            coupling, rhs = half[:, :-1], half[:, -1]
            self._without_knots[ratio, step] = WithoutKnots(
                self._normal[np.ix_(rest, rest)] - coupling.T @ coupling,
                self._rhs[rest] - coupling.T @ rhs,
                float(rhs @ rhs - log_determinant(cholesky) - determinant) / 2,
            )
        return self._without_knots[ratio, step]

    def _most_likely(self, previous: ChangeModel | None) -> ChangeModel:
        best = start = previous or START_MODEL
        for ratio in range(len(CORRELATED_CHANGE_RATIOS)):
            if previous is None or abs(ratio - previous.ratio) <= 1:
                start = self._hill_climb(start.with_ratio(ratio))
                best = max(best, start, key=self.log_odds)
        return best

    def _hill_climb(self, model: ChangeModel) -> ChangeModel:
        """Return a model whose neighbours of the same correlation are less likely."""
        while (best := max([model, *model.neighbours()], key=self.log_odds)) != model:
            model = best
        return model

    @cached_property
    def _equations(self) -> tuple[Floats, Floats]:
        """Cholesky factor (k, k) of the change's normal matrix with the most likely model, and its rhs."""
        precision, information = self._change.precision_at(self.model)
        return cholesky_inplace(self._normal + precision), self._rhs + information

    @cached_property
    def change_m(self) -> Floats:
        """Estimated change (k,) [m]."""
        cholesky, rhs = self._equations
        return np.asarray(linalg.cho_solve((cholesky, True), rhs, check_finite=False))

    @property
    def heave_variance_m2(self) -> Floats:
        """Posterior variance of the heaves (heave_columns,) [m²]."""
        cholesky, _ = self._equations
        columns = np.eye(len(cholesky))[:, len(cholesky) - self._change.heave_columns :]
        half = solve_lower(cholesky, columns)
        return np.asarray(np.sum(half**2, axis=0))

    @cached_property
    def estimate(self) -> Floats:
        """Estimated unknowns (m,)."""
        return self._with_change(self.change_m)

    def _with_change(self, change_m: Floats) -> Floats:
        """Return the unknowns (m,) that belong to a change (k,)."""
        state_size = self._state_size
        normal, rhs = self._reduced.normal[:state_size], self._reduced.rhs[:state_size]
        return np.concatenate([self._state_factor.solve(rhs - normal[:, state_size:] @ change_m), change_m])

    def mixture(self) -> Mixture:
        """Return the mixture of all models that are not negligible."""
        models = self._likely_models()
        weight = np.exp([self.log_odds(model) - self.log_odds(self.model) for model in models])
        weight /= weight.sum()
        size = len(self._rhs)
        mean_m, covariance, bias = np.zeros(size), np.zeros((size, size)), np.zeros((size, size))
        for model, share in zip(models, weight, strict=True):
            precision, information = self._change.precision_at(model)
            model_covariance = ScaledCholesky(self._normal + precision).inverse()
            change_m = model_covariance @ (self._rhs + information)
            mean_m += share * change_m
            covariance += share * (model_covariance + np.outer(change_m, change_m))
            half = self._change.times_root_precision(model_covariance, model)
            bias += share * (half @ half.T)
        covariance -= np.outer(mean_m, mean_m)
        mixture_precision = ScaledCholesky(covariance).inverse()
        normal, first = self._reduced.normal.copy(), self._state_size
        normal[first:, first:] += mixture_precision - self._normal
        size_m = float(np.sqrt(weight @ [model.size_m**2 for model in models]))
        scale = np.sqrt(np.diag(bias))
        change_bias = np.tril(cholesky_inplace(bias / np.outer(scale, scale))).T * scale @ mixture_precision
        return Mixture(self._with_change(mean_m), ScaledCholesky(normal), change_bias, size_m)

    def _likely_models(self) -> list[ChangeModel]:
        """Return the models that are not negligible and connected to the most likely of a correlation."""
        limit = self.log_odds(self.model) - NEGLIGIBLE_LOG_ODDS
        likely, frontier = set[ChangeModel](), list(self._log_odds or [self.model])
        while frontier:
            model = frontier.pop()
            if model not in likely and self.log_odds(model) >= limit:
                likely.add(model)
                frontier += model.neighbours(ratios=True)
        return sorted(likely)
