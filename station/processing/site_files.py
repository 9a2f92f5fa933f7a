"""What a site file names, read with its settings: series, areas, flags, references, logs, scans."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import shapely

from station.archive.netcdf_layout import Series, roundtrip_text
from station.config import Site
from station.errors import ConfigError, StationError
from station.inbox.file_hash import sha256_file, sha256_files
from station.inbox.listing import ScanFile
from station.quantities import Bools, Grid
from station.queries.site_products.product_queries import Product
from station.queries.site_products.profile_lines import sample_line
from station.readers.flags import read_flags, reasons_for
from station.readers.polygons import cells_inside, read_polygons
from station.readers.raster import read_geotiff
from station.sections.product import ProductSection, product_key


def series_for(site: Site) -> Series:
    """Return the series of a site."""
    return Series(
        folder=site.station.data,
        station_id=site.station.id,
        grid=site.grid_cells,
        crs=site.grid_crs,
        vertical_datum=site.map.vertical_datum,
        name=site.station.name,
        institution=site.station.institution,
        metadata=(
            *site.metadata.attributes.items(),
            ("time_coverage_resolution", f"PT{site.scans.expected_every_s:.0f}S"),
        ),
        scanner=site.instrument,
        cf_uncertainty=site.products.cf_uncertainty,
        plane_crs=site.map.crs if site.grid.plane else None,
    )


def polygon_cells(file: Path, site: Site) -> Bools:
    """Return the cells (ny, nx) inside any of the polygons of a file."""
    inside = np.zeros(site.grid_cells.shape, bool)
    for polygon in read_polygons(file, site.grid_crs).values():
        inside |= cells_inside(polygon, site.grid_cells)
    return inside


def exclusion_reason(site: Site, start_utc_s: float, end_utc_s: float) -> str:
    """Return the reasons in the flag file for excluding a scan, as stored; '' if there are none."""
    reason = reasons_for(read_flags(site.flags.file), start_utc_s, end_utc_s) if site.flags else ""
    return roundtrip_text(reason, "sentence")


def site_file_sha256(file: Path) -> str:
    """Return the SHA-256 of a file that the site file names; links are followed, unlike those in an inbox."""
    return sha256_file(file.resolve())


def file_version(file: Path) -> str:
    """Return the version name of a reference surface given as a file."""
    return f"{file.stem}-{site_file_sha256(file)[:8]}"


def load_area_polygons(site: Site) -> dict[str, shapely.Geometry]:
    """Return the outlines of the areas of a site by name, in map coordinates."""
    return {} if site.areas is None else read_polygons(site.areas.file, site.grid_crs)


def load_areas(site: Site) -> dict[str, Bools]:
    """Return the cells (ny, nx) of the areas of a site by name."""
    polygons = load_area_polygons(site)
    return {name: cells_inside(polygon, site.grid_cells) for name, polygon in polygons.items()}


def load_products(site: Site) -> tuple[list[Product], list[str]]:
    """Return the products of a site with what they refer to, and why others of them cannot be computed."""
    products, faults = [], []
    areas: dict[str, Bools] = {}
    for section in site.product:
        try:
            if section.needs_areas and not areas:
                areas = load_areas(site)
            products.append(_load_product(site, section, areas))
        except (StationError, OSError) as error:
            faults.append(f"product {section.name}: {error}")
    return products, faults


def load_product(site: Site, name: str) -> Product:
    """Return a product of a site by its name or that of its file.

    Raises StationError if there is none, ConfigError if a raster, an area or a place of it cannot be used.
    """
    for section in site.product:
        if section.key == product_key(name):
            return _load_product(site, section, load_areas(site) if section.needs_areas else {})
    known = ", ".join(section.name for section in site.product) or "none"
    raise StationError(f"no product {name!r} in the site file; products: {known}")


def _load_product(site: Site, section: ProductSection, areas: dict[str, Bools]) -> Product:
    """Return a product; raise ConfigError if a raster, an area or a place of it cannot be used."""
    grid = site.grid_cells
    rasters = {key: read_geotiff(path, grid, site.grid_crs) for key, path in section.rasters.items()}
    files = tuple(site_file_sha256(path) for path in section.rasters.values())
    if section.line is not None:
        lines = {name: sample_line(points, grid) for name, points in section.lines.items()}
        return Product(section, {name: line.cells for name, line in lines.items()}, lines, rasters, files)
    places = _areas_of(section, areas) if section.needs_areas else {section.name: _cells_at(section, grid)}
    for key in {"low", "high"} & rasters.keys():
        places = {name: cells & np.isfinite(rasters[key]) for name, cells in places.items()}
    if empty := [name for name, cells in places.items() if not cells.any()]:
        raise ConfigError(f"no cell of the grid in {', '.join(empty)}: are the coordinates those of the map?")
    return Product(section, places, rasters=rasters, files=files)


def _areas_of(section: ProductSection, areas: dict[str, Bools]) -> dict[str, Bools]:
    unknown = [name for name in section.areas if name not in areas]
    if unknown:
        raise ConfigError(f"no area {', '.join(unknown)} in areas.file, which has {', '.join(areas)}")
    return {name: areas[name] for name in section.areas or areas}


def _cells_at(section: ProductSection, grid: Grid) -> Bools:
    """Return the cells (ny, nx) within a radius of a point, at least the one that contains it."""
    east_m, north_m = section.at or (np.nan, np.nan)
    distance_m = np.hypot(grid.x_m[None, :] - east_m, grid.y_m[:, None] - north_m)
    cells = distance_m <= section.radius_m
    column, row = (east_m - grid.west_m) / grid.cell_m, (grid.north_m - north_m) / grid.cell_m
    if 0 <= column < grid.nx and 0 <= row < grid.ny:
        cells[int(row), int(column)] = True
    return np.asarray(cells)


def sha256_log(scan: ScanFile) -> str:
    """Return the SHA-256 of a scan's inclination log, or of those of its files; '' if there is none."""
    return sha256_files(scan.logs)
