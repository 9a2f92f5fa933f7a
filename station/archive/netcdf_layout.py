"""NetCDF layout shared by all files of a store: dimensions, coordinates, map projection, attributes."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import netCDF4
import numpy as np
from pyproj import CRS

from station.archive import discovery
from station.archive.schema import CHANGE_LENGTH, FILL, TEXT_LENGTH, Variable
from station.grid_plane import GridPlane
from station.quantities import Grid, Scanner

CHUNK = 128  # rows and columns of a chunk
TIMES_PER_CHUNK = 512  # epochs per chunk of a variable that is small per scan, in a file of many epochs
CONVENTIONS = "CF-1.11, ACDD-1.3"
ENCODING = "utf-8"  # of texts; older files declare ascii, a subset
SCANNER_ATTRIBUTE = "scanner"  # specifications as JSON
UNCERTAINTY_ATTRIBUTE = "uncertainty_variables"
ELLIPSOIDAL = "EPSG:4979"  # heights above the ellipsoid of WGS84
EXTENTS = {  # variables: axis in the names of ACDD's attributes, attributes of the variable
    "longitude_extent": (
        "lon",
        {
            "standard_name": "longitude",
            "long_name": "western and eastern end of the grid",
            "units": "degrees_east",
        },
    ),
    "latitude_extent": (
        "lat",
        {
            "standard_name": "latitude",
            "long_name": "southern and northern end of the grid",
            "units": "degrees_north",
        },
    ),
    "height_extent": (
        "vertical",
        {
            "long_name": "lowest and highest point of the reference",
            "units": "m",
            "positive": "up",
            "axis": "Z",
        },
    ),
}
ALONG_NORMAL = "heights are distances from the plane of the grid along its normal, positive outward"
TIME_ATTRS = {
    "standard_name": "time",
    "units": "seconds since 1970-01-01 00:00:00",
    "units_metadata": "leap_seconds: none",
    "calendar": "standard",
}
RENAMED_PARAMETERS = {"refraction_moving": "refraction_ice"}  # older names of shared parameters


@dataclass(frozen=True)
class Series:
    """The store of a station: its folder, and the station's metadata written to every file."""

    folder: Path
    station_id: str
    grid: Grid
    crs: str | None
    vertical_datum: str = ""
    name: str = ""
    institution: str = ""
    metadata: tuple[tuple[str, str], ...] = ()  # global attributes that the site file gives
    scanner: Scanner | None = None
    cf_uncertainty: bool = False  # write the attributes of CF's draft on uncertainty
    plane_crs: str | None = (
        None  # map of the origin of the grid's plane, if it lies on one: then `crs` is None
    )

    @property
    def vertical_crs(self) -> str | None:
        """What heights are above: a named geoid or vertical CRS, else the ellipsoid; None on a local map."""
        if self.crs is None:
            return None
        crs = CRS.from_user_input(self.crs)
        if self.vertical_datum or not crs.is_compound:
            return self.vertical_datum or ELLIPSOIDAL
        vertical = crs.sub_crs_list[1]
        return ":".join(vertical.to_authority() or (vertical.name,))

    @property
    def has_ellipsoidal_heights(self) -> bool:
        """True if heights are above the ellipsoid of the CRS."""
        return self.vertical_crs == ELLIPSOIDAL

    @property
    def path(self) -> Path:
        """Path of `series.nc`, the file that users open."""
        return self.folder / "series.nc"

    @property
    def processing_path(self) -> Path:
        """Path of `processing.nc`: everything about each scan but the rasters."""
        return self.folder / "processing.nc"


def create_file(
    file: netCDF4.Dataset,
    series: Series,
    title: str,
    times: int | None,
    parameters: tuple[tuple[str, ...], tuple[str, ...]] = ((), ()),
    heights_m: tuple[float, float] | None = None,
) -> None:
    """Write dimensions, coordinates and metadata; no time dimension if `times` is None.

    `parameters` are the names and units of the shared parameters, `heights_m` the smallest and the largest
    height, by default those of the newest reference; NaN if there are none.
    """
    write_global_attrs(file, series, title, heights_m)
    if times is not None:
        file.createDimension("time", None)
    for axis, coordinate in (("y", series.grid.y_m), ("x", series.grid.x_m)):
        _create_axis(file, series, axis, coordinate)
    if times is not None:
        create_time_axis(file, times)
    for dim, length in TEXT_LENGTH.items():
        file.createDimension(dim, length)
    if series.crs is not None:
        create_crs(file, series)
    _create_parameter_names(file, *parameters)


