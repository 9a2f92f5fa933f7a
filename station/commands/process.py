"""`station process`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from station.commands._options import SiteArgument


def process(
    site: SiteArgument,
    scans: Annotated[
        list[Path],
        typer.Argument(metavar="SCAN", help="Scan files.", exists=True, dir_okay=False, show_default=False),
    ],
) -> None:
    """Process these scans now and print the verdict of each.

    Exits with 3 if a scan was set aside.
    """
    from station.config import read_site
    from station.operations.batch import format_entry, process_scans

    sys.exit(process_scans(read_site(site), scans, lambda entry: print(format_entry(entry), flush=True)))
