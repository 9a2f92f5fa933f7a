"""`station papers`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer


def papers(
    paper: Annotated[
        str | None, typer.Argument(metavar="PAPER", help="One of them.", show_default=False)
    ] = None,
    pages: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Write a page for each paper there (Markdown).")
    ] = None,
) -> None:
    """Recompute the numbers of the four papers.

    Compares them with the printed ones: hartzell2015, voordendag2023, ozendi2016, leslar2014. Exits
    with 1 if one does not agree.
    """
    from station.papers.errata import PAPERS
    from station.papers.pages import format_table, run_checks, write_pages

    keys = [entry.key for entry in PAPERS]
    if paper is not None and paper not in keys:
        raise typer.BadParameter(f"choose from {', '.join(keys)}")
    checks = run_checks(paper)
    print(format_table(checks))
    for path in write_pages(checks, pages) if pages else []:
        print(path)
    if not all(check.passes for check in checks):
        sys.exit(1)
