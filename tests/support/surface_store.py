"""Scans on a plane slope with errors in common, three of which are the surface of a product."""

from dataclasses import replace

import numpy as np
from support.plane_store import GRID, make_epoch, make_reference, random_parameters

from station.archive import epochs
from station.archive.netcdf_layout import Series
from station.archive.reference_files import write_reference
from station.archive.series.virtual import build_series
from station.quantities import ChangeErrors

HOURS = (1, 3, 4, 30)  # the first three are the surface
SPAN = {"from": "2025-11-21T00:00:00Z", "to": "2025-11-21T06:00:00Z"}
BASE, LAST = (0, 1, 2), 3
PATTERN = np.random.default_rng(8).normal(size=288)


def epoch_with_common_errors(hour, mode):
    """Return an epoch whose errors contain a mode that all epochs have in common."""
    shared = random_parameters(hour, 0.3)
    modes = np.zeros((len(mode), 32))
    modes[:, hour % 32] = mode
    covariance = shared.covariance + np.outer(mode, mode)
    shared = replace(shared, covariance=covariance, change_errors=ChangeErrors(modes, PATTERN))
    return make_epoch(hour, "joint", shared)


def common_mode():
    """Return the mode of the parameters that all epochs have in common."""
    sigma = np.sqrt(np.diag(random_parameters(20, 0.3).covariance))
    return sigma * np.random.default_rng(21).normal(size=len(sigma))


def write_store(folder):
    """Return the series of a new store."""
    series = Series(folder, "hef", GRID, "EPSG:32632")
    write_reference(series, make_reference())
    for hour in HOURS:
        epochs.write_epoch(series, epoch_with_common_errors(hour, common_mode()))
    build_series(series)
    return series


def mean_errors(stored, base, index):
    """Return covariance of the parameters and variance of the line tilts of a mean, against an epoch."""
    hours, common = np.array(HOURS)[list(base)], np.outer(common_mode(), common_mode())
    lasting = np.exp(-np.abs(np.subtract.outer(hours, hours)) / 6).mean()
    lasting -= 2 * np.exp(-np.abs(HOURS[index] - hours) / 6).mean()  # what the epoch has of them
    single = stored.shared_parameter_covariance.values[list(base)].astype(float).mean(axis=0)
    line = stored.shared_parameter_line_tilt_variance.values[list(base)].mean(axis=0) / len(base)
    return common + max(lasting, 1 / len(base)) * (single - common), line