def write_global_attrs(
    file: netCDF4.Dataset, series: Series, title: str, heights_m: tuple[float, float] | None = None
) -> None:
    """Write conventions, title, station, origin and extent; the extent also as variables."""
    name = series.name or series.station_id
    extent = dict(discovery.extent(series.grid, series.crs))
    heights_m = heights_m or discovery.read_heights(series.folder / "reference.nc")
    if np.isfinite(heights_m).all() and series.grid.plane.is_map:
        extent |= {"geospatial_vertical_min": heights_m[0], "geospatial_vertical_max": heights_m[1]}
    file.setncatts(
        {
            "Conventions": CONVENTIONS,
            "title": title,
            "id": series.station_id,
            "station_id": series.station_id,
            "station_name": name,
            **discovery.descriptive_attributes(name, series.institution, dict(series.metadata)),
            **extent,
            **({"geospatial_bounds_vertical_crs": series.vertical_crs} if series.vertical_crs else {}),
            **_scanner_attributes(series.scanner),
            **discovery.plane_attributes(series.grid.plane, series.plane_crs),
        }
    )
    _write_extent(file, extent)


def _write_extent(file: netCDF4.Dataset, extent: Mapping[str, str | float]) -> None:
    """Write the extent as variables: ACDD's checker finds no degrees and no heights in projected rasters."""
    if "extent" not in file.dimensions:  # not bnds: CDO would take it for a vertical axis
        file.createDimension("extent", 2)
    for name, (axis, attrs) in EXTENTS.items():
        if f"geospatial_{axis}_min" not in extent:
            continue
        if name not in file.variables:
            file.createVariable(name, "f8", ("extent",)).setncatts(attrs)
        file[name][:] = [extent[f"geospatial_{axis}_{end}"] for end in ("min", "max")]


def _scanner_attributes(scanner: Scanner | None) -> dict[str, str]:
    if scanner is None:
        return {}
    return {"instrument": scanner.model, SCANNER_ATTRIBUTE: json.dumps(asdict(scanner))}


def read_scanner(file: netCDF4.Dataset) -> Scanner | None:
    """Return the scanner that a file names; None in files of older versions."""
    if SCANNER_ATTRIBUTE not in file.ncattrs():
        return None
    values = json.loads(file.getncattr(SCANNER_ATTRIBUTE))
    return Scanner(**values | {"beam_origin_m": tuple(values["beam_origin_m"])})


def _create_axis(file: netCDF4.Dataset, series: Series, axis: str, coordinate: np.ndarray[Any, Any]) -> None:
    if "bnds" not in file.dimensions:
        file.createDimension("bnds", 2)
    file.createDimension(axis, len(coordinate))
    half_m = series.grid.cell_m / 2
    variable = file.createVariable(axis, "f8", (axis,))
    horizontal = {"axis": axis.upper()} if series.grid.plane.is_map else {}  # in CF, X and Y are horizontal
    variable.setncatts(axis_attributes(axis, series.grid.plane) | horizontal | {"bounds": f"{axis}_bnds"})
    variable[:] = coordinate
    bounds = file.createVariable(f"{axis}_bnds", "f8", (axis, "bnds"))
    half_step_m = half_m if axis == "x" else -half_m  # rows run from north to south
    bounds[:] = np.stack([coordinate - half_step_m, coordinate + half_step_m], axis=-1)


def axis_attributes(axis: str, plane: GridPlane, what: str = "") -> dict[str, str]:
    """Return name and unit of coordinates along x or y of a grid, of `what` if it is not the cells."""
    if not plane.is_map:
        direction = {"x": "along", "y": "up"}[axis]
        return {"long_name": f"distance {direction} the plane from its origin{what}", "units": "m"}
    name = {"x": "easting", "y": "northing"}[axis]
    return {"standard_name": f"projection_{axis}_coordinate", "long_name": name + what, "units": "m"}


