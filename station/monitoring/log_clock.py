"""Clock offset of the inclination logger, from the stored series: a warning for the operator."""

from __future__ import annotations

import h5py
import numpy as np

from station.archive.read_errors import read_errors
from station.archive.schema import FILL
from station.archive.series.index import processing_file
from station.config import Site
from station.processing.site_files import series_for

MAX_SCANS = 24  # newest of the series
MIN_SCANS = 6  # with an estimate
CLOCK_SIGMA_S = 2.5  # one sigma of a log's clock offset from scan to scan; equations.md, 2.10
MIN_SIGNIFICANCE = 4.0
MIN_OFFSET_S = 2.5  # below which nothing is reported


def log_clock_offset(site: Site) -> str:
    """Return a message on the mean clock offset of the newest inclination logs; "" if it is insignificant.

    That of each log is what was corrected and what remains, estimated from the ground. Raises StoreError if
    the series cannot be read.
    """
    path = processing_file(series_for(site))
    names = ("log_offset", "log_clock_offset", "log_clock_offset_uncertainty")
    with read_errors(path), h5py.File(path, "r") as file:
        if any(name not in file for name in names):
            return ""
        corrected_s, remaining_s, sigma_s = (file[name][-MAX_SCANS:].astype(np.float64) for name in names)
    estimated = np.isfinite(remaining_s) & (remaining_s < FILL / 2)
    offset_s = corrected_s + remaining_s
    if np.count_nonzero(estimated) < MIN_SCANS:
        return ""
    weight = 1 / (sigma_s[estimated] ** 2 + CLOCK_SIGMA_S**2)
    mean_offset_s = float(weight @ offset_s[estimated] / weight.sum())
    mean_sigma_s = float(weight.sum() ** -0.5)
    if abs(mean_offset_s) < max(MIN_OFFSET_S, MIN_SIGNIFICANCE * mean_sigma_s):
        return ""
    direction = "late" if mean_offset_s > 0 else "early"
    return (
        f"the inclination logs of the last {np.count_nonzero(estimated)} scans are"
        f" {abs(mean_offset_s):.1f} s {direction} (± {mean_sigma_s:.1f} s), estimated from the ground:"
        " check the clock of the logger"
    )
