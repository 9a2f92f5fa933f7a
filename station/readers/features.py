"""Points and planes that a registration holds on to, from a table."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from station.errors import ConfigError
from station.science.registration import Features

SCAN = ("x", "y", "z")
REFERENCE = ("ref_x", "ref_y", "ref_z")
NORMAL = ("normal_x", "normal_y", "normal_z")
NEEDED = (*SCAN, *REFERENCE, "sigma")
KNOWN = {"name", *NEEDED, *NORMAL}


def read_features(path: Path) -> Features:
    """Read a CSV table of features: x y z in the scan, ref_x ref_y ref_z outside, sigma [m], a name.

    With normal_x normal_y normal_z (any length) a row says that the scan's point lies on the plane through
    the reference across that normal; without, that it is the reference. `#` begins a comment. Raises
    ConfigError with the line where something is missing or no number.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from error
    lines = [
        (number, line)
        for number, line in enumerate((one.split("#")[0] for one in text.splitlines()), start=1)
        if line.strip(" ,\t")
    ]
    rows = list(csv.reader((line for _, line in lines), skipinitialspace=True))
    head = [name.strip().lower() for name in rows[0]] if rows else []
    lacking, strange = [name for name in NEEDED if name not in head], [n for n in head if n not in KNOWN]
    if lacking or strange:
        raise ConfigError(
            f"{path}: the first line names the columns: lacking {', '.join(lacking) or 'none'};"
            f" not known {', '.join(strange) or 'none'}; name and {', '.join(NORMAL)} are optional"
        )
    found = [
        _feature(f"{path}: line {number}", dict(zip(head, row, strict=False)), index)
        for index, ((number, _), row) in enumerate(zip(lines[1:], rows[1:], strict=True), start=1)
    ]
    if not found:
        raise ConfigError(f"{path}: holds no feature")
    values = np.array([values for _, values in found])
    return Features(
        tuple(name for name, _ in found), values[:, :3], values[:, 3:6], values[:, 6:9], values[:, 9]
    )


def _feature(where: str, row: dict[str, str], index: int) -> tuple[str, list[float]]:
    """Return the name of a row and its ten numbers."""
    name = row.get("name", "").strip() or f"feature_{index}"
    scan, reference = ([_number(where, row, key) for key in keys] for keys in (SCAN, REFERENCE))
    told = [row.get(key, "").strip() for key in NORMAL]
    normal = np.zeros(3) if not any(told) else np.array([_number(where, row, key) for key in NORMAL])
    length = float(np.linalg.norm(normal))
    if any(told) and length == 0:
        raise ConfigError(f"{where} ({name}): the normal has no length: leave it empty for a point")
    sigma_m = _number(where, row, "sigma")
    if sigma_m <= 0:
        raise ConfigError(f"{where} ({name}): sigma must be more than 0, is {sigma_m:g}")
    return name, [*scan, *reference, *(normal / (length or 1.0)), sigma_m]


def _number(where: str, row: dict[str, str], key: str) -> float:
    try:
        value = float(row.get(key, ""))
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise ConfigError(f"{where}: {key} is {row.get(key, '')!r}, no number")
    return value
