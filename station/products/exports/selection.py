"""What is exported: epochs, variables, a box of the grid, chunks; and into which files."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path

import h5py
import numpy as np

from station.archive.derived.computed_rasters import COMPUTED, OUTSIDE, RANDOM
from station.archive.epochs import EpochRef
from station.archive.netcdf_layout import CHUNK, Series
from station.archive.schema import BY_NAME
from station.archive.series.index import SeriesIndex, processing_file
from station.errors import StationError
from station.products.area_tables import Span
from station.quantities import Grid
from station.readers.polygons import read_polygons

FORMAT_VERSION = 2  # of exported files: those of another version are written again
FINGERPRINT = "export_fingerprint"  # global attribute by which an exported file is recognised
PERIODS = {"1D": "%Y%m%d", "1M": "%Y%m"}  # periods of files: time format in their names
MAX_CHUNK_BYTES = 2**26  # a reader decodes whole chunks
ALL = "all"  # variables: how each scan was processed, too
KEPT = ("scan_id", "verdict", "verdict_reason")  # variables without which an epoch can be misread


@dataclass(frozen=True)
class Selection:
    """The part of a series to export."""

    series: Series
    epochs: list[EpochRef]
    rows: slice
    columns: slice
    variables: frozenset[str]
    chunks: tuple[int, int, int]  # (time, y, x)
    url: str | None = None  # of the data folder, for files that refer to those of the store

    @property
    def is_whole_grid(self) -> bool:
        """True if the grid is not cropped."""
        return self.shape == self.series.grid.shape

    @property
    def shape(self) -> tuple[int, int]:
        """Number of rows and columns."""
        return self.rows.stop - self.rows.start, self.columns.stop - self.columns.start

    @property
    def cropped(self) -> Series:
        """The series on the cropped grid."""
        grid, (ny, nx) = self.series.grid, self.shape
        west_m = grid.west_m + self.columns.start * grid.cell_m
        north_m = grid.north_m - self.rows.start * grid.cell_m
        return replace(self.series, grid=replace(grid, west_m=west_m, north_m=north_m, nx=nx, ny=ny))

    @property
    def refers_to_store(self) -> bool:
        """True if the files refer to those of the store, which do not have what is computed."""
        return self.url is not None

    @property
    def stored_or_computed(self) -> frozenset[str]:
        """Names of the variables; for files that refer to the store, with what computed ones come from."""
        if not self.refers_to_store:
            return self.variables
        sources = (COMPUTED[name] for name in self.variables if name in COMPUTED)
        return self.variables.union(*sources)

    def fingerprint(self, epochs: list[EpochRef]) -> str:
        """Return what decides the content of a file with these epochs, as a checksum.

        An epoch file never changes under its name.
        """
        series = replace(self.series, folder=Path())
        content = (FORMAT_VERSION, series, self.rows, self.columns, sorted(self.variables), self.chunks)
        names = [epoch.epoch_file for epoch in epochs]
        places = [(self.url, str(epoch.path), epoch.index) for epoch in epochs] if self.url else []
        return hashlib.sha256(json.dumps([str(content), names, places]).encode()).hexdigest()


@dataclass(frozen=True)
class Part:
    """A file to write, the epochs in it, and their period in words."""

    path: Path
    epochs: list[EpochRef]
    period: str


def select(
    series: Series,
    span: Span,
    box_m: tuple[float, float, float, float] | None = None,
    variables: str | None = None,
    chunks: str | None = None,
) -> Selection:
    """Return the epochs of a span, the cells whose centres are in a box, and the named variables.

    `box_m` is west, south, east, north on the map, `variables` names and `chunks` three numbers (time, y, x),
    both separated by commas. Raises StationError if anything is unknown or nothing is left.
    """
    stored = SeriesIndex(series)[:]
    if not stored:
        raise StationError(f"{series.folder}: nothing is stored yet")
    epochs = [epoch for epoch in stored if epoch.start in span]
    if not epochs:
        first, last = (f"{epoch.start:%Y-%m-%dT%H:%M}" for epoch in (stored[0], stored[-1]))
        raise StationError(f"no epoch in this span: the series extends from {first} to {last} UTC")
    rows, columns = _window(series.grid, box_m)
    shape = len(epochs), rows.stop - rows.start, columns.stop - columns.start
    return Selection(series, epochs, rows, columns, _names(series, variables), _chunks(chunks, shape))


def require_whole_grid(selection: Selection) -> None:
    """Raise StationError if the grid is cropped: files of the store are referred to as a whole."""
    if not selection.is_whole_grid:
        raise StationError("references are to whole files of the store: leave --area out")


def parse_box(text: str, areas: Path | None, crs: str | None) -> tuple[float, float, float, float]:
    """Return west, south, east, north [m] of four numbers with commas, or of the area of a site with a name.

    Raises StationError if it is neither.
    """
    try:
        west_m, south_m, east_m, north_m = (float(number) for number in text.split(","))
    except ValueError:
        polygons = read_polygons(areas, crs) if areas is not None else {}
        if text in polygons:
            west_m, south_m, east_m, north_m = polygons[text].bounds
            return west_m, south_m, east_m, north_m
        known = f"one of the areas {', '.join(polygons)}" if polygons else "an area: the site has none"
        raise StationError(f"{text}: neither four numbers west,south,east,north nor {known}") from None
    if not (west_m < east_m and south_m < north_m):
        raise StationError(f"{text}: not a box: write west,south,east,north in metres on the map")
    return west_m, south_m, east_m, north_m


def _window(grid: Grid, box_m: tuple[float, float, float, float] | None) -> tuple[slice, slice]:
    if box_m is None:
        return slice(0, grid.ny), slice(0, grid.nx)
    west_m, south_m, east_m, north_m = box_m
    rows = np.flatnonzero((grid.y_m > south_m) & (grid.y_m < north_m))
    columns = np.flatnonzero((grid.x_m > west_m) & (grid.x_m < east_m))
    if not rows.size or not columns.size:
        south_m, east_m = grid.north_m - grid.ny * grid.cell_m, grid.west_m + grid.nx * grid.cell_m
        extent = _metres((grid.west_m, south_m, east_m, grid.north_m))
        raise StationError(f"no cell of the grid, {extent} (west,south,east,north), is in {_metres(box_m)}")
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)


def _metres(values_m: tuple[float, ...]) -> str:
    return ",".join(f"{value_m:.10g}" for value_m in values_m)


def _names(series: Series, text: str | None) -> frozenset[str]:
    """Return the variables of `station.open`, the random uncertainty left out, which the others imply.

    With a text those that it names and KEPT, or all of `processing.nc` too.
    """
    results, processing = (_stored_names(path) for path in (series.path, processing_file(series)))
    results = {*results, *COMPUTED} - {OUTSIDE}
    if text is None:
        return frozenset(results - {RANDOM})
    known = [name for name in BY_NAME if name in results | processing]
    names = known if text.strip() == ALL else [name.strip() for name in text.split(",")]
    if unknown := [name for name in names if name not in known]:
        raise StationError(
            f"{unknown[0]!r}: not a variable of the series: choose {ALL} or from {', '.join(known)}"
        )
    return frozenset((*names, *KEPT))


def _stored_names(path: Path) -> set[str]:
    with h5py.File(path, "r") as file:
        return {name for name in BY_NAME if name in file}


def _chunks(text: str | None, shape: tuple[int, int, int]) -> tuple[int, int, int]:
    """Return the sizes of a chunk, at most those of the data; by default as in the series."""
    try:
        time, y, x = (int(number) for number in text.split(",")) if text else (1, CHUNK, CHUNK)
    except ValueError:
        time = y = x = 0
    if min(time, y, x) < 1:
        raise StationError(f"{text}: not a chunk: write three numbers TIME,Y,X such as 24,128,128")
    chunks = min(time, shape[0]), min(y, shape[1]), min(x, shape[2])
    if 4 * int(np.prod(chunks)) > MAX_CHUNK_BYTES:
        raise StationError(f"{text}: chunks of more than {MAX_CHUNK_BYTES // 2**20} MB: choose smaller ones")
    return chunks


def split(selection: Selection, out: Path, suffix: str, every: str | None) -> list[Part]:
    """Return the files to write: `out` itself, or one for each day or month in the folder `out`.

    Raises StationError if the name of a single file has another suffix, or the folder is a file.
    """
    if every is None:
        if out.suffix != suffix:
            raise StationError(f"{out}: give a name that ends in {suffix}, or --every 1M for monthly files")
        first, last = (f"{epoch.start:%Y-%m-%d}" for epoch in (selection.epochs[0], selection.epochs[-1]))
        return [Part(out, selection.epochs, first if first == last else f"{first} to {last}")]
    if out.is_file():
        raise StationError(f"{out}: is a file, but --every needs a folder")
    return list(_by_period(selection, out, suffix, PERIODS[every]))


def _by_period(selection: Selection, folder: Path, suffix: str, stamp: str) -> Iterator[Part]:
    for name, epochs in groupby(selection.epochs, key=lambda epoch: epoch.start.strftime(stamp)):
        yield Part(folder / f"{selection.series.station_id}_{name}{suffix}", list(epochs), name)


def pending(
    selection: Selection, parts: list[Part], read_fingerprint: Callable[[Path], str | None]
) -> list[Part]:
    """Return the parts whose file is missing or whose sources changed since it was written.

    Raises StationError if a file was not written by this program.
    """
    remaining = []
    for part in parts:
        if part.path.exists():
            written = read_fingerprint(part.path)
            if written is None:
                raise StationError(
                    f"{part.path}: exists and is no export of a station: move it away, or choose another name"
                )
            if written == selection.fingerprint(part.epochs):
                continue
        remaining.append(part)
    return remaining
