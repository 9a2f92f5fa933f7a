"""`station calibrate`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from station.commands._options import Json, SiteArgument, json_safe


def calibrate(
    site: SiteArgument,
    scans: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="[SCAN...]",
            help="Scan files to measure the precision of ranges and angles with; default: the newest two.",
            exists=True,
            dir_okay=False,
            show_default=False,
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Write CSV tables and [scanner] keys there.")
    ] = None,
    epochs: Annotated[
        int, typer.Option(min=1, help="Maximum number of epochs, spread over the series.")
    ] = 200,
    *,
    json_: Json = False,
) -> None:
    """Compare the stated sigma with what stable ground shows.

    By range and scale, over the life of the station; and measure the precision of ranges and angles.
    """
    from station.config import read_site
    from station.operations.calibration_report import calibration_report, format_report, write_tables

    report = calibration_report(read_site(site), scans or [], epochs, lambda: None)
    print(json.dumps(json_safe(report), indent=2) if json_ else format_report(report))
    for path in write_tables(report, out) if out else []:
        print(path)
