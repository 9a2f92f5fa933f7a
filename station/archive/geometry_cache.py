"""On-disk cache of the viewing geometry: one folder per set of inputs, one `.npy` file per array.

Computing the arrays, or inflating compressed ones, would take as long as processing the scan. The name of
the folder is a hash of all inputs; a missing or damaged folder is computed again. NetCDF is not used,
because on a full disk HDF5 may leave a half-closed file and terminate the process.
"""

from __future__ import annotations

import math
import os
import shutil
import weakref
from collections.abc import Callable
from contextlib import suppress
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from station._version import __version__
from station.archive.checksums import fingerprint, read_checked_json, to_checked_json
from station.archive.netcdf_layout import Series
from station.archive.reference_files import reference_path
from station.errors import StoreError
from station.quantities import Reference
from station.science.gridding.reference_cells import CELL_ARRAYS, MAX_VISIBILITY_CELLS, CellClass, Position
from station.science.gridding.viewing_geometry import ViewingGeometry
from station.science.uncertainty.parameters import parameter_layout

PREFIX = ".viewing_geometry-"
MANIFEST = "manifest.json"  # size and CRC-32 of each file
MAX_CACHED = 2  # folders per station: scans from before a relocation may still be reprocessed
SMALL_ARRAYS = ("datum_m", "sector_bounds", "sampling_step")
GRID_ARRAYS = ("height_above_datum_m", "cell_index")

Array = np.ndarray[Any, Any]


def cached_viewing_geometry(
    series: Series,
    reference: Reference,
    scanner_pose: tuple[Position | None, Position],
    settings: str,
    compute: Callable[[], ViewingGeometry],
) -> ViewingGeometry:
    """Return the viewing geometry from its cache; if there is none or it is damaged, compute and write it.

    `scanner_pose` is position and axis of the scanner; `settings` identifies every other input. The arrays
    stay readable if another process deletes the cache.
    """
    status = reference_path(series, reference.version).stat()
    key = (
        __version__,
        (SMALL_ARRAYS, GRID_ARRAYS),
        [(name, np.dtype(dtype).str) for name, dtype in CELL_ARRAYS.items()],
        MAX_VISIBILITY_CELLS,
        list(CellClass),
        reference.version,
        status.st_size,
        status.st_mtime_ns,
        scanner_pose,
        settings,
    )
    folder = series.folder / f"{PREFIX}{sha256(repr(key).encode()).hexdigest()[:16]}"
    geometry = _read(folder, reference, *scanner_pose)
    if geometry is not None:
        return geometry
    _delete(folder)
    geometry = compute()
    _write(folder, geometry)
    return _read(folder, reference, *scanner_pose) or geometry


def _read(
    folder: Path, reference: Reference, position_m: Position | None, axis: Position
) -> ViewingGeometry | None:
    """Return the viewing geometry in a folder; None if it is missing, incomplete or damaged.

    Every byte is read, so that a failing disk raises an error here, not a signal at a later access.
    """
    try:
        manifest = read_checked_json(folder / MANIFEST)
        for name in (*SMALL_ARRAYS, *GRID_ARRAYS, *CELL_ARRAYS):
            if fingerprint(folder / f"{name}.npy") != manifest[name]:
                return None
        small = {name: np.load(folder / f"{name}.npy") for name in SMALL_ARRAYS}
        large: dict[str, Any] = {
            name: _FileArray(folder / f"{name}.npy") for name in (*GRID_ARRAYS, *CELL_ARRAYS)
        }
    except (OSError, ValueError, KeyError, TypeError):
        return None
    params = parameter_layout(reference.grid, position_m, axis) if position_m else None
    return ViewingGeometry(
        reference,
        params,
        position_m,
        datum_m=float(small["datum_m"]),
        height_above_datum_m=large["height_above_datum_m"],
        cell_index=large["cell_index"],
        sector_bounds=small["sector_bounds"],
        sampling_step=(int(small["sampling_step"][0]), int(small["sampling_step"][1])),
        cells={name: large[name] for name in CELL_ARRAYS},
    )


class _FileArray:
    """An array in a `.npy` file, mapped only while it is used: mapped pages count as memory of the process.

    It stays readable if another process deletes the file.
    """

    def __init__(self, path: Path) -> None:
        mapped: Any = np.load(path, mmap_mode="r")
        self._dtype, self._shape, self._offset = mapped.dtype, mapped.shape, mapped.offset
        self._path, self._file = path, path.open("rb", buffering=0)
        weakref.finalize(self, self._file.close)

    def __getitem__(self, rows: slice) -> Array:
        """Return a slice of rows, read into memory: for the cells of a sector faster than mapping.

        Raises StoreError if the file cannot be read, or is shorter than when it was opened.
        """
        first, stop, step = rows.indices(self._shape[0])
        values = np.empty((max(stop - first, 0), *self._shape[1:]), self._dtype)
        row_bytes = math.prod(self._shape[1:]) * self._dtype.itemsize
        try:
            count = os.preadv(self._file.fileno(), [values.data], self._offset + first * row_bytes)
        except OSError as error:
            raise StoreError(f"{self._path}: cannot be read: {error}") from error
        if count != values.nbytes:
            raise StoreError(f"{self._path}: truncated while in use: {count} of {values.nbytes} bytes")
        return values[::step]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> Array:  # noqa: ANN401, FBT001 - numpy's
        """Return the whole array, mapped read-only; or a copy."""
        mapped = np.memmap(self._file, self._dtype, "r", self._offset, self._shape)
        return np.array(mapped, dtype) if copy else np.asarray(mapped, dtype)


def _write(folder: Path, geometry: ViewingGeometry) -> None:
    """Write the cache; none remains if it cannot be written.

    Without fsync: the checksums detect what a power cut destroys.
    """
    tmp_folder = folder.with_name(f".{folder.name}.{os.getpid()}.part")
    arrays: dict[str, Any] = {name: getattr(geometry, name) for name in (*SMALL_ARRAYS, *GRID_ARRAYS)} | {
        **geometry.cells
    }
    try:
        shutil.rmtree(tmp_folder, ignore_errors=True)  # from a killed process that had the same process id
        tmp_folder.mkdir()
        manifest = {}
        for name, values in arrays.items():
            path = tmp_folder / f"{name}.npy"
            _save(path, np.asarray(values, order="C"))
            manifest[name] = fingerprint(path)
        (tmp_folder / MANIFEST).write_text(to_checked_json(manifest), encoding="ascii")
        tmp_folder.rename(folder)
        cached = sorted(folder.parent.glob(f"{PREFIX}*"), key=lambda path: path.stat().st_mtime_ns)
        for old in cached[:-MAX_CACHED]:
            _delete(old)
    except OSError:  # also if another process has written the folder in the meantime
        shutil.rmtree(tmp_folder, ignore_errors=True)


def _save(path: Path, values: Array) -> None:
    """Write an array as `np.save` does, which however reports no error if the disk is full at the end."""
    with path.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, np.lib.format.header_data_from_array_1_0(values))
        file.write(values.reshape(-1).data)


def _delete(folder: Path) -> None:
    """Delete a cache; renamed first, because deleting takes several steps."""
    tmp_folder = folder.with_name(f".{folder.name}.{os.getpid()}.part")
    with suppress(OSError):
        folder.rename(tmp_folder)
    shutil.rmtree(tmp_folder, ignore_errors=True)
    with suppress(OSError):
        tmp_folder.unlink()  # if a file had its name
