"""`station sop solve`, `station sop show`, and `station import riscan`, which begins with SOPs."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from station.commands._options import Json

app = typer.Typer(
    help="Solve an SOP from points and planes; inspect one.",
    no_args_is_help=True,
    rich_markup_mode=None,
)
import_app = typer.Typer(
    help="Begin with what other programs wrote.",
    no_args_is_help=True,
    rich_markup_mode=None,
)
Crs = Annotated[
    str | None,
    typer.Option(metavar="EPSG", help="The map CRS, if the SOP leads to the map without a POP or origin."),
]
EXISTING_FILE: dict[str, Any] = {"exists": True, "dir_okay": False, "show_default": False}


@app.command()
def solve(
    features: Annotated[
        Path, typer.Argument(metavar="FEATURES", help="Table of features (CSV).", **EXISTING_FILE)
    ],
    out: Annotated[Path, typer.Option(metavar="SOP", help="Where to write it.", show_default=False)],
    start: Annotated[
        Path | None,
        typer.Option(
            metavar="SOP", help="Approximate SOP; needed with fewer than three points.", **EXISTING_FILE
        ),
    ] = None,
    crs: Crs = None,
    scanner: Annotated[
        str | None,
        typer.Option(metavar="MODEL", help="Add the noise of this scanner, such as riegl-vz-6000."),
    ] = None,
    *,
    json_: Json = False,
) -> None:
    """Solve an SOP by least squares, with its covariance.

    Each row of the table: x,y,z in the scan, ref_x,ref_y,ref_z outside, sigma [m], name; for a point on a
    plane also normal_x,normal_y,normal_z.
    """
    from station.operations.sop_solution import format_solution, scanner_by_model, solve_sop

    solution = solve_sop(features, out, start, crs, None if scanner is None else scanner_by_model(scanner))
    print(json.dumps(asdict(solution), indent=2) if json_ else format_solution(solution))


@app.command()
def show(
    sop: Annotated[list[Path], typer.Argument(metavar="SOP", help="One or more, in order.", **EXISTING_FILE)],
    pop: Annotated[
        Path | None, typer.Option(metavar="POP", help="From the project to WGS84.", **EXISTING_FILE)
    ] = None,
    crs: Crs = None,
    *,
    json_: Json = False,
) -> None:
    """Print where SOPs put the scanner and how it is tilted there.

    With several SOPs also how each differs from the previous one.
    """
    from station.operations.sop_solution import format_pose, summarise_sops

    poses = summarise_sops(sop, pop, crs)
    print(
        json.dumps([asdict(pose) for pose in poses], indent=2)
        if json_
        else "\n".join(format_pose(pose) for pose in poses)
    )


@import_app.callback()
def _group() -> None:
    """Keep `riscan` a command of its own."""


@import_app.command()
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
