"""Write an epoch, never lose one; say what is stored."""

from __future__ import annotations

import os
import re
from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import overload

import h5py
import netCDF4
import numpy as np
from isal.igzip_lib import IsalError

from station.archive.layout import Series, define, lay_out, strings, text, written_whole
from station.archive.rasters import Array, rounded, write_rasters
from station.archive.tiles import column
from station.archive.variables import BY_NAME, TERMS, TEXT_LENGTH, VARIABLES, VERDICTS
from station.errors import StoreError
from station.quantities import Grid, Measurement, Shared

STAMP = "%Y%m%dT%H%M%SZ"
JOINED = {"days": "%Y%m%d", "months": "%Y%m"}  # kinds of joined files, by how each names its time
COLUMNS = {  # of a measurement, by variable
    "elevation": "elevation_m",
    "elevation_change": "change_m",
    "elevation_change_uncertainty": "uncertainty_m",
    "elevation_change_random_uncertainty": "random_uncertainty_m",
    "elevation_spread": "spread_m",
    "point_count": "count",
    "quality": "quality",
}
AIR = ("air_temperature", "air_pressure", "relative_humidity")  # variables, told where weather was known
_EPOCH_NAME = re.compile(r"_(\d{8}T\d{6}Z)(?:_r(\d+))?\.nc$")

Seen = Callable[[slice, Mapping[str, Array]], None]


@dataclass(frozen=True)
class Epoch:
    """One scan, measured.

    `numbers` are by the name of a variable over time; `provenance` is by the name of a text variable.
    """

    start_s: float  # seconds since 1970
    end_s: float
    scan_id: str
    measurement: Measurement
    shared: Shared | None
    verdict: str
    verdict_reason: str
    numbers: dict[str, float]
    provenance: dict[str, str]


@dataclass(frozen=True)
class Stored:
    """An epoch file: when its scan began, and which revision of that it is."""

    path: Path
    start: datetime
    revision: int


@dataclass(frozen=True)
class Row:
    """One epoch and where it is: a file and the index in it."""

    epoch_file: str
    start: datetime
    revision: int
    path: Path
    index: int
    time_s: float


def write_epoch(series: Series, epoch: Epoch, newer_than: int = 0, seen: Seen | None = None) -> Stored:
    """Write an epoch beside the series; raise StoreError where it cannot, and leave nothing then.

    A second epoch of the same start is a new revision, also where the journal remembers one (`newer_than`)
    whose file is lost; no file is ever changed. `seen` is shown its rasters as they are written, some rows of
    the grid at a time: to lay them out once more would take as long as a quarter of the writing.
    """
    start = datetime.fromtimestamp(epoch.start_s, UTC)
    known = [0, *(one.revision for one in revisions(series, start))]
    for kind, stamp in JOINED.items():  # after the sweep an epoch may be there only
        for path in joined(series, kind, start.strftime(stamp)):
            known += [row.revision for row in rows_in(path) if row.start == start]
    revision = 1 + max(newer_than, *known)
    tail = f"_r{revision}" if revision > 1 else ""
    path = epoch_folder(series, start) / f"{series.station_id}_{start.strftime(STAMP)}{tail}.nc"
    with written_whole(path) as beside:
        with netCDF4.Dataset(beside, "w", clobber=False) as file:
            _write(file, series, epoch, path.name)
        columns = _columns(epoch.measurement)
        rows = {column: BY_NAME[name] for name, column in columns.items()}

        def band(part: slice) -> list[Array]:
            laid = epoch.measurement.laid(
                *rows, rows=part, made=lambda column, values: rounded(rows[column], values)
            )
            if seen is not None:
                seen(part, dict(zip(columns, laid, strict=True)))
            return laid

        write_rasters(beside, list(rows.values()), band)
    return Stored(path, start, revision)


def epoch_folder(series: Series, start: datetime) -> Path:
    """Return the folder of the epochs of a day."""
    return series.folder / "epochs" / start.strftime("%Y") / start.strftime("%m") / start.strftime("%d")


def revisions(series: Series, start: datetime) -> list[Stored]:
    """Return the epoch files of one start, oldest first."""
    pattern = f"{series.station_id}_{start.strftime(STAMP)}*.nc"
    found = (stored(path) for path in epoch_folder(series, start).glob(pattern))
    return sorted((one for one in found if one), key=lambda one: one.revision)


def epochs(series: Series) -> list[Stored]:
    """Return all epoch files, by start and revision."""
    found = (stored(path) for path in (series.folder / "epochs").glob("*/*/*/*.nc"))
    return sorted((one for one in found if one), key=lambda one: (one.start, one.revision))


def stored(path: Path) -> Stored | None:
    """Read start and revision off the name of an epoch file; None for another file."""
    told = _EPOCH_NAME.search(path.name)
    if told is None or path.name.startswith("."):
        return None
    start = datetime.fromisoformat(told[1])
    return Stored(path, start, int(told[2] or 1))


