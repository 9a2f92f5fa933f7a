"""Texts of the page, one file for each language, and how numbers and times are written."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
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
_PLANE_TEXT = {language: _read(f"plane.{language}.json") for language in LANGUAGES}


@dataclass(frozen=True)
class PageText:
    """Texts of a page by key: of the page itself, and of the map in it."""

    page: dict[str, str]
    viewer: dict[str, str]

    @classmethod
    def of(cls, language: str, *, on_map: bool) -> PageText:
        """Return the texts in a language, in other words where the grid does not lie on the map."""
        texts, others = (PAGE_TEXT[language], VIEWER_TEXT[language]), _PLANE_TEXT[language]
        if on_map:
            return cls(*texts)
        page, viewer = ({key: others.get(key, text) for key, text in own.items()} for own in texts)
        return cls(page, viewer)

    @property
    def script(self) -> dict[str, str]:
        """The texts that the scripts of the page need."""
        return self.viewer | {key: text for key, text in self.page.items() if key.startswith("js_")}


def format_number(value: float | None, digits: int, sign: bool = False) -> str:  # noqa: FBT001, FBT002 - a filter
    """Return a number with a true minus sign and thin spaces, never a negative zero; – if it is missing."""
    if value is None or not math.isfinite(value):
        return MISSING
    return f"{value:{'+' if sign else ''}z,.{digits}f}".replace("-", "−").replace(",", "\u202f")


def format_utc(time_s: float) -> str:
    """Return a time (UTC) to the minute."""
    return f"{datetime.fromtimestamp(time_s, UTC):%Y-%m-%d %H:%M}"
