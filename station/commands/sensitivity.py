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
    *,
    json_: Json = False,
) -> None:
    """Print which input makes an epoch uncertain.

    Share of tilt, heading, translation, range, refraction, jitter and random errors in the variance of cells
    and areas: exact, and by simulation.
    """
    from station.config import read_site
    from station.operations.sensitivity_report import format_report, sensitivity_report

    report = sensitivity_report(read_site(site), _epoch(epoch), maps)
    print(json.dumps(json_safe(report), indent=2) if json_ else format_report(report))


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