def listing(series: Series) -> set[str]:
    """Return every file that holds epochs, relative to the store."""
    found = set()
    for kind in ("epochs", *JOINED):
        for folder, _, names in os.walk(series.folder / kind):
            place = os.path.relpath(folder, series.folder)
            found |= {f"{place}/{name}" for name in names if name.endswith(".nc") and name[0] != "."}
    return found


def joined(series: Series, kind: str, name: str = "*") -> list[Path]:
    """Return the joined files of `kind` (days or months) and of the day or month `name`, oldest first."""
    found = (series.folder / kind).glob(f"**/{series.station_id}_{name}_r*.nc")
    return sorted(found, key=lambda path: (path.name.rpartition("_r")[0], joined_revision(path)))


def joined_revision(path: Path) -> int:
    """Read off its name which revision of its day or month a joined file is."""
    tail = path.stem.rpartition("_r")[2]
    return int(tail) if tail.isdigit() else 0


def rows_in(path: Path) -> list[Row]:
    """Return the epochs in a file; raise StoreError where it is damaged."""
    try:
        with h5py.File(path, "r") as file:
            times = np.asarray(file["time"][:], dtype=np.float64).tolist()
            names = strings(file["epoch_file"][:])
    except (OSError, RuntimeError, KeyError) as error:
        raise StoreError(f"{path}: damaged, cannot be read: {error}") from error
    found = []
    for index, (time_s, name) in enumerate(zip(times, names, strict=True)):
        told = stored(Path(name))
        if told is None:
            raise StoreError(f"{path}: damaged, names no epoch file in row {index}")
        found.append(Row(name, told.start, told.revision, path, index, time_s))
    return found


def rows(series: Series) -> list[Row]:
    """Return the epochs of the series in the order of time: of each start the newest revision.

    Where several files hold it, months go before days before epochs, and a newer joined file before an older.
    """
    best: dict[datetime, tuple[tuple[int, int, int], Row]] = {}
    for rank, kind in enumerate(JOINED, start=1):
        for path in joined(series, kind):
            for row in rows_in(path):
                key = (row.revision, rank, joined_revision(path))
                if row.start not in best or key > best[row.start][0]:
                    best[row.start] = key, row
    newest = {one.start: one for one in epochs(series)}  # they come oldest revision first
    for start, one in newest.items():
        if start not in best or one.revision > best[start][0][0]:
            best[start] = (one.revision, 0, 0), rows_in(one.path)[0]
    return _increasing(sorted((row for _, row in best.values()), key=lambda row: (row.time_s, row.start)))


def _increasing(found: list[Row]) -> list[Row]:
    """Leave out epochs whose time is not after the one before: two scans cannot share a middle."""
    kept: list[Row] = []
    for row in found:
        if not kept or row.time_s > kept[-1].time_s:
            kept.append(row)
    return kept


class Named(Sequence[Row]):
    """The epochs that a `series.nc` names, as it tells them: no other file is opened, no row made in vain.

    `time_s` and `start_s` (n,) are in seconds since 1970, `epoch_file` (n,) holds names as bytes.
    """

    def __init__(self, series: Series) -> None:
        """Raise StoreError where it cannot be read; without a series there are none."""
        self.time_s, self.start_s = np.empty((2, 0))
        self.epoch_file = np.empty(0, f"S{TEXT_LENGTH['text']}")
        self._at: list[int] = []  # row at which each file begins
        self._there: list[tuple[Path, int]] = []
        if not series.path.is_file():
            return
        try:
            with h5py.File(series.path, "r") as file:
                self.time_s = np.asarray(file["time"][:], dtype=np.float64)
                self.start_s = np.asarray(file["time_bnds"][:, 0], dtype=np.float64)
                self.epoch_file = column(file["epoch_file"]).view(self.epoch_file.dtype)[:, 0]
                for one in file["elevation"].virtual_sources():
                    whole = one.src_space.get_select_type() == h5py.h5s.SEL_ALL
                    first = 0 if whole else one.src_space.get_select_bounds()[0][0]
                    self._at.append(one.vspace.get_select_bounds()[0][0])
                    self._there.append((series.folder / one.file_name, first))
        except (OSError, RuntimeError, KeyError, ValueError, IsalError) as error:  # type: ignore[misc] # the stub has no class
            raise StoreError(f"{series.path}: damaged, cannot be read: {error}") from error

    @property
    def files(self) -> set[Path]:
        """Return the files they lie in."""
        return {path for path, _ in self._there}

    def __len__(self) -> int:
        """Return how many there are."""
        return len(self.time_s)

    @overload
    def __getitem__(self, at: int) -> Row: ...

    @overload
    def __getitem__(self, at: slice) -> list[Row]: ...

    def __getitem__(self, at: int | slice) -> Row | list[Row]:
        """Return an epoch, or several."""
        if isinstance(at, slice):
            return [self[index] for index in range(*at.indices(len(self)))]
        index = range(len(self))[at]
        name = self.epoch_file[index].decode("ascii")
        told = stored(Path(name))
        if told is None:
            raise StoreError(f"series.nc: damaged, names no epoch file in row {index}")
        place = bisect_right(self._at, index) - 1
        path, first = self._there[place]
        there = first + index - self._at[place]
        return Row(name, told.start, told.revision, path, there, float(self.time_s[index]))


