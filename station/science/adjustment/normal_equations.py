"""Normal equations of one scan: its patches, its inclination log and the prior of its state.

The line tilts are eliminated (Schur complement) and recovered by back-substitution. The unknowns that remain
are the state by knots, the error modes of the inclination log, the response of rough ground and the change
of moving ground.
Source: equations.md, 6.3.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import linalg, sparse

from station.quantities import ChangeErrors, Floats, SharedParameters
from station.science.adjustment.line_tilt import LineTiltPosterior, LineTiltPrior
from station.science.uncertainty import common_mode
from station.science.uncertainty.jacobian import HeightJacobian, sight_tilt_of
from station.science.uncertainty.parameters import (
    GLOBAL,
    ParameterLayout,
    interpolate_to_lines,
    knot_interpolation,
)
from station.science.uncertainty.propagation import (
    condense_rows,
    expand_covariance,
    expand_rows,
    with_residual_tilt,
)


@dataclass(frozen=True)
class ReferenceTiltModes:
    """Tilt error of the reference: principal components, 1 σ each, that the inclination log cannot show."""

    sight_tilt_rad: Floats  # (lines, k) along the line of sight
    state: Floats  # (p, k) the reference's state by knots that belongs to each component


@dataclass(frozen=True)
class LineInclination:
    """Inclination log averaged per scan-line group, with its noise and its systematic errors."""

    sight_tilt_rad: Floats  # (lines,) along the line of sight
    weight: Floats  # (lines,) 1 / rad², zero without a sample
    error_modes: Floats  # (lines, f) effect of 1 σ of each systematic error of the sensor [rad]
    reference_tilt: ReferenceTiltModes | None = None  # if the log is relative to the tilt of a reference

    @property
    def all_modes(self) -> Floats:
        """Effect of 1 σ of all systematic errors: the sensor's and the reference's (lines, f + k) [rad]."""
        return (
            self.error_modes
            if self.reference_tilt is None
            else np.hstack([self.error_modes, self.reference_tilt.sight_tilt_rad])
        )

    def reference_columns(self, params: ParameterLayout) -> slice:
        """Return the columns of the unknowns that are tilt modes of the reference."""
        first = len(params.names) + self.error_modes.shape[1]
        return slice(
            first, first + (0 if self.reference_tilt is None else self.reference_tilt.sight_tilt_rad.shape[1])
        )

    def relative_to(self, params: ParameterLayout, reference_covariance: Floats) -> LineInclination:
        """Return this log relative to a reference whose state has a covariance (p, p).

        The sensor does not observe the tilt error of the reference. Only the modes of that error which exceed
        the noise of a line group are kept.
        """
        values, vectors = np.linalg.eigh(reference_covariance)
        factor = vectors * np.sqrt(np.maximum(values, 0.0))
        sight_tilt = interpolate_to_lines(params, factor[len(GLOBAL) : len(GLOBAL) + params.sight_tilt_knots])
        sight_tilt += sight_tilt_of(params.line_azimuth_rad) @ factor[:2]
        modes, sizes, rotation = linalg.svd(sight_tilt, full_matrices=False)
        observable = sizes**2 * self.weight.max(initial=0.0) > 1
        return replace(
            self,
            reference_tilt=ReferenceTiltModes(
                modes[:, observable] * sizes[observable], factor @ rotation[observable].T
            ),
        )


@dataclass(frozen=True)
class StatePrior:
    """Prior of the scanner's state, before any shot of the scan is used.

    The tilt of a line group is interpolated linearly between the enclosing knots, plus its line tilt.
    """

    params: ParameterLayout
    knot_covariance: Floats  # (p, p) globals, sight tilt, refraction, cross tilt
    line_tilt: LineTiltPrior

    def relative_to(self, reference: SharedParameters | None) -> StatePrior:
        """Return the prior of the difference to the reference's state, which is uncertain too."""
        if reference is None:
            return self
        line_tilt = self.line_tilt if reference.names == self.params.names else self.line_tilt.doubled()
        return StatePrior(self.params, self.knot_covariance + self.reference_covariance(reference), line_tilt)

    def reference_covariance(self, reference: SharedParameters) -> Floats:
        """Return the covariance (p, p) of a reference's state; of a scan's if the scanner was relocated."""
        return reference.covariance if reference.names == self.params.names else self.knot_covariance

    def line_covariance(self) -> Floats:
        """Return the covariance (u, u) of globals, tilt by line group, refraction and cross tilt by knot."""
        covariance = expand_covariance(self.params, self.knot_covariance)
        lines = slice(len(GLOBAL), len(GLOBAL) + self.params.line_groups)
        covariance[lines, lines] += self.line_tilt.covariance()
        return covariance


