"""`station retry`."""

from __future__ import annotations

from typing import Annotated

import typer

from station.commands._options import SiteArgument


def retry(
    site: SiteArgument,
    scans: Annotated[
        list[str] | None,
        typer.Argument(metavar="[SCAN...]", help="File names; all if none is given.", show_default=False),
    ] = None,
) -> None:
    """Try scans again that were set aside or failed, also beside the running service.

    Not needed after a change of settings, limits or version: then the service tries them by itself.
    """
    from station.config import read_site
    from station.operations.retry import retry_scans

    for line in retry_scans(read_site(site), [scan.rpartition("/")[2] for scan in scans or ()]):
        print(line)
