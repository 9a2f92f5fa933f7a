"""Maps of the recent epochs, as images and tiles of values: which are kept, and making the missing ones."""

from __future__ import annotations

import hashlib
import json
import os
import struct
import time
import zipfile
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image

from station._version import __version__
from station.archive.atomic_files import atomic_write
from station.archive.epochs import EpochRef
from station.archive.netcdf_layout import Series
from station.errors import StoreError
from station.products.colours import round_up
from station.products.maps import Caption, change_map, encode_webp
from station.products.overview import BaseMap, Overview, base_map, read_overview
from station.products.viewer.level_tiles import LevelMaps, update_levels
from station.products.viewer.value_tiles import (
    delete_cells,
    delete_old_values,
    has_values,
    read_cells,
    write_cells,
    write_heights,
    write_means,
)
from station.quantities import Floats, Grid

KEEP_ALL_FOR = timedelta(days=2)  # before the newest epoch; then the last map of each day …
KEEP_DAILY_FOR = timedelta(days=60)  # … and before that the last of each month
DAY_S = 86_400.0
MAX_CELL_MAPS = 50  # newest maps with tiles of cells, two days of hourly scans; before them, of means only
MAX_MADE = 8  # per call: the maps of an archive older than the page are made over several calls
DELETE_GRACE_S = 3600.0  # an open page may still refer to a map that is no longer kept
LIMIT_SIGMAS = 10.0


class MeasuredEpoch(NamedTuple):
    """An epoch that has a reference; a page creates thousands of them."""

    epochs: Sequence[EpochRef]
    position: int  # its index in `epochs`
    start: datetime
    version: str  # of the reference
    verdict: str  # text in the caption
    overview: Overview | None = None  # if it is in memory already

    @property
    def epoch(self) -> EpochRef:
        """Return the epoch and its location in the archive."""
        return self.epochs[self.position]


@dataclass(frozen=True)
class Style:
    """How maps are drawn; maps of another style are drawn again."""

    station: str
    width_px: int
    limit_m: float | None  # None: fixed once, from the first epoch


@dataclass(frozen=True)
class MapImage:
    """A map image on disk, relative to the gallery's folder."""

    start: datetime
    file: str
    version: str  # of the reference
    epoch_file: str
    finest: int  # level of its tiles of values


@dataclass(frozen=True)
class Gallery:
    """The maps of the page: change over time, and levels where the station keeps them."""

    change: list[MapImage]
    levels: LevelMaps
    limit_m: float | None
    size: tuple[int, int]  # of a map [pixels]
    bases: dict[str, BaseMap]  # by version of the reference


def update_gallery(
    series: Series,
    folder: Path,
    measured: list[MeasuredEpoch],
    style: Style,
    progress: Callable[[], None],
) -> Gallery:
    """Make the missing maps, newest first, delete those no longer kept, and return the gallery.

    `measured` are the epochs that have a reference, in time order. Raises StoreError if something cannot be
    read or written.
    """
    if not measured:
        return Gallery([], LevelMaps(), style.limit_m, (0, 0), {})
    limit_m = style.limit_m or _fixed_limit(series, folder, measured[0])
    style_json = json.dumps([style.station, style.width_px, limit_m, __version__])
    tag = hashlib.sha256(style_json.encode()).hexdigest()[:8]
    retained = [
        measured[index]
        for index in retention_indices(np.array([item.start.timestamp() for item in measured]))
    ]
    made_count, images, bases = 0, list[MapImage](), dict[str, BaseMap]()
    for age, item in enumerate(reversed(retained)):
        epoch_file = item.epoch.epoch_file
        image = folder / "maps" / f"{Path(epoch_file).stem}_{tag}.webp"
        if item.version not in bases:
            bases[item.version] = cached_base_map(series, folder, item.version, style.width_px)
            write_heights(series, folder, bases[item.version])
        base = bases[item.version]
        with_cells = base.factor > 1 and age < MAX_CELL_MAPS
        missing = [
            not _is_whole(image),
            not has_values(folder, epoch_file, base, cells=False),
            with_cells and not has_values(folder, epoch_file, base, cells=True),
        ]
        if any(missing):
            if made_count == MAX_MADE:
                continue
            _make(item, folder, image, base, missing, style, limit_m)
            made_count += 1
            progress()
        if not with_cells:
            delete_cells(folder, epoch_file, base)
        images.append(
            MapImage(
                item.start,
                f"maps/{image.name}",
                item.version,
                epoch_file,
                int(base.factor > 1 and not with_cells),
            )
        )
    images.reverse()
    _delete_old(folder / "maps", {Path(item.file).name for item in images})
    levels = update_levels(series, folder, bases[images[-1].version], progress)
    level_folders = [name for level in levels.maps for name in level.folders]
    delete_old_values(folder, [*(item.epoch_file for item in images), *level_folders], bases)
    return Gallery(images, levels, limit_m, _size(folder / images[-1].file), bases)


