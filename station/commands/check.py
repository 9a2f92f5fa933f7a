"""`station init` and `station check`."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated

import typer

from station.commands._options import Json, SiteArgument


def init(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Where to write it.", show_default=False)],
    like: Annotated[
        str,
        typer.Option(
            help="hef: glacier, VZ-6000. mammoth: snow field, VZ-400i. low-cost-snow: snow slope, Livox."
            " beach: VZ-2000. rockfall: rock face, VZ-400i."
        ),
    ] = "hef",
    source: Annotated[
        Path | None,
        typer.Option(
            "--from",
            metavar="FOLDER",
            help="Write it for the scans, logs and matrices in this folder.",
            exists=True,
            file_okay=False,
            show_default=False,
        ),
    ] = None,
) -> None:
    """Write a commented site file to start from."""
    from station.config import write_site
    from station.operations.proposals.site_proposal import propose_site

    for path in [write_site(folder, like)] if source is None else propose_site(source, folder):
        print(path)


def check(
    site: SiteArgument,
    *,
    store: Annotated[
        bool, typer.Option("--store", help="Check the store against its journal and checksums instead.")
    ] = False,
    strict: Annotated[bool, typer.Option("--strict", help="Exit with 1 for warnings too.")] = False,
    json_: Json = False,
) -> None:
    """Check the site file, SOP, folders, weather and newest scan.

    Everything that can be known before going live. Exits with 1 if something has to be fixed. As root it also
    tells what the user `station` may not read or write.
    """
    from station.operations.site_check import site_findings, store_findings

    findings = store_findings(site) if store else site_findings(site)
    if json_:
        print(json.dumps(findings, indent=2))
    else:
        for finding in findings:
            print(f"{finding['level']:7} {finding['what']}: {finding['message']}")
    if any(finding["level"] == "fault" or (strict and finding["level"] == "warning") for finding in findings):
        sys.exit(1)
