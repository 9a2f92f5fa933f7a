"""Steps of the scanner's pose in the stored series: a warning for the operator.

Stored changes stay right, because each epoch is adjusted to the ground.
"""

from __future__ import annotations

from datetime import UTC, datetime

import h5py
import numpy as np

from station.archive.netcdf_layout import Series, decode_text
from station.archive.read_errors import read_errors
from station.archive.reference_files import read_variance_components
from station.archive.schema import VERDICTS
from station.archive.series.index import processing_file
from station.config import Site
from station.processing.site_files import series_for
from station.quantities import Bools, Floats
from station.science.analysis.pose_steps import Step, detect_steps, pose_sigma
from station.science.uncertainty.parameters import GLOBAL

MAX_SCANS = 200  # newest of the series
SAME_STEP_SCANS = 3  # by which one scan more or less may shift the position of a step
MIN_COMPONENT_SIGMAS = 3.0  # above which a component of the pose is reported
POSE_PARAMETERS = tuple(name for name, _ in GLOBAL[:6])


def latest_step(site: Site) -> str:
    """Return a message on the latest step of the scanner's pose in the newest scans; "" without a step.

    Only scans adjusted under the same SOP are compared: another SOP means another pose. Raises StoreError if
    the series cannot be read.
    """
    return step_shown_by(site, None)[0]


def step_shown_by(site: Site, start_utc_s: float | None) -> tuple[str, str]:
    """Return messages on the latest step of the pose, and on the step revealed by the scan of this start.

    Either is "" without such a step. Raises StoreError if the series cannot be read.
    """
    series = series_for(site)
    start_s, pose = _read_poses(series)
    sigma = pose_sigma(read_variance_components(series))
    detected = detect_steps(start_s, pose, sigma)
    if not detected:
        return "", ""
    message = _describe_step(detected[-1], start_s)
    if start_utc_s not in start_s:
        return message, ""
    if start_utc_s == start_s[-1]:  # steps detected before the newest scan do not depend on it
        earlier_s = [start_s[step.last_before] for step in detected if step.detected_at < len(start_s) - 1]
    else:
        is_other = start_s != start_utc_s
        earlier_steps = detect_steps(start_s[is_other], pose[is_other], sigma)
        earlier_s = [start_s[is_other][step.last_before] for step in earlier_steps]
    tolerance_s = SAME_STEP_SCANS * float(np.median(np.diff(start_s)))
    step_s = start_s[detected[-1].last_before]
    return message, "" if any(abs(step_s - other_s) <= tolerance_s for other_s in earlier_s) else message


def _read_poses(series: Series) -> tuple[Floats, Floats]:
    """Return start [s] (n,) and pose (n, 6) of the newest comparable scans."""
    path = processing_file(series)
    with read_errors(path), h5py.File(path, "r") as file:
        if "shared_parameter" not in file:
            return np.empty(0), np.empty((0, len(POSE_PARAMETERS)))
        rows = slice(-MAX_SCANS, None)
        names = decode_text(file["parameter_name"][:])
        columns = [names.index(name) for name in POSE_PARAMETERS]
        pose = np.asarray(file["shared_parameter"][rows], dtype=np.float64)[:, columns]
        start_s = np.asarray(file["time_bnds"][rows, 0], dtype=np.float64)
        adjustment, sop = (np.array(decode_text(file[name][rows])) for name in ("adjustment", "sop_id"))
        comparable: Bools = (adjustment == "joint") & (file["verdict"][rows] != VERDICTS.index("unusable"))
    comparable &= np.all(np.abs(pose) < 1e3, axis=1)  # excludes netCDF's fill value
    if comparable.any():
        comparable &= sop == sop[comparable][-1]
    return start_s[comparable], pose[comparable]


def _describe_step(step: Step, start_s: Floats) -> str:
    begin, end = (
        f"{datetime.fromtimestamp(start_s[index], UTC):%Y-%m-%d %H:%M}"
        for index in (step.last_before, step.last_before + 1)
    )
    parts = [
        f"{verb} by {np.linalg.norm(step.size[component]) * scale:.3g} {unit}"
        for verb, component, scale, unit in (
            ("tilted", slice(0, 2), np.degrees(1.0), "degree"),
            ("turned", slice(2, 3), np.degrees(1.0), "degree"),
            ("shifted", slice(3, 6), 1000.0, "mm"),
        )
        if np.max(np.abs(step.size[component]) / step.sigma[component]) > MIN_COMPONENT_SIGMAS
    ]
    return (
        f"scanner {', '.join(parts)} between {begin} and {end} UTC ({step.significance:.0f} sigma):"
        " check the mount; determine a new SOP if the step persists"
    )
