"""Chunks of a raster as they stand in a file, found and unpacked without the library's detours.

To ask the library where a chunk lies takes as long as there are chunks before it: of a month half a million.
"""

from __future__ import annotations

from typing import Any

import h5py
import numpy as np
from isal import isal_zlib

# Says the library of a chunk that was never written; where it says it otherwise, the library reads it.
NEVER_WRITTEN = "storage is not allocated"
ALL = slice(None), slice(None)
FILTERS = (h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_DEFLATE)

Array = np.ndarray[Any, Any]


def places(dataset: Any) -> dict[tuple[int, ...], tuple[int, int]]:  # noqa: ANN401 - h5py has no types
    """Return where each chunk that is there begins in the file, and its length, by its corner."""
    found = {}

    def note(chunk: Any) -> None:  # noqa: ANN401 - h5py has no types
        found[chunk.chunk_offset] = chunk.byte_offset, chunk.size

    dataset.id.chunk_iter(note)
    return found


def unpacked(
    raw: bytes, stored: np.dtype[Any], size: tuple[int, int], part: tuple[slice, slice] = ALL
) -> Array:
    """Return a part of a chunk of that size (height, width), with the fill that stands in it.

    Raises IsalError where it is damaged, ValueError where it is of another size.
    """
    planes = np.frombuffer(isal_zlib.decompress(raw), np.uint8).reshape(stored.itemsize, *size)
    planes = planes[:, *part]
    if stored.itemsize != 4:
        return np.asarray(np.ascontiguousarray(np.moveaxis(planes, 0, -1)).view(stored)[..., 0])
    values = planes[3].astype(np.uint32)  # four times as fast
    for plane in planes[2::-1]:
        values <<= 8
        values |= plane
    return np.asarray(values.view(stored))


def column(dataset: Any, first: int = 0) -> Array:  # noqa: ANN401 - h5py has no types
    """Return a variable over time as it stands in the file, from the row on that a chunk begins with.

    As `dataset[first:]`, in a quarter of the time where it is text. Raises OSError, RuntimeError, ValueError
    or IsalError where it is damaged.
    """
    chunks, shape = dataset.chunks, dataset.shape
    if not _is_packed(dataset) or chunks[1:] != shape[1:] or first % chunks[0]:
        return np.asarray(dataset[first:])
    held = []
    for row in range(first, len(dataset), chunks[0]):
        mask, raw = dataset.id.read_direct_chunk((row, *[0] * (len(shape) - 1)))
        if mask:
            return np.asarray(dataset[first:])
        planes = np.frombuffer(isal_zlib.decompress(raw), np.uint8).reshape(dataset.dtype.itemsize, -1)
        held.append(np.ascontiguousarray(planes.T).view(dataset.dtype).reshape(chunks))
    return np.concatenate(held)[: len(dataset) - first]


def _is_packed(dataset: Any) -> bool:  # noqa: ANN401
    """Tell whether a variable has chunks, shuffled and deflated.

    Asked for a chunk of one that has none at all, the library tells of any size.
    """
    plist = dataset.id.get_create_plist()
    filters = tuple(plist.get_filter(k)[0] for k in range(plist.get_nfilters()))
    return filters == FILTERS and dataset.id.chunk_iter(lambda _: True) is not None


class Tiles:
    """Parts of the chunks of a raster in an open file; several threads may read.

    `size` is the rows and columns of a chunk, `is_plain` whether there are chunks, each of one epoch and
    shuffled and deflated: else they are the library's to unpack.
    """

    def __init__(self, dataset: Any) -> None:  # noqa: ANN401 - h5py has no types
        self._dataset = dataset
        self._stored, self._fill = dataset.dtype, dataset.fillvalue
        chunks = dataset.chunks or dataset.shape
        self.size: tuple[int, int] = chunks[-2:]
        self.is_plain = chunks[:-2] in ((), (1,)) and _is_packed(dataset)

    def read(self, corner: tuple[int, ...], part: tuple[slice, slice] | None = None) -> Array:
        """Return a chunk, by its corner, or a part of it; with the fill that stands for what is missing.

        Raises OSError, RuntimeError, ValueError or IsalError where it is damaged.
        """
        part = part or (slice(0, self.size[0]), slice(0, self.size[1]))
        if self.is_plain:
            try:
                mask, raw = self._dataset.id.read_direct_chunk(corner)
                if not mask:
                    return unpacked(raw, self._stored, self.size, part)
            except RuntimeError as error:
                if NEVER_WRITTEN in str(error):
                    return np.full([one.stop - one.start for one in part], self._fill, self._stored)
        *epoch, top, left = corner
        down, across = part
        rows = slice(top + down.start, top + down.stop)
        columns = slice(left + across.start, left + across.stop)
        return np.asarray(self._dataset[*epoch, rows, columns])
