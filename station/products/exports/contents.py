"""The content of an exported file: small variables in memory, rasters block by block."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from functools import lru_cache, partial
from itertools import product
from math import isqrt
from pathlib import Path
from typing import Any

import h5py
import netCDF4
import numpy as np

from station._version import __version__
from station.archive.chunk_codec import ChunkReader
from station.archive.derived.computed_rasters import COMPUTED, ReferenceSurfaces, read_raster
from station.archive.discovery import time_coverage
from station.archive.netcdf_layout import UNCERTAINTY_ATTRIBUTE, create_file, create_variable, decode_text
from station.archive.schema import FILL, VARIABLES, Variable
from station.archive.series.epoch_reader import EpochSource, Parameters, contiguous_runs, read_source
from station.errors import StoreError
from station.products.exports.selection import FINGERPRINT, Part, Selection

BLOCK_BYTES = 2**26  # of a raster in memory: a month in chunks of 32 x 32 still covers those of the store
EPOCHS_AT_ONCE = 64  # of the other variables
ANCILLARY_ATTRIBUTES = {"ancillary_variables", UNCERTAINTY_ATTRIBUTE}  # name other variables
MAX_OPEN_FILES = 48  # the epochs of a day and more, at some 5 MB each

Array = np.ndarray[Any, Any]
Block = tuple[slice, slice, slice]  # times of the part, rows and columns of the cropped grid
Advance = Callable[[float], None]


class PartContents:
    """The epochs of a part in their sources, which `verify` checks; it raises StoreError if one is damaged.

    `sources` are runs of epochs in one file each, `variables` the rows of the schema that they contain.
    """

    def __init__(self, selection: Selection, part: Part, verify: Callable[[Path], None]) -> None:
        self.selection, self.part = selection, part
        self.sources: list[EpochSource] = []
        for run in contiguous_runs(part.epochs):
            verify(run[0])
            self.sources.append(read_source(*run))
        self.parameters: Parameters = {}
        for source in reversed(self.sources):
            self.parameters = source.parameters | self.parameters
        order = {name: index for index, name in enumerate(self.parameters)}
        self._order = {
            id(source): [order[name] for name in source.parameters] for source in self.sources
        }  # of the parameters
        large = {name for source in self.sources for name in source.raster_shapes}
        present = large if selection.refers_to_store else large | set(COMPUTED)
        self.variables = [
            spec
            for spec in VARIABLES
            if spec.name in selection.stored_or_computed and (spec.name in present or not spec.is_large)
        ]
        self.rasters = [spec for spec in self.variables if spec.is_raster]
        opened = partial(h5py.File, mode="r", rdcc_nbytes=0)
        self._open = lru_cache(MAX_OPEN_FILES)(opened)  # a file is closed when it is dropped
        self._surfaces = ReferenceSurfaces(selection.series)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of epochs, rows and columns."""
        return len(self.part.epochs), *self.selection.shape

    def write_header(self, file: netCDF4.Dataset) -> None:
        """Write everything into a new file but the values of the rasters."""
        file.set_auto_mask(False)
        file.set_auto_chartostring(False)
        series, times = self.selection.cropped, len(self.part.epochs)
        has_parameters = any("parameter" in spec.dims for spec in self.variables)
        parameters = (tuple(self.parameters), tuple(self.parameters.values())) if has_parameters else ((), ())
        title = f"Elevation change at {series.name or series.station_id}, {self.part.period}"
        create_file(file, series, title, times, parameters)
        self._write_coordinates(file)
        names = {spec.name for spec in self.variables}
        for spec in self.variables:
            chunks = self.selection.chunks if spec.is_raster else None
            variable = create_variable(file, spec, series, times, chunks)
            for attribute in ANCILLARY_ATTRIBUTES & set(variable.ncattrs()):
                present = [name for name in variable.getncattr(attribute).split() if name in names]
                variable.delncattr(attribute)
                if present:
                    variable.setncattr(attribute, " ".join(present))
            if not spec.is_raster:
                self._write_values(variable)
        start_s, end_s = file["time_bnds"][0, 0], file["time_bnds"][-1, 1]
        created = datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
        file.setncatts(
            {
                **time_coverage(float(start_s), float(end_s)),
                "history": f"{created} exported by station {__version__}",
                FINGERPRINT: self.selection.fingerprint(self.part.epochs),
            }
        )

    def _write_coordinates(self, file: netCDF4.Dataset) -> None:
        """Write the times, and the same coordinates as in the series: to crop a grid rounds otherwise."""
        for name in ("time", "time_bnds"):
            self._write_values(file[name])
        grid, half_m = self.selection.series.grid, self.selection.series.grid.cell_m / 2
        for axis, cells, coordinates_m, step_m in (
            ("x", self.selection.columns, grid.x_m, half_m),
            ("y", self.selection.rows, grid.y_m, -half_m),
        ):
            file[axis][:] = coordinates_m[cells]
            file[f"{axis}_bnds"][:] = np.stack([coordinates_m - step_m, coordinates_m + step_m], axis=-1)[
                cells
            ]

    def _write_values(self, variable: netCDF4.Variable[Any]) -> None:
        """Write a variable that is no raster; fill values where a source lacks it."""
        for times in _slices(len(self.part.epochs), EPOCHS_AT_ONCE):
            shape = (times.stop - times.start, *variable.shape[1:])
            values = np.full(shape, fill_value(variable.dtype), variable.dtype)
            for source, stored_times, target_times in self._overlapping(times):
                if variable.name in source.scalars:
                    first = source.file_start
                    stored = source.scalars[variable.name][
                        stored_times.start - first : stored_times.stop - first
                    ]
                elif variable.name in source.raster_shapes:
                    stored = self.dataset(source, variable.name)[stored_times]
                else:
                    continue
                places = [
                    self._order[id(source)] if dim.startswith("parameter") else range(size)
                    for dim, size in zip(variable.dimensions[1:], shape[1:], strict=True)
                ]
                values[np.ix_(range(target_times.start, target_times.stop), *places)] = stored
            variable[times] = values

    def _overlapping(self, times: slice) -> Iterator[tuple[EpochSource, slice, slice]]:
        """Yield each source of some epochs, their indices in its file, and within `times`."""
        for source in self.sources:
            first = max(times.start, source.series_start)
            last = min(times.stop, source.series_start + source.count)
            if first < last:
                shift = source.file_start - source.series_start
                yield (
                    source,
                    slice(first + shift, last + shift),
                    slice(first - times.start, last - times.start),
                )

    def blocks(self, chunks: tuple[int, int, int]) -> Iterator[Block]:
        """Yield blocks of whole chunks that cover the rasters, the first times first."""
        scale = max(1, isqrt(BLOCK_BYTES // (4 * int(np.prod(chunks)))))
        steps = chunks[0], chunks[1] * scale, chunks[2] * scale
        yield from product(*(_slices(size, step) for size, step in zip(self.shape, steps, strict=True)))

    def is_stored(self, spec: Variable) -> bool:
        """Return True if no epoch needs a raster to be computed."""
        if spec.name not in COMPUTED:
            return True
        replacement = COMPUTED[spec.name][1]
        return all(
            spec.name in source.raster_shapes and replacement not in source.raster_shapes
            for source in self.sources
        )

    def read(self, spec: Variable, block: Block) -> Array:
        """Return a block of a raster as stored or computed; fill values where a source does not have it."""
        times, rows, columns = block
        window = _shifted(rows, self.selection.rows.start), _shifted(columns, self.selection.columns.start)
        shape = tuple(part.stop - part.start for part in block)
        values = np.full(shape, fill_value(spec.dtype), spec.dtype)
        for source, stored_times, target_times in self._overlapping(times):
            if spec.name in COMPUTED:
                for index, target in zip(_indices(stored_times), _indices(target_times), strict=True):
                    values[target] = self._compute(source, spec.name, index, window)
            elif spec.name in source.raster_shapes:
                reader = self._reader(source, spec.name)
                for index, target in zip(_indices(stored_times), _indices(target_times), strict=True):
                    values[target] = reader.read(index, *window)
        return values

    def _compute(self, source: EpochSource, name: str, index: int, window: tuple[slice, slice]) -> Array:
        """Return a window of a raster of one epoch, computed if it is not stored."""

        def read(stored: str) -> Array | None:
            if stored not in source.raster_shapes:
                return None
            return self._reader(source, stored).read(index, *window)

        versions = source.scalars["reference_version"][index - source.file_start]
        version = decode_text(versions[None])[0]
        return read_raster(name, read, lambda: self._surfaces.height_m(version, *window))

    def _reader(self, source: EpochSource, name: str) -> ChunkReader:
        return ChunkReader(self.dataset(source, name))

    def dataset(self, source: EpochSource, name: str) -> Any:  # noqa: ANN401 - h5py has no types
        """Return a variable of a source as an HDF5 dataset; raise StoreError if it cannot be read."""
        try:
            return self._open(source.path)[name]
        except (OSError, RuntimeError, KeyError) as error:
            raise StoreError(f"{source.path}: cannot be read: {error}") from error


def fill_value(dtype: Any) -> Any:  # noqa: ANN401 - of any type
    """Return the value of missing data of a type."""
    return {"f": FILL, "S": b""}.get(np.dtype(dtype).kind, 0)


def _shifted(part: slice, start: int) -> slice:
    return slice(part.start + start, part.stop + start)


def _indices(times: slice) -> range:
    return range(times.start, times.stop)


def _slices(size: int, step: int) -> list[slice]:
    return [slice(start, min(start + step, size)) for start in range(0, size, step)]
