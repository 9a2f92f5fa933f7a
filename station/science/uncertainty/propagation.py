"""Propagation of random and shared errors: the variance of any weighted sum of cell heights.

Also conversions of shared parameters: between knots and line groups, to a difference of two scans, to another
layout, and to a subset of the parameters.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from station.quantities import Bools, Floats, SharedParameters
from station.science.uncertainty.jacobian import HeightJacobian, line_tilt_variance
from station.science.uncertainty.parameters import (
    GLOBAL,
    LINE_GROUPS_PER_KNOT,
    ParameterLayout,
    interpolate_to_lines,
    knot_interpolation,
)

BLOCK_CELLS = 8192  # at once: 34 MB


def aggregate_variance(
    weights: Floats,
    random_variance_m2: Floats,
    jacobian: HeightJacobian,
    shared: SharedParameters,
    leverage: Floats | None = None,
) -> float:
    """Return the variance of a weighted sum of cell heights: Σ a² σ_r² + gᵀ C g + line-tilt variance.

    The unit is m² times that of the squared weights. `leverage` (n,) is the share of each cell's noise that
    the adjustment absorbed (`leverage.leverage`); its covariance with the state is subtracted, but the result
    is at least the random variance that was not absorbed. For a difference of two epochs add both variances:
    errors of a common reference cancel. Source: equations.md, 6.2; Hartzell et al. (2015), Eq. 14 and 21,
    lack the second term.
    """
    projector = knot_interpolation(jacobian.params).residual_projector
    line_rad2 = line_tilt_variance(jacobian.params, shared)
    random_m2, independent = weights**2 * random_variance_m2, np.ones(1) if leverage is None else 1 - leverage
    adjusted_weights = weights * (2 * independent - 1)
    shared_m2 = float(jacobian.aggregate(weights) @ shared.covariance @ jacobian.aggregate(adjusted_weights))
    shared_m2 += float(
        ((jacobian.aggregate_by_line(weights) @ projector) * line_rad2)
        @ (jacobian.aggregate_by_line(adjusted_weights) @ projector)
    )
    return max(float(np.sum(random_m2)) + shared_m2, float(np.sum(random_m2 * independent)))


def cell_covariances(first: HeightJacobian, second: HeightJacobian, covariance: Floats) -> Floats:
    """Return J₁ X J₂ᵀ of each cell (n,) for the covariance X (p, p) of the parameters of two epochs [m²]."""
    rows, columns = first.to_sparse(), second.to_sparse()
    blocks = [slice(top, top + BLOCK_CELLS) for top in range(0, len(first), BLOCK_CELLS)]
    sums = [(columns[block].multiply(rows[block] @ covariance)).sum(axis=1) for block in blocks]
    return np.concatenate([np.empty(0), *(np.asarray(values).ravel() for values in sums)])


def difference_to_reference(shared: SharedParameters, reference: SharedParameters | None) -> SharedParameters:
    """Return the shared parameters of scan minus reference: their covariance is C_scan + C_ref.

    If the scanner was relocated since, the two have different parameters and C_ref is taken to be C_scan.
    """
    if reference is None:
        return shared
    return shared + (reference if reference.names == shared.names else shared)


def with_pose_uncertainty(shared: SharedParameters, sigma_rad: float, sigma_m: float) -> SharedParameters:
    """Return the parameters with these uncertainties of rotation and translation, independent of all others.

    `sigma_rad` is that about each axis, `sigma_m` that along each.
    """
    names = [name for name, _ in GLOBAL]
    pose = slice(names.index("tilt_east"), names.index("translation_up") + 1)
    covariance = shared.covariance.copy()
    covariance[pose, :] = covariance[:, pose] = 0.0
    covariance[pose, pose] = np.diag([sigma_rad**2] * 3 + [sigma_m**2] * 3)
    return replace(shared, covariance=covariance)


def align_to(params: ParameterLayout, shared: SharedParameters) -> SharedParameters:
    """Return shared parameters reordered to a parameter layout; parameters they lack get zero variance."""
    if shared.names == params.names:
        return shared
    columns = {name: column for column, name in enumerate(shared.names)}
    dst = [column for column, name in enumerate(params.names) if name in columns]
    src = [columns[params.names[column]] for column in dst]
    estimate, line_variance = np.zeros(len(params.names)), np.zeros(len(params.names))
    covariance = np.zeros((len(params.names),) * 2)
    estimate[dst], line_variance[dst] = shared.estimate[src], shared.line_tilt_variance[src]
    covariance[np.ix_(dst, dst)] = shared.covariance[np.ix_(src, src)]
    change = shared.change_errors
    if change is not None:
        modes = np.zeros((len(params.names), change.modes.shape[1]))
        modes[dst] = change.modes[src]
        change = replace(change, modes=modes)
    return SharedParameters(params.names, params.units, estimate, covariance, line_variance, change)


def expand_covariance(params: ParameterLayout, covariance: Floats) -> Floats:
    """Expand a covariance by knot (p, p) to line groups (u, u).

    The u parameters are the ten globals, the line groups and the knots of refraction and cross tilt.
    """
    expanded = expand_rows(params, covariance)
    return expand_rows(params, expanded.T)


def expand_rows(params: ParameterLayout, rows: Floats) -> Floats:
    """Expand rows by knot (p, k) to rows by line group (u, k)."""
    first, last = len(GLOBAL), len(GLOBAL) + params.sight_tilt_knots
    return np.concatenate([rows[:first], interpolate_to_lines(params, rows[first:last]), rows[last:]])


def condense_rows(params: ParameterLayout, rows: Floats) -> Floats:
    """Condense rows by line group (u, k) to rows by knot (p, k), by least squares."""
    first, last = len(GLOBAL), len(GLOBAL) + params.line_groups
    return np.concatenate([rows[:first], knot_interpolation(params).pinv @ rows[first:last], rows[last:]])


def condense_to_knots(params: ParameterLayout, estimate: Floats, covariance: Floats) -> SharedParameters:
    """Return SharedParameters on knots from an estimate (u,) and covariance (u, u) by line group."""
    lines = slice(len(GLOBAL), len(GLOBAL) + params.line_groups)
    knot_rows = condense_rows(params, covariance)
    residual_rad2 = covariance[lines, lines] - interpolate_to_lines(
        params, knot_rows[lines.start : lines.start + params.sight_tilt_knots, lines]
    )
    line_rad2 = np.einsum("ij,ij->i", residual_rad2, knot_interpolation(params).residual_projector)
    return with_residual_tilt(
        params, condense_rows(params, estimate[:, None])[:, 0], condense_rows(params, knot_rows.T), line_rad2
    )


def with_residual_tilt(
    params: ParameterLayout, estimate: Floats, covariance: Floats, residual_rad2: Floats
) -> SharedParameters:
    """Return SharedParameters on knots (p,), with the tilt variance (lines,) about the knots [rad²].

    Line tilt that the knots cannot represent is kept as independent variance per line group, scaled for the
    part that the knots absorb. This changes the sigma of boxes and areas by less than 5 %.
    """
    # The residual projector is idempotent: the squares of each row sum to its diagonal element.
    line_rad2 = np.maximum(residual_rad2, 0.0) / np.diag(knot_interpolation(params).residual_projector)
    line_variance = np.zeros(len(estimate))
    line_variance[len(GLOBAL) : len(GLOBAL) + params.knot_intervals] = line_rad2.reshape(
        params.knot_intervals, LINE_GROUPS_PER_KNOT
    ).mean(axis=1)
    return SharedParameters(params.names, params.units, estimate, covariance, line_variance)


def restricted_to(shared: SharedParameters, chosen: Bools) -> SharedParameters:
    """Return the shared parameters as if all but the chosen (p,) were known exactly."""
    return replace(
        shared,
        covariance=np.where(np.outer(chosen, chosen), shared.covariance, 0.0),
        line_tilt_variance=np.where(chosen, shared.line_tilt_variance, 0.0),
    )


def to_shared_parameters(params: ParameterLayout, covariance: Floats) -> SharedParameters:
    """Return shared parameters with the covariance of a registration (6, 6), on the layout of a station."""
    sign = np.array([1.0, 1.0, -1.0, 1.0, 1.0, 1.0])  # heading is clockwise
    extended = np.zeros((len(params.names), len(params.names)))
    extended[: len(sign), : len(sign)] = covariance * np.outer(sign, sign)
    zeros = np.zeros(len(params.names))
    assert GLOBAL[2][0] == "heading"  # noqa: S101 - the order of the parameters
    return SharedParameters(params.names, params.units, zeros, extended, zeros)
