"""Compressed chunks of HDF5 datasets decoded by ISA-L, four times as fast as by the filters of HDF5."""

from __future__ import annotations

from typing import Any

import h5py
import numpy as np
from isal import isal_zlib

FILTERS = (h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_DEFLATE)

Array = np.ndarray[Any, Any]


def chunk_index(dataset: Any) -> dict[tuple[int, ...], tuple[int, int]]:  # noqa: ANN401 - h5py has no types
    """Return file offset and size [bytes] of each existing chunk, by its corner."""
    index = {}

    def collect(chunk: Any) -> None:  # noqa: ANN401 - h5py has no types
        index[chunk.chunk_offset] = chunk.byte_offset, chunk.size

    dataset.id.chunk_iter(collect)
    return index


def inflate(raw: bytes, dtype: np.dtype[Any], chunk_shape: tuple[int, int]) -> Array:
    """Return a compressed chunk (height, width), fill values included.

    Raises IsalError if the chunk is damaged, ValueError if it has another size.
    """
    planes = np.frombuffer(isal_zlib.decompress(raw), np.uint8).reshape(dtype.itemsize, *chunk_shape)
    if dtype.itemsize != 4:
        return np.asarray(np.ascontiguousarray(np.moveaxis(planes, 0, -1)).view(dtype)[..., 0])
    # Each word is assembled from its highest byte down: four times as fast as moving the axis.
    values = planes[3].astype(np.uint32)
    for plane in planes[2::-1]:
        values <<= 8
        values |= plane
    return np.asarray(values.view(dtype))


def read_column(dataset: Any, first: int = 0) -> Array:  # noqa: ANN401 - h5py has no types
    """Return the stored values of a variable over time from index `first`, the start of a chunk.

    Same as `dataset[first:]`, but four times as fast for text. Raises OSError, RuntimeError, ValueError or
    IsalError if the file is damaged.
    """
    chunks, shape = dataset.chunks, dataset.shape
    if not is_shuffle_deflate(dataset) or chunks[1:] != shape[1:] or first % chunks[0]:
        return np.asarray(dataset[first:])
    parts = []
    for start in range(first, len(dataset), chunks[0]):
        mask, raw = dataset.id.read_direct_chunk((start, *[0] * (len(shape) - 1)))
        if mask:  # a filter was skipped for this chunk
            return np.asarray(dataset[first:])
        planes = np.frombuffer(isal_zlib.decompress(raw), np.uint8).reshape(dataset.dtype.itemsize, -1)
        parts.append(np.ascontiguousarray(planes.T).view(dataset.dtype).reshape(chunks))
    return np.concatenate(parts)[: len(dataset) - first]


def is_shuffle_deflate(dataset: Any) -> bool:  # noqa: ANN401 - h5py has no types
    """Return True if a variable has chunks that are shuffled and deflated.

    At least one chunk must exist: otherwise HDF5 reports an arbitrary size for a requested chunk.
    """
    plist = dataset.id.get_create_plist()
    filters = tuple(plist.get_filter(index)[0] for index in range(plist.get_nfilters()))
    return filters == FILTERS and dataset.id.chunk_iter(lambda _: True) is not None
