"""Texts of the page, one file for each language, and how numbers and times are written."""

from __future__ import annotations

import json
import math
from datetime import UTC, datetime
from typing import get_args

from station.products.maps import ASSETS
from station.sections.results import ProductsSection

MISSING = "–"
LANGUAGES: tuple[str, ...] = get_args(ProductsSection.model_fields["language"].annotation)


def _read(name: str) -> dict[str, str]:
    path = ASSETS / name
    texts: dict[str, str] = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    return texts


PAGE_TEXT = {language: _read(f"page.{language}.json") for language in LANGUAGES}
VIEWER_TEXT = {language: _read("text.en.json") | _read(f"text.{language}.json") for language in LANGUAGES}


def script_text(language: str) -> dict[str, str]:
    """Return the texts that the scripts of the page need, by key."""
    own = {key: text for key, text in PAGE_TEXT[language].items() if key.startswith("js_")}
    return VIEWER_TEXT[language] | own


def format_number(value: float | None, digits: int, sign: bool = False) -> str:  # noqa: FBT001, FBT002 - a filter
    """Return a number with a true minus sign and thin spaces, never a negative zero; – if it is missing."""
    if value is None or not math.isfinite(value):
        return MISSING
    return f"{value:{'+' if sign else ''}z,.{digits}f}".replace("-", "−").replace(",", "\u202f")


def format_utc(time_s: float) -> str:
    """Return a time (UTC) to the minute."""
    return f"{datetime.fromtimestamp(time_s, UTC):%Y-%m-%d %H:%M}"
