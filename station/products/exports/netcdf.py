"""NetCDF export: the series in files that stand alone, real data instead of references to other files."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import product
from pathlib import Path
from typing import Any

import h5py
import netCDF4
import numpy as np

from station.archive.atomic_files import atomic_write
from station.archive.raster_io import deflated_chunks
from station.archive.schema import Variable
from station.archive.series.compaction import METADATA_BLOCK_BYTES
from station.archive.series.epoch_reader import LIBVER_COMPAT, copy_chunks, has_same_encoding
from station.products.exports.contents import Advance, Block, PartContents, fill_value
from station.products.exports.selection import FINGERPRINT, Part, Selection


def read_fingerprint(path: Path) -> str | None:
    """Return the fingerprint of an exported file; None if it is no such file."""
    try:
        with netCDF4.Dataset(path) as file:
            return str(file.getncattr(FINGERPRINT))
    except (OSError, RuntimeError, AttributeError):
        return None


def write_netcdf(
    selection: Selection, parts: list[Part], verify: Callable[[Path], None], advance: Advance
) -> Iterator[Path]:
    """Write each part as one file, which appears when it is complete; yield the paths.

    Values have the same bits as in the series. Compressed chunks are copied as they are where grid and chunks
    are those of the series, otherwise blocks of BLOCK_BYTES are decoded. `advance` receives the epochs
    done. Raises StoreError if a source is damaged or a file cannot be written.
    """
    for part in parts:
        remove_abandoned(part.path)
        contents = PartContents(selection, part, verify)
        with atomic_write(part.path) as tmp_path:
            with netCDF4.Dataset(tmp_path, "w", clobber=False) as file:
                contents.write_header(file)
            with h5py.File(
                tmp_path, "r+", libver=LIBVER_COMPAT, meta_block_size=METADATA_BLOCK_BYTES
            ) as target_file:
                for spec in contents.rasters:
                    target = target_file[spec.name]
                    target.resize(contents.shape[0], axis=0)
                    _write_raster(contents, spec, target, advance)
        yield part.path


def remove_abandoned(path: Path) -> None:
    """Delete what killed processes left behind while they wrote `path`."""
    for left in path.parent.glob(f".{path.name}.*.part"):
        process = left.name.removesuffix(".part").rpartition(".")[2]
        if process.isdigit() and not Path("/proc", process).exists() and left.is_file():
            left.unlink(missing_ok=True)


def _write_raster(contents: PartContents, spec: Variable, target: Any, advance: Advance) -> None:  # noqa: ANN401 - h5py has no types
    """Write a raster of all epochs, whose chunks are in the file afterwards if they contain a value."""
    sources = [source for source in contents.sources if spec.name in source.raster_shapes]
    datasets = {source.path: contents.dataset(source, spec.name) for source in sources}
    is_copied = contents.selection.is_whole_grid and contents.is_stored(spec)
    if is_copied and all(has_same_encoding(dataset, target) for dataset in datasets.values()):
        for source in sources:
            copy_chunks(datasets[source.path], source.file_start, target, source.series_start, source.count)
            advance(source.count / len(contents.rasters))
        return
    cells = int(np.prod(contents.shape[1:])) * len(contents.rasters)
    write = _deflate_block if target.chunks[0] == 1 else _write_block
    for block in sorted(contents.blocks(target.chunks), key=_place_first):
        values = contents.read(spec, block)
        write(target, block, values)
        advance(values.size / cells)


def _place_first(block: Block) -> tuple[int, int, int]:
    """Key of an order in which all epochs of a window follow each other: their reference is read once."""
    times, rows, columns = block
    return rows.start, columns.start, times.start


def _deflate_block(target: Any, block: Block, values: Any) -> None:  # noqa: ANN401
    """Do as `_write_block` for chunks of one epoch each, without the slower filters of HDF5."""
    times, rows, columns = block
    height, width = target.chunks[1:]
    for epoch, raster in zip(range(times.start, times.stop), values, strict=True):
        for top in range(0, len(raster), height):
            for left, deflated in deflated_chunks((height, width), raster[top : top + height]):
                target.id.write_direct_chunk((epoch, rows.start + top, columns.start + left), deflated)


def _write_block(target: Any, block: Block, values: Any) -> None:  # noqa: ANN401
    """Write the chunks of a block that contain a value; others read as fill value without being stored.

    Integers have no fill value.
    """
    starts = [range(0, size, chunk) for size, chunk in zip(values.shape, target.chunks, strict=True)]
    for corner in product(*starts):
        window = tuple(
            slice(start, start + chunk) for start, chunk in zip(corner, target.chunks, strict=True)
        )
        chunk_values = values[window]
        if values.dtype.kind != "f" or np.any(chunk_values != fill_value(values.dtype)):
            place = tuple(
                slice(part.start + start, part.start + start + size)
                for part, start, size in zip(block, corner, chunk_values.shape, strict=True)
            )
            target[place] = chunk_values
