"""`station export`."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from station.commands._options import FromOption, Period, SiteArgument, ToOption, amount_bar, progress_bar

if TYPE_CHECKING:
    from station.config import Site
    from station.products.area_tables import Span


class FileFormat(StrEnum):
    """Of the files of `station export points` and `station export levels`."""

    laz = "laz"
    copc = "copc"
    geotiff = "geotiff"
    netcdf = "netcdf"


class ExportFormat(StrEnum):
    """What `station export` writes."""

    geotiff = "geotiff"
    csv = "csv"
    stac = "stac"
    points = "points"
    transformations = "transformations"
    levels = "levels"
    netcdf = "netcdf"
    zarr = "zarr"
    references = "references"
    ncml = "ncml"
    erddap = "erddap"


OF_EPOCHS = {
    ExportFormat.geotiff,
    ExportFormat.csv,
    ExportFormat.stac,
    ExportFormat.points,
    ExportFormat.transformations,
    ExportFormat.levels,
}  # the others are of the series


FILE_FORMATS = {  # the first is the default
    ExportFormat.points: (FileFormat.laz, FileFormat.copc),
    ExportFormat.levels: (FileFormat.geotiff, FileFormat.netcdf),
}


@dataclass(frozen=True)
class SeriesOptions:
    """Options of the formats that contain or describe the series."""

    every: str | None
    area: str | None
    variables: str | None
    chunks: str | None
    url: str | None


def export(
    site: SiteArgument,
    kind: Annotated[
        ExportFormat,
        typer.Argument(
            metavar="FORMAT",
            help="See above.",
            show_default=False,
        ),
    ],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Folder or file to write.")] = Path(),
    first: FromOption = None,
    last: ToOption = None,
    every: Annotated[
        Period | None,
        typer.Option(help="NetCDF, Zarr: one file for each day or month.", show_default=False),
    ] = None,
    area: Annotated[
        str | None,
        typer.Option(
            metavar="NAME|W,S,E,N", help="NetCDF, Zarr: only around an area or in a box.", show_default=False
        ),
    ] = None,
    variables: Annotated[
        str | None,
        typer.Option(
            metavar="A,B,…",
            help="NetCDF, Zarr: only these; all: those of processing.nc too.",
            show_default=False,
        ),
    ] = None,
    chunks: Annotated[
        str | None,
        typer.Option(
            metavar="TIME,Y,X", help="NetCDF, Zarr: size of a chunk; default 1,128,128.", show_default=False
        ),
    ] = None,
    url: Annotated[
        str | None,
        typer.Option(
            metavar="URL", help="References: address of the data folder; default here.", show_default=False
        ),
    ] = None,
    product: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="GeoTIFF, NetCDF: the map of this product (snow depth, melt, mass balance) instead.",
            show_default=False,
        ),
    ] = None,
    file_format: Annotated[
        FileFormat | None,
        typer.Option(
            "--format",
            help="Points: laz (default) or copc. Levels: geotiff (default) or netcdf.",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Write the series or some of its epochs in other formats.

    netcdf and zarr: the series itself, complete and compressed, with the same values. Files that exist and
    whose epochs did not change are kept, so an interrupted export continues when it is repeated.
    references, ncml and erddap describe it for the cloud and for data servers, without a copy.
    geotiff, stac and csv: the newest epoch, or those of a span; change and its uncertainty as GeoTIFF with
    QGIS styles, a STAC catalogue of these, or scans and areas as CSV.
    points: the scans of these epochs as LAZ or COPC, corrected, on the map, each point with change, sigma and
    quality of its cell. transformations: how the scanner had moved at these epochs, as 4 x 4 matrices, and
    their covariance. levels: level and rate of each cell as GeoTIFF, or as NetCDF with all days in one file,
    of the newest day that is over, or of the days and months of a span.
    geotiff and netcdf with --product: its value in each cell with one sigma and its two parts, of the newest
    epoch or those of a span.
    """
    from station.config import read_site
    from station.products.area_tables import Span
    from station.products.export import export as write_files

    settings, span = read_site(site), Span.parse(first, last)
    chosen_format = _file_format(kind, file_format)
    options = SeriesOptions(every and every.value, area, variables, chunks, url)
    if product is not None:
        _refuse(options, "a map")
        for path in _export_maps(settings, kind, product, out, span if first or last else None):
            print(path)
        return
    if kind not in OF_EPOCHS:
        for path in _export_series(settings, kind.value, out, span, options):
            print(path)
        return
    _refuse(options, kind.value)
    if kind is ExportFormat.points:
        from station.operations.point_export import export_points

        for path in export_points(
            settings,
            span if first or last else None,
            out,
            progress_bar("writing"),
            chosen_format,
        ):
            print(path)
        return
    if kind is ExportFormat.levels:
        from station.archive.series.index import series_in
        from station.products.exports.levels import export_levels

        series = series_in(settings.station.data)
        for path in export_levels(series, span if first or last else None, out, chosen_format):
            print(path)
        return
    for path in write_files(
        settings, kind.value, span if first or last else None, out, progress_bar("writing")
    ):
        print(path)


