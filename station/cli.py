"""The commands; no logic. Data goes to stdout, logs and progress to stderr."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Iterable
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path
from typing import Annotated, TypeVar

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

T = TypeVar("T")


class Drawn(StrEnum):
    """What `station plot` draws."""

    map = "map"
    curve = "curve"
    film = "film"


class Shown(StrEnum):
    """What a map shows."""

    change = "change"
    sigma = "sigma"
    points = "points"


class Exported(StrEnum):
    """What `station export` writes."""

    geotiff = "geotiff"
    csv = "csv"
    stac = "stac"


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


FromOption = Annotated[
    str | None, typer.Option("--from", metavar="TIME", help="First epoch, UTC.", show_default=False)
]
ToOption = Annotated[
    str | None, typer.Option("--to", metavar="TIME", help="Last epoch, UTC.", show_default=False)
]
Against = Annotated[
    str, typer.Option(metavar="EPOCH", help="reference, previous, or an epoch: a scan's name or a time.")
]


def _bar(label: str) -> Callable[[list[T]], Iterable[T]]:
    """Return what goes through a list with a progress bar, where a person looks on."""
    from rich.console import Console
    from rich.progress import track

    return lambda rows: track(
        rows, label, console=Console(stderr=True), transient=True, disable=not sys.stderr.isatty()
    )


@app.command()
def areas(
    site: SiteArgument,
    polygons: Annotated[
        Path | None,
        typer.Argument(
            metavar="[POLYGONS]", help="GeoJSON of named polygons; else the site's.", show_default=False
        ),
    ] = None,
    first: FromOption = None,
    last: ToOption = None,
    against: Against = "reference",
    table: Annotated[
        str | None, typer.Option("--csv", metavar="FILE", help="Write CSV; - is stdout.", show_default=False)
    ] = None,
) -> None:
    """Tell how areas changed, with 95 % intervals.

    Mean, median, volume; also of polygons given after the fact, and between any two epochs.
    """
    from station.config import read_site
    from station.products.areas import Span, area_lines, as_csv, as_text

    lines = area_lines(read_site(site), polygons, Span.of(first, last), against, _bar("summing up"))
    if table is None:
        print(as_text(lines))
    elif table == "-":
        print(as_csv(lines), end="")
    else:
        Path(table).write_text(as_csv(lines), encoding="utf-8")


@app.command()
def plot(
    site: SiteArgument,
    what: Annotated[
        Drawn, typer.Argument(metavar="map|curve|film", help="What to draw.", show_default=False)
    ],
    epoch: Annotated[str, typer.Option(metavar="EPOCH", help="Of a map: a scan's name or a time.")] = "last",
    against: Against = "reference",
    show: Annotated[Shown, typer.Option(help="Of a map.")] = Shown.change,
    area: Annotated[
        str | None, typer.Option(help="Of a curve: one area; else all.", show_default=False)
    ] = None,
    polygons: Annotated[
        Path | None, typer.Option(metavar="GEOJSON", help="Of a curve.", show_default=False)
    ] = None,
    first: FromOption = None,
    last: ToOption = None,
    limit: Annotated[
        float | None, typer.Option(help="Where the colours end, m.", min=1e-3, show_default=False)
    ] = None,
    width: Annotated[
        int | None, typer.Option(help="Of a map, pixels.", min=300, max=8000, show_default=False)
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", metavar="FILE", show_default=False)] = None,
) -> None:
    """Draw a map, the curve of an area, or a film.

    The file's ending decides its format: png, webp, jpg; curves also svg, pdf; films webp, gif.
    """
    from station.config import read_site
    from station.products import plots
    from station.products.areas import Span, area_lines

    found, span = read_site(site), Span.of(first, last)
    out = out or Path(f"{found.station.id}_{what.value}.{'webp' if what is Drawn.film else 'png'}")
    if what is Drawn.map:
        plots.plot_map(found, epoch, against, show.value, out, width, limit)
    elif what is Drawn.film:
        plots.plot_film(found, span, out, width, limit, _bar("drawing"))
    else:
        lines = area_lines(found, polygons, span, against, _bar("summing up"))
        since = (
            f"the {against} one" if against == "previous" else against.replace("reference", "the reference")
        )
        title = f"{found.station.name or found.station.id}: mean change since {since}"
        plots.plot_curve(lines, area, title, out)
    print(out)


@app.command()
def export(
    site: SiteArgument,
    kind: Annotated[
        Exported, typer.Argument(metavar="geotiff|csv|stac", help="For which tools.", show_default=False)
    ],
    folder: Annotated[Path, typer.Argument(metavar="[DIR]", help="Where to put it.")] = Path(),
    first: FromOption = None,
    last: ToOption = None,
) -> None:
    """Write files for tools that do not read NetCDF.

    The newest epoch, or those of a span: change and its uncertainty as GeoTIFF with QGIS styles, a STAC
    catalogue of these, or scans and areas as CSV.
    """
    from station.config import read_site
    from station.products.areas import Span
    from station.products.export import export as write

    span = Span.of(first, last) if first or last else None
    for path in write(read_site(site), kind.value, span, folder, _bar("writing")):
        print(path)


@app.command()
def serve(
    site: SiteArgument,
    port: Annotated[int, typer.Option(min=1, max=65535, help="On 127.0.0.1.")] = 8750,
) -> None:
    """Show the station's page on this machine, read-only."""
    from station.config import read_site
    from station.products.serve import serve as show
    from station.service.pictures import page_folder

    folder = page_folder(read_site(site))
    print(f"http://127.0.0.1:{port}/ (Ctrl-C ends it)", file=sys.stderr)
    show(folder, port)


