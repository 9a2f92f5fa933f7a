"""Epoch files: writing them, listing them, reading their metadata."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import h5py
import netCDF4
import numpy as np

from station.archive.atomic_files import atomic_write
from station.archive.derived.computed_rasters import (
    CHANGE,
    OUTSIDE,
    RANDOM,
    SYSTEMATIC,
    TOTAL,
    is_value,
    other_part,
)
from station.archive.discovery import read_heights, time_coverage
from station.archive.netcdf_layout import Series, create_file, create_variable, decode_text, encode_text
from station.archive.raster_io import Array, rounded, write_rasters
from station.archive.reference_files import version_path
from station.archive.schema import BY_NAME, FILL, TERMS, VARIABLES, VERDICTS
from station.archive.small_variables import write_epochs
from station.errors import StoreError
from station.quantities import Floats, Measurement, Quality, SharedParameters

TIME_FORMAT = "%Y%m%dT%H%M%SZ"
COMPACTED = {"days": "%Y%m%d", "months": "%Y%m"}  # kinds of compacted files: time format in their names
MEASUREMENT_VARIABLES = {  # column of the measurement, by variable
    OUTSIDE: "elevation_m",
    CHANGE: "change_m",
    TOTAL: "uncertainty_m",
    SYSTEMATIC: "systematic_uncertainty_m",
    "elevation_spread": "spread_m",
    "point_count": "count",
    "quality": "quality",
}
AIR_VARIABLES = ("air_temperature", "air_pressure", "relative_humidity")  # if weather was measured
_EPOCH_FILENAME = re.compile(r"_(\d{8}T\d{6}Z)(?:_r(\d+))?\.nc$")

RowObserver = Callable[[slice, Mapping[str, Array]], None]


@dataclass(frozen=True)
class Epoch:
    """Result of one scan.

    `scalars` are keyed by the name of a variable over time, `provenance` by the name of a text variable.
    """

    start_s: float  # seconds since 1970
    end_s: float
    scan_id: str
    measurement: Measurement
    shared: SharedParameters | None
    verdict: str
    verdict_reason: str
    scalars: dict[str, float]
    provenance: dict[str, str]
    redundancy: Floats | None = None  # (p,) of the shared parameters


@dataclass(frozen=True)
class EpochFile:
    """An epoch file: path, start of the scan, revision."""

    path: Path
    start: datetime
    revision: int


@dataclass(frozen=True)
class EpochRef:
    """One epoch and its location: a file and the index in it."""

    epoch_file: str
    start: datetime
    revision: int
    path: Path
    index: int
    time_s: float


def write_epoch(
    series: Series, epoch: Epoch, newer_than: int = 0, on_rows: RowObserver | None = None
) -> EpochFile:
    """Write an epoch file and return it; on StoreError no file remains.

    A second epoch with the same start becomes a new revision, numbered above `newer_than`, the last revision
    in the journal, even if that file is lost. Existing files are never changed. `on_rows` receives the
    rasters block by block while they are written; laying them out again would cost a quarter of the writing.
    """
    start = datetime.fromtimestamp(epoch.start_s, UTC)
    known_revisions = [0, *(epoch_file.revision for epoch_file in revisions(series, start))]
    for kind, stamp in COMPACTED.items():  # after `delete_expired` an epoch may exist only here
        for path in compacted_files(series, kind, start.strftime(stamp)):
            known_revisions += [
                compacted_epoch.revision
                for compacted_epoch in epochs_in_file(path)
                if compacted_epoch.start == start
            ]
    revision = 1 + max(newer_than, *known_revisions)
    suffix = f"_r{revision}" if revision > 1 else ""
    path = epoch_folder(series, start) / f"{series.station_id}_{start.strftime(TIME_FORMAT)}{suffix}.nc"
    with atomic_write(path) as tmp_path:
        values = _small_values(epoch, path.name)
        with netCDF4.Dataset(tmp_path, "w", clobber=False) as file:
            _create(file, series, epoch, values)
        with h5py.File(tmp_path, "r+") as file:
            write_epochs(file, values)
        columns = _measurement_variables(epoch.measurement)
        specs = {column: BY_NAME[name] for name, column in columns.items()}

        def get_rows(block: slice) -> list[Array]:
            rasters = epoch.measurement.to_rasters(
                *specs, rows=block, transform=lambda column, values: rounded(specs[column], values)
            )
            by_name = dict(zip(columns, rasters, strict=True))
            by_name["quality"][~is_value(by_name[OUTSIDE])] |= Quality.NOT_SEEN
            by_name[OUTSIDE][is_value(by_name[CHANGE])] = FILL
            if on_rows is not None:
                on_rows(block, by_name | {RANDOM: other_part(by_name[TOTAL], by_name[SYSTEMATIC])})
            return rasters

        write_rasters(tmp_path, list(specs.values()), get_rows)
    return EpochFile(path, start, revision)


def epoch_folder(series: Series, start: datetime) -> Path:
    """Return the folder of the epoch files of a day."""
    return series.folder / "epochs" / start.strftime("%Y") / start.strftime("%m") / start.strftime("%d")


def revisions(series: Series, start: datetime) -> list[EpochFile]:
    """Return the epoch files with this start, oldest revision first."""
    pattern = f"{series.station_id}_{start.strftime(TIME_FORMAT)}*.nc"
    files = (parse_epoch_filename(path) for path in epoch_folder(series, start).glob(pattern))
    return sorted(
        (epoch_file for epoch_file in files if epoch_file), key=lambda epoch_file: epoch_file.revision
    )


def epoch_files(series: Series) -> list[EpochFile]:
    """Return all epoch files, sorted by start and revision."""
    files = (parse_epoch_filename(path) for path in (series.folder / "epochs").glob("*/*/*/*.nc"))
    return sorted(
        (epoch_file for epoch_file in files if epoch_file),
        key=lambda epoch_file: (epoch_file.start, epoch_file.revision),
    )


def parse_epoch_filename(path: Path) -> EpochFile | None:
    """Return start and revision from the name of an epoch file; None if it is not one."""
    match = _EPOCH_FILENAME.search(path.name)
    if match is None or path.name.startswith("."):
        return None
    start = datetime.fromisoformat(match[1])
    return EpochFile(path, start, int(match[2] or 1))


def list_files(series: Series) -> set[str]:
    """Return all files that contain epochs, relative to the folder of the store."""
    files = set()
    for kind in ("epochs", *COMPACTED):
        for folder, _, names in os.walk(series.folder / kind):
            relative_folder = os.path.relpath(folder, series.folder)
            files |= {
                f"{relative_folder}/{name}" for name in names if name.endswith(".nc") and name[0] != "."
            }
    return files


def compacted_files(series: Series, kind: str, name: str = "*") -> list[Path]:
    """Return the compacted files of `kind` (days or months) for the day or month `name`, oldest first."""
    paths = (series.folder / kind).glob(f"**/{series.station_id}_{name}_r*.nc")
    return sorted(paths, key=lambda path: (path.name.rpartition("_r")[0], compacted_revision(path)))


def compacted_revision(path: Path) -> int:
    """Return the revision in the name of a compacted file."""
    revision = path.stem.rpartition("_r")[2]
    return int(revision) if revision.isdigit() else 0


def epochs_in_file(path: Path) -> list[EpochRef]:
    """Return the epochs in a file; raise StoreError if it is damaged."""
    try:
        with h5py.File(path, "r") as file:
            times = np.asarray(file["time"][:], dtype=np.float64).tolist()
            names = decode_text(file["epoch_file"][:])
    except (OSError, RuntimeError, KeyError) as error:
        raise StoreError(f"{path}: damaged, cannot be read: {error}") from error
    refs = []
    for index, (time_s, name) in enumerate(zip(times, names, strict=True)):
        epoch_file = parse_epoch_filename(Path(name))
        if epoch_file is None:
            raise StoreError(f"{path}: damaged, entry {index} names no epoch file")
        refs.append(EpochRef(name, epoch_file.start, epoch_file.revision, path, index, time_s))
    return refs


def read_provenance(path: Path) -> dict[str, str]:
    """Return the text variables of an epoch file, and its verdict; raise StoreError if unreadable."""
    try:
        with netCDF4.Dataset(path) as file:
            return {
                spec.name: str(file[spec.name][0])
                for spec in VARIABLES
                if spec.dtype == "S1" and spec.name in file.variables
            } | {"verdict": VERDICTS[int(file["verdict"][0])]}
    except (OSError, RuntimeError) as error:
        raise StoreError(f"{path}: cannot be read: {error}") from error


def read_air(path: Path) -> tuple[float, ...]:
    """Return air temperature [°C], pressure [hPa] and humidity [%] of an epoch; () if not known.

    Raises StoreError if the file cannot be read.
    """
    try:
        with netCDF4.Dataset(path) as file:
            values = [file[name][0] for name in AIR_VARIABLES if name in file.variables]
    except (OSError, RuntimeError) as error:
        raise StoreError(f"{path}: cannot be read: {error}") from error
    return () if len(values) < len(AIR_VARIABLES) or np.ma.is_masked(values[0]) else tuple(map(float, values))


def _create(file: netCDF4.Dataset, series: Series, epoch: Epoch, values: Mapping[str, Array]) -> None:
    """Create the file of an epoch with all its variables."""
    shared = epoch.shared
    parameters = (shared.names, shared.units) if shared is not None else ((), ())
    title = f"Elevation change at {series.name or series.station_id}, one scan"
    measured_from = version_path(series, epoch.provenance.get("reference_version", ""))
    create_file(file, series, title, 1, parameters, read_heights(measured_from))
    file.setncatts(time_coverage(epoch.start_s, epoch.end_s))
    names = values.keys() | _measurement_variables(epoch.measurement)
    for spec in VARIABLES:
        if spec.name in names:
            create_variable(file, spec, series, 1)


def _measurement_variables(measurement: Measurement) -> dict[str, str]:
    """Return the stored columns of a measurement, by variable."""
    return MEASUREMENT_VARIABLES | {term: term for term in TERMS if term in measurement.terms}


def _small_values(epoch: Epoch, name: str) -> dict[str, Array]:
    """Return the values (1, …) of every variable of the file `name` but the rasters."""
    texts = {
        "scan_id": epoch.scan_id,
        "verdict_reason": epoch.verdict_reason,
        "epoch_file": name,
        **epoch.provenance,
    }
    valid_count = int(np.count_nonzero(np.isfinite(epoch.measurement.change_m)))
    numbers: dict[str, float] = {
        **epoch.scalars,
        "verdict": VERDICTS.index(epoch.verdict),
        "valid_count": valid_count,
    }
    values: dict[str, Array] = {
        "time": np.array([(epoch.start_s + epoch.end_s) / 2]),
        "time_bnds": np.array([(epoch.start_s, epoch.end_s)]),
    }
    for spec in VARIABLES:
        if spec.dims == ("time",):
            value = numbers.get(spec.name, np.nan)
            values[spec.name] = np.array([value if np.isfinite(value) else FILL])
        elif spec.dtype == "S1":
            values[spec.name] = encode_text([texts.get(spec.name, "")], spec.dims[1])
    return values | _shared_values(epoch)


def _shared_values(epoch: Epoch) -> dict[str, Array]:
    """Return the values (1, …) of the shared parameters."""
    shared = epoch.shared
    if shared is None:
        return {}
    values = {
        "shared_parameter": shared.estimate,
        "shared_parameter_covariance": shared.covariance,
        "shared_parameter_line_tilt_variance": shared.line_tilt_variance,
    }
    if epoch.redundancy is not None:
        values["shared_parameter_redundancy"] = epoch.redundancy
    if shared.change_errors is not None:
        values["change_errors"] = shared.change_errors.modes
        values["change_pattern"] = shared.change_errors.polar_change
    return {name: np.asarray(value)[np.newaxis] for name, value in values.items()}
