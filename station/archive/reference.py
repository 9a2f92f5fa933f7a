"""`reference.nc`: the master surface that change is measured from."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import netCDF4
import numpy as np

from station.archive.layout import Series, define, lay_out, strings, written_whole
from station.archive.rasters import Raster, rounded, write_rasters
from station.archive.variables import FILL, Variable
from station.errors import StoreError
from station.quantities import Floats32, Habits, Reference, Shared

HABIT = "habit_"  # of the station, one sigma each, attributes of the file
_ROWS = (
    Variable(
        "reference_elevation", ("y", "x"), "f4", "elevation of the reference surface at the cell centre", "m",
        "surface_altitude", 3, None, "bilinear between cell centres",
    ),
    Variable(
        "reference_random_uncertainty", ("y", "x"), "f4", "random uncertainty of the reference surface", "m",
        None, 4, None, "one standard deviation, of a single cell",
    ),
    Variable(
        "reference_roughness",
        ("y", "x"),
        "f4",
        "standard deviation of the terrain about the reference surface within the cell",
        "m",
        None,
        4,
    ),
    Variable(
        "reference_variance_factor",
        ("y", "x"),
        "f4",
        "random variance of a cell from scan to scan against the modelled",
        "1",
        None,
        3,
    ),
    Variable(
        "reference_intensity", ("y", "x"), "f4", "mean brightness of the cell's echoes, 0 to 1", "1", None, 4
    ),
    Variable(
        "reference_stable", ("y", "x"), "i1", "ground found stable: steep and without change", None, None,
        flag_values=(0, 1), flag_meanings="other stable",
    ),
    Variable("reference_seen", ("y", "x"), "f4", "share of the scans that saw the cell", "1", None, 3),
    Variable(
        "shared_parameter_noise_variance", ("parameter",), "f8",
        "variance of the lean of each group of scan lines beyond the parameter",
        comment="units are squares of parameter_unit",
    ),
    Variable(
        "shared_parameter_covariance", ("parameter", "parameter_2"), "f8",
        "covariance of what all points of the reference share",
        comment="units are products of parameter_unit",
    ),
)  # fmt: skip


@dataclass(frozen=True)
class Lineage:
    """What a version of the reference was made from: `base` is the version whose moving ground it shares."""

    base: str
    science_hash: str = ""
    replaces: tuple[str, ...] = ()  # versions of that base that nothing is to be measured from any more
    made_from: tuple[dict[str, str], ...] = ()  # of each of its scans, what an epoch tells of its origin


def path_of(series: Series, version: str) -> Path:
    """Return the file of a version of the reference."""
    return series.folder / f"reference_{version}.nc"


def held_at(series: Series, version: str) -> Path:
    """Return where a version of the reference is to be read: by its own name, where it has one."""
    own = path_of(series, version)
    return own if own.is_file() else series.folder / "reference.nc"


def versions(series: Series) -> list[str]:
    """Return the versions made by the station itself, oldest first."""
    found = (path.stem.removeprefix("reference_") for path in series.folder.glob("reference_*.nc"))
    return sorted((version for version in found if version.isdigit()), key=int)


def current(series: Series) -> dict[str, Lineage]:
    """Return the versions made by the station that epochs may be measured from, oldest first.

    They share the moving ground of the newest, so that change counts from the same surface.
    """
    told = {version: read_lineage(series, version) for version in versions(series)}
    if not told:
        return {}
    base = list(told.values())[-1].base
    replaced = {version for lineage in told.values() for version in lineage.replaces}
    return {
        version: lineage
        for version, lineage in told.items()
        if lineage.base == base and version not in replaced
    }


def read_lineage(series: Series, version: str) -> Lineage:
    """Return what a version was made from; raise StoreError where it cannot be read."""
    path = path_of(series, version)
    try:
        with netCDF4.Dataset(path) as file:
            known = set(file.ncattrs())
            return Lineage(
                base=str(file.base) if "base" in known else version,
                science_hash=str(file.science_hash) if "science_hash" in known else "",
                replaces=tuple(str(file.replaces).split()) if "replaces" in known else (),
                made_from=tuple(json.loads(str(file.made_from))) if "made_from" in known else (),
            )
    except (OSError, RuntimeError, ValueError) as error:
        raise StoreError(f"{path}: cannot be read: {error}") from error


def write_reference(series: Series, reference: Reference, lineage: Lineage | None = None) -> None:
    """Write a version of the reference for good, and `reference.nc` as another name of the newest.

    Without a lineage it stands for itself. Raises StoreError where it cannot.
    """
    lineage = lineage or Lineage(reference.version)
    kept = path_of(series, reference.version)
    with written_whole(kept) as beside:
        with netCDF4.Dataset(beside, "w", clobber=False) as file:
            _write(file, series, reference, lineage)
        rasters = [row for row in _ROWS if row.is_raster]
        write_rasters(beside, rasters, lambda rows: map(rounded, rasters, _band(reference, rows)))
    _name_newest(series, kept)


def _write(file: netCDF4.Dataset, series: Series, reference: Reference, lineage: Lineage) -> None:
    """Write all but the rasters, for which there is room."""
    shared = reference.shared
    parameters = (shared.names, shared.units) if shared is not None else ((), ())
    lay_out(file, series, f"Reference surface of {series.name or series.station_id}", None, parameters)
    file.setncatts({"reference_version": reference.version, "scan_ids": " ".join(reference.scan_ids)})
    file.setncatts({"base": lineage.base, "science_hash": lineage.science_hash})
    file.setncatts({"replaces": " ".join(lineage.replaces)})
    file.setncatts({"made_from": json.dumps(lineage.made_from)})
    file.setncatts({f"{HABIT}{name}": value for name, value in asdict(reference.habits).items()})
    for row in _ROWS:
        if all(dim in file.dimensions for dim in row.dims):
            define(file, row, series, 1)
    if shared is not None:
        file["shared_parameter_covariance"][:] = shared.covariance
        file["shared_parameter_noise_variance"][:] = shared.noise_variance


def _band(reference: Reference, rows: slice) -> list[np.ndarray[Any, Any]]:
    """Return some rows of what lies on the grid, in the order of `_ROWS`."""
    return [
        reference.elevation_m[rows],
        np.sqrt(reference.random_variance_m2[rows]),
        np.sqrt(reference.roughness_m2[rows]),
        reference.variance_factor[rows],
        reference.intensity[rows],
        reference.stable[rows],
        reference.seen[rows],
    ]


def settle_reference(series: Series) -> None:
    """Have `reference.nc` be the newest version, also where the power went between the two names.

    Raises StoreError where it cannot.
    """
    newest = max(series.folder.glob("reference_*.nc"), key=_written_ns, default=None)
    named = series.folder / "reference.nc"
    if newest is not None and (not named.is_file() or _written_ns(named) < _written_ns(newest)):
        _name_newest(series, newest)


def _name_newest(series: Series, kept: Path) -> None:
    with written_whole(series.folder / "reference.nc") as beside:
        os.link(kept, beside)


def _written_ns(path: Path) -> int:
    return path.stat().st_mtime_ns


def read_reference(series: Series, version: str | None = None) -> Reference | None:
    """Read the newest reference or a version; None where there is none; StoreError where it fits no grid."""
    held = open_reference(series, version)
    if held is None:
        return None
    whole: dict[str, Any] = {name: np.asarray(getattr(held, name)) for name, _, _ in _HELD}
    return replace(held, **whole)


def open_reference(series: Series, version: str | None = None) -> Reference | None:
    """Return as `read_reference` does, but read the rasters only as rows of them are looked at."""
    path = series.folder / "reference.nc" if version is None else path_of(series, version)
    if not path.is_file():
        return None
    try:
        with netCDF4.Dataset(path) as file:
            return _opened(file, held_at(series, str(file.reference_version)), series)
    except (OSError, RuntimeError, KeyError, IndexError, AttributeError) as error:
        raise StoreError(f"{path}: cannot be read: {error}") from error


def read_habits(series: Series) -> Habits:
    """Read what the newest reference says of the station's habits; start values where there is none."""
    path = series.folder / "reference.nc"
    if not path.is_file():
        return Habits()
    try:
        with netCDF4.Dataset(path) as file:
            return _habits(file)
    except (OSError, RuntimeError, AttributeError) as error:
        raise StoreError(f"{path}: cannot be read: {error}") from error


