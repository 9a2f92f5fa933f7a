"""Files for tools that do not read NetCDF: GeoTIFF, CSV, a STAC catalogue."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from pyproj import Transformer

from station.archive.epochs import EpochRef
from station.archive.netcdf_layout import Series
from station.archive.series.index import list_epochs, series_in
from station.config import Site
from station.errors import StationError
from station.products.area_tables import REFERENCE, Span, area_records, as_csv
from station.products.epoch_table import EpochTable, csv_times, read_epoch_table
from station.products.gallery import default_limit, replace_if_changed
from station.products.geotiff import KINDS, export_geotiff
from station.science.geometry.pose import horizontal_crs

TOPO4D = "https://stac-extensions.github.io/topo4d/v1.0.0/schema.json"
COG_MEDIA_TYPE = "image/tiff; application=geotiff; profile=cloud-optimized"
Track = Callable[[list[EpochRef]], Iterable[EpochRef]]


def export(site: Site, kind: str, span: Span | None, folder: Path, track: Track = iter) -> list[Path]:
    """Write the epochs of a span, by default the newest, as `kind` into a folder; return the files written.

    `kind` is geotiff, csv (scans and areas; by default of all epochs) or stac. Raises StationError if there
    is nothing to write or a library is missing.
    """
    series = series_in(site.station.data)
    table = read_epoch_table(series)
    if kind == "csv":
        return _write_csv(site, table, span or Span.parse(None, None), folder)
    versions = dict(zip(table.texts["epoch_file"], table.texts["reference_version"], strict=True))
    measured = [epoch for epoch in list_epochs(series) if versions.get(epoch.epoch_file)]
    chosen = measured[-1:] if span is None else [epoch for epoch in measured if epoch.start in span]
    if not chosen:
        raise StationError("no epoch with a change in this span")
    limit_m = site.products.change_limit_m
    limit_m = limit_m or default_limit(series, measured[0], versions[measured[0].epoch_file])
    if kind == "stac":
        return _write_stac(site, series, table, list(track(chosen)), folder, limit_m)
    return [path for epoch in track(chosen) for path in export_geotiff(series, epoch, folder, limit_m)]


def _write_csv(site: Site, table: EpochTable, span: Span, folder: Path) -> list[Path]:
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(["time_utc", "start_utc", "end_utc", "scan", "verdict", "reason", *table.scalars])
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
                ]
            )
    files = {"scans.csv": stream.getvalue()}
    if site.areas is not None:
        files["areas.csv"] = as_csv(area_records(site, None, span, REFERENCE))
    for name, text in files.items():
        replace_if_changed(folder / name, text.encode())
    return [folder / name for name in files]


def _write_stac(
    site: Site, series: Series, table: EpochTable, chosen: list[EpochRef], folder: Path, limit_m: float
) -> list[Path]:
    """Write a relocatable STAC collection of one item per epoch, with its GeoTIFFs."""
    try:
        import pystac  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise StationError("STAC needs pystac: pip install 'tls-station[export]'") from error
    geometry, bbox = _footprint(series)
    starts = [epoch.start for epoch in chosen]
    collection = pystac.Collection(
        id=series.station_id,
        description=f"Elevation change at {site.station.name or series.station_id}, measured by a permanently"
        " mounted laser scanner",
        title=site.station.name or series.station_id,
        license=site.metadata.license or "other",
        extent=pystac.Extent(
            pystac.SpatialExtent([bbox or [-180.0, -90.0, 180.0, 90.0]]),
            pystac.TemporalExtent([[min(starts), max(starts)]]),
        ),
        stac_extensions=[TOPO4D],
        summaries=pystac.Summaries({"num_items": {"values": [len(chosen)]}}),
    )
    for epoch in chosen:
        item = pystac.Item(
            id=Path(epoch.epoch_file).stem,
            geometry=geometry,
            bbox=bbox,
            datetime=epoch.start,
            properties=_item_properties(site, series, table, epoch),
            stac_extensions=[TOPO4D],
        )
        item_folder = folder / item.id
        for kind, path in zip(KINDS, export_geotiff(series, epoch, item_folder, limit_m), strict=True):
            item.add_asset(
                kind,
                pystac.Asset(f"./{path.name}", KINDS[kind][1], media_type=COG_MEDIA_TYPE, roles=["data"]),
            )
        collection.add_item(item)
    collection.normalize_hrefs(str(folder))
    collection.save(pystac.CatalogType.SELF_CONTAINED)
    return [folder / "collection.json"]


def _item_properties(site: Site, series: Series, table: EpochTable, epoch: EpochRef) -> dict[str, Any]:
    """Return the STAC properties of an epoch: those of the topo4d extension, and its verdict."""
    index = table.texts["epoch_file"].index(epoch.epoch_file)
    crs = horizontal_crs(series.crs) if series.crs else None
    code = crs.to_authority() if crs is not None else None
    version = table.texts["reference_version"][index]
    properties: dict[str, Any] = {
        "title": f"{site.station.name or series.station_id}, {epoch.start:%Y-%m-%d %H:%M} UTC",
        "instruments": [site.scanner.model],
        "topo4d:data_type": "raster",
        "topo4d:native_crs": ":".join(code) if code else "local",
        "topo4d:tz": "UTC",
        "topo4d:sensor": site.scanner.model,
        "topo4d:acquisition_mode": "TLS",
        "topo4d:spatial_resolution": series.grid.cell_m,
        "topo4d:productmeta": {
            "product_name": "elevation change",
            "param": {"reference_version": version},
            "product_level": "L3",
        },
        "station:verdict": table.verdict[index],
        "station:scan_id": table.texts["scan_id"][index],
    }
    if np.isfinite(points := table.scalars["point_total"][index]):
        properties["topo4d:point_count"] = int(points)
    return properties


def _footprint(series: Series) -> tuple[dict[str, Any] | None, list[float] | None]:
    """Return the outline of the grid in degrees as GeoJSON, and its bounding box; None without a CRS."""
    if series.crs is None:
        return None, None
    grid = series.grid
    east_m, south_m = grid.west_m + grid.nx * grid.cell_m, grid.north_m - grid.ny * grid.cell_m
    to_degrees = Transformer.from_crs(horizontal_crs(series.crs), "EPSG:4326", always_xy=True)
    corners = ((grid.west_m, south_m), (east_m, south_m), (east_m, grid.north_m), (grid.west_m, grid.north_m))
    ring = [[round(float(degrees), 8) for degrees in to_degrees.transform(*corner)] for corner in corners]
    lon, lat = zip(*ring, strict=True)
    outline = {"type": "Polygon", "coordinates": [[*ring, ring[0]]]}
    return outline, [min(lon), min(lat), max(lon), max(lat)]
