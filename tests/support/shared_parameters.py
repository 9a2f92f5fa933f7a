"""Shared parameters of a scanner at Hintereisferner, with a full covariance of realistic size."""

import numpy as np

from station.quantities import ChangeErrors, SharedParameters
from station.science.uncertainty.common_mode import MODES, SECTORS
from station.science.uncertainty.parameters import parameter_layout

SCANNER = {
    "scanner_east": 631_200.0,
    "scanner_north": 5_184_900.0,
    "scanner_height": 3_010.0,
    "scanner_axis_east": 0.04,
    "scanner_axis_north": -0.02,
}


def random_shared(seed, grid):
    """Return shared parameters; a tenth of the variance comes from change that all epochs have in common."""
    east, north, height, axis_east, axis_north = SCANNER.values()
    axis_up = np.sqrt(1 - axis_east**2 - axis_north**2)
    params = parameter_layout(grid, (east, north, height), (axis_east, axis_north, axis_up))
    counts = params.sight_tilt_knots, params.refraction_knots, params.refraction_knots
    scale = np.array([1e-5, 1e-5, 3e-6, 3e-3, 3e-3, 3e-3, 4e-3, 0.8, 0.05, 0.02])
    sigma = np.concatenate([scale, np.repeat([3e-6, 0.02, 3e-6], counts)])
    rng, common = np.random.default_rng(seed), np.random.default_rng(0)
    root = sigma[:, None] * rng.normal(size=(len(sigma), 3 * len(sigma))) / np.sqrt(3 * len(sigma))
    modes = sigma[:, None] * common.normal(size=(len(sigma), MODES)) / np.sqrt(10 * MODES)
    line_tilt = np.zeros(len(sigma))
    line_tilt[10 : 10 + params.knot_intervals] = 1e-12
    covariance = root @ root.T + modes @ modes.T
    change = ChangeErrors(modes, common.normal(size=SECTORS))
    return SharedParameters(params.names, params.units, np.zeros(len(sigma)), covariance, line_tilt, change)
