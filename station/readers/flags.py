"""Time intervals flagged by a person as unusable: a CSV file that may grow while the service runs."""

from __future__ import annotations

import csv
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

from station.errors import ConfigError
from station.readers.regular_file import read_text
from station.readers.scan import decoder_errors

COLUMNS = ["from", "to", "reason"]


class Flag(NamedTuple):
    """A time interval whose epochs must not be used, and the reason."""

    from_utc_s: float
    to_utc_s: float
    reason: str


def read_flags(path: Path) -> list[Flag]:
    """Read rows `from,to,reason` in file order: ISO times, UTC unless a zone is given.

    Raises ConfigError, with the line number, for an invalid row, unless it is the last one and still being
    written; NotReadyError if the disk fails or access is denied.
    """
    with decoder_errors(f"{path.name} cannot be read"):
        text = read_text(path)
    lines = text.splitlines()
    if lines and [name.strip() for name in lines[0].split(",")] != COLUMNS:
        raise ConfigError(f"{path}: must begin with the line {','.join(COLUMNS)}")
    flags = []
    for line_number, row in enumerate(csv.reader(lines[1:]), start=2):
        if not any(field.strip() for field in row) or row[0].lstrip().startswith("#"):
            continue
        try:
            flags.append(_parse_flag(path, line_number, row))
        except ConfigError:
            if line_number < len(lines) or text.endswith("\n"):
                raise
    return flags


def reasons_for(flags: list[Flag], start_utc_s: float, end_utc_s: float) -> str:
    """Return the reasons of the flags that overlap a scan, joined by semicolons; '' if there are none."""
    reasons = [flag.reason for flag in flags if flag.from_utc_s <= end_utc_s and start_utc_s <= flag.to_utc_s]
    return "; ".join(dict.fromkeys(reasons))


def _parse_flag(path: Path, line_number: int, row: list[str]) -> Flag:
    try:
        start, end, reason = (field.strip() for field in row)
        flag = Flag(_utc_s(start), _utc_s(end), reason)
    except (ValueError, OverflowError) as error:
        raise ConfigError(f"{path}: line {line_number}: not a row {','.join(COLUMNS)}: {error}") from error
    if flag.to_utc_s < flag.from_utc_s or not reason:
        raise ConfigError(
            f"{path}: line {line_number}: " + ("ends before it begins" if reason else "no reason")
        )
    return flag


def _utc_s(text: str) -> float:
    time = datetime.fromisoformat(text)
    return (time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp()
