"""Checksums of derived files and of small files of state, which show any damage before they are used."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from isal import isal_zlib

BLOCK_BYTES = 2**18  # read at once: fits into the cache of the processor


def fingerprint(path: Path) -> list[int]:
    """Return size [bytes] and CRC-32 of a file; raise OSError if it is no regular file or unreadable."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no regular file")
    size, crc, block = 0, 0, memoryview(bytearray(BLOCK_BYTES))
    with path.open("rb", buffering=0) as file:
        while count := file.readinto(block):
            size, crc = size + count, isal_zlib.crc32(block[:count], crc)
    return [size, crc]


def matches_fingerprint(path: Path, expected: object) -> bool:
    """Return True if a file has an expected fingerprint."""
    try:
        return fingerprint(path) == expected
    except OSError:
        return False


def to_checked_json(content: Any) -> str:  # noqa: ANN401 - anything JSON can hold
    """Return `content` as JSON with a checksum; `read_checked_json` reads it."""
    return json.dumps({"crc32": _crc(content), "content": content})


def read_checked_json(path: Path) -> Any:  # noqa: ANN401
    """Return the content of a file written with `to_checked_json`; None if it is missing or damaged."""
    try:
        if not path.is_file():
            return None
        document = json.loads(path.read_text(encoding="utf-8"))
        return document["content"] if document["crc32"] == _crc(document["content"]) else None
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None


def _crc(content: Any) -> int:  # noqa: ANN401
    return isal_zlib.crc32(json.dumps(content).encode())
