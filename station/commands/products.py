"""`station areas`, `station product`, `station trend`, `station events`, `station plot`, `station serve`."""

from __future__ import annotations

import sys
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from station.commands._options import (
    Against,
    CsvOption,
    FromOption,
    Json,
    Period,
    Polygons,
    SiteArgument,
    ToOption,
    json_safe,
    print_or_write,
    progress_bar,
)

if TYPE_CHECKING:
    from station.config import Site


MAX_ANSWER_S = 60.0  # of the server, for one request
SitesArgument = Annotated[
    list[Path], typer.Argument(metavar="SITE", help="The site files (TOML).", show_default=False)
]


class PlotKind(StrEnum):
    """What `station plot` draws."""

    map = "map"
    curve = "curve"
    film = "film"


class MapVariable(StrEnum):
    """The variable of a map."""

    change = "change"
    sigma = "sigma"
    points = "points"


class EventKind(StrEnum):
    """Kinds of events."""

    loss = "loss"
    gain = "gain"
    paired = "paired"
    melt_front = "melt_front"
    snowfall = "snowfall"


def areas(
    site: SiteArgument,
    polygons: Polygons = None,
    first: FromOption = None,
    last: ToOption = None,
    against: Against = "reference",
    table: CsvOption = None,
) -> None:
    """Print how areas changed, with 95 % intervals.

    Mean, median and volume; also for polygons drawn later, and between any two epochs.
    """
    from station.config import read_site
    from station.products.area_tables import Span, area_records, as_csv, as_text

    settings, span = read_site(site), Span.parse(first, last)
    _print_epochs(settings, against)
    records = area_records(settings, polygons, span, against, progress_bar("summing up"))
    print_or_write(as_text(records) if table is None else as_csv(records), table)


def product(
    site: SiteArgument,
    name: Annotated[
        str | None, typer.Argument(metavar="NAME", help="A product of the site.", show_default=False)
    ] = None,
    first: FromOption = None,
    last: ToOption = None,
    table: CsvOption = None,
    json_: Json = False,
) -> None:
    """Print the products of the site file, or one over time.

    The newest values of all, or with NAME those of one, with 95 % intervals. CSV and JSON have one sigma,
    and its random and systematic part. With observations in the site file, prints how the product agrees
    with them. Computes what the service has not computed yet.
    """
    from json import dumps

    from station.archive.derived.product_files import read_product, read_products
    from station.config import read_site
    from station.processing.store_tasks import renew_products
    from station.products.area_tables import Span
    from station.products.site_products import observations, product_tables

    settings, span = read_site(site), Span.parse(first, last)
    for fault in renew_products(settings):
        print(fault, file=sys.stderr)
    data = settings.station.data
    if name is None:
        newest = list(product_tables.newest_rows(read_products(data)))
        print(dumps(json_safe(newest), indent=2) if json_ else product_tables.newest_as_text(newest))
        return
    chosen = read_product(data, name)
    rows = list(product_tables.product_rows(chosen, span))
    if json_:
        print(dumps(json_safe(rows), indent=2))
        return
    text = product_tables.as_text(chosen, rows) if table is None else product_tables.as_csv(rows)
    print_or_write(text, table)
    for section in settings.product:
        if section.observations and section.key == chosen.key:
            for agreement in observations.compare(chosen, section.observations):
                print(observations.agreement_text(agreement), file=sys.stderr if table else sys.stdout)


def trend(
    site: SiteArgument,
    polygons: Polygons = None,
    area: Annotated[str | None, typer.Option(help="One area instead of all.", show_default=False)] = None,
    first: FromOption = None,
    last: ToOption = None,
    every: Annotated[
        Period | None, typer.Option(help="A rate for each day or month, UTC.", show_default=False)
    ] = None,
    table: CsvOption = None,
) -> None:
    """Print how fast areas change, and whether they speed up.

    With 95 % intervals. The rate is that of the straight line through the mean change of the area. Its
    interval allows for errors that last for hours. CSV has the inverse velocity too.
    """
    from station.config import read_site
    from station.products.area_tables import Span
    from station.products.trend_tables import as_csv, as_text, trend_records

    settings, span = read_site(site), Span.parse(first, last)
    period = every.value if every else None
    records = trend_records(settings, polygons, span, area, period, progress_bar("summing up"))
    print_or_write(as_text(records) if table is None else as_csv(records), table)


