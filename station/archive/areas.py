"""`areas.nc`: mean and volume change of named areas over time, made from the epochs."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import astuple
from pathlib import Path
from typing import Any, Protocol

import h5py
import netCDF4
import numpy as np

from station.archive.aggregate import AreaChange
from station.archive.layout import (
    TIMES_TOGETHER,
    Series,
    define,
    introduce,
    strings,
    time_axis,
    written_whole,
)
from station.archive.sources import ORDINARY, read_source, runs, take_over
from station.archive.store import Named, Row
from station.archive.variables import BY_NAME, FILL, TEXT, TEXT_LENGTH, Variable
from station.quantities import Bools
from station.science.change import SIGNIFICANT_SIGMAS

Columns = dict[str, np.ndarray[Any, Any]]  # all that lies over time, as it stands in the file

MASKS = "area_masks_sha256"
LACKING = -1
_OVER_TIME = ("time", "area")
_ONE_SIGMA = "one standard deviation, with what all cells of a scan share and what was interpolated"


def _of(quantity: str, told: str, units: str, comment: str) -> tuple[Variable, ...]:
    """Return the variables of a quantity: its value, one sigma, and between what it lies at 95 %."""
    return (
        Variable(quantity, _OVER_TIME, "f8", f"{told} of the area", units, comment=comment),
        Variable(
            f"{quantity}_uncertainty",
            _OVER_TIME,
            "f8",
            f"uncertainty of the {told}",
            units,
            comment=_ONE_SIGMA,
        ),
        Variable(f"{quantity}_low", _OVER_TIME, "f8", f"lower end of the {told} at 95 %", units),
        Variable(f"{quantity}_high", _OVER_TIME, "f8", f"upper end of the {told} at 95 %", units),
    )


AREA_VARIABLES: tuple[Variable, ...] = (
    Variable("area_name", ("area", "area_text"), "S1", "name of the area"),
    Variable("area_size", ("area",), "f8", "horizontal size of the area's cells on the grid", "m2"),
    *_of(
        "mean_change", "mean elevation change", "m",
        "against the reference surface; cells without a change are interpolated from those around them",
    ),
    *_of("median_change", "median elevation change", "m", "of the cells that have a change"),
    *_of("volume_change", "volume change", "m3", "mean_change times area_size"),
    Variable("coverage", _OVER_TIME, "f8", "share of the area's cells that have a change", "1"),
    BY_NAME["epoch_file"],
    BY_NAME["reference_version"],
)  # fmt: skip


class Aggregator(Protocol):
    """What knows how an area changed and how sure that is."""

    def area(self, cells: Bools, row: Row) -> AreaChange:
        """How the cells (ny, nx) changed in an epoch; NaN where none has a change."""


def update_areas(
    series: Series, areas: dict[str, Bools], aggregator: Aggregator, progress: Callable[[], None]
) -> Path | None:
    """Make `areas.nc` agree with `series.nc`; `areas` are cells (ny, nx) by name.

    Epochs it already holds are not computed again unless an area has changed. Returns None, and writes
    nothing, where there is no area or no epoch. `progress` is called after each epoch computed. Raises
    StoreError where an epoch is damaged or it cannot write; then the old file stays.
    """
    found = Named(series) if areas else ()
    if not found:
        return None
    path = series.folder / "areas.nc"
    masks = fingerprint(series, areas)
    whole, known = _read(path, masks, len(areas), found)
    place = {key: index for index, key in enumerate(_keys(known["time"], _names(known["epoch_file"])))}
    at = [place.get(key, LACKING) for key in _keys(found.time_s[whole:], found.epoch_file[whole:])]
    if at == list(range(len(place))):
        return path
    size_m2 = np.array([np.count_nonzero(cells) for cells in areas.values()]) * series.grid.cell_m**2
    lacking = [found[whole + index] for index, place in enumerate(at) if place == LACKING]
    measured = _measure(lacking, areas, size_m2, aggregator, progress)
    is_known = np.array(at) != LACKING
    columns = _blank(len(at), len(areas))
    for name, column in columns.items():
        column[is_known] = known[name][[index for index in at if index != LACKING]]
        column[~is_known] = measured[name]
    with written_whole(path) as beside:
        with netCDF4.Dataset(beside, "w", clobber=False) as file:
            _write(file, series, tuple(areas), size_m2, columns, whole)
            file.setncattr(MASKS, masks)
        if whole:
            with h5py.File(path, "r") as old, h5py.File(beside, "r+", libver=ORDINARY) as file:
                take_over(old, file, tuple(columns), whole)
    return path


def fingerprint(series: Series, areas: dict[str, Bools]) -> str:
    """Identify areas by their names, their order and their cells, and the grid these are of."""
    told = hashlib.sha256(json.dumps([astuple(series.grid), list(areas)]).encode())
    for cells in areas.values():
        told.update(np.packbits(cells).tobytes())
    return told.hexdigest()


def is_of(path: Path, series: Series, areas: dict[str, Bools]) -> bool:
    """Tell whether a file holds the series of just these areas."""
    try:
        with h5py.File(path, "r") as file:
            return bool(file.attrs[MASKS] == np.bytes_(fingerprint(series, areas)))
    except (OSError, RuntimeError, KeyError):
        return False


def _blank(times: int, areas: int) -> Columns:
    """Return columns without any value."""
    return {
        "time": np.zeros(times),
        "time_bnds": np.zeros((times, 2)),
        **{row.name: np.full((times, areas), FILL) for row in AREA_VARIABLES if row.dims == _OVER_TIME},
        **{
            row.name: np.zeros((times, TEXT_LENGTH["text"]), "S1")
            for row in AREA_VARIABLES
            if row.dims == TEXT
        },
    }


def _keys(time_s: np.ndarray[Any, Any], epoch_file: np.ndarray[Any, Any]) -> list[tuple[float, bytes]]:
    """Return what tells one epoch from another: its time and file."""
    return list(zip(time_s.tolist(), epoch_file.tolist(), strict=True))


def _names(letters: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Return characters (n, length) as names (n,)."""
    return np.ascontiguousarray(letters).view(f"S{letters.shape[-1]}")[:, 0]


