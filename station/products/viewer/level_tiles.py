"""Maps of level and rate for the page, where the station keeps them: tiles of means, of the newest days."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import h5py
import numpy as np

from station.archive.derived.boxes import DAY_S
from station.archive.derived.computed_rasters import CHANGE, RANDOM, TOTAL
from station.archive.derived.level_files import is_day, level_files, level_raster
from station.archive.netcdf_layout import Series
from station.archive.raster_io import Array
from station.archive.read_errors import read_errors
from station.archive.schema import FILL
from station.archive.small_variables import read_number, read_text
from station.errors import StoreError
from station.products.overview import BAND_ROWS, BaseMap, Overview, OverviewBuilder
from station.products.viewer.value_tiles import has_values, write_means

MAX_DAYS = 14  # newest days with maps
QUANTITIES = ("level", "rate")


@dataclass(frozen=True)
class LevelMap:
    """The maps of level and rate at the end of a day."""

    name: str  # of the folders of tiles, after the quantity
    time_s: float  # of the level: the middle of the last epoch of the day
    version: str  # of the reference

    @property
    def folders(self) -> tuple[str, ...]:
        """Names of the folders of tiles."""
        return tuple(f"{quantity}_{self.name}" for quantity in QUANTITIES)


@dataclass(frozen=True)
class LevelMaps:
    """The maps of level and rate, in order of time, and why some are missing."""

    maps: list[LevelMap] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)

    def at(self, time_s: float, version: str) -> str | None:
        """Return the name of the level at the end of the day of a time, or of the last before; or None."""
        end_s = (time_s // DAY_S + 1) * DAY_S
        names = [level.name for level in self.maps if level.time_s < end_s and level.version == version]
        return names[-1] if names else None


def update_levels(series: Series, folder: Path, base: BaseMap, progress: Callable[[], None]) -> LevelMaps:
    """Make the missing maps of the newest days that have the reference of a base map; return all.

    A day whose file is damaged has no map until the file is computed again. Raises StoreError if a map cannot
    be written.
    """
    levels = LevelMaps()
    for path in [path for path in level_files(series) if is_day(path)][-MAX_DAYS:]:
        try:
            level_map = read_head(path)
            if level_map.version != base.version:
                continue
            overviews = {
                name: _overview(path, quantity, base)
                for quantity, name in zip(QUANTITIES, level_map.folders, strict=True)
                if not has_values(folder, name, base, cells=False)
            }
        except StoreError as error:
            levels.faults.append(f"{error}: the page lacks this day's level (station check --store)")
            continue
        for name, overview in overviews.items():
            write_means(folder, name, overview)
            progress()
        levels.maps.append(level_map)
    return levels


def read_head(path: Path) -> LevelMap:
    """Return name, time and reference of a file of levels; raise StoreError if it is damaged."""
    with read_errors(path), h5py.File(path, "r") as file:
        return LevelMap(path.stem, read_number(file, "time", 0), read_text(file, "reference_version", 0))


def _overview(path: Path, quantity: str, base: BaseMap) -> Overview:
    """Return level or rate in pixels, with the sigma of their means; raise StoreError if damaged."""
    builder = OverviewBuilder(base)
    value, random, systematic = (
        level_raster(path, f"{quantity}{part}")
        for part in ("", "_random_uncertainty", "_systematic_uncertainty")
    )
    for top in range(0, value.shape[0], BAND_ROWS):
        rows = slice(top, min(top + BAND_ROWS, value.shape[0]))
        with read_errors(path):
            random_m = np.asarray(random[rows])
            band = {CHANGE: value[rows], TOTAL: np.hypot(random_m, systematic[rows]), RANDOM: random_m}
        builder.add(rows, {name: _as_stored(np.asarray(values)) for name, values in band.items()})
    return builder.build()


def _as_stored(values: Array) -> Array:
    return np.where(np.isfinite(values), values, np.float32(FILL))
