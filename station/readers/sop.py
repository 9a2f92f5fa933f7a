"""Transformation matrices between frames: SOP (scanner → project) and POP (project → geocentric)."""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import datetime
from fnmatch import fnmatchcase
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np

from station.errors import ConfigError, ScanError
from station.quantities import Floats
from station.readers.regular_file import read_text
from station.scan_names import composed
from station.sections.inputs import SopSection

ROTATION_TOLERANCE = 1e-6  # moves a point 1,000 km away by 1 m; files with nine digits reach 1e-9
MAX_CORRECTABLE = 1e-4  # a few digits lost in writing; beyond that it is not a rotation
POSITION, QUATERNION = ("x", "y", "z"), ("qw", "qx", "qy", "qz")
ANGLES = ("roll_deg", "pitch_deg", "yaw_deg")
NAMED = re.compile(r"\"?([a-z][a-z_]*)\"?\s*[=:]\s*(\S+?)\s*[,}]*")
DECIMAL_COMMA = re.compile(r"[-+]?\d*(,\d*)?([eE][-+]?\d+)?")
MAX_NAMED_LINE = 200  # characters of a line with a name and a number
MAX_COORDINATE_M = 1e8  # from the origin of any frame or map; the earth's radius is 6.4e6


def read_matrix(path: Path) -> Floats:
    """Read a rotation and a translation [m] as a matrix (4, 4), `#` comments.

    They are sixteen numbers row by row, in any lines and with decimal points or commas, also in the element
    `matrix` of XML; or named values: x, y, z [m] with qw, qx, qy, qz, or with roll_deg, pitch_deg, yaw_deg
    about x, y and z, applied in this order. A rotation that deviates by at most 1e-4 is replaced by the
    nearest orthonormal one. Raises ConfigError, with the reason, for anything else that is not a rotation.
    """
    try:
        text = read_text(path)
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from error
    if text.lstrip().startswith("<"):
        text = _xml_matrix(text, path)
    lines = [line.split("#")[0].strip() for line in text.splitlines()]
    return checked_matrix("\n".join(line for line in lines if line), path)


def checked_matrix(text: str, path: Path) -> Floats:
    """Return the matrix (4, 4) that a text without comments holds; raises as `read_matrix`."""
    try:
        named = _named_values(text)
        matrix = _matrix_of(named, path) if named else _sixteen_numbers(text, path)
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


def _xml_matrix(text: str, path: Path) -> str:
    """Return the numbers of the only element `matrix` of an XML document."""
    try:
        matrices = list(ET.fromstring(text).iter("matrix"))  # noqa: S314 - expat limits expansion
    except ET.ParseError as error:
        raise ConfigError(f"{path}: not valid XML: {error}") from error
    if len(matrices) != 1:
        advice = ": station import riscan reads whole projects" if matrices else ""
        raise ConfigError(f"{path}: has {len(matrices)} elements named matrix, needs one{advice}")
    return matrices[0].text or ""


def _named_values(text: str) -> dict[str, float]:
    """Return the numbers of lines such as `roll_deg = 1.5`; empty if they are not named."""
    lines = (line.lower() for line in text.splitlines() if len(line) <= MAX_NAMED_LINE)
    pairs = [NAMED.fullmatch(line) for line in lines]
    return {pair[1]: float(pair[2].replace(",", ".")) for pair in pairs if pair}


def _matrix_of(named: dict[str, float], path: Path) -> Floats:
    """Return the matrix of a position and a quaternion or three angles."""
    kind = QUATERNION if "qw" in named else ANGLES
    missing = [name for name in (*POSITION, *kind) if name not in named]
    if missing or len(named) != len(POSITION) + len(kind):
        raise ConfigError(
            f"{path}: needs {', '.join(POSITION)} and {', '.join(QUATERNION)} or {', '.join(ANGLES)};"
            f" has {', '.join(named)}"
        )
    values = np.array([named[name] for name in kind])
    matrix = np.eye(4)
    matrix[:3, 3] = [named[name] for name in POSITION]
    if kind is ANGLES:
        matrix[:3, :3] = _rotation_of_angles(*np.radians(values))
        return matrix
    length = float(np.linalg.norm(values))
    if abs(length - 1.0) > MAX_CORRECTABLE:
        raise ConfigError(f"{path}: the quaternion has a length of {length:.6g}, not 1")
    matrix[:3, :3] = _rotation_of_quaternion(values / length)
    return matrix


def _rotation_of_angles(roll_rad: float, pitch_rad: float, yaw_rad: float) -> Floats:
    """Return the rotation about x, then y, then z (3, 3)."""
    (sx, sy, sz), (cx, cy, cz) = (function([roll_rad, pitch_rad, yaw_rad]) for function in (np.sin, np.cos))
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    about_z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    return np.asarray(about_z @ about_y @ about_x)


def _rotation_of_quaternion(q: Floats) -> Floats:
    """Return the rotation (3, 3) of a unit quaternion w, x, y, z (4,)."""
    w, vector = q[0], q[1:]
    x, y, z = vector
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + 2 * w * cross + 2 * cross @ cross)


def _sixteen_numbers(text: str, path: Path) -> Floats:
    """Return the matrix of sixteen numbers in lines."""
    rows = [_numbers(line) for line in text.splitlines()]
    if [len(row) for row in rows] not in ([4, 4, 4, 4], [16]):
        raise ConfigError(
            f"{path}: needs 4 rows of 4 numbers, or 16 in one line, has rows of"
            f" {[len(row) for row in rows][:20]}"
        )
    return np.array(rows, dtype=np.float64).reshape(4, 4)


def _numbers(line: str) -> list[str]:
    """Return the numbers of a line; a comma is that of decimals if other separators are between them."""
    words = line.replace(";", " ").split()
    if len(words) in {4, 16} and all(DECIMAL_COMMA.fullmatch(word) for word in words):
        return [word.replace(",", ".") for word in words]
    return line.replace(",", " ").replace(";", " ").split()


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


def sops_of_file(sops: Sequence[SopSection], name: str) -> list[SopSection]:
    """Return the SOPs for a file of a scan: those whose pattern it matches, else those without one."""
    own = [sop for sop in sops if sop.files is not None and fnmatchcase(composed(name), composed(sop.files))]
    return own or [sop for sop in sops if sop.files is None]


def valid_sop(sops: Sequence[SopSection], time_utc: datetime, name: str = "") -> SopSection | None:
    """Return the SOP valid at a time: the latest that has begun; None if there are none at all.

    With scan positions it is that for the file `name`; without a name, that of the position listed first.
    Raises ScanError if none has begun.
    """
    if not sops:
        return None
    started = [sop for sop in sops if sop.from_ <= time_utc]
    if not started:
        raise ScanError(f"no [[sop]] of the site file has begun by {time_utc:%Y-%m-%d %H:%M:%S} UTC")
    if name:
        started = sops_of_file(started, name)
        if not started:
            raise ScanError(f"no [[sop]] of the site file is for {name}: see sop.files")
    else:
        started = [sop for sop in started if sop.files == started[0].files]
    return max(started, key=lambda sop: sop.from_)
