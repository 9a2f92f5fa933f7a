"""`station export`."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from enum import StrEnum
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from station.commands._options import FromOption, SiteArgument, ToOption, amount_bar, progress_bar

if TYPE_CHECKING:
    from station.config import Site
    from station.products.area_tables import Span


class ExportFormat(StrEnum):
    """What `station export` writes."""

    geotiff = "geotiff"
    csv = "csv"
    stac = "stac"
    netcdf = "netcdf"
    zarr = "zarr"


class ExportPeriod(StrEnum):
    """The period of each file of an export."""

    day = "1D"
    month = "1M"


def export(
    site: SiteArgument,
    kind: Annotated[
        ExportFormat,
        typer.Argument(metavar="geotiff|csv|stac|netcdf|zarr", help="The format.", show_default=False),
    ],
    out: Annotated[Path, typer.Argument(metavar="[OUT]", help="Folder or file to write.")] = Path(),
    first: FromOption = None,
    last: ToOption = None,
    every: Annotated[
        ExportPeriod | None,
        typer.Option(help="NetCDF, Zarr: one file for each day or month.", show_default=False),
    ] = None,
    area: Annotated[
        str | None,
        typer.Option(
            metavar="NAME|W,S,E,N", help="NetCDF, Zarr: only around an area or in a box.", show_default=False
        ),
    ] = None,
    variables: Annotated[
        str | None, typer.Option(metavar="A,B,…", help="NetCDF, Zarr: only these.", show_default=False)
    ] = None,
    chunks: Annotated[
        str | None,
        typer.Option(metavar="TIME,Y,X", help="NetCDF, Zarr: size of a chunk.  [default: 1,128,128]"),
    ] = None,
) -> None:
    """Write files to pass on, or for tools that cannot read the series.

    netcdf and zarr: the series itself, complete and compressed, with the same values. Files that exist and
    whose epochs did not change are kept, so an interrupted export continues when it is repeated.
    geotiff, stac and csv: the newest epoch, or those of a span; change and its uncertainty as GeoTIFF with
    QGIS styles, a STAC catalogue of these, or scans and areas as CSV.
    """
    from station.config import read_site
    from station.products.area_tables import Span
    from station.products.export import export as write_files

    settings, span = read_site(site), Span.parse(first, last)
    if kind in {ExportFormat.netcdf, ExportFormat.zarr}:
        for path in _export_series(
            settings, kind.value, out, span, every and every.value, area, variables, chunks
        ):
            print(path)
        return
    if given := [name for name, value in (
        ("--every", every), ("--area", area), ("--variables", variables), ("--chunks", chunks)
    ) if value is not None]:  # fmt: skip
        raise typer.BadParameter(f"{given[0]} is for netcdf and zarr only")
    for path in write_files(
        settings, kind.value, span if first or last else None, out, progress_bar("writing")
    ):
        print(path)


def _export_series(
    settings: Site,
    kind: str,
    out: Path,
    span: Span,
    every: str | None,
    area: str | None,
    variables: str | None,
    chunks: str | None,
) -> Iterator[Path]:
    """Yield each file of the series when it is written; files that are up to date are kept."""
    from station.processing.scan_tasks import series_for
    from station.products.exports.formats import FORMATS
    from station.products.exports.selection import parse_box, pending, select, split

    file_format = FORMATS[kind]
    areas = settings.areas.file if settings.areas else None
    box_m = parse_box(area, areas, settings.map.crs) if area else None
    selection = select(series_for(settings), span, box_m, variables, chunks)
    parts = split(selection, out, file_format.suffix, every)
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
    from station.inbox.journal import Journal

    folder, checksums = settings.station.data, dict[str, str]()
    if (folder / "journal.sqlite").is_file():
        with Journal(folder / "journal.sqlite", read_only=True) as journal:
            checksums = journal.checksums()

    @cache  # a month has one file and is read for each of its days
    def verify(path: Path) -> None:
        expected = checksums.get(str(path.relative_to(folder)))
        if expected is not None and sha256_file(path) != expected:
            raise StoreError(f"{path}: damaged: its checksum does not match (station check --store)")

    return verify
