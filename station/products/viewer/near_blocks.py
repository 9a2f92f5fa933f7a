"""Systematic sigma of blocks near the scanner, which span many lines: their errors average out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import sparse

from station.quantities import Floats, SharedParameters
from station.science.analysis.calibration import SparseJacobian
from station.science.uncertainty.jacobian import HeightJacobian
from station.science.uncertainty.parameters import TILT_KNOT_RAD

MAX_PLACES = 4  # along each side of a block; a block of fewer cells has a place for each
MIN_SPAN = 0.5  # of a block, in knots, from which its places are distinguished
AT_ONCE = 1000  # blocks


def sigma_ratio(
    jacobian: HeightJacobian,
    shared: SharedParameters,
    offset_m: tuple[Floats, Floats, Floats],
    cell_m: float,
    cells: int,
) -> Floats:
    """Return the systematic sigma of the mean of each block (n,), in sigmas of its middle.

    A block is `cells` wide and long; `offset_m` is that of its middle from the scanner, on the grid.
    Within it only the azimuth of places matters: the other derivatives change linearly.
    Source: equations.md, 6.2.
    """
    plane, block_m = jacobian.params.plane, cells * cell_m
    east_m, north_m, _ = plane.in_map_axes(offset_m)
    ratio = np.ones(len(jacobian))
    near = np.flatnonzero(np.hypot(east_m, north_m) * TILT_KNOT_RAD * MIN_SPAN < block_m)
    places = min(cells, MAX_PLACES)
    step_m = (np.arange(places) + 0.5) / places * block_m - block_m / 2
    step_x_m, step_y_m = (steps.ravel() for steps in np.meshgrid(step_m, step_m))
    step_east_m, step_north_m, _ = plane.in_map_axes((step_x_m, step_y_m, 0.0))
    for first in range(0, len(near), AT_ONCE):
        chosen = near[first : first + AT_ONCE]
        middle = east_m[chosen, None] + 1j * north_m[chosen, None]
        turn_rad = np.angle((middle + step_east_m + 1j * step_north_m) / middle)
        part = jacobian.take(np.repeat(chosen, places**2))
        last = np.nextafter(jacobian.params.knot_intervals, 0)
        position = np.clip(part.knot_position - turn_rad.ravel() / TILT_KNOT_RAD, 0, last)
        part = replace(part, knot_position=position)
        index = np.arange(len(part))
        entries = np.full(len(part), places**-2.0), (index // places**2, index)
        weights = sparse.csr_array(entries, shape=(len(chosen), len(part)))
        mean_m2 = SparseJacobian(part).sums(weights).variance(np.zeros(len(part)), shared)
        ratio[chosen] = np.sqrt(mean_m2 / np.asarray(jacobian.take(chosen).variance(shared)))
    return np.minimum(ratio, 1.0)
