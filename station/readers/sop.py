"""Transformation matrices between frames: SOP (scanner → project) and POP (project → geocentric)."""

from __future__ import annotations

from collections.abc import Iterable
from datetime import datetime
from pathlib import Path

import numpy as np

from station.errors import ConfigError, ScanError
from station.quantities import Floats
from station.sections import SopSection

ROTATION_TOLERANCE = 1e-6  # moves a point 1,000 km away by 1 m; files with nine digits reach 1e-9
MAX_CORRECTABLE = 1e-4  # a few digits lost in writing; beyond that it is not a rotation
MAX_COORDINATE_M = 1e8  # from the origin of any frame or map; the earth's radius is 6.4e6


def read_matrix(path: Path) -> Floats:
    """Read a rotation and a translation [m] as a matrix (4, 4): four rows of four numbers, `#` comments.

    A rotation that deviates by at most 1e-4 is replaced by the nearest orthonormal one. Raises ConfigError,
    with the reason, for anything else that is not a rotation.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from error
    lines = [line.split("#")[0].replace(",", " ").split() for line in text.splitlines()]
    rows = [line for line in lines if line]
    if [len(row) for row in rows] != [4, 4, 4, 4]:
        raise ConfigError(f"{path}: needs 4 rows of 4 numbers, has rows of {[len(row) for row in rows][:20]}")
    try:
        matrix = np.array(rows, dtype=np.float64)
    except ValueError as error:
        raise ConfigError(f"{path}: {error}") from error
    if not np.isfinite(matrix).all():
        raise ConfigError(f"{path}: contains a value that is not a finite number")
    if not np.array_equal(matrix[3], (0.0, 0.0, 0.0, 1.0)):
        transposed = np.array_equal(matrix[:, 3], (0.0, 0.0, 0.0, 1.0))
        raise ConfigError(
            f"{path}: the last row must be 0 0 0 1, is {matrix[3].tolist()}"
            + ("; the matrix is transposed: write its columns as rows" if transposed else "")
        )
    if (np.abs(matrix) > MAX_COORDINATE_M).any():
        raise ConfigError(f"{path}: contains {np.abs(matrix).max():g} m, beyond any map")
    matrix[:3, :3] = _orthonormal_rotation(matrix[:3, :3], path)
    return matrix


def _orthonormal_rotation(rotation: Floats, path: Path) -> Floats:
    """Return a rotation matrix (3, 3), orthonormal to 1e-6; raise ConfigError if it cannot be one."""
    deviation = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if np.linalg.det(rotation) < 0:
        raise ConfigError(
            f"{path}: is a reflection (determinant {np.linalg.det(rotation):.3f}): two axes are swapped"
        )
    if deviation <= ROTATION_TOLERANCE:
        return rotation
    u, scale, vt = np.linalg.svd(rotation)
    if deviation > MAX_CORRECTABLE:
        uniform = np.ptp(scale) <= MAX_CORRECTABLE * scale[0]
        raise ConfigError(
            f"{path}: not a rotation, off by {deviation:.2g}"
            + (f": it also scales by {scale[0]:.6g}" if uniform else ": its rows are not at right angles")
        )
    return np.asarray(u @ vt)


def valid_sop(sops: Iterable[SopSection], time_utc: datetime) -> SopSection:
    """Return the SOP valid at a time: the latest that has begun; raise ScanError if none has."""
    started = [sop for sop in sops if sop.from_ <= time_utc]
    if not started:
        raise ScanError(f"no [[sop]] of the site file has begun by {time_utc:%Y-%m-%d %H:%M:%S} UTC")
    return max(started, key=lambda sop: sop.from_)
