"""`station sensitivity`."""

from __future__ import annotations

import json
from datetime import datetime
from pathlib import Path
from typing import Annotated

import typer

from station.commands._options import Json, SiteArgument, json_safe


def sensitivity(
    site: SiteArgument,
    epoch: Annotated[
        str, typer.Option(metavar="TIME", help="The epoch nearest to this time (UTC), or its index.")
    ] = "-1",
    maps: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write maps of the shares to this NetCDF file.")
    ] = None,
    budget: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Write the budget by effect as a page (HTML) with a diagram; - prints it."
        ),
    ] = None,
    area: Annotated[
        str | None, typer.Option(help="Of the budget: one area instead of all cells.", show_default=False)
    ] = None,
    *,
    json_: Json = False,
) -> None:
    """Print which input makes an epoch uncertain.

    Share of tilt, heading, translation, range, refraction, jitter and random errors in the variance of cells
    and areas: exact, and by simulation.
    """
    from station.config import read_site
    from station.operations.reports.sensitivity_report import format_report, sensitivity_report

    if budget is not None:
        _budget(site, _epoch(epoch), area, budget, as_json=json_)
        return
    report = sensitivity_report(read_site(site), _epoch(epoch), maps)
    print(json.dumps(json_safe(report), indent=2) if json_ else format_report(report))


def _budget(site: Path, epoch: int | str, area: str | None, path: Path, *, as_json: bool) -> None:
    """Print the budget of an area, or write its page."""
    from station.config import read_site
    from station.operations.reports.uncertainty_budget import format_budget, uncertainty_budget, write_budget

    result = uncertainty_budget(read_site(site), epoch, area)
    if str(path) != "-":
        write_budget(result, path)
        print(path)
        return
    print(json.dumps(json_safe(result), indent=2) if as_json else format_budget(result))


def _epoch(text: str) -> int | str:
    """Return an integer as an index into the series, anything else as a time."""
    try:
        return int(text)
    except ValueError:
        pass
    try:
        datetime.fromisoformat(text)
    except ValueError:
        raise typer.BadParameter(f"{text!r} is neither a time (2026-02-01T12:00) nor an index (-1)") from None
    return text
