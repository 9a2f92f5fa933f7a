"""Bad intervals noted by a person: a CSV file that may grow while the service runs."""

from __future__ import annotations

import csv
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

from station.errors import ConfigError
from station.readers.scan import foreign_code

COLUMNS = ["from", "to", "reason"]


class Flag(NamedTuple):
    """An interval whose epochs are not to be used, and why."""

    from_utc_s: float
    to_utc_s: float
    reason: str


def read_flags(path: Path) -> list[Flag]:
    """Read rows `from,to,reason` in the order of the file: ISO times, UTC where no zone is written.

    Raises ConfigError for a row that is none, naming its line, but for a last one still being written;
    NotReadyError where the disk or its rights fail.
    """
    with foreign_code(f"{path.name} cannot be read"):
        text = path.read_text(encoding="utf-8-sig")
    lines = text.splitlines()
    if lines and [name.strip() for name in lines[0].split(",")] != COLUMNS:
        raise ConfigError(f"{path}: must begin with the line {','.join(COLUMNS)}")
    flags = []
    for number, row in enumerate(csv.reader(lines[1:]), start=2):
        if not any(field.strip() for field in row) or row[0].lstrip().startswith("#"):
            continue
        try:
            flags.append(_flag(path, number, row))
        except ConfigError:
            if number < len(lines) or text.endswith("\n"):
                raise
    return flags


def flag_on(flags: list[Flag], start_utc_s: float, end_utc_s: float) -> str:
    """Return the reasons of the flags that a scan overlaps, '' where none does."""
    found = [flag.reason for flag in flags if flag.from_utc_s <= end_utc_s and start_utc_s <= flag.to_utc_s]
    return "; ".join(dict.fromkeys(found))


def _flag(path: Path, number: int, row: list[str]) -> Flag:
    try:
        start, end, reason = (field.strip() for field in row)
        flag = Flag(_utc_s(start), _utc_s(end), reason)
    except (ValueError, OverflowError) as error:
        raise ConfigError(f"{path}: line {number}: not a row {','.join(COLUMNS)}: {error}") from error
    if flag.to_utc_s < flag.from_utc_s or not reason:
        raise ConfigError(f"{path}: line {number}: " + ("ends before it begins" if reason else "no reason"))
    return flag


def _utc_s(text: str) -> float:
    moment = datetime.fromisoformat(text)
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()