def _read(path: Path, masks: str, areas: int, named: Named) -> tuple[int, Columns]:
    """Read what the file holds of these areas: how many epochs stand as they are, and what comes after them.

    Those that stand fill whole chunks. Nothing where the file is not there, damaged or of other areas.
    """
    blank = _blank(0, areas)
    try:
        with h5py.File(path, "r") as file:
            if file.attrs[MASKS] != np.bytes_(masks):
                return 0, blank
            times = len(file["time"])
            if any(file[name].shape != (times, *column.shape[1:]) for name, column in blank.items()):
                return 0, blank
            stands = np.array_equal(file["time"][:], named.time_s[:times])
            stands = stands and np.array_equal(_names(file["epoch_file"][:]), named.epoch_file[:times])
            stands = stands and all(file[name].chunks[0] == TIMES_TOGETHER for name in blank)
            whole = times // TIMES_TOGETHER * TIMES_TOGETHER if stands else 0
            return whole, {
                name: np.asarray(file[name][whole:], dtype=column.dtype) for name, column in blank.items()
            }
    except (OSError, RuntimeError, KeyError, TypeError, ValueError):
        return 0, blank


def _measure(
    lacking: list[Row],
    areas: dict[str, Bools],
    size_m2: np.ndarray[Any, Any],
    aggregator: Aggregator,
    progress: Callable[[], None],
) -> Columns:
    """Compute the columns of some epochs; where there was no reference yet, nothing is known."""
    columns = _blank(len(lacking), len(areas))
    for path, first, at, count in runs(lacking):
        words = read_source(path, first, at, count).words
        for name in ("time", "time_bnds", "epoch_file", "reference_version"):
            columns[name][at : at + count] = words[name]
    for index, version in enumerate(strings(columns["reference_version"])):
        for area, cells in enumerate(areas.values()):
            if version and size_m2[area] > 0:
                told = figures(aggregator.area(cells, lacking[index]), float(size_m2[area]))
                for name, value in told.items():
                    columns[name][index, area] = value if np.isfinite(value) else FILL
        progress()
    return columns


def figures(found: AreaChange, size_m2: float) -> dict[str, float]:
    """Return what is told of the change of an area of that size, by the names of the variables."""
    told: dict[str, float] = {}
    for name, value, sigma in (
        ("mean_change", found.mean_m, found.mean_sigma_m),
        ("median_change", found.median_m, found.median_sigma_m),
        ("volume_change", found.mean_m * size_m2, found.mean_sigma_m * size_m2),
    ):
        half = SIGNIFICANT_SIGMAS * sigma
        told |= {
            name: value,
            f"{name}_uncertainty": sigma,
            f"{name}_low": value - half,
            f"{name}_high": value + half,
        }
    return told | {"coverage": found.coverage}


def _write(
    file: netCDF4.Dataset,
    series: Series,
    names: tuple[str, ...],
    size_m2: np.ndarray[Any, Any],
    columns: Columns,
    first: int,
) -> None:
    """Write the areas, and their columns from the `first` epoch on."""
    times = first + len(columns["time"])
    spelt = np.array([name.encode() for name in names])
    introduce(file, series, f"Elevation change of areas at {series.name or series.station_id}")
    for dim, length in {
        "time": None,
        "bnds": 2,
        "area": len(names),
        "area_text": spelt.dtype.itemsize,
        "text": TEXT_LENGTH["text"],
    }.items():
        file.createDimension(dim, length)
    time_axis(file, times)
    for row in AREA_VARIABLES:
        variable = define(file, row, series, times)
        if row.dims == _OVER_TIME:
            variable.coordinates = "area_name"  # a label: CDO and NCO carry it on, xarray selects by it
    file.set_auto_mask(False)
    file.set_auto_chartostring(False)
    file["area_name"].setncattr("_Encoding", "utf-8")
    letters = spelt.view("S1").reshape(len(names), -1)
    file["area_name"][:], file["area_size"][:] = letters, size_m2
    for name, column in columns.items():
        file[name][first:times] = column