@dataclass(frozen=True)
class ReducedNormals:
    """Reduced normal equations: the line tilts are eliminated (Schur complement)."""

    normal: Floats  # (m, m)
    rhs: Floats  # (m,)
    line_tilt: LineTiltPosterior
    coupling: sparse.csr_array  # (lines, m) block of the normal matrix between line tilts and other unknowns
    line_rhs: Floats  # (lines,) right-hand side of the line tilts

    def back_substitute(self, estimate: Floats) -> Floats:
        """Return the line tilts (lines,) [rad] that belong to the other unknowns (m,)."""
        return self.line_tilt.apply((self.line_rhs - self.coupling @ estimate)[:, None])[:, 0]


class NormalEquations:
    """Normal equations of m unknowns: state by knots, errors of the log, responses, change of moving ground.

    The line tilts are unknowns too, but `reduce` eliminates them. `response_design_m` (n, k) is the effect of
    one sigma of each response on the patches (`ground_response.ResponseDesign`); None for none. The first
    `size` unknowns are not change.
    """

    def __init__(
        self,
        jacobian: HeightJacobian,
        change_design: sparse.csr_array,
        misclosure_m: Floats,
        prior: StatePrior,
        log: LineInclination | None,
        response_design_m: sparse.csr_array | None = None,
    ) -> None:
        params = jacobian.params
        state_design, state_size = jacobian.to_sparse(), len(prior.knot_covariance)
        self._patch_count = len(jacobian)
        self._line_effect, self._line, self._misclosure = jacobian.sight_tilt, jacobian.line, misclosure_m
        mode_count = 0 if log is None else log.all_modes.shape[1]
        modes = sparse.csr_array((len(jacobian), mode_count))
        responses = sparse.csr_array((len(jacobian), 0)) if response_design_m is None else response_design_m
        self.size = state_size + mode_count + responses.shape[1]
        self._design = sparse.hstack([state_design, modes, responses, change_design], format="csr")
        self._log_weight = np.empty(0)
        if log is not None:
            self._add_log(log, params)
        self._precision = np.zeros((self._design.shape[1],) * 2)
        self._precision[range(state_size, self.size), range(state_size, self.size)] = 1.0
        self._add_prior(prior, log)
        self._line_tilt = prior.line_tilt
        rows = np.arange(len(self._line))
        shape = params.line_groups, len(rows)
        self._line_design_transposed = sparse.csr_array((self._line_effect, (self._line, rows)), shape=shape)
        self._design_transposed = self._design.T.tocsr()

    def _add_prior(self, prior: StatePrior, log: LineInclination | None) -> None:
        """Add the prior of the state.

        The state is a difference. Added to the reference's state, which the tilt modes describe, it is the
        state of the scan, which is independent of those modes.
        """
        covariance, state_size = prior.knot_covariance, len(prior.knot_covariance)
        if log is None or (reference_tilt := log.reference_tilt) is None:
            self._precision[:state_size, :state_size] = ScaledCholesky(covariance).inverse()
            return
        columns = log.reference_columns(prior.params)
        precision = ScaledCholesky(covariance - reference_tilt.state @ reference_tilt.state.T).inverse()
        cross_precision = precision @ reference_tilt.state
        self._precision[:state_size, :state_size] = precision
        self._precision[:state_size, columns], self._precision[columns, :state_size] = (
            cross_precision,
            cross_precision.T,
        )
        self._precision[columns, columns] += reference_tilt.state.T @ cross_precision

    def _add_log(self, log: LineInclination, params: ParameterLayout) -> None:
        """Append the inclination log of each line group as further observations."""
        design = np.zeros((params.line_groups, self._design.shape[1]))
        knots, first_mode = params.knot_slices[0], len(params.names)
        design[:, :2] = sight_tilt_of(params.line_azimuth_rad)
        design[:, knots] = interpolate_to_lines(params, np.eye(params.sight_tilt_knots))
        design[:, first_mode : first_mode + log.all_modes.shape[1]] = log.all_modes
        self._design = sparse.vstack([self._design, sparse.csr_array(design)], format="csr")
        self._line_effect = np.concatenate([self._line_effect, np.ones(len(design))])
        self._line = np.concatenate([self._line, np.arange(len(design))])
        self._misclosure = np.concatenate([self._misclosure, log.sight_tilt_rad])
        self._log_weight = log.weight

    def reduce(self, weight: Floats) -> ReducedNormals:
        """Return the reduced normal equations for patch weights (n,) [1 / m²]."""
        weight = np.concatenate([weight, self._log_weight])
        weighted_design = sparse.diags_array(weight) @ self._design
        line_tilt = self._line_tilt.condition_on(
            np.asarray(self._line_design_transposed @ (weight * self._line_effect))
        )
        coupling: sparse.csr_array = self._line_design_transposed @ weighted_design
        normal = (
            self._precision
            + (self._design_transposed @ weighted_design).toarray()
            - line_tilt.quadratic_form(coupling)
        )
        weighted = weight * self._misclosure
        line_rhs = np.asarray(self._line_design_transposed @ weighted)
        rhs = self._design_transposed @ weighted - coupling.T @ line_tilt.apply(line_rhs[:, None])[:, 0]
        return ReducedNormals(normal, rhs, line_tilt, coupling, line_rhs)

    def mean_jtj(self, state_size: int) -> Floats:
        """Return the mean of JᵀJ over the patches (state_size, state_size), for the first unknowns."""
        state_design = self._design[: self._patch_count, :state_size]
        return np.asarray((state_design.T @ state_design).toarray() / max(self._patch_count, 1))

    def state_effect(self, state: Floats) -> Floats:
        """Return the effect of a state by knots (p,) on the patches (n,) [m]."""
        return np.asarray(self._design[: self._patch_count, : len(state)] @ state)

    def effect(self, estimate: Floats, line_tilt_rad: Floats) -> Floats:
        """Return the effect of the unknowns (m,) and of the line tilts (lines,) on the patches (n,) [m]."""
        effect = self._design @ estimate + self._line_effect * line_tilt_rad[self._line]
        return np.asarray(effect[: self._patch_count])


