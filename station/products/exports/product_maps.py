"""Maps of a product as GeoTIFF, one for each epoch and variable, or as one NetCDF file of all epochs."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import netCDF4
import numpy as np

from station._version import __version__
from station.archive.atomic_files import atomic_write
from station.archive.discovery import time_coverage
from station.archive.epochs import EpochRef
from station.archive.netcdf_layout import Series, create_file, create_variable
from station.archive.schema import FILL
from station.archive.series.index import SeriesIndex, references_and_usable
from station.errors import StationError
from station.products.area_tables import Span
from station.products.geotiff import write_cog
from station.queries.site_products.product_maps import map_variables, product_map
from station.queries.site_products.product_queries import Product, ProductQueries

Track = Callable[[list[EpochRef]], Iterable[EpochRef]]


def export_maps(
    series: Series, product: Product, span: Span | None, folder: Path, file_format: str, track: Track = iter
) -> list[Path]:
    """Write the maps of a product in the usable epochs of a span, by default the newest; return the files.

    `file_format` is geotiff or netcdf. Raises StationError if there is no such epoch, no map or a library is
    missing, StoreError if an epoch is damaged or a file cannot be written.
    """
    map_variables(product)  # refuses products without maps before anything is read
    measured = _measured_epochs(series)
    chosen = measured[-1:] if span is None else [epoch for epoch in measured if epoch.start in span]
    if not chosen:
        raise StationError("no epoch with a change in this span")
    queries = ProductQueries(series)
    if file_format == "netcdf":
        return [_write_netcdf(queries, product, chosen, folder, track)]
    return [path for epoch in track(chosen) for path in _write_geotiffs(queries, product, epoch, folder)]


def _measured_epochs(series: Series) -> list[EpochRef]:
    """Return the usable epochs with a change."""
    index = SeriesIndex(series)
    if not len(index):
        return []
    versions, usable = references_and_usable(series)
    return [index[position] for position in np.flatnonzero(usable & (versions != b"")).tolist()]


def _write_geotiffs(queries: ProductQueries, product: Product, epoch: EpochRef, folder: Path) -> list[Path]:
    paths, rasters = [], product_map(queries, product, epoch)
    tags = {
        "station": queries.series.station_id,
        "epoch": epoch.epoch_file,
        "product": product.section.name,
        "time_start": f"{epoch.start:%Y-%m-%dT%H:%M:%SZ}",
        "software": f"station {__version__}",
    }
    for spec in map_variables(product):
        suffix = spec.name.removeprefix(product.section.kind)
        path = folder / f"{Path(epoch.epoch_file).stem}_{product.section.key}{suffix}.tif"
        write_cog(path, queries.series, rasters[spec.name], spec.long_name, tags, spec.units or "1")
        paths.append(path)
    return paths


def _write_netcdf(
    queries: ProductQueries, product: Product, epochs: list[EpochRef], folder: Path, track: Track
) -> Path:
    series, section = queries.series, product.section
    starts = dict.fromkeys(f"{epoch.start:%Y%m%dT%H%M%S}" for epoch in (epochs[0], epochs[-1]))
    path = folder / f"{series.station_id}_{section.key}_{'-'.join(starts)}.nc"
    title = f"{section.name} at {series.name or series.station_id}"
    specs = map_variables(product)
    with atomic_write(path) as tmp_path, netCDF4.Dataset(tmp_path, "w", clobber=False) as file:
        create_file(file, series, title, len(epochs))
        for spec in specs:
            create_variable(file, spec, series, len(epochs))
        file.set_auto_mask(False)
        for number, epoch in enumerate(track(epochs)):
            start_s = epoch.start.timestamp()
            file["time"][number] = epoch.time_s
            file["time_bnds"][number] = start_s, 2 * epoch.time_s - start_s
            for name, raster in product_map(queries, product, epoch).items():
                file[name][number] = np.where(np.isfinite(raster), raster, np.float32(FILL))
        bounds_s = file["time_bnds"][:]
        file.setncatts(time_coverage(float(bounds_s[0, 0]), float(bounds_s[-1, 1])))
        file.setncatts({"product_kind": section.kind, "product_name": section.name})
    return path