def _export_maps(settings: Site, kind: ExportFormat, name: str, out: Path, span: Span | None) -> list[Path]:
    """Write the maps of a product and return the files."""
    from station.processing.site_files import load_product, series_for
    from station.products.exports.product_maps import export_maps

    if kind not in {ExportFormat.geotiff, ExportFormat.netcdf}:
        raise typer.BadParameter(f"--product: a map is geotiff or netcdf, not {kind.value}")
    product = load_product(settings, name)
    return export_maps(series_for(settings), product, span, out, kind.value, progress_bar("computing"))


def _refuse(options: SeriesOptions, kind: str) -> None:
    """Raise BadParameter if an option of the series is given."""
    if given := [name for name, value in vars(options).items() if value is not None]:
        raise typer.BadParameter(f"--{given[0]} is for the series, not for {kind}")


def _file_format(kind: ExportFormat, file_format: FileFormat | None) -> str:
    """Return the format of the files of a kind, by default the first; '' if there is no choice."""
    formats = FILE_FORMATS.get(kind, ())
    if file_format is None:
        return formats[0].value if formats else ""
    if file_format not in formats:
        names = " or ".join(formats) if formats else "no --format"
        raise typer.BadParameter(f"--format: {kind.value} has {names}, not {file_format.value}")
    return file_format.value


def _export_series(
    settings: Site,
    kind: str,
    out: Path,
    span: Span,
    options: SeriesOptions,
) -> Iterator[Path]:
    """Yield each file of the series when it is written; files that are up to date are kept."""
    from station.processing.site_files import series_for
    from station.products.exports.formats import FORMATS
    from station.products.exports.selection import parse_box, pending, select, split

    file_format = FORMATS[kind]
    areas = settings.areas.file if settings.areas else None
    box_m = parse_box(options.area, areas, settings.grid_crs) if options.area else None
    selection = select(series_for(settings), span, box_m, options.variables, options.chunks)
    if kind == "references":
        selection = replace(selection, url=options.url or settings.station.data.resolve().as_uri())
    parts = split(selection, out, file_format.suffix, options.every)
    remaining = pending(selection, parts, file_format.read_fingerprint)
    if kept := len(parts) - len(remaining):
        print(f"{kept} of {len(parts)} files are up to date", file=sys.stderr)
    with amount_bar("writing", sum(len(part.epochs) for part in remaining)) as advance:
        yield from file_format.write(selection, remaining, _verifier(settings), advance)


def _verifier(settings: Site) -> Callable[[Path], None]:
    """Return a function that raises StoreError if a file of the store does not match its checksum.

    A copied store without a journal has no checksums.
    """
    from station.errors import StoreError
    from station.inbox.file_hash import sha256_file
    from station.inbox.journal_reader import JournalReader

    folder, checksums = settings.station.data, dict[str, str]()
    if (folder / "journal.sqlite").is_file():
        with JournalReader(folder / "journal.sqlite") as journal:
            checksums = journal.checksums()

    @cache  # a month has one file and is read for each of its days
    def verify(path: Path) -> None:
        expected = checksums.get(str(path.relative_to(folder)))
        if expected is not None and sha256_file(path) != expected:
            raise StoreError(f"{path}: damaged: its checksum does not match (station check --store)")

    return verify
