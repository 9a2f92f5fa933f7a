"""Files for tools that do not read NetCDF: GeoTIFF, CSV, a STAC catalogue, transformations."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from station.archive.derived.product_files import read_products
from station.archive.epochs import EpochRef
from station.archive.netcdf_layout import Series
from station.archive.reference_files import valid_versions
from station.archive.series.index import list_epochs, series_in
from station.config import Site
from station.errors import StationError
from station.products.area_tables import REFERENCE, Span, area_records, as_csv
from station.products.epoch_table import EpochTable, csv_times, read_epoch_table
from station.products.exports.transformations import write_transformations
from station.products.gallery import default_limit, replace_if_changed
from station.products.geotiff import export_geotiff
from station.products.site_products import product_tables
from station.products.stac import write_stac

Track = Callable[[list[EpochRef]], Iterable[EpochRef]]


def export(site: Site, kind: str, span: Span | None, folder: Path, track: Track = iter) -> list[Path]:
    """Write the epochs of a span, by default the newest, as `kind` into a folder; return the files written.

    `kind` is geotiff, csv (scans, areas, products; by default of all epochs), stac or transformations. Raises
    StationError if there is nothing to write or a library is missing.
    """
    series = series_in(site.station.data)
    table = read_epoch_table(series)
    if kind == "csv":
        versions_by_scan = _versions_by_scan(series)
        return _write_csv(site, table, versions_by_scan, span or Span.parse(None, None), folder)
    versions = dict(zip(table.texts["epoch_file"], table.texts["reference_version"], strict=True))
    measured = [epoch for epoch in list_epochs(series) if versions.get(epoch.epoch_file)]
    chosen = measured[-1:] if span is None else [epoch for epoch in measured if epoch.start in span]
    if not chosen:
        raise StationError("no epoch with a change in this span")
    if kind == "transformations":
        return write_transformations(series, chosen, folder, track)
    limit_m = site.products.change_limit_m
    limit_m = limit_m or default_limit(series, measured[0], versions[measured[0].epoch_file])
    if kind == "stac":
        return write_stac(site, series, chosen, folder, limit_m, track)
    return [path for epoch in track(chosen) for path in export_geotiff(series, epoch, folder, limit_m)]


def _versions_by_scan(series: Series) -> dict[str, list[str]]:
    """Return the versions of the reference that each scan is part of, by scan."""
    versions_by_scan: dict[str, list[str]] = {}
    for version, provenance in valid_versions(series).items():
        for scan_id in provenance.scan_ids:
            versions_by_scan.setdefault(scan_id, []).append(version)
    return versions_by_scan


def _write_csv(
    site: Site, table: EpochTable, versions_by_scan: dict[str, list[str]], span: Span, folder: Path
) -> list[Path]:
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(
        ["time_utc", "start_utc", "end_utc", "scan", "verdict", "reason", *table.scalars, "in_reference"]
    )
    for index, start_s in enumerate(table.start_s):
        start = datetime.fromtimestamp(float(start_s), UTC)
        if start in span:
            numbers = [float(column[index]) for column in table.scalars.values()]
            writer.writerow(
                [
                    *csv_times(float(start_s), float(table.end_s[index])).values(),
                    table.texts["scan_id"][index],
                    table.verdict[index],
                    table.texts["verdict_reason"][index],
                    *(f"{number:.9g}" if np.isfinite(number) else "" for number in numbers),
                    " ".join(versions_by_scan.get(table.texts["scan_id"][index], ())),
                ]
            )
    files = {"scans.csv": stream.getvalue()}
    if site.areas is not None:
        files["areas.csv"] = as_csv(area_records(site, None, span, REFERENCE))
    for product in read_products(site.station.data):
        files[f"product_{product.key}.csv"] = product_tables.as_csv(
            product_tables.product_rows(product, span)
        )
    for name, text in files.items():
        replace_if_changed(folder / name, text.encode())
    return [folder / name for name in files]