def create_time_axis(file: netCDF4.Dataset, times: int) -> None:
    """Create the time coordinate and its bounds, chunked for a file of `times` epochs."""
    chunk_times = min(times, TIMES_PER_CHUNK)
    time = file.createVariable("time", "f8", ("time",), chunksizes=(chunk_times,))
    time.setncatts(TIME_ATTRS | {"long_name": "middle of the scan", "axis": "T", "bounds": "time_bnds"})
    file.createVariable("time_bnds", "f8", ("time", "bnds"), chunksizes=(chunk_times, 2))


def create_crs(file: netCDF4.Dataset, series: Series) -> None:
    """Write the map projection in every form that some tool needs: horizontal only, ASCII, no +type=crs.

    Each form fixes a tool that failed without it. Source: store.md, 4.
    """
    grid = series.grid
    attrs = _crs_attributes(series.crs) | {
        "GeoTransform": f"{grid.west_m!r} {grid.cell_m!r} 0 {grid.north_m!r} 0 {-grid.cell_m!r}",
    }
    if series.vertical_datum:
        attrs["geoid_name"] = series.vertical_datum
    variable = file.createVariable("crs", "i4", ())
    variable.setncatts({k: _ascii(v) for k, v in attrs.items()})
    variable[...] = 0


@lru_cache(8)
def _crs_attributes(user_crs: str) -> dict[str, Any]:
    full_crs = CRS.from_user_input(user_crs)
    crs = full_crs.sub_crs_list[0] if full_crs.is_compound else full_crs.to_2d()
    wkt = crs.to_wkt().encode("ascii", "ignore").decode()
    attrs = {k: v for k, v in crs.to_cf().items() if v not in (None, "")}
    return attrs | {"crs_wkt": wkt, "spatial_ref": wkt, "proj_params": _proj4(crs)}


def _proj4(crs: CRS) -> str:
    """Return the PROJ string without +type=crs, which makes CDO misplace the grid without an error."""
    import warnings  # noqa: PLC0415 - used here only

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # the loss of information is known; crs_wkt is complete
        text = crs.to_proj4()
    return text.replace(" +type=crs", "")


def _ascii(value: object) -> object:
    return value.encode("ascii", "ignore").decode() if isinstance(value, str) else value


def _create_parameter_names(file: netCDF4.Dataset, names: tuple[str, ...], units: tuple[str, ...]) -> None:
    if not names:
        return
    file.createDimension("parameter", len(names))
    file.createDimension("parameter_2", len(names))
    if "time" in file.dimensions:
        for dim, length in CHANGE_LENGTH.items():
            file.createDimension(dim, length)
    for name, values, long_name in (
        ("parameter_name", names, "name of the shared parameter"),
        ("parameter_unit", units, "unit of the shared parameter"),
    ):
        variable = file.createVariable(name, "S1", ("parameter", "text"))
        variable.setncatts({"long_name": long_name, "_Encoding": ENCODING})
        variable[:] = encode_text(values, "text")


def create_variable(
    file: netCDF4.Dataset,
    spec: Variable,
    series: Series,
    times: int,
    chunks: tuple[int, ...] | None = None,
) -> netCDF4.Variable[Any]:
    """Create a variable of the schema in a file of `times` epochs, by default chunked as in the store."""
    fill = {"f4": FILL, "f8": FILL, "S1": None}.get(spec.dtype, False)
    variable = file.createVariable(
        spec.name,
        spec.dtype,
        spec.dims,
        compression="zlib",
        complevel=1,
        shuffle=True,
        chunksizes=chunks or _default_chunks(file, spec, series, times),
        fill_value=fill,
        least_significant_digit=spec.digits,
    )
    variable.setncatts(attributes(spec, series))
    return variable


def _default_chunks(
    file: netCDF4.Dataset, spec: Variable, series: Series, times: int
) -> tuple[int, ...] | None:
    """Return the chunks of a variable: a map is read without its neighbours in time."""
    if spec.is_raster:
        return (1, min(CHUNK, series.grid.ny), min(CHUNK, series.grid.nx))[-len(spec.dims) :]
    if spec.is_large:
        return (1, *(len(file.dimensions[dim]) for dim in spec.dims[1:]))
    if spec.dims[:1] == ("time",):
        return (min(times, TIMES_PER_CHUNK), *(len(file.dimensions[dim]) for dim in spec.dims[1:]))
    return None


