"""Pages of reports: one HTML file each, which loads nothing."""

from __future__ import annotations

from pathlib import Path

import jinja2

from station.archive.atomic_files import atomic_write

ASSETS = Path(__file__).parent / "assets"


def write_page(path: Path, template: str, **values: object) -> None:
    """Write a page from a template in `assets/`; raise StoreError if that fails."""
    templates = jinja2.Environment(
        loader=jinja2.FileSystemLoader(ASSETS), autoescape=True, undefined=jinja2.StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    page = templates.get_template(template).render(**values)
    with atomic_write(path) as tmp_path:
        tmp_path.write_text(page, encoding="utf-8")
