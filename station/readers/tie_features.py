"""Tie features of a registration (points and planes), from a CSV table."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from station.errors import ConfigError
from station.science.geometry.registration import Features

SCAN_COLUMNS = ("x", "y", "z")
REFERENCE_COLUMNS = ("ref_x", "ref_y", "ref_z")
NORMAL_COLUMNS = ("normal_x", "normal_y", "normal_z")
REQUIRED_COLUMNS = (*SCAN_COLUMNS, *REFERENCE_COLUMNS, "sigma")
KNOWN_COLUMNS = {"name", *REQUIRED_COLUMNS, *NORMAL_COLUMNS}


def read_tie_features(path: Path) -> Features:
    """Read a CSV table of tie features: x y z in the scan, ref_x ref_y ref_z outside, sigma [m], name.

    With normal_x normal_y normal_z (any length) the point of the scan lies on the plane through the reference
    point perpendicular to that normal; without, it is the reference point. `#` begins a comment. Raises
    ConfigError, with the line number, if a value is missing or not a number.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from error
    lines = [
        (line_number, line)
        for line_number, line in enumerate(
            (raw_line.split("#")[0] for raw_line in text.splitlines()), start=1
        )
        if line.strip(" ,\t")
    ]
    rows = list(csv.reader((line for _, line in lines), skipinitialspace=True))
    header = [name.strip().lower() for name in rows[0]] if rows else []
    missing, unknown = (
        [name for name in REQUIRED_COLUMNS if name not in header],
        [column for column in header if column not in KNOWN_COLUMNS],
    )
    if missing or unknown:
        raise ConfigError(
            f"{path}: the first line must name the columns: missing {', '.join(missing) or 'none'};"
            f" unknown {', '.join(unknown) or 'none'}; name and {', '.join(NORMAL_COLUMNS)} are optional"
        )
    parsed = [
        _parse_feature(f"{path}: line {line_number}", dict(zip(header, row, strict=False)), index)
        for index, ((line_number, _), row) in enumerate(zip(lines[1:], rows[1:], strict=True), start=1)
    ]
    if not parsed:
        raise ConfigError(f"{path}: contains no feature")
    values = np.array([values for _, values in parsed])
    return Features(
        tuple(name for name, _ in parsed), values[:, :3], values[:, 3:6], values[:, 6:9], values[:, 9]
    )


def _parse_feature(location: str, row: dict[str, str], index: int) -> tuple[str, list[float]]:
    """Return the name of a feature and its ten numbers: point, reference, unit normal, sigma [m]."""
    name = row.get("name", "").strip() or f"feature_{index}"
    scan, reference = (
        [_parse_number(location, row, key) for key in keys] for keys in (SCAN_COLUMNS, REFERENCE_COLUMNS)
    )
    normal_fields = [row.get(key, "").strip() for key in NORMAL_COLUMNS]
    normal = (
        np.zeros(3)
        if not any(normal_fields)
        else np.array([_parse_number(location, row, key) for key in NORMAL_COLUMNS])
    )
    length = float(np.linalg.norm(normal))
    if any(normal_fields) and length == 0:
        raise ConfigError(f"{location} ({name}): the normal has length zero: leave it empty for a point")
    sigma_m = _parse_number(location, row, "sigma")
    if sigma_m <= 0:
        raise ConfigError(f"{location} ({name}): sigma must be positive, is {sigma_m:g}")
    return name, [*scan, *reference, *(normal / (length or 1.0)), sigma_m]


def _parse_number(location: str, row: dict[str, str], key: str) -> float:
    try:
        value = float(row.get(key, ""))
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise ConfigError(f"{location}: {key} is {row.get(key, '')!r}, not a number")
    return value
