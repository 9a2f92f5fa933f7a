"""Which input matters: what each contributes to the variance of a result.

Exactly, from a covariance and first derivatives; and by simulation, for a model of any shape. Where the model
is as good as linear and the inputs are independent both give the same, which is how each checks the other.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from station.quantities import Bools, Floats, Shared
from station.science.shared import Sensitivities, aggregate_variance

Model = Callable[[Floats], Floats]  # inputs (variables, draws) → result (draws,)
Draw = Callable[
    [int, np.random.Generator], Floats
]  # how many → inputs (variables, draws), independent by group

GROUPS: Mapping[str, tuple[str, ...]] = {  # parameters by how their names begin
    "tilt": ("tilt_",),
    "heading": ("heading",),
    "translation": ("translation_",),
    "range": ("range_",),
    "refraction": ("refraction",),
    "jitter": ("lean_",),
}
RANDOM = "random"
INPUTS = (*GROUPS, RANDOM)
STEP = 1e-3  # of a sigma, for derivatives
REPETITIONS = 8  # of a simulation


@dataclass(frozen=True)
class Share:
    """What one input has of a variance, as shares of the whole.

    `part` adds up to 1 over all inputs and is negative where an input offsets others; `first` is what would
    go if the input became known, `total` what would stay if all others did. All are one for independent
    inputs.
    """

    part: float
    first: float
    total: float


@dataclass(frozen=True)
class Simulated:
    """Sobol indices of inputs (d,) by simulation, each with its standard error."""

    first: Floats
    first_error: Floats
    total: Floats
    total_error: Floats


def members(names: tuple[str, ...], group: str) -> Bools:
    """Tell which shared parameters (p,) belong to a group of inputs."""
    return np.array([name.startswith(GROUPS[group]) for name in names], dtype=bool)


def only(unknown: Shared, chosen: Bools) -> Shared:
    """Return what is unknown as if all parameters but the chosen (p,) were known to be as estimated."""
    return replace(
        unknown,
        covariance=np.where(np.outer(chosen, chosen), unknown.covariance, 0.0),
        noise_variance=np.where(chosen, unknown.noise_variance, 0.0),
    )


def apart(unknown: Shared) -> Shared:
    """Return what is unknown as if the groups of inputs were independent of each other."""
    held = sum(np.outer(of, of) for of in (members(unknown.names, group) for group in GROUPS))
    return replace(unknown, covariance=np.where(held, unknown.covariance, 0.0))


def cell_shares(felt: Sensitivities, random_m2: Floats, unknown: Shared) -> dict[str, Floats]:
    """Part of each input in the variance of each cell's height (n,); they add up to 1.

    Source: EQUATIONS 8.9. With correlated inputs a part is g_Gᵀ C g over gᵀ C g, of which half the variance
    with the group alone, less half of that without it, is one half more than the other.
    """
    shared_m2 = felt.variance(unknown)
    variance_m2 = shared_m2 + random_m2
    shares = {}
    for group in GROUPS:
        of = members(unknown.names, group)
        alone_m2, without_m2 = felt.variance(only(unknown, of)), felt.variance(only(unknown, ~of))
        shares[group] = (shared_m2 + alone_m2 - without_m2) / (2 * variance_m2)
    return shares | {RANDOM: random_m2 / variance_m2}


def sum_shares(
    weights: Floats, random_m2: Floats, felt: Sensitivities, unknown: Shared
) -> tuple[float, dict[str, Share]]:
    """Variance of a weighted sum of heights [m²], and what each input has of it.

    Exact for normal errors: V[E(Y|X)] = c Cᴳ⁻¹ cᵀ with c the covariance of the sum and the group.
    Source: EQUATIONS 8.9; Leslar et al. (2014), Eq. 10 and 12, for correlated inputs.
    """
    variance_m2 = aggregate_variance(weights, random_m2, felt, unknown)
    g, covariance = felt.total(weights), unknown.covariance
    along = covariance @ g
    shares = {}
    for group in GROUPS:
        of = members(unknown.names, group)
        silent = replace(only(unknown, of), covariance=np.zeros_like(covariance))
        own_m2 = aggregate_variance(weights, 0 * random_m2, felt, silent)  # of lines, independent of all
        parts = (
            g[of] @ along[of],
            along[of] @ np.linalg.pinv(covariance[np.ix_(of, of)], hermitian=True) @ along[of],
            g[of] @ _given_the_others(covariance, of) @ g[of],
        )
        shares[group] = Share(*(float(part + own_m2) / variance_m2 for part in parts))
    share = float(np.sum(weights**2 * random_m2)) / variance_m2
    return variance_m2, shares | {RANDOM: Share(share, share, share)}


def _given_the_others(covariance: Floats, of: Bools) -> Floats:
    """Covariance of the chosen parameters once all others are known."""
    across = covariance[np.ix_(of, ~of)]
    others = np.linalg.pinv(covariance[np.ix_(~of, ~of)], hermitian=True)
    return np.asarray(covariance[np.ix_(of, of)] - across @ others @ across.T)


def derivatives(model: Model, at: Floats, sigma: Floats) -> Floats:
    """Derivative of a result by each variable (d,), times its sigma: central differences.

    Source: Leslar et al. (2014), Eq. 4-5.
    """
    steps = STEP * np.diag(sigma)
    ends = model(np.concatenate([at[:, None] + steps, at[:, None] - steps], axis=1))
    count = len(at)
    return np.asarray((ends[:count] - ends[count:]) / (2 * STEP))


def propagated(model: Model, at: Floats, sigma: Floats) -> tuple[float, Floats]:
    """Variance of a result of independent variables, and the share (d,) of each.

    The general law of propagation of variances; the printed formula inverts the inner matrix.
    Source: Leslar et al. (2014), Eq. 6-7, with U Q Uᵀ where it prints U Q⁻¹ Uᵀ.
    """
    parts = derivatives(model, at, sigma) ** 2
    return float(parts.sum()), parts / parts.sum()


def sobol(model: Model, draw: Draw, groups: list[Bools], draws: int = 256, seed: int = 1) -> Simulated:
    """Sobol indices of groups of variables by simulation, with standard errors from repetitions.

    `groups` says which variables (d,) each holds; `draws`, a power of two, is of each repetition.
    Source: Leslar et al. (2014), Eq. 9, 10 and 12.
    """
    first, total = _repeated(model, draw, groups, draws, seed)
    return Simulated(*_mean_and_error(first), *_mean_and_error(total))


def interactions(
    model: Model, draw: Draw, groups: list[Bools], draws: int = 256, seed: int = 1
) -> dict[tuple[int, ...], tuple[float, float]]:
    """Index of every combination of groups by simulation, of one group to all, with its standard error.

    What a combination explains together, less what any part of it does: for three, the three pairs' as well
    as the three groups' own. `draws` as of `sobol`; `groups` are few: n make 2ⁿ combinations.
    Source: Leslar et al. (2014), Eq. 11, which as printed takes only the groups' own off.
    """
    some_of = [of for size in range(1, len(groups) + 1) for of in combinations(range(len(groups)), size)]
    together = [np.any([groups[one] for one in of], axis=0) for of in some_of]
    closed, _ = _repeated(model, draw, together, draws, seed)
    found: dict[tuple[int, ...], Floats] = {}
    for column, of in enumerate(some_of):
        lower = [found[part] for part in found if set(part) < set(of)]
        found[of] = closed[:, column] - np.sum(lower, axis=0)
    told = {of: _mean_and_error(values) for of, values in found.items()}
    return {of: (float(mean), float(error)) for of, (mean, error) in told.items()}


def _repeated(model: Model, draw: Draw, groups: list[Bools], draws: int, seed: int) -> tuple[Floats, Floats]:
    """First and total indices (repetitions, groups)."""
    from scipy import stats  # noqa: PLC0415 - a third of what a scan's process would load

    random = np.random.default_rng(seed)
    found = []
    for _ in range(REPETITIONS):
        a, b = draw(draws, random), draw(draws, random)
        mixed = [np.where(of[:, None], b, a) for of in groups]
        values = model(np.concatenate([a, b, *mixed], axis=1)).reshape(len(groups) + 2, draws)
        indices = stats.sobol_indices(
            func={"f_A": values[:1], "f_B": values[1:2], "f_AB": values[2:, None]}, n=draws
        )
        found.append((np.ravel(indices.first_order), np.ravel(indices.total_order)))
    first, total = np.moveaxis(np.array(found), 1, 0)
    return first, total


def _mean_and_error(repeated: Floats) -> tuple[Floats, Floats]:
    return repeated.mean(axis=0), repeated.std(axis=0, ddof=1) / np.sqrt(REPETITIONS)


def independent(sigma: Floats, at: Floats) -> Draw:
    """Return what draws independent normal variables about `at` (d,)."""

    def draw(count: int, random: np.random.Generator) -> Floats:
        return np.asarray(at[:, None] + sigma[:, None] * random.standard_normal((len(at), count)))

    return draw
