"""Kerchunk references: the series as Zarr whose chunks are ranges of bytes in the files of the store."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import netCDF4
import numpy as np

from station.archive.atomic_files import atomic_write
from station.archive.chunk_codec import chunk_index, is_shuffle_deflate
from station.archive.netcdf_layout import decode_text
from station.archive.schema import TEXT_LENGTH, Variable
from station.errors import StationError
from station.products.exports.contents import Advance, PartContents, fill_value
from station.products.exports.selection import FINGERPRINT, Part, Selection, require_whole_grid

HEAD_CHARACTERS = 2**16  # of a file: the global attributes come first
Refs = dict[str, Any]  # metadata, data in Base64, or [url, offset, size], by key of the Zarr store


def read_fingerprint(path: Path) -> str | None:
    """Return the fingerprint of a file of references; None if it is no such file."""
    try:
        with path.open(encoding="utf-8") as file:
            found = re.search(rf"{FINGERPRINT}\W+([0-9a-f]{{64}})", file.read(HEAD_CHARACTERS))
    except (OSError, ValueError):
        return None
    return found[1] if found else None


def write_references(
    selection: Selection, parts: list[Part], verify: Callable[[Path], None], advance: Advance
) -> Iterator[Path]:
    """Write the references of each part as JSON (version 1, Zarr 2); yield the paths.

    Small variables are included, rasters are referred to below the address `selection.url` of the data
    folder. Covariances are left out. Raises StationError if a raster is not stored in chunks of one epoch.
    """
    require_whole_grid(selection)
    for part in parts:
        contents = PartContents(selection, part, verify)
        refs: Refs = {".zgroup": json.dumps({"zarr_format": 2})}
        with netCDF4.Dataset(part.path.name, "w", diskless=True) as file:
            contents.write_header(file)
            file.set_auto_maskandscale(False)
            file.set_auto_chartostring(False)
            refs[".zattrs"] = json.dumps(_attributes(file))
            rasters = {spec.name: spec for spec in contents.rasters}
            for name, variable in file.variables.items():
                if name in rasters:
                    _add_raster(refs, contents, rasters[name], variable)
                    advance(len(part.epochs) / len(rasters))
                elif "parameter" not in variable.dimensions:
                    _add_small(refs, variable)
        with atomic_write(part.path) as tmp_path:
            tmp_path.write_text(json.dumps({"version": 1, "refs": refs}), encoding="utf-8")
        yield part.path


def _attributes(owner: Any) -> dict[str, Any]:  # noqa: ANN401 - a file or variable
    """Return the attributes of a NetCDF file or variable as JSON can hold them."""
    return {
        name: np.asarray(owner.getncattr(name)).tolist() for name in owner.ncattrs() if name != "_FillValue"
    }


def _add_small(refs: Refs, variable: netCDF4.Variable[Any]) -> None:
    """Add a variable with its values; characters become strings of fixed length."""
    dims, values = variable.dimensions, variable[...]
    if dims and (length := TEXT_LENGTH.get(dims[-1])):
        dims = dims[:-1]
        values = np.array([text.encode() for text in decode_text(values)], f"S{length}")
    values = np.asarray(values)
    _add_array(refs, variable, dims, values.shape, values.shape, values.dtype, [])
    chunk = ".".join("0" * values.ndim) or "0"
    refs[f"{variable.name}/{chunk}"] = "base64:" + base64.b64encode(values.tobytes()).decode()


def _add_raster(refs: Refs, contents: PartContents, spec: Variable, variable: netCDF4.Variable[Any]) -> None:
    """Add the ranges of bytes of all chunks of a raster; chunks without a value have none."""
    chunks, dtype = None, np.dtype(spec.dtype)
    for source in contents.sources:
        if spec.name not in source.raster_shapes:
            continue
        dataset = contents.dataset(source, spec.name)
        chunks = chunks or dataset.chunks
        if dataset.chunks != chunks or chunks[0] != 1 or dataset.dtype != dtype:
            raise StationError(f"{source.path}: {spec.name} is stored otherwise than in the other files")
        path = source.path.relative_to(contents.selection.series.folder)
        shift = source.series_start - source.file_start
        if not is_shuffle_deflate(dataset):
            continue  # without any chunk
        for (time, row, column), (offset, size) in chunk_index(dataset).items():
            if source.file_start <= time < source.file_start + source.count:
                key = f"{spec.name}/{time + shift}.{row // chunks[1]}.{column // chunks[2]}"
                refs[key] = [f"{contents.selection.url}/{path}", offset, size]
    filters = [{"id": "shuffle", "elementsize": dtype.itemsize}, {"id": "zlib", "level": 1}]
    _add_array(refs, variable, spec.dims, contents.shape, chunks or contents.selection.chunks, dtype, filters)


def _add_array(
    refs: Refs,
    variable: netCDF4.Variable[Any],
    dims: tuple[str, ...],
    shape: tuple[int, ...],
    chunks: tuple[int, ...],
    dtype: Any,  # noqa: ANN401 - a numpy type
    filters: list[dict[str, Any]],
) -> None:
    """Add the description of an array; integers have no fill value, which readers would take for missing."""
    refs[f"{variable.name}/.zarray"] = json.dumps(
        {
            "zarr_format": 2,
            "shape": shape,
            "chunks": chunks,
            "dtype": dtype.str,
            "fill_value": dtype.type(fill_value(dtype)).item() if dtype.kind == "f" else None,
            "order": "C",
            "filters": filters or None,
            "compressor": None,
        }
    )
    refs[f"{variable.name}/.zattrs"] = json.dumps(_attributes(variable) | {"_ARRAY_DIMENSIONS": dims})
