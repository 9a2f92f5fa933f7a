"""`station simulate` and `station demo`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from station.simulation.scenario import NAMES

LIKE = ("hef", "mammoth", "low-cost-snow", "beach", "rockfall")


def _like(kind: str) -> str:
    if kind not in LIKE:
        raise typer.BadParameter(f"choose from {', '.join(LIKE)}")
    return kind


def _scenario(name: str | None) -> str | None:
    if name is not None and name not in NAMES:
        raise typer.BadParameter(f"choose from {', '.join(NAMES)}")
    return name


def simulate(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Where to build it.", show_default=False)],
    hours: Annotated[int, typer.Option(min=1, max=2000, help="Hours, with a scan in each or more.")] = 24,
    seed: Annotated[int, typer.Option(help="The same seed gives the same station.")] = 1,
    scenario: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            callback=_scenario,
            show_default="melt and a large avalanche",
            help=f"What happens at hef: {', '.join(NAMES)}.",
        ),
    ] = None,
    like: Annotated[
        str,
        typer.Option(
            metavar="KIND",
            callback=_like,
            help="hef: glacier. mammoth: snow slope, VZ-400i. low-cost-snow: snow slope, Livox."
            " beach: VZ-2000. rockfall: rock face, VZ-400i.",
        ),
    ] = "hef",
) -> None:
    """Build a small station with a known truth.

    Scans, inclination logs, weather, SOP, polygons, a site file, and the truth to compare with.
    """
    from station.simulation.kinds import KINDS
    from station.simulation.scenario import demo as demo_scenario
    from station.simulation.scenario import named
    from station.simulation.station import simulate as simulate_station

    if scenario and like != "hef":
        raise typer.BadParameter(f"--scenario and --like {like}: scenarios are those of hef")
    build = KINDS.get(like, demo_scenario)
    simulate_station(folder, named(scenario, hours, seed) if scenario else build(hours, seed))
    print(folder / "site.toml")


def demo(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Where to run it.")] = Path("station-demo"),
    hours: Annotated[int, typer.Option(min=1, max=2000, help="Number of hourly scans.")] = 24,
) -> None:
    """Simulate a day, process it and print what changed.

    Takes about a minute.
    """
    from station.operations.demo import run_demo

    sys.exit(run_demo(folder, hours))
