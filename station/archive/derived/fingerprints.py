"""Fingerprints of files derived from the epochs: `areas.nc`, `boxes.nc`, `daily.nc`, `events.geojson`.

A derived file that differs from what was written, by a single bit, is not opened but built again.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from station.archive.atomic_files import atomic_write
from station.archive.checksums import fingerprint, matches_fingerprint, read_checked_json, to_checked_json


def is_intact(path: Path) -> bool:
    """Return True if a derived file is as it was written."""
    expected = read_checked_json(fingerprints_path(path))
    return bool(expected) and any(matches_fingerprint(path, known) for known in expected)


def write_fingerprints(path: Path, tmp_path: Path) -> None:
    """Record the fingerprint of the new file and, because the process may be killed, that of the old one."""
    known = [fingerprint(tmp_path)]
    with suppress(OSError):
        known.append(fingerprint(path))
    with atomic_write(fingerprints_path(path)) as tmp_json:
        tmp_json.write_text(to_checked_json(known), encoding="ascii")


def fingerprints_path(path: Path) -> Path:
    """Return the file of the fingerprints of a derived file."""
    return path.with_name(f".{path.stem}.json")
