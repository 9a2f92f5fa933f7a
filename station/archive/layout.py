"""The frame all files of a store have in common: who, where, which variables; and how a file comes to be."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import netCDF4
import numpy as np
from pyproj import CRS

from station import __version__
from station.archive.variables import CHANGE_LENGTH, FILL, TEXT_LENGTH, Variable
from station.errors import StoreError
from station.quantities import Grid

CHUNK = 128  # rows and columns stored together
TIMES_TOGETHER = 512  # of a variable that is small per scan, in a file of as many
CONVENTIONS = "CF-1.11"
ENCODING = "utf-8"  # of texts; files of old that say ascii are the same


@dataclass(frozen=True)
class Series:
    """A station's store: where it lies and what its files say of the station."""

    folder: Path
    station_id: str
    grid: Grid
    crs: str | None
    vertical_datum: str = ""
    name: str = ""
    institution: str = ""

    @property
    def path(self) -> Path:
        """The file that people open."""
        return self.folder / "series.nc"


@contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """Give a place beside `path` to write to; move it to `path` when all of it is on the disk.

    Raises StoreError where it cannot; then nothing is left of it.
    """
    beside = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        beside.unlink(missing_ok=True)  # of a process that was killed and had the same number
        yield beside
        with beside.open("rb") as file:
            os.fsync(file.fileno())
        beside.replace(path)
        _sync_folders(path.parent)
    except (OSError, RuntimeError) as error:  # the netCDF library loses the errno of a full disk
        raise StoreError(f"{path}: cannot be written: {error}") from error
    finally:
        with suppress(OSError):  # where even that cannot be: the sweep takes it, in time
            beside.unlink(missing_ok=True)