@dataclass(frozen=True)
class Posterior:
    """Posterior of the scan state: factored normal matrix and conditional covariance of the line tilts.

    The last unknowns are the change of moving ground; `polar_change` is its estimate.
    """

    params: ParameterLayout
    line_tilt: LineTiltPosterior
    coupling: sparse.csr_array  # (lines, m) block of the normal matrix between line tilts and other unknowns
    factor: ScaledCholesky  # (m, m)
    change_bias: Floats  # (k, k) factor of the change's part of the covariance, from its block of N⁻¹
    mean_jtj: Floats  # (p, p) of the state by knots
    polar_change: Floats  # (sectors,)

    def line_covariance(self) -> Floats:
        """Return the covariance (u, u) of the state by line group."""
        half = self.factor.half_solve(self._state_map().T)
        covariance = half.T @ half
        covariance[self._line_slice, self._line_slice] += self.line_tilt.apply(
            np.eye(self.params.line_groups)
        )
        return np.asarray(covariance)

    def sight_tilt_covariance(self, log: LineInclination) -> Floats:
        """Return the covariance (lines, lines) of the sight tilt that an error-free log would show [rad²]."""
        state_map = self._state_map()
        design = sight_tilt_of(self.params.line_azimuth_rad) @ state_map[:2] + state_map[self._line_slice]
        if log.reference_tilt is not None:
            design[:, log.reference_columns(self.params)] += log.reference_tilt.sight_tilt_rad
        half = self.factor.half_solve(design.T)
        return np.asarray(half.T @ half + self.line_tilt.apply(np.eye(self.params.line_groups)))

    @property
    def _line_slice(self) -> slice:
        return slice(len(GLOBAL), len(GLOBAL) + self.params.line_groups)

    @cached_property
    def _line_response(self) -> Floats:
        """Response of the line tilts to the other unknowns (lines, m)."""
        return self.line_tilt.apply(self.coupling.toarray())

    def _state_map(self) -> Floats:
        """Return the matrix (u, m) that maps the unknowns to the state by line group."""
        state_map = expand_rows(self.params, np.eye(len(self.params.names), self.coupling.shape[1]))
        state_map[self._line_slice] -= self._line_response
        return np.asarray(state_map)

    def covariance_with(self, knot_effect: Floats, line_effect: Floats) -> tuple[Floats, Floats]:
        """Return the covariance of the unknowns (m,) and of the line tilts (lines,) with a linear function.

        `knot_effect` (p,) and `line_effect` (lines,) are its derivatives by the state on knots and by the
        line tilts.
        """
        rhs = -self.coupling.T @ self.line_tilt.apply(line_effect[:, None])[:, 0]
        rhs[: len(knot_effect)] += knot_effect
        unknowns = self.factor.solve(rhs)
        return unknowns, self.line_tilt.apply((line_effect - self.coupling @ unknowns)[:, None])[:, 0]

    def to_shared_parameters(self, estimate: Floats) -> SharedParameters:
        """Return SharedParameters on knots from the estimated state by line group (u,)."""
        params, line_tilt, interpolation = self.params, self.line_tilt, knot_interpolation(self.params)
        tilt_slice = slice(len(GLOBAL), len(GLOBAL) + params.sight_tilt_knots)
        response = self._line_response
        knot_response = interpolation.pinv @ response
        state_map = np.eye(len(params.names), self.coupling.shape[1])
        state_map[tilt_slice] -= knot_response
        half = self.factor.half_solve(state_map.T)
        covariance = half.T @ half
        cross_covariance = line_tilt.apply(interpolation.pinv.T)
        knot_covariance = interpolation.pinv @ cross_covariance
        covariance[tilt_slice, tilt_slice] += knot_covariance
        residual_rad2 = line_tilt.variance() - np.einsum(
            "ij,ij->i",
            interpolation.matrix,
            2 * cross_covariance - interpolate_to_lines(params, knot_covariance),
        )
        residual_rad2 += np.sum(
            self.factor.half_solve((response - interpolate_to_lines(params, knot_response)).T) ** 2, axis=0
        )
        shared = with_residual_tilt(
            params, condense_rows(params, estimate[:, None])[:, 0], covariance, residual_rad2
        )
        return (
            shared if not len(self.change_bias) else replace(shared, change_errors=self._change_errors(half))
        )

    def _change_errors(self, half: Floats) -> ChangeErrors:
        """Return the part of the covariance that the change causes, from L⁻¹ (m, p) of the state by knots."""
        with_change = self.factor.back_solve_last(half, len(self.change_bias))
        factor = self.change_bias @ with_change
        return ChangeErrors(common_mode.dominant_modes(factor, self.mean_jtj), self.polar_change)


