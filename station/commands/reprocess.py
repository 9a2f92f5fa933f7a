"""`station reprocess` and `station retry`."""

from __future__ import annotations

import sys
from datetime import UTC, datetime
from typing import Annotated

import typer

from station.commands._options import TIMES, SiteArgument


def reprocess(
    site: SiteArgument,
    *,
    from_: Annotated[
        datetime | None,
        typer.Option("--from", formats=TIMES, metavar="TIME", help="Only scans from this time (UTC) on."),
    ] = None,
    to: Annotated[
        datetime | None, typer.Option(formats=TIMES, metavar="TIME", help="Only scans before this time.")
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(metavar="ADDR", help="A Dask cluster: tcp://127.0.0.1:PORT or tls://HOST:PORT."),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Only print how many scans there are to do, and why.")
    ] = False,
) -> None:
    """Reprocess what a changed SOP, setting, flag or log affects.

    Only that is redone. Uses all cores. If interrupted, it continues when started again. Exits with 3 if
    a scan is missing or was set aside.
    """
    from station.config import read_site
    from station.operations.reprocessing import reprocess as reprocess_site

    begin, end = (moment.replace(tzinfo=UTC) if moment else None for moment in (from_, to))
    sys.exit(reprocess_site(read_site(site), (begin, end), print, scheduler=scheduler, dry_run=dry_run))


def retry(
    site: SiteArgument,
    scans: Annotated[
        list[str] | None,
        typer.Argument(metavar="SCAN", help="File names; all if none is given.", show_default=False),
    ] = None,
) -> None:
    """Try scans again that were set aside or failed.

    Also beside the running service. Not needed after a change of settings, limits or version: then the
    service tries them by itself.
    """
    from station.config import read_site
    from station.operations.retry import retry_scans

    for line in retry_scans(read_site(site), [scan.rpartition("/")[2] for scan in scans or ()]):
        print(line)