def _sync_folders(folder: Path) -> None:
    """Make a new name, and the new folders it may stand in, last."""
    for place in (folder, *list(folder.parents)[:4]):
        if not os.access(place, os.R_OK):
            return
        descriptor = os.open(place, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def lay_out(
    file: netCDF4.Dataset,
    series: Series,
    title: str,
    times: int | None,
    parameters: tuple[tuple[str, ...], tuple[str, ...]] = ((), ()),
) -> None:
    """Write dimensions, coordinates and metadata. `times` None: no time dimension."""
    introduce(file, series, title)
    if times is not None:
        file.createDimension("time", None)
    for axis, coordinate in (("y", series.grid.y_m), ("x", series.grid.x_m)):
        _axis(file, series, axis, coordinate)
    if times is not None:
        time_axis(file, times)
    for dim, length in TEXT_LENGTH.items():
        file.createDimension(dim, length)
    if series.crs is not None:
        _crs(file, series)
    _parameters(file, *parameters)


def introduce(file: netCDF4.Dataset, series: Series, title: str) -> None:
    """Write what a file is and where it comes from."""
    file.setncatts(
        {
            "Conventions": CONVENTIONS,
            "title": title,
            "institution": series.institution or "not given",
            "source": "terrestrial laser scanner, permanently mounted",
            "history": f"written by station {__version__}",
            "station_id": series.station_id,
            "station_name": series.name or series.station_id,
        }
    )


def _axis(file: netCDF4.Dataset, series: Series, axis: str, coordinate: np.ndarray[Any, Any]) -> None:
    if "bnds" not in file.dimensions:
        file.createDimension("bnds", 2)
    file.createDimension(axis, len(coordinate))
    half_m = series.grid.cell_m / 2
    variable = file.createVariable(axis, "f8", (axis,))
    variable.setncatts(
        {
            "standard_name": f"projection_{axis}_coordinate",
            "long_name": {"x": "easting", "y": "northing"}[axis],
            "units": "m",
            "axis": axis.upper(),
            "bounds": f"{axis}_bnds",
        }
    )
    variable[:] = coordinate
    bounds = file.createVariable(f"{axis}_bnds", "f8", (axis, "bnds"))
    towards = half_m if axis == "x" else -half_m  # rows run southward
    bounds[:] = np.stack([coordinate - towards, coordinate + towards], axis=-1)


def time_axis(file: netCDF4.Dataset, times: int) -> None:
    """Create time and its bounds, of so many times, on the dimensions `time` and `bnds`."""
    together = min(times, TIMES_TOGETHER)
    time = file.createVariable("time", "f8", ("time",), chunksizes=(together,))
    time.setncatts(
        {
            "standard_name": "time",
            "long_name": "middle of the scan",
            "units": "seconds since 1970-01-01 00:00:00",
            "units_metadata": "leap_seconds: none",
            "calendar": "standard",
            "axis": "T",
            "bounds": "time_bnds",
        }
    )
    file.createVariable("time_bnds", "f8", ("time", "bnds"), chunksizes=(together, 2))


def _crs(file: netCDF4.Dataset, series: Series) -> None:
    """Say the map in every way some tool needs; each was a measured break (horizontal, ASCII, no +type)."""
    given = CRS.from_user_input(series.crs)
    crs = given.sub_crs_list[0] if given.is_compound else given.to_2d()
    told = {k: v for k, v in crs.to_cf().items() if v not in (None, "")}
    wkt = crs.to_wkt().encode("ascii", "ignore").decode()
    grid = series.grid
    told |= {
        "crs_wkt": wkt,
        "spatial_ref": wkt,
        "GeoTransform": f"{grid.west_m!r} {grid.cell_m!r} 0 {grid.north_m!r} 0 {-grid.cell_m!r}",
        "proj_params": _proj4(crs),
    }
    if series.vertical_datum:
        told["geoid_name"] = series.vertical_datum
    variable = file.createVariable("crs", "i4", ())
    variable.setncatts({k: _ascii(v) for k, v in told.items()})
    variable[...] = 0


def _proj4(crs: CRS) -> str:
    """Return the PROJ string as CDO needs it: with +type=crs it puts the grid in the wrong place silently."""
    import warnings  # noqa: PLC0415 - only here

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # that it loses information is known: crs_wkt keeps it
        text = crs.to_proj4()
    return text.replace(" +type=crs", "")


def _ascii(value: object) -> object:
    return value.encode("ascii", "ignore").decode() if isinstance(value, str) else value


def _parameters(file: netCDF4.Dataset, names: tuple[str, ...], units: tuple[str, ...]) -> None:
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
        variable[:] = text(values, "text")


def define(file: netCDF4.Dataset, row: Variable, series: Series, times: int) -> netCDF4.Variable[Any]:
    """Create a variable of the table in a file of so many times."""
    chunks = None
    if row.is_raster:
        height, width = min(CHUNK, series.grid.ny), min(CHUNK, series.grid.nx)
        chunks = (1, height, width)[-len(row.dims) :]
    elif row.is_heavy:
        chunks = (1, *(len(file.dimensions[dim]) for dim in row.dims[1:]))
    elif row.dims[:1] == ("time",):
        chunks = (min(times, TIMES_TOGETHER), *(len(file.dimensions[dim]) for dim in row.dims[1:]))
    fill = {"f4": FILL, "f8": FILL, "S1": None}.get(row.dtype, False)
    variable = file.createVariable(
        row.name,
        row.dtype,
        row.dims,
        compression="zlib",
        complevel=1,
        shuffle=True,
        chunksizes=chunks,
        fill_value=fill,
        least_significant_digit=row.digits,
    )
    variable.setncatts(attributes(row, mapped=series.crs is not None))
    return variable


def attributes(row: Variable, *, mapped: bool) -> dict[str, Any]:
    """Return the attributes of a variable of the table."""
    told: dict[str, Any] = {
        key: getattr(row, key)
        for key in ("long_name", "standard_name", "units", "cell_methods", "comment", "flag_meanings")
        if getattr(row, key) is not None
    }
    for key in ("flag_masks", "flag_values"):
        if getattr(row, key):
            told[key] = np.array(getattr(row, key), dtype=row.dtype)
    if row.digits is not None:  # netCDF's own is 64 bits wide, which classic files cannot hold
        told["least_significant_digit"] = np.int32(row.digits)
    if row.is_raster and mapped:
        told["grid_mapping"] = "crs"
    if row.standard_name == "air_temperature":
        told["units_metadata"] = "temperature: on_scale"
    if row.dtype == "S1":
        told["_Encoding"] = ENCODING
    return told


def text(values: Sequence[str], dim: str) -> np.ndarray[Any, Any]:
    """Return strings as characters (n, length), cut and filled with NUL."""
    length = TEXT_LENGTH[dim]
    told = np.array([_cut(value, dim) for value in values], dtype=f"S{length}")
    return told.view("S1").reshape(-1, length)


def kept_of(value: str, dim: str) -> str:
    """Return a string as it is read again: what `text` keeps of it."""
    return _cut(value, dim).decode(ENCODING)


def _cut(value: str, dim: str) -> bytes:
    """Encode as many whole characters as there is room for; what no encoding has becomes a question mark."""
    room = value.encode(ENCODING, "replace")[: TEXT_LENGTH[dim]]
    return room.decode(ENCODING, "ignore").encode(ENCODING)


def strings(characters: np.ndarray[Any, Any]) -> list[str]:
    """Return characters (n, length) as strings: what `text` was given."""
    rows = np.ascontiguousarray(characters).view(f"S{characters.shape[-1]}")
    together = b"\0".join(rows[:, 0].tolist())
    return together.decode(ENCODING, "replace").split("\0") if len(rows) else []  # all at once
