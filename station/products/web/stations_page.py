"""The page of several stations: a row each with its lamp, newest map and newest alarm.

It is static: each station's page folder has a small script with its state, which is loaded when the page is
opened, so the page never has to be written again.
"""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from station.products.gallery import replace_if_changed
from station.products.maps import ASSETS
from station.products.page import environment
from station.products.web.page_text import PAGE_TEXT

SCRIPT = "stations.js"


@dataclass(frozen=True)
class StationRow:
    """A station on the page; `page` is the address of its page folder, with a slash at its end."""

    id: str
    name: str
    page: str


def write_stations(path: Path, stations: list[tuple[str, str, Path]], language: str) -> None:
    """Write the page of stations, given as id, name and page folder, with its script and style beside it.

    Raises StoreError if a file cannot be written.
    """
    here = path.resolve().parent
    entries = [
        StationRow(station_id, name, f"{quote(os.path.relpath(folder.resolve(), here))}/")
        for station_id, name, folder in stations
    ]
    html, script, style = render_stations(entries, language)
    for name, content in ((SCRIPT, script), ("page.css", style), (path.name, html)):
        replace_if_changed(here / name, content.encode())


def render_stations(entries: list[StationRow], language: str) -> tuple[str, str, str]:
    """Return the page of stations: HTML, script, style sheet."""
    text = PAGE_TEXT[language]
    data = {
        "stations": [vars(entry) for entry in entries],
        "text": {key: value for key, value in text.items() if key.startswith(("js_", "index_"))},
    }
    body = json.dumps(data, ensure_ascii=True, separators=(",", ":"))
    script = f"window.STATIONS_DATA={body};\n{(ASSETS / SCRIPT).read_text(encoding='utf-8')}"
    html = environment().get_template("stations.html").render(entries=entries, t=text, language=language)
    style = "".join((ASSETS / name).read_text(encoding="utf-8") for name in ("page.css", "stations.css"))
    return html, script, style