sop_app = typer.Typer(
    help="Solve an SOP from points and planes; see what an SOP says.",
    no_args_is_help=True,
    rich_markup_mode=None,
)
app.add_typer(sop_app, name="sop")

Crs = Annotated[
    str | None,
    typer.Option(metavar="EPSG", help="The map, where the SOP leads to one without a POP or origin."),
]
Given = {"exists": True, "dir_okay": False, "show_default": False}


@sop_app.command()
def solve(
    features: Annotated[Path, typer.Argument(metavar="FEATURES", help="Table of features (CSV).", **Given)],
    out: Annotated[Path, typer.Option(metavar="SOP", help="Where to write it.", show_default=False)],
    start: Annotated[
        Path | None,
        typer.Option(metavar="SOP", help="Start from this; needed without three points.", **Given),
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
    from dataclasses import asdict

    from station.service.sop import describe_solution, known_scanner, solve_sop

    found = solve_sop(features, out, start, crs, None if scanner is None else known_scanner(scanner))
    print(json.dumps(asdict(found), indent=2) if json_ else describe_solution(found))


@sop_app.command()
def show(
    sop: Annotated[
        list[Path], typer.Argument(metavar="SOP...", help="One or more, in their order.", **Given)
    ],
    pop: Annotated[
        Path | None, typer.Option(metavar="POP", help="From the project to WGS84.", **Given)
    ] = None,
    crs: Crs = None,
    *,
    json_: Json = False,
) -> None:
    """Tell where SOPs put the scanner and how it leans there.

    Of each but the first also how it differs from the one before.
    """
    from dataclasses import asdict

    from station.service.sop import describe_chain, show_sop

    chains = show_sop(sop, pop, crs)
    print(
        json.dumps([asdict(chain) for chain in chains], indent=2)
        if json_
        else "\n".join(describe_chain(chain) for chain in chains)
    )


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


alarms_app = typer.Typer(
    help="Tell people what is wrong; try whether they could be told.",
    no_args_is_help=True,
    rich_markup_mode=None,
)
app.add_typer(alarms_app, name="alarms")


@alarms_app.command("look")
def alarms_look(site: SiteArgument) -> None:
    """Ask the rules of [alarms], now, and tell what is new, still so or over.

    Runs every few minutes by a timer, beside the service. Exits with 1 if a target could not be reached: it
    is told the next time.
    """
    from station.config import read_site
    from station.service.alarms import look
    from station.service.targets import leave

    leave(look(read_site(site), tell=print))


@alarms_app.command("test")
def alarms_test(site: SiteArgument) -> None:
    """Send a test message by every target and say which failed.

    Exits with 1 if one did.
    """
    from station.config import read_site
    from station.service.alarms import test
    from station.service.targets import leave

    leave(test(read_site(site), print))


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
