"""Whether the logger's clock is wrong, as the stored series shows: news for a person, not for the epochs."""

from __future__ import annotations

import h5py
import numpy as np

from station.archive.variables import FILL
from station.config import Site
from station.errors import StoreError
from station.service.tasks import series_of

LOOKED_AT = 24  # newest scans of the series
FEWEST = 6  # of them that say anything
CLOCK_S = 2.5  # one sigma by which a log's clock differs from scan to scan, EQUATIONS 2.10
CLEAR_SIGMAS = 4.0
LEAST_S = 2.5  # that is worth a word


def late_log(site: Site) -> str:
    """Say how late the newest inclination logs are by what the ground says of each; nothing if they are not.

    Raises StoreError where the series cannot be read.
    """
    path = series_of(site).path
    names = ("log_lateness", "log_lateness_uncertainty")
    try:
        with h5py.File(path, "r") as file:
            if any(name not in file for name in names):
                return ""
            late_s, sigma_s = (file[name][-LOOKED_AT:].astype(np.float64) for name in names)
    except (OSError, RuntimeError, IndexError, ValueError) as error:
        raise StoreError(f"{path}: cannot be read: {error}") from error
    told = np.isfinite(late_s) & (late_s < FILL / 2)
    if np.count_nonzero(told) < FEWEST:
        return ""
    weight = 1 / (sigma_s[told] ** 2 + CLOCK_S**2)
    mean_s, mean_sigma_s = float(weight @ late_s[told] / weight.sum()), float(weight.sum() ** -0.5)
    if abs(mean_s) < max(LEAST_S, CLEAR_SIGMAS * mean_sigma_s):
        return ""
    word = "late" if mean_s > 0 else "early"
    return (
        f"the inclination logs of the last {np.count_nonzero(told)} scans are {abs(mean_s):.1f} s {word}"
        f" (± {mean_sigma_s:.1f} s), by how the ground sways: look at the clock of the logger"
    )