class ScaledCholesky:
    """Jacobi-scaled Cholesky factor L of a covariance or normal matrix (n, n) with mixed units."""

    def __init__(self, matrix: Floats) -> None:
        self._scale = 1 / np.sqrt(np.diag(matrix))
        self._cholesky = cholesky_inplace(matrix * self._scale[:, None] * self._scale)

    def half_solve(self, rhs: Floats) -> Floats:
        """Return L⁻¹ B (n, k) for a right-hand side B (n, k)."""
        return solve_lower(self._cholesky, rhs * self._scale[:, None])

    def solve(self, rhs: Floats) -> Floats:
        """Return the solution (n,) for a right-hand side (n,)."""
        solution = linalg.cho_solve((self._cholesky, True), rhs * self._scale, check_finite=False)
        return np.asarray(solution * self._scale)

    def back_solve_last(self, half: Floats, count: int) -> Floats:
        """Return the last `count` rows of the solution (count, k) from its half-solution L⁻¹ B (n, k)."""
        corner, scale = self._cholesky[-count:, -count:], self._scale[-count:, None]
        return np.asarray(
            linalg.solve_triangular(corner, half[-count:], lower=True, trans="T", check_finite=False) * scale
        )

    def inverse(self) -> Floats:
        """Return the inverse (n, n)."""
        if not len(self._scale):
            return np.empty((0, 0))
        triangle = np.tril(linalg.lapack.dpotri(self._cholesky, lower=True)[0])
        full = triangle + np.tril(triangle, -1).T
        return np.asarray(full * self._scale[:, None] * self._scale)

    def log_determinant(self) -> float:
        """Return the logarithm of the determinant."""
        return log_determinant(self._cholesky) - float(2 * np.log(self._scale).sum())


def cholesky_inplace(matrix: Floats) -> Floats:
    """Return the lower Cholesky factor of a symmetric matrix (n, n), which is overwritten.

    By LAPACK itself, as in `solve_lower`: SciPy's checks cost more than the factor of a small matrix. Raises
    LinAlgError if the matrix is not positive definite.
    """
    cholesky, failed = linalg.lapack.dpotrf(matrix.T, lower=True, clean=False, overwrite_a=True)
    if failed:
        raise linalg.LinAlgError(f"the leading minor of order {failed} is not positive")
    return np.asarray(cholesky)


def solve_lower(cholesky: Floats, rhs: Floats) -> Floats:
    """Return L⁻¹ B (n, k) for a lower Cholesky factor L (n, n) and a right-hand side B (n, k)."""
    if not len(cholesky):
        return rhs
    solution, _ = linalg.lapack.dtrtrs(cholesky, rhs, lower=True)
    return np.asarray(solution)


def log_determinant(cholesky: Floats) -> float:
    """Return the logarithm of a matrix's determinant from its Cholesky factor (n, n)."""
    return float(2 * np.log(np.diag(cholesky)).sum())
