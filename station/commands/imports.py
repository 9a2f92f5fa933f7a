"""`station import riscan`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(
    help="Begin with what other programs wrote.",
    no_args_is_help=True,
    rich_markup_mode=None,
)


@app.callback()
def _group() -> None:
    """Keep `riscan` a command of its own."""


@app.command()
def riscan(
    project: Annotated[
        Path,
        typer.Argument(metavar="PROJECT", help="The project folder or its .rsp file.", show_default=False),
    ],
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="Where to write the files.", show_default=False)
    ],
) -> None:
    """Write SOPs, POP and a first site file from a RiSCAN PRO project.

    SOPs begin with the first scan of their position. Lines of the site file that say `check:` need your eyes.
    """
    from station.operations.riscan_import import import_riscan

    for path in import_riscan(project, folder):
        print(path)
