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

from station.archive.layout import Series
from station.archive.store import Row, rows, series_in
from station.config import Site
from station.errors import StationError
from station.products.areas import REFERENCE, Span, area_lines, as_csv
from station.products.gallery import default_limit, put
from station.products.geotiff import KINDS, export_geotiff
from station.products.record import Record, read_record
from station.science.pose import horizontal_crs

TOPO4D = "https://stac-extensions.github.io/topo4d/v1.0.0/schema.json"
COG = "image/tiff; application=geotiff; profile=cloud-optimized"
Each = Callable[[list[Row]], Iterable[Row]]


def export(site: Site, kind: str, span: Span | None, folder: Path, each: Each = iter) -> list[Path]:
    """Write the epochs of a span, the newest where none is given, as `kind` into a folder.

    `kind` is geotiff, csv (scans and areas; all of them where no span is given) or stac. Returns what was
    written. Raises StationError where there is nothing to write or a library is missing.
    """
    series = series_in(site.station.data)
    record = read_record(series)
    if kind == "csv":
        return _csv(site, record, span or Span.of(None, None), folder)
    versions = dict(zip(record.words["epoch_file"], record.words["reference_version"], strict=True))
    measured = [row for row in rows(series) if versions.get(row.epoch_file)]
    chosen = measured[-1:] if span is None else [row for row in measured if row.start in span]
    if not chosen:
        raise StationError("no epoch with a change there")
    limit_m = site.products.change_limit_m
    limit_m = limit_m or default_limit(series, measured[0], versions[measured[0].epoch_file])
    if kind == "stac":
        return _stac(site, series, record, list(each(chosen)), folder, limit_m)
    return [path for row in each(chosen) for path in export_geotiff(series, row, folder, limit_m)]


def _csv(site: Site, record: Record, span: Span, folder: Path) -> list[Path]:
    told = io.StringIO()
    writer = csv.writer(told, lineterminator="\n")
    writer.writerow(["start_utc", "scan", "verdict", "reason", *record.numbers])
    for index, start_s in enumerate(record.start_s):
        start = datetime.fromtimestamp(float(start_s), UTC)
        if start in span:
            numbers = [float(column[index]) for column in record.numbers.values()]
            writer.writerow(
                [
                    f"{start:%Y-%m-%dT%H:%M:%SZ}",
                    record.words["scan_id"][index],
                    record.verdict[index],
                    record.words["verdict_reason"][index],
                    *(f"{number:.9g}" if np.isfinite(number) else "" for number in numbers),
                ]
            )
    made = {"scans.csv": told.getvalue()}
    if site.areas is not None:
        made["areas.csv"] = as_csv(area_lines(site, None, span, REFERENCE))
    for name, text in made.items():
        put(folder / name, text.encode())
    return [folder / name for name in made]


def _stac(
    site: Site, series: Series, record: Record, chosen: list[Row], folder: Path, limit_m: float
) -> list[Path]:
    """Write a collection of one item an epoch, GeoTIFFs beside each, which works wherever it is put."""
    try:
        import pystac  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise StationError("STAC needs pystac: pip install 'tls-station[export]'") from error
    geometry, bbox = _outline(series)
    starts = [row.start for row in chosen]
    collection = pystac.Collection(
        id=series.station_id,
        description=f"Elevation change at {site.station.name or series.station_id}, measured by a permanently"
        " mounted laser scanner",
        title=site.station.name or series.station_id,
        license="other",
        extent=pystac.Extent(
            pystac.SpatialExtent([bbox or [-180.0, -90.0, 180.0, 90.0]]),
            pystac.TemporalExtent([[min(starts), max(starts)]]),
        ),
        stac_extensions=[TOPO4D],
        summaries=pystac.Summaries({"num_items": {"values": [len(chosen)]}}),
    )
    for row in chosen:
        item = pystac.Item(
            id=Path(row.epoch_file).stem,
            geometry=geometry,
            bbox=bbox,
            datetime=row.start,
            properties=_properties(site, series, record, row),
            stac_extensions=[TOPO4D],
        )
        beside = folder / item.id
        for kind, path in zip(KINDS, export_geotiff(series, row, beside, limit_m), strict=True):
            item.add_asset(
                kind, pystac.Asset(f"./{path.name}", KINDS[kind][1], media_type=COG, roles=["data"])
            )
        collection.add_item(item)
    collection.normalize_hrefs(str(folder))
    collection.save(pystac.CatalogType.SELF_CONTAINED)
    return [folder / "collection.json"]


def _properties(site: Site, series: Series, record: Record, row: Row) -> dict[str, Any]:
    """Return what the extension for topographic time series tells of an epoch, and its verdict."""
    at = record.words["epoch_file"].index(row.epoch_file)
    crs = horizontal_crs(series.crs) if series.crs else None
    code = crs.to_authority() if crs is not None else None
    version = record.words["reference_version"][at]
    told: dict[str, Any] = {
        "title": f"{site.station.name or series.station_id}, {row.start:%Y-%m-%d %H:%M} UTC",
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
        "station:verdict": record.verdict[at],
        "station:scan_id": record.words["scan_id"][at],
    }
    if np.isfinite(points := record.numbers["point_total"][at]):
        told["topo4d:point_count"] = int(points)
    return told


def _outline(series: Series) -> tuple[dict[str, Any] | None, list[float] | None]:
    """Return the edge of the grid in degrees as GeoJSON, and its box; None where the map is nowhere."""
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