def events(
    site: SiteArgument,
    kind: Annotated[EventKind | None, typer.Option(help="Only of this kind.", show_default=False)] = None,
    first: FromOption = None,
    last: ToOption = None,
    table: CsvOption = None,
    geoparquet: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Write GeoParquet with the outlines instead.", show_default=False),
    ] = None,
) -> None:
    """Print where and when the surface changed.

    Anywhere on the grid: loss and gain against the surroundings, pairs of scar and deposit, snowfall and
    melt, each with its volume and 95 % interval. The outlines are in events.geojson of the data folder.
    """
    from station.config import read_site
    from station.products.area_tables import Span
    from station.products.event_tables import as_csv, as_text, select_events, write_geoparquet

    if table is not None and geoparquet is not None:
        raise typer.BadParameter("--csv and --geoparquet: choose one")
    settings = read_site(site)
    found = select_events(settings, Span.parse(first, last), kind.value if kind else None)
    if geoparquet is not None:
        from station.archive.series.index import series_in

        write_geoparquet(series_in(settings.station.data), found, geoparquet)
        return
    print_or_write(
        as_text(found, on_map=settings.grid.plane is None) if table is None else as_csv(found), table
    )


def _print_epochs(settings: Site, *texts: str) -> None:
    """Print which epochs are meant: of a time the nearest is taken."""
    from station.products.area_tables import describe_epoch

    for text in texts:
        if description := describe_epoch(settings, text):
            print(description, file=sys.stderr)


def plot(
    site: SiteArgument,
    kind: Annotated[
        PlotKind, typer.Argument(metavar="map|curve|film", help="What to draw.", show_default=False)
    ],
    epoch: Annotated[str, typer.Option(metavar="EPOCH", help="Map: a scan's name or a time.")] = "last",
    against: Against = "reference",
    show: Annotated[MapVariable, typer.Option(help="Map: the variable.")] = MapVariable.change,
    area: Annotated[
        str | None, typer.Option(help="Curve: one area instead of all.", show_default=False)
    ] = None,
    polygons: Annotated[
        Path | None, typer.Option(metavar="GEOJSON", help="Curve: other areas.", show_default=False)
    ] = None,
    first: FromOption = None,
    last: ToOption = None,
    limit: Annotated[
        float | None, typer.Option(help="End of the colour scale, m.", min=1e-3, show_default=False)
    ] = None,
    width: Annotated[
        int | None, typer.Option(help="Width of a map, pixels.", min=300, max=8000, show_default=False)
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", metavar="FILE", show_default=False)] = None,
) -> None:
    """Draw a map, the curve of an area, or a film.

    The suffix of the file decides its format: png, webp, jpg; curves also svg, pdf; films webp, gif.
    """
    from station.config import read_site
    from station.products import plots
    from station.products.area_tables import Span, area_records

    settings, span = read_site(site), Span.parse(first, last)
    out = out or Path(f"{settings.station.id}_{kind.value}.{'webp' if kind is PlotKind.film else 'png'}")
    _print_epochs(settings, against, *([epoch] if kind is PlotKind.map else []))
    if kind is PlotKind.map:
        plots.plot_map(settings, epoch, against, show.value, out, width, limit)
    elif kind is PlotKind.film:
        plots.plot_film(settings, span, out, width, limit, progress_bar("drawing"))
    else:
        records = area_records(settings, polygons, span, against, progress_bar("summing up"))
        plots.plot_curve(records, area, plots.curve_title(settings, against), out)
    print(out)


def serve(
    sites: SitesArgument,
    port: Annotated[int, typer.Option(min=1, max=65535, help="On 127.0.0.1.")] = 8750,
) -> None:
    """Serve the page of a station on this machine, read-only.

    Several stations get a page with all of them. Below api/ it answers what a static page cannot: the
    change of any polygon over any epochs, and parts of the series as NetCDF and GeoTIFF.
    """
    from station.config import read_site
    from station.processing.workers.isolation import TaskRunner
    from station.products.serve import Served, server_for

    settings = [read_site(site) for site in sites]
    stations = [Served(site.station.id, site.station.name, site.station.data) for site in settings]
    run = partial(
        TaskRunner().run,
        memory_gb=min(site.service.memory_gb for site in settings),
        timeout_s=MAX_ANSWER_S,
    )
    serve_page = server_for(stations, port, run, settings[0].products.language)
    print(f"http://127.0.0.1:{port}/ (Ctrl-C ends it)", file=sys.stderr)
    serve_page()


def index(
    sites: SitesArgument,
    out: Annotated[Path, typer.Option("--out", "-o", metavar="FILE", help="The page.")] = Path("index.html"),
) -> None:
    """Write a page of several stations.

    A row each with its state, newest map and newest alarm. It reads the pages of the stations when it is
    opened: write it again for another list of stations only.
    """
    from station.config import read_site
    from station.processing.epoch_recorder import page_folder
    from station.products.web.stations_page import write_stations

    settings = [read_site(site) for site in sites]
    stations = [(site.station.id, site.station.name, page_folder(site)) for site in settings]
    write_stations(out, stations, settings[0].products.language)
    print(out)
