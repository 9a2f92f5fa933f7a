"""What a site file names, read with its settings: series, areas, flags, references, logs, scans."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import shapely

from station.archive.netcdf_layout import Series, roundtrip_text
from station.config import Site
from station.inbox.file_hash import sha256_file, sha256_files
from station.inbox.listing import ScanFile
from station.quantities import Bools
from station.readers.flags import read_flags, reasons_for
from station.readers.polygons import cells_inside, read_polygons


def series_for(site: Site) -> Series:
    """Return the series of a site."""
    return Series(
        folder=site.station.data,
        station_id=site.station.id,
        grid=site.grid_cells,
        crs=site.map.crs,
        vertical_datum=site.map.vertical_datum,
        name=site.station.name,
        institution=site.station.institution,
        metadata=(
            *site.metadata.attributes.items(),
            ("time_coverage_resolution", f"PT{site.scans.expected_every_s:.0f}S"),
        ),
        scanner=site.instrument,
        cf_uncertainty=site.products.cf_uncertainty,
    )


def polygon_cells(file: Path, site: Site) -> Bools:
    """Return the cells (ny, nx) inside any of the polygons of a file."""
    inside = np.zeros(site.grid_cells.shape, bool)
    for polygon in read_polygons(file, site.map.crs).values():
        inside |= cells_inside(polygon, site.grid_cells)
    return inside


def exclusion_reason(site: Site, start_utc_s: float, end_utc_s: float) -> str:
    """Return the reasons in the flag file for excluding a scan, as stored; '' if there are none."""
    reason = reasons_for(read_flags(site.flags.file), start_utc_s, end_utc_s) if site.flags else ""
    return roundtrip_text(reason, "sentence")


def file_version(file: Path) -> str:
    """Return the version name of a reference surface given as a file."""
    return f"{file.stem}-{sha256_file(file)[:8]}"


def load_area_polygons(site: Site) -> dict[str, shapely.Geometry]:
    """Return the outlines of the areas of a site by name, in map coordinates."""
    return {} if site.areas is None else read_polygons(site.areas.file, site.map.crs)


def load_areas(site: Site) -> dict[str, Bools]:
    """Return the cells (ny, nx) of the areas of a site by name."""
    polygons = load_area_polygons(site)
    return {name: cells_inside(polygon, site.grid_cells) for name, polygon in polygons.items()}


def sha256_log(scan: ScanFile) -> str:
    """Return the SHA-256 of a scan's inclination log, or of those of its files; '' if there is none."""
    return sha256_files(scan.logs)
