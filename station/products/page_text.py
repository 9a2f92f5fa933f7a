"""Texts and numbers of the page."""

from __future__ import annotations

import math
from datetime import UTC, datetime

MISSING = "–"


def format_number(value: float | None, digits: int, sign: bool = False) -> str:  # noqa: FBT001, FBT002 - a filter
    """Return a number with a true minus sign and thin spaces, never a negative zero; – if it is missing."""
    if value is None or not math.isfinite(value):
        return MISSING
    return f"{value:{'+' if sign else ''}z,.{digits}f}".replace("-", "−").replace(",", "\u202f")


def format_utc(time_s: float) -> str:
    """Return a time (UTC) to the minute."""
    return f"{datetime.fromtimestamp(time_s, UTC):%Y-%m-%d %H:%M}"
