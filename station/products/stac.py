"""A STAC catalogue of GeoTIFFs with the topo4d extension for time series of topography.

The schema of topo4d is that of version 0.2.0, which its owners publish at TOPO4D. Its summaries `num_items`
and `temporal_resolution` are left out: they are no valid summaries of STAC itself.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np
from pyproj import Transformer

from station.archive.epochs import EpochRef
from station.archive.netcdf_layout import Series
from station.archive.read_errors import read_errors
from station.archive.reference_files import read_reference
from station.archive.series.index import processing_file
from station.config import Site
from station.errors import StationError
from station.products.epoch_table import EpochTable, read_epoch_table
from station.products.exports.transformations import read_transformation
from station.products.geotiff import KINDS, export_geotiff, write_cog
from station.quantities import Floats
from station.science.geometry.pose import horizontal_crs

if TYPE_CHECKING:
    import pystac

TOPO4D = "https://tum-rsa.github.io/topo4d/v0.2.0/schema.json"
PROJECTION = "https://stac-extensions.github.io/projection/v2.0.0/schema.json"
COG_MEDIA_TYPE = "image/tiff; application=geotiff; profile=cloud-optimized"
SPDX = re.compile(r"[A-Za-z0-9][A-Za-z0-9.+-]*")  # a licence that is no identifier is a link or a text


def write_stac(
    site: Site,
    series: Series,
    epochs: list[EpochRef],
    folder: Path,
    limit_m: float,
    track: Callable[[list[EpochRef]], Iterable[EpochRef]],
) -> list[Path]:
    """Write a relocatable catalogue: one collection of one item per epoch, with GeoTIFFs; return its root.

    `track` iterates over the epochs. Raises StationError if a library is missing.
    """
    try:
        import pystac  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise StationError("STAC needs pystac: pip install 'tls-station[export]'") from error
    title = site.station.name or series.station_id
    catalog = pystac.Catalog(series.station_id, f"Products of the permanent laser scanner at {title}", title)
    table, bounds_s = read_epoch_table(series), _time_bounds(series)
    rows = {name: row for row, name in enumerate(table.texts["epoch_file"])}
    collection = _collection(site, series, epochs, [bounds_s[rows[epoch.epoch_file]] for epoch in epochs])
    catalog.add_child(collection)
    collection_folder = folder / collection.id
    geometry, bbox = _footprint(series)
    for version in sorted({table.texts["reference_version"][rows[epoch.epoch_file]] for epoch in epochs}):
        _add_reference(collection, series, version, collection_folder)
    for epoch in track(epochs):
        row = rows[epoch.epoch_file]
        start_s, end_s = bounds_s[row]
        item = pystac.Item(
            id=Path(epoch.epoch_file).stem,
            geometry=geometry,
            bbox=bbox,
            datetime=_utc(epoch.time_s),
            start_datetime=_utc(start_s),
            end_datetime=_utc(end_s),
            properties={
                **_projection(series),
                **_topo4d(site, series, table, row),
                "topo4d:duration": round(float(end_s - start_s), 3),
            },
            stac_extensions=[TOPO4D, PROJECTION],
        )
        for kind, path in zip(
            KINDS, export_geotiff(series, epoch, collection_folder / item.id, limit_m), strict=True
        ):
            item.add_asset(kind, _asset(path, KINDS[kind][1]))
        collection.add_item(item)
    catalog.normalize_hrefs(str(folder))
    catalog.save(pystac.CatalogType.SELF_CONTAINED)
    return [folder / "catalog.json"]


def _collection(
    site: Site, series: Series, epochs: list[EpochRef], bounds_s: list[Floats]
) -> pystac.Collection:
    import pystac  # noqa: PLC0415 - an extra

    metadata, title = site.metadata, site.station.name or series.station_id
    is_spdx = bool(SPDX.fullmatch(metadata.license))
    bbox = _footprint(series)[1] or [-180.0, -90.0, 180.0, 90.0]
    span = [_utc(bounds_s[0][0]), _utc(bounds_s[-1][1])]
    timestamps = [_iso(epoch.time_s) for epoch in epochs]
    collection = pystac.Collection(
        id=f"{series.station_id}-elevation-change",
        description=metadata.summary
        or f"Elevation change at {title}, measured by a permanently mounted laser scanner",
        title=f"Elevation change at {title}",
        license=metadata.license if is_spdx else "other",
        keywords=[*metadata.keywords] or ["elevation change", "terrestrial laser scanning"],
        extent=pystac.Extent(pystac.SpatialExtent([bbox]), pystac.TemporalExtent([span])),
        stac_extensions=[TOPO4D],
        summaries=pystac.Summaries({"timestamp_list": timestamps}, maxcount=len(timestamps)),
    )
    if name := metadata.creator_name or site.station.institution:
        roles = [pystac.ProviderRole.PRODUCER, pystac.ProviderRole.LICENSOR]
        collection.providers = [pystac.Provider(name, roles=roles)]
    if metadata.license.startswith(("http://", "https://")):
        collection.add_link(pystac.Link("license", metadata.license))
    if metadata.doi:
        collection.add_link(pystac.Link("cite-as", f"https://doi.org/{metadata.doi}"))
    return collection


def _add_reference(collection: pystac.Collection, series: Series, version: str, folder: Path) -> None:
    """Write a version of the reference surface as an asset of the collection, if it is stored."""
    reference = read_reference(series, version)
    if reference is None:
        return
    path = folder / _reference_name(version)
    heights = "above the ellipsoid" if series.has_ellipsoidal_heights else series.vertical_datum
    description = f"reference surface, version {version}: elevation {heights} [m]".replace("  ", " ")
    tags = {"station": series.station_id, "scans": " ".join(reference.scan_ids)}
    write_cog(path, series, reference.elevation_m.astype(np.float32), description, tags)
    collection.add_asset(path.stem, _asset(path, description))


def _reference_name(version: str) -> str:
    return f"reference_{version}.tif"


def _asset(path: Path, title: str) -> pystac.Asset:
    import pystac  # noqa: PLC0415 - an extra

    raster = {"data_type": "float32", "nodata": "nan", "unit": "m"}
    return pystac.Asset(f"./{path.name}", title, None, COG_MEDIA_TYPE, ["data"], raster)


def _projection(series: Series) -> dict[str, Any]:
    """Return the grid of a raster by the projection extension."""
    grid = series.grid
    crs = horizontal_crs(series.crs) if series.crs else None
    code = crs.to_authority() if crs is not None else None
    south_m, east_m = grid.north_m - grid.ny * grid.cell_m, grid.west_m + grid.nx * grid.cell_m
    return {
        "proj:code": ":".join(code) if code else None,
        **({"proj:wkt2": crs.to_wkt()} if crs is not None and not code else {}),
        "proj:shape": [grid.ny, grid.nx],
        "proj:transform": [grid.cell_m, 0.0, grid.west_m, 0.0, -grid.cell_m, grid.north_m],
        "proj:bbox": [grid.west_m, south_m, east_m, grid.north_m],
    }


def _topo4d(site: Site, series: Series, table: EpochTable, row: int) -> dict[str, Any]:
    """Return the properties of an epoch by the topo4d extension, and its verdict."""
    version = table.texts["reference_version"][row]
    transformation: dict[str, Any] = {
        "reference_epoch": {
            "rel": "reference",
            "href": f"../{_reference_name(version)}",
            "type": COG_MEDIA_TYPE,
            "title": f"reference surface, version {version}",
        }
    }
    covariance = {}
    if (found := read_transformation(series, row)) is not None:
        transformation["transformation"] = found.matrix.tolist()
        covariance = {
            "station:transformation_covariance": found.covariance.tolist(),
            "station:scanner_position": found.position_m.tolist(),
        }
    if np.isfinite(error_m := table.scalars["stable_nmad"][row]):
        transformation["registration_error"] = round(float(error_m), 6)
    return {
        "title": f"{site.station.name or series.station_id}, {_iso(table.start_s[row])}",
        "instruments": list(dict.fromkeys(scanner.model for scanner in site.scanners.values())),
        "topo4d:data_type": "raster",
        "topo4d:tz": "UTC",
        "topo4d:acquisition_mode": "TLS",
        "topo4d:spatial_resolution": series.grid.cell_m,
        "topo4d:positional_accuracy": site.scanner.range_sigma_m,
        "topo4d:trafometa": transformation,
        "topo4d:productmeta": {
            "product_name": "elevation change",
            "param": {"reference_version": version},
            "product_level": "L3",
        },
        **covariance,
        "station:verdict": table.verdict[row],
        "station:scan_id": table.texts["scan_id"][row],
    }


def _time_bounds(series: Series) -> Floats:
    """Return start and end of all epochs (t, 2) [s since 1970]."""
    path = processing_file(series)
    with read_errors(path), h5py.File(path, "r") as file:
        return np.asarray(file["time_bnds"][:], dtype=np.float64)


def _utc(time_s: float) -> datetime:
    return datetime.fromtimestamp(float(time_s), UTC)


def _iso(time_s: float) -> str:
    return f"{_utc(time_s):%Y-%m-%dT%H:%M:%SZ}"


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