def _opened(file: netCDF4.Dataset, path: Path, series: Series) -> Reference:
    grid = series.grid
    if (
        file["x"].shape != (grid.nx,)
        or file["y"].shape != (grid.ny,)
        or (abs(file["x"][0] - grid.x_m[0]) + abs(file["y"][0] - grid.y_m[0]) > 1e-6)
    ):
        raise StoreError(f"{file.filepath()}: is of another grid: move it away or restore [grid]")
    file.set_auto_chartostring(False)
    shared = None
    if "parameter_name" in file.variables:
        names, units = (
            tuple(strings(np.ma.getdata(file[name][:]))) for name in ("parameter_name", "parameter_unit")
        )
        covariance = np.asarray(file["shared_parameter_covariance"][:], dtype=np.float64)
        noise = np.asarray(file["shared_parameter_noise_variance"][:], dtype=np.float64)
        shared = Shared(names, units, np.zeros(len(names)), covariance, noise)
    rasters: dict[str, Any] = {
        field: Raster(path, name, made) for field, name, made in _HELD if name in file.variables
    }
    return Reference(
        grid=grid,
        version=str(file.reference_version),
        shared=shared,
        scan_ids=tuple(str(file.scan_ids).split()),
        habits=_habits(file),
        **rasters,
    )


def _habits(file: netCDF4.Dataset) -> Habits:
    return Habits(**{field.name: float(file.getncattr(f"{HABIT}{field.name}")) for field in fields(Habits)})


def _filled(values: np.ndarray[Any, Any], fill: float = np.nan) -> Floats32:
    return np.where(values == np.float32(FILL), np.float32(fill), values)


_HELD: tuple[tuple[str, str, Callable[[np.ndarray[Any, Any]], np.ndarray[Any, Any]]], ...] = (
    ("elevation_m", "reference_elevation", lambda values: _filled(values).astype(np.float64)),
    ("random_variance_m2", "reference_random_uncertainty", lambda values: _filled(values) ** 2),
    ("roughness_m2", "reference_roughness", lambda values: _filled(values) ** 2),
    ("variance_factor", "reference_variance_factor", lambda values: _filled(values, 1.0)),
    ("intensity", "reference_intensity", _filled),
    ("stable", "reference_stable", lambda values: values == 1),
    ("seen", "reference_seen", _filled),
)
