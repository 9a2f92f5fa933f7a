"""`station calibrate` and `station score`."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated

import typer

from station.commands._options import Json, SiteArgument, json_safe


def calibrate(
    site: SiteArgument,
    scans: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="SCAN",
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
    from station.operations.reports.calibration_report import calibration_report, format_report, write_tables

    report = calibration_report(read_site(site), scans or [], epochs, lambda: None)
    print(json.dumps(json_safe(report), indent=2) if json_ else format_report(report))
    for path in write_tables(report, out) if out else []:
        print(path)


def score(
    archive: Annotated[
        Path,
        typer.Argument(
            metavar="ARCHIVE",
            help="A site file of the archive, or the folder with its site.toml.",
            show_default=False,
        ),
    ],
    out: Annotated[
        Path, typer.Option("--out", "-o", metavar="DIR", help="Where to write the page, and to process.")
    ] = Path("station-score"),
    epochs: Annotated[
        int, typer.Option(min=1, help="Maximum number of epochs, spread over the series.")
    ] = 200,
    *,
    json_: Json = False,
) -> None:
    """Process an archive of scans and write a page on its accuracy.

    Errors of withheld stable ground over their sigma, gain over the registration, alarms, CPU time. Nothing
    is written to the archive, and the page holds no point of it.
    """
    from station.config import read_site
    from station.operations.batch import format_entry
    from station.operations.reports import score as scoring

    site = read_site(archive / "site.toml" if archive.is_dir() else archive)
    report = scoring.score(site, out, epochs, lambda entry: print(format_entry(entry), file=sys.stderr))
    result = json_safe(report)
    paths = scoring.write_score(result, out)
    print(json.dumps(result, indent=2) if json_ else "\n".join(map(str, paths)))
