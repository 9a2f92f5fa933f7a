"""Manifest of the sources of the series, so that a new epoch is added without opening the earlier ones.

Only a cache: if it is missing or does not match the files, the series is rebuilt from them.
"""

from __future__ import annotations

import hashlib
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from station._version import __version__
from station.archive.atomic_files import move_folder_away
from station.archive.checksums import (
    fingerprint,
    matches_fingerprint,
    read_checked_json,
    to_checked_json,
)
from station.archive.epochs import list_files, parse_epoch_filename
from station.archive.netcdf_layout import Series
from station.archive.schema import VARIABLES
from station.archive.series.epoch_reader import EpochSource, Parameters, read_source
from station.archive.series.index import SeriesIndex, list_epochs

MANIFEST = ".series.json"


@dataclass(frozen=True)
class SeriesManifest:
    """Sources and parameters of a `series.nc`."""

    sources: list[EpochSource]  # without scalars
    parameters: Parameters
    last_s: float  # time of the last epoch
    newest_start_s: float  # of any epoch

    @property
    def count(self) -> int:
        """Number of epochs."""
        return sum(source.count for source in self.sources)


def write_manifest(series: Series, manifest: SeriesManifest) -> None:
    """Write the manifest of the current `series.nc`; skipped without an error if it cannot be written."""
    path = series.folder / MANIFEST
    content = {
        "header_hash": _header_hash(series),
        "series": fingerprint(series.path),
        "processing": fingerprint(series.processing_path),
        "files": sorted(list_files(series)),
        "parameters": manifest.parameters,
        "last_s": manifest.last_s,
        "newest_start_s": manifest.newest_start_s,
        "sources": [
            {
                "name": str(source.path.relative_to(series.folder)),
                "stamp": _file_stamp(source.path),
                "range": [source.file_start, source.series_start, source.count],
                "shapes": source.raster_shapes,
                "parameters": None if source.parameters == manifest.parameters else source.parameters,
            }
            for source in manifest.sources
        ],
    }
    tmp_path = path.with_name(f"{MANIFEST}.part")
    with suppress(OSError):
        tmp_path.write_text(to_checked_json(content), encoding="utf-8")
        move_folder_away(path)
        tmp_path.replace(path)


def pending_epochs(series: Series) -> tuple[SeriesManifest, list[EpochSource]] | None:
    """Return the manifest of `series.nc` and the epochs stored since, if all are later than those in it.

    None if the files of the store changed in any other way. Raises StoreError if a new epoch is damaged.
    """
    content = _read_manifest(series)
    if content is None:
        return None
    sources = [_source_from_manifest(series, entry, content["parameters"]) for entry in content["sources"]]
    manifest = SeriesManifest(sources, content["parameters"], content["last_s"], content["newest_start_s"])
    new_files = [
        parse_epoch_filename(series.folder / name) for name in list_files(series) - set(content["files"])
    ]
    epoch_files = sorted((entry for entry in new_files if entry is not None), key=lambda entry: entry.start)
    if len(epoch_files) < len(new_files):  # a compacted file
        return None
    start_s, last_s = manifest.newest_start_s, manifest.last_s
    new_sources: list[EpochSource] = []
    for entry in epoch_files:
        source = read_source(entry.path, 0, manifest.count + len(new_sources), 1)
        time_s = float(source.scalars["time"][0])
        is_known = all(manifest.parameters.get(name) == unit for name, unit in source.parameters.items())
        if entry.start.timestamp() <= start_s or time_s <= last_s or not is_known:
            return None
        start_s, last_s = entry.start.timestamp(), time_s
        new_sources.append(source)
    return SeriesManifest(sources, manifest.parameters, last_s, start_s), new_sources


def index_if_current(series: Series) -> SeriesIndex | None:
    """Return the index of `series.nc` if no file of the store has changed since; else None."""
    content = _read_manifest(series)
    return (
        SeriesIndex(series) if content is not None and list_files(series) == set(content["files"]) else None
    )


def is_intact(series: Series) -> bool:
    """Return True if `series.nc` and `processing.nc` are as they were written."""
    content = read_checked_json(series.folder / MANIFEST)
    return content is not None and _matches(series, content)


def _matches(series: Series, content: dict[str, Any]) -> bool:
    return matches_fingerprint(series.path, content["series"]) and matches_fingerprint(
        series.processing_path, content.get("processing")
    )


def listed_sources(series: Series) -> set[Path] | None:
    """Return the files that `series.nc` refers to, without opening it; None if it is damaged."""
    content = read_checked_json(series.folder / MANIFEST)
    if content is None or not matches_fingerprint(series.path, content["series"]):
        return None
    return {series.folder / entry["name"] for entry in content["sources"]}


def source_count(series: Series) -> int:
    """Return the number of files that `series.nc` refers to, or will refer to when it is built again."""
    content = _read_manifest(series)
    return len({ref.path for ref in list_epochs(series)}) if content is None else len(content["sources"])


def _read_manifest(series: Series) -> dict[str, Any] | None:
    """Return the manifest if both files are intact and their sources unchanged; else None."""
    content: dict[str, Any] | None = read_checked_json(series.folder / MANIFEST)
    if content is None or content["header_hash"] != _header_hash(series):
        return None
    try:
        is_current = all(
            _file_stamp(series.folder / entry["name"]) == entry["stamp"] for entry in content["sources"]
        )
    except OSError:
        return None
    return content if is_current and _matches(series, content) else None


def _source_from_manifest(series: Series, entry: dict[str, Any], parameters: Parameters) -> EpochSource:
    source_parameters = entry["parameters"]
    file_start, series_start, count = entry["range"]
    return EpochSource(
        series.folder / entry["name"],
        file_start,
        series_start,
        count,
        scalars={},
        raster_shapes={name: tuple(shape) for name, shape in entry["shapes"].items()},
        parameters=parameters if source_parameters is None else source_parameters,
    )


def _header_hash(series: Series) -> str:
    """Return a hash of all metadata of a series that does not depend on its epochs."""
    header = [__version__, series.station_id, series.grid, series.crs, series.vertical_datum, series.name]
    return hashlib.sha256(repr([*header, series.institution, VARIABLES]).encode()).hexdigest()


def _file_stamp(path: Path) -> list[int]:
    """Return inode, size and modification time, which change when a file is written or replaced."""
    status = path.stat()
    return [status.st_ino, status.st_size, status.st_mtime_ns]
