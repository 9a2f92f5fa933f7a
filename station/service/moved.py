"""Whether the scanner was moved, as the stored series shows: news for a person, not for the epochs.

Each epoch is adjusted to the ground anyhow, so that its change stays right.
"""

from __future__ import annotations

from datetime import UTC, datetime

import h5py
import numpy as np

from station.archive.layout import Series, strings
from station.archive.reference import read_habits
from station.archive.variables import VERDICTS
from station.config import Site
from station.errors import StoreError
from station.quantities import Bools, Floats
from station.science.motion import Step, steps, usual
from station.science.shared import GLOBAL
from station.service.tasks import series_of

LOOKED_AT = 200  # newest scans of the series
SAME_SCANS = 3  # by which the place of a step may differ when one scan more or less is there to tell
CLEAR_SIGMAS = 3.0  # of a part of the pose that is worth a word
POSE = tuple(name for name, _ in GLOBAL[:6])


def moved(site: Site) -> str:
    """Say how the scanner was last moved, as far as the newest scans show; nothing if it was not.

    Only scans adjusted under one SOP are compared: another one is another pose. Raises StoreError where the
    series cannot be read.
    """
    return moved_by(site, None)[0]


def moved_by(site: Site, start_utc_s: float | None) -> tuple[str, str]:
    """Say how the scanner was last moved, and again if it is the scan of this start that shows it.

    Raises StoreError where the series cannot be read.
    """
    series = series_of(site)
    start_s, pose = _poses(series)
    habit = usual(read_habits(series))
    found = steps(start_s, pose, habit)
    if not found:
        return "", ""
    last = _words(found[-1], start_s)
    if start_utc_s not in start_s:
        return last, ""
    if start_utc_s == start_s[-1]:  # what was told before it came does not depend on it
        known_s = [start_s[step.last_before] for step in found if step.told_at < len(start_s) - 1]
    else:
        others = start_s != start_utc_s
        known = steps(start_s[others], pose[others], habit)
        known_s = [start_s[others][step.last_before] for step in known]
    near_s = SAME_SCANS * float(np.median(np.diff(start_s)))
    when_s = start_s[found[-1].last_before]
    return last, "" if any(abs(when_s - one) <= near_s for one in known_s) else last


def _poses(series: Series) -> tuple[Floats, Floats]:
    """Read start (n,) and pose (n, 6) of the newest scans that are comparable."""
    try:
        with h5py.File(series.path, "r") as file:
            if "shared_parameter" not in file:
                return np.empty(0), np.empty((0, len(POSE)))
            rows = slice(-LOOKED_AT, None)
            names = strings(file["parameter_name"][:])
            place = [names.index(name) for name in POSE]
            pose = np.asarray(file["shared_parameter"][rows], dtype=np.float64)[:, place]
            start_s = np.asarray(file["time_bnds"][rows, 0], dtype=np.float64)
            adjustment, sop = (np.array(strings(file[name][rows])) for name in ("adjustment", "sop_id"))
            chosen: Bools = (adjustment == "joint") & (file["verdict"][rows] != VERDICTS.index("unusable"))
    except (OSError, RuntimeError, IndexError, ValueError) as error:
        raise StoreError(f"{series.path}: cannot be read: {error}") from error
    chosen &= np.all(np.abs(pose) < 1e3, axis=1)  # netCDF's fill is not
    if chosen.any():
        chosen &= sop == sop[chosen][-1]
    return start_s[chosen], pose[chosen]


def _words(step: Step, start_s: Floats) -> str:
    before, after = (
        f"{datetime.fromtimestamp(start_s[index], UTC):%Y-%m-%d %H:%M}"
        for index in (step.last_before, step.last_before + 1)
    )
    parts = [
        f"{verb} by {np.linalg.norm(step.size[place]) * scale:.3g} {unit}"
        for verb, place, scale, unit in (
            ("tilted", slice(0, 2), np.degrees(1.0), "degree"),
            ("turned", slice(2, 3), np.degrees(1.0), "degree"),
            ("shifted", slice(3, 6), 1000.0, "mm"),
        )
        if np.max(np.abs(step.size[place]) / step.sigma[place]) > CLEAR_SIGMAS
    ]
    return (
        f"scanner {', '.join(parts)} between {before} and {after} UTC ({step.sigmas:.0f} sigma):"
        " look at the mount; make a new SOP if it stays"
    )