def attributes(spec: Variable, series: Series) -> dict[str, Any]:
    """Return the NetCDF attributes of a variable of the schema."""
    attrs: dict[str, Any] = {
        key: getattr(spec, key)
        for key in ("long_name", "standard_name", "units", "cell_methods", "comment", "flag_meanings")
        if getattr(spec, key) is not None
    }
    for key in ("flag_masks", "flag_values"):
        if getattr(spec, key):
            attrs[key] = np.array(getattr(spec, key), dtype=spec.dtype)
    if spec.digits is not None:  # netCDF4 writes 64 bits, which classic files cannot hold
        attrs["least_significant_digit"] = np.int32(spec.digits)
    attrs["coverage_content_type"] = _content_type(spec)
    if spec.ancillary:
        attrs["ancillary_variables"] = " ".join(spec.ancillary)
    if series.cf_uncertainty:
        attrs |= _uncertainty_attributes(spec)
    if spec.standard_name == "surface_altitude" and series.has_ellipsoidal_heights:
        attrs["standard_name"] = "height_above_reference_ellipsoid"
    if spec.is_raster and series.crs is not None:
        attrs["grid_mapping"] = "crs"
    if spec.standard_name == "air_temperature":
        attrs["units_metadata"] = "temperature: on_scale"
    if spec.dtype == "S1":
        attrs["_Encoding"] = ENCODING
    return _along_normal(attrs, spec, series.grid.plane)


def _along_normal(attrs: dict[str, Any], spec: Variable, plane: GridPlane) -> dict[str, Any]:
    """Return the attributes of a variable on a plane: there, heights are distances along its normal."""
    if plane.is_map or spec.units != "m" or not (spec.is_raster or spec.standard_name):
        return attrs
    comment = f"{spec.comment}; {ALONG_NORMAL}" if spec.comment else ALONG_NORMAL
    return {key: value for key, value in attrs.items() if key != "standard_name"} | {"comment": comment}


def _uncertainty_attributes(spec: Variable) -> dict[str, Any]:
    """Return the attributes of a draft of CF on uncertainty, as far as they are undisputed.

    Source: https://github.com/cf-convention/cf-conventions/pull/661, of August 2026.
    """
    if spec.name.endswith("_uncertainty"):
        return {
            "coverage_interval": "standard_deviation",
            "coverage_probability": 0.6827,
            "probability_distribution": "gaussian",
        }
    named = [name for name in spec.ancillary if name.endswith("_uncertainty")]
    return {UNCERTAINTY_ATTRIBUTE: " ".join(named)} if named else {}


def _content_type(spec: Variable) -> str:
    """Return the ISO 19115 code of what a variable contains."""
    if spec.flag_meanings or "uncertainty" in spec.name or "covariance" in spec.name:
        return "qualityInformation"
    return "physicalMeasurement" if spec.is_raster else "auxiliaryInformation"


def encode_text(values: Sequence[str], dim: str) -> np.ndarray[Any, Any]:
    """Return strings as characters (n, length), truncated and padded with NUL."""
    length = TEXT_LENGTH[dim]
    encoded = np.array([_truncate(value, dim) for value in values], dtype=f"S{length}")
    return encoded.view("S1").reshape(-1, length)


def roundtrip_text(value: str, dim: str) -> str:
    """Return a string as it reads back after `encode_text`, truncated to the length of `dim`."""
    return _truncate(value, dim).decode(ENCODING)


def _truncate(value: str, dim: str) -> bytes:
    """Encode as many whole characters as fit; characters that cannot be encoded become question marks."""
    prefix = value.encode(ENCODING, "replace")[: TEXT_LENGTH[dim]]
    return prefix.decode(ENCODING, "ignore").encode(ENCODING)


def decode_text(characters: np.ndarray[Any, Any]) -> list[str]:
    """Return characters (n, length) as strings; inverse of `encode_text`."""
    rows = np.ascontiguousarray(characters).view(f"S{characters.shape[-1]}")
    joined_bytes = b"\0".join(rows[:, 0].tolist())
    return joined_bytes.decode(ENCODING, "replace").split("\0") if len(rows) else []  # one call for all


def decode_parameters(characters: np.ndarray[Any, Any]) -> list[str]:
    """Return the names of shared parameters in a file; files of older versions get the names of today."""
    return [RENAMED_PARAMETERS.get(name, name) for name in decode_text(characters)]
