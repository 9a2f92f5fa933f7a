"""Names of scan files: the stem that scan, log and epoch share, and the start that the name states.

Scans may lie in folders below the inbox: their names then have as many `/` as the pattern of their names.
"""

from __future__ import annotations

import hashlib
import re
import unicodedata
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import PurePath
from typing import Literal
from zoneinfo import ZoneInfo

COMPRESSED = ".gz"
INNER_SUFFIXES = (".copc",)  # `x.copc.laz` is the scan `x`
# Digits of the fields of a pattern; any other field is at least one character.
FIELD_DIGITS = {"Y": 4, "m": 2, "d": 2, "H": 2, "I": 2, "M": 2, "S": 2, "y": 2, "j": 3}
ANY = "*"
ZONE_MARK = "@"  # separates the pattern from its time zone
SEPARATOR = "/"  # of folders
MAX_ID_BYTES = 64  # of the name of a scan in the store
HOURS, MINUTES = ("%H", "%I", "%T", "%X", "%c", "%s", "%f"), ("%M", "%T", "%X", "%c", "%s", "%f")


def scan_stem(name: str | PurePath) -> str:
    """Return the name of a scan without folder and suffixes, also of `x.laz.gz` and `x.copc.laz`."""
    base = str(name).rpartition(SEPARATOR)[2]
    if base.lower().endswith(COMPRESSED):
        base = base[: -len(COMPRESSED)]
    stem = (
        base.rpartition(".")[0] or base
    )  # by hand, ten times as fast as with paths: the page needs those of a year
    outer, _, inner = stem.rpartition(".")
    return outer if outer and f".{inner.lower()}" in INNER_SUFFIXES else stem


def composed(name: str) -> str:
    """Return a name with each letter and its accents as one character, as keyboards write it.

    Files from macOS may have them apart (NFD).
    """
    return name if name.isascii() else unicodedata.normalize("NFC", name)


def path_stem(name: str) -> str:
    """Return the name of a scan with its folders below the inbox, without suffixes."""
    folder, separator, _ = name.rpartition(SEPARATOR)
    return f"{folder}{separator}{scan_stem(name)}"


def scan_id(name: str) -> str:
    """Return the name of a scan in the store: with its folders, without suffixes, at most 64 bytes.

    Of a longer one it is the end, where the time usually is, after a hash of the whole.
    """
    stem = path_stem(name)
    content = stem.encode("utf-8", "replace")
    if len(content) <= MAX_ID_BYTES:
        return stem
    mark = hashlib.sha256(content).hexdigest()[:8] + "~"
    return mark + content[len(mark) - MAX_ID_BYTES :].decode("utf-8", "ignore")


def folder_depth(pattern: str) -> int:
    """Return how many folders below the inbox the scans lie, by the pattern of their names."""
    return pattern.partition(ZONE_MARK)[0].count(SEPARATOR)


def name_below(path: PurePath, pattern: str) -> str:
    """Return the name of a scan with as many of its folders as the pattern has."""
    return SEPARATOR.join(path.parts[-1 - folder_depth(pattern) :])


def resolution_s(pattern: str) -> float:
    """Return how exactly names by this pattern state the start of a scan [s]: 60, an hour, or a day."""
    pattern = pattern.partition(ZONE_MARK)[0]
    if any(field in pattern for field in MINUTES):
        return 60.0
    return 3600.0 if any(field in pattern for field in HOURS) else 86_400.0


@lru_cache(maxsize=1 << 16)
def start_in_name(name: str, pattern: str, *, fold: Literal[0, 1] = 0) -> datetime | None:
    """Return the start of a scan (UTC) that its name states; None if it does not match the pattern.

    The pattern is one of strptime, in which `*` stands for any characters of one name, also of the folders
    before a `/`. `@` and the name of a time zone may follow; of an hour that occurs twice, the first counts,
    with `fold` the second.
    """
    pattern, _, zone = composed(pattern).partition(ZONE_MARK)
    stem = composed(path_stem(name_below(PurePath(name), pattern)))
    if ANY in pattern:
        match = _expression(pattern).fullmatch(stem)
        if match is None:
            return None
        stem, pattern = "".join(match.groups()), pattern.replace(ANY, "")
    try:
        start = datetime.strptime(stem, pattern)  # noqa: DTZ007 - the pattern may contain a zone
    except ValueError:
        return None
    if start.tzinfo is None:
        start = start.replace(tzinfo=ZoneInfo(zone) if zone else UTC, fold=fold)
    return start.astimezone(UTC)


@lru_cache
def _expression(pattern: str) -> re.Pattern[str]:
    """Return the expression of a pattern with `*`; its groups are what is between the `*`."""
    parts = []
    for part in pattern.split(ANY):
        fields = re.findall(r"%.|[^%]+", part)
        parts.append("(" + "".join(_field_expression(field) for field in fields) + ")")
    return re.compile("[^/]*".join(parts))


def _field_expression(field: str) -> str:
    if not field.startswith("%"):
        return re.escape(field)
    digits = FIELD_DIGITS.get(field[1])
    return rf"\d{{{digits}}}" if digits else "%" if field == "%%" else "[^/]+"


@lru_cache(maxsize=1 << 16)
def epoch_name(start: datetime, pattern: str, window_s: int | None = None) -> str:
    """Return the name of the epoch to which a scan belongs: its start, in the zone of the pattern.

    With `window_s` it is the start of the window, counted from midnight, in which the scan began.
    """
    pattern, _, zone = pattern.partition(ZONE_MARK)
    local = start.astimezone(ZoneInfo(zone) if zone else UTC)
    if window_s is not None:
        second_of_day = local.hour * 3600 + local.minute * 60 + local.second
        hours, rest_s = divmod(second_of_day // window_s * window_s, 3600)
        local = local.replace(hour=hours, minute=rest_s // 60, second=rest_s % 60)
    return local.strftime(pattern)
