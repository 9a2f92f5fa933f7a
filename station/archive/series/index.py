"""Index of a store: its epochs in order of time, from the files themselves or from `series.nc` alone."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

import h5py
import netCDF4
import numpy as np

from station.archive.chunk_codec import read_column
from station.archive.derived.computed_rasters import CHANGE
from station.archive.discovery import read_plane
from station.archive.epochs import (
    COMPACTED,
    EpochRef,
    compacted_files,
    compacted_revision,
    epoch_files,
    epochs_in_file,
    list_files,
    parse_epoch_filename,
)
from station.archive.netcdf_layout import Series, read_scanner
from station.archive.read_errors import read_errors
from station.archive.schema import TEXT_LENGTH, VERDICTS
from station.archive.series.epoch_reader import middle
from station.errors import StationError, StoreError
from station.quantities import Bools, Grid

if TYPE_CHECKING:
    from station.config import Site

NEAREST_TOLERANCE_S = 12 * 3600.0  # so that a date finds the first or last epoch of its day
Array = np.ndarray[Any, Any]

MAX_TRIED = 5  # files of the store, if the newest are damaged


def list_epochs(series: Series) -> list[EpochRef]:
    """Return the epochs of the store in order of time, the newest revision of each start.

    If several files contain that revision, months take precedence over days and days over epoch files, and a
    newer compacted file over an older one.
    """
    best: dict[datetime, tuple[tuple[int, int, int], EpochRef]] = {}
    for rank, kind in enumerate(COMPACTED, start=1):
        for path in compacted_files(series, kind):
            for epoch in epochs_in_file(path):
                key = (epoch.revision, rank, compacted_revision(path))
                if epoch.start not in best or key > best[epoch.start][0]:
                    best[epoch.start] = key, epoch
    newest = {
        epoch_file.start: epoch_file for epoch_file in epoch_files(series)
    }  # sorted, so the newest revision wins
    for start, epoch_file in newest.items():
        if start not in best or epoch_file.revision > best[start][0][0]:
            best[start] = (epoch_file.revision, 0, 0), epochs_in_file(epoch_file.path)[0]
    return _drop_simultaneous(
        sorted((epoch for _, epoch in best.values()), key=lambda epoch: (epoch.time_s, epoch.start))
    )


def nearest_epoch(epochs: Sequence[EpochRef], time_s: float) -> EpochRef:
    """Return the epoch whose start or middle is nearest to a time [s since 1970].

    Raises StationError, with the nearest time, if there is none within NEAREST_TOLERANCE_S.
    """

    def distance_s(epoch: EpochRef) -> float:
        return min(abs(epoch.start.timestamp() - time_s), abs(epoch.time_s - time_s))

    nearest = min(epochs, key=distance_s)
    if distance_s(nearest) > NEAREST_TOLERANCE_S:
        raise StationError(
            f"no epoch within {NEAREST_TOLERANCE_S / 3600:g} h of {_format_utc(time_s)}:"
            f" the nearest is that of {_format_utc(nearest.start.timestamp())}"
        )
    return nearest


def _format_utc(time_s: float) -> str:
    return f"{datetime.fromtimestamp(time_s, UTC):%Y-%m-%d %H:%M} UTC"


def _drop_simultaneous(refs: list[EpochRef]) -> list[EpochRef]:
    """Drop epochs that are not later than their predecessor: two scans cannot have the same mid-time."""
    kept: list[EpochRef] = []
    for epoch in refs:
        if not kept or epoch.time_s > kept[-1].time_s:
            kept.append(epoch)
    return kept


def references_and_usable(series: Series) -> tuple[Array, Bools]:
    """Return the reference version (n,) of each epoch, b"" if it has none, and whether it is usable.

    Raises StoreError if the file cannot be read.
    """
    with read_errors(series.path), h5py.File(series.path, "r") as file:
        versions = read_column(file["reference_version"]).view(f"S{TEXT_LENGTH['text']}")[:, 0]
        return versions, read_column(file["verdict"]) != VERDICTS.index("unusable")


class SeriesIndex(Sequence[EpochRef]):
    """The epochs of a `series.nc`, read from that file alone; each `EpochRef` is created on access.

    `time_s` and `start_s` (n,) are seconds since 1970, `epoch_file` (n,) are file names as bytes.
    """

    def __init__(self, series: Series) -> None:
        """Read the index; empty if there is no series, StoreError if it cannot be read."""
        self.time_s, self.start_s = np.empty((2, 0))
        self.epoch_file = np.empty(0, f"S{TEXT_LENGTH['text']}")
        self._file_starts: list[int] = []  # index of the first epoch of each file
        self._locations: list[tuple[Path, int]] = []
        if not series.path.is_file():
            return
        with read_errors(series.path), h5py.File(series.path, "r") as file:
            bounds_s = np.asarray(file["time_bnds"][:], dtype=np.float64)
            self.time_s, self.start_s = middle(bounds_s), bounds_s[:, 0]
            self.epoch_file = read_column(file["epoch_file"]).view(self.epoch_file.dtype)[:, 0]
            for linked in linked_epochs(file, series.folder):
                self._file_starts.append(linked.series_start)
                self._locations.append((linked.path, linked.file_start))

    @property
    def files(self) -> set[Path]:
        """Files that contain the epochs."""
        return {path for path, _ in self._locations}

    def __len__(self) -> int:
        """Return the number of epochs."""
        return len(self.time_s)

    @overload
    def __getitem__(self, position: int) -> EpochRef: ...

    @overload
    def __getitem__(self, position: slice) -> list[EpochRef]: ...

    def __getitem__(self, position: int | slice) -> EpochRef | list[EpochRef]:
        """Return the epoch at an index, or a list of epochs for a slice."""
        if isinstance(position, slice):
            return [self[index] for index in range(*position.indices(len(self)))]
        index = range(len(self))[position]
        name = self.epoch_file[index].decode("ascii")
        epoch_file = parse_epoch_filename(Path(name))
        if epoch_file is None:
            raise StoreError(f"series.nc: damaged, entry {index} names no epoch file")
        file_number = bisect_right(self._file_starts, index) - 1
        path, file_start = self._locations[file_number]
        file_index = file_start + index - self._file_starts[file_number]
        return EpochRef(
            name, epoch_file.start, epoch_file.revision, path, file_index, float(self.time_s[index])
        )


def processing_file(series: Series) -> Path:
    """Return `processing.nc`, or `series.nc` of an older version, which contained everything."""
    return series.processing_path if series.processing_path.is_file() else series.path


@dataclass(frozen=True)
class LinkedEpochs:
    """Epochs of a virtual file in one of its sources."""

    path: Path
    file_start: int  # index of the first epoch in the source
    series_start: int  # and in the virtual file


def source_files(series_path: Path) -> set[Path]:
    """Return the files that a `series.nc` or `processing.nc` refers to; empty if there is no such file."""
    if not series_path.is_file():
        return set()
    with read_errors(series_path), h5py.File(series_path, "r") as file:
        return {linked.path for linked in linked_epochs(file, series_path.parent)}


def linked_epochs(file: h5py.File, folder: Path) -> list[LinkedEpochs]:
    """Return the sources of an open virtual file in the order of its epochs."""
    found = []
    for source in file[CHANGE if CHANGE in file else "time"].virtual_sources():
        is_whole_file = source.src_space.get_select_type() == h5py.h5s.SEL_ALL
        file_start = 0 if is_whole_file else source.src_space.get_select_bounds()[0][0]
        series_start = source.vspace.get_select_bounds()[0][0]
        found.append(LinkedEpochs(folder / source.file_name, file_start, series_start))
    return found


def data_folder(site_or_folder: str | Path) -> Path:
    """Return the data folder of a site file or a `series.nc`, or the folder itself.

    Raises StoreError if it is another file.
    """
    path = Path(site_or_folder)
    if path.name == "series.nc" and not path.is_dir():
        return path.parent
    site = _site(path)
    if site is None and path.is_file():
        raise StoreError(
            f"{path}: no site file, data folder or series.nc: xarray.open_dataset reads other files"
        )
    return path if site is None else site.station.data


def _site(path: Path) -> Site | None:
    """Return the site of a site file; None for a folder."""
    if not path.is_file() or path.suffix != ".toml":
        return None
    from station.config import read_site  # noqa: PLC0415 - a folder does not need pydantic

    return read_site(path)


def series_in(site_or_folder: str | Path) -> Series:
    """Return the store of a site file or data folder; raise StoreError if there is no series yet.

    The scanner is that of the site file, or of the series.
    """
    site = _site(Path(site_or_folder))
    folder = data_folder(site_or_folder) if site is None else site.station.data
    try:
        series = _read_header(folder, folder / "series.nc")
    except StoreError as error:
        raise StoreError(f"{folder}: holds no readable series (see station status): {error}") from error
    return series if site is None else replace(series, scanner=site.instrument)


def stored_series(series: Series) -> Series | None:
    """Return the station, grid and map of the stored epochs; None if nothing readable is stored.

    They are read from the newest files of epochs, because a derived file may be damaged.
    """
    for name in sorted(list_files(series), key=lambda name: Path(name).name, reverse=True)[:MAX_TRIED]:
        try:
            return _read_header(series.folder, series.folder / name)
        except StoreError:
            continue
    return None


def _read_header(folder: Path, path: Path) -> Series:
    """Return the store in a folder as one of its files describes it; raise StoreError if that is damaged."""
    with read_errors(path), netCDF4.Dataset(path) as file:
        x_m, y_m = (np.asarray(file[axis][:], dtype=np.float64) for axis in "xy")
        x_bounds, y_bounds = (file[f"{axis}_bnds"][0] for axis in "xy")
        west_m, north_m = float(x_bounds.min()), float(y_bounds.max())
        plane, plane_crs = read_plane(file)
        grid = Grid(west_m, north_m, float(np.ptp(x_bounds)), len(x_m), len(y_m), plane)
        crs = str(file["crs"].crs_wkt) if "crs" in file.variables else None
        scanner = read_scanner(file)
        return Series(folder, str(file.station_id), grid, crs, scanner=scanner, plane_crs=plane_crs)