def _make(
    item: MeasuredEpoch,
    folder: Path,
    image: Path,
    base: BaseMap,
    missing: Sequence[bool],
    style: Style,
    limit_m: float,
) -> None:
    """Make what is missing of the map of an epoch: its image, the tiles of means, and those of cells."""
    overview = item.overview
    if any(missing[:2]):
        overview = overview or read_overview(item.epoch, base)
        if missing[0]:
            caption = Caption(style.station, f"{item.start:%Y-%m-%d %H:%M} UTC", item.verdict)
            picture = change_map(overview, caption, limit_m, style.width_px, "the reference")
            replace_if_changed(image, encode_webp(picture))
        if missing[1]:
            write_means(folder, item.epoch.epoch_file, overview)
    if missing[2]:
        write_cells(folder, item.epoch.epoch_file, read_cells(item.epoch, base))


def _is_whole(path: Path) -> bool:
    """Return True if a map is there and as long as its header states."""
    try:
        with path.open("rb") as file:
            riff, size, webp = struct.unpack("<4sI4s", file.read(12))
            return (riff, size + 8, webp) == (b"RIFF", os.fstat(file.fileno()).st_size, b"WEBP")
    except (OSError, struct.error):
        return False


def _size(path: Path) -> tuple[int, int]:
    """Return width and height of a map [pixels]; a damaged file is deleted, so that it is drawn again."""
    try:
        with Image.open(path) as picture:
            return picture.size
    except OSError as error:
        path.unlink(missing_ok=True)
        raise StoreError(f"{path}: damaged, drawn again with the next scan: {error}") from error


def retention_indices(start_s: Floats) -> list[int]:
    """Return the indices of those of the times (n,) [s], ascending, that are kept: fewer the older they are.

    Ages are compared by whole days, so that the map kept of a month was already drawn as that of its day.
    """
    day = start_s // DAY_S
    month = start_s.astype("datetime64[s]").astype("datetime64[M]").astype(np.int64)
    recent = start_s[-1] - start_s <= KEEP_ALL_FOR.total_seconds()
    daily = ~recent & (day[-1] - day <= KEEP_DAILY_FOR.days)
    groups = [np.flatnonzero(recent)]
    for selected, period in ((daily, day), (~recent & ~daily, month)):
        index = np.flatnonzero(selected)
        groups.append(index[np.diff(period[index], append=np.inf) != 0])
    return [int(index) for index in np.sort(np.concatenate(groups))]


def replace_if_changed(path: Path, content: bytes) -> None:
    """Replace a file atomically; leave it untouched if the content is the same."""
    try:
        if path.read_bytes() == content:
            return
    except OSError:
        pass
    with atomic_write(path) as tmp_path:
        tmp_path.write_bytes(content)


def cached_base_map(series: Series, folder: Path, version: str, pixels: int) -> BaseMap:
    """Return the base map of a reference version; caching it with the maps saves half a second each."""
    path = folder / f".terrain_{version}_{pixels}.npz"
    grid = series.grid
    try:
        with path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
            if np.array_equal(file["grid"], [grid.west_m, grid.north_m, grid.cell_m, grid.nx, grid.ny]):
                row_start, row_stop, column_start, column_stop, factor = (
                    int(number) for number in file["extent"]
                )
                west_m, north_m, cell_m = (float(number) for number in file["origin"])
                shade = np.where(
                    file["hillshade"] == 0, np.float32(np.nan), (file["hillshade"] - 1.0) / 254.0
                )
                ny, nx = shade.shape
                part = Grid(west_m, north_m, cell_m, nx, ny, grid.plane)
                rows, columns = slice(row_start, row_stop), slice(column_start, column_stop)
                return BaseMap(version, factor, rows, columns, shade.astype(np.float32), part)
    except (OSError, ValueError, KeyError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error):
        pass  # missing or damaged: computed again
    base = base_map(series, version, pixels)
    shade = (
        np.where(np.isfinite(base.hillshade), 1 + 254 * np.nan_to_num(base.hillshade), 0)
        .round()
        .astype(np.uint8)
    )
    with atomic_write(path) as tmp_path, tmp_path.open("wb") as file:
        np.savez_compressed(
            file,
            grid=[grid.west_m, grid.north_m, grid.cell_m, grid.nx, grid.ny],
            extent=[base.rows.start, base.rows.stop, base.columns.start, base.columns.stop, base.factor],
            origin=[base.grid.west_m, base.grid.north_m, base.grid.cell_m],
            hillshade=shade,
        )
    return base


def _fixed_limit(series: Series, folder: Path, first: MeasuredEpoch) -> float:
    """Return the limit of the change colours [m], fixed once from the first epoch."""
    path = folder / "limit.json"
    try:
        return float(json.loads(path.read_text(encoding="ascii"))["change_limit_m"])
    except (OSError, ValueError, KeyError, TypeError):
        pass
    limit_m = default_limit(series, first.epoch, first.version)
    replace_if_changed(path, json.dumps({"change_limit_m": limit_m}).encode("ascii"))
    return limit_m


def default_limit(series: Series, epoch: EpochRef, version: str) -> float:
    """Return ten times the median sigma of an epoch's cells [m], rounded up."""
    overview = read_overview(epoch, base_map(series, version, max(series.grid.shape)))
    if not overview.observed.any():
        return 1.0
    return round_up(LIMIT_SIGMAS * float(np.median(overview.sigma_m[overview.observed])))


def _delete_old(maps_folder: Path, keep: set[str]) -> None:
    for path in maps_folder.glob("*.webp"):
        if path.name not in keep and time.time() - path.stat().st_mtime > DELETE_GRACE_S:
            path.unlink(missing_ok=True)