def sources(series_path: Path) -> set[Path]:
    """Return the files that a `series.nc` points to; none where there is no series."""
    if not series_path.is_file():
        return set()
    try:
        with h5py.File(series_path, "r") as file:
            return {series_path.parent / one.file_name for one in file["elevation"].virtual_sources()}
    except (OSError, RuntimeError, KeyError) as error:
        raise StoreError(f"{series_path}: damaged, cannot be read: {error}") from error


def said(path: Path) -> dict[str, str]:
    """Return what an epoch file says of its origin: its text variables; raise StoreError if unreadable."""
    try:
        with netCDF4.Dataset(path) as file:
            return {
                row.name: str(file[row.name][0])
                for row in VARIABLES
                if row.dtype == "S1" and row.name in file.variables
            } | {"verdict": VERDICTS[int(file["verdict"][0])]}
    except (OSError, RuntimeError) as error:
        raise StoreError(f"{path}: cannot be read: {error}") from error


def air_in(path: Path) -> tuple[float, ...]:
    """Return the air an epoch was measured in, () where it is not known; raise StoreError if unreadable."""
    try:
        with netCDF4.Dataset(path) as file:
            found = [file[name][0] for name in AIR if name in file.variables]
    except (OSError, RuntimeError) as error:
        raise StoreError(f"{path}: cannot be read: {error}") from error
    return () if len(found) < len(AIR) or np.ma.is_masked(found[0]) else tuple(map(float, found))


def folder_of(site_or_folder: str | Path) -> Path:
    """Return the data folder of a site file, or the folder itself."""
    place = Path(site_or_folder)
    if place.is_file() and place.suffix == ".toml":
        from station.config import read_site  # noqa: PLC0415 - a folder needs no pydantic

        return read_site(place).station.data
    return place


def series_in(site_or_folder: str | Path) -> Series:
    """Return the store that lies in a folder; raise StoreError where there is none yet."""
    folder = folder_of(site_or_folder)
    try:
        with netCDF4.Dataset(folder / "series.nc") as file:
            x_m, y_m = (np.asarray(file[axis][:], dtype=np.float64) for axis in "xy")
            x_bounds, y_bounds = (file[f"{axis}_bnds"][0] for axis in "xy")
            west_m, north_m = float(x_bounds.min()), float(y_bounds.max())
            grid = Grid(west_m, north_m, float(np.ptp(x_bounds)), len(x_m), len(y_m))
            crs = str(file["crs"].crs_wkt) if "crs" in file.variables else None
            return Series(folder, str(file.station_id), grid, crs)
    except (OSError, RuntimeError, KeyError, IndexError, AttributeError) as error:
        raise StoreError(f"{folder}: no series to be read there (station status): {error}") from error


def _write(file: netCDF4.Dataset, series: Series, epoch: Epoch, name: str) -> None:
    shared = epoch.shared
    parameters = (shared.names, shared.units) if shared is not None else ((), ())
    title = f"Elevation change at {series.name or series.station_id}, one scan"
    lay_out(file, series, title, 1, parameters)
    file["time"][0] = (epoch.start_s + epoch.end_s) / 2
    file["time_bnds"][0] = (epoch.start_s, epoch.end_s)
    for variable in _columns(epoch.measurement):
        define(file, BY_NAME[variable], series, 1)
    if shared is not None:
        define(file, BY_NAME["shared_parameter"], series, 1)[0] = shared.estimate
        define(file, BY_NAME["shared_parameter_covariance"], series, 1)[0] = shared.covariance
        define(file, BY_NAME["shared_parameter_noise_variance"], series, 1)[0] = shared.noise_variance
        if shared.change is not None:
            define(file, BY_NAME["change_errors"], series, 1)[0] = shared.change.modes
            define(file, BY_NAME["change_pattern"], series, 1)[0] = shared.change.pattern
    _write_words(file, series, epoch, name)


def _columns(measured: Measurement) -> dict[str, str]:
    """Return what is kept of each cell, by variable."""
    return COLUMNS | {term: term for term in TERMS if term in measured.terms}


def _write_words(file: netCDF4.Dataset, series: Series, epoch: Epoch, name: str) -> None:
    """Write what there is one of per scan: numbers and texts."""
    words = {
        "scan_id": epoch.scan_id,
        "verdict_reason": epoch.verdict_reason,
        "epoch_file": name,
        **epoch.provenance,
    }
    for row in VARIABLES:
        if row.dims == ("time",):
            value = VERDICTS.index(epoch.verdict) if row.name == "verdict" else epoch.numbers.get(row.name)
            variable = define(file, row, series, 1)
            variable[0] = value if value is not None and np.isfinite(value) else np.ma.masked
        elif row.dtype == "S1":
            define(file, row, series, 1)[0] = text([words.get(row.name, "")], row.dims[1])[0]
