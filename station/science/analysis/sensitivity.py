"""Sensitivity analysis: the contribution of each input to the variance of a result.

Exact, from a covariance and first derivatives; and by simulation, for any model. For a nearly linear model
with independent inputs both agree, so each checks the other.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from station.quantities import Bools, Floats, SharedParameters
from station.science.uncertainty.jacobian import HeightJacobian
from station.science.uncertainty.propagation import aggregate_variance, restricted_to

Model = Callable[[Floats], Floats]  # inputs (variables, draws) → result (draws,)
Draw = Callable[
    [int, np.random.Generator], Floats
]  # count → inputs (variables, draws), independent between groups

GROUPS: Mapping[str, tuple[str, ...]] = {  # parameters by the prefix of their names
    "tilt": ("tilt_",),
    "heading": ("heading",),
    "translation": ("translation_",),
    "range": ("range_",),
    "refraction": ("refraction",),
    "jitter": ("sight_tilt_", "cross_tilt_"),
}
RANDOM = "random"
INPUTS = (*GROUPS, RANDOM)
STEP_SIGMAS = 1e-3  # for derivatives
REPETITIONS = 8  # of a simulation


@dataclass(frozen=True)
class Share:
    """Contribution of one input to a variance, as shares of the whole.

    `covariance_share` sums to 1 over all inputs and is negative if an input offsets others. `first` is the
    share that would vanish if the input became known, `total` the share that would remain if all other inputs
    did. For independent inputs all three are equal.
    """

    covariance_share: float
    first: float
    total: float


@dataclass(frozen=True)
class SobolIndices:
    """Sobol indices of inputs (d,) by simulation, each with its standard error."""

    first: Floats
    first_error: Floats
    total: Floats
    total_error: Floats


def group_mask(names: tuple[str, ...], group: str) -> Bools:
    """Return a mask of the shared parameters (p,) that belong to a group of inputs."""
    return np.array([name.startswith(GROUPS[group]) for name in names], dtype=bool)


def block_diagonal(shared: SharedParameters) -> SharedParameters:
    """Return the shared parameters as if the groups of inputs were independent of each other."""
    same_group = sum(np.outer(mask, mask) for mask in (group_mask(shared.names, group) for group in GROUPS))
    return replace(shared, covariance=np.where(same_group, shared.covariance, 0.0))


def cell_shares(jacobian: HeightJacobian, random_m2: Floats, shared: SharedParameters) -> dict[str, Floats]:
    """Covariance share of each input in the variance of each cell's height (n,); the shares sum to 1.

    With correlated inputs the share is g_Gᵀ C g over gᵀ C g. The numerator is (V + V_alone - V_without) / 2,
    with the variances of all parameters, of the group alone and without it. Source: equations.md, 8.9.
    """
    shared_m2 = jacobian.variance(shared)
    variance_m2 = shared_m2 + random_m2
    shares = {}
    for group in GROUPS:
        mask = group_mask(shared.names, group)
        alone_m2, without_m2 = (
            jacobian.variance(restricted_to(shared, mask)),
            jacobian.variance(restricted_to(shared, ~mask)),
        )
        shares[group] = (shared_m2 + alone_m2 - without_m2) / (2 * variance_m2)
    return shares | {RANDOM: random_m2 / variance_m2}


def sum_shares(
    weights: Floats, random_m2: Floats, jacobian: HeightJacobian, shared: SharedParameters
) -> tuple[float, dict[str, Share]]:
    """Variance of a weighted sum of heights [m²], and the share of each input.

    Exact for normal errors: V[E(Y|X)] = c Cᴳ⁻¹ cᵀ, where c is the covariance of the sum and the group.
    Source: equations.md, 8.9; Leslar et al. (2014), Eq. 10 and 12, for correlated inputs.
    """
    variance_m2 = aggregate_variance(weights, random_m2, jacobian, shared)
    g, covariance = jacobian.aggregate(weights), shared.covariance
    covariance_with_sum = covariance @ g
    shares = {}
    for group in GROUPS:
        mask = group_mask(shared.names, group)
        line_only = replace(restricted_to(shared, mask), covariance=np.zeros_like(covariance))
        line_m2 = aggregate_variance(weights, 0 * random_m2, jacobian, line_only)  # of the lines, independent
        parts = (
            g[mask] @ covariance_with_sum[mask],
            covariance_with_sum[mask]
            @ np.linalg.pinv(covariance[np.ix_(mask, mask)], hermitian=True)
            @ covariance_with_sum[mask],
            g[mask] @ _conditional_covariance(covariance, mask) @ g[mask],
        )
        shares[group] = Share(*(float(part + line_m2) / variance_m2 for part in parts))
    share = float(np.sum(weights**2 * random_m2)) / variance_m2
    return variance_m2, shares | {RANDOM: Share(share, share, share)}


def _conditional_covariance(covariance: Floats, mask: Bools) -> Floats:
    """Covariance of the chosen parameters, conditional on all others."""
    cross_covariance = covariance[np.ix_(mask, ~mask)]
    others = np.linalg.pinv(covariance[np.ix_(~mask, ~mask)], hermitian=True)
    return np.asarray(covariance[np.ix_(mask, mask)] - cross_covariance @ others @ cross_covariance.T)


def scaled_gradient(model: Model, point: Floats, sigma: Floats) -> Floats:
    """Derivative of a result by each variable (d,), times its sigma, from central differences.

    Source: Leslar et al. (2014), Eq. 4-5.
    """
    steps = STEP_SIGMAS * np.diag(sigma)
    ends = model(np.concatenate([point[:, None] + steps, point[:, None] - steps], axis=1))
    count = len(point)
    return np.asarray((ends[:count] - ends[count:]) / (2 * STEP_SIGMAS))


def first_order_variance(model: Model, point: Floats, sigma: Floats) -> tuple[float, Floats]:
    """First-order variance of a result of independent variables, and the share of each (d,).

    The general law of propagation of variances; the printed formula inverts the inner matrix.
    Source: Leslar et al. (2014), Eq. 6-7, with U Q Uᵀ where it prints U Q⁻¹ Uᵀ.
    """
    parts = scaled_gradient(model, point, sigma) ** 2
    return float(parts.sum()), parts / parts.sum()


def sobol(model: Model, draw: Draw, groups: list[Bools], draws: int = 256, seed: int = 1) -> SobolIndices:
    """Sobol indices of groups of variables by simulation, with standard errors from repetitions.

    `groups` are masks of the variables (d,); `draws`, a power of two, is the number per repetition.
    Source: Leslar et al. (2014), Eq. 9, 10 and 12.
    """
    first, total = _repeat_indices(model, draw, groups, draws, seed)
    return SobolIndices(*_mean_and_error(first), *_mean_and_error(total))


def interactions(
    model: Model, draw: Draw, groups: list[Bools], draws: int = 256, seed: int = 1
) -> dict[tuple[int, ...], tuple[float, float]]:
    """Interaction index of every combination of groups by simulation, from one group to all, and its error.

    The index of a combination is its closed index minus the indices of all its subsets: for three groups the
    three pairs as well as the three single groups. `draws` as in `sobol`; n groups make 2ⁿ combinations.
    Source: Leslar et al. (2014), Eq. 11, which as printed subtracts only the single groups.
    """
    combined = [
        combination
        for size in range(1, len(groups) + 1)
        for combination in combinations(range(len(groups)), size)
    ]
    masks = [np.any([groups[group] for group in combination], axis=0) for combination in combined]
    closed, _ = _repeat_indices(model, draw, masks, draws, seed)
    indices: dict[tuple[int, ...], Floats] = {}
    for column, combination in enumerate(combined):
        lower = [indices[subset] for subset in indices if set(subset) < set(combination)]
        indices[combination] = closed[:, column] - np.sum(lower, axis=0)
    estimates = {combination: _mean_and_error(values) for combination, values in indices.items()}
    return {combination: (float(mean), float(error)) for combination, (mean, error) in estimates.items()}


def _repeat_indices(
    model: Model, draw: Draw, groups: list[Bools], draws: int, seed: int
) -> tuple[Floats, Floats]:
    """First and total indices (repetitions, groups)."""
    from scipy import stats  # noqa: PLC0415 - a third of the import time of a worker process

    random = np.random.default_rng(seed)
    repetitions = []
    for _ in range(REPETITIONS):
        a, b = draw(draws, random), draw(draws, random)
        mixed = [np.where(mask[:, None], b, a) for mask in groups]
        values = model(np.concatenate([a, b, *mixed], axis=1)).reshape(len(groups) + 2, draws)
        indices = stats.sobol_indices(
            func={"f_A": values[:1], "f_B": values[1:2], "f_AB": values[2:, None]}, n=draws
        )
        repetitions.append((np.ravel(indices.first_order), np.ravel(indices.total_order)))
    first, total = np.moveaxis(np.array(repetitions), 1, 0)
    return first, total


def _mean_and_error(repeated: Floats) -> tuple[Floats, Floats]:
    return repeated.mean(axis=0), repeated.std(axis=0, ddof=1) / np.sqrt(REPETITIONS)


def independent_normal(sigma: Floats, mean: Floats) -> Draw:
    """Return a sampler of independent normal variables with mean `mean` (d,)."""

    def draw(count: int, random: np.random.Generator) -> Floats:
        return np.asarray(mean[:, None] + sigma[:, None] * random.standard_normal((len(mean), count)))

    return draw
