"""Matrices that lead from frame to frame: SOP (scanner → project) and POP (project → geocentric)."""

from __future__ import annotations

from collections.abc import Iterable
from datetime import datetime
from pathlib import Path

import numpy as np

from station.errors import ConfigError, ScanError
from station.quantities import Floats
from station.sections import SopSection

EXACT = 1e-6  # shifts 1 m at 1,000 km; files with nine digits reach 1e-9
MENDABLE = 1e-4  # a few digits lost in writing; beyond that it is no rotation
FARTHEST_M = 1e8  # from the origin of any frame or map; the earth's radius is 6.4e6


def read_matrix(path: Path) -> Floats:
    """Read a rotation and a translation [m] as a matrix (4, 4): four rows of four numbers, `#` comments.

    A rotation off by at most 1e-4 is made orthonormal (the nearest one); raises ConfigError for anything else
    that is not one, saying what it is.
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
        raise ConfigError(f"{path}: holds a value that is not a finite number")
    if not np.array_equal(matrix[3], (0.0, 0.0, 0.0, 1.0)):
        transposed = np.array_equal(matrix[:, 3], (0.0, 0.0, 0.0, 1.0))
        raise ConfigError(
            f"{path}: the last row must be 0 0 0 1, is {matrix[3].tolist()}"
            + ("; the matrix is transposed: write its columns as rows" if transposed else "")
        )
    if (np.abs(matrix) > FARTHEST_M).any():
        raise ConfigError(f"{path}: holds {np.abs(matrix).max():g}: metres, beyond any map")
    matrix[:3, :3] = _rotation(matrix[:3, :3], path)
    return matrix


def _rotation(given: Floats, path: Path) -> Floats:
    """Return a matrix (3, 3) that is a rotation to 1e-6, or raise ConfigError."""
    off = float(np.abs(given @ given.T - np.eye(3)).max())
    if np.linalg.det(given) < 0:
        raise ConfigError(f"{path}: mirrors (determinant {np.linalg.det(given):.3f}): two axes are swapped")
    if off <= EXACT:
        return given
    left, scale, right = np.linalg.svd(given)
    if off > MENDABLE:
        uniform = np.ptp(scale) <= MENDABLE * scale[0]
        raise ConfigError(
            f"{path}: not a rotation, off by {off:.2g}"
            + (f": it also scales by {scale[0]:.6g}" if uniform else ": its rows are not at right angles")
        )
    return np.asarray(left @ right)


def sop_for(sops: Iterable[SopSection], when: datetime) -> SopSection:
    """Return the SOP in force: the newest that has begun; raises ScanError where none has."""
    begun = [sop for sop in sops if sop.from_ <= when]
    if not begun:
        raise ScanError(f"no [[sop]] of the site file has begun by {when:%Y-%m-%d %H:%M:%S} UTC")
    return max(begun, key=lambda sop: sop.from_)
