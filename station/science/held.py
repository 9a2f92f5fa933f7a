"""How far the noise of its own cells holds a scan: noise that is in the estimate too does not add to it.

A patch of cells with random variance V and weight W draws the estimate after its own noise by the share
s = V W, so that what its cells have wrong is taken off them again. For anything linear in cells that held the
scan, noise and state go against each other: Σ a² σ² + gᵀ C g - 2 Σ a s J C g.
"""

from __future__ import annotations

import numpy as np

from station.quantities import Bools, Floats, Ints
from station.science.normals import Normals, Unknown
from station.science.patches import Kind, Patches

SLACK_M2 = (1e-9, 1e4)  # least and most that is told
HALVINGS = 45


def slacks(patches: Patches, weight: Floats, normals: Normals, unknown: Unknown) -> tuple[float, float]:
    """Variance [m²] that a moving and a stable cell were given beyond that of their random errors.

    A cell of random variance v holds the scan with the share v / (v + slack) of its noise. Where ground may
    change, the change takes most of that: its slack is large. Chosen so that the mean of all cells of a kind
    has the covariance with the estimate that follows from the patches.
    """
    moving, stable = (
        _slack(patches, patches.kind == kind, weight / patches.one_in[kind], normals, unknown)
        for kind in (Kind.MOVING, Kind.STABLE)
    )
    return moving, stable


def _slack(patches: Patches, chosen: Bools, weight: Floats, normals: Normals, unknown: Unknown) -> float:
    least, most = SLACK_M2
    if not chosen.any():
        return most
    mean = np.where(chosen, patches.cells, 0.0) / patches.cells[chosen].sum()
    estimate, own_rad = unknown.going_with(patches.felt.total(mean), patches.felt.by_line(mean))
    drawn_m2 = normals.effect(estimate, own_rad)
    estimate[normals.size :] = 0.0  # what the change takes of it
    state_m2 = normals.effect(estimate, own_rad)
    held_m2 = mean @ (patches.variance_m2 * weight * drawn_m2)
    cell_m2 = patches.variance_m2 * patches.cells
    for _ in range(HALVINGS):
        middle = float(np.sqrt(least * most))
        if mean @ (cell_m2 / (cell_m2 + middle) * state_m2) > held_m2:
            least = middle
        else:
            most = middle
    return least


def share(own_m2: Floats, random_m2: Floats, kind: Ints, slack_m2: tuple[float, float]) -> Floats:
    """Share (n,) of each cell's own noise that is in the estimate of its scan, by its `Kind`.

    `own_m2` is the part that counts of its `random_m2`: of a difference that of the scan alone.
    """
    moving, stable = (own_m2 / (random_m2 + slack) for slack in slack_m2)
    return np.asarray(np.select([kind == Kind.MOVING, kind == Kind.STABLE], [moving, stable], 0.0))
