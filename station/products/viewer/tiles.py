"""Tiles of binary data as scripts, the only kind of data that a page opened from a folder may load.

A tile calls `STATION_TILE(name, head, data)`: `head` is a JSON object, `data` is deflated and in base64.
Tiles are derived from the store and written often, so they are replaced without a sync.
"""

from __future__ import annotations

import binascii
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from isal import isal_zlib

from station.errors import StoreError

Array = np.ndarray[Any, Any]

LEVEL = 2  # of ISA-L

to_json = json.JSONEncoder(separators=(",", ":"), allow_nan=False).encode


def tile_script(name: str, head: Mapping[str, object], data: bytes) -> bytes:
    """Return a tile as a script of plain ASCII."""
    arguments = [to_json(part).encode() for part in (name, head)]
    packed = binascii.b2a_base64(isal_zlib.compress(data, LEVEL), newline=False)
    return b'STATION_TILE(%s,%s,"%s");\n' % (*arguments, packed)


class TileFolder:
    """A folder of tiles, whose files are replaced atomically."""

    def __init__(self, folder: Path) -> None:
        """Create the folder if it is missing; raise StoreError if that fails."""
        self._folder, self.name = str(folder), folder.name
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise StoreError(f"{folder}: cannot be written: {error}") from error
        self._written: set[str] = set()

    def write(self, name: str, head: Mapping[str, object], data: bytes) -> None:
        """Write the tile of a name; raise StoreError if that fails."""
        replace_file(f"{self._folder}/{name}.js", tile_script(f"{self.name}/{name}", head, data))
        self._written.add(f"{name}.js")

    def delete_others(self) -> None:
        """Delete the tiles that were not written since this object was created."""
        for entry in os.scandir(self._folder):
            if entry.name not in self._written:
                Path(entry.path).unlink(missing_ok=True)


def byte_planes(codes: Array, size: int) -> Array:
    """Return the lowest `size` bytes of non-negative integers (...) as planes (size, ...), to be deflated."""
    little = np.ascontiguousarray(codes.astype("<u4")).view(np.uint8).reshape(*codes.shape, 4)
    return np.moveaxis(little[..., :size], -1, 0)


def zigzag_differences(codes: Array) -> Array:
    """Return the first of integers (t, ...) and the differences that follow, as non-negative numbers."""
    steps: Array = np.diff(codes.astype(np.int32), axis=0, prepend=np.zeros((1, *codes.shape[1:]), np.int32))
    return np.asarray(np.left_shift(steps, 1) ^ np.right_shift(steps, 31))


def replace_file(path: Path | str, content: bytes) -> None:
    """Replace a file atomically, without a sync; raise StoreError if that fails."""
    parent, _, name = str(path).rpartition("/")
    tmp_path = f"{parent}/.{name}.part"
    try:
        descriptor = os.open(tmp_path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o666)
        try:
            os.write(descriptor, content)
        finally:
            os.close(descriptor)
        os.replace(tmp_path, path)  # noqa: PTH105 - thousands of tiles
    except OSError as error:
        raise StoreError(f"{path}: cannot be written: {error}") from error
