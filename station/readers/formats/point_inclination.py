"""The inclination log that the points of a scan carry: PDAL writes roll and pitch of RXP with each point.

The sensor is read about once a second, and its last reading stands with all points until the next one.
Source: PDAL, plugins/rxp/io/RxpPointcloud.cpp (on_hk_incl: degrees).
"""

from __future__ import annotations

import re
from math import pi

import numpy as np

from station.quantities import Floats, InclinationLog

AXES = ("roll", "pitch")
ROW_STEP_S = 0.1  # at most one row in each: readings are a second apart
UNITS = {"deg": pi / 180, "°": pi / 180, "mdeg": pi / 180e3, "rad": 1.0, "mrad": 1e-3}  # factors to radians
_UNIT = re.compile(r"(?<![a-z])(mdeg|deg|mrad|rad|°)")


def tilt_field(name: str, description: str = "") -> tuple[str, float] | None:
    """Return which of AXES a field of points holds, and the factor to radians; None for other fields.

    The unit stands behind the name, else in the description, else it is degrees.
    """
    plain = name.strip(" \"'/#\0\r\n").lower().removeprefix("scalar_")
    axis = next((axis for axis in AXES if re.fullmatch(rf"{axis}([\s_(\[].*)?", plain)), None)
    if axis is None:
        return None
    rest = plain.removeprefix(axis).strip(" _()[]")
    unit = _UNIT.search(rest or description.lower())
    if rest and unit is None:  # such as roll_rate
        return None
    return axis, UNITS[unit[1]] if unit else UNITS["deg"]


class PointInclination:
    """Collects roll and pitch of points into a log: a row when they change, at most one each 0.1 s.

    While nothing changes there is no row, so that a sensor that stopped leaves a gap as in a log file.
    """

    def __init__(self) -> None:
        self._rows = np.empty((3, 0))

    def add(self, time_s: Floats, roll_rad: Floats, pitch_rad: Floats) -> None:
        """Add the times [s], roll and pitch [rad] of points (n,), in any order."""
        rows = np.hstack([self._rows, np.stack([time_s, roll_rad, pitch_rad])])
        rows = rows[:, np.argsort(rows[0], kind="stable")]
        _, first = np.unique(np.floor(rows[0] / ROW_STEP_S), return_index=True)
        self._rows = rows[:, first]

    def log(self) -> InclinationLog | None:
        """Return the log, uncleaned; None if there are no points."""
        rows = self._rows
        if not rows.size:
            return None
        changes = np.any(rows[1:, 1:] != rows[1:, :-1], axis=0)
        time_s, roll_rad, pitch_rad = rows[:, np.concatenate([[True], changes])]
        return InclinationLog(time_s, roll_rad, pitch_rad)
