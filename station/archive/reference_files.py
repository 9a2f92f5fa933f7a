"""`reference.nc`: the reference surface from which change is measured, with all its versions."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import netCDF4
import numpy as np

from station.archive.atomic_files import atomic_write
from station.archive.discovery import NO_HEIGHTS, time_coverage
from station.archive.netcdf_layout import (
    RENAMED_PARAMETERS,
    TIME_ATTRS,
    Series,
    create_file,
    create_variable,
    decode_parameters,
)
from station.archive.raster_io import LazyRaster, rounded, write_rasters
from station.archive.read_errors import read_errors
from station.archive.schema import FILL, Variable
from station.archive.small_variables import read_variable, text_attribute
from station.errors import StoreError
from station.quantities import Floats, Floats32, Reference, SharedParameters, VarianceComponents
from station.science.geometry.terrain import HALO_ROWS, known_cell_means

# Prefix of the attributes with the variance components of the station, one sigma each.
COMPONENT_PREFIX = "component_"
MEAN_ELEVATION = "reference_mean_elevation"
_VARIABLES = (
    Variable(
        "reference_elevation", ("y", "x"), "f4", "elevation of the reference surface at the cell centre", "m",
        "surface_altitude", 3, None, "bilinear between cell centres",
    ),
    Variable(
        "reference_mean_residual", ("y", "x"), "f4",
        "mean height of the reference's scans above its surface in the cell", "m", None, 4, None,
        "elevation changes are counted from the surface plus this height",
    ),
    Variable(
        MEAN_ELEVATION, ("y", "x"), "f4",
        "elevation of the reference, mean over the cell", "m", "surface_altitude", 4, None,
        "elevation changes are counted from it: mean of reference_elevation over the cell, plus"
        " reference_mean_residual",
    ),
    Variable(
        "reference_random_uncertainty", ("y", "x"), "f4", "random uncertainty of the reference surface", "m",
        None, 4, None, "one standard deviation of a single cell",
    ),
    Variable(
        "reference_roughness", ("y", "x"), "f4",
        "standard deviation of the terrain around the reference surface within the cell", "m", None, 4,
    ),
    Variable(
        "reference_variance_factor",
        ("y", "x"),
        "f4",
        "ratio of empirical to modelled random variance of the cell between scans",
        "1",
        None,
        3,
    ),
    Variable(
        "reference_intensity", ("y", "x"), "f4", "mean echo intensity of the cell, 0 to 1", "1", None, 6
    ),
    Variable(
        "reference_stable", ("y", "x"), "i1", "stable ground: steep and without change", None, None,
        flag_values=(0, 1), flag_meanings="other stable",
    ),
    Variable(
        "reference_visibility", ("y", "x"), "f4", "share of the scans that observed the cell", "1", None, 3
    ),
    Variable(
        "reference_point_count", ("y", "x"), "f4", "number of points of the cell in a scan", "1", None, 2,
        None, "mean of the scans that observed it",
    ),
    Variable(
        "shared_parameter", ("parameter",), "f8",
        "mean state of the scanner in the scans of the reference, relative to the SOP",
        comment="units are those in parameter_unit; change is not corrected for it",
    ),
    Variable(
        "shared_parameter_line_tilt_variance", ("parameter",), "f8",
        "variance of the tilt of each group of scan lines in excess of the parameter",
        comment="units are squares of parameter_unit",
    ),
    Variable(
        "shared_parameter_covariance", ("parameter", "parameter_2"), "f8",
        "covariance of the parameters shared by all points of the reference",
        comment="units are products of parameter_unit",
    ),
)  # fmt: skip


@dataclass(frozen=True)
class ReferenceProvenance:
    """Provenance of a version of the reference; `base` is the version whose moving ground it shares."""

    base: str
    science_hash: str = ""
    replaces: tuple[str, ...] = ()  # superseded versions with the same base
    scan_provenance: tuple[dict[str, str], ...] = ()  # epoch provenance of each of its scans, values as JSON

    @property
    def scan_ids(self) -> list[str]:
        """Scans that this version was built from."""
        return [json.loads(provenance["scan_id"]) for provenance in self.scan_provenance]


def version_path(series: Series, version: str) -> Path:
    """Return the file of a version of the reference."""
    return series.folder / f"reference_{version}.nc"


def reference_path(series: Series, version: str) -> Path:
    """Return the file to read a version from: its own file if it exists, otherwise `reference.nc`."""
    path = version_path(series, version)
    return path if path.is_file() else series.folder / "reference.nc"


def versions(series: Series) -> list[str]:
    """Return the versions built by the station itself, oldest first."""
    names = (path.stem.removeprefix("reference_") for path in series.folder.glob("reference_*.nc"))
    return sorted((version for version in names if version.isdigit()), key=int)


def valid_versions(series: Series) -> dict[str, ReferenceProvenance]:
    """Return the versions built by the station that epochs may be measured against, oldest first.

    They share the moving ground of the newest version, so that change refers to one surface.
    """
    provenances = {version: read_reference_provenance(series, version) for version in versions(series)}
    if not provenances:
        return {}
    base = list(provenances.values())[-1].base
    replaced = {version for provenance in provenances.values() for version in provenance.replaces}
    return {
        version: provenance
        for version, provenance in provenances.items()
        if provenance.base == base and version not in replaced
    }


def read_reference_provenance(series: Series, version: str) -> ReferenceProvenance:
    """Return the provenance of a version; raise StoreError if it cannot be read."""
    path = version_path(series, version)
    with read_errors(path), h5py.File(path, "r") as file:
        return ReferenceProvenance(
            base=text_attribute(file, "base", version),
            science_hash=text_attribute(file, "science_hash", ""),
            replaces=tuple(text_attribute(file, "replaces", "").split()),
            scan_provenance=tuple(json.loads(text_attribute(file, "scan_provenance", "[]"))),
        )


def write_reference(
    series: Series, reference: Reference, provenance: ReferenceProvenance | None = None
) -> None:
    """Write a version of the reference, and make `reference.nc` a hard link to it.

    Without a provenance, the version is its own base. Raises StoreError if it cannot be written.
    """
    provenance = provenance or ReferenceProvenance(reference.version)
    path = version_path(series, reference.version)
    with atomic_write(path) as tmp_path:
        with netCDF4.Dataset(tmp_path, "w", clobber=False) as file:
            _write(file, series, reference, provenance)
        rasters = [spec for spec in _VARIABLES if spec.is_raster]
        write_rasters(
            tmp_path, rasters, lambda grid_rows: map(rounded, rasters, _raster_rows(reference, grid_rows))
        )
    _link_newest(series, path)


def _write(
    file: netCDF4.Dataset, series: Series, reference: Reference, provenance: ReferenceProvenance
) -> None:
    """Write everything but the values of the rasters, whose variables are created."""
    shared = reference.shared
    parameters = (shared.names, shared.units) if shared is not None else ((), ())
    title = f"Reference surface of {series.name or series.station_id}"
    create_file(file, series, title, None, parameters, _heights_m(reference))
    file.setncatts({"reference_version": reference.version, "scan_ids": " ".join(reference.scan_ids)})
    file.setncattr("mean_time", reference.time_s)
    if reference.sop_scan_count is not None:
        file.setncattr("sop_scan_count", reference.sop_scan_count)
    file.setncatts({"base": provenance.base, "science_hash": provenance.science_hash})
    file.setncatts({"replaces": " ".join(provenance.replaces)})
    file.setncatts({"scan_provenance": json.dumps(provenance.scan_provenance)})
    if provenance.scan_provenance:
        starts_s, ends_s = (
            [float(scan[name]) for scan in provenance.scan_provenance] for name in ("start_s", "end_s")
        )
        file.setncatts(time_coverage(min(starts_s), max(ends_s)))
        file.createDimension("scan", len(starts_s))
        time = file.createVariable("scan_time", "f8", ("scan",))
        time.setncatts(TIME_ATTRS | {"long_name": "middle of each scan of the reference"})
        time[:] = (np.array(starts_s) + ends_s) / 2
    file.setncatts(
        {f"{COMPONENT_PREFIX}{name}": value for name, value in asdict(reference.components).items()}
    )
    for spec in _VARIABLES:
        if all(dim in file.dimensions for dim in spec.dims):
            create_variable(file, spec, series, 1)
    if shared is not None:
        file["shared_parameter"][:] = shared.estimate
        file["shared_parameter_covariance"][:] = shared.covariance
        file["shared_parameter_line_tilt_variance"][:] = shared.line_tilt_variance


def _heights_m(reference: Reference) -> tuple[float, float]:
    """Return the smallest and the largest height of the surface as stored [m]; NaN if none is known."""
    known_m = reference.elevation_m[np.isfinite(reference.elevation_m)]
    if not known_m.size:
        return NO_HEIGHTS
    low_m, high_m = rounded(_VARIABLES[0], np.array([known_m.min(), known_m.max()]))
    return float(low_m), float(high_m)


def _raster_rows(reference: Reference, rows: slice) -> list[np.ndarray[Any, Any]]:
    """Return a block of rows of each raster, in the order of `_VARIABLES`."""
    return [
        reference.elevation_m[rows],
        reference.mean_residual_m[rows],
        _stored_mean_elevation(reference, rows),
        np.sqrt(reference.random_variance_m2[rows]),
        np.sqrt(reference.roughness_m2[rows]),
        reference.variance_factor[rows],
        reference.intensity[rows],
        reference.stable[rows],
        reference.visibility[rows],
        reference.point_count[rows].astype(np.float32),  # which holds the fill value
    ]


def _stored_mean_elevation(reference: Reference, rows: slice) -> Floats:
    """Return the mean elevation of cells (r, nx) [m] by the stored values, which change is counted from."""
    halo = slice(max(rows.start - HALO_ROWS, 0), rows.stop + HALO_ROWS)
    elevation, mean_residual, *_ = _VARIABLES
    elevation_m = _replace_fill(rounded(elevation, reference.elevation_m[halo]))
    mean_residual_m = _replace_fill(rounded(mean_residual, reference.mean_residual_m[halo]))
    inner = slice(rows.start - halo.start, rows.stop - halo.start)
    return _mean_elevation(elevation_m, mean_residual_m, inner, slice(0, reference.grid.nx))


def _mean_elevation(
    elevation_m: Floats | Floats32, mean_residual_m: Floats32, rows: slice, columns: slice
) -> Floats:
    """Return the mean elevation of cells in a window of a reference (r, c) [m]: change is counted from it."""
    return known_cell_means(elevation_m, rows, columns) + mean_residual_m[rows, columns]


def open_mean_elevation(
    series: Series, version: str
) -> Callable[[slice, slice], np.ndarray[Any, Any]] | None:
    """Return a function that reads the mean elevation of cells in a window of a reference (r, c) [m].

    None without the file of the version. Older files do not contain it: it is computed.
    """
    reference, path = open_reference(series, version), reference_path(series, version)
    if reference is None:
        return None
    with read_errors(path), h5py.File(path, "r") as file:
        is_stored = MEAN_ELEVATION in file
    if not is_stored:
        return partial(_mean_elevation, reference.elevation_m, reference.mean_residual_m)
    raster = LazyRaster(path, MEAN_ELEVATION, _replace_fill)
    return lambda rows, columns: raster[rows, columns]


def repair_reference_link(series: Series) -> None:
    """Link `reference.nc` to the newest version, in case a power cut prevented it.

    Raises StoreError if it cannot be linked.
    """
    newest = max(series.folder.glob("reference_*.nc"), key=_written_ns, default=None)
    link = series.folder / "reference.nc"
    if newest is not None and (not link.is_file() or _written_ns(link) < _written_ns(newest)):
        _link_newest(series, newest)


def _link_newest(series: Series, path: Path) -> None:
    with atomic_write(series.folder / "reference.nc") as tmp_path:
        os.link(path, tmp_path)


def _written_ns(path: Path) -> int:
    return path.stat().st_mtime_ns


def read_reference(series: Series, version: str | None = None) -> Reference | None:
    """Return the newest reference or a version, read into memory; None if there is none.

    Raises StoreError if it cannot be read or is on another grid.
    """
    reference = open_reference(series, version)
    if reference is None:
        return None
    rasters: dict[str, Any] = {name: np.asarray(getattr(reference, name)) for name, _, _ in _RASTER_FIELDS}
    return replace(reference, **rasters)


def open_reference(series: Series, version: str | None = None) -> Reference | None:
    """Return the reference as `read_reference` does, but with rasters that are read on access.

    If the file of a version is missing, as in a partial copy, `reference.nc` serves if it is that version.
    """
    path = series.folder / "reference.nc" if version is None else reference_path(series, version)
    if not path.is_file():
        return None
    with read_errors(path), h5py.File(path, "r") as file:
        stored_version = text_attribute(file, "reference_version")
        if version not in (None, stored_version):
            return None
        return _reference_from_file(file, reference_path(series, stored_version), series)


def read_variance_components(series: Series) -> VarianceComponents:
    """Return the variance components in the newest reference; start values if there is none."""
    path = series.folder / "reference.nc"
    if not path.is_file():
        return VarianceComponents()
    with read_errors(path), h5py.File(path, "r") as file:
        return _read_components(file)


def _reference_from_file(file: h5py.File, path: Path, series: Series) -> Reference:
    grid = series.grid
    if (
        file["x"].shape != (grid.nx,)
        or file["y"].shape != (grid.ny,)
        or (abs(file["x"][0] - grid.x_m[0]) + abs(file["y"][0] - grid.y_m[0]) > 1e-6)
    ):
        raise StoreError(f"{file.filename}: is on another grid: move it away or restore [grid]")
    shared = None
    if "parameter_name" in file:
        names, units = (
            tuple(decode_parameters(read_variable(file, name)))
            for name in ("parameter_name", "parameter_unit")
        )
        estimate = np.zeros(len(names))
        if "shared_parameter" in file:  # absent from references of early versions
            estimate = np.asarray(file["shared_parameter"][:], dtype=np.float64)
        covariance = np.asarray(file["shared_parameter_covariance"][:], dtype=np.float64)
        line_tilt_variance = np.asarray(file["shared_parameter_line_tilt_variance"][:], dtype=np.float64)
        shared = SharedParameters(names, units, estimate, covariance, line_tilt_variance)
    rasters: dict[str, Any] = {
        field: LazyRaster(path, name, transform) for field, name, transform in _RASTER_FIELDS if name in file
    }
    rasters.setdefault("point_count", np.broadcast_to(np.float16(np.nan), grid.shape))  # of early versions
    return Reference(
        grid=grid,
        version=text_attribute(file, "reference_version"),
        shared=shared,
        scan_ids=tuple(text_attribute(file, "scan_ids").split()),
        time_s=float(file.attrs["mean_time"].item()),
        components=_read_components(file),
        sop_scan_count=int(file.attrs["sop_scan_count"].item()) if "sop_scan_count" in file.attrs else None,
        **rasters,
    )


def _read_components(file: h5py.File) -> VarianceComponents:
    older = {name: old for old, name in RENAMED_PARAMETERS.items()}

    def component(name: str) -> float:
        stored = f"{COMPONENT_PREFIX}{name}"
        older_name = f"{COMPONENT_PREFIX}{older.get(name, name)}"
        return float(file.attrs[stored if stored in file.attrs else older_name].item())

    return VarianceComponents(**{field.name: component(field.name) for field in fields(VarianceComponents)})


def _replace_fill(values: np.ndarray[Any, Any], fill: float = np.nan) -> Floats32:
    return np.where(values == np.float32(FILL), np.float32(fill), values)


_RASTER_FIELDS: tuple[tuple[str, str, Callable[[np.ndarray[Any, Any]], np.ndarray[Any, Any]]], ...] = (
    ("elevation_m", "reference_elevation", lambda values: _replace_fill(values).astype(np.float64)),
    ("mean_residual_m", "reference_mean_residual", _replace_fill),
    ("random_variance_m2", "reference_random_uncertainty", lambda values: _replace_fill(values) ** 2),
    ("roughness_m2", "reference_roughness", lambda values: _replace_fill(values) ** 2),
    ("variance_factor", "reference_variance_factor", lambda values: _replace_fill(values, 1.0)),
    ("intensity", "reference_intensity", _replace_fill),
    ("stable", "reference_stable", lambda values: values == 1),
    ("visibility", "reference_visibility", _replace_fill),
    ("point_count", "reference_point_count", lambda values: _replace_fill(values).astype(np.float16)),
)
