"""Where the scanner stands under an SOP, and the transformation of its shots to the map."""

from __future__ import annotations

import hashlib
from datetime import datetime
from pathlib import Path

import numpy as np
from pyproj import CRS, Transformer

from station.config import Site
from station.errors import ConfigError
from station.quantities import VERTICAL_AXIS, Floats, ScanGeometry
from station.readers.sop import read_matrix, valid_sop
from station.science.geometry import pose
from station.sections.inputs import SopSection
from station.sections.results import Origin

NO_SOP = "local"  # identity of the missing SOP of a local map


def scan_geometry(
    site: Site,
    position_m: tuple[float, float, float] | None,
    axis: tuple[float, float, float] = VERTICAL_AXIS,
) -> ScanGeometry:
    """Return the geometry and settings that are the same for all scans under one SOP.

    `position_m` is the scanner's position on the map, None if it is unknown.
    """
    grid = site.grid_cells
    return ScanGeometry(
        scanner=site.instrument,
        grid=grid,
        position_m=None if position_m is None else grid.plane.place_from_map(position_m),
        axis=axis,
        min_points=site.grid.min_points,
        published_budget=site.uncertainty.model == "voordendag2023",
        registration_sigma_m=site.uncertainty.registration_sigma_m,
        store_terms=site.uncertainty.store_terms,
    )


def sop_identity(sop: SopSection | None) -> str:
    """Return an identifier that changes with the content of the SOP file, `sop.scan` and `sop.scanner`."""
    if sop is None:
        return NO_SOP
    content = sop.file.read_bytes() + (f"\n{sop.scan}".encode() if sop.scan else b"")
    if sop.scanner is not None:
        content += f"\n{sop.scanner.model_dump_json()}".encode()
    return f"{sop.file.stem}-{hashlib.sha256(content).hexdigest()[:8]}"


def sop_identity_at(site: Site, time_utc: datetime) -> str:
    """Return an identifier of the SOPs valid at a time: that of the only one, or of all positions together.

    Raises ScanError if none has begun.
    """
    first = valid_sop(site.sop, time_utc)
    started = [sop for sop in site.sop if sop.from_ <= time_utc]
    patterns = sorted({sop.files or "" for sop in started})
    if len(patterns) <= 1:
        return sop_identity(first)
    valid = [
        valid_sop([sop for sop in started if (sop.files or "") == files], time_utc) for files in patterns
    ]
    text = "\n".join(f"{sop.files} {sop_identity(sop)}" for sop in valid if sop is not None)
    return f"positions-{hashlib.sha256(text.encode()).hexdigest()[:8]}"


def scanner_to_map(site: Site, sop: SopSection | None, matrix: Floats | None = None) -> pose.ScannerToMap:
    """Return the transformation from scanner to map under an SOP; raise ConfigError if it has none.

    `matrix` (4, 4) replaces that of the file. Without an SOP the map is the levelled frame of the scanner.
    """
    if sop is None:
        return pose.scanner_to_local_map(np.eye(4) if matrix is None else matrix)
    matrix = read_matrix(sop.file) if matrix is None else matrix
    radius_m = site.scanner_of(sop).range_max_m
    if site.map.crs is None:
        return pose.scanner_to_local_map(matrix)
    if site.map.pop is not None:
        return pose.scanner_to_map_by_pop(matrix, read_matrix(site.map.pop), site.map.crs, radius_m)
    if site.map.origin is not None:
        return pose.scanner_to_map_by_origin(matrix, _degrees(site.map.origin), site.map.crs, radius_m)
    _require_on_map(site.map.crs, matrix[:3, 3].tolist(), sop.file)
    return pose.scanner_to_map_directly(matrix, site.map.crs, radius_m)


def registered_matrix(site: Site, sop: SopSection | None, path: Path) -> Floats:
    """Return the matrix (4, 4) from scanner to project, or to a local map, that a registration file gives.

    Raises ConfigError if it holds none.
    """
    matrix = read_matrix(path)
    into_scanner = site.registration is not None and site.registration.into == "scanner"
    return np.asarray(read_matrix(sop.file) @ matrix) if into_scanner and sop is not None else matrix


def _degrees(origin: Origin) -> tuple[float, float, float]:
    return origin.latitude_deg, origin.longitude_deg, origin.height_m


def _require_on_map(crs: str, position_m: list[float], file: Path) -> None:
    """Raise ConfigError if an SOP places the scanner off the map: it probably refers to a local frame."""
    horizontal = pose.horizontal_crs(crs)
    area = CRS.from_user_input(crs).area_of_use
    to_degrees = Transformer.from_crs(horizontal, horizontal.geodetic_crs, always_xy=True)
    longitude, latitude = to_degrees.transform(position_m[0], position_m[1])
    if area is None:
        return
    inside = area.west - 1 <= longitude <= area.east + 1 and area.south - 1 <= latitude <= area.north + 1
    if not inside:
        raise ConfigError(
            f"{file}: places the scanner at easting {position_m[0]:g}, northing {position_m[1]:g}, outside"
            f" {crs} ({area.name}). If it refers to a local frame, set map.origin or map.pop, or omit"
            " map.crs"
        )


def map_position(site: Site) -> tuple[float, float, float] | None:
    """Return easting, northing and height of `map.origin` [m]; None without it."""
    if site.map.origin is None or site.map.crs is None:
        return None
    to_map = Transformer.from_crs(pose.GEOGRAPHIC, pose.horizontal_crs(site.map.crs), always_xy=True)
    latitude, longitude, height_m = _degrees(site.map.origin)
    east_m, north_m, up_m = to_map.transform(longitude, latitude, height_m)
    return float(east_m), float(north_m), float(up_m)


def scanner_height_m(site: Site, sop: SopSection | None) -> float | None:
    """Return the height of the scanner above the ellipsoid [m]; None without a map, whose zero is unknown."""
    return None if site.map.crs is None else scanner_to_map(site, sop).position_m[2]
