"""Tables in Markdown, written into a page of the docs between two comments that mark their place."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path


def marks(benchmark: str) -> tuple[str, str]:
    """Return the comments before and after the tables of a benchmark."""
    return (
        f"<!-- tables of benchmarks.{benchmark} -->",
        f"<!-- end of the tables of benchmarks.{benchmark} -->",
    )


def write_tables(
    page: Path, benchmark: str, title: str, tables: Iterable[tuple[Sequence[str], Iterable[Sequence[str]]]]
) -> None:
    """Replace the tables of a benchmark in a page: heads and cells of each."""
    begin, end = marks(benchmark)
    before, rest = page.read_text(encoding="utf-8").split(begin)
    _, after = rest.split(end)
    parts = [f"{before}{begin}", f"{title}:", *(_markdown(*each) for each in tables), f"{end}{after}"]
    page.write_text("\n\n".join(parts), encoding="utf-8")


def _markdown(heads: Sequence[str], cells: Iterable[Sequence[str]]) -> str:
    lines = [heads, ["---"] * len(heads), *cells]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
