"""The commands; no logic. Data goes to stdout, logs and progress to stderr."""

from __future__ import annotations

import json
import math
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


@app.command()
def calibrate(
    site: SiteArgument,
    scans: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="[SCAN...]",
            help="Scan files to take the precision of ranges and angles from; else the newest two.",
            exists=True,
            dir_okay=False,
            show_default=False,
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Write CSV tables and [scanner] keys there.")
    ] = None,
    epochs: Annotated[int, typer.Option(min=1, help="So many epochs at most, spread over the series.")] = 200,
    *,
    json_: Json = False,
) -> None:
    """Set the stated sigma against what stable ground shows.

    By range and scale, over the life of the station; and measure the precision of ranges and angles.
    """
    from station.config import read_site
    from station.service.calibrate import calibrate as measure
    from station.service.calibrate import describe, write_tables

    found = measure(read_site(site), scans or [], epochs, lambda: None)
    print(json.dumps(_plain(found), indent=2) if json_ else describe(found))
    for path in write_tables(found, out) if out else []:
        print(path)


@app.command()
def sensitivity(
    site: SiteArgument,
    epoch: Annotated[
        str, typer.Option(metavar="TIME", help="The epoch nearest to this time (UTC), or its place.")
    ] = "-1",
    maps: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write maps of the shares to this NetCDF file.")
    ] = None,
    *,
    json_: Json = False,
) -> None:
    """Tell which input makes an epoch unsure.

    Share of tilt, heading, translation, range, refraction, jitter and random errors in the variance of cells
    and areas: exact, and by simulation.
    """
    from station.config import read_site
    from station.service.sensitivity import describe
    from station.service.sensitivity import sensitivity as attribute

    try:
        found = attribute(read_site(site), _epoch(epoch), maps)
    except IndexError:
        raise typer.BadParameter(f"the series has no epoch at place {epoch}") from None
    print(json.dumps(_plain(found), indent=2) if json_ else describe(found))


@app.command()
def papers(
    paper: Annotated[
        str | None, typer.Argument(metavar="[PAPER]", help="One of them.", show_default=False)
    ] = None,
    pages: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Write a page for each paper there (Markdown).")
    ] = None,
) -> None:
    """Compute the numbers of the four papers, beside what they print.

    hartzell2015, voordendag2023, ozendi2016, leslar2014. Exits with 1 if one is not right.
    """
    from station.papers.errata import PAPERS
    from station.papers.pages import results, table, write_pages

    names = [one.key for one in PAPERS]
    if paper is not None and paper not in names:
        raise typer.BadParameter(f"choose from {', '.join(names)}")
    found = results(paper)
    print(table(found))
    for path in write_pages(found, pages) if pages else []:
        print(path)
    if not all(one.good for one in found):
        sys.exit(1)


def _epoch(given: str) -> int | str:
    """Take a whole number for a place in the series, anything else for a time."""
    try:
        return int(given)
    except ValueError:
        pass
    try:
        datetime.fromisoformat(given)
    except ValueError:
        raise typer.BadParameter(f"{given!r} is neither a time (2026-02-01T12:00) nor a place (-1)") from None
    return given


def _plain(found: object) -> object:
    """Return the same without NaN, which JSON does not know."""
    if isinstance(found, dict):
        return {key: _plain(value) for key, value in found.items()}
    if isinstance(found, list):
        return [_plain(value) for value in found]
    return None if isinstance(found, float) and not math.isfinite(found) else found


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
