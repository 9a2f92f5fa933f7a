"""The series as a Zarr store (version 3), for the cloud."""

from __future__ import annotations

import base64
import os
import shutil
import struct
import warnings
from collections.abc import Callable, Iterator
from math import isqrt
from pathlib import Path
from typing import TYPE_CHECKING, Any

import netCDF4
import numpy as np

from station.archive.netcdf_layout import TIMES_PER_CHUNK, decode_text
from station.archive.schema import TEXT_LENGTH
from station.errors import StationError, StoreError
from station.products.exports.contents import EPOCHS_AT_ONCE, Advance, PartContents, fill_value
from station.products.exports.selection import FINGERPRINT, Part, Selection

if TYPE_CHECKING:
    import zarr

EPOCHS_PER_SHARD = 24  # a shard is a file of the store: about a day
SHARD_BYTES = 2**25  # at most, before compression
WRITING = {
    "codec_pipeline.path": "zarrs.ZarrsCodecPipeline",  # in Rust: that of zarr needs 1 ms for a chunk
    "threading.max_workers": 1,  # more compress more chunks of a shard at once, up to 0.2 GB
}
PROGRESS_FILE = "export.progress"  # in an unfinished store: the raster being written, and its finished blocks


def read_fingerprint(path: Path) -> str | None:
    """Return the fingerprint of an exported store; None if it is no such store."""
    try:
        return str(_zarr().open_group(path, mode="r").attrs[FINGERPRINT])
    except (OSError, ValueError, KeyError):
        return None


def write_zarr(
    selection: Selection, parts: list[Part], verify: Callable[[Path], None], advance: Advance
) -> Iterator[Path]:
    """Write each part as one store, which appears when it is complete; yield the paths.

    Values have the same bits as in the series. A store that was begun with the same epochs is continued after
    the last finished block of each raster. Raises StoreError if a source is damaged or a store cannot be
    written, StationError without the package zarr.
    """
    for part in parts:
        beside = part.path.with_name(f".{part.path.name}.part")
        contents = PartContents(selection, part, verify)
        try:
            if read_fingerprint(beside) != selection.fingerprint(part.epochs):
                shutil.rmtree(beside, ignore_errors=True)
                _write_header(contents, beside)
            _write_rasters(contents, beside, advance)
            os.sync()
            if part.path.exists():
                replaced = part.path.with_name(f".{part.path.name}.replaced")
                part.path.rename(replaced)
                beside.rename(part.path)
                shutil.rmtree(replaced)
            else:
                beside.rename(part.path)
        except OSError as error:
            raise StoreError(f"{part.path}: cannot be written: {error}") from error
        yield part.path


def _zarr() -> Any:  # noqa: ANN401 - a module
    try:
        import zarr  # noqa: PLC0415 - an extra
        import zarrs  # noqa: F401, PLC0415 - used by zarr
    except ImportError as error:
        raise StationError(
            "Zarr needs the packages zarr and zarrs: pip install 'tls-station[zarr]'"
        ) from error
    return zarr


def _write_header(contents: PartContents, path: Path) -> None:
    """Create a store with everything but the values of the rasters, from the header of a NetCDF file."""
    zarr = _zarr()
    path.mkdir(parents=True)
    header = path / "header.nc"
    with netCDF4.Dataset(header, "w") as file:
        contents.write_header(file)
    with netCDF4.Dataset(header) as file:
        file.set_auto_maskandscale(False)
        file.set_auto_chartostring(False)
        group = zarr.create_group(path, attributes=_attributes(file))
        for name, variable in file.variables.items():
            if name in (spec.name for spec in contents.rasters):
                _create_raster(group, variable, contents)
            else:
                _copy_variable(group, variable)
    header.unlink()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # not in the standard yet, but one request instead of sixty
        zarr.consolidate_metadata(group.store)


def _attributes(owner: Any) -> dict[str, Any]:  # noqa: ANN401 - a file or variable
    """Return the attributes of a NetCDF file or variable as JSON can hold them.

    The fill value of a float is its bytes in Base64, as xarray writes and expects it.
    """
    attrs = {name: owner.getncattr(name) for name in owner.ncattrs()}
    result = {name: np.asarray(value).tolist() for name, value in attrs.items() if name != "_Encoding"}
    if "_FillValue" in result:
        result["_FillValue"] = base64.standard_b64encode(struct.pack("<d", result["_FillValue"])).decode()
    return result


def _copy_variable(group: zarr.Group, variable: netCDF4.Variable[Any]) -> None:
    """Copy a variable that is no raster, a chunk at a time; characters become strings."""
    is_text = variable.dimensions[-1:] and variable.dimensions[-1] in TEXT_LENGTH
    shape = variable.shape[:-1] if is_text else variable.shape
    chunks = shape
    if variable.dimensions[:1] == ("time",):
        chunks = min(shape[0], TIMES_PER_CHUNK if len(shape) < 3 else EPOCHS_AT_ONCE), *shape[1:]
    array = group.create_array(
        variable.name,
        shape=shape,
        dtype=str if is_text else variable.dtype,
        chunks=chunks or "auto",
        dimension_names=variable.dimensions[: len(shape)],
        attributes=_attributes(variable),
    )
    if not shape:
        array[...] = variable[...]
        return
    for start in range(0, shape[0], chunks[0]):
        values = variable[start : start + chunks[0]]
        array[start : start + chunks[0]] = np.array(decode_text(values), dtype=object) if is_text else values


def _create_raster(group: zarr.Group, variable: netCDF4.Variable[Any], contents: PartContents) -> None:
    from zarr.codecs import BloscCodec  # noqa: PLC0415 - an extra

    chunks = contents.selection.chunks
    times = chunks[0] * max(1, EPOCHS_PER_SHARD // chunks[0])
    scale = max(1, isqrt(SHARD_BYTES // (4 * times * chunks[1] * chunks[2])))
    group.create_array(
        variable.name,
        shape=contents.shape,
        dtype=variable.dtype,
        chunks=chunks,
        shards=(times, chunks[1] * scale, chunks[2] * scale),
        compressors=BloscCodec(cname="zstd", clevel=1, shuffle="shuffle"),
        fill_value=fill_value(variable.dtype),
        dimension_names=variable.dimensions,
        attributes=_attributes(variable),
    )


def _write_rasters(contents: PartContents, path: Path, advance: Advance) -> None:
    """Write the rasters shard by shard, without the shards that an earlier run finished."""
    zarr, progress = _zarr(), path / PROGRESS_FILE
    with zarr.config.set(WRITING):
        arrays = dict(zarr.open_group(path, mode="r+").arrays())
    finished = int(progress.read_text()) if progress.is_file() else 0
    number = 0
    for spec in contents.rasters:
        array = arrays[spec.name]
        cells = int(np.prod(contents.shape[1:])) * len(contents.rasters)
        for block in contents.blocks(array.shards):
            number += 1
            if number > finished:
                array[block] = values = contents.read(spec, block)
                progress.write_text(str(number))
                advance(values.size / cells)
            else:
                advance(np.prod([part.stop - part.start for part in block]) / cells)
    progress.unlink(missing_ok=True)
