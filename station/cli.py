"""The commands; no logic. Data goes to stdout, logs and progress to stderr."""

from __future__ import annotations

import json
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer

from station.errors import StationError
from station.simulation.scenario import NAMES

app = typer.Typer(
    name="station",
    help="Runs a permanently mounted laser scanner as a measuring instrument:"
    " elevation change with an uncertainty that can be trusted.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

SiteArgument = Annotated[
    Path, typer.Argument(metavar="SITE", help="The site file (TOML).", show_default=False)
]
TIMES = ["%Y-%m-%d", "%Y-%m-%dT%H:%M:%S", "%Y-%m-%dT%H:%M:%SZ"]
Json = Annotated[bool, typer.Option("--json", help="Print JSON.")]


def main() -> None:
    """Run a command; end with the exit status its error carries.

    0 done, 1 failed, 2 wrong usage, 3 some scan set aside, 74 cannot write, 75 try again later, 78 bad
    config.
    """
    try:
        app()
    except StationError as error:
        print(f"station: {error}", file=sys.stderr)
        sys.exit(error.exit_status)
    except KeyboardInterrupt:
        sys.exit(130)


@app.command()
def init(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Where to write it.", show_default=False)],
    like: Annotated[str, typer.Option(help="hef: glacier, VZ-6000. mammoth: snow field, VZ-400i.")] = "hef",
) -> None:
    """Write a commented site file to start from."""
    from station.config import write_site

    print(write_site(folder, like))


@app.command()
def check(
    site: SiteArgument,
    *,
    store: Annotated[
        bool, typer.Option("--store", help="Instead: prove the store against journal and checksums.")
    ] = False,
    json_: Json = False,
) -> None:
    """Try site file, SOP, folders, weather, newest scan.

    Everything that can be known before going live; exits with 1 if something must be mended.
    """
    from station.service.check import check as try_all
    from station.service.check import check_store

    findings = check_store(site) if store else try_all(site)
    if json_:
        print(json.dumps(findings, indent=2))
    else:
        for finding in findings:
            print(f"{finding['level']:7} {finding['what']}: {finding['says']}")
    if any(finding["level"] == "fault" for finding in findings):
        sys.exit(1)


@app.command()
def process(
    site: SiteArgument,
    scans: Annotated[
        list[Path],
        typer.Argument(
            metavar="SCAN...", help="Scan files.", exists=True, dir_okay=False, show_default=False
        ),
    ],
) -> None:
    """Measure these scans, now: verdict and one line each.

    Exits with 3 if some scan was set aside.
    """
    from station.config import read_site
    from station.service.once import one_line, process_scans

    sys.exit(process_scans(read_site(site), scans, lambda entry: print(one_line(entry), flush=True)))


@app.command()
def reprocess(
    site: SiteArgument,
    *,
    from_: Annotated[
        datetime | None,
        typer.Option("--from", formats=TIMES, metavar="TIME", help="Only scans from then (UTC) on."),
    ] = None,
    to: Annotated[
        datetime | None, typer.Option(formats=TIMES, metavar="TIME", help="Only scans before.")
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(metavar="ADDR", help="A Dask cluster: tcp://127.0.0.1:PORT or tls://HOST:PORT."),
    ] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only tell how many, and why.")] = False,
) -> None:
    """Redo what a changed SOP, setting, flag or log affects, and only that.

    On all cores; interrupted, it goes on when started again. Exits with 3 if some scan is gone or set aside.
    """
    from station.config import read_site
    from station.service.reprocess import reprocess as redo

    begin, end = (moment.replace(tzinfo=UTC) if moment else None for moment in (from_, to))
    sys.exit(redo(read_site(site), (begin, end), print, scheduler=scheduler, dry_run=dry_run))


@app.command()
def run(site: SiteArgument) -> None:
    """Be the service: catch up with the inbox, then watch it.

    Ends at SIGTERM, reads the site file again at SIGHUP.
    """
    from station.service.daemon import run as serve

    sys.exit(serve(site))


@app.command()
def status(site: SiteArgument, *, json_: Json = False) -> None:
    """Tell what was done, what waits, what was set aside.

    With the reasons, and how good the last scan was.
    """
    from station.config import read_site
    from station.service.health import describe
    from station.service.health import status as look

    found = look(read_site(site))
    print(json.dumps(found, indent=2) if json_ else describe(found))


def _known(scenario: str | None) -> str | None:
    if scenario is not None and scenario not in NAMES:
        raise typer.BadParameter(f"choose from {', '.join(NAMES)}")
    return scenario


@app.command()
def simulate(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Where to build it.", show_default=False)],
    hours: Annotated[int, typer.Option(min=1, max=2000, help="How many hourly scans.")] = 24,
    seed: Annotated[int, typer.Option(help="The same seed gives the same station.")] = 1,
    scenario: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            callback=_known,
            show_default="melt and a large avalanche",
            help=f"What it lives through: {', '.join(NAMES)}.",
        ),
    ] = None,
) -> None:
    """Build a small station with a known truth.

    Scans, inclination logs, weather, SOP, polygons, site file, and the truth to compare with.
    """
    from station.simulation.scenario import demo as usual
    from station.simulation.scenario import named
    from station.simulation.station import simulate as build

    build(folder, named(scenario, hours, seed) if scenario else usual(hours, seed))
    print(folder / "site.toml")


@app.command()
def demo(
    folder: Annotated[Path, typer.Argument(metavar="[DIR]", help="Where to run it.")] = Path("station-demo"),
    hours: Annotated[int, typer.Option(min=1, max=2000, help="How many hourly scans.")] = 24,
) -> None:
    """Simulate a day, process it, tell what changed.

    The whole thing in about a minute.
    """
    from station.service.demo import run_demo

    sys.exit(run_demo(folder, hours))


alarms = typer.Typer(no_args_is_help=True, add_completion=False)
app.add_typer(alarms, name="alarms", help="Tell people what is wrong, or try whether they could be told.")


@alarms.command("look")
def alarms_look(site: SiteArgument) -> None:
    """Ask the rules of [alarms], now, and tell what is new, still so or over.

    Runs every few minutes by a timer, beside the service. Exits with 1 if a target could not be reached: it
    is told the next time.
    """
    from station.config import read_site
    from station.service.alarms import look

    sys.exit(look(read_site(site), tell=print))


@alarms.command("test")
def alarms_test(site: SiteArgument) -> None:
    """Send a test message by every target and say which failed.

    Exits with 1 if one did.
    """
    from station.config import read_site
    from station.service.alarms import test

    sys.exit(test(read_site(site), print))


@app.callback(invoke_without_command=True)
def _version(
    version: Annotated[bool, typer.Option("--version", help="Print the version.", is_eager=True)] = False,
) -> None:
    if version:
        from station import __version__

        print(__version__)
        raise typer.Exit


if __name__ == "__main__":
    main()
